"""What the studies of bounds share: processor time, files, and the bars of their figures."""

from __future__ import annotations

import argparse
import csv
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import tqdm  # type: ignore[import-untyped]

from ..report import markdown, new_figure

tqdm.tqdm.monitor_interval = 0
"""Bars, even those that are switched off, begin no thread: a process that has one cannot fork."""

FIGURES: Final = Path(__file__).parents[2] / "docs" / "figures"
"""Where the figures of the pages are."""

OUT: Final = Path(__file__).parent / "out"
"""Where the results are."""

PLANNED: Final = "#1b6f5f"
"""The colour of plans."""

OTHERS: Final = "#9a9a9a"
"""The colour of rules and published results."""


def options_of(description: str, arguments: Sequence[str] | None, **counts: int) -> Any:
    """Parse a command line: ``--quick``, folders, and a number for each of ``counts``."""
    parser = argparse.ArgumentParser(description=description)
    for name, value in counts.items():
        parser.add_argument(f"--{name}", type=int, default=value, help="(default: %(default)s)")
    parser.add_argument("--quick", action="store_true", help="a run of less than half a minute")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--figures", type=Path, default=FIGURES)
    options = parser.parse_args(arguments)
    if options.quick and options.out == OUT:
        options.out = OUT / "quick"
    if options.quick and options.figures == FIGURES:
        options.figures = options.out
    for folder in (options.out, options.figures):
        folder.mkdir(parents=True, exist_ok=True)
    return options


def cpu_seconds() -> float:
    """Return the processor time of this process and of those that it has started and ended."""
    return sum(os.times()[:4])


def write(path: Path, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Write a file of comma-separated values."""
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([columns, *rows])


def read(path: Path, numbers: Sequence[int]) -> list[list[Any]]:
    """Return the rows of a file that ``write`` has written; none if it does not exist.

    Args:
        path: The file.
        numbers: The columns that are numbers.
    """
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        rows: list[list[Any]] = [*csv.reader(file)][1:]
    for row in rows:
        for column in numbers:
            row[column] = float(row[column])
    return rows


def show(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Print a table in Markdown."""
    print(markdown(columns, rows), flush=True)


def draw(path: Path, values: Mapping[str, float], planned: Sequence[str], label: str) -> None:
    """Draw a bar for each value.

    Args:
        path: The file to write.
        values: The values by name, the first one at the top.
        planned: The names of the plans, which get a colour of their own.
        label: The label of the axis.
    """
    figure = new_figure(6.5, 0.6 + 0.28 * len(values))
    axes = figure.subplots()
    colors = [PLANNED if name in planned else OTHERS for name in values]
    bars = axes.barh([*values], [*values.values()], color=colors)
    axes.bar_label(bars, fmt="%.4g", padding=2, fontsize=8)
    axes.invert_yaxis()
    axes.margins(x=0.12)
    axes.set_xlabel(label)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=110)
