"""The load of a run: how many episodes planners have before them, and on how many processes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final, NamedTuple


class Load(NamedTuple):
    """The episodes of a run, and the processes that share them."""

    episodes: int
    processes: int


_LOADS: Final[list[Load]] = []


@contextmanager
def loaded(episodes: int, processes: int) -> Iterator[None]:
    """Let the first planner of a run take its load."""
    before = [*_LOADS]
    _LOADS.append(Load(episodes, processes))
    try:
        yield
    finally:
        _LOADS[:] = before


def take_load() -> Load | None:
    """Return the load of the run, once. None outside of runs."""
    return _LOADS.pop() if _LOADS else None
