"""The estimated values of candidate actions, and warnings of futures that tell little."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations, zip_longest
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ..errors import warn_user
from ..simulation import Action

_SEVERAL: Final = 4
"""The number of futures that must be the same before the user is warned."""

_MANY: Final = 16
"""The least number of futures, or of times between decisions, for statistics of them."""

_UNRELATED: Final = (-0.5, 0.1)
"""The user is warned if returns correlate by a number in this interval.

A strong negative correlation shows a common chance, too.
"""

_VARIATION: Final = 0.1
"""The coefficient of variation of times above which the user is warned."""

_SETTLED: Final[set[tuple[str, str]]] = set()
"""The names of simulations and the kinds of warnings that were issued, or need not be."""


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

    actions: tuple[Action, ...]
    means: NDArray[np.float64]
    standard_errors: NDArray[np.float64]
    counts: NDArray[np.int64]
    best: Action
    returns: NDArray[np.float64]
    correlation: float


def estimate(
    actions: Sequence[Action], returns: Sequence[Sequence[float]], best: int
) -> ActionValues:
    """Estimate the values of candidates.

    Args:
        actions: The candidates.
        returns: For each candidate, its returns, in the order of the futures.
        best: The index of the best candidate.
    """
    counts = np.array([*map(len, returns)], np.int64)
    table = np.full((len(counts), counts.max()), np.nan)
    means, errors = np.full((2, len(counts)), np.nan)
    for index, values in enumerate(returns):
        table[index, : len(values)] = values
        if values:
            means[index] = np.mean(values)
        if len(values) > 1:
            errors[index] = np.std(values, ddof=1) / np.sqrt(len(values))
    found = correlation_of(table)
    return ActionValues(tuple(actions), means, errors, counts, actions[best], table, found)


def correlation_of(
    returns: NDArray[np.float64],
    least: int = 3,
) -> float:
    """Return the mean correlation of pairs of rows over their common columns.

    Only pairs of rows that vary count, and only those with the ``least`` number of common columns.
    Nan without such a pair.
    """
    correlations: list[float] = []
    for first, second in combinations(returns, 2):
        common = ~np.isnan(first + second)
        pair = np.array([first[common], second[common]])
        if common.sum() >= least and np.ptp(pair, axis=1).all():
            correlations.append(np.corrcoef(pair)[0, 1])
    if not correlations:
        return np.nan
    return float(np.mean(correlations))


def warn_of_futures(
    name: str, outcomes: Iterable[Sequence[object]], returns: NDArray[np.float64]
) -> None:
    """Warn of futures that are all the same, and of futures that candidates do not share.

    Args:
        name: The name of the simulation.
        outcomes: For each sequence of candidates, its outcomes in several futures. Chance was drawn
            anew for each of them.
        returns: As in ``ActionValues``.
    """
    compared = [futures for futures in outcomes if len(futures) >= _SEVERAL]
    if any(futures.count(futures[0]) < len(futures) for futures in compared):
        # The simulation draws. Later futures may be the same by chance, or near the end.
        _SETTLED.add((name, "same futures"))
    elif compared:
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


def warn_of_times(
    name: str,
    rollouts: Sequence[Sequence[float]],
) -> None:
    """Warn of a horizon in decisions that ends at different times, because decisions do.

    Args:
        name: The name of the simulation.
        rollouts: For each rollout, the simulation's times between its decisions.
    """
    times = np.array([*zip_longest(*rollouts, fillvalue=np.nan)])  # (decisions, rollouts)
    if np.isfinite(times).sum() < _MANY:
        return
    mean = np.nanmean(times)
    deviations = times - np.nanmean(times, axis=1, keepdims=True)
    spread = np.sqrt(np.nanmean(deviations**2))
    if spread > _VARIATION * mean > 0:
        _warn_once(
            name,
            "times",
            f"the times between the decisions of {name} vary, so that a horizon in decisions ends"
            ' at another time for each candidate; use horizon_by="time"',
        )


def _warn_once(
    name: str,
    kind: str,
    message: str,
) -> None:
    """Warn of a simulation, once for each kind of warning."""
    if (name, kind) not in _SETTLED:
        _SETTLED.add((name, kind))
        warn_user(message)
