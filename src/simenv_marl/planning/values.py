"""The values of candidate actions, and warnings of simulations whose futures tell little about them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations, zip_longest
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ..errors import warn_user

_SEVERAL: Final = 4
"""The number of futures of a plan that are compared to find out whether they are all the same."""

_MANY: Final = 16
"""The number of futures, or of times between decisions, from which on their statistics are trusted."""

_UNRELATED: Final = (-0.5, 0.1)
"""Between these correlations of returns, the user is warned.

Far below, the same chance meets all candidates, too.
"""

_VARIATION: Final = 0.1
"""The coefficient of variation of times above which the user is warned."""

_SETTLED: Final[set[tuple[str, str]]] = set()
"""The simulations of which the user was warned, or need not be, and of what."""


@dataclass(frozen=True, eq=False)
class ActionValues:
    """The estimated values of candidate actions. Made by ``action_values`` and by planners.

    Attributes:
        actions: The candidates.
        means: ``(candidates,)``: the mean return of each candidate; nan if it was not tried.
        standard_errors: ``(candidates,)``: the standard errors of the means; nan with fewer than
            two returns.
        counts: ``(candidates,)`` int: the number of futures in which each candidate was tried.
        best: The best candidate.
        returns: ``(candidates, futures)``: the returns, nan where a candidate was not tried. A
            column is one future, so that the difference of two rows excludes the chance that
            affects both.
        correlation: The mean correlation of the returns of pairs of candidates over their common
            futures; nan with fewer than three of these, or where the returns do not vary. Where it
            is low, the same chance does not meet all candidates, and differences take many futures
            to see.
    """

    actions: tuple[Any, ...]
    means: NDArray[np.float64]
    standard_errors: NDArray[np.float64]
    counts: NDArray[np.int64]
    best: Any
    returns: NDArray[np.float64]
    correlation: float


def correlation_of(returns: NDArray[np.float64], least: int = 3) -> float:
    """Return the mean correlation of pairs of rows over their common columns.

    Nan if no pair has the ``least`` number.

    Rows that do not vary do not count.
    """
    found = []
    for one, other in combinations(returns, 2):
        both = ~np.isnan(one + other)
        if both.sum() >= least and np.ptp(one[both]) > 0 and np.ptp(other[both]) > 0:
            found.append(np.corrcoef(one[both], other[both])[0, 1])
    return float(np.mean(found)) if found else float("nan")


def warn_of_futures(name: str, outcomes: Iterable[list[Any]], returns: NDArray[np.float64]) -> None:
    """Warn of futures that are all the same although chance was drawn anew, and of those that candidates do not share.

    Args:
        name: The name of the simulation.
        outcomes: For each plan, what was seen in its futures.
        returns: As in ``ActionValues``.
    """
    several = [seen for seen in outcomes if len(seen) >= _SEVERAL]
    if any(seen.count(seen[0]) != len(seen) for seen in several):
        # it draws; by chance, or near the end, futures can be the same later
        _SETTLED.add((name, "same futures"))
    elif several:
        _warn_once(
            name,
            "same futures",
            f"all futures of {name} are the same, although it was reseeded for each: it is"
            " deterministic from here, or its reseed does not reach the generators that it draws"
            " from, and the planner foresees chance. reseed must seed each of them;"
            " global_rng=True reaches those of random and numpy.random alone",
        )
    correlation = correlation_of(returns, _MANY)
    if _UNRELATED[0] < correlation < _UNRELATED[1]:
        _warn_once(
            name,
            "correlation",
            f"the same future of {name} is a different one for each candidate: their returns"
            f" correlate by {correlation:.2f}, so that differences take many futures to see. Give"
            " each process or entity a generator for itself, and reseed each of them: an action"
            " then changes no chance but its own",
        )


def warn_of_times(name: str, rollouts: Sequence[list[float]]) -> None:
    """Warn of a horizon in decisions, if it ends at different times: if times vary between rollouts.

    Args:
        name: The name of the simulation.
        rollouts: The times between decisions, in each rollout.
    """
    at_each = [
        np.array([time for time in times if time is not None]) for times in zip_longest(*rollouts)
    ]
    times = np.concatenate([np.zeros(0), *at_each])
    if len(times) < _MANY or times.mean() <= 0:
        return
    spread = np.sqrt(np.mean(np.concatenate([times - times.mean() for times in at_each]) ** 2))
    if spread > _VARIATION * times.mean():
        _warn_once(
            name,
            "times",
            f"the times between the decisions of {name} vary, so that a horizon in decisions ends"
            " at another time for"
            ' each candidate; use horizon_by="time"',
        )


def _warn_once(name: str, kind: str, message: str) -> None:
    """Warn of a simulation, once for each kind of warning."""
    if (name, kind) not in _SETTLED:
        _SETTLED.add((name, kind))
        warn_user(message)
