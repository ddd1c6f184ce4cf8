"""Effects of factors: main effects, interactions, and shares of the variance."""

from dataclasses import dataclass, field
from itertools import combinations
from math import ceil
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..data.plots import COLOURS, interval, is_proportion, style
from ..errors import OptionValueError, did_you_mean, short_repr
from ..many.parallel import import_extra
from .designs import saltelli_blocks
from .evaluation import check_metric, check_number, numbers
from .plots import LOOKS, draw_means, label_levels, short_text
from .runner import RUN_COLUMNS, TEAM

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure
    from pandas import DataFrame, Series


@dataclass(frozen=True, eq=False)
class Effects:
    """The effects of factors on a value. Made by ``effects``.

    Attributes:
        main: One row for each level of each factor, the index: ``mean`` (of the seeds' means at
            this level), the bounds of its interval ``low`` and ``high`` (as ``Evaluation.summary``
            has them, nan where nothing is known), ``effect`` (the mean minus the same mean of all
            levels), and ``count``.
        interactions: One row for each pair of factors, the strongest first. ``strength`` is the
            standard deviation of the differences between the means of their combinations and the
            sum of both main effects.
        metric: The name of the value.
        levels: The levels of each factor with their types.
    """

    main: "DataFrame"
    interactions: "DataFrame"
    metric: str
    levels: dict[str, list[Any]]
    _cells: "dict[tuple[str, str], DataFrame]" = field(repr=False)

    def cells(self, one: str, other: str) -> "DataFrame":
        """Return the mean of the value for each combination of the levels of two factors.

        The first factor has the rows, the second the columns.

        Raises:
            OptionValueError: One of them is not a factor.
        """
        if (one, other) not in self._cells:
            names = f"{short_repr(one)} and {short_repr(other)}"
            raise OptionValueError(f"{names} are not two factors of {list(self.levels)}")
        return self._cells[one, other]

    def plot(self, *, figure: "Figure | SubFigure | None" = None) -> "Figure | SubFigure":
        """Draw the main effects of all factors and, below them, the strongest interactions.

        ``figure`` and the result are as in ``plot_timeline``.
        """
        pairs = [pair for pair, strength in self.interactions["strength"].items() if strength > 0][
            :4
        ]
        columns = min(max(len(self.levels), len(pairs)), 5)  # more would be too small to read
        above = ceil(len(self.levels) / columns)
        with style(figure) as make_figure:
            figure = make_figure(max(3.2, 2.3 * columns), 2.8 * (above + bool(pairs)))
            grid = figure.subplots(above + bool(pairs), columns, squeeze=False)
            upper = grid[:above].ravel()
            for axes, factor in zip(upper, self.levels, strict=False):
                means = self.main.loc[factor]
                draw_means(axes, range(len(means)), means, LOOKS["effect"])
                label_levels(axes, self.levels[factor], factor)
                if axes is not upper[0]:
                    axes.sharey(upper[0])
            for axes in grid[:above, 0]:
                axes.set_ylabel(f"{self.metric}, mean")
            for axes, (one, other) in zip(grid[-1], pairs, strict=False):
                for place, level in enumerate(self.levels[other]):
                    axes.plot(
                        self._cells[one, other].iloc[:, place].to_numpy(),
                        "o-",
                        color=COLOURS[place % len(COLOURS)],
                        markersize=4,
                        label=short_text(level),
                    )
                label_levels(axes, self.levels[one], one)
                axes.legend(title=other, **LOOKS["levels"])
            for axes in grid.flat:
                axes.set_visible(axes.has_data())
        return figure


