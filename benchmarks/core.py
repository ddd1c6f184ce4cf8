"""The cost of a simulation that keeps its own loop: this library's views beside their alternatives, in one run.

Run it with ``make benchmark``, which pins it to one core. A section is a module with a function ``measure``; ``--only``
selects sections. ``PYTHONPATH`` determines which source is measured.
"""

from __future__ import annotations

import argparse
from importlib import import_module
from pathlib import Path

from benchmarks.measure import Report
from benchmarks.picture import draw

SECTIONS = (
    "decisions",
    "stages",
    "extras",
    "rounds",
    "plugins",
    "vector",
    "suspended",
    "many",
    "branches",
    "outside",
    "wolf_sheep",
    "pension",
    "experiments",
    "batch_run",
    "greenhouse",
)
"""The sections in the order in which they run. Each is imported when it runs, and the greenhouse comes last, because
its module makes a ``difference()``, which stays in the process."""

QUICK = {"rounds": 2, "number": 200}
"""Enough to check that all sections run."""


def main() -> None:
    """Run the benchmarks from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=SECTIONS, help="sections to run (all)")
    parser.add_argument("--rounds", type=int, default=31, help="number of rounds (%(default)s)")
    parser.add_argument("--number", type=int, default=20_000, help="decisions per round (%(default)s)")
    parser.add_argument("--quick", action="store_true", help="a smoke test; its figures are meaningless")
    parser.add_argument("--write", type=Path, help="a Markdown file for the tables; a figure is written beside it")
    parser.add_argument("--json", type=Path, help="a file for the figures")
    arguments = parser.parse_args()
    effort = QUICK if arguments.quick else {"rounds": arguments.rounds, "number": arguments.number}
    report = Report("What a decision costs")
    for name in SECTIONS:
        if name in arguments.only:
            report.add(import_module(f"benchmarks.{name}").measure(**effort))
    if len(arguments.only) > 1:
        report.conclude()
    if arguments.write is not None:
        report.write(arguments.write)
        if {"vector", "suspended"} <= set(arguments.only):
            draw(report.times, arguments.write.with_name("vector.png"))
    if arguments.json is not None:
        report.dump(arguments.json)


if __name__ == "__main__":
    main()
