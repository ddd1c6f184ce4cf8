"""Variants of the greenhouse: what an experiment changes about the model, from outside and under a name.

The Sim-Env paper extends its greenhouse twice. ``WARM_EXCHANGE`` is its ``new_air_exchange``: the warmer it is, the
faster the air is exchanged. ``VENTILATED`` is what it says could be done in the same way: the air exchange becomes
one that relies on a newly defined decision function, and so a second agent arrives by a plugin. The model, and
environments that are made without these variants, know nothing of them.

Run on its own, it tells how the plants fare in each variant, and what each was made of::

    python -m examples.greenhouse_coop.variants
"""

from __future__ import annotations

import json

from simenv_marl import Variant, make_step, provenance, simulate

from .env import ACTION_SPACE, OBSERVATION_SPACE, WATERING, GreenhouseSim, observe, reward, to_fraction
from .model import Greenhouse

AIR_EXCHANGE = f"{Greenhouse.__module__}.Greenhouse.update_air_exchange"
"""What the plugins replace."""


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


def main() -> None:
    """Print how the plants fare in each variant with its rules, and what the last one was made of."""
    for variant in (BASE, WARM_EXCHANGE, VENTILATED):
        print(f"{variant.name:15}", simulate(variant, seed=1).render("ansi"))
    print(json.dumps(provenance(VENTILATED, seed=1), indent=2))


if __name__ == "__main__":
    main()
