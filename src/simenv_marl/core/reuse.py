"""Reuses resources, such as processes, for equal simulations that run one after the other."""

from __future__ import annotations

from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Final, Protocol


class Resource(Protocol):
    """A resource that can serve several simulations, one after the other."""

    @property
    def usable(self) -> bool:
        """Whether another simulation can use it."""

    def close_input(self) -> None:
        """Ask the resource to end."""

    def close(self) -> None:
        """Wait for the end of the resource."""


_POOL: Final[ContextVar[dict[Hashable, list[Resource]] | None]] = ContextVar("simenv_marl.reuse", default=None)
"""The free resources, by the arguments that made them. None outside a block of ``reuse_resources``."""


@contextmanager
def reuse_resources() -> Iterator[None]:
    """Reuse the resources of closed simulations for new ones, until the end of the block.

    Starting a process often takes longer than an episode. Within another such block this does nothing.
    """
    if _POOL.get() is not None:
        yield
        return
    pool: dict[Hashable, list[Resource]] = {}
    token = _POOL.set(pool)
    try:
        yield
    finally:
        _POOL.reset(token)
        resources = [resource for alike in pool.values() for resource in alike]
        for resource in resources:  # first for all of them, so that they end at the same time
            resource.close_input()
        for resource in resources:
            resource.close()


def release(key: Hashable, resource: Resource) -> bool:
    """Leave a resource to later simulations; return False if it is not usable, or if there is no block."""
    pool = _POOL.get()
    if pool is None or not resource.usable:
        return False
    pool.setdefault(key, []).append(resource)
    return True


def acquire(key: Hashable) -> Any:
    """Return a usable resource that was released under an equal key; None if there is none."""
    alike = (_POOL.get() or {}).get(key, [])
    while alike:
        resource = alike.pop()
        if resource.usable:
            return resource
    return None
