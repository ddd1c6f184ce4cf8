"""A simulation in a module of its own, whose environments are copied and pickled."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
from gymnasium import spaces

from simenv_marl import Definition, generate_env, make_step


def observe(walk: Any) -> list[float]:
    return [walk.place]


def reward(walk: Any) -> float:
    return -abs(walk.place)


def to_step(action: int) -> int:
    return action - 1


def define(**changes: Any) -> Definition:
    given: dict[str, Any] = {
        "observation_space": spaces.Box(-100, 100, (1,), np.float32),
        "observation_space_mapping": observe,
        "action_space": spaces.Discrete(3),
        "action_space_mapping": to_step,
        "reward_mapping": reward,
    }
    return make_step(**given | changes)


class Walk:
    """A walk that decides where to go."""

    def __init__(self, length: int = 5) -> None:
        self.length = length

    def reset(self, seed: int | None = None) -> None:
        self.random = random.Random(seed)
        self.place, self.steps = 0.0, []
        self.held = (step for step in self.steps)  # which cannot be pickled

    def run(self) -> None:
        for _ in range(self.length):
            self.steps.append(self.choose())
            self.place += self.steps[-1] + self.drift() + self.random.random()

    @define(agent="walker_0")
    def choose(self) -> int:
        return self.random.choice([-1, 1])

    def drift(self) -> float:
        return 0.0


def blow(walk: Walk) -> float:
    return 0.25


WalkEnv = generate_env(Walk, Walk.choose)
WalkEnv.__qualname__ = WalkEnv.__name__ = "WalkEnv"
