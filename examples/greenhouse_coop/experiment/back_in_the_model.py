"""What has been learnt, at work in the model's own loop.

``python -m examples.greenhouse_coop.experiment.back_in_the_model FILE ...`` loads policies that the scripts of the
libraries have left, and lets ``simenv_marl.simulate`` run the greenhouse with them, beside one that is run by its
rules. No environment is made, and nobody steps: the simulation runs its own loop, and what counts is what a gardener
would count.

    ``sb3-3-0.zip``      stable-baselines3
    ``torchrl-4a-0.pt``  TorchRL
    ``rllib-4a-0``       RLlib; a folder

Each asks for the library that has made it, and for nothing else that learns. RLlib stands in an environment of its own,
so its policies have to be shown by that one's Python.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Final

from rich.console import Console
from rich.table import Table

from simenv_marl import simulate

from ..env import GreenhouseSim
from ..train import Team
from .questions import FINAL, QUESTIONS
from .runs import RUNS, Run

LIBRARIES: Final = {"sb3": "stable-baselines3", "torchrl": "torchrl", "rllib": "ray[rllib]"}
"""Which distribution a library's policies need."""


def load(path: Path) -> tuple[str, Team]:
    """Load a policy.

    Args:
        path: What a script has left of a run: ``LIBRARY-QUESTION-SEED``, with a suffix or without.

    Returns:
        What to call it, and who decides.
    """
    library, _, rest = path.stem.partition("-")
    question, _, seed = rest.partition("-")
    if library not in LIBRARIES or question not in QUESTIONS or not seed.isdecimal():
        raise SystemExit(f"{path} is not named LIBRARY-QUESTION-SEED as policies are: sb3-3-0.zip, for instance")
    if not path.exists():
        raise SystemExit(f"{path} does not exist: python -m {__package__}.{library} learns it")
    try:
        script = import_module(f"{__package__}.{library}")
    except ModuleNotFoundError as missing:
        raise SystemExit(
            f"{path.name} needs {LIBRARIES[library]}, which this Python has not ({missing}): take that of another"
            " virtual environment"
        ) from missing
    team = script.load(Run(library, question, int(seed), 0, path.parent))
    return f"{path.stem}: {QUESTIONS[question].title}", team


def compare(teams: dict[str, Team], seeds: Sequence[int]) -> Table:
    """Let everyone keep the same greenhouses, one simulation after the other.

    Args:
        teams: By what to call them, who decides what; whoever is not named follows the rule.
        seeds: Of the greenhouses.
    """
    table = Table(title="In the model's own loop")
    for column in ("greenhouse", "who decides", "days", "plants alive", "litres poured", "litres for each alive"):
        table.add_column(column, justify="left" if column == "who decides" else "right")
    for seed in seeds:
        for title, team in teams.items():
            greenhouse = simulate(GreenhouseSim, team, seed=seed).greenhouse
            cells = (f"{greenhouse.day}", f"{greenhouse.alive}", f"{greenhouse.water_use:.0f}")
            each = f"{greenhouse.water_use / greenhouse.alive:.0f}" if greenhouse.alive else ""
            table.add_row(str(seed), title, *cells, each)
        table.add_section()
    return table


def main(arguments: Sequence[str] | None = None) -> None:
    """Show what policies do."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policies", nargs="+", type=Path, metavar="FILE", help=f"what a run has left, in {RUNS}")
    parser.add_argument("--greenhouses", type=int, default=4, help="how many of the held-out ones (default: 4)")
    options = parser.parse_args(arguments)
    teams: dict[str, Team] = {"the rules": {}}
    teams |= [load(path) for path in options.policies]
    Console().print(compare(teams, FINAL[: options.greenhouses]))


if __name__ == "__main__":
    main()
