"""Two rooms, the people in them, and what it costs to keep them warm: a model on top of EnergyPlus.

It knows nothing of reinforcement learning: ``python -m examples.energyplus_zones.model`` runs it by its own rule.
"""

from __future__ import annotations

import random
from datetime import date, timedelta
from pathlib import Path
from string import Template
from typing import Final

from .engine import Engine

STEPS_PER_HOUR: Final = 20
"""As the building has it."""

STEPS_PER_DECISION: Final = 5
"""Thermostats are set every quarter of an hour."""

DAYS: Final = 3
"""How many days a run takes, all of them working days."""

MONDAYS: Final = [date(2018, 1, 8) + timedelta(weeks=week) for week in range(7)]

LOWEST_SETPOINT, HIGHEST_SETPOINT = 15.0, 23.0
COMFORT: Final = 20.0
"""Below so many degrees people are cold."""

COLD: Final = 0.25
"""What it costs if a person is a degree too cold for an hour."""


def price(hour: float) -> float:
    """What a kilowatt hour costs: half as much by night."""
    return 0.15 if hour <= 6 or hour > 22 else 0.3


class Zone:
    """A room.

    Attributes:
        building: The building.
        name: Its name.
        other: The room beside it.
        begin, end, expected: When people come and leave on the present day, and how many.
        people: How many people are in it.
        temperature: Of its air.
        setpoint: Up to which temperature its heater works.
        energy: Kilowatt hours that its heater has used.
        cost: What that has cost, with what it costs that people were cold.
    """

    other: Zone

    def __init__(self, building: Building, name: str) -> None:
        """Put a heater, a thermometer and a thermostat into a room of the building."""
        engine = building.engine
        self.building, self.name = building, name.lower()
        self.people, self.temperature, self.setpoint = 0, 0.0, 0.0
        self.energy = self.cost = 0.0
        self.begin = self.end = 0.0
        self.expected = 0
        self._air = engine.sensor("Zone Mean Air Temperature", name)
        self._power = engine.sensor("Baseboard Electricity Rate", f"{name} heater")
        self._thermostat = engine.actuator("Zone Temperature Control", "Heating Setpoint", name)
        self._people = engine.actuator("People", "Number of People", f"{name} people")

    def plan_day(self) -> None:
        """Draw when people come today, how many, and when they leave; on some days none come."""
        rng = self.building.random
        self.begin, self.end = rng.uniform(7, 10), rng.uniform(14, 18)
        self.expected = rng.choice((0, 1, 2, 3, 4))

    def look(self) -> None:
        """See how warm it is, and who is there."""
        engine = self.building.engine
        self.temperature = engine.read(self._air)
        self.people = self.expected if self.begin <= engine.hour < self.end else 0
        engine.set(self._people, self.people)

    def heat(self) -> None:
        """Set the thermostat."""
        self.setpoint = float(self.choose_setpoint())
        self.building.engine.set(self._thermostat, self.setpoint)

    def choose_setpoint(self) -> float:
        """Decide how warm it is to be.

        Returns:
            What a time switch says: warm from six to six.
        """
        return COMFORT + 0.5 if 6 <= self.building.hour < 18 else 16.0

    def account(self, hours: float) -> None:
        """Take down what some time has cost."""
        engine = self.building.engine
        self.temperature = engine.read(self._air)
        energy = engine.read(self._power) / 1000 * hours
        self.energy += energy
        cold = max(0.0, COMFORT - self.temperature)
        self.cost += energy * price(engine.hour) + COLD * cold * self.people * hours


class Building:
    """The two rooms through some days in winter.

    Attributes:
        engine: EnergyPlus.
        random: What chance is drawn from: the days, and the people of each.
        zones: The rooms.
        hour, weekday: Of the present time step.
        outside: The temperature of the air outside.
        steps: How many time steps have begun.
    """

    def __init__(self, seed: int | None = None) -> None:
        """Build it, and draw the days of the run."""
        self.random = random.Random(seed)
        first = self.random.choice(MONDAYS) + timedelta(self.random.randrange(5 - DAYS + 1))
        last = first + timedelta(DAYS - 1)
        text = Template((Path(__file__).parent / "two_zones.idf").read_text())
        days = {"begin": f"{first.month},{first.day}", "end": f"{last.month},{last.day}"}
        self.engine = engine = Engine(text.substitute(days))
        self._outside = engine.sensor("Site Outdoor Air Drybulb Temperature", "Environment")
        south, north = self.zones = [Zone(self, "South"), Zone(self, "North")]
        south.other, north.other = north, south
        self.hour, self.weekday, self.outside, self.steps = 0.0, first.weekday(), 0.0, 0
        engine.at_begin_of_step(self.begin_step)
        engine.at_end_of_step(self.end_step)

    def run(self) -> None:
        """Let the days go by."""
        self.engine.run()

    def begin_step(self) -> None:
        """Let people come and go, and from time to time decide for each room how warm it is to be."""
        engine, before = self.engine, self.weekday
        self.hour, self.weekday, self.outside = engine.hour, engine.weekday, engine.read(self._outside)
        if self.steps == 0 or self.weekday != before:
            for zone in self.zones:
                zone.plan_day()
        for zone in self.zones:
            zone.look()
        if self.steps % STEPS_PER_DECISION == 0:
            for zone in self.zones:
                zone.heat()
        self.steps += 1

    def end_step(self) -> None:
        """Take down what a time step has cost."""
        if self.steps:
            for zone in self.zones:
                zone.account(self.engine.hours_of_step)

    @property
    def cost(self) -> float:
        """What both rooms have cost."""
        return sum(zone.cost for zone in self.zones)

    def close(self) -> None:
        """Let go of EnergyPlus."""
        self.engine.close()


def main() -> None:
    """Run the model as it is."""
    building = Building(seed=0)
    building.run()
    for zone in building.zones:
        print(f"{zone.name}: {zone.energy:.1f} kWh, {zone.cost:.2f} in all, {zone.temperature:.1f} °C in the end")
    building.close()


if __name__ == "__main__":
    main()
