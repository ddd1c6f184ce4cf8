"""A check whether a simulation draws from the global random generators, which the whole process shares.

During the first decisions of each class of simulations, the state of the generators is compared before and after the
simulation runs. After that the check costs nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from threading import current_thread
from threading import enumerate as enumerate_threads
from time import process_time_ns, thread_time_ns
from typing import Any, Final
from weakref import WeakKeyDictionary, ref

from ..errors import warn_user
from .rng import used_up
from .switch import BaseDriver, Event
from .threads import SIMULATION, ThreadDriver

DECISIONS: Final = 1_000
"""The number of decisions during which a class of simulations is watched."""

GLIMPSE: Final = 5_000
"""A time in nanoseconds that is too short for another thread to wake up and draw."""

_left: Final[WeakKeyDictionary[type, int]] = WeakKeyDictionary()
"""The number of decisions that are left to watch, by class of simulations."""


def is_watched(simulation: Any) -> bool:
    """Whether simulations of this class are still watched."""
    return _left.get(type(simulation), DECISIONS) > 0


def watched(simulation: Any, work: Callable[[], Any], *, in_thread: bool) -> Any:
    """Run a simulation, and warn if it has drawn from the global generators.

    Args:
        simulation: The simulation.
        work: The function that runs it.
        in_thread: Whether the simulation has its own thread, so that other threads may run while the user's waits.

    Returns:
        The result of ``work``.
    """
    before, begun = used_up(), _others()
    result = work()
    kind, moved = type(simulation), [one != other for one, other in zip(before, used_up(), strict=True)]
    drawn = any(moved) and (_alone() or (not in_thread and _others() - begun < GLIMPSE))
    _left[kind] = 0 if drawn else _left.get(kind, DECISIONS) - 1
    if drawn:
        names = " and ".join(name for name, own in zip(("random", "numpy.random"), moved, strict=True) if own)
        warn_user(
            f"{kind.__name__} draws from the global generator of {names}, which all code in the process shares: its"
            " environments influence each other, and a seed does not repeat an episode. Make them with global_rng=True"
        )
    return result


def _others() -> int:
    """The time in nanoseconds for which all other threads have run."""
    return process_time_ns() - thread_time_ns()


def _alone() -> bool:
    """Whether no other thread can have drawn while a simulation ran."""
    return all(thread is current_thread() or thread.name == SIMULATION for thread in enumerate_threads())


class WatchedDriver:
    """The stand-in for an episode's driver as long as the simulation is watched."""

    __slots__ = ("_driver", "_session")

    def __init__(self, driver: BaseDriver, session: Any) -> None:
        """Watch the simulation of a session.

        Args:
            driver: Its driver.
            session: The session. Its episode gets the driver itself as soon as the check is over.
        """
        self._driver, self._session = driver, ref(session)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._driver, name)

    def resume(self, reply: Any) -> Event:
        """Resume the simulation with a reply; return its next event."""
        session: Any = self._session()
        if session is not None and is_watched(session.simulation):
            event: Event = watched(
                session.simulation,
                lambda: self._driver.resume(reply),
                in_thread=isinstance(self._driver, ThreadDriver),
            )
            return event
        if session is not None:
            session.episode.driver = self._driver
        return self._driver.resume(reply)  # type: ignore[no-any-return]
