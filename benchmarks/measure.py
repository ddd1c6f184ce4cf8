"""Measure contenders side by side: in turn, in many rounds, by medians of the ratios in a round.

A machine that is slow for a while is slow for all contenders of a round, so ratios are reliable
where times are not. Times are processor times of all threads of this process, or wall-clock times
where processes share the work.
"""

from __future__ import annotations

import gc
import json
import os
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

Contender = Callable[[], float]
"""Runs once; returns microseconds per decision, or another quantity."""

ROOT = Path(__file__).parent.parent
PACKAGES = ("greenlet", "gymnasium", "pettingzoo", "mesa", "numpy")

COLUMNS = {
    "section": 10,
    "row": 70,
    "unit": 5,
    "candidate": 9,
    "baseline": 9,
    "ratio": 20,
    "bar": 6,
    "aim": 6,
}
"""The columns of the table but the last, and their widths on a terminal."""

now = time.process_time
"""The clock of all contenders except those of several processes.

It does not count other programs on the machine.
"""


@dataclass(frozen=True)
class Row:
    """One comparison.

    Attributes:
        name: What is compared with what.
        candidate, baseline: The contenders. Without a baseline, the figure is the candidate's own.
        bar, aim: The project's limit for the ratio, and its better target; None for neither.
        faster: Whether the ratio is that of the speeds, where more is better; else it is that of
            the times.
        unit: The unit of what the contenders return.
    """

    name: str
    candidate: Contender
    baseline: Contender | None = None
    bar: float | None = None
    aim: float | None = None
    faster: bool = False
    unit: str = "µs"


@dataclass(frozen=True)
class Group:
    """Rows of a section that are measured in the same rounds.

    Attributes:
        rows: The rows. Contenders that several rows share run once in each round.
        most: The largest number of rounds that is worth its time.
    """

    rows: list[Row]
    most: int = 1_000


class MissingError(Exception):
    """The rest of a section cannot be measured here; the message says what is missing."""


@dataclass(frozen=True)
class Figure:
    """The figures of a row: medians over rounds of the ratio, the candidate and the baseline."""

    row: Row
    ratio: float
    candidate: float
    baseline: float | None

    @property
    def verdict(self) -> str:
        """Whether the ratio reaches the aim, the bar or neither."""
        sign = -1 if self.row.faster else 1
        for word, limit in (("aim", self.row.aim), ("bar", self.row.bar)):
            if limit is not None and sign * self.ratio <= sign * limit:
                return word
        return "" if self.row.bar is None else "missed"

    def cells(self) -> list[str]:
        """Return the cells of the table's line."""
        sign = "≥" if self.row.faster else "≤"
        limits = [
            "" if limit is None else f"{sign} {limit:g}" for limit in (self.row.bar, self.row.aim)
        ]
        baseline = "" if self.baseline is None else _number(self.baseline)
        ratio = f"{_number(self.ratio)} times as fast" if self.row.faster else _number(self.ratio)
        return [
            self.row.name,
            self.row.unit,
            _number(self.candidate),
            baseline,
            ratio,
            *limits,
            self.verdict,
        ]


def measure(group: Group, rounds: int, *, warm_up: bool = True) -> list[Figure]:
    """Run all contenders of a group in turn for a number of rounds, after a warm-up round."""
    pairs = [contender for row in group.rows for contender in (row.baseline, row.candidate)]
    values: dict[Contender, list[float]] = {
        contender: [] for contender in pairs if contender is not None
    }
    with _without_collections():
        for number in range(-warm_up, min(rounds, group.most)):
            for contender, found in values.items():
                value = contender()
                if number >= 0:
                    found.append(value)
    return [_figure(row, values) for row in group.rows]


def _figure(row: Row, values: Mapping[Contender, list[float]]) -> Figure:
    ours = values[row.candidate]
    theirs = [1.0] * len(ours) if row.baseline is None else values[row.baseline]
    ratios = [
        base / own if row.faster else own / base for own, base in zip(ours, theirs, strict=True)
    ]
    ratio = statistics.median(ratios)
    return Figure(
        row,
        round(ratio, _digits(ratio)),
        statistics.median(ours),
        None if row.baseline is None else statistics.median(theirs),
    )


def _number(value: float) -> str:
    return f"{value:,.{_digits(value)}f}"


def _digits(value: float) -> int:
    return 2 if abs(value) >= 0.1 else 3


