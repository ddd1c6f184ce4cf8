"""An environment made from the heated room: the agent sets the heater's power each quarter hour.

Observations and actions have the names of the unit's variables. The reward is minus the cost since
the previous decision: of energy, which is half as expensive at night, and of each degree below 20
°C during the day.
"""

from __future__ import annotations

import random
from math import cos, pi
from typing import Any, Final

import fmpy
import numpy as np
from gymnasium import spaces

from simenv_marl import TRUNCATED, SimulationInterface, difference, make_step

from .master import Master, labels_of, spaces_of
from .units import unit

STEP, DAYS, COMFORT = 900.0, 2, 20.0
OBSERVED: Final = ("temperature", "outside")
BOUNDS: Final = {"power": (0.0, 2.0), "temperature": (-40.0, 60.0), "outside": (-40.0, 60.0)}
"""The bounds for the unit ``fmi2``, whose model description has none."""


class HeatedRoom(Master):
    """A room with a thermostat: the model.

    ``chance`` makes the weather; ``cost`` grows with each step.
    """

    hour = cost = 0.0

    def __init__(self, *arguments: Any, seed: int | None) -> None:
        self.chance = random.Random(seed)
        self._mean = self.chance.uniform(-5.0, 8.0)
        super().__init__(*arguments, outside=self._mean - 5.0)

    def decide(self) -> dict[str, Any]:
        """Heat if it is too cold, until it is warm enough."""
        temperature = self.read("temperature")
        if COMFORT <= temperature <= COMFORT + 1:
            return {"power": self.read("power")}
        return {"power": 2.0 if temperature < COMFORT else 0.0}

    def do_step(self) -> None:
        """Do one step, add its cost, and change the weather."""
        super().do_step()
        price = 0.3 if 6 <= self.hour < 22 else 0.15
        cold = max(0.0, COMFORT - self.read("temperature")) if 8 <= self.hour < 18 else 0.0
        self.cost += self.step / 3600 * (self.read("power") * price + cold)
        self.hour = self.time / 3600 % 24
        self._mean += self.chance.gauss(0.0, 0.2)
        self.write({"outside": self._mean - 5.0 * cos(self.hour / 12 * pi)})


_cost_since = difference(lambda room: room.cost)


class RoomSim(SimulationInterface):
    """The simulation of a room for two days in winter.

    The model description tells the spaces of ``points``.
    """

    def __init__(self, kind: str = "c") -> None:
        """Take a unit, one of ``units.UNITS``."""
        self._folder = unit(kind)
        self._description = description = fmpy.read_model_description(self._folder)
        bounds = BOUNDS if kind == "fmi2" else {}
        hour = spaces.Box(0.0, 24.0, (1,), np.float64)
        self.points = {
            HeatedRoom.decide: make_step(
                observation_space=spaces.Dict(
                    {**spaces_of(description, OBSERVED, bounds), "hour": hour}
                ),
                observation_space_mapping=lambda room: (
                    {n: [room.read(n)] for n in OBSERVED} | {"hour": [room.hour]}
                ),
                observation_labels=labels_of(description, OBSERVED) | {"hour": "hour"},
                action_space=spaces_of(description, ["power"], bounds),
                action_space_mapping=lambda action: {"power": float(action["power"][0])},
                rule_action_mapping=lambda inputs: {"power": np.array([inputs["power"]])},
                reward_mapping=lambda room: -float(_cost_since(room)),
                agent="heater_0",
                action_labels={"power": "heating power, kW"},
                question="With how much power do you heat in the next step?",
                display_mapping=lambda room: {
                    "hour of the day": f"{room.hour:.2f}",
                    **{n: f"{room.read(n):.1f}" for n in OBSERVED},
                },
            )
        }

    def reset(self, seed: int | None = None) -> None:
        """Begin at midnight."""
        self.room = HeatedRoom(self._folder, self._description, STEP, DAYS * 86400.0, seed=seed)

    def run(self) -> Any:
        """Run the master."""
        self.room.run()
        return TRUNCATED

    def reseed(self, seed: int) -> None:
        """Draw the weather to come anew."""
        self.room.chance.seed(seed)

    def close(self) -> None:
        """Free the unit."""
        self.room.close()
