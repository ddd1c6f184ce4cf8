"""Run trained policies in the model's own loop.

``python -m studies.greenhouse_experiment.back_in_the_model FILE ...`` loads policies that the
libraries' scripts have saved, and lets ``simenv_marl.simulate`` run the greenhouse with them, and
once with its rules. There is no environment and no stepping: the simulation runs its own loop, and
the results are plants and litres, not rewards.

    ``sb3-3-0.zip``      stable-baselines3
    ``torchrl-4a-0.pt``  TorchRL
    ``rllib-4a-0``       RLlib (a folder)

Each policy needs the library that made it, and no other learning library. RLlib is installed in a
virtual environment of its own, so run its policies with that environment's Python.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Final

from examples.greenhouse_coop.env import GreenhouseSim
from examples.greenhouse_coop.train import Team
from rich.console import Console
from rich.table import Table

from simenv_marl import simulate

from .questions import FINAL, QUESTIONS
from .runs import RUNS, Run

LIBRARIES: Final = {"sb3": "stable-baselines3", "torchrl": "torchrl", "rllib": "ray[rllib]"}
"""The distribution that each library's policies need."""


def load(path: Path) -> tuple[str, Team]:
    """Load a policy.

    Args:
        path: The policy that a script saved for a run: ``LIBRARY-QUESTION-SEED``, with or without a
            suffix.

    Returns:
        The title of the policy, and the team.
    """
    library, _, rest = path.stem.partition("-")
    question, _, seed = rest.partition("-")
    if library not in LIBRARIES or question not in QUESTIONS or not seed.isdecimal():
        raise SystemExit(
            f"{path} is not named LIBRARY-QUESTION-SEED as policies are, for instance sb3-3-0.zip"
        )
    if not path.exists():
        raise SystemExit(f"{path} does not exist; python -m {__package__}.{library} trains it")
    try:
        script = import_module(f"{__package__}.{library}")
    except ModuleNotFoundError as missing:
        raise SystemExit(
            f"{path.name} needs {LIBRARIES[library]}, which is not installed here ({missing}): use"
            " the Python of another virtual environment"
        ) from missing
    team = script.load(Run(library, question, int(seed), 0, path.parent))
    return f"{path.stem}: {QUESTIONS[question].title}", team


def compare(teams: dict[str, Team], seeds: Sequence[int]) -> Table:
    """Run the same greenhouses with each team, one simulation after another.

    Args:
        teams: The teams by title. Agents without a policy follow their rule.
        seeds: The seeds of the greenhouses.
    """
    table = Table(title="In the model's own loop")
    for column in (
        "greenhouse",
        "who decides",
        "days",
        "plants alive",
        "litres poured",
        "litres for each alive",
    ):
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
    """Run the policies, and print a table of the results."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "policies", nargs="+", type=Path, metavar="FILE", help=f"policies of runs, from {RUNS}"
    )
    parser.add_argument(
        "--greenhouses", type=int, default=4, help="number of held-out greenhouses (default: 4)"
    )
    options = parser.parse_args(arguments)
    teams: dict[str, Team] = {"the rules": {}}
    teams |= [load(path) for path in options.policies]
    Console().print(compare(teams, FINAL[: options.greenhouses]))


if __name__ == "__main__":
    main()
