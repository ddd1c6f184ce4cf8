"""Draws dots, means and labels: the parts of the plots of evaluations and effects."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from ..data.plots import COLOURS, INK, PALE, scatter

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from pandas import DataFrame


LOOKS: Final[dict[str, dict[str, Any]]] = {
    "seed": {"color": PALE, "linewidth": 0.7, "alpha": 0.7, "zorder": 1},
    "zero": {"color": INK, "linewidth": 0.8, "zorder": 1},
    "dots": {"s": 14, "alpha": 0.5, "linewidths": 0},
    "mean": {"fmt": "o", "color": INK, "elinewidth": 2},
    "effect": {"fmt": "o-", "color": COLOURS[0]},
    "number": {"textcoords": "offset points", "va": "center", "fontsize": 8.5},
    "slanted": {"rotation": 30, "ha": "right", "rotation_mode": "anchor"},
    "levels": {"fontsize": 7, "title_fontsize": 8, "frameon": True, "edgecolor": "none"},
}
"""The options of the parts of the plots of evaluations and effects."""


def draw_dots(
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
    offsets = spread * scatter(len(values))
    for place, name in enumerate(values.columns):
        colour = COLOURS[names.index(name) % len(COLOURS)]
        axes.scatter(place + offsets, values[name], color=colour, **LOOKS["dots"])
        draw_means(axes, [place], means.loc[[name]], LOOKS["mean"])
        mean = means.loc[name].iloc[0]
        axes.annotate(f"{mean:.4g}", (place, mean), (8, 0), **LOOKS["number"])
    axes.set_xlim(-0.5, len(values.columns) - 0.5)


def draw_means(
    axes: "Axes",
    places: Sequence[int],
    means: "DataFrame",
    look: dict[str, Any],
) -> None:
    """Draw means with their intervals, from the first three columns: mean, low and high."""
    mean, low, high = means.to_numpy(float)[:, :3].T
    bars = np.maximum([mean - low, high - mean], 0.0)  # unknown bounds are nan, and not drawn
    axes.errorbar(places, mean, yerr=bars, **look)


def label_below(axes: "Axes", names: Sequence[str]) -> None:
    """Write names below the axes, slanted if they would overlap, and draw a grid."""
    axes.grid(axis="y")
    axes.set_xticks(range(len(names)), names)
    inches = axes.get_window_extent().width / axes.figure.dpi
    if sum(len(name) + 2 for name in names) * 0.075 > inches:  # the average width of a letter
        for label in axes.get_xticklabels():
            label.set(**LOOKS["slanted"])


def label_levels(axes: "Axes", levels: list[Any], factor: str) -> None:
    """Write the levels of a factor below the axes."""
    axes.set_xlim(-0.4, len(levels) - 0.6)
    axes.set_xlabel(factor)
    label_below(axes, [short_text(level) for level in levels])


def short_text(level: Any) -> str:
    """Return a short text for a level."""
    if hasattr(level, "left"):  # an interval
        return f"{level.left:.3g} to {level.right:.3g}"
    return f"{level:.4g}" if isinstance(level, float) else str(level)
