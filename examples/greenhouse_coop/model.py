"""The domain model: a greenhouse whose rule overwaters the plants.

This follows supplement S1 of the Sim-Env paper, with its parameters and its order of events. The
model contains no reinforcement learning and no environments: only the rules below decide.

As a script, it prints the numbers of living and dead plants day by day::

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
POT_CAPACITY = 3.0  # litres; more water drowns the plant


class Greenhouse:
    """A greenhouse with potted plants and weather.

    It has its own random number generator, so greenhouses with the same seed develop alike,
    whatever else runs.

    Attributes:
        pots: The plants.
        day: The number of past days.
        temp: Temperature in degrees Celsius.
        humidity: Relative humidity of the air inside.
        outside_humidity: Relative humidity of the air outside; constant.
        size: Volume of the air inside, in cubic metres.
        water_use: Litres poured so far.
    """

    def __init__(self, seed: int | None = None) -> None:
        """Create a greenhouse.

        Args:
            seed: The seed of plants and weather; None: a new one each time.
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
        """The number of living plants."""
        return len([plant for plant in self.pots if plant.health > 0])

    def update_day(self) -> None:
        """Simulate one day."""
        self.update_temperature()
        self.update_humidity()
        self.update_air_exchange()
        for plant in self.pots:
            plant.update_day()
        self.water_plants()
        self.day += 1

    def update_temperature(self) -> None:
        """Change the temperature by up to two degrees, within bounds."""
        temp = self.temp + int(self.random.random() * 5) - 2
        self.temp = min(max(temp, LOWEST_TEMPERATURE), HIGHEST_TEMPERATURE)

    def update_humidity(self) -> None:
        """Let water evaporate from the pots: the warmer and drier the air, the more."""
        portion = self.temp / 100 * (1 - self.humidity)
        vapour = 0.0
        # no min() or max() in the loop over plants, because they would take half of the run time
        for plant in self.pots:
            loss = portion * plant.water
            rest = plant.water - loss
            plant.water = rest if rest > 0 else 0.0
            vapour += loss
        self.humidity = (self.humidity * SATURATION + vapour / self.size) / SATURATION

    def update_air_exchange(self) -> None:
        """Replace a fifth of the air with outside air."""
        self.humidity = 0.8 * self.humidity + 0.2 * self.outside_humidity

    def choose_water_amount(self) -> float:
        """Choose how many litres to pour today.

        Returns:
            A litre per pot each day, which is more than any plant can take.
        """
        return 200

    def water_plants(self) -> None:
        """Pour the chosen amount, in equal parts."""
        amount = self.choose_water_amount()
        portion = amount / len(self.pots)
        for plant in self.pots:
            plant.water += portion
        self.water_use += amount


class Plant:
    """A potted plant.

    Attributes:
        greenhouse: The plant's greenhouse.
        water: Litres in its pot.
        health: From 1 (full health) to 0 (dead), which is final.
        req_water: Litres that it takes from its pot in a day.
    """

    __slots__ = ("__weakref__", "greenhouse", "health", "req_water", "water")

    def __init__(self, greenhouse: Greenhouse) -> None:
        """Create a plant with random health and water demand."""
        draw = greenhouse.random.random
        self.greenhouse = greenhouse
        self.water = 2.0
        self.health = 0.1 + 0.8 * draw()
        self.req_water = 0.1 + 0.3 * draw()

    def update_day(self) -> None:
        """Take water from the pot, then update the health by what is left."""
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
    """Print the numbers of living and dead plants day by day."""
    parser = argparse.ArgumentParser(description="Run the greenhouse by its own rules.")
    parser.add_argument(
        "--days", type=int, default=10, help="how many days to simulate (default: 10)"
    )
    parser.add_argument(
        "--seed", type=int, help="seed of plants and weather (default: a new one each time)"
    )
    options = parser.parse_args(arguments)
    greenhouse = Greenhouse(options.seed)
    for day in range(options.days):
        alive = greenhouse.alive
        print(f"day {day} alive: {alive}, dead: {len(greenhouse.pots) - alive}")
        greenhouse.update_day()


if __name__ == "__main__":
    main()
