"""The greenhouse as environments: two of its decisions become agents that share one reward.

After supplement S2 of the Sim-Env paper, and the two agents that its outlook promises: ``waterer_0`` decides how
many litres are poured, ``ventilator_0`` how much air is exchanged. The model knows nothing of either: its functions
are named as decision points from here, and stay what they are for everyone else.

- ``raw_env`` and ``env``: both agents, as a PettingZoo AEC environment, bare and in PettingZoo's wrappers.
- ``parallel_env``: both agents, as a PettingZoo parallel environment, a round a day.
- ``joint_env``: one agent that takes both decisions, as a Gymnasium environment; its reward is the sum of the two.
- ``watering_env``: the waterer alone, as a Gymnasium environment; ventilation runs its rule.
- ``ventilation_env``: the ventilator alone; watering runs its rule.

Importing this module registers them: ``pettingzoo.make("aec", "greenhouse_coop/coop_v0")``, the same with
``"parallel"``, and ``gymnasium.make`` of ``"greenhouse_coop/Watering-v0"``, ``"greenhouse_coop/Ventilation-v0"`` and
``"greenhouse_coop/Joint-v0"``.

Both agents are rewarded alike, once a day: with the share of the plants that are alive, less a thousandth for each
litre poured since their decision of the day before. As it is one reward, the return of the team is the return of
*one* of its agents and not the sum: say, of the ventilator, whose return is the sum over all days. (The waterer, who
is asked after the plants have had their day, is not rewarded for the first day, when all plants are alive, but for
the last one twice: its return is less by the share of the plants that are dead in the end.)
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
    SimulationAECEnv,
    SimulationEnv,
    SimulationInterface,
    SimulationJointEnv,
    SimulationParallelEnv,
    aec_env,
    difference,
    make_step,
    single_env,
)

from .model import HIGHEST_TEMPERATURE, LOWEST_TEMPERATURE, POT_CAPACITY, Greenhouse

DAYS: Final = 100
"""After how many days an episode is truncated."""

MOST_WATER: Final = 1000.0
"""Litres that the waterer can pour in a day."""

OBSERVED: Final = (
    "temperature, between its bounds",
    "relative humidity",
    "share of the plants that are alive",
    "share of the days that are gone",
    "water in the pots of living plants: its mean, by what a pot holds",
    "the same, each pot counted by what its plant lacks in health: are the weak too dry or too wet?",
)
"""What both agents observe."""


# -- what is observed, decided and rewarded -------------------------------------------------------


def observe(greenhouse: Greenhouse) -> NDArray[np.float32]:
    """Observe what ``OBSERVED`` lists.

    All of it is clipped to [0, 1], whatever it has come to: nothing in the model bounds the humidity, and bad enough
    decisions drive it, and the water along with it, as far as to infinity.
    """
    living = 0
    water = lack = water_by_lack = 0.0
    for plant in greenhouse.pots:  # once through all, because this takes most of the time of a decision
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
    """Clip to [0, 1]; what is not even a number becomes 0."""
    return 1.0 if value > 1.0 else value if value > 0.0 else 0.0


@difference
def _water_since(greenhouse: Greenhouse) -> float:
    """Litres poured since the agent that is being rewarded was last asked."""
    return greenhouse.water_use


def reward(greenhouse: Greenhouse) -> float:
    """The reward of the day that has gone by since the agent's decision before."""
    return greenhouse.alive / len(greenhouse.pots) - float(_water_since(greenhouse)) / 1000


def to_fraction(action: Any) -> float:
    """The action as a python number, which keeps NumPy's slower ones out of the model."""
    return min(max(float(action.item() if isinstance(action, np.ndarray) else action), 0.0), 1.0)


def to_litres(action: Any) -> float:
    """What the waterer's action decides: litres to pour."""
    return MOST_WATER * to_fraction(action)


def exchange_air(action: Any, greenhouse: Greenhouse) -> None:
    """What the ventilator's action does in place of the model's fixed 20 %: exchange that fraction of the air."""
    fraction = to_fraction(action)
    greenhouse.humidity = (1 - fraction) * greenhouse.humidity + fraction * greenhouse.outside_humidity


OBSERVATION_SPACE: Final = Box(0.0, 1.0, (len(OBSERVED),), np.float32)
ACTION_SPACE: Final = Box(0.0, 1.0, (1,), np.float32)

WATERING: Final[dict[Any, Definition]] = {
    f"{Greenhouse.__module__}.Greenhouse.choose_water_amount": make_step(
        observation_space=OBSERVATION_SPACE,
        observation_space_mapping=observe,
        action_space=ACTION_SPACE,
        action_space_mapping=to_litres,
        rule_action_mapping=lambda litres: [litres / MOST_WATER],
        reward_mapping=reward,
        agent="waterer_0",
    )
}
"""The waterer's decision point."""

