"""Variants of the greenhouse: what an experiment changes about the model, from outside and under a name.

The Sim-Env paper extends its greenhouse twice. ``WARM_EXCHANGE`` is its ``new_air_exchange``: the warmer it is, the
faster the air is exchanged. ``VENTILATED`` is what it says could be done in the same way: the air exchange becomes
one that relies on a newly defined decision function, and so a second agent arrives by a plugin. The model, and
environments that are made without these variants, know nothing of them. ``greenhouse`` has both of them, the number of
plants and the climate as factors of an experiment.

Run on its own, it tells how the plants fare in each variant, and what each was made of::

    python -m examples.greenhouse_coop.variants
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

from simenv_marl import Variant, make_step, provenance, simulate

from .env import ACTION_SPACE, OBSERVATION_SPACE, WATERING, GreenhouseSim, observe, reward, to_fraction
from .model import HIGHEST_TEMPERATURE, LOWEST_TEMPERATURE, OUTSIDE_HUMIDITY, PLANTS, Greenhouse, Plant
from .plan import BEST, VENTILATOR

AIR_EXCHANGE = f"{Greenhouse.__module__}.Greenhouse.update_air_exchange"
"""What the plugins replace."""

TEMPERATURE = f"{Greenhouse.__module__}.Greenhouse.update_temperature"
"""What the plugin of the climate replaces."""


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
    """Decide which fraction of the air is replaced: a decision that the model does not know.

    Returns:
        A fifth, as the model has it.
    """
    return 0.2


def decided_air_exchange(greenhouse: Greenhouse) -> None:
    """Exchange as much air as was decided."""
    fraction = choose_air_exchange(greenhouse)
    greenhouse.humidity = (1 - fraction) * greenhouse.humidity + fraction * greenhouse.outside_humidity


BASE = Variant("base", GreenhouseSim, points=WATERING)
"""The model as it is, watered by an agent."""

WARM_EXCHANGE = Variant(
    "warm_exchange", GreenhouseSim, points=WATERING, plugins=[(new_air_exchange, AIR_EXCHANGE, "instead")]
)
"""Watered by an agent, while the air is exchanged the faster the warmer it is."""

VENTILATED = Variant(
    "ventilated",
    GreenhouseSim,
    points={**WATERING, choose_air_exchange: None},
    plugins=[(decided_air_exchange, AIR_EXCHANGE, "instead")],
)
"""Two agents: one of them decides what the plugin asks."""


# -- the same as factors --------------------------------------------------------------------------


def new_temperature(greenhouse: Greenhouse) -> None:
    """Draw each day's temperature anew between its bounds, as the paper's text has it; its code lets it walk."""
    greenhouse.temp = greenhouse.random.randint(LOWEST_TEMPERATURE, HIGHEST_TEMPERATURE)


class House(GreenhouseSim):
    """A greenhouse with any number of plants, in air of any humidity."""

    def __init__(self, plants: int = PLANTS, outside_humidity: float = OUTSIDE_HUMIDITY) -> None:
        """Make a simulation.

        Args:
            plants: How many plants there are.
            outside_humidity: Relative humidity of the air outside.
        """
        super().__init__()
        self.plants, self.outside_humidity = plants, outside_humidity

    def reset(self, seed: int | None = None) -> None:
        """Furnish a new greenhouse: with the model's own plants, fewer of them, or some more."""
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
"""What becomes of the air: a fixed fifth of it is exchanged; more on warm days; or what was decided, which is all."""


def greenhouse(plants: int, climate: str, exchange: str) -> Variant:
    """Make the greenhouse of a row of an experiment.

    Args:
        plants: How many plants there are.
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
    """Print how the plants fare in each variant with its rules, and what the last one was made of."""
    for variant in (BASE, WARM_EXCHANGE, VENTILATED):
        print(f"{variant.name:15}", simulate(variant, seed=1).render("ansi"))
    print(json.dumps(provenance(VENTILATED, seed=1), indent=2))


if __name__ == "__main__":
    main()
