"""Draws the returns of contenders and the effects of factors."""

from collections.abc import Mapping, Sequence
from math import ceil
from typing import TYPE_CHECKING, Any

import numpy as np

from ..data.plots import ABSENT, COLOURS, INK, PALE, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure
    from pandas import DataFrame

LINES = 200
"""The largest number of seeds that are drawn as lines."""


def plot_contenders(
    values: "DataFrame",
    summary: "DataFrame",
    metric: str,
    baseline: str | None,
    marks: Mapping[str, str],
    figure: "Figure | SubFigure | None",
) -> "Figure | SubFigure":
    """Draw each seed as a line across the contenders, the columns of ``values``.

    With a baseline, also draw the difference on each seed. ``marks`` stand below the names.
    """
    names = list(values.columns)
    number = len(values)
    others = [] if baseline is None else [name for name in names if name != baseline]
    sizes = [len(names), len(others)] if others else [len(names)]
    with style("plot") as new_figure:
        if figure is None:
            figure = new_figure(min(sum(1.1 * size + 1.2 for size in sizes) + 1.0, 14.0), 4.2)
        grid = figure.subplots(1, len(sizes), squeeze=False, width_ratios=sizes)
        left, *right = grid[0]
        for row in values.to_numpy()[:LINES]:
            left.plot(
                row,
                color=PALE,
                linewidth=0.7,
                alpha=0.7,
                zorder=1,
            )
        _draw_dots(left, values, names, summary[["mean", "low", "high"]], 0.0)
        _label_below(left, [name + marks.get(name, "") for name in names])
        left.set_ylabel(f"{metric} of the team" if metric in ("return", "length") else metric)
        if number == 1:
            title = "1 seed"
        elif len(names) == 1:
            title = f"{number} seeds, each a dot"
        elif number <= LINES:
            title = f"{number} seeds, each a line"
        else:
            title = f"{number} seeds, lines for {LINES} of them"
        left.set_title(title)
        for axes in right:
            axes.axhline(0.0, color=INK, linewidth=0.8, zorder=1)
            differences = values.sub(values[baseline], axis=0)[others]
            bounds = summary.loc[others, ["difference", "difference_low", "difference_high"]]
            _draw_dots(axes, differences, names, bounds, 0.24)
            _label_below(axes, others)
            axes.set_ylabel(f"difference from {baseline}, same seed")
            axes.set_title("differences")
    return figure


def plot_factors(
    main: "DataFrame",
    interactions: "DataFrame",
    cells: "Mapping[tuple[str, str], DataFrame]",
    levels: Mapping[str, list[Any]],
    metric: str,
    figure: "Figure | SubFigure | None",
) -> "Figure | SubFigure":
    """Draw the main effects of all factors and, below them, the strongest interactions."""
    pairs = [pair for pair, strength in interactions["strength"].items() if strength > 0][:4]
    columns = min(max(len(levels), len(pairs)), 5)  # more would be too small to read
    above = ceil(len(levels) / columns)
    with style("plot") as new_figure:
        if figure is None:
            figure = new_figure(max(3.2, 2.3 * columns), 2.8 * (above + bool(pairs)))
        grid = figure.subplots(above + bool(pairs), columns, squeeze=False)
        upper = grid[:above].ravel()
        for axes, factor in zip(upper, levels, strict=False):
            means = main.loc[factor]
            _draw_means(
                axes,
                range(len(means)),
                means,
                fmt="o-",
                color=COLOURS[0],
            )
            _label_levels(axes, levels[factor], factor)
            if axes is not upper[0]:
                axes.sharey(upper[0])
        for axes in grid[:above, 0]:
            axes.set_ylabel(f"{metric}, mean")
        for axes, (one, other) in zip(grid[-1], pairs, strict=False):
            for place, level in enumerate(levels[other]):
                axes.plot(
                    cells[one, other].iloc[:, place].to_numpy(),
                    "o-",
                    color=COLOURS[place % len(COLOURS)],
                    markersize=4,
                    label=_short_text(level),
                )
            _label_levels(axes, levels[one], one)
            axes.legend(
                title=other,
                fontsize=7,
                title_fontsize=8,
                frameon=True,
                edgecolor="none",
            )
        for axes in grid.flat:
            axes.set_visible(axes.has_data())
    return figure


def _draw_dots(
    axes: "Axes",
    values: "DataFrame",
    names: list[str],
    means: "DataFrame",
    spread: float,
) -> None:
    """Draw a column of dots for each contender, one for each seed, and ``means`` with intervals.

    The dots are at most ``spread`` from the middle of their column. A contender's place in
    ``names`` determines its colour.
    """
    # Even distances in an irregular order.
    offsets = spread * (2 * (np.arange(len(values)) * 0.618034 % 1) - 1)
    for place, name in enumerate(values.columns):
        colour = COLOURS[names.index(name) % len(COLOURS)]
        axes.scatter(
            place + offsets,
            values[name],
            14,
            color=colour,
            alpha=0.5,
            linewidths=0,
        )
        _draw_means(
            axes,
            [place],
            means.loc[[name]],
            fmt="o",
            color=INK,
            elinewidth=2,
        )
        mean = means.loc[name].iloc[0]
        axes.annotate(
            f"{mean:.4g}",
            (place, mean),
            (8, 0),
            textcoords="offset points",
            va="center",
            fontsize=8.5,
        )
    axes.set_xlim(-0.5, len(values.columns) - 0.5)


def _draw_means(
    axes: "Axes",
    places: Sequence[int],
    means: "DataFrame",
    **format_options: Any,
) -> None:
    """Draw means with their intervals, from the first three columns: mean, low and high."""
    mean, low, high = means.to_numpy(float)[:, :3].T
    bars = np.maximum([mean - low, high - mean], 0.0)  # unknown bounds are nan, and not drawn
    axes.errorbar(
        places,
        mean,
        yerr=bars,
        markersize=4,
        **format_options,
    )


def _label_below(axes: "Axes", names: Sequence[str]) -> None:
    """Write names below the axes, slanted if they would overlap, and draw a grid."""
    axes.grid(axis="y", color=ABSENT, linewidth=0.7)
    axes.set_axisbelow(True)
    axes.set_xticks(range(len(names)), names)
    inches = axes.get_window_extent().width / axes.figure.dpi
    if sum(len(name) + 2 for name in names) * 0.075 > inches:  # the average width of a letter
        for label in axes.get_xticklabels():
            label.set(rotation=30, ha="right", rotation_mode="anchor")


def _label_levels(axes: "Axes", levels: list[Any], factor: str) -> None:
    axes.set_xlim(-0.4, len(levels) - 0.6)
    axes.set_xlabel(factor)
    _label_below(axes, [_short_text(level) for level in levels])


def _short_text(level: Any) -> str:
    if hasattr(level, "left"):  # an interval
        return f"{level.left:.3g} to {level.right:.3g}"
    return f"{level:.4g}" if isinstance(level, float) else str(level)
