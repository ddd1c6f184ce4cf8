"""A simulation in a module of its own, whose environments are copied and pickled."""

import random

import numpy as np
from gymnasium import spaces

from simenv_marl import generate_env, make_step


def observe(walk):
    return [walk.place]


def reward(walk):
    return -abs(walk.place)


def to_step(action):
    return action - 1


def define(**changes):
    given = {
        "observation_space": spaces.Box(-100, 100, (1,), np.float32),
        "observation_space_mapping": observe,
        "action_space": spaces.Discrete(3),
        "action_space_mapping": to_step,
        "reward_mapping": reward,
    }
    return make_step(**given | changes)


class Walk:
    """A walk that decides where to go."""

    def __init__(self, length=5):
        self.length = length

    def reset(self, seed=None):
        self.random = random.Random(seed)
        self.place, self.steps = 0.0, []
        self.held = (step for step in self.steps)  # which cannot be pickled

    def run(self):
        for _ in range(self.length):
            self.steps.append(self.choose())
            self.place += self.steps[-1] + self.drift() + self.random.random()

    @define(agent="walker_0")
    def choose(self):
        return self.random.choice([-1, 1])

    def drift(self):
        return 0.0


def blow(walk):
    return 0.25


WalkEnv = generate_env(Walk, Walk.choose)
WalkEnv.__qualname__ = WalkEnv.__name__ = "WalkEnv"
