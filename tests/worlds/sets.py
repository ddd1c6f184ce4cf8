"""Walks over sets of strings, in a module that new processes import quickly."""

import os
import random

import numpy as np
from gymnasium import spaces

from simenv_marl import make_step

NAMES = ("ant", "bee", "cat", "dog")


class Walk:
    """A walk in the order of its names."""

    names = NAMES

    def reset(self, seed=None):
        self.random = random.Random(seed)
        self.place = 0.0
        self.notes = []

    def run(self):
        for number, name in enumerate(self.names):
            self.place += self.choose() + self.random.uniform(-0.5, 0.5)
            self.place += number * (name == "ant")

    def choose(self):
        return self.random.choice([-1, 0, 1])


class Unordered(Walk):
    names = frozenset(NAMES)


class Noted(Walk):
    """It only notes the order of a set."""

    def run(self):
        super().run()
        self.notes = [*{*NAMES}]


class Hashed(Walk):
    def choose(self):
        return hash("walker") % 1000


class Ordered(Walk):
    """It sorts a set, and holds values that differ in each process."""

    names = sorted({*NAMES})

    def run(self):
        super().run()
        self.notes = [{*NAMES}, os.getpid()]


def points(simulation, **changes):
    """The one decision point of a walk."""
    given = {
        "observation_space": spaces.Box(-1e9, 1e9, (1,), np.float64),
        "observation_space_mapping": lambda walk: [walk.place],
        "action_space": spaces.Discrete(3),
        "action_space_mapping": lambda action: action - 1,
        "reward_mapping": lambda walk: -abs(walk.place),
        "agent": "walker_0",
    }
    return {simulation.choose: make_step(**given | changes)}
