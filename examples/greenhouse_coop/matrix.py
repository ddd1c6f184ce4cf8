"""The paper's own matrix: who waters, and what becomes of that with other numbers of plants, climates and plugins.

``python -m examples.greenhouse_coop.matrix`` (or ``make matrix``) trains waterers, and has them, the model's rule and a
planner keep the same greenhouses in every combination of the factors, which are those of ``variants.greenhouse``. What
has been run is in a folder, and is not run again. From the table of all runs come the figures of
``docs/greenhouse-matrix.md``.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from simenv_marl import design, evaluate, run_experiment

from .plan import HELD_OUT, WATERER, PortionPlanner
from .train import OUT, Constant, Linear, Team, learn
from .variants import CLIMATES, EXCHANGES, House, greenhouse

Levels = Mapping[str, Sequence[Any]]
"""Of each factor."""

FACTORS: Final[Levels] = {
    "plants": (100, 200, 400),
    "climate": tuple(CLIMATES),
    "exchange": tuple(EXCHANGES),
}

HOME: Final = {"plants": 200, "climate": "mild", "exchange": "fixed"}
"""The row that is the paper's greenhouse, as its code has it."""

SCHOOLS: Final[Mapping[str, Levels]] = {
    "learned at home": {name: (level,) for name, level in HOME.items()},
    "learned all over": FACTORS,
}
"""Where is learned: in the paper's greenhouse alone, and in those of all rows."""

FIRST: Final = {WATERER: Constant(0.06)}
"""Where learning begins: with sixty litres a day."""

GENERATIONS: Final = 30


# -- learning -------------------------------------------------------------------------------------


def train(school: Levels, generations: int, seed: int, workers: int) -> Linear:
    """Train a waterer by evolution (CMA-ES).

    Args:
        school: The levels of each factor that it learns in. All candidates of a generation meet the same greenhouses.
        generations: For how long.
        seed: Determines everything.
        workers: How many processes play.
    """
    rows = rows_of(school).to_dict("records")

    def rate(teams: Sequence[Team], seeds: Iterable[int]) -> NDArray[np.float64]:
        contenders = {str(number): team for number, team in enumerate(teams)}
        played = [
            evaluate(greenhouse(**rows[seed % len(rows)]), contenders, seeds=[seed], workers=workers).values()
            for seed in seeds
        ]
        returns: NDArray[np.float64] = np.mean(played, axis=(0, 1))
        return returns

    return learn(rate, FIRST, generations, np.random.default_rng(seed))[WATERER]


def learned(folder: Path, learners: int, generations: int, workers: int) -> dict[str, Linear]:
    """Train the waterers, or load those that were trained before.

    Args:
        folder: Where their weights are kept.
        learners: How many of each school.
        generations: For how long they learn.
        workers: How many processes play.
    """
    found = {}
    for name, school in SCHOOLS.items():
        for number in range(1, learners + 1):
            path = folder / f"{name} {number}.json".replace(" ", "-")
            if not path.exists():
                began = time.monotonic()
                weights = train(school, generations, number, workers).weights.tolist()
                print(f"{name} {number}: {generations} generations, {time.monotonic() - began:.0f} s", flush=True)
                path.write_text(json.dumps(weights), encoding="utf-8")
            found[f"{name} {number}"] = Linear(np.array(json.loads(path.read_text(encoding="utf-8"))))
    return found


# -- the matrix -----------------------------------------------------------------------------------


def share_alive(simulation: House) -> float:
    """Which share of the plants is alive in the end."""
    return simulation.greenhouse.alive / simulation.plants


def litres_a_pot(simulation: House) -> float:
    """How much was poured into each pot, on average, in a day."""
    kept = simulation.greenhouse
    return kept.water_use / simulation.plants / kept.day


def rows_of(levels: Levels) -> Any:
    """Each combination of the levels of the factors."""
    return design({name: list(own) for name, own in levels.items()})


def run(folder: Path, levels: Levels, waterers: Mapping[str, Any], seeds: int, workers: int) -> Any:
    """Run what is missing of the matrix.

    Args:
        folder: Where all of it is kept.
        levels: Those of each factor.
        waterers: Who waters, beside the rule.
        seeds: How many greenhouses are kept in each row.
        workers: How many processes share the work.

    Returns:
        The table of all runs.
    """
    return run_experiment(
        greenhouse,
        rows_of(levels),
        policies={name: {WATERER: policy} for name, policy in waterers.items()},
        seeds=range(HELD_OUT, HELD_OUT + seeds),
        metric={"alive": share_alive, "litres": litres_a_pot},
        store=folder,
        workers=workers,
        progress=True,
    )


def main(arguments: Sequence[str] | None = None) -> Any:
    """Run the matrix, and show what came of it.

    Returns:
        The table of all runs.
    """
    parser = argparse.ArgumentParser(description="Who waters best, and where?")
    parser.add_argument("--seeds", type=int, default=8, help="greenhouses in each row (default: %(default)s)")
    parser.add_argument("--learners", type=int, default=5, help="of each school (default: %(default)s)")
    parser.add_argument("--generations", type=int, default=GENERATIONS, help="of learning (default: %(default)s)")
    parser.add_argument("--workers", type=int, default=2, help="processes (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=OUT / "matrix", help="folder for all of it (default: %(default)s)")
    parser.add_argument("--figures", type=Path, help="folder for pictures and tables (default: the same)")
    parser.add_argument("--quick", action="store_true", help="little of everything, to see that it works")
    if parser.parse_args(arguments).quick:
        parser.set_defaults(seeds=2, learners=1, generations=2, out=OUT / "matrix-quick")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    waterers = learned(options.out, options.learners, options.generations, options.workers)
    factors = {name: levels[:2] for name, levels in FACTORS.items()} if options.quick else FACTORS
    contenders = {**waterers, "planned": PortionPlanner()}
    table = run(options.out / "runs", factors, contenders, options.seeds, options.workers)

    from . import matrix_figures  # here, for no process that forks is to carry what draws

    matrix_figures.show(table, options.figures or options.out)
    return table


if __name__ == "__main__":
    main()
