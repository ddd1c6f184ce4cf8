"""Measuring side by side: all contenders in turn, many rounds, medians of the ratios within a round.

A machine that is slow for a while is slow for all contenders of a round, so that ratios stand where times
do not.
"""

from __future__ import annotations

import gc
import platform
import statistics
import time
from collections.abc import Callable, Mapping
from importlib.metadata import version
from pathlib import Path

from rich.console import Console
from rich.table import Table

Contender = Callable[[], float]
"""Runs once; returns microseconds per decision (or whatever is compared)."""

Times = dict[str, list[float]]

PACKAGES = ("greenlet", "gymnasium", "pettingzoo", "mesa", "numpy")


def timed(loop: Callable[[int], None], number: int) -> Contender:
    """Make a contender of a loop that is told how often to go round."""

    def run() -> float:
        start = time.perf_counter()
        loop(number)
        return (time.perf_counter() - start) / number * 1e6

    return run


def side_by_side(contenders: Mapping[str, Contender], rounds: int) -> Times:
    """Run all contenders in turn, as many rounds as asked, after one round that does not count."""
    times: Times = {name: [] for name in contenders}
    gc.collect()
    gc.disable()
    try:
        for number in range(rounds + 1):
            for name, contender in contenders.items():
                figure = contender()
                if number:
                    times[name].append(figure)
    finally:
        gc.enable()
    return times


def ratio(times: Times, over: str, *under: str) -> float:
    """The median over the rounds of one contender's time over the sum of others'."""
    sums = zip(*(times[name] for name in under), strict=True)
    return statistics.median(top / sum(bottom) for top, bottom in zip(times[over], sums, strict=True))


class Section:
    """What one module has measured: ratios, with what the project holds itself to, and the times behind them.

    Attributes:
        title: What it is about.
        unit: What the times are.
        ratios, rows: The rows of its two tables.
        remarks: What else is to be said.
    """

    def __init__(self, title: str, unit: str) -> None:
        self.title, self.unit = title, unit
        self.ratios: list[list[str]] = []
        self.rows: list[list[str]] = []
        self.remarks: list[str] = []

    def ratio(
        self, what: str, value: float, bar: float | None = None, aim: float | None = None, digits: int = 2
    ) -> None:
        """Add a ratio; its bar, if it is to stay below (or above) one; and what it would better be."""
        limits = ["" if limit is None else f"{limit:g}" for limit in (bar, aim)]
        self.ratios.append([what, f"{value:.{digits}f}", *limits])

    def time(self, what: str, value: float, digits: int = 2) -> None:
        """Add a time."""
        self.rows.append([what, f"{value:.{digits}f}"])

    def times(self, times: Times) -> None:
        """Add the medians of measured times."""
        for name, values in times.items():
            self.time(name, statistics.median(values))


class Report:
    """Tables for the terminal and, the same, in Markdown."""

    def __init__(self, title: str) -> None:
        self._console = Console()
        packages = ", ".join(f"{name} {version(name)}" for name in PACKAGES)
        self._lines = [
            f"Measured with CPython {platform.python_version()} on {platform.machine()} ({_processor()}), one core,"
            f" {packages}.",
        ]
        self._console.rule(title)
        self._console.print(self._lines[0])

    def add(self, section: Section) -> None:
        """Tell what a section has measured."""
        self._table(f"{section.title}: ratios", ["what", "ratio", "bar", "aim"], section.ratios)
        self._table(f"{section.title}: {section.unit}", ["what", "time"], section.rows)
        for remark in section.remarks:
            self._console.print(remark)
            self._lines += ["", remark]

    def _table(self, title: str, columns: list[str], rows: list[list[str]]) -> None:
        table = Table(*columns, title=title)
        for row in rows:
            table.add_row(*row)
        self._console.print(table)
        self._lines += ["", f"**{title}**", "", f"| {' | '.join(columns)} |", f"|{' --- |' * len(columns)}"]
        self._lines += [f"| {' | '.join(row)} |" for row in rows]

    def write(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(self._lines) + "\n", encoding="utf-8")


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "unknown")
