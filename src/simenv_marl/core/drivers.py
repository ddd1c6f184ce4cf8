"""The drivers by name, and ready-made simulations with the stacks on which they were made."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextvars import Context
from typing import Any, Final
from weakref import finalize

from ..simulation import make_simulation
from .events import FINISHED, STALLED
from .greenlets import GreenletDriver
from .switch import BaseDriver
from .threads import ThreadDriver

DRIVERS: Final[Mapping[str, Callable[..., BaseDriver]]] = {"greenlet": GreenletDriver, "thread": ThreadDriver}


def run_job(driver: BaseDriver, job: Callable[[], Any], context: Context | None = None) -> Any:
    """Run a job on a simulation's stack, where decision functions run their rule; return its result.

    Raises:
        BaseException: Any error that the job raises.
    """
    try:
        driver.prepare(job, context=context)
        kind, box, _ = driver.resume(None)
    except BaseException:
        driver.unwind()  # an interrupt has ended the wait
        raise
    value = box.pop()
    if kind is FINISHED:
        return value
    if kind is STALLED:
        driver.unwind()
    try:
        raise value
    finally:
        del value


class Spare:
    """A simulation that a plan made for inspection, with its stack, until an environment takes both.

    Attributes:
        kind: The driver's name.
        driver, simulation: The stack, and the simulation that was made on it.
    """

    def __init__(self, source: Any, kind: str) -> None:
        """Make a simulation.

        Raises:
            SimulationError: The source does not make a simulation.
        """
        self.kind = kind
        self.driver = DRIVERS[kind]()
        self._end = finalize(self, self.driver.end)
        try:
            self.simulation = run_job(self.driver, lambda: make_simulation(source))
        except BaseException:
            self._end()
            raise

    def taken(self) -> tuple[BaseDriver, Any]:
        """Hand over the driver and the simulation. From now on the caller must end them."""
        self._end.detach()
        return self.driver, self.simulation
