"""Measuring side by side: all contenders in turn, many rounds, medians of the ratios within a round.

A machine that is slow for a while is slow for all contenders of a round, so ratios are reliable where times are not.
Times are processor times of all threads of a process, or wall-clock times where processes share the work.
"""

from __future__ import annotations

import gc
import json
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

Contender = Callable[[], float]
"""Runs once; returns microseconds per decision (or another quantity to compare)."""

Times = dict[str, list[float]]

now = time.process_time
"""The clock of all contenders except those of several processes; it does not count other programs on the machine."""

ROOT = Path(__file__).parent.parent

COLUMNS = ["what", "ratio", "bar", "aim", "reached"]

PACKAGES = ("greenlet", "gymnasium", "pettingzoo", "mesa", "numpy")


def timed(loop: Callable[[int], None], number: int, clock: Callable[[], float] = now) -> Contender:
    """Make a contender from a loop that takes the number of iterations."""

    def run() -> float:
        start = clock()
        loop(number)
        return (clock() - start) / number * 1e6

    return run


@contextmanager
def without_collections() -> Iterator[None]:
    """Disable garbage collection, which would hit some contenders and not others."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def side_by_side(contenders: Mapping[str, Contender], rounds: int) -> Times:
    """Run all contenders in turn for a number of rounds, after one warm-up round."""
    times: Times = {name: [] for name in contenders}
    with without_collections():
        for number in range(rounds + 1):
            for name, contender in contenders.items():
                figure = contender()
                if number:
                    times[name].append(figure)
    return times


def ratio(times: Times, over: str, *under: str) -> float:
    """Compute the median over rounds of one contender's time divided by the sum of others' times."""
    sums = zip(*(times[name] for name in under), strict=True)
    return statistics.median(top / sum(bottom) for top, bottom in zip(times[over], sums, strict=True))


class Elsewhere:
    """Contenders in another process, which take turns like all others.

    This is for effects on everything else in a process. The other process runs a module that calls ``serve``.
    """

    def __init__(self, module: str, *arguments: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", module, *arguments],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def contender(self, name: str) -> Contender:
        """Make a contender from the one of this name in the other process."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        asking, told = self._process.stdin, self._process.stdout

        def run() -> float:
            print(name, file=asking, flush=True)
            return float(told.readline())

        return run

    def close(self) -> None:
        """End the process."""
        self._process.communicate()


def alone(section: str, *arguments: str, cores: str | None = None) -> Any:
    """Measure something in a new process, which runs a section's module and prints JSON."""
    command = [sys.executable, "-m", f"benchmarks.{section}", *arguments]
    if cores is not None:
        command = ["taskset", "-c", cores, *command]
    done = subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout)


def serve(contenders: Mapping[str, Contender]) -> None:
    """Run the contenders whose names arrive on standard input: the other side of ``Elsewhere``."""
    with without_collections():
        for line in sys.stdin:
            print(contenders[line.strip()](), flush=True)


@dataclass(frozen=True)
class Figure:
    """One ratio, or another quantity with a target.

    Attributes:
        what: The description.
        value: The value, rounded to ``digits``.
        bar, aim: The project's limit, and its better target; None for neither.
        digits: The number of decimals.
        at_least: Whether higher values are better; else lower ones are.
    """

    what: str
    value: float
    bar: float | None
    aim: float | None
    digits: int
    at_least: bool

    @property
    def verdict(self) -> str:
        """Whether the value reaches the aim, the bar or neither."""
        sign = -1 if self.at_least else 1
        if self.bar is None:
            return ""
        if self.aim is not None and sign * self.value <= sign * self.aim:
            return "aim"
        return "bar" if sign * self.value <= sign * self.bar else "missed"

    def row(self) -> list[str]:
        """Return the row of a table."""
        sign = "≥" if self.at_least else "≤"
        limits = ["" if limit is None else f"{sign} {limit:g}" for limit in (self.bar, self.aim)]
        return [self.what, f"{self.value:.{self.digits}f}", *limits, self.verdict]


