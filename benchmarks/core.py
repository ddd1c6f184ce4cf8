"""The cost of simulations with their own loop: this library's views and alternatives, in one run.

Run it with ``make benchmark``. It keeps itself on one core, except for rows that need two. A
section is a module whose function ``groups`` takes a number of decisions and yields its rows;
``--only`` selects sections. ``PYTHONPATH`` determines which source is measured.
"""

from __future__ import annotations

import argparse
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

from benchmarks.measure import MissingError, Table, measure, pin

SECTIONS = (
    "decisions", "resets", "extras", "rounds", "plugins", "vector", "suspended", "many", "branches",
    "episodes", "outside", "openenv", "wolf_sheep", "energyplus", "experiments", "batch_run",
)  # fmt: skip
"""The sections in the order in which they run. Each is imported when it runs."""


def main() -> None:
    """Run the benchmarks from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--only", nargs="+", choices=SECTIONS, default=SECTIONS, help="sections to run (all)"
    )
    parser.add_argument("--rounds", type=int, default=31, help="the most rounds (%(default)s)")
    parser.add_argument(
        "--number", type=int, default=20_000, help="decisions per round (%(default)s)"
    )
    parser.add_argument(
        "--quick", action="store_true", help="a smoke test on one core; its figures mean nothing"
    )
    parser.add_argument(
        "--write", type=Path, help="a Markdown file for the table; a figure is written beside it"
    )
    parser.add_argument("--json", type=Path, help="a file for the figures")
    arguments = parser.parse_args()
    rounds, number = (1, 200) if arguments.quick else (arguments.rounds, arguments.number)
    pin(1 if arguments.quick else 2)
    print(f"The library in {Path(find_spec('simenv_marl').origin).parent}:")
    table = Table(rounds)
    for name in SECTIONS:
        if name in arguments.only:
            try:
                for group in import_module(f"benchmarks.{name}").groups(number):
                    table.add(name, measure(group, rounds, warm_up=not arguments.quick))
            except MissingError as error:
                table.remark(f"{name}: the rest needs {error}.")
    if arguments.write is not None:
        table.write(arguments.write)
        if {"vector", "suspended"} <= table.figures.keys():
            from benchmarks.picture import draw

            draw(table.figures, arguments.write.with_name("vector.png"))
    if arguments.json is not None:
        table.dump(arguments.json)


if __name__ == "__main__":
    main()
