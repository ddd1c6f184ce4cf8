"""A hive whose bees are born and die, and its environments.

Learners with fixed rosters find such agents hardest. The model has a loop, a clock and rules of its
own. Some meadows have no nectar; action masks exclude these.
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
    """A bee: flies out every day, and lives on the nectar that it brings home."""

    def __init__(self, hive: Hive, number: int) -> None:
        self.hive, self.name = hive, f"bee_{number}"
        self.strength = 2
        self.brought = 0.0

    def observed(self) -> list[float]:
        """Observe the nectar of each meadow, and the bee's strength."""
        return [*self.hive.nectar, self.strength / 5]

    def choose_meadow(self) -> int:
        """Decide where to fly."""
        # the nearest with nectar
        return next(number for number in range(MEADOWS) if self.hive.nectar[number])

    def fly(self) -> None:
        """Fly to a meadow; become stronger or weaker, according to its nectar."""
        self.brought = self.hive.nectar[self.choose_meadow()]
        self.strength = min(self.strength + (1 if self.brought > 0.5 else -1), 5)
        if self.strength == 0:
            self.hive.lose(self)


class Hive:
    """A hive with one bee at first; at most four bees hatch in all."""

    def __init__(self, seed: int | None) -> None:
        self.random = Random(seed)
        self.day = 0
        self.bees: list[Bee] = []
        self.hatched = 0
        self.dawn()

    def dawn(self) -> None:
        """Draw the nectar of the meadows; on every other day, a bee hatches."""
        self.nectar = [
            self.random.random() if self.random.random() < 0.8 else 0.0 for _ in range(MEADOWS)
        ]
        self.nectar[self.random.randrange(MEADOWS)] = self.random.uniform(0.2, 1.0)
        if self.day % 2 == 0 and self.hatched < len(BEES):
            self.bees.append(Bee(self, self.hatched))
            self.hatched += 1

    def lose(self, bee: Bee) -> None:
        """Remove a dead bee."""
        self.bees.remove(bee)

    def update_day(self) -> None:
        """Simulate one day."""
        for bee in list(self.bees):
            bee.fly()
        self.day += 1
        self.dawn()


class HiveSim(SimulationInterface):
    """Twelve days of a hive; the episode ends earlier if no bee is left."""

    def reset(self, seed: int | None = None) -> None:
        """Start with a new hive."""
        self.hive = Hive(seed)

    def run(self) -> Any:
        """Simulate day after day."""
        while self.hive.day < DAYS:
            self.hive.update_day()
            if not self.hive.bees:
                return None
        return TRUNCATED

    def expected_calls(self, point: str) -> list[tuple[Any, ...]]:
        """Announce that all bees are going to decide."""
        return [(bee,) for bee in self.hive.bees]

    def time(self) -> float:
        """Return the day."""
        return float(self.hive.day)

    def state(self) -> list[float]:
        """Return the nectar of all meadows, and the day."""
        return [*self.hive.nectar, self.hive.day / DAYS]


# The task: fly to the meadow with the most nectar.
DEFINITION: dict[str, Any] = {
    "observation_space": spaces.Box(0, 1, (MEADOWS + 1,), np.float32),
    "observation_space_mapping": Bee.observed,
    "action_space": spaces.Discrete(MEADOWS),
    "action_space_mapping": int,
    "reward_mapping": lambda bee: bee.brought,
    "agent": lambda bee: bee.name,
    "removed_by": {"hive.Hive.lose": lambda hive, bee: bee.name},
}
MASKED = DEFINITION | {
    "action_mask_mapping": lambda bee: [nectar > 0 for nectar in bee.hive.nectar]
}
MASK_OBSERVED = MASKED | {  # RLlib needs these keys
    "observation_space": spaces.Dict(
        {
            "observations": spaces.Box(0, 1, (MEADOWS + 1,), np.float32),
            "action_mask": spaces.Box(0, 1, (MEADOWS,), np.int8),
        }
    ),
    "observation_space_mapping": lambda bee: {"observations": bee.observed()},
}


def points(definition: dict[str, Any] = MASKED) -> dict[Any, Any]:
    """Return the bees' decision point, with one of the definitions above."""
    return {Bee.choose_meadow: make_step(**definition)}
