"""Keeps processes while many simulations run one after the other, to reuse them for equal simulations."""

from __future__ import annotations

from collections.abc import Hashable
from contextvars import ContextVar, Token
from typing import Any, Final, Protocol
from weakref import ref


class Reusable(Protocol):
    """A resource that can serve several simulations, one after the other."""

    @property
    def usable(self) -> bool:
        """Whether another simulation can use it."""

    def close_input(self) -> None:
        """Ask the resource to end."""

    def end(self) -> None:
        """Wait for the end of the resource."""


Kept = dict[Hashable, list[Any]]
"""Kept processes, by the arguments that started them."""


class processes_kept:  # noqa: N801 - it is used as a function
    """Keep the processes of closed simulations for new ones, until the end of the block.

    Starting a process often takes longer than an episode. Within another such block this does nothing.
    """

    __slots__ = ("__weakref__", "_token", "kept")

    def __init__(self) -> None:
        self.kept: Kept = {}
        self._token: Token[ref[processes_kept] | None] | None = None

    def __enter__(self) -> None:
        if _block() is None:
            self._token = _BLOCK.set(ref(self))

    def __exit__(self, *raised: object) -> None:
        if self._token is None:
            return
        _BLOCK.reset(self._token)
        children = [child for alike in self.kept.values() for child in alike]
        for child in children:  # first for all of them, so that they end at the same time
            child.close_input()
        for child in children:
            child.end()


_BLOCK: Final[ContextVar[ref[processes_kept] | None]] = ContextVar("simenv_marl.processes_kept", default=None)
"""The current block. Weak: after an interrupt before it was entered, a block is never left."""


def _block() -> processes_kept | None:
    found = _BLOCK.get()
    return None if found is None else found()


def keep(key: Hashable, child: Reusable) -> bool:
    """Keep a process if a block is active; return whether it is kept."""
    block = _block()
    if block is None or not child.usable:
        return False
    block.kept.setdefault(key, []).append(child)
    return True


def take(key: Hashable) -> Any:
    """Return a kept process that was started in the same way; None if there is none."""
    block = _block()
    alike = [] if block is None else block.kept.get(key, [])
    while alike:
        child = alike.pop()
        if child.usable:
            return child
    return None
