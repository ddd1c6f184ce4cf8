"""Variants of the greenhouse: named changes that an experiment makes to the model from outside.

The Sim-Env paper extends its greenhouse twice. ``WARM_EXCHANGE`` is the paper's
``new_air_exchange``: the warmer it is, the faster the air is exchanged. ``VENTILATED`` is the
extension that the paper suggests: the air exchange calls a newly defined decision function, so that
a plugin adds a second agent. The model, and environments without these variants, stay unchanged.
``greenhouse`` makes the air exchange, the number of plants and the climate factors of an
experiment.

As a script, the module prints the plants' numbers in each variant, and the provenance of the last
one::

    python -m studies.greenhouse_matrix.variants
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

from examples.greenhouse_coop.env import (
    ACTION_SPACE,
    OBSERVATION_SPACE,
    VENTILATOR,
    WATERING,
    GreenhouseSim,
    observe,
    reward,
    to_fraction,
)
from examples.greenhouse_coop.model import (
    HIGHEST_TEMPERATURE,
    LOWEST_TEMPERATURE,
    OUTSIDE_HUMIDITY,
    PLANTS,
    Greenhouse,
    Plant,
)
from examples.greenhouse_coop.plan import BEST

from simenv_marl import make_step, simulate
from simenv_marl.experiments import Variant, provenance

AIR_EXCHANGE = f"{Greenhouse.__module__}.Greenhouse.update_air_exchange"
"""The function that the plugins replace."""

TEMPERATURE = f"{Greenhouse.__module__}.Greenhouse.update_temperature"
"""The function that the climate's plugin replaces."""


def new_air_exchange(greenhouse: Greenhouse) -> None:
    """Exchange the air faster at higher temperatures (paper, section 4, step 3)."""
    factor = (greenhouse.temp - 15) / 20
    greenhouse.humidity += factor * (greenhouse.outside_humidity - greenhouse.humidity)


@make_step(
    observation_space=OBSERVATION_SPACE,
    observation_space_mapping=observe,
    action_space=ACTION_SPACE,
    action_space_mapping=to_fraction,
    reward_mapping=reward,
    agent="ventilator_0",
)
def choose_air_exchange(greenhouse: Greenhouse) -> float:
    """Choose the fraction of air to replace: a decision that the model does not contain.

    Returns:
        A fifth, as in the model.
    """
    return 0.2


def decided_air_exchange(greenhouse: Greenhouse) -> None:
    """Exchange the chosen fraction of the air."""
    fraction = choose_air_exchange(greenhouse)
    greenhouse.humidity = (
        1 - fraction
    ) * greenhouse.humidity + fraction * greenhouse.outside_humidity


BASE = Variant("base", GreenhouseSim, points=WATERING)
"""The unchanged model, watered by an agent."""

WARM_EXCHANGE = Variant(
    "warm_exchange",
    GreenhouseSim,
    points=WATERING,
    plugins=[(new_air_exchange, AIR_EXCHANGE, "instead")],
)
"""Watered by an agent; the warmer it is, the faster the air is exchanged."""

VENTILATED = Variant(
    "ventilated",
    GreenhouseSim,
    points={**WATERING, choose_air_exchange: None},
    plugins=[(decided_air_exchange, AIR_EXCHANGE, "instead")],
)
"""Two agents: the waterer, and one for the plugin's decision."""


# -- variants as factors --------------------------------------------------------------------------


def new_temperature(greenhouse: Greenhouse) -> None:
    """Draw each day's temperature uniformly between its bounds, as in the paper's text.

    In its code, it is a walk.
    """
    greenhouse.temp = greenhouse.random.randint(LOWEST_TEMPERATURE, HIGHEST_TEMPERATURE)


class House(GreenhouseSim):
    """The simulation of a greenhouse with any number of plants and any outside humidity."""

    def __init__(self, plants: int = PLANTS, outside_humidity: float = OUTSIDE_HUMIDITY) -> None:
        """Make a simulation.

        Args:
            plants: The number of plants.
            outside_humidity: Relative humidity of the air outside.
        """
        super().__init__()
        self.plants, self.outside_humidity = plants, outside_humidity

    def reset(self, seed: int | None = None) -> None:
        """Create a new greenhouse: with the model's plants, fewer of them, or additional ones."""
        super().reset(seed)
        greenhouse = self.greenhouse
        del greenhouse.pots[self.plants :]
        greenhouse.pots += [Plant(greenhouse) for _ in range(self.plants - len(greenhouse.pots))]
        greenhouse.outside_humidity = self.outside_humidity


CLIMATES: Final[Mapping[str, tuple[Mapping[str, Any], tuple[Any, ...]]]] = {
    "mild": ({}, ()),
    "dry": ({"outside_humidity": OUTSIDE_HUMIDITY / 2}, ()),
    "erratic": ({}, ((new_temperature, TEMPERATURE, "instead"),)),
}
"""Parameters and plugins of each climate. The first is the model's own."""

EXCHANGES: Final[Mapping[str, Variant]] = {
    "fixed": BASE,
    "warm": WARM_EXCHANGE,
    "decided": replace(VENTILATED, policies={VENTILATOR: BEST[VENTILATOR]}),
}
"""The air exchange: a fixed fifth of the air.

More on warm days; or a decision, here for all of the air.
"""


def greenhouse(plants: int, climate: str, exchange: str) -> Variant:
    """Make the variant for a row of an experiment.

    Args:
        plants: The number of plants.
        climate: One of ``CLIMATES``.
        exchange: One of ``EXCHANGES``.
    """
    parameters, plugins = CLIMATES[climate]
    base = EXCHANGES[exchange]
    return replace(
        base,
        name=f"{plants}_{climate}_{exchange}",
        simulation=House,
        parameters={"plants": plants, **parameters},
        plugins=(*base.plugins, *plugins),
    )


def main() -> None:
    """Print the plants' numbers in each variant with its rules, and the last one's provenance."""
    for variant in (BASE, WARM_EXCHANGE, VENTILATED):
        print(f"{variant.name:15}", simulate(variant, seed=1).render("ansi"))
    print(json.dumps(provenance(VENTILATED, seed=1), indent=2))


if __name__ == "__main__":
    main()
