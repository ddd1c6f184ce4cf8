"""A model with two decisions a day, for policies that are slow, fail or read."""

import random

import numpy as np
from gymnasium import spaces

from simenv_marl import make_step

LEVEL = spaces.Box(-50, 50, (1,), np.float32)


class Tank:
    """Water flows in and out; some of it evaporates by chance."""

    days = 5

    def reset(self, seed=None):
        self.chance, self.level, self.day, self.log = random.Random(seed), 5.0, 0, []

    def reseed(self, seed):
        self.chance.seed(seed)

    def time(self):
        return float(self.day)

    def run(self):
        for day in range(self.days):
            self.day = day
            self.level += self.fill()
            self.level -= self.drain() + self.chance.random()
            self.log.append(self.level)

    def fill(self):
        """Choose how much water flows in."""
        return 1.0

    def drain(self):
        return 0.5


def definition(decisions, **more):
    """Define a decision among some numbers, rewarded by the level."""
    return make_step(
        **{
            "observation_space": LEVEL,
            "observation_space_mapping": lambda tank: [tank.level],
            "action_space": spaces.Discrete(len(decisions)),
            "action_space_mapping": dict(enumerate(decisions)),
            "reward_mapping": lambda tank: tank.level,
        }
        | more
    )


FILL = definition(
    [0.0, 1.0, 2.0], agent="filler", action_labels=["closed", "half", "open"], observation_labels=["level"]
)
DRAIN = definition([0.5, 1.5], agent="drainer")
POINTS = {Tank.fill: FILL, Tank.drain: DRAIN}


def level_of(tank):
    """Return what happened in an episode."""
    return tuple(tank.log)
