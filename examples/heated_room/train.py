"""Train the heater by evolution (CMA-ES), and compare it with the thermostat on held-out seeds.

``python -m examples.heated_room.train`` takes half a minute.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import cos, pi, sin, tanh
from typing import Final

import numpy as np
from numpy.typing import NDArray

from simenv_marl import evaluate

from ..evolution import evolve
from .env import COMFORT, RoomSim

HELD_OUT: Final = 1_000_000


@dataclass(frozen=True)
class Linear:
    """A policy: the power grows with a weighted sum of warmth, outside temperature, time of day."""

    weights: Sequence[float]

    def __call__(
        self, observation: Mapping[str, NDArray[np.float64]]
    ) -> dict[str, NDArray[np.float64]]:
        """Choose the power."""
        warm, outside, angle = (
            observation[name].item() for name in ("temperature", "outside", "hour")
        )
        angle *= pi / 12
        features = warm - COMFORT, outside / 10, sin(angle), cos(angle), cos(2 * angle), 1.0
        return {"power": np.array([1 + tanh(np.dot(self.weights, features))])}


def learn(generations: int, episodes: int = 4) -> Linear:
    """Train a policy."""
    rng = np.random.default_rng(0)

    def rate(candidates: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
        contenders = {
            str(number): {"heater_0": Linear(each.tolist())}
            for number, each in enumerate(candidates)
        }
        found = evaluate(RoomSim, contenders, seeds=rng.integers(HELD_OUT, size=episodes).tolist())
        return np.asarray(found.values().mean(), float)

    return Linear(evolve(rate, np.zeros(6), generations, rng, population=10).tolist())


def main(arguments: Sequence[str] | None = None) -> None:
    """Train a policy, and print the comparison."""
    parser = argparse.ArgumentParser(
        description="Train the heater of a room, and compare it with the thermostat."
    )
    parser.add_argument(
        "--generations", type=int, default=25, help="generations of training (default: %(default)s)"
    )
    parser.add_argument(
        "--seeds", type=int, default=50, help="seeds for the comparison (default: %(default)s)"
    )
    options = parser.parse_args(arguments)
    contenders = {"rule": {}, "trained": {"heater_0": learn(options.generations)}}
    print(
        evaluate(
            RoomSim, contenders, seeds=range(HELD_OUT, HELD_OUT + options.seeds), baseline="rule"
        )
    )


if __name__ == "__main__":
    main()
