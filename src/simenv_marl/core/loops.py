"""The state that asyncio event loops set for a whole thread, kept separate for the two stacks that share the thread."""

from __future__ import annotations

import sys
from importlib import import_module
from signal import SIGINT, default_int_handler
from sys import modules
from threading import get_ident, main_thread
from typing import Any, Final

from .switch import is_exit

_signal: Final[Any] = import_module("_signal")
"""The C module. ``signal`` makes enums of handlers, which takes longer than everything else in this module."""

LOOPS: Final = "asyncio.events"
"""The module that knows a thread's running event loop, whatever its stack. If it is not imported, no loop runs."""

Surroundings = tuple[Any, Any, int]
"""The state that an event loop sets for its thread: the running loop, the hooks of asynchronous generators, and the
depth of coroutine origin tracking."""

NO_LOOP: Final = (None, (None, None), 0)


def running_loop() -> Any:
    """The event loop that runs in this thread; None if there is none."""
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
    """The event loops of a simulation and of its user, in one thread.

    Attributes:
        find: Returns the running loop. None until it is known that asyncio is imported.
        users: The surroundings of the user when the simulation was resumed. None if neither had a loop then.
    """

    __slots__ = ("_before", "_interrupt", "_own", "find", "users")

    def __init__(self) -> None:
        self.find: Any = None
        self.users: Surroundings | None = None
        self._before = NO_LOOP  # the user's surroundings, for a simulation that begins a loop later
        self._own: Surroundings | None = None  # the simulation's surroundings, while the user runs
        self._interrupt: Any = None  # the Ctrl-C handler of the simulation's loop

    def begin(self) -> None:
        """Switch to the simulation for a new job, which begins without a loop."""
        before = _surroundings()
        self._before = NO_LOOP if before[0] is not None or before == NO_LOOP else before  # share one object
        self._own = self._interrupt = None
        self.enter()

    def look(self) -> Any:
        """Switch to the user for the first time after asyncio was imported."""
        self.find = modules[LOOPS]._get_running_loop
        return self.leave()

    def leave(self) -> Surroundings | None:
        """Switch to the user's surroundings; return the simulation's, if they must be restored later."""
        loop = running_loop()
        if loop is None and self.users is None:
            return None
        self._own = own = _surroundings()
        users, self.users = self.users or self._before, None
        _surround(users)
        self._interrupt = _take_interrupt(loop)  # last, because from now on a Ctrl-C is raised here
        return own

    def enter(self) -> None:
        """Switch to the simulation's surroundings."""
        interrupt, self._interrupt = self._interrupt, None
        if interrupt is not None and _signal.getsignal(SIGINT) is default_int_handler:
            _signal.signal(SIGINT, interrupt)
        users, own = _surroundings(), self._own
        self._own = None
        if own is not None or users[0] is not None:
            self.users = users
            _surround(own or NO_LOOP)


def _take_interrupt(loop: Any) -> Any:
    """Restore Python's default Ctrl-C handler if ``asyncio.run`` has replaced it for a given loop.

    Returns:
        The handler that ``asyncio.run`` had set. None if it had set none.
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
    """Stop the running loop from reporting tasks that are unwound, because no code can await them any more."""
    loop = running_loop()
    if loop is not None:
        before = loop.get_exception_handler()
        if not isinstance(before, _Hushed):
            loop.set_exception_handler(_Hushed(before))


class _Hushed:
    """A loop's exception handler that ignores tasks that were unwound, or left over when the loop was closed."""

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
