"""Environments made from the greenhouse: two of its decisions become agents that share one reward.

This follows supplement S2 of the Sim-Env paper, with the two agents that its outlook suggests:
``waterer_0`` decides how many litres to pour, ``ventilator_0`` how much air to exchange. The model
itself does not refer to this module: the module names the model's functions as decision points, and
they stay unchanged for all other uses.

- ``raw_env`` and ``env``: both agents, as a PettingZoo AEC environment, without and with
  PettingZoo's wrappers.
- ``parallel_env``: both agents, as a PettingZoo parallel environment, with one round per day.
- ``joint_env``: one agent that takes both decisions, as a Gymnasium environment; its reward is the
  sum of the two.
- ``watering_env``: the waterer alone, as a Gymnasium environment; ventilation follows its rule.
- ``ventilation_env``: the ventilator alone; watering follows its rule.

Importing this module registers them: ``pettingzoo.make("aec", "greenhouse_coop/coop_v0")``, the
same with ``"parallel"``, and ``gymnasium.make`` of ``"greenhouse_coop/Watering-v0"``,
``"greenhouse_coop/Ventilation-v0"`` and ``"greenhouse_coop/Joint-v0"``.

Both agents get the same reward once a day: the share of living plants, less a thousandth per litre
poured since their decision of the day before. As the reward is shared, the return of the team is
the return of *one* agent, not the sum: here the ventilator's, whose return is the sum over all
days. (The waterer decides after the plants' daily update. It gets no reward for the first day, when
all plants are alive, and two for the last day, so its return is less by the share of plants that
are dead in the end.)
"""

from __future__ import annotations

from typing import Any, Final

import gymnasium
import numpy as np
import pettingzoo
from gymnasium.spaces import Box
from numpy.typing import NDArray
from pettingzoo.utils.wrappers import ClipOutOfBoundsWrapper, OrderEnforcingWrapper

import simenv_marl
from simenv_marl import (
    TRUNCATED,
    Definition,
    SimulationInterface,
    aec_env,
    difference,
    make_step,
    single_env,
)
from simenv_marl.envs import (
    SimulationAECEnv,
    SimulationEnv,
    SimulationJointEnv,
    SimulationParallelEnv,
)

from .model import HIGHEST_TEMPERATURE, LOWEST_TEMPERATURE, POT_CAPACITY, Greenhouse

WATERER, VENTILATOR = "waterer_0", "ventilator_0"

DAYS: Final = 100
"""The number of days after which an episode is truncated."""

MOST_WATER: Final = 1000.0
"""The most litres that the waterer can pour in a day."""

OBSERVED: Final = (
    "temperature, between its bounds",
    "relative humidity",
    "share of the plants that are alive",
    "share of the days that are gone",
    "water in the pots of living plants: its mean, by what a pot holds",
    (
        "the same, each pot counted by what its plant lacks in health: are the weak too dry or too"
        " wet?"
    ),
)
"""The observation of both agents."""


# -- observations, actions, rewards ---------------------------------------------------------------


def observe(greenhouse: Greenhouse) -> NDArray[np.float32]:
    """Observe the greenhouse, as ``OBSERVED`` lists it.

    All values are clipped to [0, 1], because the model does not bound the humidity: bad decisions
    can drive it, and the water with it, to infinity.
    """
    living = 0
    water = lack = water_by_lack = 0.0
    for plant in greenhouse.pots:  # a single pass, because it takes most of the time of a decision
        if plant.health > 0:
            missing = 1 - plant.health
            living += 1
            water += plant.water
            lack += missing
            water_by_lack += plant.water * missing
    mean = water / max(1, living)
    values = (
        (greenhouse.temp - LOWEST_TEMPERATURE) / (HIGHEST_TEMPERATURE - LOWEST_TEMPERATURE),
        greenhouse.humidity,
        living / len(greenhouse.pots),
        greenhouse.day / DAYS,
        mean / POT_CAPACITY,
        (water_by_lack / lack if lack else mean) / POT_CAPACITY,
    )
    return np.array([_unit(value) for value in values], np.float32)


