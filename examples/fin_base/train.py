"""Train policies of the pension fund: for the asset mix, and for the indexation of pensions.

``python -m examples.fin_base.train`` trains the pair by evolution (CMA-ES) in small funds, and
compares it with the model's rules in funds that it has not been trained on, by the members'
welfare. It takes some minutes.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from math import exp, log
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from simenv_marl import evaluate

from ..evolution import evolve
from .env import OBSERVED, TEAM, FundSim
from .pension import Parameters

HELD_OUT: Final = 1_000_000
"""Seeds from this number on are for comparisons; those below it are for learning."""

USUAL: Final = np.array(
    [1.2, 1.2, 1.0, 0.4, 0.25, 0.2, 0.9, 0.45, 0.4, 0.5, 0.1, 0.22, 0.15], np.float32
)
"""Typical values of the observations of the company and of a client."""

SPREAD: Final = np.array(
    [0.3, 0.3, 3.0, 0.2, 0.15, 0.15, 0.2, 0.12, 0.15, 0.3, 0.2, 0.1, 0.1], np.float32
)
"""The typical spread of each observation around ``USUAL``."""

Policies = Mapping[str, Any]
"""Policies by agent or decision point; the model's rules decide for all others."""


def nearest_lawful(level: int, mask: NDArray[np.int8]) -> int:
    """Find the lawful level nearest to another one; of two, the lower one."""
    lawful = np.flatnonzero(mask)
    return int(lawful[np.argmin(abs(lawful - level))])


@dataclass(frozen=True)
class Linear:
    """A linear policy: the logistic function of a weighted sum of the observations is the level."""

    weights: tuple[float, ...]  # one for each observed number, in units of SPREAD, then a constant

    @classmethod
    def start(cls, share: float, observed: int) -> Linear:
        """Make a policy that always chooses a level, from 0 for the lowest to 1 for the highest."""
        return cls((0.0,) * observed + (log(share / (1 - share)),))

    def share(self, observation: NDArray[np.float32]) -> float:
        """Compute the wanted level, from 0 for the lowest to 1 for the highest."""
        *weights, constant = self.weights
        observed = len(weights)
        total = (
            float(np.dot((observation - USUAL[:observed]) / SPREAD[:observed], weights)) + constant
        )
        return 1 / (1 + exp(-min(max(total, -50.0), 50.0)))

    def __call__(self, observation: NDArray[np.float32], info: Mapping[str, Any]) -> int:
        """Choose a level."""
        mask = info["action_mask"]
        return nearest_lawful(round(self.share(observation) * (len(mask) - 1)), mask)


PAIR: Final = {
    "manager_0": Linear.start(0.75, len(OBSERVED)),
    "indexer_0": Linear.start(0.9, len(OBSERVED)),
}
"""The pair before any training."""

Rate = Callable[[Iterable[Policies], Iterable[int]], NDArray[np.float64]]


def rate(
    world: Any, points: Any, workers: int, contenders: Iterable[Policies], seeds: Iterable[int]
) -> Any:
    """Compute the mean welfare of several policies of some decision points, on the same seeds."""
    named = {str(number): policies for number, policies in enumerate(contenders)}
    found = evaluate(
        world, named, seeds=seeds, points=points, metric=FundSim.welfare, workers=workers
    )
    return found.values("metric").mean().to_numpy()


def train(
    start: Mapping[str, Linear], rate: Rate, generations: int, seed: int
) -> dict[str, Linear]:
    """Train policies jointly, by evolution of their weights, from those at the start."""
    sizes = np.cumsum([len(policy.weights) for policy in start.values()])[:-1]

    def team(weights: NDArray[np.float64]) -> dict[str, Linear]:
        return {
            name: Linear(tuple(own.tolist()))
            for name, own in zip(start, np.split(weights, sizes), strict=True)
        }

    def rated(candidates: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
        return rate(map(team, candidates), rng.integers(HELD_OUT, size=8).tolist())

    rng = np.random.default_rng(seed)
    first = np.concatenate([policy.weights for policy in start.values()])
    return team(evolve(rated, first, generations, rng, population=14))


def main(arguments: Sequence[str] | None = None) -> None:
    """Train the pair, and print how it compares with the model's rules."""
    parser = argparse.ArgumentParser(
        description="Train policies for the asset mix and the indexation of pensions."
    )
    parser.add_argument(
        "--clients", type=int, default=200, help="initial number of clients (default: 200)"
    )
    parser.add_argument("--years", type=int, default=20, help="years of an episode (default: 20)")
    parser.add_argument(
        "--generations", type=int, default=24, help="generations of learning (default: 24)"
    )
    parser.add_argument(
        "--seeds", type=int, default=32, help="funds for the comparison (default: 32)"
    )
    parser.add_argument("--workers", type=int, default=2, help="processes (default: 2)")
    options = parser.parse_args(arguments)
    world = partial(FundSim, options.years, Parameters(clients=options.clients))
    pair = train(PAIR, partial(rate, world, TEAM, options.workers), options.generations, seed=1)
    found = evaluate(
        world,
        {"rule": {}, "trained pair": pair},
        seeds=range(HELD_OUT, HELD_OUT + options.seeds),
        points=TEAM,
        metric=FundSim.welfare,
        baseline="rule",
        workers=options.workers,
    )
    print(found.summary("metric").round(1).to_string())


if __name__ == "__main__":
    main()
