"""The domain model: a greenhouse whose plants are watered by a rule that means too well.

After supplement S1 of the Sim-Env paper, with its parameters and its order of events. Nothing here knows of
reinforcement learning, of environments or of anyone who would decide otherwise than the rules below.

Run on its own, it tells how the plants fare day by day::

    python -m examples.greenhouse_coop.model
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from random import Random

PLANTS = 200
AIR_VOLUME = 2400.0  # cubic metres
SATURATION = 0.20  # kilograms of water that a cubic metre of air can hold
OUTSIDE_HUMIDITY = 0.6  # relative
LOWEST_TEMPERATURE, HIGHEST_TEMPERATURE = 15, 35  # degrees Celsius
POT_CAPACITY = 3.0  # litres; more of it drowns the plant


class Greenhouse:
    """A room full of potted plants, and the weather in it.

    Its random numbers are its own: houses of the same seed fare alike, whatever else goes on around them.

    Attributes:
        pots: The plants.
        day: How many days have gone by.
        temp: Temperature in degrees Celsius.
        humidity: Relative humidity of the air inside.
        outside_humidity: Relative humidity of the air outside, which never changes.
        size: Volume of the air inside, in cubic metres.
        water_use: Litres that have been poured so far.
    """

    def __init__(self, seed: int | None = None) -> None:
        """Furnish a greenhouse.

        Args:
            seed: Determines plants and weather; None: they are different each time.
        """
        self.random = Random(seed)
        self.pots = [Plant(self) for _ in range(PLANTS)]
        self.day = 0
        self.temp = 20
        self.humidity = OUTSIDE_HUMIDITY
        self.outside_humidity = OUTSIDE_HUMIDITY
        self.size = AIR_VOLUME
        self.water_use = 0.0

    @property
    def alive(self) -> int:
        """How many plants are alive."""
        return len([plant for plant in self.pots if plant.health > 0])

    def update_day(self) -> None:
        """Let a day go by."""
        self.update_temperature()
        self.update_humidity()
        self.update_air_exchange()
        for plant in self.pots:
            plant.update_day()
        self.water_plants()
        self.day += 1

    def update_temperature(self) -> None:
        """Make it up to two degrees warmer or colder, within bounds."""
        temp = self.temp + int(self.random.random() * 5) - 2
        self.temp = min(max(temp, LOWEST_TEMPERATURE), HIGHEST_TEMPERATURE)

    def update_humidity(self) -> None:
        """Let water evaporate from the pots into the air: the more, the warmer and the drier that is."""
        portion = self.temp / 100 * (1 - self.humidity)
        vapour = 0.0
        # No min() or max() where something is done for every plant: they would take half of the day's time.
        for plant in self.pots:
            loss = portion * plant.water
            rest = plant.water - loss
            plant.water = rest if rest > 0 else 0.0
            vapour += loss
        self.humidity = (self.humidity * SATURATION + vapour / self.size) / SATURATION

    def update_air_exchange(self) -> None:
        """Replace a fifth of the air by air from outside."""
        self.humidity = 0.8 * self.humidity + 0.2 * self.outside_humidity

    def choose_water_amount(self) -> float:
        """Decide how many litres to pour today.

        Returns:
            A litre for each pot, every day, which is more than any plant can take.
        """
        return 200

    def water_plants(self) -> None:
        """Pour what was decided, in equal parts."""
        amount = self.choose_water_amount()
        portion = amount / len(self.pots)
        for plant in self.pots:
            plant.water += portion
        self.water_use += amount


class Plant:
    """A plant in its pot.

    Attributes:
        greenhouse: Where it stands.
        water: Litres in its pot.
        health: From 1, in full bloom, to 0, dead, from where none comes back.
        req_water: Litres that it takes from its pot in a day.
    """

    __slots__ = ("__weakref__", "greenhouse", "health", "req_water", "water")

    def __init__(self, greenhouse: Greenhouse) -> None:
        """Pot a plant, of a health and a thirst of its own."""
        draw = greenhouse.random.random
        self.greenhouse = greenhouse
        self.water = 2.0
        self.health = 0.1 + 0.8 * draw()
        self.req_water = 0.1 + 0.3 * draw()

    def update_day(self) -> None:
        """Drink, and feel better or worse for what is left in the pot."""
        rest = self.water - self.req_water
        self.water = rest if rest > 0 else 0.0
        self.update_health()

    def update_health(self) -> None:
        """Recover a little, unless the pot is dry or flooded."""
        if self.health == 0:
            return
        if self.water <= 0 or self.water > POT_CAPACITY:
            health = self.health - 0.25
            self.health = health if health > 0 else 0.0
        else:
            health = self.health + 0.1
            self.health = health if health < 1 else 1.0


def main(arguments: Sequence[str] | None = None) -> None:
    """Print how the plants fare."""
    parser = argparse.ArgumentParser(description="Let the greenhouse be run by its own rules.")
    parser.add_argument("--days", type=int, default=10, help="for how many days (default: 10)")
    parser.add_argument("--seed", type=int, help="of plants and weather (default: different each time)")
    options = parser.parse_args(arguments)
    greenhouse = Greenhouse(options.seed)
    for day in range(options.days):
        alive = greenhouse.alive
        print(f"day {day} alive: {alive}, dead: {len(greenhouse.pots) - alive}")
        greenhouse.update_day()


if __name__ == "__main__":
    main()
