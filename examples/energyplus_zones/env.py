"""The two rooms as environments: each thermostat is an agent.

- ``raw_env`` and ``env``: both agents, as a PettingZoo AEC environment, bare and in PettingZoo's wrappers.
- ``parallel_env``: both agents, a round every quarter of an hour.

Importing this module registers them as ``energyplus_zones/coop_v0``. An agent is rewarded with what its room has cost
since its decision before, as a negative number; the reward of the team is the sum.
"""

from __future__ import annotations

from math import cos, pi, sin
from typing import Any, Final

import numpy as np
import pettingzoo
from gymnasium.spaces import Box
from numpy.typing import NDArray
from pettingzoo.utils.wrappers import ClipOutOfBoundsWrapper, OrderEnforcingWrapper

import simenv_marl
from simenv_marl import (
    TRUNCATED,
    Definition,
    SimulationAECEnv,
    SimulationInterface,
    SimulationParallelEnv,
    aec_env,
    difference,
    make_step,
)

from .model import HIGHEST_SETPOINT, LOWEST_SETPOINT, STEPS_PER_HOUR, Building, Zone

AGENTS: Final = ["south_0", "north_0"]

OBSERVED: Final = (
    "the hour of the day, as a sine",
    "the same, as a cosine",
    "degrees outside",
    "degrees in the room",
    "degrees in the room beside it",
    "people in the room",
)
"""What an agent observes."""


def observe(zone: Zone) -> NDArray[np.float32]:
    """Observe what ``OBSERVED`` lists."""
    building, angle = zone.building, zone.building.hour / 12 * pi
    values = (sin(angle), cos(angle), building.outside, zone.temperature, zone.other.temperature, zone.people)
    return np.array(values, np.float32)


_cost_since = difference(lambda zone: zone.cost)


def reward(zone: Zone) -> float:
    """What the room has cost since its agent was last asked, as a loss."""
    return -float(_cost_since(zone))


def to_degrees(action: Any) -> float:
    """The setpoint that an action decides: 0 the lowest, 1 the highest."""
    return LOWEST_SETPOINT + (HIGHEST_SETPOINT - LOWEST_SETPOINT) * float(np.asarray(action).item())


def to_action(degrees: float) -> list[float]:
    """The action that decides a setpoint."""
    return [(degrees - LOWEST_SETPOINT) / (HIGHEST_SETPOINT - LOWEST_SETPOINT)]


POINT: Final = f"{Zone.__module__}.Zone.choose_setpoint"
POINTS: Final[dict[Any, Definition]] = {
    POINT: make_step(
        observation_space=Box(
            np.array([-1, -1, -50, -50, -50, 0], np.float32), np.array([1, 1, 50, 50, 50, 4], np.float32)
        ),
        observation_space_mapping=observe,
        action_space=Box(0.0, 1.0, (1,), np.float32),
        action_space_mapping=to_degrees,
        reward_mapping=reward,
        agent=lambda zone: f"{zone.name}_0",
    )
}
"""The thermostats of both rooms."""


class BuildingSim(SimulationInterface):
    """Runs a building for some days in winter.

    Attributes:
        building: The building of the present episode.
        results: What EnergyPlus has written about the latest run that came to its end.
    """

    points = POINTS
    building: Building
    results: str

    def reset(self, seed: int | None = None) -> None:
        """Build it anew."""
        self.building = Building(seed)

    def run(self) -> Any:
        """Let the days go by."""
        self.building.run()
        self.results = self.building.engine.results()
        return TRUNCATED

    def expected_calls(self, point: str) -> list[tuple[Any, ...]]:
        """Which rooms are going to decide: both."""
        return [(zone,) for zone in self.building.zones]

    def time(self) -> float:
        """Hours since the run has begun."""
        return self.building.steps / STEPS_PER_HOUR

    def reseed(self, seed: int) -> None:
        """Draw anew who comes on the days that lie ahead."""
        self.building.random.seed(seed)

    def close(self) -> None:
        """Let go of EnergyPlus, and of its files."""
        self.building.close()


def raw_env(**options: Any) -> SimulationAECEnv:
    """Make the environment of both agents.

    Args:
        **options: As ``simenv_marl.aec_env`` takes them.
    """
    return aec_env(BuildingSim, **{"possible_agents": AGENTS} | options)


def env(**options: Any) -> OrderEnforcingWrapper[str, Any, Any]:
    """Make the environment of both agents in PettingZoo's wrappers, which tell mistakes and clip actions.

    Args:
        **options: As ``simenv_marl.aec_env`` takes them.
    """
    return OrderEnforcingWrapper(ClipOutOfBoundsWrapper(raw_env(**options)))


def parallel_env(**options: Any) -> SimulationParallelEnv:
    """Make the environment of both agents in which they decide at once.

    Args:
        **options: As ``simenv_marl.parallel_env`` takes them.
    """
    return simenv_marl.parallel_env(BuildingSim, **{"possible_agents": AGENTS} | options)


def _register() -> None:
    """Tell the registry of PettingZoo, unless it knows already."""
    for kind, entry_point in (("aec", "env"), ("parallel", "parallel_env")):
        known = getattr(pettingzoo, f"{kind}_registry", None)  # younger than the oldest PettingZoo that will do
        if known is not None and "energyplus_zones/coop-v0" not in known:
            pettingzoo.register(kind, "energyplus_zones/coop_v0", f"{__name__}:{entry_point}")


_register()
