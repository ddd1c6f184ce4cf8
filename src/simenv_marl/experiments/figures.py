"""Plots of the results of experiments."""

from __future__ import annotations

from math import ceil
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from ..data.plots import ABSENT, COLOURS, INK, PALE, style

if TYPE_CHECKING:
    from pandas import DataFrame

LINES: Final = 200
"""The largest number of seeds that are drawn as lines."""

WIDEST: Final = 14.0
"""The largest width of a figure, in inches."""

LETTER: Final = 0.075
"""The average width of a letter, in inches."""

PAIRS: Final = 4
"""The largest number of interactions that are drawn."""

ABREAST: Final = 5
"""The largest number of factors side by side."""


def _label_below(axes: Any, names: list[str]) -> None:
    """Write names below the axes, slanted if they would overlap, and draw a grid."""
    axes.tick_params(labelsize=8, colors=INK, color=PALE)
    axes.grid(axis="y", color=ABSENT, linewidth=0.7)
    axes.set_axisbelow(True)
    axes.set_xticks(range(len(names)), names)
    inches = axes.get_subplotspec().get_position(axes.figure).width * axes.figure.bbox.width / axes.figure.dpi
    if sum(len(name) + 2 for name in names) * LETTER > inches:
        for label in axes.get_xticklabels():
            label.set(rotation=30, ha="right", rotation_mode="anchor")


def draw_evaluation(values: DataFrame, summary: DataFrame, baseline: str | None, metric: str, figure: Any) -> Any:
    """Draw the values of contenders seed by seed and, with a baseline, their differences from it."""
    names = list(values.columns)
    others = [name for name in names if name != baseline]
    panels = 2 if baseline is not None and others else 1
    with style("plot") as new_figure:
        if figure is None:
            width = 2.2 + 1.1 * len(names) + (1.2 + 1.1 * len(others)) * (panels - 1)
            figure = new_figure(min(width, WIDEST), 4.2)
        ratios = [len(names), len(others)][:panels]
        axes = figure.subplots(1, panels, squeeze=False, width_ratios=ratios)[0]
        for row in values.to_numpy()[:LINES]:
            axes[0].plot(range(len(names)), row, color=PALE, linewidth=0.7, alpha=0.7, zorder=1)
        _draw_dots(axes[0], values, names, summary[["mean", "low", "high"]], 0.0)
        axes[0].set_ylabel(f"{metric} of the team" if metric in ("return", "length") else metric)
        each = "each a line" if len(values) <= LINES else f"lines for {LINES} of them"
        each = "each a dot" if len(names) == 1 else each
        axes[0].set_title(f"{len(values)} seeds, {each}" if len(values) > 1 else "1 seed")
        if panels == 2:
            axes[1].axhline(0.0, color=INK, linewidth=0.8, zorder=1)
            differences = values.sub(values[baseline], axis=0)[others]
            marks = summary.loc[others, ["difference", "difference_low", "difference_high"]]
            _draw_dots(axes[1], differences, names, marks, 0.24)
            axes[1].set_ylabel(f"difference from {baseline}, same seed")
            axes[1].set_title("differences")
    return figure


def _draw_dots(axes: Any, values: DataFrame, names: list[str], marks: DataFrame, spread: float) -> None:
    """Draw a column of dots for each contender, one for each seed, and the mean with its interval from ``marks``.

    The dots are at most ``spread`` from the middle of their column. All ``names`` together determine the colours.
    """
    for place, name in enumerate(values.columns):
        across = place + spread * (2 * (np.arange(len(values)) * 0.618034 % 1) - 1)  # even, in irregular order
        colour = COLOURS[names.index(name) % len(COLOURS)]
        axes.scatter(across, values[name], 14, color=colour, alpha=0.5, linewidths=0, zorder=2)
        mean, low, high = marks.loc[name]
        bars = None if np.isnan(low) else [[max(0.0, mean - low)], [max(0.0, high - mean)]]
        axes.errorbar([place], [mean], yerr=bars, fmt="o", color=INK, markersize=5, elinewidth=2, zorder=5)
        axes.annotate(f"{mean:.4g}", (place, mean), (8, 0), textcoords="offset points", va="center", fontsize=8.5)
    axes.set_xlim(-0.5, len(values.columns) - 0.5)
    _label_below(axes, list(values.columns))


def draw_effects(effects: Any, figure: Any) -> Any:
    """Draw main effects in rows and, below them, the strongest interactions."""
    factors = list(effects.levels)
    pairs = [pair for pair, strength in effects.interactions["strength"].items() if strength > 0][:PAIRS]
    columns = min(max(len(factors), len(pairs)), ABREAST)
    above = ceil(len(factors) / columns)
    with style("plot") as new_figure:
        if figure is None:
            figure = new_figure(max(3.2, 2.3 * columns), 2.8 * (above + bool(pairs)))
        rows = figure.subplots(above + bool(pairs), columns, squeeze=False)
        main = rows[:above].ravel()
        for axes, factor in zip(main, factors, strict=False):
            if axes is not main[0]:
                axes.sharey(main[0])
            own = effects.main.loc[factor]
            bars = [(own["mean"] - own["low"]).clip(lower=0), (own["high"] - own["mean"]).clip(lower=0)]
            axes.errorbar(
                range(len(own)), own["mean"], yerr=bars, fmt="o-", color=COLOURS[0], linewidth=1, markersize=4
            )
            _label_levels(axes, effects.levels[factor], factor)
        for axes in rows[:above, 0]:
            axes.set_ylabel(f"{effects.metric}, mean")
        for axes, (one, other) in zip(rows[-1], pairs, strict=False):
            table = effects.cells(one, other)
            for place, level in enumerate(effects.levels[other]):
                colour = COLOURS[place % len(COLOURS)]
                axes.plot(
                    range(len(table)), table.iloc[:, place], "o-", color=colour, markersize=4, label=_short(level)
                )
            _label_levels(axes, effects.levels[one], one)
            axes.legend(title=other, fontsize=7, title_fontsize=8, frameon=True, framealpha=0.8, edgecolor="none")
        for axes in [*main[len(factors) :], *(rows[-1][len(pairs) :] if pairs else ())]:
            axes.set_visible(False)
    return figure


def _label_levels(axes: Any, levels: list[Any], factor: str) -> None:
    axes.set_xlim(-0.4, len(levels) - 0.6)
    axes.set_xlabel(factor)
    _label_below(axes, [_short(level) for level in levels])


def _short(level: Any) -> str:
    if hasattr(level, "left"):
        return f"{level.left:.3g} to {level.right:.3g}"
    return f"{level:.4g}" if isinstance(level, float) else str(level)
