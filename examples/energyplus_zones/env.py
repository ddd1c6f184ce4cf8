"""Environments made from the two rooms: each thermostat is an agent.

- ``raw_env`` and ``env``: both agents, as a PettingZoo AEC environment, without and with
  PettingZoo's wrappers.
- ``parallel_env``: both agents, with one round every quarter of an hour.

Importing this module registers them as ``energyplus_zones/coop_v0``. An agent's reward is minus the
cost of its room since its previous decision; the reward of the team is the sum.
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
from simenv_marl import TRUNCATED, Definition, SimulationInterface, aec_env, difference, make_step
from simenv_marl.envs import SimulationAECEnv, SimulationParallelEnv

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
"""The observation of an agent."""


def observe(zone: Zone) -> NDArray[np.float32]:
    """Observe a room, as ``OBSERVED`` lists it."""
    building, angle = zone.building, zone.building.hour / 12 * pi
    values = (
        sin(angle),
        cos(angle),
        building.outside,
        zone.temperature,
        zone.other.temperature,
        zone.people,
    )
    return np.array(values, np.float32)


_cost_since = difference(lambda zone: zone.cost)


def reward(zone: Zone) -> float:
    """Compute the reward: minus the cost of the room since its agent's previous decision."""
    return -float(_cost_since(zone))


def to_degrees(action: Any) -> float:
    """Map an action to a setpoint: 0 to the lowest, 1 to the highest."""
    return LOWEST_SETPOINT + (HIGHEST_SETPOINT - LOWEST_SETPOINT) * float(np.asarray(action).item())


def to_action(degrees: float) -> list[float]:
    """Map a setpoint to its action."""
    return [(degrees - LOWEST_SETPOINT) / (HIGHEST_SETPOINT - LOWEST_SETPOINT)]


def display(zone: Zone) -> dict[str, str | int]:
    """Return what people and language models read in place of the observation."""
    return {
        "hour of the day": f"{zone.building.hour:.2f}",
        "outside": f"{zone.building.outside:.1f} °C",
        "in the room": f"{zone.temperature:.1f} °C",
        "in the room beside it": f"{zone.other.temperature:.1f} °C",
        "people in the room": int(zone.people),
    }


POINT: Final = f"{Zone.__module__}.Zone.choose_setpoint"
POINTS: Final[dict[Any, Definition]] = {
    POINT: make_step(
        observation_space=Box(
            np.array([-1, -1, -50, -50, -50, 0], np.float32),
            np.array([1, 1, 50, 50, 50, 4], np.float32),
        ),
        observation_space_mapping=observe,
        action_space=Box(0.0, 1.0, (1,), np.float32),
        action_space_mapping=to_degrees,
        reward_mapping=reward,
        agent=lambda zone: f"{zone.name}_0",
        question="How warm shall the room be, from coolest (0) to warmest (1)?",
        display_mapping=display,
        action_labels=["from 0 to 1"],
        observation_labels=OBSERVED,
    )
}
"""The thermostats of both rooms."""


class BuildingSim(SimulationInterface):
    """The simulation of a building for some days in winter.

    Attributes:
        building: The building of the current episode.
        results: EnergyPlus's output of the latest completed run.
    """

    points = POINTS
    building: Building
    results: str

    def reset(self, seed: int | None = None) -> None:
        """Create a new building."""
        self.building = Building(seed)

    def run(self) -> Any:
        """Simulate the days of the run."""
        self.building.run()
        self.results = self.building.engine.results()
        return TRUNCATED

    def expected_calls(self, point: str) -> list[tuple[Any, ...]]:
        """Return the calls to come: one for each room."""
        return [(zone,) for zone in self.building.zones]

    def time(self) -> float:
        """The time since the beginning of the run, in hours."""
        return self.building.steps / STEPS_PER_HOUR

    def reseed(self, seed: int) -> None:
        """Draw another future of the people's presence."""
        self.building.random.seed(seed)

    def close(self) -> None:
        """Close EnergyPlus, and remove its files."""
        self.building.close()


def raw_env(**options: Any) -> SimulationAECEnv:
    """Make the environment of both agents.

    Args:
        **options: The options of ``simenv_marl.aec_env``.
    """
    return aec_env(BuildingSim, **{"possible_agents": AGENTS} | options)


def env(**options: Any) -> OrderEnforcingWrapper[str, Any, Any]:
    """Make the environment of both agents in PettingZoo's wrappers.

    The wrappers report wrong use and clip actions.

    Args:
        **options: The options of ``simenv_marl.aec_env``.
    """
    return OrderEnforcingWrapper(ClipOutOfBoundsWrapper(raw_env(**options)))


def parallel_env(**options: Any) -> SimulationParallelEnv:
    """Make the parallel environment, in which both agents decide simultaneously.

    Args:
        **options: The options of ``simenv_marl.parallel_env``.
    """
    return simenv_marl.parallel_env(BuildingSim, **{"possible_agents": AGENTS} | options)


def _register() -> None:
    """Register the environments with PettingZoo, unless they are registered already."""
    for kind, entry_point in (("aec", "env"), ("parallel", "parallel_env")):
        # missing in the oldest supported PettingZoo
        known = getattr(pettingzoo, f"{kind}_registry", None)
        if known is not None and "energyplus_zones/coop-v0" not in known:
            pettingzoo.register(kind, "energyplus_zones/coop_v0", f"{__name__}:{entry_point}")


_register()
