"""A study: how much profit a better policy brings the agency of ``model``.

The policy has four parameters and looks at one case at a time. It can decide on all cases as one
agent, or be shared by the agents of all debtors. CMA-ES finds the parameters. ``main`` compares the
policy with the rule, with constant policies, and with policies that take over one parameter each,
on seeds that the search does not use. The utility is that of ``model``::

    python -m studies.debt_collection.study
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, replace
from typing import Any, Final

import numpy as np
from examples.evolution import evolve
from numpy.typing import NDArray

from simenv_marl import evaluate, simulate
from simenv_marl.experiments import Evaluation

from .env import COLLECTOR, DAYS, CollectionSim, lawful
from .model import HALF_LIFE

HELD_OUT: Final = 2_000_000
"""Seeds from this number on are for comparisons; those below it are for learning."""


def prefer(*wanted: str) -> Any:
    """Make a policy that always takes the first lawful one of the wanted choices."""

    def policy(observation: Any) -> int:
        choices = lawful(observation)
        return choices.index(next(choice for choice in (*wanted, "leave") if choice in choices))

    return policy


@dataclass(frozen=True)
class Thresholds:
    """A threshold policy: it calls about debts of enough worth.

    The worth is the amount, halved per ``HALF_LIFE`` of age.

    Attributes:
        letters: The number of letters after which it sends no more.
        attempts: The number of calls after which it makes no more.
        call: The lowest worth for which it calls, in hundreds of dollars.
        sue: The lowest amount for which it sues when no other choice is left, in hundreds of
            dollars.
    """

    letters: float = 2.0
    attempts: float = 6.0
    call: float = 1.0
    sue: float = 5.0

    def __call__(self, observation: Any, info: Any = None) -> int:
        """Choose the first of call, letter and lawsuit that is worth it and lawful.

        Else leave the case alone.
        """
        owed, age, _, letters, attempts = (float(number) for number in observation[:5])
        worth = 10 * owed * 0.5 ** (365 * age / HALF_LIFE)
        wanted = {
            "call": worth >= self.call and attempts < self.attempts,
            "write": letters < self.letters,
            "sue": 10 * owed >= self.sue,
        }
        return int(prefer(*(choice for choice, wish in wanted.items() if wish))(observation))


LEARNED: Final = Thresholds(letters=7.63, attempts=20.0, call=1.35, sue=8.4)
"""The rounded result of ``main`` with its default options."""


def rate(policy: Any, seeds: Sequence[int], simulation: Any = CollectionSim) -> float:
    """Compute a policy's mean profit over seeds, in hundreds of dollars."""
    runs = (
        simulate(simulation, {"collector_0": policy}, points=COLLECTOR, seed=seed) for seed in seeds
    )
    return float(np.mean([run.agency.profit / 100_00 for run in runs]))


def learn(
    generations: int, seed: int = 0, *, episodes: int = 4, simulation: Any = CollectionSim
) -> Thresholds:
    """Find thresholds by CMA-ES, which searches their logarithms.

    Args:
        generations: The number of generations.
        seed: The seed of the search.
        episodes: The number of seeds on which each candidate is rated; all candidates of a
            generation share them.
        simulation: The simulation's class.

    Returns:
        The best policy found.
    """
    draw = np.random.default_rng(seed)

    def rated(points: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
        seeds = draw.integers(HELD_OUT, size=episodes).tolist()
        return np.array([rate(Thresholds(*np.exp(point)), seeds, simulation) for point in points])

    first = np.log(astuple(Thresholds()))
    return Thresholds(
        *np.exp(evolve(rated, first, generations, draw, population=8, spread=0.5)).tolist()
    )


CONSTANTS: Final = {
    "leave": prefer(),
    "write": prefer("write"),
    "call, write": prefer("call", "write"),
    "sue, write": prefer("sue", "write"),
}
"""Policies that ignore the case: they take their first wanted choice that is lawful."""


def compare(
    policies: Mapping[str, Any], seeds: Sequence[int], simulation: Any = CollectionSim
) -> Evaluation:
    """Compare policies with the rule on the same seeds.

    Returns are profits in hundreds of dollars.
    """
    contenders: dict[str, Any] = {"rule": {}}
    contenders |= {name: {"collector_0": policy} for name, policy in policies.items()}
    return evaluate(simulation, contenders, seeds=seeds, points=COLLECTOR, baseline="rule")


def main(arguments: Sequence[str] | None = None) -> None:
    """Learn a policy, compare it, and print the table."""
    parser = argparse.ArgumentParser(
        description="Learn whom to write to, call or sue, and compare."
    )
    parser.add_argument(
        "--generations", type=int, default=15, help="generations of the search (default: 15)"
    )
    parser.add_argument(
        "--seeds", type=int, default=32, help="number of seeds for the comparison (default: 32)"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the search (default: 0)")
    parser.add_argument(
        "--days", type=int, default=DAYS, help="length of an episode (default: %(default)s)"
    )
    options = parser.parse_args(arguments)
    simulation = CollectionSim(options.days)
    learned = learn(options.generations, options.seed, simulation=simulation)
    print(learned)
    start = Thresholds()
    mixed = {
        f"start, {name}": replace(start, **{name: value}) for name, value in asdict(learned).items()
    }
    policies = {"learned": learned, **CONSTANTS, "start": start, **mixed}
    result = compare(policies, range(HELD_OUT, HELD_OUT + options.seeds), simulation)
    print(result.summary().round(1).to_string())


if __name__ == "__main__":
    main()
