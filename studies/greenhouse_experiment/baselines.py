"""Baselines for learning: the rule, random actions, the best constants, ``make demo``'s CMA-ES.

``python -m studies.greenhouse_experiment.baselines``

Searches and evolution are those of the module ``train``. They run once with the number of episodes
of ``make demo``, and once with the learners' budget, at a hundred days per episode.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
from examples.greenhouse_coop.env import VENTILATOR
from examples.greenhouse_coop.plan import BEST
from examples.greenhouse_coop.train import EXCHANGES, Constant, Team, compare, draw_seeds

from .questions import BEST_WATERING, CURVE, FINAL, Verdict, judge
from .runs import RUNS, each, write

LIBRARY: Final = "baselines"

TEAMS: Final = (
    "rule",
    "random actions",
    "constant watering",
    "constant pair",
    "CMA-ES, watering",
    "CMA-ES, both",
)
"""The teams that ``compare`` compares, in its order."""

BESIDE_CURVES: Final[dict[str, Team]] = {
    "rule": {},
    "constant watering": BEST_WATERING,
    "constant pair": BEST,
}
"""The baselines that are also evaluated on the greenhouses of the learning curves."""

SEARCHED_ON: Final = 8
"""The number of greenhouses on which constant ventilation is tried."""


def constant_ventilation(seed: int) -> Verdict:
    """Evaluate the best constant ventilation, the baseline of question 2: watering by the rule."""
    seeds = draw_seeds(np.random.default_rng(seed), SEARCHED_ON)
    teams: list[Team] = [{VENTILATOR: Constant(fraction)} for fraction in EXCHANGES]
    best = max(teams, key=lambda team: judge(team, seeds).value)
    return judge(best, FINAL)


def search(out: Path, job: tuple[int, int]) -> str:
    """Run a search, and write its results.

    Args:
        out: The folder of all runs.
        job: The number of episodes and the seed of the search.
    """
    episodes, seed = job
    path = out / f"{LIBRARY}-{episodes}-{seed}.json"
    if path.exists():
        return f"{path.name} is there already"
    outcomes, _ = compare(episodes, len(FINAL), seed, workers=1)
    found = {
        team: asdict(Verdict.of(played))
        for team, played in zip(TEAMS, outcomes.values(), strict=True)
    }
    found["constant ventilation"] = asdict(constant_ventilation(seed))
    titles = list(outcomes)
    constants = {"constant watering": titles[2], "constant pair": titles[3]}
    write(
        path,
        {
            "library": LIBRARY,
            "episodes": episodes,
            "seed": seed,
            "constants": constants,
            "teams": found,
        },
    )
    return f"{path.name}: CMA-ES pair {found['CMA-ES, both']['value']:.1f}"


def beside_curves(out: Path) -> None:
    """Evaluate the baselines without learning on the greenhouses of the learning curves.

    Args:
        out: The folder of all runs.
    """
    path = out / f"{LIBRARY}-curve.json"
    if not path.exists():
        found = {title: asdict(judge(team, CURVE)) for title, team in BESIDE_CURVES.items()}
        write(path, {"library": LIBRARY, "beside_curves": found})


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the missing searches."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--episodes", nargs="+", type=int, default=[600, 3600], help="default: 600 and 3600"
    )
    parser.add_argument(
        "--seeds",
        nargs="+",
        type=int,
        default=list(range(5)),
        metavar="SEED",
        help="default: 0 to 4",
    )
    parser.add_argument(
        "--workers",
        type=int,
        default=1,
        help="number of parallel searches, in processes (default: 1)",
    )
    parser.add_argument(
        "--out", type=Path, default=RUNS, help="folder for all runs (default: %(default)s)"
    )
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    beside_curves(options.out)
    jobs = [(episodes, seed) for episodes in options.episodes for seed in options.seeds]
    for said in each(partial(search, options.out), jobs, options.workers):
        print(said, flush=True)


if __name__ == "__main__":
    main()
