"""Effects of factors: main effects, interactions, and shares of the variance."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from ..errors import OptionValueError, did_you_mean, short_repr
from ..many.parallel import import_extra
from .playing import TEAM
from .statistics import check_confidence, interval, numbers

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure
    from pandas import DataFrame

__all__ = ["Effects", "effects", "sobol_indices"]

MANY: Final = 8
"""Numeric factors with more levels than this are grouped into ``GROUPS``."""

GROUPS: Final = 4


@dataclass(frozen=True, eq=False)
class Effects:
    """The effects of factors on a value. Made by ``effects``.

    Attributes:
        main: One row for each level of each factor, the index: ``mean`` (of the value at this level), the bounds of its
            interval ``low`` and ``high``, ``effect`` (the mean minus the mean of all), and ``count``.
        interactions: One row for each pair of factors, the strongest first. ``strength`` is the standard deviation of
            the differences between the means of their combinations and the sum of both main effects.
        of: The name of the value.
        levels: The levels of each factor with their types. An index cannot distinguish 1, True and 1.0.
    """

    main: "DataFrame"
    interactions: "DataFrame"
    of: str
    levels: dict[str, list[Any]]
    _cells: "dict[tuple[str, str], DataFrame]"

    def cells(self, one: str, other: str) -> "DataFrame":
        """Return the mean of the value for each combination of two factors: one row for each level of the first.

        Raises:
            OptionValueError: One of them is not a factor.
        """
        for pair, table in self._cells.items():
            if pair == (one, other):
                return table
            if pair == (other, one):
                return table.T
        raise OptionValueError(f"{short_repr(one)} and {short_repr(other)} are not two factors of {list(self.levels)}")

    def plot(self, *, figure: "Figure | SubFigure | None" = None) -> "Figure | SubFigure":
        """Draw the main effects of all factors and, below them, the strongest interactions.

        Args:
            figure: The figure to draw in. None: a new figure.

        Returns:
            The figure. A notebook shows a new figure that is the last value of a cell; ``savefig`` saves it.

        Raises:
            MissingExtraError: Matplotlib is missing.
        """
        from .pictures import draw_effects

        drawn: Figure | SubFigure = draw_effects(self, figure)
        return drawn


def effects(
    frame: "DataFrame",
    of: str = "return",
    *,
    contender: str | None = None,
    agent: str = TEAM,
    confidence: float = 0.95,
) -> Effects:
    """Estimate the effects of an experiment's factors.

    Numeric factors with many values are grouped into quarters. Failed runs are left out. Intervals are over the seeds,
    for the given rows: the effects of other factors at a level do not widen its interval. With a single seed, intervals
    are over the rows.

    Args:
        frame: The result of ``run_experiment``.
        of: The value: ``"return"``, ``"length"`` or the name of a metric.
        contender: The contender whose runs are used. None: all runs, with the contender as one more factor.
        agent: The agent whose rows are used. Default: the team.
        confidence: The confidence level of the intervals.

    Returns:
        The effects.

    Raises:
        OptionValueError: There is no such column, contender or agent, the values are not numbers, or nothing varies.
    """
    pandas = import_extra("pandas", "effects")
    check_confidence(confidence)
    table, factors = _taken(frame, of, contender, agent)
    if contender is None and table["contender"].nunique() > 1:
        factors = [*factors, "contender"]
    levels = {name: _levels(table[name]) for name in factors}
    found = {name: _in_order(own) for name, own in levels.items()}
    found = {name: own for name, own in found.items() if len(own) > 1}
    if not found:
        raise OptionValueError("no factor has more than one level")
    values = numbers(table[of], of).to_numpy()
    at = {name: [_at(levels[name], level) for level in own] for name, own in found.items()}
    main = []
    seeds = table["seed"].to_numpy()
    for mask in (mask for masks in at.values() for mask in masks):
        there = values[mask]
        sample = _by_seed(there, seeds[mask])
        main.append([there.mean(), *interval(sample, confidence), there.mean() - values.mean(), len(there)])
    pairs = [(name, level) for name, own in found.items() for level in own]
    index = pandas.MultiIndex.from_tuples(pairs, names=["factor", "level"])
    rows = pandas.DataFrame(main, index, columns=["mean", "low", "high", "effect", "count"])
    cells = {pair: _cells(pair, found, at, values) for pair in combinations(found, 2)}
    strengths = [(*pair, _strength(own.to_numpy(np.float64))) for pair, own in cells.items()]
    apart = pandas.DataFrame(strengths, columns=["factor", "other", "strength"]).set_index(["factor", "other"])
    return Effects(rows.astype({"count": int}), apart.sort_values("strength", ascending=False), of, found, cells)


def _by_seed(values: NDArray[np.float64], seeds: NDArray[Any]) -> NDArray[np.float64]:
    """Return the mean of each seed, or the values themselves if there is only one seed."""
    distinct, place = np.unique(seeds, return_inverse=True)
    if len(distinct) < 2:
        return values
    return np.bincount(place, values) / np.bincount(place)


def _taken(frame: "DataFrame", of: str, contender: str | None, agent: str) -> "tuple[DataFrame, list[str]]":
    """Return the rows to use, and the names of the factors.

    Raises:
        OptionValueError: There are none.
    """
    columns = list(getattr(frame, "columns", ()))
    if not {"contender", "seed", "agent", "return", "length", "status"} <= set(columns):
        raise OptionValueError("frame must be the DataFrame that run_experiment returned")
    factors = columns[: columns.index("contender")]
    if of not in columns or of in (*factors, "contender", "seed", "agent", "status", "error"):
        values = columns[columns.index("return") : columns.index("status")]
        raise OptionValueError(
            f"of={short_repr(of)} is not a column of numbers; these are: {values}{did_you_mean(of, values)}"
        )
    for what, value in (("contender", contender), ("agent", agent)):
        if value is not None and value not in set(frame[what]):
            known = sorted(set(frame[what]))
            raise OptionValueError(
                f"there is no {what} {short_repr(value)}; there are {known}{did_you_mean(value, known)}"
            )
    chosen = (frame["agent"] == agent) & (frame["status"] == "ok")
    table = frame[chosen if contender is None else chosen & (frame["contender"] == contender)]
    if not len(table):
        raise OptionValueError("no run has come to its end")
    return table, factors


def _levels(column: Any) -> Any:
    """Return the level of each row; numeric factors with many values are grouped into quarters."""
    pandas = import_extra("pandas", "effects")
    if column.nunique() > MANY and pandas.api.types.is_numeric_dtype(column) and column.dtype != bool:
        return pandas.qcut(column, GROUPS, duplicates="drop")
    return column


def _in_order(levels: Any) -> list[Any]:
    """Return a factor's levels: numbers and groups sorted, others in order of appearance, one for missing values."""
    found: list[Any] = list(levels.cat.categories) if hasattr(levels, "cat") else list(dict.fromkeys(levels.tolist()))
    found = [level for level in found if not _is_nan(level)]
    ordered = sorted(found) if all(type(level) in (int, float) for level in found) else found
    return [*ordered, *([float("nan")] if any(map(_is_nan, levels.tolist())) else [])]


