"""Simulations that people play in these tests."""

import os
import random
import time
from dataclasses import replace

import numpy as np
from gymnasium import spaces

from simenv_marl import SimulationInterface, difference, make_step, reseed_generators

ORDER = make_step(
    observation_space=spaces.Dict(
        {"stock": spaces.Discrete(100), "mean": spaces.Box(-np.inf, np.inf, (1,), np.float32)}
    ),
    observation_space_mapping=lambda shop: {
        "stock": shop.stock,
        "mean": [shop.profit / (shop.day + 1)],
    },
    action_space=spaces.Discrete(4),
    action_space_mapping={0: 0, 1: 1, 2: 2, 3: 3},
    rule_action_mapping=int,
    action_mask_mapping=lambda shop: [shop.stock + amount < 7 for amount in range(4)],
    reward_mapping=difference(lambda shop: shop.profit),
    agent="buyer",
)

SWITCH = make_step(
    observation_space=spaces.Box(0, 10, (2,)),
    observation_space_mapping=lambda shop: [shop.day, shop.stock % 10],
    action_space=spaces.MultiDiscrete([2, 3]),
    action_space_mapping=tuple,
    reward_mapping=lambda shop: float(shop.switches[0]),
    agent="seller",
)


class Shop(SimulationInterface):
    """A buyer orders up to what fits into the store, on eight days; a seller sets two switches."""

    days, render_modes = 8, ("rgb_array",)

    def reset(self, seed=None):
        self.random = random.Random(seed)
        self.day, self.stock, self.profit, self.switches = 0, 2, 0, (0, 0)

    def reseed(self, seed):
        reseed_generators(self, seed)

    def time(self):
        return float(self.day)

    def render(self, mode):
        return np.full((2, 3, 3), self.day, np.uint8)

    def run(self):
        while self.day < self.days:
            ordered = self.order()
            self.switches = self.switch()
            wanted = self.random.choice([0, 1, 2, 2, 3, 4])
            sold = min(self.stock + ordered, wanted)
            self.stock += ordered - sold
            self.profit += 4 * sold - self.stock - sum(self.switches)
            self.day += 1

    def order(self):
        """Order pieces.

        They arrive at once.
        """
        return 2 if self.stock < 3 else 0

    def switch(self):
        """Set the switches."""
        return (1, 0)


Shop.points = {Shop.order: ORDER, Shop.switch: SWITCH}


class FixedShop(Shop):
    """Its chance cannot be drawn anew."""

    reseed = None


class SlowShop(Shop):
    """It takes two seconds to go on."""

    points = {Shop.order: ORDER}  # noqa: RUF012

    def switch(self):
        time.sleep(2)
        return super().switch()


class OddShop(Shop):
    """Its buyer has a name with special characters."""

    points = {Shop.order: replace(ORDER, agent="../a b/ü?&<i>")}  # noqa: RUF012


def five(observation):
    """Bring five crates to the market."""
    return 5


class ClosedShop(Shop):
    """It takes some time to close."""

    def close(self):
        time.sleep(0.2)
        print("It is closed.", flush=True)


class EndlessShop(Shop):
    """It does not go on after a decision."""

    def run(self):
        self.order()
        time.sleep(600)


class BrokenShop(Shop):
    """It cannot begin."""

    def reset(self, seed=None):
        raise OSError("the door is locked")


class LeavingShop(Shop):
    """It ends its process."""

    def reset(self, seed=None):
        os._exit(3)


def labels(shop):
    """Name the actions, on the first three days."""
    return [f"order {amount} of {3 // (3 - shop.day)}" for amount in range(4)]


class BreakingShop(Shop):
    """It breaks on the day after three pieces were ordered; its labels fail on the fourth day."""

    points = {Shop.order: replace(ORDER, action_labels=labels)}  # noqa: RUF012

    def run(self):
        while self.day < self.days:
            if self.order() == 3:
                raise ZeroDivisionError("the till is broken")
            self.day += 1


class ClosingShop(Shop):
    """Its seller leaves after two days."""

    days = 2

    def run(self):
        super().run()
        self.end_agent("seller")
        for self.day in range(3, 6):
            self.order()