VENTILATION: Final[dict[Any, Definition]] = {
    f"{Greenhouse.__module__}.Greenhouse.update_air_exchange": make_step(
        observation_space=OBSERVATION_SPACE,
        observation_space_mapping=observe,
        action_space=ACTION_SPACE,
        apply=exchange_air,
        rule_action_mapping=lambda nothing, greenhouse: [0.2],  # the fixed 20 %, which the model decides by doing
        reward_mapping=reward,
        agent="ventilator_0",
    )
}
"""The ventilator's decision point."""


# -- the simulation -------------------------------------------------------------------------------


class GreenhouseSim(SimulationInterface):
    """Runs a greenhouse for a hundred days, or until its plants are dead.

    Attributes:
        greenhouse: The greenhouse of the present episode.
    """

    points = WATERING | VENTILATION
    render_modes = ("ansi",)

    def __init__(self) -> None:
        self.greenhouse = Greenhouse()
        self._stopped = False

    def reset(self, seed: int | None = None) -> None:
        """Furnish a new greenhouse."""
        self.greenhouse = Greenhouse(seed)
        self._stopped = False

    def run(self) -> Any:
        """Let day after day go by.

        Returns:
            ``TRUNCATED`` where plants have lived to see the last day.
        """
        greenhouse = self.greenhouse
        while not self._stopped and greenhouse.day < DAYS:
            anyone = greenhouse.alive > 0
            greenhouse.update_day()
            if not anyone:  # as in the paper, only who comes in the next morning finds them dead
                return None
        return TRUNCATED if greenhouse.alive else None

    def reseed(self, seed: int) -> None:
        """Draw the weather that lies ahead anew."""
        self.greenhouse.random.seed(seed)

    def expected_calls(self, point: str) -> list[tuple[Any, ...]]:
        """Whose decision will be called for: either is the greenhouse's."""
        return [(self.greenhouse,)]

    def stop(self) -> None:
        """Ask the loop to end after the present day."""
        self._stopped = True

    def render(self, mode: str) -> str:
        """Tell how the plants fare, in the words of the model."""
        greenhouse = self.greenhouse
        alive = greenhouse.alive
        return f"day {greenhouse.day} alive: {alive}, dead: {len(greenhouse.pots) - alive}"


# -- environments ---------------------------------------------------------------------------------


def watering_env(**options: Any) -> SimulationEnv:
    """Make the environment of the waterer alone, while ventilation runs its rule.

    Args:
        **options: As ``simenv_marl.single_env`` takes them.
    """
    return single_env(GreenhouseSim, WATERING, **options)


def ventilation_env(**options: Any) -> SimulationEnv:
    """Make the environment of the ventilator alone, while watering runs its rule.

    Args:
        **options: As ``simenv_marl.single_env`` takes them.
    """
    return single_env(GreenhouseSim, VENTILATION, **options)


def raw_env(**options: Any) -> SimulationAECEnv:
    """Make the environment of both agents.

    Args:
        **options: As ``simenv_marl.aec_env`` takes them.
    """
    return aec_env(GreenhouseSim, **options)


def env(**options: Any) -> OrderEnforcingWrapper[str, Any, Any]:
    """Make the environment of both agents in PettingZoo's wrappers, which tell mistakes and clip actions.

    Args:
        **options: As ``simenv_marl.aec_env`` takes them.
    """
    return OrderEnforcingWrapper(ClipOutOfBoundsWrapper(raw_env(**options)))


def parallel_env(**options: Any) -> SimulationParallelEnv:
    """Make the environment of both agents in which they decide day by day, and see nothing of each other's decision.

    Args:
        **options: As ``simenv_marl.parallel_env`` takes them.
    """
    return simenv_marl.parallel_env(GreenhouseSim, **options)


def joint_env(**options: Any) -> SimulationJointEnv:
    """Make the environment of one agent that takes both decisions; ``flatten=True`` makes one vector of them.

    Args:
        **options: As ``simenv_marl.joint_env`` takes them.
    """
    return simenv_marl.joint_env(GreenhouseSim, **options)


def _register() -> None:
    """Tell the registries of Gymnasium and PettingZoo, unless they know already."""
    for name, entry_point in (
        ("Watering", "watering_env"),
        ("Ventilation", "ventilation_env"),
        ("Joint", "joint_env"),
    ):
        if f"greenhouse_coop/{name}-v0" not in gymnasium.registry:
            gymnasium.register(f"greenhouse_coop/{name}-v0", f"{__name__}:{entry_point}")
    for kind, entry_point in (("aec", "env"), ("parallel", "parallel_env")):
        known = getattr(pettingzoo, f"{kind}_registry", None)  # younger than the oldest PettingZoo that will do
        if known is not None and "greenhouse_coop/coop-v0" not in known:
            pettingzoo.register(kind, "greenhouse_coop/coop_v0", f"{__name__}:{entry_point}")


_register()
