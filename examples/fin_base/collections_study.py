"""What a better policy is worth to the agency of ``collections``.

The policy has four numbers and looks at one case. It can decide on all cases as one agent, or serve the agents of all
debtors. CMA-ES finds the numbers. ``main`` compares the policy with the rule, with constants, and with policies that
have one of the numbers, on seeds that the search does not use. The utility is that of ``collections``::

    python -m examples.fin_base.collections_study
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from simenv_marl import Evaluation, evaluate, simulate

from ..evolution import evolve
from .collections import HALF_LIFE
from .collections_env import COLLECTOR, CollectionSim, lawful

HELD_OUT: Final = 2_000_000
"""Seeds from here on are for comparisons. Those below it are to learn from."""


def prefer(*wanted: str) -> Any:
    """Make a policy that always takes the first of the wanted choices that is lawful."""

    def policy(observation: Any) -> int:
        choices = lawful(observation)
        return choices.index(next(choice for choice in (*wanted, "leave") if choice in choices))

    return policy


@dataclass(frozen=True)
class Thresholds:
    """A policy that calls about debts that are worth it: the worth is the amount, halved for each ``HALF_LIFE`` of age.

    Attributes:
        letters: It sends letters until so many are sent.
        attempts: It makes calls until so many are made.
        call: The lowest worth for which it calls, in hundreds of dollars.
        sue: The lowest amount for which it sues, in hundreds of dollars, when there is nothing else left to do.
    """

    letters: float = 2.0
    attempts: float = 6.0
    call: float = 1.0
    sue: float = 5.0

    def __call__(self, observation: Any, info: Any = None) -> int:
        """Choose the first of a call, a letter and a lawsuit that is worth it and lawful; else leave the case alone."""
        owed, age, _, letters, attempts = (float(number) for number in observation[:5])
        worth = 10 * owed * 0.5 ** (365 * age / HALF_LIFE)
        wanted = {
            "call": worth >= self.call and attempts < self.attempts,
            "write": letters < self.letters,
            "sue": 10 * owed >= self.sue,
        }
        return int(prefer(*(choice for choice, wish in wanted.items() if wish))(observation))


LEARNED: Final = Thresholds(letters=7.63, attempts=20.0, call=1.35, sue=8.4)
"""What ``main`` finds by default, rounded."""


def rate(policy: Any, seeds: Sequence[int], simulation: Any = CollectionSim) -> float:
    """The mean profit over seeds, in hundreds of dollars."""
    runs = (simulate(simulation, {"collector_0": policy}, points=COLLECTOR, seed=seed) for seed in seeds)
    return float(np.mean([run.agency.profit / 100_00 for run in runs]))


def learn(generations: int, seed: int = 0, *, episodes: int = 4, simulation: Any = CollectionSim) -> Thresholds:
    """Find thresholds by CMA-ES, in logarithms.

    Args:
        generations: For how long.
        seed: Of the search.
        episodes: On how many seeds each candidate is rated; the same for all candidates of a generation.
        simulation: What is simulated.

    Returns:
        The policy that was found.
    """
    draw = np.random.default_rng(seed)

    def rated(points: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
        seeds = draw.integers(HELD_OUT, size=episodes).tolist()
        return np.array([rate(Thresholds(*np.exp(point)), seeds, simulation) for point in points])

    first = np.log(astuple(Thresholds()))
    return Thresholds(*np.exp(evolve(rated, first, generations, draw, population=8, spread=0.5)).tolist())


CONSTANTS: Final = {
    "leave": prefer(),
    "write": prefer("write"),
    "call, write": prefer("call", "write"),
    "sue, write": prefer("sue", "write"),
}
"""Policies that take what is lawful, whatever the case."""


def compare(policies: Mapping[str, Any], seeds: Sequence[int], simulation: Any = CollectionSim) -> Evaluation:
    """Compare policies with the rule on the same seeds; returns are profits in hundreds of dollars."""
    contenders: dict[str, Any] = {"rule": {}}
    contenders |= {name: {"collector_0": policy} for name, policy in policies.items()}
    return evaluate(simulation, contenders, seeds=seeds, points=COLLECTOR, baseline="rule")


def main(arguments: Sequence[str] | None = None) -> None:
    """Learn, compare, and print the table."""
    parser = argparse.ArgumentParser(description="Learn whom to write to, call or sue, and compare.")
    parser.add_argument("--generations", type=int, default=15, help="of the search (default: 15)")
    parser.add_argument("--seeds", type=int, default=32, help="to compare on (default: 32)")
    parser.add_argument("--seed", type=int, default=0, help="of the search (default: 0)")
    options = parser.parse_args(arguments)
    learned = learn(options.generations, options.seed)
    print(learned)
    start = Thresholds()
    mixed = {f"start, {name}": replace(start, **{name: value}) for name, value in asdict(learned).items()}
    policies = {"learned": learned, **CONSTANTS, "start": start, **mixed}
    result = compare(policies, range(HELD_OUT, HELD_OUT + options.seeds))
    print(result.summary().round(1).to_string())


if __name__ == "__main__":
    main()
