"""Measuring side by side: all contenders in turn, many rounds, medians of the ratios within a round.

A machine that is slow for a while is slow for all contenders of a round, so that ratios stand where times
do not. Time is the processor's, of all threads of a process; where processes share the work, the wall clock's.
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
"""Runs once; returns microseconds per decision (or whatever is compared)."""

Times = dict[str, list[float]]

now = time.process_time
"""The clock of all contenders but those that are several processes: what else runs on the machine is not counted."""

ROOT = Path(__file__).parent.parent

COLUMNS = ["what", "ratio", "bar", "aim", "reached"]

PACKAGES = ("greenlet", "gymnasium", "pettingzoo", "mesa", "numpy")


def timed(loop: Callable[[int], None], number: int, clock: Callable[[], float] = now) -> Contender:
    """Make a contender of a loop that is told how often to go round."""

    def run() -> float:
        start = clock()
        loop(number)
        return (clock() - start) / number * 1e6

    return run


@contextmanager
def without_collections() -> Iterator[None]:
    """No garbage collection, which would fall to some contenders and not to others."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def side_by_side(contenders: Mapping[str, Contender], rounds: int) -> Times:
    """Run all contenders in turn, as many rounds as asked, after one round that does not count."""
    times: Times = {name: [] for name in contenders}
    with without_collections():
        for number in range(rounds + 1):
            for name, contender in contenders.items():
                figure = contender()
                if number:
                    times[name].append(figure)
    return times


def ratio(times: Times, over: str, *under: str) -> float:
    """The median over the rounds of one contender's time over the sum of others'."""
    sums = zip(*(times[name] for name in under), strict=True)
    return statistics.median(top / sum(bottom) for top, bottom in zip(times[over], sums, strict=True))


class Elsewhere:
    """Contenders in a process of their own, which take their turns like any others.

    For what all that is in a process may have to pay for. The other process is a module that calls ``serve``.
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
        """Make a contender of the one that has this name over there."""
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
    """Measure something in a process that has done nothing before: a section's, which prints JSON."""
    command = [sys.executable, "-m", f"benchmarks.{section}", *arguments]
    if cores is not None:
        command = ["taskset", "-c", cores, *command]
    done = subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout)


def serve(contenders: Mapping[str, Contender]) -> None:
    """Run each contender whose name is read, until there is none left: the other side of ``Elsewhere``."""
    with without_collections():
        for line in sys.stdin:
            print(contenders[line.strip()](), flush=True)


@dataclass(frozen=True)
class Figure:
    """One ratio (or whatever else is held to something).

    Attributes:
        what: What was compared.
        value: What came out, rounded to what is shown.
        bar, aim: What the project holds itself to, and what would be better; None for neither.
        digits: How many decimals are shown.
        at_least: Whether more is better; else less is.
    """

    what: str
    value: float
    bar: float | None
    aim: float | None
    digits: int
    at_least: bool

    @property
    def verdict(self) -> str:
        """Which of the two it reaches."""
        sign = -1 if self.at_least else 1
        if self.bar is None:
            return ""
        if self.aim is not None and sign * self.value <= sign * self.aim:
            return "aim"
        return "bar" if sign * self.value <= sign * self.bar else "missed"

    def row(self) -> list[str]:
        """The row of a table."""
        sign = "≥" if self.at_least else "≤"
        limits = ["" if limit is None else f"{sign} {limit:g}" for limit in (self.bar, self.aim)]
        return [self.what, f"{self.value:.{self.digits}f}", *limits, self.verdict]


class Section:
    """What one module has measured: ratios, with what the project holds itself to, and the times behind them.

    Attributes:
        title: What it is about.
        unit: What the times are.
        ratios: The rows of its first table.
        medians: Those of its second: times by what took them.
        remarks: What else is to be said.
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
        """Add a ratio; its bar, if it is to stay below (or above) one; and what it would better be."""
        self.ratios.append(Figure(what, round(value, digits), bar, aim, digits, at_least))

    def time(self, what: str, value: float) -> None:
        """Add a time."""
        self.medians[what] = value

    def times(self, times: Times) -> None:
        """Add the medians of measured times."""
        for name, values in times.items():
            self.time(name, statistics.median(values))


class Report:
    """Tables for the terminal and, the same, in Markdown; and figures for programs."""

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
        """All times so far, by what took them."""
        return {what: time for section in self._sections for what, time in section.medians.items()}

    def add(self, section: Section) -> None:
        """Tell what a section has measured."""
        self._sections.append(section)
        for table in _tables(section):
            self._print(*table)
        for remark in section.remarks:
            self._console.print(remark)

    def conclude(self) -> None:
        """Tell what has become of all that is held to a bar."""
        self._print(*self._held())

    def _held(self) -> tuple[str, list[str], list[list[str]]]:
        figures = [figure for section in self._sections for figure in section.ratios if figure.bar is not None]
        return "What the project holds itself to", COLUMNS, [figure.row() for figure in figures]

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
        """Write all ratios and times as JSON: by section, and by what was measured."""
        figures = {
            section.title: {
                "ratios": {figure.what: figure.value for figure in section.ratios},
                "times": section.medians,
            }
            for section in self._sections
        }
        path.write_text(json.dumps(figures, indent=1), encoding="utf-8")


def _tables(section: Section) -> Iterator[tuple[str, list[str], list[list[str]]]]:
    """Title, columns and rows of a section's tables."""
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
