"""What factors do: main effects, interactions, and shares of the variance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from ..errors import OptionValueError, shown
from .extras import needed
from .playing import TEAM
from .statistics import interval

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure
    from pandas import DataFrame

__all__ = ["Effects", "effects", "sobol_indices"]

MANY: Final = 8
"""Numbers of more levels than these are grouped into ``GROUPS``."""

GROUPS: Final = 4


@dataclass(frozen=True, eq=False)
class Effects:
    """What factors do to a value. Made by ``effects``.

    Attributes:
        main: A row for each level of each factor, by which it is indexed: ``mean`` of the value there, its interval
            ``low`` and ``high``, ``effect`` (by how much that is more than the mean of all), and ``count``.
        interactions: A row for each pair of factors: ``strength``, the standard deviation of what the means of their
            combinations are apart from the sum of both main effects; the strongest first.
        of: What the value is.
    """

    main: DataFrame
    interactions: DataFrame
    of: str
    _cells: dict[tuple[str, str], DataFrame]

    def cells(self, one: str, other: str) -> DataFrame:
        """The mean of the value in each combination of two factors: a row for each level of the one.

        Raises:
            OptionValueError: One of them is no factor.
        """
        for pair, table in self._cells.items():
            if pair == (one, other):
                return table
            if pair == (other, one):
                return table.T
        names = list(dict.fromkeys(self.main.index.get_level_values("factor")))
        raise OptionValueError(f"{shown(one)} and {shown(other)} are no two factors of {names}")

    def plot(self, *, figure: Figure | SubFigure | None = None) -> Figure | SubFigure:
        """Draw the main effects of all factors and, below them, the strongest interactions.

        Args:
            figure: Where to draw. None: a new figure.

        Returns:
            The figure. Notebooks show a new one where it is the last value of a cell; ``savefig`` saves it.

        Raises:
            MissingExtraError: Matplotlib is missing.
        """
        from .pictures import draw_effects

        drawn: Figure | SubFigure = draw_effects(self, figure)
        return drawn


def effects(
    frame: DataFrame,
    of: str = "return",
    *,
    contender: str | None = None,
    agent: str = TEAM,
    confidence: float = 0.95,
) -> Effects:
    """Say what the factors of an experiment do.

    Factors of many numbers are grouped into quarters. Runs that have failed are left out.

    Args:
        frame: What ``run_experiment`` has returned.
        of: The value: ``"return"``, ``"length"`` or the name of a metric.
        contender: Whose runs are looked at. None: all, and the contender is a factor like any other.
        agent: Whose rows.
        confidence: Of the intervals.

    Returns:
        The effects.

    Raises:
        OptionValueError: There is no such column, contender or agent, or nothing varies.
    """
    pandas = needed("pandas", "effects")
    table, factors = _taken(frame, of, contender, agent)
    if contender is None and table["contender"].nunique() > 1:
        factors = [*factors, "contender"]
    levels = {name: _levels(table[name]) for name in factors}
    levels = {name: own for name, own in levels.items() if own.nunique(dropna=False) > 1}
    if not levels:
        raise OptionValueError("no factor has more than one level")
    values = table[of].to_numpy(np.float64)
    main = {}
    for name, own in levels.items():
        for level in _in_order(own):
            there = values[_at(own, level)]
            main[name, level] = [there.mean(), *interval(there, confidence), there.mean() - values.mean(), len(there)]
    index = pandas.MultiIndex.from_tuples(main, names=["factor", "level"])
    rows = pandas.DataFrame(list(main.values()), index, columns=["mean", "low", "high", "effect", "count"])
    cells = {pair: _cells(levels[pair[0]], levels[pair[1]], values) for pair in combinations(levels, 2)}
    strengths = [(*pair, _strength(own.to_numpy(np.float64))) for pair, own in cells.items()]
    apart = pandas.DataFrame(strengths, columns=["factor", "other", "strength"]).set_index(["factor", "other"])
    return Effects(rows.astype({"count": int}), apart.sort_values("strength", ascending=False), of, cells)


def _taken(frame: DataFrame, of: str, contender: str | None, agent: str) -> tuple[DataFrame, list[str]]:
    """The rows that count, and the names of the factors.

    Raises:
        OptionValueError: There are none.
    """
    columns = list(frame.columns)
    if not {"contender", "seed", "agent", "return", "length", "status"} <= set(columns):
        raise OptionValueError("frame must be what run_experiment has returned")
    factors = columns[: columns.index("contender")]
    if of not in columns or of in (*factors, "contender", "seed", "agent", "status", "error"):
        values = columns[columns.index("return") : columns.index("status")]
        raise OptionValueError(f"of={shown(of)} is no column with values; there are {values}")
    for what, value in (("contender", contender), ("agent", agent)):
        if value is not None and value not in set(frame[what]):
            raise OptionValueError(f"there is no {what} {shown(value)}; there are {sorted(set(frame[what]))}")
    chosen = (frame["agent"] == agent) & (frame["status"] == "ok")
    table = frame[chosen if contender is None else chosen & (frame["contender"] == contender)]
    if not len(table):
        raise OptionValueError("there is no run that has come to its end")
    return table, factors


def _levels(column: Any) -> Any:
    """The levels of a factor; those of many numbers as quarters of them."""
    pandas = needed("pandas", "effects")
    if column.nunique() > MANY and pandas.api.types.is_numeric_dtype(column) and column.dtype != bool:
        return pandas.qcut(column, GROUPS, duplicates="drop")
    return column


def _in_order(levels: Any) -> list[Any]:
    """The levels of a factor: numbers and groups in their order, others as they come."""
    found = list(levels.cat.categories) if hasattr(levels, "cat") else list(dict.fromkeys(levels.tolist()))
    return sorted(found) if all(type(level) in (int, float) for level in found) else found


def _at(levels: Any, level: Any) -> NDArray[np.bool_]:
    """Where a factor has a level."""
    return np.array([own is level or own == level for own in levels.tolist()], np.bool_)


def _cells(one: Any, other: Any, values: NDArray[np.float64]) -> DataFrame:
    pandas = needed("pandas", "effects")
    rows, columns = _in_order(one), _in_order(other)
    down, across = [_at(one, level) for level in rows], [_at(other, level) for level in columns]
    means = [[values[a & b].mean() if (a & b).any() else np.nan for b in across] for a in down]
    table: DataFrame = pandas.DataFrame(means, index=pandas.Index(rows, name=one.name))
    table.columns = pandas.Index(columns, name=other.name)
    return table


def _strength(means: NDArray[np.float64]) -> float:
    """How far the means of combinations are from the sum of both main effects; nan where some are missing."""
    apart = means - means.mean(axis=1, keepdims=True) - means.mean(axis=0, keepdims=True) + means.mean()
    return float(np.sqrt((apart**2).mean()))


# -- shares of the variance -----------------------------------------------------------------------


def sobol_indices(
    frame: DataFrame,
    of: str = "return",
    *,
    contender: str = "rule",
    agent: str = TEAM,
    confidence: float = 0.95,
) -> DataFrame:
    """Say which share of a value's variance is due to which factor, by SALib.

    Args:
        frame: What ``run_experiment`` has returned for ``design(..., method="saltelli")``. The value of a row is its
            mean over the seeds.
        of: The value: ``"return"``, ``"length"`` or the name of a metric.
        contender: Whose runs are looked at.
        agent: Whose rows.
        confidence: Of the intervals.

    Returns:
        Indexed by factor: ``first``, the share that is due to the factor alone, and ``total``, the share that it takes
        part in; by how much they may be off, ``first_error`` and ``total_error``.

    Raises:
        OptionValueError: The design is another one, runs have failed, or the value does not vary.
        MissingExtraError: SALib is missing.
    """
    pandas, analyze = needed("pandas", "sobol_indices"), needed("SALib.analyze.sobol", "sobol_indices").analyze
    if ((frame["contender"] == contender) & (frame["status"] != "ok")).any():
        raise OptionValueError("some runs have failed, and shares of the variance need all rows of the design")
    table, names = _taken(frame, of, contender, agent)
    seeds = table["seed"].nunique()
    values, rows = table[of].to_numpy(np.float64), table[names].to_numpy(object)
    if len(values) % seeds or not _is_saltelli(rows[::seeds]):
        raise OptionValueError("shares of the variance need all rows of design(..., method='saltelli'), in their order")
    means = values.reshape(-1, seeds).mean(axis=1)
    if (means == means[0]).all():
        raise OptionValueError(f"{of!r} is {means[0]:g} in all rows, and has no variance")
    problem = {"num_vars": len(names), "names": names, "bounds": [[0.0, 1.0]] * len(names)}
    found = analyze(problem, means, conf_level=confidence, seed=0)
    columns = {"first": "S1", "first_error": "S1_conf", "total": "ST", "total_error": "ST_conf"}
    return pandas.DataFrame({name: found[key] for name, key in columns.items()}, pandas.Index(names, name="factor"))


def _is_saltelli(rows: Sequence[Any]) -> bool:
    """Whether rows are blocks of: A; A with each factor of B in turn; B with each factor of A in turn; B."""
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