def effects(
    frame: "DataFrame",
    metric: str = "return",
    *,
    contender: str | None = None,
    agent: str = TEAM,
    confidence: float = 0.95,
) -> Effects:
    """Estimate the effects of an experiment's factors.

    Numeric factors with more than eight values are grouped into quarters of their values. Failed
    runs are left out. Means and intervals are over the seeds, for the given rows: the effects of
    other factors at a level do not widen its interval. With a single seed, they are over the rows.

    Args:
        frame: The result of ``run_experiment``.
        metric: The value: ``"return"``, ``"length"`` or the name of a metric.
        contender: The contender whose runs are used. None: all runs, with the contender as one more
            factor.
        agent: The agent whose rows are used. Default: the team.
        confidence: The confidence level of the intervals.

    Returns:
        The effects.

    Raises:
        OptionValueError: There is no such column, contender or agent, the values are not numbers,
            or nothing varies.
    """
    import pandas

    check_number("confidence", confidence, 1)
    table, factors = _select(frame, metric, contender, agent)
    if contender is None and table["contender"].nunique() > 1:
        factors = [*factors, "contender"]
    levels = {}
    codes = {}
    for name in factors:
        places, own_levels = _encode(table[name])
        if len(own_levels) > 1:
            codes[name] = places
            levels[name] = own_levels
    if not levels:
        raise OptionValueError("no factor has more than one level")
    values = pandas.Series(numbers(table[metric], metric).to_numpy(), table["seed"])
    is_share = is_proportion(table[metric].to_numpy())
    overall = _over_seeds(values).mean()
    rows = []
    for name in levels:
        for code, group in values.groupby(codes[name]):
            sample = _over_seeds(group)
            mean = sample.mean()
            is_proper = is_share and len(sample) == len(group)  # each is the value of one run
            low, high, _ = interval(sample, confidence, proportion=is_proper)
            rows.append((name, levels[name][code], mean, low, high, mean - overall, len(group)))
    columns = ["factor", "level", "mean", "low", "high", "effect", "count"]
    main = pandas.DataFrame(rows, columns=columns).set_index(["factor", "level"])
    cells = {}
    strengths = []
    for one, other in combinations(levels, 2):
        means = values.groupby([codes[one], codes[other]]).mean().unstack()
        table = means.set_axis(levels[one], axis=0).set_axis(levels[other], axis=1)
        cells[one, other] = table.rename_axis(index=one, columns=other)
        cells[other, one] = cells[one, other].T
        grid = means.to_numpy()
        rest = grid - grid.mean(axis=1, keepdims=True) - grid.mean(axis=0) + grid.mean()
        strengths.append((one, other, np.sqrt((rest**2).mean())))  # nan if a combination is missing
    interactions = pandas.DataFrame(strengths, columns=["factor", "other", "strength"])
    interactions = interactions.set_index(["factor", "other"])
    strongest_first = interactions.sort_values("strength", ascending=False)
    return Effects(main, strongest_first, metric, levels, cells)


def _over_seeds(values: "Series[float]") -> NDArray[np.float64]:
    """Return the mean of each seed, the index, or all values of a single seed."""
    means = values.groupby(level=0).mean()
    sample: NDArray[np.float64] = (means if len(means) > 1 else values).to_numpy()
    return sample


def _select(
    frame: "DataFrame",
    metric: str,
    contender: str | None,
    agent: str,
) -> "tuple[DataFrame, list[str]]":
    """Return the rows to use, and the names of the factors."""
    columns = list(getattr(frame, "columns", ()))
    if not {*RUN_COLUMNS, "status"} <= set(columns):
        raise OptionValueError("frame must be the DataFrame that run_experiment returned")
    factors = columns[: columns.index("contender")]
    check_metric(metric, columns[len(factors) :])
    selection = frame["status"] == "ok"
    for column, value in (("contender", contender), ("agent", agent)):
        if value is None:
            continue
        names = sorted(set(frame[column]))
        if value not in names:
            raise OptionValueError(
                f"there is no {column} {short_repr(value)}; there are"
                f" {names}{did_you_mean(value, names)}"
            )
        selection &= frame[column] == value
    if not selection.any():
        raise OptionValueError("no run has come to its end")
    return frame[selection], factors


