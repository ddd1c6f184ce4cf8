"""Small simulations on which a short training improves a policy for certain.

Each is a model with a loop of its own and a rule for each decision; nothing in them is made for a learner but the
definitions of their decision points. The comments say what there is to be learnt.
"""

from __future__ import annotations

from random import Random
from typing import Any

import numpy as np
from gymnasium import spaces

from simenv_marl import TRUNCATED, SimulationInterface, make_step

NUMBER: dict[str, Any] = {
    "observation_space": spaces.Box(0, 1, (4,), np.float32),
    "observation_space_mapping": lambda shop: shop.observed(),
    "action_space": spaces.Discrete(4),
    "action_space_mapping": int,
    "reward_mapping": lambda shop: shop.profit,
}
"""What both decisions have in common: so many loaves, for the profit of the day."""


class Shop:
    """Bread is baked in the morning, put on the shelf, and sold as long as there is some and somebody wants it."""

    def __init__(self, seed: int | None) -> None:
        self.random = Random(seed)
        self.day = 0
        self.stock = 0
        self.wanted = self.random.randrange(4)
        self.profit = 0.0

    # Worth learning, for both: as many as are wanted. Neither is of any use without the other.
    def observed(self) -> list[float]:
        return [float(number == self.wanted) for number in range(4)]

    @make_step(agent="baker_0", **NUMBER)
    def choose_batch(self) -> int:
        return 2

    @make_step(agent="seller_0", **NUMBER)
    def choose_display(self) -> int:
        return self.stock

    def update_day(self) -> None:
        self.stock = self.choose_batch()
        shelf = min(self.choose_display(), self.stock)
        sold = min(shelf, self.wanted)
        self.profit = sold - 0.5 * (self.stock - sold) - 0.25 * (shelf - sold)
        self.wanted = self.random.randrange(4)
        self.day += 1


class ShopSim(SimulationInterface):
    """Ten days of a shop."""

    points = (Shop.choose_batch, Shop.choose_display)

    def reset(self, seed: int | None = None) -> None:
        self.shop = Shop(seed)

    def run(self) -> Any:
        while self.shop.day < 10:
            self.shop.update_day()
        return TRUNCATED

    def expected_calls(self, point: str) -> list[tuple[Any, ...]]:
        return [(self.shop,)]

    def state(self) -> list[float]:
        return [*self.shop.observed(), self.shop.day / 10]


class Crane:
    """A crane that brings its hook above a load."""

    def __init__(self, seed: int | None) -> None:
        rng = np.random.default_rng(seed)
        self.hook, self.load = np.zeros(2), rng.uniform(-1, 1, 2)
        self.moves = 0

    # Worth learning: towards the load. All that is told is whether the hook is above it.
    @make_step(
        observation_space=spaces.Box(-1, 1, (2,), np.float32),
        observation_space_mapping=lambda crane: crane.hook,
        action_space=spaces.Box(-1, 1, (2,), np.float32),
        action_space_mapping=lambda action: 0.4 * action.astype(float),
        reward_mapping=lambda crane: _above(np.float32(crane.hook), np.float32(crane.load), None),
        agent="driver_0",
        goal_space=spaces.Box(-1, 1, (2,), np.float32),
        achieved_goal_mapping=lambda crane: crane.hook,
        desired_goal_mapping=lambda crane: crane.load,
        compute_reward=lambda achieved, desired, info: _above(achieved, desired, info),
    )
    def choose_move(self) -> Any:
        return np.zeros(2)

    def update(self) -> None:
        self.hook = np.clip(self.hook + self.choose_move(), -1, 1)
        self.moves += 1


def _above(achieved: Any, desired: Any, info: Any) -> Any:
    return -(np.linalg.norm(achieved - desired, axis=-1) > 0.3).astype(float)


class CraneSim(SimulationInterface):
    """Ten moves of a crane."""

    points = (Crane.choose_move,)

    def reset(self, seed: int | None = None) -> None:
        self.crane = Crane(seed)

    def run(self) -> Any:
        while self.crane.moves < 10:
            self.crane.update()
        return TRUNCATED


class Forager:
    """Lives on what it finds."""

    def __init__(self, herd: Herd, number: int) -> None:
        self.herd, self.name = herd, f"forager_{number}"
        self.energy, self.gained = 3, 0.0

    # Worth learning: to go where there is something, and to rest where there is nothing.
    @make_step(
        observation_space=spaces.Box(0, 1, (2,), np.float32),
        observation_space_mapping=lambda forager: [forager.herd.food / 3, min(forager.energy, 10) / 10],
        action_space=spaces.Discrete(2),
        action_space_mapping={0: False, 1: True},
        reward_mapping=lambda forager: forager.gained,
        agent=lambda forager: forager.name,
        removed_by="tests.clients.worlds.Forager.die",
    )
    def choose_to_go(self) -> bool:
        return True

    def update_day(self) -> None:
        self.gained = self.herd.food - 1.5 if self.choose_to_go() else 0.0
        self.energy = min(self.energy + round(self.gained), 10)
        if self.energy <= 0:
            self.die()

    def die(self) -> None:
        self.herd.foragers.remove(self)


class Herd:
    """Foragers, of whom one is born every third day."""

    def __init__(self, seed: int | None) -> None:
        self.random = Random(seed)
        self.day = self.born = 0
        self.food = self.random.randrange(4)
        self.foragers: list[Forager] = []

    def update_day(self) -> None:
        if self.day % 3 == 0 and self.born < len(FORAGERS):
            self.foragers.append(Forager(self, self.born))
            self.born += 1
        for forager in list(self.foragers):
            forager.update_day()
        self.food = self.random.randrange(4)
        self.day += 1


class HerdSim(SimulationInterface):
    """Fifteen days of a herd."""

    points = (Forager.choose_to_go,)

    def reset(self, seed: int | None = None) -> None:
        self.herd = Herd(seed)

    def run(self) -> Any:
        while self.herd.day < 15:
            self.herd.update_day()
        return TRUNCATED

    def expected_calls(self, point: str) -> list[tuple[Any, ...]]:
        return [(forager,) for forager in self.herd.foragers]


FORAGERS = [f"forager_{number}" for number in range(4)]
