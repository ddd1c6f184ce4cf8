"""A model on top of EnergyPlus: two rooms, their occupants, the cost of heating and discomfort.

It contains no reinforcement learning: ``python -m examples.energyplus_zones.model`` runs it by its
own rule.
"""

from __future__ import annotations

import random
from datetime import date, timedelta
from pathlib import Path
from string import Template
from typing import Final

from .engine import Engine

STEPS_PER_HOUR: Final = 20
"""Time steps per hour, as in the building's input file."""

STEPS_PER_DECISION: Final = 5
"""Time steps between decisions: the model sets thermostats every quarter of an hour."""

DAYS: Final = 3
"""The length of a run in days, all of them working days."""

MONDAYS: Final = [date(2018, 1, 8) + timedelta(weeks=week) for week in range(7)]

LOWEST_SETPOINT, HIGHEST_SETPOINT = 15.0, 23.0
COMFORT: Final = 20.0
"""The temperature below which people are cold, in degrees Celsius."""

COLD: Final = 0.25
"""The cost per person, degree below ``COMFORT`` and hour."""


def price(hour: float) -> float:
    """Return the price of a kilowatt hour, which is half as high at night."""
    return 0.15 if hour <= 6 or hour > 22 else 0.3


class Zone:
    """A room of the building.

    Attributes:
        building: The building.
        name: The name of the room.
        other: The adjacent room.
        begin, end, expected: The hours at which people come and leave on the current day, and their
            number.
        people: The number of people in the room.
        temperature: The air temperature, in degrees Celsius.
        setpoint: The setpoint of its heater, in degrees Celsius.
        energy: The energy that its heater has used, in kilowatt hours.
        cost: The cost so far, of energy and of discomfort.
    """

    other: Zone

    def __init__(self, building: Building, name: str) -> None:
        """Connect to the room's heater, thermometer and thermostat in EnergyPlus."""
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
        """Draw the hours at which people come and leave today, and their number, which may be 0."""
        rng = self.building.random
        self.begin, self.end = rng.uniform(7, 10), rng.uniform(14, 18)
        self.expected = rng.choice((0, 1, 2, 3, 4))

    def look(self) -> None:
        """Update the temperature and the number of people."""
        engine = self.building.engine
        self.temperature = engine.read(self._air)
        self.people = self.expected if self.begin <= engine.hour < self.end else 0
        engine.set(self._people, self.people)

    def heat(self) -> None:
        """Set the thermostat."""
        self.setpoint = float(self.choose_setpoint())
        self.building.engine.set(self._thermostat, self.setpoint)

    def choose_setpoint(self) -> float:
        """Choose the setpoint, in degrees Celsius.

        Returns:
            The setpoint of a time switch: warm from 6 to 18 o'clock.
        """
        return COMFORT + 0.5 if 6 <= self.building.hour < 18 else 16.0

    def account(self, hours: float) -> None:
        """Add the energy and the cost of some hours."""
        engine = self.building.engine
        self.temperature = engine.read(self._air)
        energy = engine.read(self._power) / 1000 * hours
        self.energy += energy
        cold = max(0.0, COMFORT - self.temperature)
        self.cost += energy * price(engine.hour) + COLD * cold * self.people * hours


class Building:
    """A building of two rooms over some days in winter.

    Attributes:
        engine: EnergyPlus.
        random: The random number generator, for the days and the people.
        zones: The rooms.
        hour, weekday: The hour and the weekday of the current time step.
        outside: The outdoor air temperature, in degrees Celsius.
        steps: The number of time steps that have begun.
    """

    def __init__(self, seed: int | None = None) -> None:
        """Create the building, and draw the days of the run."""
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
        """Simulate the days of the run."""
        self.engine.run()

    def begin_step(self) -> None:
        """Let people come and go; at every decision step, choose the setpoint of each room."""
        engine, before = self.engine, self.weekday
        self.hour, self.weekday, self.outside = (
            engine.hour,
            engine.weekday,
            engine.read(self._outside),
        )
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
        """Account for the cost of a time step."""
        if self.steps:
            for zone in self.zones:
                zone.account(self.engine.hours_of_step)

    @property
    def cost(self) -> float:
        """The cost of both rooms so far."""
        return sum(zone.cost for zone in self.zones)

    def close(self) -> None:
        """Close EnergyPlus."""
        self.engine.close()


def main() -> None:
    """Run the model by its own rule."""
    building = Building(seed=0)
    building.run()
    for zone in building.zones:
        print(
            f"{zone.name}: {zone.energy:.1f} kWh, {zone.cost:.2f} in total, {zone.temperature:.1f}"
            " °C at the end"
        )
    building.close()


if __name__ == "__main__":
    main()