@contextmanager
def _without_collections() -> Iterator[None]:
    """Disable garbage collection, which would hit some contenders and not others."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


# -- contenders -----------------------------------------------------------------------------------


def timer(loop: Callable[[int], None], number: int, clock: Callable[[], float] = now) -> Contender:
    """Make a contender from a loop that takes the number of iterations."""

    def run() -> float:
        start = clock()
        loop(number)
        return (clock() - start) / number * 1e6

    return run


def both(*contenders: Contender) -> Contender:
    """Make a contender whose time is the sum of those of others."""
    return lambda: sum(contender() for contender in contenders)


def calls(function: Callable[..., Any], number: int, *args: Any) -> Contender:
    """Make a contender of calls of a function with at most one argument."""

    def loop(number: int) -> None:
        for _ in range(number):
            function()

    def loop_of_one(number: int) -> None:
        (arg,) = args
        for _ in range(number):
            function(arg)

    return timer(loop_of_one if args else loop, number)


def alone(section: str, *arguments: str) -> Any:
    """Measure something in a new process, which runs a section's module and prints JSON."""
    command = [sys.executable, "-m", f"benchmarks.{section}", *arguments]
    return json.loads(
        subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True).stdout
    )


# -- cores ----------------------------------------------------------------------------------------


_cores: list[int] = []
"""The cores that rows may use."""


def pin(most: int) -> None:
    """Keep this process and its children on one core, and let some rows use up to ``most`` cores.

    The function has no effect on systems without processor affinity.
    """
    if hasattr(os, "sched_getaffinity"):
        _cores[:] = sorted(os.sched_getaffinity(0))[:most]
        os.sched_setaffinity(0, _cores[:1])


@contextmanager
def two_cores() -> Iterator[None]:
    """Let this process and those that it starts use two cores.

    Raises:
        MissingError: There are not two.
    """
    if len(_cores) < 2:
        raise MissingError("two cores")
    os.sched_setaffinity(0, _cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, _cores[:1])


# -- the table ------------------------------------------------------------------------------------


class Table:
    """The table of all figures: printed line by line, then written as Markdown and JSON.

    Attributes:
        figures: The figures of each section.
        remarks: What was not measured, and why.
    """

    def __init__(self, rounds: int) -> None:
        self.figures: dict[str, list[Figure]] = {}
        self.remarks: list[str] = []
        packages = ", ".join(f"{name} {version(name)}" for name in PACKAGES)
        self._heading = (
            f"Measured with CPython {platform.python_version()} on {platform.machine()}"
            f" ({_processor()}), {packages}; rounds: {rounds} at most."
        )
        print(self._heading, *_lines([], list(COLUMNS.values())), sep="\n", flush=True)

    def add(self, section: str, figures: list[Figure]) -> None:
        """Add figures, and print them."""
        self.figures.setdefault(section, []).extend(figures)
        for line in _lines([(section, figures)], list(COLUMNS.values()))[2:]:
            print(line, flush=True)

    def remark(self, text: str) -> None:
        """Add a remark, and print it."""
        self.remarks.append(text)
        print(text, flush=True)

    def write(self, path: Path) -> None:
        """Write the table in Markdown."""
        lines = [self._heading, "", *_lines(list(self.figures.items()), [0] * len(COLUMNS))]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(
            "\n".join([*lines, *(f"\n{remark}" for remark in self.remarks)]) + "\n",
            encoding="utf-8",
        )

    def dump(self, path: Path) -> None:
        """Write all figures as JSON, by section and row."""

        def entry(figure: Figure) -> dict[str, Any]:
            measured = {name: getattr(figure, name) for name in ("ratio", "candidate", "baseline")}
            return measured | {"unit": figure.row.unit}

        figures = {
            name: {figure.row.name: entry(figure) for figure in found}
            for name, found in self.figures.items()
        }
        path.write_text(json.dumps(figures, indent=1), encoding="utf-8")


def _lines(sections: list[tuple[str, list[Figure]]], widths: list[int]) -> list[str]:
    """Return the lines of a Markdown table, with columns at least as wide as given."""
    rows = [[section, *figure.cells()] for section, figures in sections for figure in figures]
    cells = [[*COLUMNS, "reached"], ["---"] * (len(COLUMNS) + 1), *rows]
    return [f"| {' | '.join(map(str.ljust, row, [*widths, 0]))} |" for row in cells]


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next(
        (line.partition(":")[2].strip() for line in lines if line.startswith("model name")),
        "unknown",
    )