def _is_nan(level: Any) -> bool:
    return isinstance(level, float) and level != level


def _at(levels: Any, level: Any) -> NDArray[np.bool_]:
    """Return in which rows a factor has a level."""
    return np.array([own == level or (_is_nan(own) and _is_nan(level)) for own in levels.tolist()], np.bool_)


def _cells(pair: tuple[str, str], levels: Any, at: Any, values: NDArray[np.float64]) -> "DataFrame":
    """Return the means of all combinations of two factors."""
    pandas, (one, other) = import_extra("pandas", "effects"), pair
    means = [[values[a & b].mean() if (a & b).any() else np.nan for b in at[other]] for a in at[one]]
    table: DataFrame = pandas.DataFrame(means, index=pandas.Index(levels[one], name=one))
    table.columns = pandas.Index(levels[other], name=other)
    return table


def _strength(means: NDArray[np.float64]) -> float:
    """Return how far the means of combinations are from the sum of both main effects; nan if some are missing."""
    apart = means - means.mean(axis=1, keepdims=True) - means.mean(axis=0, keepdims=True) + means.mean()
    return float(np.sqrt((apart**2).mean()))


# -- shares of the variance -----------------------------------------------------------------------


def sobol_indices(
    frame: "DataFrame",
    of: str = "return",
    *,
    contender: str = "rule",
    agent: str = TEAM,
    confidence: float = 0.95,
) -> "DataFrame":
    """Estimate the share of each factor in the variance of a value (Sobol indices), by SALib.

    Args:
        frame: The result of ``run_experiment`` for ``design(..., method="saltelli")``. The value of a row is its mean
            over the seeds.
        of: The value: ``"return"``, ``"length"`` or the name of a metric.
        contender: The contender whose runs are used.
        agent: The agent whose rows are used. Default: the team.
        confidence: The confidence level of the error bounds.

    Returns:
        A table indexed by factor: ``first`` (first-order index, the share of the factor alone), ``total`` (total-order
        index, which includes its interactions), and the half-widths of their intervals, ``first_error`` and
        ``total_error``.

    Raises:
        OptionValueError: The frame has another design, runs have failed, or the value is not a number or does not vary.
        MissingExtraError: SALib is missing.
    """
    pandas = import_extra("pandas", "sobol_indices")
    analyze = import_extra("SALib.analyze.sobol", "sobol_indices").analyze
    check_confidence(confidence)
    table, names = _taken(frame, of, contender, agent)
    if ((frame["contender"] == contender) & (frame["status"] != "ok")).any():
        raise OptionValueError("some runs have failed, but shares of the variance need all rows of the design")
    seeds = table["seed"].nunique()
    values, rows = numbers(table[of], of).to_numpy(), table[names].to_numpy(object)
    if not np.isfinite(values).all():
        raise OptionValueError(f"{of!r} is missing or not finite in some rows, but shares of the variance need all")
    if len(values) % seeds or not _is_saltelli(rows[::seeds]):
        raise OptionValueError("shares of the variance need all rows of design(..., method='saltelli'), in their order")
    means = values.reshape(-1, seeds).mean(axis=1)
    if (means == means[0]).all():
        raise OptionValueError(f"{of!r} is {means[0]:g} in all rows, so it has no variance")
    problem = {"num_vars": len(names), "names": names, "bounds": [[0.0, 1.0]] * len(names)}
    found = analyze(problem, means, conf_level=confidence, seed=0)
    columns = {"first": "S1", "first_error": "S1_conf", "total": "ST", "total_error": "ST_conf"}
    return pandas.DataFrame({name: found[key] for name, key in columns.items()}, pandas.Index(names, name="factor"))


def _is_saltelli(rows: Sequence[Any]) -> bool:
    """Return whether rows are blocks of: A; A with each factor of B in turn; B with each factor of A in turn; B."""
    count = len(rows[0])
    size = 2 * count + 2
    if not count or len(rows) % size:
        return False
    for start in range(0, len(rows), size):
        block = rows[start : start + size]
        first, last = block[0], block[-1]
        for place in range(count):
            here = np.arange(count) == place
            if not (block[1 + place] == np.where(here, last, first)).all():
                return False
            if not (block[1 + count + place] == np.where(here, first, last)).all():
                return False
    return True
