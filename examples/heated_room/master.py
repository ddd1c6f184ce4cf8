"""A master of one co-simulation unit, of FMI 2 or FMI 3, and the spaces of the unit's variables."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
from fmpy.model_description import ModelDescription, ModelVariable
from gymnasium import spaces


class Master:
    """Runs a unit, and decides on the unit's inputs before each step. ``time`` is in seconds."""

    def __init__(
        self, folder: Path, description: ModelDescription, step: float, stop: float, **start: float
    ) -> None:
        """Initialize the unit in a folder; ``start`` contains values of its variables by name."""
        self.step, self.stop, self.time = step, stop, 0.0
        self._variables = {variable.name: variable for variable in description.modelVariables}
        self._unit: Any = fmpy.instantiate_fmu(str(folder), description, "CoSimulation")
        self._integer = "Integer" if description.fmiVersion == "2.0" else "Int64"
        if description.fmiVersion == "2.0":
            self._unit.setupExperiment(stopTime=stop)
        self.write(start)
        self._unit.enterInitializationMode()
        self._unit.exitInitializationMode()

    def run(self) -> None:
        """Step the unit to the end."""
        while self.time < self.stop:
            self.write(self.decide())
            self.do_step()

    def do_step(self) -> None:
        """Do one step of the unit."""
        self._unit.doStep(self.time, self.step)
        self.time += self.step

    def decide(self) -> dict[str, Any]:
        """Return inputs of the unit, by name."""
        raise NotImplementedError

    def read(self, name: str) -> Any:
        """Return the value of a scalar variable."""
        return self._access("get", name)([self._variables[name].valueReference])[0]

    def write(self, values: Mapping[str, Any]) -> None:
        """Set scalar variables by name."""
        for name, value in values.items():
            self._access("set", name)([self._variables[name].valueReference], [value])

    def _access(self, what: str, name: str) -> Any:
        kind = self._variables[name].type
        return getattr(self._unit, what + (self._integer if kind == "Enumeration" else kind))

    def close(self) -> None:
        """Free the unit."""
        self._unit.terminate()
        self._unit.freeInstance()


def spaces_of(
    description: ModelDescription,
    names: Collection[str],
    bounds: Mapping[str, tuple[float, float]] | None = None,
) -> spaces.Dict:
    """Return the spaces of scalar variables by name.

    Bounds are those of the variables or of their declared types. ``bounds`` contains the bounds of
    variables that have none, or others. A real variable has a ``Box`` of shape ``(1,)``, in its
    unit, and any other one a ``Discrete``.

    Raises:
        ValueError: A variable does not exist, is not a scalar number, or has no bounds.
    """
    variables = {variable.name: variable for variable in description.modelVariables}
    if unknown := set(names) - set(variables):
        raise ValueError(
            f"the unit has no variable {', '.join(sorted(unknown))}, but {', '.join(variables)}"
        )
    return spaces.Dict({name: _space(variables[name], (bounds or {}).get(name)) for name in names})


def _space(variable: ModelVariable, bounds: tuple[float, float] | None) -> spaces.Space[Any]:
    kind, declared = variable.type, variable.declaredType
    if kind in ("String", "Binary", "Clock") or variable.dimensions:
        raise ValueError(f"{variable.name} is not a scalar number")
    ends: list[Any] = [
        getattr(variable, end) or getattr(declared, end, None) for end in ("min", "max")
    ]
    if kind == "Boolean":
        ends = [0, 1]
    elif kind == "Enumeration" and declared is not None:
        ends = [pick(int(item.value) for item in declared.items) for pick in (min, max)]
    low, high = bounds or ends
    if low is None or high is None:
        raise ValueError(
            f"{variable.name} has no bounds; give them: bounds={{{variable.name!r}: (low, high)}}"
        )
    if kind == "Real" or kind.startswith("Float"):
        return spaces.Box(float(low), float(high), (1,), np.float64)
    return spaces.Discrete(int(high) - int(low) + 1, start=int(low))


def labels_of(description: ModelDescription, names: Collection[str]) -> dict[str, str]:
    """Return a label for each variable: its name, and its unit where it has one."""
    found = {
        each.name: each.unit or getattr(each.declaredType, "unit", None)
        for each in description.modelVariables
    }
    return {name: f"{name} ({found[name]})" if found[name] else name for name in names}
