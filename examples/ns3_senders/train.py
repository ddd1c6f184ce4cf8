"""Train one shared policy for all senders, and compare it with the model's rule.

``python -m examples.ns3_senders.train`` compiles the model, trains a linear policy by evolution
(CMA-ES), and compares it with the model's rule on held-out seeds. It takes a few minutes on two
cores.

The same options give the same result, with any number of processes.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from simenv_marl import evaluate
from simenv_marl.experiments import Evaluation

from ..evolution import evolve
from .env import OBSERVED, POINTS, program, senders

POINT: Final = next(iter(POINTS))

GENERATIONS, POPULATION, EPISODES_EACH = 20, 10, 8

HELD_OUT: Final = 1_000_000
"""Seeds from this number on are for the final comparison; those below it are for learning."""


@dataclass(frozen=True)
class Linear:
    """A linear policy: the action is the hyperbolic tangent of a weighted sum of the observation.

    Attributes:
        weights: One weight for each number of the observation, then a constant.
    """

    weights: tuple[float, ...]

    def __call__(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Choose an action."""
        *each, alone = self.weights
        return np.array([math.tanh(np.dot(observation, each) + alone)], np.float32)


def compare(
    contenders: dict[str, dict[str, Linear]], seeds: Any, workers: int, baseline: str | None = None
) -> Evaluation:
    """Compare policies on the same seeds."""
    metrics = {
        name: lambda simulation, name=name: simulation.result[name]
        for name in ("megabits", "queueing")
    }
    return evaluate(
        senders, contenders, seeds=seeds, metric=metrics, workers=workers, baseline=baseline
    )


def learn(generations: int, workers: int, seed: int = 0, episodes: int = EPISODES_EACH) -> Linear:
    """Train a policy.

    Args:
        generations: The number of generations.
        workers: The number of processes.
        seed: The seed of the training.
        episodes: The number of episodes per candidate.
    """
    rng = np.random.default_rng(seed)

    def rate(candidates: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
        seeds = rng.integers(HELD_OUT, size=episodes).tolist()
        contenders = {
            str(number): {POINT: Linear(tuple(each))} for number, each in enumerate(candidates)
        }
        returns: NDArray[np.float64] = (
            compare(contenders, seeds, workers).values().mean().to_numpy()
        )
        print(f"this generation: {returns.mean():.1f}, the best {returns.max():.1f}", flush=True)
        return returns

    return Linear(
        tuple(evolve(rate, np.zeros(len(OBSERVED) + 1), generations, rng, POPULATION).tolist())
    )


def main() -> None:
    """Train a policy, and print the comparison."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--generations", type=int, default=GENERATIONS, help="generations of training (%(default)s)"
    )
    parser.add_argument(
        "--seeds", type=int, default=64, help="seeds for the comparison (%(default)s)"
    )
    parser.add_argument("--workers", type=int, default=2, help="number of processes (%(default)s)")
    arguments = parser.parse_args()
    program()
    policy = learn(arguments.generations, arguments.workers)
    print(dict(zip((*OBSERVED, "alone"), np.round(policy.weights, 2).tolist(), strict=True)))
    seeds = range(HELD_OUT, HELD_OUT + arguments.seeds)
    found = compare(
        {"rule": {}, "trained": {POINT: policy}}, seeds, arguments.workers, baseline="rule"
    )
    for of in ("return", "megabits", "queueing"):
        print(f"\n{of}:\n{found.summary(of).round(3).to_string()}")


if __name__ == "__main__":
    main()
