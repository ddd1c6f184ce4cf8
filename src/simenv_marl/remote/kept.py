"""Processes that are kept while many simulations run one after the other, each for the next one that is made alike."""

from __future__ import annotations

from collections.abc import Hashable
from contextvars import ContextVar, Token
from typing import Final

from .child import Child

Kept = dict[Hashable, list[Child]]

_KEPT: Final[ContextVar[Kept | None]] = ContextVar("simenv_marl.processes_kept", default=None)
"""Those that are kept, by how they were started; None where none are."""


class processes_kept:  # noqa: N801 - it is used as a function
    """Keep the processes of simulations that are closed for those that begin, up to the end of the block.

    To start a process takes longer than many an episode. Within another such block it does nothing.
    """

    __slots__ = ("_token",)

    def __enter__(self) -> None:
        self._token: Token[Kept | None] | None = _KEPT.set({}) if _KEPT.get() is None else None

    def __exit__(self, *raised: object) -> None:
        if self._token is None:
            return
        kept = _KEPT.get() or {}
        _KEPT.reset(self._token)
        children = [child for alike in kept.values() for child in alike]
        for child in children:  # first, so that they end side by side
            child.close_input()
        for child in children:
            child.end()


def keep(key: Hashable, child: Child) -> bool:
    """Keep a process, if such are kept here; return whether it is."""
    kept = _KEPT.get()
    if kept is None or not child.usable:
        return False
    kept.setdefault(key, []).append(child)
    return True


def take(key: Hashable) -> Child | None:
    """A process that was started like that and has been kept; None where there is none."""
    alike = (_KEPT.get() or {}).get(key, [])
    while alike:
        child = alike.pop()
        if child.usable:
            return child
    return None
