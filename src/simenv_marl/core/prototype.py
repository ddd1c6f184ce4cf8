"""Simulations that are made for inspection, and what a plan knows of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final
from weakref import finalize

from ..decision import DecisionPoint, Definition
from ..hooks.stacks import outside_simulation
from ..simulation import SimulationInterface, make_simulation
from .driver import Driver
from .greenlets import GreenletDriver
from .points import own_points
from .threads import ThreadDriver

DRIVERS: Final[Mapping[str, Callable[..., Driver]]] = {"greenlet": GreenletDriver, "thread": ThreadDriver}

RENDER_MODES = ("ansi", "human", "rgb_array")
"""The render modes of a simulation with a method ``render`` that does not define ``render_modes``."""

RENDER_FPS = 4
"""The frames per second of a simulation that does not define ``render_fps``."""


class Prototype:
    """A simulation that a plan made for inspection, with its stack, until an environment claims both.

    Attributes:
        driver, simulation: The stack, and the simulation that was made on it.
    """

    def __init__(self, source: Any, kind: str) -> None:
        """Make a simulation.

        Args:
            source: The simulation, class or factory.
            kind: The driver's name.

        Raises:
            SimulationError: The source does not make a simulation.
        """
        self.driver = DRIVERS[kind]()
        self._end = finalize(self, self.driver.end)
        try:
            with outside_simulation():
                self.simulation = self.driver.run(lambda: make_simulation(source))
        except BaseException:
            self._end()
            raise

    def claim(self) -> tuple[Driver, Any]:
        """Hand over the driver and the simulation. From now on the caller must end them."""
        self._end.detach()
        return self.driver, self.simulation


@dataclass(frozen=True)
class Model:
    """What a plan knows of the simulation.

    Attributes:
        points: The decision points in its attribute ``points``, with their definitions.
        ends_agents: Whether it has ``end_agent`` of ``SimulationInterface``.
        render_modes: Its render modes.
        render_fps: The frames per second of its rendering.
    """

    points: Mapping[DecisionPoint, Definition]
    ends_agents: bool
    render_modes: list[str]
    render_fps: float

    @classmethod
    def of(cls, simulation: Any) -> Model:
        """Inspect a simulation or its class."""
        return cls(
            own_points(simulation),
            issubclass(simulation if isinstance(simulation, type) else type(simulation), SimulationInterface),
            list(getattr(simulation, "render_modes", RENDER_MODES)) if hasattr(simulation, "render") else [],
            getattr(simulation, "render_fps", RENDER_FPS),
        )
