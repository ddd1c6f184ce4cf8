"""Pictures of the results of ``make demo`` and ``make plan``: returns and daily developments.

``python -m studies.demo.picture FILE`` draws the results that ``examples.greenhouse_coop.train`` or
``examples.greenhouse_coop.plan`` has written to a file, as a picture beside it.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

COLOURS: Final = ("#8c8c8c", "#c9c9c9", "#e3b778", "#d1812c", "#7fb3d3", "#1b6f5f")
"""In the order of the table: grey without a search, orange for constants, then learned policies."""

INK: Final = "#333333"

TITLES: Final = {
    "greenhouse": (
        "Two agents learn to keep a greenhouse: one decides the water, the other the ventilation"
    ),
    "plan": "Plans keep a greenhouse: the waterer tries out amounts of water before it pours",
}
"""The title of each picture, by the name of its file."""


def draw(
    returns: Mapping[str, Sequence[float]],
    alive: Mapping[str, NDArray[Any]],
    poured: Mapping[str, NDArray[Any]],
    path: Path,
    *,
    title: str,
    notes: Mapping[str, str] | None = None,
    curves: Mapping[str, Sequence[NDArray[np.float64]]] | None = None,
) -> None:
    """Draw the picture.

    Args:
        returns: By the title of each team, its return for each seed.
        alive: Likewise, the plants alive by seed and day.
        poured: Likewise, the litres poured by seed and day.
        path: The file to write.
        title: The title of the picture.
        notes: By the title of a team, what to write beside its return.
        curves: By the title of each team that was trained, the mean return of each candidate of
            each generation.
    """
    colours = dict(zip(returns, (COLOURS[0], *COLOURS[1 - len(returns) :]), strict=True))
    figure = Figure(figsize=(12, 6.6), layout=ConstrainedLayoutEngine(h_pad=0.1, w_pad=0.1))
    FigureCanvasAgg(figure)  # no window, no state of pyplot
    figure.suptitle(title, x=0.01, ha="left", fontsize=14, fontweight="bold", color=INK)
    grid = figure.add_gridspec(2, 2, width_ratios=(1, 1.05), height_ratios=(1.4, 1))
    _draw_returns(
        figure.add_subplot(grid[0 if curves else slice(None), 0]), returns, colours, notes or {}
    )
    if curves:
        _draw_learning(figure.add_subplot(grid[1, 0]), curves, colours)
    _draw_alive(days := figure.add_subplot(grid[0, 1]), alive, colours)
    _draw_poured(figure.add_subplot(grid[1, 1], sharex=days), poured, colours)
    figure.savefig(path, dpi=150)


def _draw_returns(
    axes: Axes,
    returns: Mapping[str, Sequence[float]],
    colours: Mapping[str, str],
    notes: Mapping[str, str],
) -> None:
    jitter = np.random.default_rng(0)
    for row, (title, values) in enumerate(returns.items()):
        mean, spread = float(np.mean(values)), float(np.std(values))
        axes.barh(row, mean, height=0.62, color=colours[title], xerr=spread, ecolor=INK, capsize=3)
        axes.scatter(
            values,
            row + jitter.uniform(-0.2, 0.2, len(values)),
            s=7,
            color=INK,
            alpha=0.35,
            linewidths=0,
        )
        text = axes.annotate(
            f"{mean:.1f}",
            (max(*values, mean + spread), row),
            (6, 0),
            textcoords="offset points",
            va="center",
            color=INK,
        )
        if title in notes:
            axes.annotate(
                fill(notes[title], 40),
                (1, 0.5),
                (8, 0),
                xycoords=text,
                textcoords="offset points",
                va="center",
                color=INK,
                fontsize=8.5,
                style="italic",
            )
    axes.set_yticks(range(len(returns)), list(returns))
    axes.invert_yaxis()
    axes.set_xlim(min(0.0, axes.get_xlim()[0]), 107)
    axes.axvline(0, color=INK, linewidth=0.8)
    axes.set_title(
        "Return of the team in greenhouses that it was not trained on", loc="left", fontsize=11
    )
    axes.set_xlabel(
        "share of plants alive minus litres poured / 1000, summed over 100 days", fontsize=9
    )
    _tidy(axes, "x")


def _draw_learning(
    axes: Axes, curves: Mapping[str, Sequence[NDArray[np.float64]]], colours: Mapping[str, str]
) -> None:
    for title, generations in curves.items():
        numbers = range(1, len(generations) + 1)
        mean, best = np.mean(generations, axis=1), np.max(generations, axis=1)
        axes.plot(numbers, mean, color=colours[title], linewidth=1.8, label=title)
        axes.plot(numbers, best, color=colours[title], linewidth=0, marker="o", markersize=3)
    axes.set_title("Learning (mean return of a generation, and its best)", loc="left", fontsize=11)
    axes.set_xlabel("generation, each judged in new greenhouses", fontsize=9)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.legend(fontsize=8.5, frameon=False, loc="lower right")
    _tidy(axes, "y")


def _draw_alive(axes: Axes, alive: Mapping[str, NDArray[Any]], colours: Mapping[str, str]) -> None:
    for title, counts in alive.items():
        low, high = np.quantile(counts, (0.1, 0.9), axis=0)
        days = np.arange(counts.shape[1])
        axes.fill_between(days, low, high, color=colours[title], alpha=0.13, linewidth=0)
        axes.plot(days, counts.mean(axis=0), color=colours[title], linewidth=1.8, label=title)
    axes.set_ylim(0, None)
    axes.set_title("Plants alive (mean, and 80 % of the greenhouses)", loc="left", fontsize=11)
    axes.tick_params(labelbottom=False)
    axes.legend(fontsize=8.5, frameon=False, loc="lower right", ncols=2)
    _tidy(axes, "y")


def _draw_poured(
    axes: Axes, poured: Mapping[str, NDArray[Any]], colours: Mapping[str, str]
) -> None:
    for title, litres in poured.items():
        axes.plot(
            np.arange(litres.shape[1]), litres.mean(axis=0), color=colours[title], linewidth=1.6
        )
    axes.set_yscale(
        "function", functions=(lambda litres: np.sqrt(np.maximum(litres, 0)), np.square)
    )
    # random actions pour 500 on the first days, the others below 100
    axes.set_yticks([0, 25, 50, 100, 200, 400, 600])
    axes.set_ylim(0, None)
    axes.set_title("Litres poured on each day (mean; square-root scale)", loc="left", fontsize=11)
    axes.set_xlabel("day", fontsize=9)
    _tidy(axes, "y")


def _tidy(axes: Axes, along: Any) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis=along, color="#e6e6e6", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=9, colors=INK)


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw the picture of a file of results."""
    parser = argparse.ArgumentParser(description="Draw the results of make demo or make plan.")
    parser.add_argument("file", type=Path, help="the results: greenhouse.json or plan.json")
    results = parser.parse_args(arguments).file
    told = json.loads(results.read_text(encoding="utf-8"))
    for name in ("alive", "poured"):
        told[name] = {title: np.array(values) for title, values in told[name].items()}
    picture = results.with_suffix(".png")
    draw(path=picture, title=TITLES[results.stem], **told)
    print(f"Picture: {picture}")


if __name__ == "__main__":
    main()
