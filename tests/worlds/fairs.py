"""Random fairs: births, deaths, masks, splits and forced moves, all of which decisions change."""

import random

import numpy as np
from gymnasium import spaces

from simenv_marl import RULE, difference, make_step

HERE = __name__
MOST = 6


class Stall:
    """A stall, which sells at its price."""

    def __init__(self, number):
        self.number, self.earned = number, 0


class Fair:
    """A fair of some days: it prices all stalls in one call, and then lets one more in or not."""

    def reset(self, seed=None):
        self.random = random.Random(seed)
        self.day = self.built = 0
        self.level = self.random.randrange(50)
        self.days = self.random.randrange(2, 5)
        self.stalls = []
        for _ in range(self.random.randrange(1, 3)):
            self.build()

    def run(self):
        while self.stalls and self.day < self.days:
            for stall, price in zip(list(self.stalls), self.prices(), strict=True):
                stall.earned += price * (self.level % 3) - price**2 / 4
                self.level = (self.level * 3 + price + self.random.randrange(4)) % 101
                if self.level % 7 == 0:
                    self.shut(stall)
            self.level += self.enlarge()
            if self.level % 3 == 0:
                self.build()
            self.day += 1

    def build(self):
        if self.built < MOST:
            self.stalls.append(Stall(self.built))
            self.built += 1

    def shut(self, stall):
        self.stalls.remove(stall)

    def prices(self):
        return [self.random.randrange(4) for _ in self.stalls]

    def enlarge(self):
        return self.random.choice(self.sizes())

    def sizes(self):
        return [number + self.level % 2 for number in range(1 + self.level % 4)]

    def time(self):
        return float(self.day)

    def reseed(self, seed):
        self.random.seed(seed)

    @property
    def fortune(self):
        return float(self.level + sum(stall.earned for stall in self.stalls))


def affordable(stall, fair, *, _answers):
    """The mask of prices: not those that two stalls of the day have already."""
    return np.array([_answers.count(price) < 2 for price in range(4)], np.int8)


SEEN = spaces.Box(-1e6, 1e6, (3,), np.float64)

POINTS = {
    f"{HERE}.Fair.prices": make_step(
        split=lambda fair: list(fair.stalls),
        agent=lambda stall: f"stall_{stall.number}",
        observation_space=SEEN,
        observation_space_mapping=lambda stall, fair: [stall.number, fair.level, fair.day],
        action_space=spaces.Discrete(4),
        action_space_mapping={price: price for price in range(4)},
        action_mask_mapping=affordable,
        reward_mapping=lambda stall, fair: stall.earned / 3 + fair.level / 7,
        removed_by={f"{HERE}.Fair.shut": lambda fair, stall: f"stall_{stall.number}"},
        action_labels=["free", "cheap", "fair", "dear"],
    ),
    f"{HERE}.Fair.enlarge": make_step(
        agent="warden_0",
        observation_space=SEEN,
        observation_space_mapping=lambda fair: [-1, fair.level, len(fair.stalls)],
        action_space=spaces.Discrete(4),
        choices=Fair.sizes,
        reward_mapping=difference(lambda fair: fair.level / 3),
    ),
}


def advised(observation, info):
    """An answer by the observation alone: a legal action, or the rule."""
    legal = np.flatnonzero(info["action_mask"]).tolist()
    return random.Random(str(observation.tolist())).choice([*legal, RULE])


def boldest(observation, info):
    """The last legal action."""
    return int(np.flatnonzero(info["action_mask"])[-1])


POLICIES = dict.fromkeys(POINTS, advised)
