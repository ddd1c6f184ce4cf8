"""A hive whose bees are born and die, and its environments: learners with fixed rosters find such agents hardest.

The model has a loop, a clock and rules of its own. Some meadows have no nectar; action masks exclude these.
"""

from __future__ import annotations

from random import Random
from typing import Any

import numpy as np
from gymnasium import spaces

from simenv_marl import TRUNCATED, SimulationInterface, make_step

DAYS = 12
MEADOWS = 3
BEES = [f"bee_{number}" for number in range(4)]


class Bee:
    """Flies out every day, and lives on what it brings home."""

    def __init__(self, hive: Hive, number: int) -> None:
        self.hive, self.name = hive, f"bee_{number}"
        self.strength = 2
        self.brought = 0.0

    def observed(self) -> list[float]:
        """What it knows when it decides: the nectar of each meadow, and how strong it is."""
        return [*self.hive.nectar, self.strength / 5]

    def choose_meadow(self) -> int:
        """Decide where to fly."""
        return next(number for number in range(MEADOWS) if self.hive.nectar[number])  # the nearest where there is any

    def fly(self) -> None:
        """Spend a day."""
        self.brought = self.hive.nectar[self.choose_meadow()]
        self.strength = min(self.strength + (1 if self.brought > 0.5 else -1), 5)
        if self.strength == 0:
            self.hive.lose(self)


class Hive:
    """Has room for four bees in its time, of which one is there at the beginning."""

    def __init__(self, seed: int | None) -> None:
        self.random = Random(seed)
        self.day = 0
        self.bees: list[Bee] = []
        self.hatched = 0
        self.dawn()

    def dawn(self) -> None:
        """Let the meadows blossom anew; on every other day a bee hatches."""
        self.nectar = [self.random.random() if self.random.random() < 0.8 else 0.0 for _ in range(MEADOWS)]
        self.nectar[self.random.randrange(MEADOWS)] = self.random.uniform(0.2, 1.0)
        if self.day % 2 == 0 and self.hatched < len(BEES):
            self.bees.append(Bee(self, self.hatched))
            self.hatched += 1

    def lose(self, bee: Bee) -> None:
        """Do without a bee from now on."""
        self.bees.remove(bee)

    def update_day(self) -> None:
        """Let a day go by."""
        for bee in list(self.bees):
            bee.fly()
        self.day += 1
        self.dawn()


class HiveSim(SimulationInterface):
    """Twelve days of a hive, or fewer where no bee is left."""

    def reset(self, seed: int | None = None) -> None:
        """Found a new hive."""
        self.hive = Hive(seed)

    def run(self) -> Any:
        """Let day after day go by."""
        while self.hive.day < DAYS:
            self.hive.update_day()
            if not self.hive.bees:
                return None
        return TRUNCATED

    def expected_calls(self, point: str) -> list[tuple[Any, ...]]:
        """All bees are going to fly."""
        return [(bee,) for bee in self.hive.bees]

    def time(self) -> float:
        """The day."""
        return float(self.hive.day)

    def state(self) -> list[float]:
        """All meadows, and the day."""
        return [*self.hive.nectar, self.hive.day / DAYS]


# What there is to be learnt: fly to where the most nectar is.
DEFINITION: dict[str, Any] = {
    "observation_space": spaces.Box(0, 1, (MEADOWS + 1,), np.float32),
    "observation_space_mapping": Bee.observed,
    "action_space": spaces.Discrete(MEADOWS),
    "action_space_mapping": int,
    "reward_mapping": lambda bee: bee.brought,
    "agent": lambda bee: bee.name,
    "removed_by": {"hive.Hive.lose": lambda hive, bee: bee.name},
}
MASKED = DEFINITION | {"action_mask_mapping": lambda bee: [nectar > 0 for nectar in bee.hive.nectar]}
MASK_OBSERVED = MASKED | {  # by those names for RLlib
    "observation_space": spaces.Dict(
        {
            "observations": spaces.Box(0, 1, (MEADOWS + 1,), np.float32),
            "action_mask": spaces.Box(0, 1, (MEADOWS,), np.int8),
        }
    ),
    "observation_space_mapping": lambda bee: {"observations": bee.observed()},
}


def points(definition: dict[str, Any] = MASKED) -> dict[Any, Any]:
    """The bees' decision point under one of the definitions above."""
    return {Bee.choose_meadow: make_step(**definition)}
