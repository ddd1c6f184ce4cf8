"""Resources that several simulations use one after the other, such as processes."""

from __future__ import annotations

from contextvars import ContextVar
from typing import Final, Protocol, TypeVar


class Resource(Protocol):
    """A resource that a later simulation can use."""

    @property
    def usable(self) -> bool:
        """Whether it can be used again."""

    def close_input(self) -> None:
        """Ask it to end."""

    def close(self) -> None:
        """Wait for its end."""


ResourceType = TypeVar("ResourceType", bound=Resource)

_FREE: Final[ContextVar[list[tuple[object, Resource]] | None]] = ContextVar(
    "simenv_marl.free", default=None
)
"""The free resources of the current block, each with its key. None outside of a block."""


class reuse_resources:  # noqa: N801 - it is used like a function
    """Reuse the resources of closed simulations for new ones, until the end of the block.

    Starting a process often takes longer than an episode. Within another such block this does
    nothing.
    """

    def __enter__(self) -> None:
        self._token = _FREE.set([]) if _FREE.get() is None else None

    def __exit__(self, *error: object) -> None:
        if self._token is None:
            return
        free = _FREE.get() or []
        _FREE.reset(self._token)
        for _, resource in free:  # first for all of them, so that they end at the same time
            resource.close_input()
        for _, resource in free:
            resource.close()


def release(key: object, resource: Resource) -> bool:
    """Leave a resource to later simulations. Return False if that is not possible."""
    free = _FREE.get()
    if free is None or not resource.usable:
        return False
    free.append((key, resource))
    return True


def acquire(key: object, kind: type[ResourceType]) -> ResourceType | None:
    """Return a resource of a kind that was released under an equal key. None if there is none."""
    free = _FREE.get() or []
    for number, (other, resource) in enumerate(free):
        if other == key and isinstance(resource, kind):
            del free[number]
            return resource
    return None
