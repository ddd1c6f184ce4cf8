"""Draws what contenders earn and what factors change."""

from collections.abc import Mapping
from math import ceil
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from ..data.plots import ABSENT, COLOURS, INK, PALE, style

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure
    from pandas import DataFrame

LINES: Final = 200
"""The largest number of seeds that are drawn as lines."""


def plot_contenders(
    values: "DataFrame",
    summary: "DataFrame",
    metric: str,
    baseline: str | None,
    marks: list[str],
    figure: "Figure | SubFigure | None",
) -> "Figure | SubFigure":
    """Draw each seed as a line across the contenders, the columns of ``values``, with ``marks`` below their names.

    With a baseline, also draw the difference on each seed.
    """
    names = list(values.columns)
    others = [] if baseline is None else [name for name in names if name != baseline]
    sizes = [len(names), len(others)] if others else [len(names)]
    with style("plot") as new_figure:
        if figure is None:
            figure = new_figure(min(sum(1.1 * size + 1.2 for size in sizes) + 1.0, 14.0), 4.2)
        axes = figure.subplots(1, len(sizes), squeeze=False, width_ratios=sizes)[0]
        for row in values.to_numpy()[:LINES]:
            axes[0].plot(range(len(names)), row, color=PALE, linewidth=0.7, alpha=0.7, zorder=1)
        _draw_dots(axes[0], values, names, summary[["mean", "low", "high"]], 0.0)
        _label_below(axes[0], [name + mark for name, mark in zip(names, marks, strict=True)])
        axes[0].set_ylabel(f"{metric} of the team" if metric in ("return", "length") else metric)
        each = "each a line" if len(values) <= LINES else f"lines for {LINES} of them"
        each = "each a dot" if len(names) == 1 else each
        axes[0].set_title(f"{len(values)} seeds, {each}" if len(values) > 1 else "1 seed")
        if others:
            axes[1].axhline(0.0, color=INK, linewidth=0.8, zorder=1)
            differences = values.sub(values[baseline], axis=0)[others]
            bounds = summary.loc[others, ["difference", "difference_low", "difference_high"]]
            _draw_dots(axes[1], differences, names, bounds, 0.24)
            _label_below(axes[1], others)
            axes[1].set_ylabel(f"difference from {baseline}, same seed")
            axes[1].set_title("differences")
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
        rows = figure.subplots(above + bool(pairs), columns, squeeze=False)
        upper = rows[:above].ravel()
        for axes, factor in zip(upper, levels, strict=False):
            if axes is not upper[0]:
                axes.sharey(upper[0])
            own = main.loc[factor]
            bars = [
                (own["mean"] - own["low"]).clip(lower=0),
                (own["high"] - own["mean"]).clip(lower=0),
            ]
            axes.errorbar(
                range(len(own)),
                own["mean"],
                yerr=bars,
                fmt="o-",
                color=COLOURS[0],
                linewidth=1,
                markersize=4,
            )
            _label_levels(axes, levels[factor], factor)
        for axes in rows[:above, 0]:
            axes.set_ylabel(f"{metric}, mean")
        for axes, (one, other) in zip(rows[-1], pairs, strict=False):
            table = cells[one, other]
            for place, level in enumerate(levels[other]):
                colour = COLOURS[place % len(COLOURS)]
                axes.plot(
                    range(len(table)),
                    table.iloc[:, place],
                    "o-",
                    color=colour,
                    markersize=4,
                    label=_short(level),
                )
            _label_levels(axes, levels[one], one)
            axes.legend(
                title=other,
                fontsize=7,
                title_fontsize=8,
                frameon=True,
                framealpha=0.8,
                edgecolor="none",
            )
        for axes in [*upper[len(levels) :], *(rows[-1][len(pairs) :] if pairs else ())]:
            axes.set_visible(False)
    return figure


def _draw_dots(
    axes: Any, values: "DataFrame", names: list[str], marks: "DataFrame", spread: float
) -> None:
    """Draw a column of dots for each contender, one for each seed, and the mean with its interval from ``marks``.

    The dots are at most ``spread`` from the middle of their column. All ``names`` together
    determine the colours.
    """
    for place, name in enumerate(values.columns):
        # even, in irregular order
        across = place + spread * (2 * (np.arange(len(values)) * 0.618034 % 1) - 1)
        colour = COLOURS[names.index(name) % len(COLOURS)]
        axes.scatter(across, values[name], 14, color=colour, alpha=0.5, linewidths=0, zorder=2)
        mean, low, high = marks.loc[name]
        bars = None if np.isnan(low) else [[max(0.0, mean - low)], [max(0.0, high - mean)]]
        axes.errorbar(
            [place], [mean], yerr=bars, fmt="o", color=INK, markersize=5, elinewidth=2, zorder=5
        )
        axes.annotate(
            f"{mean:.4g}",
            (place, mean),
            (8, 0),
            textcoords="offset points",
            va="center",
            fontsize=8.5,
        )
    axes.set_xlim(-0.5, len(values.columns) - 0.5)


def _label_below(axes: Any, names: list[str]) -> None:
    """Write names below the axes, slanted if they would overlap, and draw a grid."""
    axes.grid(axis="y", color=ABSENT, linewidth=0.7)
    axes.set_axisbelow(True)
    axes.set_xticks(range(len(names)), names)
    inches = (
        axes.get_subplotspec().get_position(axes.figure).width
        * axes.figure.bbox.width
        / axes.figure.dpi
    )
    if sum(len(name) + 2 for name in names) * 0.075 > inches:  # the average width of a letter
        for label in axes.get_xticklabels():
            label.set(rotation=30, ha="right", rotation_mode="anchor")


def _label_levels(axes: Any, levels: list[Any], factor: str) -> None:
    axes.set_xlim(-0.4, len(levels) - 0.6)
    axes.set_xlabel(factor)
    _label_below(axes, [_short(level) for level in levels])


def _short(level: Any) -> str:
    if hasattr(level, "left"):
        return f"{level.left:.3g} to {level.right:.3g}"
    return f"{level:.4g}" if isinstance(level, float) else str(level)
