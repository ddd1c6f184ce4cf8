"""The paper's matrix of experiments: waterers, over numbers of plants, climates and plugins.

``python -m studies.greenhouse_matrix.matrix`` (or ``make matrix``) trains waterers. They, the
model's rule and a planner then run the same greenhouses in every combination of the factors, which
are those of ``variants.greenhouse``. A folder keeps the runs, so that a second call runs only what
is missing. The table of all runs gives the figures of ``docs/greenhouse-matrix.md``.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from examples.greenhouse_coop.env import MOST_WATER, WATERER
from examples.greenhouse_coop.plan import days_left
from examples.greenhouse_coop.train import HELD_OUT, Constant, Linear, Team, learn
from numpy.typing import NDArray

from simenv_marl import RULE, evaluate
from simenv_marl.experiments import design, run_experiment
from simenv_marl.planning import RolloutPolicy

from .variants import CLIMATES, EXCHANGES, House, greenhouse

OUT: Final = Path(__file__).parent / "out"
"""The folder of results; it is not under version control."""

Levels = Mapping[str, Sequence[Any]]
"""The levels of each factor."""

FACTORS: Final[Levels] = {
    "plants": (100, 200, 400),
    "climate": tuple(CLIMATES),
    "exchange": tuple(EXCHANGES),
}

HOME: Final = {"plants": 200, "climate": "mild", "exchange": "fixed"}
"""The row of the paper's greenhouse, as in its code."""

SCHOOLS: Final[Mapping[str, Levels]] = {
    "learned at home": {name: (level,) for name, level in HOME.items()},
    "learned all over": FACTORS,
}
"""The training sets: the paper's greenhouse alone, or the greenhouses of all rows."""

FIRST: Final = {WATERER: Constant(0.06)}
"""The initial policy: sixty litres a day."""

GENERATIONS: Final = 30


# -- learning -------------------------------------------------------------------------------------


def train(school: Levels, generations: int, seed: int, workers: int) -> Linear:
    """Train a waterer by evolution (CMA-ES).

    Args:
        school: The levels of each factor to train on. All candidates of a generation get the same
            greenhouses.
        generations: The number of generations.
        seed: The seed of the training.
        workers: The number of processes.
    """
    rows = rows_of(school).to_dict("records")

    def rate(teams: Sequence[Team], seeds: Iterable[int]) -> NDArray[np.float64]:
        contenders = {str(number): team for number, team in enumerate(teams)}
        played = [
            evaluate(
                greenhouse(**rows[seed % len(rows)]), contenders, seeds=[seed], workers=workers
            ).values()
            for seed in seeds
        ]
        returns: NDArray[np.float64] = np.mean(played, axis=(0, 1))
        return returns

    return learn(rate, FIRST, generations, np.random.default_rng(seed))[WATERER]


def learned(folder: Path, learners: int, generations: int, workers: int) -> dict[str, Linear]:
    """Train the waterers, or load those trained before.

    Args:
        folder: The folder of their weights.
        learners: The number of learners per training set.
        generations: The number of generations.
        workers: The number of processes.
    """
    found = {}
    for name, school in SCHOOLS.items():
        for number in range(1, learners + 1):
            path = folder / f"{name} {number}.json".replace(" ", "-")
            if not path.exists():
                began = time.monotonic()
                weights = train(school, generations, number, workers).weights.tolist()
                print(
                    f"{name} {number}: {generations} generations, {time.monotonic() - began:.0f} s",
                    flush=True,
                )
                path.write_text(json.dumps(weights), encoding="utf-8")
            found[f"{name} {number}"] = Linear(
                np.array(json.loads(path.read_text(encoding="utf-8")))
            )
    return found


# -- planning -------------------------------------------------------------------------------------

PORTIONS: Final = tuple(tenths / 10 for tenths in range(7))
"""The litres per pot that ``PortionPlanner`` tries out."""


@dataclass(frozen=True)
class PortionPlanner:
    """A waterer that plans for any number of pots: portions per pot, for one day, in one future.

    The terminal value after that day is ``days_left``, so the portion itself is the only decision
    in a branch.

    Attributes:
        portions: The portions to try out, in litres per pot.
        base: The policy that pours where this planner is the base of another one.
    """

    portions: tuple[float, ...] = PORTIONS
    base: Any = RULE

    def __call__(self, observation: Any, info: Any, *, _environment: Any) -> Any:
        """Choose an action."""
        pots = len(_environment.simulation.greenhouse.pots)
        actions = [np.array([portion * pots / MOST_WATER], np.float32) for portion in self.portions]
        planner = RolloutPolicy(
            actions, base=self.base, futures=1, horizon=1, terminal_value=days_left
        )
        return planner(observation, info, _environment=_environment)


# -- the matrix -----------------------------------------------------------------------------------


def share_alive(simulation: House) -> float:
    """Compute the share of plants alive at the end."""
    return simulation.greenhouse.alive / simulation.plants


def litres_a_pot(simulation: House) -> float:
    """Compute the mean litres per pot and day."""
    kept = simulation.greenhouse
    return kept.water_use / simulation.plants / kept.day


def rows_of(levels: Levels) -> Any:
    """Make a table of all combinations of the levels of the factors."""
    return design({name: list(own) for name, own in levels.items()})


def run(folder: Path, levels: Levels, waterers: Mapping[str, Any], seeds: int, workers: int) -> Any:
    """Run the missing runs of the matrix.

    Args:
        folder: The folder that keeps the runs.
        levels: The levels of each factor.
        waterers: The policies to compare with the rule, by name.
        seeds: The number of greenhouses in each row.
        workers: The number of processes.

    Returns:
        The table of all runs.
    """
    return run_experiment(
        greenhouse,
        rows_of(levels),
        contenders={name: {WATERER: policy} for name, policy in waterers.items()},
        seeds=range(HELD_OUT, HELD_OUT + seeds),
        metric={"alive": share_alive, "litres": litres_a_pot},
        store=folder,
        workers=workers,
        progress=True,
    )


def main(arguments: Sequence[str] | None = None) -> Any:
    """Run the matrix, and show the results.

    Returns:
        The table of all runs.
    """
    parser = argparse.ArgumentParser(description="Which policies water best, and where?")
    parser.add_argument(
        "--seeds", type=int, default=8, help="greenhouses in each row (default: %(default)s)"
    )
    parser.add_argument(
        "--learners", type=int, default=5, help="learners per training set (default: %(default)s)"
    )
    parser.add_argument(
        "--generations", type=int, default=GENERATIONS, help="of learning (default: %(default)s)"
    )
    parser.add_argument("--workers", type=int, default=2, help="processes (default: %(default)s)")
    parser.add_argument(
        "--out", type=Path, default=OUT, help="folder for results (default: %(default)s)"
    )
    parser.add_argument(
        "--figures", type=Path, help="folder for figures and tables (default: the same)"
    )
    parser.add_argument(
        "--quick", action="store_true", help="a small run, to check that everything works"
    )
    if parser.parse_args(arguments).quick:
        parser.set_defaults(seeds=2, learners=1, generations=2, out=OUT / "quick")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    waterers = learned(options.out, options.learners, options.generations, options.workers)
    factors = {name: levels[:2] for name, levels in FACTORS.items()} if options.quick else FACTORS
    contenders = {
        **waterers,
        "planned": PortionPlanner(PORTIONS[::3]) if options.quick else PortionPlanner(),
    }
    table = run(options.out / "runs", factors, contenders, options.seeds, options.workers)

    # imported here, so that forked processes do not load the plotting libraries
    from . import figures

    figures.show(table, options.figures or options.out)
    return table


if __name__ == "__main__":
    main()
