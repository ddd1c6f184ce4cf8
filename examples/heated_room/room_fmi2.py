"""The heated room as a unit of FMI 2, with the equation of ``room.c``.

pythonfmu writes neither bounds nor units.
"""

from math import exp

from pythonfmu import Fmi2Causality, Fmi2Slave, Real


class RoomFmi2(Fmi2Slave):
    """A room with a heater."""

    def __init__(self, **kwargs: object) -> None:
        super().__init__(**kwargs)
        self.power, self.outside, self.temperature = 0.0, 0.0, 18.0
        self.register_variable(Real("power", causality=Fmi2Causality.input))
        self.register_variable(Real("outside", causality=Fmi2Causality.input))
        self.register_variable(Real("temperature", causality=Fmi2Causality.output))

    def do_step(self, current_time: float, step_size: float) -> bool:
        """Approach the temperature at which the heater makes up for the losses."""
        limit = self.outside + 15.0 * self.power
        self.temperature = limit + (self.temperature - limit) * exp(-step_size / 36000.0)
        return True
