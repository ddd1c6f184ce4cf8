"""Figures and a table of the results of ``train`` and ``results``.

``python -m studies.wolf_sheep.picture`` draws ``docs/figures/shared-policy-training.png`` (the
learning curves) and ``docs/figures/shared-policy.png`` (the evaluation of the policies), and prints
the table. It runs no simulation.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes

from ..report import new_figure

FIGURES: Final = Path(__file__).parents[2] / "docs" / "figures"

STYLES: Final[dict[str, dict[str, Any]]] = {
    "the model's rule": {"color": "#4d4d4d", "linestyle": "-"},
    "random moves": {"color": "#9a9a9a", "linestyle": "--"},
    "untrained": {"color": "#c58fc0", "linestyle": ":"},
    "by hand, two steps of sight": {"color": "#d1812c", "linestyle": "-."},
    "trained, one step of sight": {"color": "#6aa5cf", "linestyle": "-"},
    "trained, two steps of sight": {"color": "#1b6f5f", "linestyle": "-"},
}
"""The line style of each policy: grey for rule and random moves, green and blue for trained."""

LEARNERS: Final = {1: "trained, one step of sight", 2: "trained, two steps of sight"}


# -- learning curves ------------------------------------------------------------------------------


def draw_training(
    course: Sequence[Mapping[str, str]], results: Mapping[str, Any], path: Path
) -> None:
    """Draw the learning curves.

    Args:
        course: The rows that ``train`` has written.
        results: The results that ``results`` has written, for the line of the rule.
        path: The file to write.
    """
    figure = new_figure(10, 3.8)
    left, right = figure.subplots(1, 2)
    for axes, what, title in (
        (left, "sheep", "Sheep on the meadow, on average over 100 ticks"),
        (right, "survived", "Share of the episodes with sheep after 100 ticks"),
    ):
        for sight, name in LEARNERS.items():
            _draw_course(axes, [row for row in course if int(row["sight"]) == sight], what, name)
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("decisions used for training, in thousands")
        axes.set_ylim(bottom=0)
        axes.margins(x=0)
        axes.spines[["top", "right"]].set_visible(False)
    rule = "the model's rule"
    left.axhline(
        results["results"][rule]["sheep while training"], label=rule, linewidth=1.5, **STYLES[rule]
    )
    left.legend(frameon=False, fontsize=9, loc="upper left", bbox_to_anchor=(0.0, 0.95))
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)


def _draw_course(axes: Axes, course: Sequence[Mapping[str, str]], what: str, name: str) -> None:
    """Draw one line per training run."""
    label: str | None = name
    for seed in sorted({row["seed"] for row in course}, key=int):
        own = [row for row in course if row["seed"] == seed]
        decisions = [int(row["decisions"]) / 1000 for row in own]
        axes.plot(
            decisions,
            [float(row[what]) for row in own],
            label=label,
            linewidth=1.4,
            alpha=0.85,
            **STYLES[name],
        )
        label = None


# -- evaluation -----------------------------------------------------------------------------------


def draw_results(results: Mapping[str, Any], path: Path) -> None:
    """Draw the numbers of sheep and wolves, and the lengths of sheep's lives, by policy."""
    figure = new_figure(11, 6.4)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.7, 1))
    sheep = figure.add_subplot(grid[0, 0])
    wolves = figure.add_subplot(grid[1, 0], sharex=sheep)
    lives = figure.add_subplot(grid[:, 1])
    for name, own in results["results"].items():
        style = STYLES[name]
        for axes, kind in ((sheep, "sheep"), (wolves, "wolves")):
            low, middle, high = (own["numbers"][kind][part] for part in ("25", "50", "75"))
            ticks = range(len(middle))
            axes.fill_between(ticks, low, high, color=style["color"], alpha=0.18, linewidth=0)
            axes.plot(ticks, middle, linewidth=1.8, **style)
        shares = np.array([np.nan if share is None else share for share in own["lives"]])
        lives.plot(shares, label=name, linewidth=1.8, **style)
    meadows = results["meadows"]
    sheep.set_title(f"Sheep: median and middle half of {meadows} meadows", fontsize=10)
    wolves.set_title("Wolves, which follow the model's rule throughout", fontsize=10)
    wolves.set_xlabel("tick")
    lives.set_title("Share of sheep that live at least that long", fontsize=10)
    lives.set_xlabel("turns")
    lives.legend(frameon=False, fontsize=9, loc="upper right")
    for axes in (sheep, wolves, lives):
        axes.set_ylim(bottom=0)
        axes.margins(x=0)
        axes.spines[["top", "right"]].set_visible(False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)


def table(results: Mapping[str, Any]) -> str:
    """Make the table, in Markdown."""
    lines = [
        (
            "| policy of the sheep | meadows with sheep at the end | sheep at the end | turns per"
            " death | starved |"
        ),
        "| --- | --- | --- | --- | --- |",
    ]
    for name, own in results["results"].items():
        shares = own["survived"]
        survived = f"{np.mean(shares):.0%}"
        if len(shares) > 1:
            survived += f" ({min(shares):.0%} to {max(shares):.0%} of {len(shares)})"
        low, middle, high = own["sheep at the end"]
        lines.append(
            f"| {name} | {survived} | {middle:.0f} ({low:.0f} to {high:.0f}) |"
            f" {own['turns per death']:.1f} | {own['starved']:.0%} |"
        )
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw both figures, and print the table."""
    parser = argparse.ArgumentParser(description="Draw the results of the sheep's policies.")
    parser.add_argument(
        "--figures",
        type=Path,
        default=FIGURES,
        help="folder with the results (default: %(default)s)",
    )
    folder = parser.parse_args(arguments).figures
    results = json.loads((folder / "shared-policy.json").read_text())
    with (folder / "shared-policy-training.csv").open(newline="") as file:
        course = list(csv.DictReader(file))
    draw_training(course, results, folder / "shared-policy-training.png")
    draw_results(results, folder / "shared-policy.png")
    print(table(results))


if __name__ == "__main__":
    main()
