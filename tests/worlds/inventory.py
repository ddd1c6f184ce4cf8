"""A shop that loses what it cannot sell, and orders what comes days later; with the best that can be done in it."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from simenv_marl import difference, make_step

DAYS = 12
LEAD = 2
"""An order is there before the sales of the day that comes so many days later."""

MOST = 5
"""The largest order."""

SHELF = 12
"""What does not fit on the shelf is lost."""

DEMANDS = (0.1, 0.2, 0.3, 0.25, 0.15)
"""How likely it is that 0, 1, 2, ... are wanted on a day."""

PRICE, HOLDING = 4.0, 1.0


class Shop:
    """Sells what it has. Its rule orders one a day, which is half of what is wanted."""

    def reset(self, seed: int | None = None) -> None:
        self.random = random.Random(seed)
        self.day, self.stock, self.coming, self.profit = 0, 4, [2] * (LEAD - 1), 0.0

    def reseed(self, seed: int) -> None:
        self.random.seed(seed)

    def run(self) -> None:
        while self.day < DAYS:
            self.coming.append(self.order())
            wanted = self.random.choices(range(len(DEMANDS)), DEMANDS)[0]
            self.stock, gain = sell(min(self.stock + self.coming.pop(0), SHELF), wanted)
            self.profit += gain
            self.day += 1

    @make_step(
        observation_space=spaces.Box(0, 99, (2 + LEAD - 1,), np.float32),
        observation_space_mapping=lambda shop: [shop.day, shop.stock, *shop.coming],
        action_space=spaces.Discrete(MOST + 1),
        action_space_mapping=int,
        reward_mapping=difference(lambda shop: shop.profit),
        agent="buyer",
    )
    def order(self) -> int:
        return 1


def sell(stock: int, wanted: int) -> tuple[int, float]:
    """What is left of a stock after a day, and what that has brought."""
    sold = min(stock, wanted)
    return stock - sold, PRICE * sold - HOLDING * (stock - sold)


def best_values() -> NDArray[np.float64]:
    """By day, stock, what comes tomorrow and order: the most that can be expected from there to the end.

    By backward induction. What was ordered yesterday is there before today is sold; today's order is what comes then.
    """
    assert LEAD == 2
    values = np.zeros((DAYS + 1, SHELF + 1, MOST + 1, MOST + 1))
    for day in reversed(range(DAYS)):
        after = values[day + 1].max(axis=2)  # by stock and what comes then
        for stock, coming in np.ndindex(SHELF + 1, MOST + 1):
            for wanted, chance in enumerate(DEMANDS):
                left, gain = sell(min(stock + coming, SHELF), wanted)
                values[day, stock, coming] += chance * (gain + after[left])
    return values[:DAYS]


def state(observation: Any) -> tuple[int, ...]:
    """The place of an observation among the values."""
    return tuple(map(int, observation))
