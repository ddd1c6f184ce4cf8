"""The figure of the cost of many simulations: microseconds per simulation, by their number."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Canvas

from benchmarks.measure import Figure


def draw(figures: Mapping[str, list[Figure]], path: Path) -> None:
    """Draw the figures of the sections ``vector`` and ``suspended`` in a file."""
    by_name = {figure.row.name: figure for figure in figures["vector"]}
    template, view = (
        [
            (int(name.split()[0].replace(",", "")), figure)
            for name, figure in by_name.items()
            if name.endswith(end)
        ]
        for end in ("simulations / SyncVectorEnv of template", "of single_env")
    )
    threads = [
        (64, figure)
        for figure in figures["suspended"]
        if figure.row.name.endswith("beside a thread for each")
    ]
    lines = {
        "vector_env": ("#1b6f5f", [(size, figure.candidate) for size, figure in template]),
        "SyncVectorEnv of template": (
            "#8c8c8c",
            [(size, figure.baseline) for size, figure in template],
        ),
        "SyncVectorEnv of single_env": (
            "#d1812c",
            [(size, figure.baseline) for size, figure in view],
        ),
        "a thread for each": ("#b3402e", [(size, figure.baseline) for size, figure in threads]),
    }
    canvas = Canvas(figsize=(7.2, 4.2), layout="constrained")
    FigureCanvasAgg(canvas)  # neither a window nor pyplot's global state
    axes = canvas.add_subplot()
    for label, (colour, points) in lines.items():
        axes.plot(*zip(*points, strict=True), marker="o", color=colour, label=label)
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="simulations side by side",
        ylabel="microseconds per simulation and step",
        title="A step of many simulations that do nothing, on one core",
    )
    axes.set_yticks([1, 2, 5, 10, 20, 50], labels=["1", "2", "5", "10", "20", "50"])
    axes.grid(visible=True, which="major", color="#dddddd", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    canvas.savefig(path, dpi=150)