class Section:
    """The results of one module: ratios, with the project's limits, and the times behind them.

    Attributes:
        title: The title.
        unit: The unit of the times.
        ratios: The rows of the first table.
        medians: The rows of the second table: times by their description.
        remarks: Additional remarks.
    """

    def __init__(self, title: str, unit: str) -> None:
        self.title, self.unit = title, unit
        self.ratios: list[Figure] = []
        self.medians: dict[str, float] = {}
        self.remarks: list[str] = []

    def ratio(
        self,
        what: str,
        value: float,
        bar: float | None = None,
        aim: float | None = None,
        digits: int = 2,
        *,
        at_least: bool = False,
    ) -> None:
        """Add a ratio, with its bar (the limit) and its aim (the better target), if it has them."""
        self.ratios.append(Figure(what, round(value, digits), bar, aim, digits, at_least))

    def time(self, what: str, value: float) -> None:
        """Add a time."""
        self.medians[what] = value

    def times(self, times: Times) -> None:
        """Add the medians of measured times."""
        for name, values in times.items():
            self.time(name, statistics.median(values))


class Report:
    """The report: the same tables for the terminal and in Markdown, and JSON for programs."""

    def __init__(self, title: str) -> None:
        self._console = Console()
        self._sections: list[Section] = []
        packages = ", ".join(f"{name} {version(name)}" for name in PACKAGES)
        self._made_with = (
            f"Measured with CPython {platform.python_version()} on {platform.machine()} ({_processor()}), one core,"
            f" {packages}."
        )
        self._console.rule(title)
        self._console.print(self._made_with)

    @property
    def times(self) -> dict[str, float]:
        """All times so far, by their description."""
        return {what: time for section in self._sections for what, time in section.medians.items()}

    def add(self, section: Section) -> None:
        """Add a section, and print its results."""
        self._sections.append(section)
        for table in _tables(section):
            self._print(*table)
        for remark in section.remarks:
            self._console.print(remark)

    def conclude(self) -> None:
        """Print all figures that have a bar."""
        self._print(*self._held())

    def _held(self) -> tuple[str, list[str], list[list[str]]]:
        figures = [figure for section in self._sections for figure in section.ratios if figure.bar is not None]
        return "Targets of the project", COLUMNS, [figure.row() for figure in figures]

    def _print(self, title: str, columns: list[str], rows: list[list[str]]) -> None:
        table = Table(*columns, title=title)
        for row in rows:
            table.add_row(*row)
        self._console.print(table)

    def write(self, path: Path) -> None:
        """Write the tables in Markdown."""
        lines = [self._made_with, *_markdown(*self._held())]
        for section in self._sections:
            for table in _tables(section):
                lines += _markdown(*table)
            for remark in section.remarks:
                lines += ["", remark]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")

    def dump(self, path: Path) -> None:
        """Write all ratios and times as JSON, by section and description."""
        figures = {
            section.title: {
                "ratios": {figure.what: figure.value for figure in section.ratios},
                "times": section.medians,
            }
            for section in self._sections
        }
        path.write_text(json.dumps(figures, indent=1), encoding="utf-8")


def _tables(section: Section) -> Iterator[tuple[str, list[str], list[list[str]]]]:
    """Yield title, columns and rows of a section's tables."""
    if section.ratios:
        yield f"{section.title}: ratios", COLUMNS, [figure.row() for figure in section.ratios]
    rows = [[what, f"{value:.2f}" if value >= 0.1 else f"{value:.3f}"] for what, value in section.medians.items()]
    yield f"{section.title}: {section.unit}", ["what", "time"], rows


def _markdown(title: str, columns: list[str], rows: list[list[str]]) -> list[str]:
    lines = [columns, ["---"] * len(columns), *rows]
    return ["", f"**{title}**", "", *(f"| {' | '.join(line)} |" for line in lines)]


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "unknown")
