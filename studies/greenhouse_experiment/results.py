"""Learning curves and a table of all runs.

``python -m studies.greenhouse_experiment.results --runs FOLDER`` collects the results of all runs
in a folder into two CSV files under version control, ``data/curves.csv`` and ``data/finals.csv``,
and draws them. Without ``--runs`` it draws the data of these files, without any training.

Curves and table show the median and the quartiles over seeds.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import pandas as pd
from examples.greenhouse_coop.env import DAYS
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..report import new_figure
from .questions import QUESTIONS

DATA: Final = Path(__file__).parent / "data"
FIGURES: Final = Path(__file__).parents[2] / "docs" / "figures"

LIBRARIES: Final = {
    "baselines": "",
    "sb3": "SB3: PPO",
    "torchrl": "TorchRL: PPO",
    "rllib": "RLlib: PPO",
}
NAMES: Final = {
    ("torchrl", "4a"): "TorchRL: IPPO",
    ("torchrl", "4b"): "TorchRL: MAPPO",
    ("rllib", "4a"): "RLlib: IPPO",
}
"""The names of a library's PPO in these cases."""

MEASURED: Final = ("value", "alive", "litres")

INK: Final = "#333333"
LINES: Final = {
    "constant pair": ("best constant pair", "#d1812c"),
    "constant watering": ("best constant watering", "#e3b778"),
    "rule": ("rule", "#8c8c8c"),
}
"""The baselines in the figure of the learning curves."""

PANELS: Final = (
    (
        "Which decision is learned (SB3)",
        {
            ("sb3", "3"): "#1b6f5f",
            ("sb3", "5a"): "#56b4a0",
            ("sb3", "5c"): "#b0413e",
            ("sb3", "5b"): "#e08a87",
            ("sb3", "1"): "#2f6da8",
            ("sb3", "2"): "#9a9a9a",
        },
    ),
    (
        "Both decisions: one agent or two",
        {
            ("sb3", "3"): "#1b6f5f",
            ("torchrl", "4a"): "#2f6da8",
            ("torchrl", "4b"): "#b0413e",
            ("rllib", "4a"): "#d39b1f",
        },
    ),
)


# -- collecting -----------------------------------------------------------------------------------


def gather(runs: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Read the results that scripts have written.

    Args:
        runs: The folder of all runs.

    Returns:
        The learning curves, one row per point, and the final results, one row per run.
    """
    found = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(runs.glob("*.json"))]
    learnt = [run for run in found if run["library"] != "baselines"]
    searches = [run for run in found if "teams" in run]
    if not learnt:
        raise SystemExit(f"there are no runs in {runs}")
    curves: list[dict[str, Any]] = [
        {"library": "baselines", "question": title, "seed": 0, "days": 0, **verdict}
        for run in found
        for title, verdict in run.get("beside_curves", {}).items()
    ]
    finals = _baselines(searches)
    for run in learnt:
        key = {name: run[name] for name in ("library", "question", "seed")}
        curves += [{**key, **point} for point in run["curve"]]
        finals.append({**key, "days": run["days"], **run["final"]})
    return pd.DataFrame(curves), pd.DataFrame(finals)


def _baselines(searches: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Select rows: CMA-ES for each number of episodes, others from the longest searches alone."""
    most = max((search["episodes"] for search in searches), default=0)
    rows: list[dict[str, Any]] = []
    for search in searches:
        seed, episodes = search["seed"], search["episodes"]
        for team, verdict in search["teams"].items():
            if team.startswith("CMA-ES"):
                row = {
                    "question": f"{team}, {episodes} episodes",
                    "seed": seed,
                    "days": episodes * DAYS,
                }
            elif episodes == most:
                row = {"question": team, "seed": seed, "days": 0}
            else:
                continue
            rows.append({"library": "baselines", **row, **verdict})
    return rows


# -- the table ------------------------------------------------------------------------------------


def name(library: str, question: str) -> str:
    """Return the name of a library's learner."""
    return NAMES.get((library, question), LIBRARIES[library])


def title(library: str, question: str) -> str:
    """Return the title of a question, or the name of a baseline."""
    return question if library == "baselines" else f"({question}) {QUESTIONS[question].title}"


def table(finals: pd.DataFrame) -> str:
    """Make the table of final results, in Markdown: medians and quartiles over seeds."""
    rows = []
    for (library, question), runs in finals.groupby(["library", "question"], sort=False):
        low, median, high = runs.value.quantile([0.25, 0.5, 0.75])
        days = int(runs.days.median())
        rows.append(
            (
                _place(library, question, median),
                (
                    title(library, question),
                    name(library, question),
                    ""
                    if not days
                    else f"at most {days:,}"
                    if library == "baselines"
                    else f"{days:,}",
                    str(len(runs)),
                    f"{median:.1f}",
                    f"{low:.1f} to {high:.1f}",
                    f"{runs.value.min():.1f}",
                    f"{runs.alive.median():.0f}",
                    f"{runs.litres.median():,.0f}",
                ),
            )
        )
    head = (
        "who decides",
        "learner",
        "days",
        "seeds",
        "return",
        "quartiles",
        "worst",
        "alive in the end",
        "litres",
    )
    lines = ["| " + " | ".join(head) + " |", "| --- | --- |" + " ---: |" * (len(head) - 2)]
    lines += ["| " + " | ".join(cells) + " |" for _, cells in sorted(rows)]
    return "\n".join(lines) + "\n"


def _place(library: str, question: str, median: float) -> tuple[bool, str | float, str]:
    """Return a sort key: baselines from the worst to the best, then the questions in order."""
    return (False, median, "") if library == "baselines" else (True, question, library)


# -- drawing --------------------------------------------------------------------------------------


def draw_curves(curves: pd.DataFrame, path: Path) -> None:
    """Draw the learning curves: medians and quartiles over seeds, against simulated days."""
    figure = new_figure(12, 5.4)
    left, right = figure.subplots(1, 2, sharey=True)
    for axes, (heading, colours) in zip((left, right), PANELS, strict=True):
        _draw_lines(axes, curves)
        for (library, question), colour in colours.items():
            runs = curves[(curves.library == library) & (curves.question == question)]
            if runs.empty:
                continue
            low, median, high = (
                runs.groupby("days").value.quantile(share) for share in (0.25, 0.5, 0.75)
            )
            axes.fill_between(median.index, low, high, color=colour, alpha=0.2, linewidth=0)
            label = f"({question}) {QUESTIONS[question].title}"
            if axes is right:
                label += f" - {name(library, question)}"
            axes.plot(median.index, median, color=colour, linewidth=1.8, label=label)
        axes.set_title(heading, loc="left", fontsize=11)
        axes.set_xlabel("simulated days", fontsize=9)
        axes.xaxis.set_major_formatter(lambda days, _: f"{days:,.0f}")
        axes.set_xlim(0, None)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize=8, frameon=False, loc="center right", bbox_to_anchor=(1, 0.36))
        _tidy(axes, "y")
    left.set_ylabel(
        "return of the team on 8 greenhouses: median and quartiles over seeds", fontsize=9
    )
    _save(figure, path)


