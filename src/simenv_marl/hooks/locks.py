"""Locks that a suspended simulation holds, and for which another simulation waits.

A simulation may hold a lock while it waits for the answer to a decision. If its user then resumes a
second simulation, which waits for the same lock, neither goes on. With ``driver="thread"``, the
user's waiting thread looks for that. A simulation in a greenlet blocks its user's thread. So
another thread watches while there are at least two simulations.
"""

from __future__ import annotations

import os
import signal
import sys
from _thread import start_new_thread
from collections.abc import Iterator
from contextlib import suppress
from dis import get_instructions
from inspect import getattr_static
from threading import Event, Semaphore, main_thread
from traceback import format_stack, walk_stack
from types import FrameType
from typing import Any, Final

from ..simulation import Model
from .stacks import STACKS

PERIOD: Final = 1.0
"""The seconds between two looks."""

LOOKS: Final = 3
"""At so many looks in succession a thread must be in the same place to count as blocked."""

Place = tuple[int, int]
"""A frame and the offset of its latest instruction."""

_told: Final[set[str]] = set()

_stops: Final[list[Semaphore | None]] = []
"""Ends the watching thread. Empty if there is none. None: there must be none."""


def explain_wait(running: FrameType, user: int) -> str | None:
    """Explain why a simulation does not go on, if it waits for a lock of a suspended one.

    If the main thread uses both, they wait for ever: return the text of an error. Another thread
    may resume the suspended one: print the text, once.

    Args:
        running: The innermost frame of the simulation that may wait.
        user: The number of its user's thread.
    """
    for waiting, holding, driver in _candidates(running):
        text = (
            f"{_describe(waiting)} waits for a lock that {_describe(holding)} holds while it is"
            " suspended at a decision. Release locks before decisions, or give each simulation a"
            " lock of its own; another driver does not help\n"
            f"{''.join(format_stack(running))}The other simulation:\n"
            f"{''.join(format_stack(driver.frame))}"
        )
        if driver.user == user == main_thread().ident:
            return text
        if text not in _told:
            _told.add(text)
            print(f"simenv_marl: {text}", file=sys.stderr)
        break
    return None


def _candidates(running: FrameType) -> Iterator[tuple[FrameType, FrameType, Any]]:
    """Yield a frame that waits for a lock, and the frame and the driver that hold it."""
    drivers = [driver for driver in STACKS.values() if driver and driver.frame and not driver.idle]
    for waiting, _ in walk_stack(running):
        lock = _locks_of(waiting, waits=True)[-1]
        for driver in drivers if hasattr(lock, "acquire") else ():
            for holding, _ in walk_stack(driver.frame):
                if any(lock is other for other in _locks_of(holding)):
                    yield waiting, holding, driver


def _describe(frame: FrameType) -> str:
    """Describe a place in the model, and the simulation: an argument of the outermost function."""
    frames = [frame]
    for outer, _ in walk_stack(frame):
        if outer.f_code.co_name == "_work":  # of the driver
            break
        if not str(outer.f_globals.get("__name__")).startswith("simenv_marl."):
            frames.append(outer)
    *_, outermost = frames
    place = frames[:2][-1]
    simulation = next(iter(outermost.f_locals.values()), None)
    while simulation and isinstance(simulation, tuple):  # the arguments of a decorator's function
        simulation = simulation[0]
    return f"{object.__repr__(simulation)} in {place.f_code.co_qualname}, line {place.f_lineno},"


def _locks_of(frame: FrameType, *, waits: bool = False) -> list[Model]:
    """Return the locks that a frame has entered. It may still wait for the last of them.

    This finds variables and their attributes. It runs no code of the model.

    Args:
        frame: The frame.
        waits: Whether to return nothing but None if it does not wait, or has a time limit.
    """
    steps = [step for step in get_instructions(frame.f_code) if step.opname != "PRECALL"]
    exits = {step.positions: step.offset for step in steps if step.opname == "CALL"}
    done = [step for step in steps if step.offset <= frame.f_lasti]
    call = [step.argval for step in done[-2:]]
    if waits and done[-1].opname != "BEFORE_WITH" and call != ["acquire", 0]:
        return [None]
    variables = frame.f_globals | frame.f_locals
    entered: list[Model] = [None]
    found = None
    for step in done:
        match step.opname, step.argval:
            case "BEFORE_WITH", _:
                if exits.get(step.positions, 0) > frame.f_lasti:
                    entered.append(found)
            case "LOAD_ATTR" | "LOAD_METHOD", "acquire":
                entered.append(found)
            case "LOAD_ATTR" | "LOAD_METHOD", "release":
                entered = [lock for lock in entered if lock is not found]
            case "LOAD_ATTR" | "LOAD_METHOD", name:
                found = getattr_static(found, name, None)
            case kind, name if kind.startswith("LOAD_"):
                found = variables.get(name)
    return entered or [None]


# -- the watching thread --------------------------------------------------------------------------


def watch_locks(stack: object) -> None:
    """Start to watch, unless there is no simulation beside that of a stack."""
    if not _stops and len(STACKS) > (stack in STACKS):
        stop = Semaphore(0)
        _stops.append(stop)
        with suppress(RuntimeError):  # there are too many threads
            start_new_thread(_watch, (stop,))  # ``threading`` does not list it


def watch_no_locks() -> None:
    """Never start to watch in this process."""
    _stops.append(None)


def _watch(stop: Semaphore) -> None:
    """Look at all threads until a signal to stop comes, or at most one simulation is left."""
    seen: dict[Place, int] = {}
    while not stop.acquire(timeout=PERIOD) and len(STACKS) > 1:
        with suppress(Exception):  # other threads change everything meanwhile
            seen = _look(seen)
    _stops.clear()


def _look(seen: dict[Place, int]) -> dict[Place, int]:
    """Look at the threads in which simulations run. Interrupt the main one if it waits for ever.

    Take and return how often each thread was in its place in succession.
    """
    places = {}
    for thread, frame in sys._current_frames().items():
        place = id(frame), frame.f_lasti
        places[place] = seen.get(place, 0) + 1
        # Not before, because a thread must not switch to another greenlet meanwhile.
        if places[place] % LOOKS == 0:
            jobs = [job for job, _ in walk_stack(frame) if job.f_code.co_name == "_work"]
            driver: Any = jobs[0].f_locals.get("self") if jobs else None
            if getattr(driver, "user", None) == thread:
                interrupts = signal.getsignal(signal.SIGINT) is signal.default_int_handler
                text = explain_wait(frame, thread if interrupts else 0)
                if text is not None:
                    places[place] = -sys.maxsize  # a second interrupt would meet other code
                    driver.note_deadlock(text)
                    signal.pthread_kill(thread, signal.SIGINT)
    return places


def _stop_watching() -> None:
    """End the watching thread before a fork, because Python warns of forks with threads."""
    for stop in filter(None, _stops[:]):
        with suppress(OSError):  # only Linux has this folder
            threads = os.listdir("/proc/self/task")
            stop.release()
            for _ in range(1000):
                if os.listdir("/proc/self/task") != threads:
                    break
                Event().wait(0.001)  # not ``sleep``, which gevent may have replaced
        stop.release()  # on other systems


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_stop_watching)
