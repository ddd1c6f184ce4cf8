"""Processes that are kept while many simulations run one after the other, each for the next one that is made alike."""

from __future__ import annotations

from collections.abc import Hashable
from contextvars import ContextVar, Token
from typing import Final
from weakref import ref

from .child import Child

Kept = dict[Hashable, list[Child]]
"""By how they were started."""


class processes_kept:  # noqa: N801 - it is used as a function
    """Keep the processes of simulations that are closed for those that begin, up to the end of the block.

    To start a process takes longer than many an episode. Within another such block it does nothing.
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
        for child in children:  # first, so that they end side by side
            child.close_input()
        for child in children:
            child.end()


_BLOCK: Final[ContextVar[ref[processes_kept] | None]] = ContextVar("simenv_marl.processes_kept", default=None)
"""The block. Weak: an interrupt may come before a block is entered, and it is never left then."""


def _block() -> processes_kept | None:
    found = _BLOCK.get()
    return None if found is None else found()


def keep(key: Hashable, child: Child) -> bool:
    """Keep a process, if such are kept here; return whether it is."""
    block = _block()
    if block is None or not child.usable:
        return False
    block.kept.setdefault(key, []).append(child)
    return True


def take(key: Hashable) -> Child | None:
    """A process that was started like that and has been kept; None where there is none."""
    block = _block()
    alike = [] if block is None else block.kept.get(key, [])
    while alike:
        child = alike.pop()
        if child.usable:
            return child
    return None
