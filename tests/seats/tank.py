"""A model with two decisions a day, for policies that are slow, fail or read."""

import random
from dataclasses import replace

import numpy as np
from gymnasium import spaces

from simenv_marl import make_step, simulate, simulate_many
from simenv_marl.experiments import run_experiment


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


FILL = make_step(
    agent="filler",
    observation_space=spaces.Box(-50, 50, (1,), np.float32),
    observation_space_mapping=lambda tank: [tank.level],
    action_space=spaces.Discrete(3),
    action_space_mapping={0: 0.0, 1: 1.0, 2: 2.0},
    reward_mapping=lambda tank: tank.level,
    action_labels=["closed", "half", "open"],
    observation_labels=["level"],
)


def filling(space, mapping=lambda action: 1.0, **more):
    """Define the first decision with actions of another space."""
    return replace(
        FILL,
        **{"action_space": space, "action_space_mapping": mapping, "action_labels": None} | more,
    )


DRAIN = filling(spaces.Discrete(2), {0: 0.5, 1: 1.5}, agent="drainer")
POINTS = {Tank.fill: FILL, Tank.drain: DRAIN}


def played(policy, seed=3, points=POINTS, simulation=Tank, **options):
    """Return the levels of an episode in which a policy fills the tank."""
    return simulate(simulation, {"filler": policy}, points=points, seed=seed, **options).log


def log_of(tank):
    """Return the levels of an episode."""
    return tank.log


def levels(policy, seeds=range(6), points=POINTS, **options):
    """Return the levels of many episodes in which a policy fills the tank."""
    return simulate_many(
        Tank, {"filler": policy}, seeds=seeds, points=points, collect=log_of, **options
    )


def experiment(contenders, store, **options):
    """Run an experiment of one row, and return its table."""
    return run_experiment(
        lambda days: Tank(),
        [{"days": 5}],
        contenders=contenders,
        points=POINTS,
        store=store,
        **options,
    )
