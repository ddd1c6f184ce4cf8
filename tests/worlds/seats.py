"""Models for policies that are slow, fail or read, and for people who play in a browser.

``Tank`` has two decisions a day: ``played``, ``levels`` and ``experiment`` run it with a policy.
``Shop`` is what people play; its subclasses are slow, break, close, or do not begin.
"""

import os
import random
import time
from dataclasses import replace

import numpy as np
from gymnasium import spaces

from simenv_marl import (
    SimulationInterface,
    difference,
    make_step,
    reseed_generators,
    simulate,
    simulate_many,
)
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