def _draw_lines(axes: Axes, curves: pd.DataFrame) -> None:
    baselines = curves[curves.library == "baselines"]
    for question, (label, colour) in LINES.items():
        runs = baselines[baselines.question == question]
        if not runs.empty:
            median = runs.value.median()
            axes.axhline(median, color=colour, linewidth=1.1, linestyle=(0, (4, 3)))
            place: Any = ("axes fraction", "data")
            axes.annotate(
                label,
                (1, median),
                (0, 2),
                place,
                textcoords="offset points",
                ha="right",
                fontsize=7.5,
                color=colour,
            )


def draw_finals(finals: pd.DataFrame, path: Path) -> None:
    """Draw the final results: a dot per seed, a line for the median, a bar between quartiles."""
    groups = list(finals.groupby(["library", "question"], sort=False))
    groups.sort(
        key=lambda group: _place(group[0][0], group[0][1], group[1].value.median()), reverse=True
    )
    figure = new_figure(12, 0.8 + 0.34 * len(groups))
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(1, 1.6))
    for axes in (left, right):
        for row, ((library, _), runs) in enumerate(groups):
            colour = "#8c8c8c" if library == "baselines" else "#1b6f5f"
            low, median, high = runs.value.quantile([0.25, 0.5, 0.75])
            axes.barh(row, high - low, left=low, height=0.56, color=colour, alpha=0.3)
            axes.plot([median, median], [row - 0.33, row + 0.33], color=colour, linewidth=2)
            axes.scatter(
                runs.value, [row] * len(runs), s=13, color=INK, alpha=0.6, linewidths=0, zorder=3
            )
        axes.set_xlabel("return of the team", fontsize=9)
        _tidy(axes, "x")
    most = finals.value.max()
    left.set_xlim(min(0.0, finals.value.min()) - 1, most + 3)
    right.set_xlim(0.75 * most, 1.01 * most)
    for row, (_, runs) in enumerate(groups):
        right.annotate(
            f"{runs.value.median():.1f}",
            (1, row),
            (4, 0),
            ("axes fraction", "data"),
            textcoords="offset points",
            va="center",
            color=INK,
        )
    left.set_yticks(
        range(len(groups)), [f"{title(*key)}  {name(*key)}".rstrip() for key, _ in groups]
    )
    left.set_title("Held-out greenhouses", loc="left", fontsize=11)
    right.set_title("The same, above three quarters of the best return", loc="left", fontsize=11)
    _save(figure, path)


def _tidy(axes: Axes, along: Any) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis=along, color="#e6e6e6", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=9, colors=INK)


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path, dpi=130, metadata={"Software": None})
    print(path)


# -- command line ---------------------------------------------------------------------------------


def main(arguments: Sequence[str] | None = None) -> None:
    """Collect the results, print the table, draw the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=Path, help="first collect the runs in this folder")
    parser.add_argument(
        "--data", type=Path, default=DATA, help="folder of the CSV files (default: %(default)s)"
    )
    parser.add_argument(
        "--figures",
        type=Path,
        default=FIGURES,
        help="folder for the figures (default: %(default)s)",
    )
    options = parser.parse_args(arguments)
    files = {kind: options.data / f"{kind}.csv" for kind in ("curves", "finals")}
    if options.runs is not None:
        options.data.mkdir(parents=True, exist_ok=True)
        for path, frame in zip(files.values(), gather(options.runs), strict=True):
            frame.to_csv(path, index=False)
    text = {"library": str, "question": str}
    curves, finals = (pd.read_csv(path, dtype=text) for path in files.values())
    options.figures.mkdir(parents=True, exist_ok=True)
    told = table(finals)
    (options.figures / "experiment.md").write_text(told, encoding="utf-8")
    print(told)
    draw_curves(curves, options.figures / "experiment-curves.png")
    draw_finals(finals, options.figures / "experiment-finals.png")


if __name__ == "__main__":
    main()
