"""Event loops of asyncio: what they set for a whole thread is kept apart for the two stacks that share it."""

from __future__ import annotations

import sys
from importlib import import_module
from signal import SIGINT, default_int_handler
from sys import modules
from threading import get_ident, main_thread
from typing import Any, Final

from .switch import is_exit

_signal: Final[Any] = import_module("_signal")
"""What ``signal`` wraps to make enums of handlers, which takes longer than all that is done here."""

LOOPS: Final = "asyncio.events"
"""What knows the event loop that runs in a thread, whichever stack it runs on. Where it was not imported, none runs."""

Surroundings = tuple[Any, Any, int]
"""What an event loop sets for its thread: that it runs, the hooks of asynchronous generators, and how much of their
origin coroutines remember."""

NO_LOOP: Final = (None, (None, None), 0)


def running_loop() -> Any:
    """The event loop that runs in this thread; None if none does."""
    events = modules.get(LOOPS)
    return None if events is None else events._get_running_loop()


def _surroundings() -> Surroundings:
    return running_loop(), sys.get_asyncgen_hooks(), sys.get_coroutine_origin_tracking_depth()


def _surround(surroundings: Surroundings) -> None:
    loop, hooks, depth = surroundings
    modules[LOOPS]._set_running_loop(loop)
    sys.set_asyncgen_hooks(*hooks)
    sys.set_coroutine_origin_tracking_depth(depth)


class Sides:
    """A simulation's event loop and its user's, in one thread.

    Attributes:
        find: Tells which loop runs; None as long as it is not known that asyncio was imported.
        users: What the user's loop had set when the simulation went on; None: the simulation had none then either.
    """

    __slots__ = ("_before", "_interrupt", "_own", "find", "users")

    def __init__(self) -> None:
        self.find: Any = None
        self.users: Surroundings | None = None
        self._before = NO_LOOP  # the user's, where the simulation begins a loop later
        self._own: Surroundings | None = None  # the simulation's, while its user goes on
        self._interrupt: Any = None  # what the simulation's loop does at Ctrl-C

    def begin(self) -> None:
        """The simulation begins a job, without a loop."""
        before = _surroundings()
        self._before = NO_LOOP if before[0] is not None or before == NO_LOOP else before  # one object for many
        self._own = self._interrupt = None
        self.enter()

    def look(self) -> Any:
        """The user goes on, and asyncio has been imported meanwhile."""
        self.find = modules[LOOPS]._get_running_loop
        return self.leave()

    def leave(self) -> Surroundings | None:
        """The user goes on, in its own surroundings; return those of the simulation, if they are to be put back."""
        loop = running_loop()
        if loop is None and self.users is None:
            return None
        self._own = own = _surroundings()
        users, self.users = self.users or self._before, None
        _surround(users)
        self._interrupt = _take_interrupt(loop)  # last: a Ctrl-C is raised here from now on
        return own

    def enter(self) -> None:
        """The simulation goes on, in the surroundings in which it was."""
        interrupt, self._interrupt = self._interrupt, None
        if interrupt is not None and _signal.getsignal(SIGINT) is default_int_handler:
            _signal.signal(SIGINT, interrupt)
        users, own = _surroundings(), self._own
        self._own = None
        if own is not None or users[0] is not None:
            self.users = users
            _surround(own or NO_LOOP)


def _take_interrupt(loop: Any) -> Any:
    """Put back the handler of Ctrl-C in whose place ``asyncio.run`` has set one for a loop: it does so for one alone.

    Returns:
        What it had set; None where it had set nothing.
    """
    if loop is None or get_ident() != main_thread().ident:
        return None
    handler = _signal.getsignal(SIGINT)
    runner = getattr(getattr(handler, "func", None), "__self__", None)
    if not isinstance(runner, modules["asyncio.runners"].Runner) or runner.get_loop() is not loop:
        return None
    _signal.signal(SIGINT, default_int_handler)
    return handler


def hush() -> None:
    """Have the loop that runs here say nothing of tasks that are unwound, which nothing may await any more."""
    loop = running_loop()
    if loop is not None:
        before = loop.get_exception_handler()
        if not isinstance(before, _Hushed):
            loop.set_exception_handler(_Hushed(before))


class _Hushed:
    """An exception handler of a loop, to which tasks that were unwound, or left when it was closed, are no news."""

    def __init__(self, handler: Any) -> None:
        self._handler = handler

    def __call__(self, loop: Any, context: dict[str, Any]) -> None:
        error = context.get("exception")
        if is_exit(error) or (error is None and loop.is_closed()):
            return
        if self._handler is None:
            loop.default_exception_handler(context)
        else:
            self._handler(loop, context)
