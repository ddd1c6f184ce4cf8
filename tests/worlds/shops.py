"""A small shop for experiments: a keeper and a helper decide; its returns are known in advance."""

import time
from dataclasses import replace

import numpy as np
from gymnasium import spaces

from simenv_marl import make_step


class Shop:
    """Each day the keeper orders, and then the helper sells."""

    def __init__(self, days=3, price=1.0, kind="plain"):
        self.days, self.price, self.kind = days, price, kind

    def reset(self, seed):
        self.generator, self.level, self.seed = np.random.default_rng(seed), 0.0, seed

    def reseed(self, seed):
        self.generator = np.random.default_rng(seed)

    def run(self):
        for _ in range(self.days):
            self.level += self.order() * self.price
            self.level -= self.sell()
            self.level += float(self.generator.normal())
        if self.kind == "faulty" and self.seed % 2:
            raise ZeroDivisionError("no change")
        if self.kind == "slow":
            time.sleep(0.02)

    def order(self):
        return 2

    def sell(self):
        return 1


def level(shop):
    return shop.level


DECIDED = {
    "observation_space": spaces.Box(-1e9, 1e9, (1,), np.float64),
    "observation_space_mapping": lambda shop: [shop.level],
    "action_space": spaces.Discrete(10),
    "action_space_mapping": lambda action: action,
}
POINTS = {
    Shop.order: make_step(**DECIDED, reward_mapping=level, agent="keeper"),
    Shop.sell: make_step(**DECIDED, reward_mapping=lambda shop: 1.0, agent="helper"),
}
NEAR = {
    point: replace(definition, reward_mapping=lambda shop: -abs(shop.level))
    for point, definition in POINTS.items()
}
"""Points at which both should keep the level near zero, so that chance matters to planners."""


def much(observation):
    return 5


def much_of_many(observations):
    return [5] * len(observations)


def some(observation):
    return int(abs(observation[0]) % 7)


def some_of_many(observations):
    return (np.abs(observations[:, 0]) % 7).astype(int)