def _unit(value: float) -> float:
    """Clip to [0, 1]; NaN becomes 0."""
    return 1.0 if value > 1.0 else value if value > 0.0 else 0.0


def display(greenhouse: Greenhouse) -> dict[str, str]:
    """Return what people and language models read in place of the observation."""
    pots = [plant for plant in greenhouse.pots if plant.health > 0]
    water = sum(plant.water for plant in pots) / max(1, len(pots))
    health = sum(plant.health for plant in pots) / max(1, len(pots))
    return {
        "day": f"{greenhouse.day + 1} of {DAYS}",
        "temperature": f"{greenhouse.temp} °C",
        "humidity of the air": f"{100 * greenhouse.humidity:.0f} %",
        "living plants": f"{len(pots)} of {len(greenhouse.pots)}",
        "their health": f"{100 * health:.0f} %",
        "water in a pot": f"{water:.2f} of {POT_CAPACITY:g} litres",
    }


@difference
def water_since(greenhouse: Greenhouse) -> float:
    """Litres poured since the previous decision of the agent that gets the reward."""
    return greenhouse.water_use


def reward(greenhouse: Greenhouse) -> float:
    """Compute the reward for the day since the agent's previous decision."""
    return greenhouse.alive / len(greenhouse.pots) - float(water_since(greenhouse)) / 1000


def to_fraction(action: Any) -> float:
    """Convert an action to a Python float, as NumPy's scalars would slow down the model."""
    return min(max(float(action.item() if isinstance(action, np.ndarray) else action), 0.0), 1.0)


def to_litres(action: Any) -> float:
    """Map the waterer's action to litres."""
    return MOST_WATER * to_fraction(action)


def from_litres(litres: float) -> list[float]:
    """Map the litres of the model's rule to the waterer's action."""
    return [litres / MOST_WATER]


def exchange_air(action: Any, greenhouse: Greenhouse) -> None:
    """Exchange the ventilator's fraction of the air, in place of the model's fixed 20 %."""
    fraction = to_fraction(action)
    greenhouse.humidity = (
        1 - fraction
    ) * greenhouse.humidity + fraction * greenhouse.outside_humidity


def usual_exchange(nothing: None, greenhouse: Greenhouse) -> list[float]:
    """Return the action of the model's rule: a fixed 20 %.

    The model's function applies this action and does not return it.
    """
    return [0.2]


OBSERVATION_SPACE: Final = Box(0.0, 1.0, (len(OBSERVED),), np.float32)
ACTION_SPACE: Final = Box(0.0, 1.0, (1,), np.float32)

WATERING: Final[dict[Any, Definition]] = {
    f"{Greenhouse.__module__}.Greenhouse.choose_water_amount": make_step(
        observation_space=OBSERVATION_SPACE,
        observation_space_mapping=observe,
        action_space=ACTION_SPACE,
        action_space_mapping=to_litres,
        rule_action_mapping=from_litres,
        reward_mapping=reward,
        agent=WATERER,
        question="How much water do you pour today, as a share of 1000 litres?",
        display_mapping=display,
        action_labels=["share of 1000 litres"],
        observation_labels=OBSERVED,
    )
}
"""The waterer's decision point."""

VENTILATION: Final[dict[Any, Definition]] = {
    f"{Greenhouse.__module__}.Greenhouse.update_air_exchange": make_step(
        observation_space=OBSERVATION_SPACE,
        observation_space_mapping=observe,
        action_space=ACTION_SPACE,
        apply=exchange_air,
        rule_action_mapping=usual_exchange,
        reward_mapping=reward,
        agent=VENTILATOR,
        question="How much of the air do you exchange for outside air today?",
        display_mapping=display,
        action_labels=["share of the air"],
        observation_labels=OBSERVED,
    )
}
"""The ventilator's decision point."""


