"""What it costs to leave a simulation in the lead: this library's views beside what they replace, in one run.

Run with ``make benchmark``, which pins it to one core. A section is a module with a function ``measure``; one
can be run alone with ``--only``.
"""

from __future__ import annotations

import argparse
from importlib import import_module
from pathlib import Path

from benchmarks.measure import Report
from benchmarks.picture import draw

SECTIONS = ("decisions", "rounds", "plugins", "vector", "many", "wolf_sheep", "greenhouse")
"""In the order in which they run. The greenhouse comes last, and each is imported when it runs, because the
greenhouse's ``difference()`` makes all environments that are made afterwards say for whom they evaluate a mapping."""


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=SECTIONS, help="sections to run (all)")
    parser.add_argument("--rounds", type=int, default=31, help="how many rounds (%(default)s)")
    parser.add_argument("--number", type=int, default=20_000, help="decisions per round (%(default)s)")
    parser.add_argument("--write", type=Path, help="a Markdown file for the tables; a picture comes beside it")
    arguments = parser.parse_args()
    report = Report("What a decision costs")
    for name in SECTIONS:
        if name in arguments.only:
            section = import_module(f"benchmarks.{name}").measure(arguments.rounds, arguments.number)
            report.add(section)
            if name == "vector" and arguments.write is not None:
                draw(section, arguments.write.with_name("vector.png"))
    if arguments.write is not None:
        report.write(arguments.write)


if __name__ == "__main__":
    main()
