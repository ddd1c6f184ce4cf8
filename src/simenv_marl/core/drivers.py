"""The drivers by name, and simulations with the stacks on which they were made."""

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
    """Run something on a stack in which nothing is decided; return what it returns.

    Raises:
        BaseException: What it raises.
    """
    try:
        driver.prepare(job, context=context)
        kind, box, _ = driver.resume(None)
    except BaseException:
        driver.unwind()  # an interrupt has come while it was waited for
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
    """A simulation that was made to be looked at, on a stack of its own, until an environment takes both.

    Attributes:
        kind: The driver's name.
        driver, simulation: The stack, and the simulation that was made there.
    """

    def __init__(self, source: Any, kind: str) -> None:
        """Make it.

        Raises:
            SimulationError: The source makes none.
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
        """The driver and the simulation, which are another's to end from now on."""
        self._end.detach()
        return self.driver, self.simulation
