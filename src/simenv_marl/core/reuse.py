"""Reuses resources, such as processes, for equal simulations that run one after the other."""

from __future__ import annotations

from collections.abc import Hashable
from contextvars import ContextVar
from typing import Any, Final, Protocol
from weakref import ref


class Resource(Protocol):
    """A resource that can serve several simulations, one after the other."""

    @property
    def usable(self) -> bool:
        """Whether another simulation can use it."""

    def close_input(self) -> None:
        """Ask the resource to end."""

    def close(self) -> None:
        """Wait for the end of the resource."""


class reuse_resources:  # noqa: N801 - it is used like a function; not a generator: immutable errors cannot pass one
    """Reuse the resources of closed simulations for new ones, until the end of the block.

    Starting a process often takes longer than an episode. Within another such block this does nothing.

    Attributes:
        free: The free resources, by the arguments that made them.
    """

    def __init__(self) -> None:
        self.free: dict[Hashable, list[Resource]] = {}
        self._token: Any = None

    def __enter__(self) -> None:
        if _block() is None:
            self._token = _BLOCK.set(ref(self))

    def __exit__(self, *error: object) -> None:
        if self._token is None:
            return
        _BLOCK.reset(self._token)
        resources = [resource for alike in self.free.values() for resource in alike]
        for resource in resources:  # first for all of them, so that they end at the same time
            resource.close_input()
        for resource in resources:
            resource.close()


_BLOCK: Final[ContextVar[Any]] = ContextVar("simenv_marl.reuse", default=lambda: None)
"""A reference to the current block. Weak: after an interrupt before it was entered, a block is never left."""


def _block() -> reuse_resources | None:
    block: reuse_resources | None = _BLOCK.get()()
    return block


def release(key: Hashable, resource: Resource) -> bool:
    """Leave a resource to later simulations; return False if it is not usable, or if there is no block."""
    block = _block()
    if block is None or not resource.usable:
        return False
    block.free.setdefault(key, []).append(resource)
    return True


def acquire(key: Hashable) -> Any:
    """Return a usable resource that was released under an equal key; None if there is none."""
    block = _block()
    alike = [] if block is None else block.free.get(key, [])
    while alike:
        resource = alike.pop()
        if resource.usable:
            return resource
    return None