# -- the simulation -------------------------------------------------------------------------------


class GreenhouseSim(SimulationInterface):
    """The simulation of a greenhouse for a hundred days, or until its plants are dead.

    Attributes:
        greenhouse: The greenhouse of the current episode.
    """

    points = WATERING | VENTILATION
    render_modes = ("ansi",)

    def __init__(self) -> None:
        self.greenhouse = Greenhouse()
        self._stopped = False

    def reset(self, seed: int | None = None) -> None:
        """Create a new greenhouse."""
        self.greenhouse = Greenhouse(seed)
        self._stopped = False

    def run(self) -> Any:
        """Simulate days until the last one, or until all plants are dead.

        Returns:
            ``TRUNCATED`` if plants are alive after the last day, else None.
        """
        greenhouse = self.greenhouse
        while not self._stopped and greenhouse.day < DAYS:
            anyone = greenhouse.alive > 0
            greenhouse.update_day()
            if not anyone:  # as in the paper, deaths end the episode on the next day
                return None
        return TRUNCATED if greenhouse.alive else None

    def reseed(self, seed: int) -> None:
        """Draw another future of the weather."""
        self.greenhouse.random.seed(seed)

    def expected_calls(self, point: str) -> list[tuple[Any, ...]]:
        """Return the call to come at a decision point: both points belong to the greenhouse."""
        return [(self.greenhouse,)]

    def stop(self) -> None:
        """Ask the loop to end after the current day."""
        self._stopped = True

    def render(self, mode: str) -> str:
        """Return the line that the model prints about its plants."""
        greenhouse = self.greenhouse
        alive = greenhouse.alive
        return f"day {greenhouse.day} alive: {alive}, dead: {len(greenhouse.pots) - alive}"


# -- environments: their options are those of the library's functions ------------------------------


def watering_env(**options: Any) -> SimulationEnv:
    """Make the environment of the waterer alone, while ventilation follows its rule."""
    return single_env(GreenhouseSim, WATERING, **options)


def ventilation_env(**options: Any) -> SimulationEnv:
    """Make the environment of the ventilator alone, while watering follows its rule."""
    return single_env(GreenhouseSim, VENTILATION, **options)


def raw_env(**options: Any) -> SimulationAECEnv:
    """Make the environment of both agents."""
    return aec_env(GreenhouseSim, **options)


def env(**options: Any) -> OrderEnforcingWrapper[str, Any, Any]:
    """Make the environment of both agents in PettingZoo's wrappers.

    The wrappers report wrong use and clip actions.
    """
    return OrderEnforcingWrapper(ClipOutOfBoundsWrapper(raw_env(**options)))


def parallel_env(**options: Any) -> SimulationParallelEnv:
    """Make the parallel environment: each day, both agents decide without seeing the other act."""
    return simenv_marl.parallel_env(GreenhouseSim, **options)


def joint_env(**options: Any) -> SimulationJointEnv:
    """Make the environment of one agent that takes both decisions.

    ``flatten=True`` makes them one vector.
    """
    return simenv_marl.joint_env(GreenhouseSim, **options)


def _register() -> None:
    """Register the environments with Gymnasium and PettingZoo, unless they already are."""
    for name in ("Watering", "Ventilation", "Joint"):
        if f"greenhouse_coop/{name}-v0" not in gymnasium.registry:
            gymnasium.register(f"greenhouse_coop/{name}-v0", f"{__name__}:{name.lower()}_env")
    for kind, maker in (("aec", "env"), ("parallel", "parallel_env")):
        # missing in the oldest supported PettingZoo
        known = getattr(pettingzoo, f"{kind}_registry", None)
        if known is not None and "greenhouse_coop/coop-v0" not in known:
            pettingzoo.register(kind, "greenhouse_coop/coop_v0", f"{__name__}:{maker}")


_register()