def _encode(column: "Series[Any]") -> tuple[NDArray[np.intp], list[Any]]:
    """Return the index of each row's level, and the levels.

    Levels of numeric factors are sorted, others have the order of the rows. Numeric factors with
    more than eight values are grouped into quarters of these values, however often each occurs.
    """
    import pandas

    is_numeric = pandas.api.types.is_numeric_dtype(column) and column.dtype != bool
    if is_numeric and column.nunique() > 8:
        _, bounds = pandas.qcut(column.drop_duplicates(), 4, retbins=True)
        column = pandas.cut(column, bounds, include_lowest=True)
    values = column.dropna().tolist()
    if len(set(zip(map(type, values), values, strict=True))) > len(set(values)):
        raise OptionValueError(
            f"the factor {column.name!r} has levels that are equal, such as 1 and True; replace"
            " them by texts"
        )
    codes, levels = pandas.factorize(column, sort=is_numeric, use_na_sentinel=False)
    return codes, levels.tolist()


# -- shares of the variance -----------------------------------------------------------------------


def sobol_indices(
    frame: "DataFrame",
    metric: str = "return",
    *,
    contender: str = "rule",
    agent: str = TEAM,
    confidence: float = 0.95,
) -> "DataFrame":
    """Estimate the share of each factor in the variance of a value (Sobol indices), by SALib.

    Args:
        frame: The result of ``run_experiment`` for ``design(..., method="saltelli")``. The value of
            a row is its mean over the seeds.
        metric: As ``effects`` takes it.
        contender: As ``effects`` takes it.
        agent: As ``effects`` takes it.
        confidence: The confidence level of the error bounds.

    Returns:
        A table indexed by factor: ``first`` (first-order index, the share of the factor alone),
        ``total`` (total-order index, which includes its interactions), and the half-widths of their
        intervals, ``first_error`` and ``total_error``.

    Raises:
        OptionValueError: The design is another or has one sample, runs have failed, or the value is
            no number or equal.
        MissingExtraError: SALib is missing.
    """
    import pandas

    analyze = import_extra("SALib.analyze.sobol", "sobol_indices").analyze
    check_number("confidence", confidence, 1)
    table, names = _select(frame, metric, contender, agent)
    seeds = table["seed"].nunique()
    values = numbers(table[metric], metric).to_numpy()
    rows = table[names].to_numpy(object)
    if not np.isfinite(values).all():
        raise OptionValueError(
            f"{metric!r} is missing or not finite in some rows, but shares of the variance need all"
        )
    if len(values) % seeds or not _is_saltelli(rows[::seeds]):
        raise OptionValueError(
            "shares of the variance need all rows of design(..., method='saltelli'), in order, and"
            " no failed run"
        )
    means = values.reshape(-1, seeds).mean(axis=1)
    if len(means) == 2 * len(names) + 2:
        raise OptionValueError(
            "one sample tells nothing of shares of the variance; give design n=64 or more samples"
        )
    if (means == means[0]).all():
        raise OptionValueError(f"{metric!r} is {means[0]:g} in all rows, so it has no variance")
    problem = {"num_vars": len(names), "names": names, "bounds": [[0.0, 1.0]] * len(names)}
    indices = analyze(problem, means, conf_level=confidence, seed=1)  # SALib ignores 0
    columns = {
        "first": indices["S1"],
        "first_error": indices["S1_conf"],
        "total": indices["ST"],
        "total_error": indices["ST_conf"],
    }
    return pandas.DataFrame(columns, pandas.Index(names, name="factor"))


def _is_saltelli(rows: NDArray[Any]) -> bool:
    """Return whether the values of the factors, ``(rows, factors)``, are a Saltelli design."""
    count = rows.shape[1]
    if not count or len(rows) % (2 * count + 2):
        return False
    blocks = rows.reshape(-1, 2 * count + 2, count)
    return bool((blocks == saltelli_blocks(blocks[:, :1], blocks[:, -1:])).all())
