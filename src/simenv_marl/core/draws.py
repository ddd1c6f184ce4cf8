"""Finding out whether a simulation draws from the global generators, which all else in the process shares.

During the first decisions of each kind of simulation, how much the generators have used up is compared before and
after the simulation was at work. From then on nothing of this is in the way.
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
"""During so many decisions a kind of simulation is watched."""

GLIMPSE: Final = 5_000
"""In less than so many nanoseconds no other thread can be woken and draw."""

_left: Final[WeakKeyDictionary[type, int]] = WeakKeyDictionary()
"""By class of simulations: during how many more."""


def is_watched(simulation: Any) -> bool:
    """Whether simulations of its kind are still watched."""
    return _left.get(type(simulation), DECISIONS) > 0


def watched(simulation: Any, work: Callable[[], Any], *, in_thread: bool) -> Any:
    """Let a simulation work; warn if the global generators have moved meanwhile.

    Args:
        simulation: The simulation.
        work: What lets it work.
        in_thread: Whether it does so in a thread of its own, while its user's waits and others may run.

    Returns:
        What the work returns.
    """
    before, begun = used_up(), _others()
    result = work()
    kind, moved = type(simulation), [one != other for one, other in zip(before, used_up(), strict=True)]
    drawn = any(moved) and (_alone() or (not in_thread and _others() - begun < GLIMPSE))
    _left[kind] = 0 if drawn else _left.get(kind, DECISIONS) - 1
    if drawn:
        names = " and ".join(name for name, own in zip(("random", "numpy.random"), moved, strict=True) if own)
        warn_user(
            f"{kind.__name__} draws from the global generator of {names}, which all else in the process shares: its"
            " environments influence each other, and the same seed gives other episodes. Make them with global_rng=True"
        )
    return result


def _others() -> int:
    """For how many nanoseconds all other threads have run."""
    return process_time_ns() - thread_time_ns()


def _alone() -> bool:
    """Whether there is no other thread that can have drawn while a simulation was at work."""
    return all(thread is current_thread() or thread.name == SIMULATION for thread in enumerate_threads())


class WatchedDriver:
    """Stands for a driver in an episode as long as the simulation is watched."""

    __slots__ = ("_driver", "_session")

    def __init__(self, driver: BaseDriver, session: Any) -> None:
        """Watch the simulation of a session.

        Args:
            driver: Its driver.
            session: The session, whose episode gets the driver itself as soon as there is nothing left to find out.
        """
        self._driver, self._session = driver, ref(session)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._driver, name)

    def resume(self, reply: Any) -> Event:
        """Let the simulation go on with a reply; return the event that comes from it next."""
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
