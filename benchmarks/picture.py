"""The figure of the cost of many simulations: microseconds per simulation, by their number."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

COLOURS = {
    "vector_env": "#1b6f5f",
    "SyncVectorEnv, by hand": "#8c8c8c",
    "SyncVectorEnv, our single view": "#d1812c",
}
OTHERS = {"a thread with queues for each, 64": ("a thread with queues for each", "#b3402e", 64)}


def draw(times: Mapping[str, float], path: Path) -> None:
    """Draw the results of the sections on vector environments and on suspended simulations.

    Args:
        times: The times of both sections, by their description.
        path: The file to write.
    """
    figure = Figure(figsize=(7.2, 4.2), layout="constrained")
    FigureCanvasAgg(figure)  # neither a window nor pyplot's global state
    axes = figure.add_subplot()
    for name, colour in COLOURS.items():
        points = [
            (int(number.replace(",", "")), value)
            for what, value in times.items()
            for title, _, number in [what.rpartition(", ")]
            if title == name
        ]
        axes.plot(*zip(*points, strict=True), marker="o", color=colour, label=name)
    for what, (title, colour, number) in OTHERS.items():
        axes.plot([number], [times[what]], marker="s", linestyle="", color=colour, label=title)
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
    figure.savefig(path, dpi=150)
