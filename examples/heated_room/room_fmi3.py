"""The heated room as a unit of FMI 3, with the equation of ``room.c``.

Bounds and units are in the declared types.
"""

from math import exp

import pythonfmu3 as fmi


class RoomFmi3(fmi.Fmi3Slave, fmi.CoSimulation):
    """A room with a heater."""

    def __init__(self, **kwargs: object) -> None:
        super().__init__(**kwargs)
        self.time, self.power, self.outside, self.temperature = 0.0, 0.0, 0.0, 18.0
        self.register_units(
            [fmi.Unit("kW", factor=1000.0, kg=1, m=2, s=-3), fmi.Unit("degC", offset=273.15, K=1)]
        )
        kilowatts = fmi.Float64Type("Power", unit="kW", min=0.0, max=2.0)
        degrees = fmi.Float64Type("Degrees", unit="degC", min=-40.0, max=60.0)
        continuous = fmi.Fmi3Variability.continuous
        self.register_variable(
            fmi.Float64("time", causality=fmi.Fmi3Causality.independent, variability=continuous)
        )
        self.register_variable(
            fmi.Float64("power", causality=fmi.Fmi3Causality.input), var_type=kilowatts
        )
        self.register_variable(
            fmi.Float64("outside", causality=fmi.Fmi3Causality.input), var_type=degrees
        )
        self.register_variable(
            fmi.Float64("temperature", causality=fmi.Fmi3Causality.output), var_type=degrees
        )

    def do_step(self, current_time: float, step_size: float) -> fmi.Fmi3StepResult:
        """Approach the temperature at which the heater makes up for the losses."""
        limit = self.outside + 15.0 * self.power
        self.temperature = limit + (self.temperature - limit) * exp(-step_size / 36000.0)
        self.time = current_time + step_size
        return fmi.Fmi3StepResult()
