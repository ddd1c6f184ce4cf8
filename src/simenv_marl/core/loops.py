"""The asyncio event loops of a simulation and of its user, kept apart where the two stacks share a thread."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from sys import modules
from typing import Any, Final

from .driver import is_exit

ASYNCIO: Final = "asyncio.events"
"""The module that knows a thread's running event loop, whatever its stack. If it is not imported, no loop runs."""

_NO_LOOP: Final = (None, (None, None), 0)
"""The state of a thread without a loop: the loop, the hooks of asynchronous generators, and the depth of coroutine
origin tracking."""


class Loops:
    """The asyncio event loops of a simulation and of its user, which share a thread.

    Attributes:
        running: Returns the loop that runs in this thread. None until it is known that asyncio is imported.
        users: The user's loop and its hooks, while the simulation runs. None if there is nothing to restore.
    """

    __slots__ = ("_before", "_own", "running", "users")

    def __init__(self) -> None:
        self.running: Callable[[], Any] | None = None
        self.users: Any = None
        self._before: Any = _NO_LOOP  # the user's state without a loop, for a simulation that begins one later
        self._own: Any = None  # the simulation's state, while the user runs

    def begin(self) -> None:
        """Switch to the simulation for a new job, which begins without a loop."""
        before = _present_loop()
        self._before = before if before[0] is None else _NO_LOOP
        self._own = None
        self.enter()

    def enter(self) -> None:
        """Switch to the simulation's loop."""
        users, own = _present_loop(), self._own
        self._own = None
        if own is not None or users[0] is not None:
            self.users = users
            _set_loop(own or _NO_LOOP)

    def leave(self) -> None:
        """Switch to the user's loop."""
        own = _present_loop()
        if own[0] is not None or self.users is not None:
            self._own, users, self.users = own, self.users or self._before, None
            _set_loop(users)


def silence_unwound_tasks() -> None:
    """Stop the running loop from reporting tasks that are unwound, because no code can await them any more."""
    loop = _present_loop()[0]
    before = None if loop is None else loop.get_exception_handler()
    if loop is None or isinstance(before, partial):  # it was silenced in an earlier episode
        return
    loop.set_exception_handler(partial(_report_task, before or type(loop).default_exception_handler))


def _report_task(report: Callable[..., Any], loop: Any, context: dict[str, Any]) -> None:
    """Handle an exception of a loop, unless its task was unwound, or left over when the loop was closed."""
    error = context.get("exception")
    if not is_exit(error) and (error is not None or not loop.is_closed()):
        report(loop, context)


def _present_loop() -> tuple[Any, Any, int]:
    events = modules.get(ASYNCIO)
    loop = None if events is None else events._get_running_loop()
    return loop, sys.get_asyncgen_hooks(), sys.get_coroutine_origin_tracking_depth()


def _set_loop(state: Any) -> None:
    loop, hooks, depth = state
    modules[ASYNCIO]._set_running_loop(loop)
    sys.set_asyncgen_hooks(*hooks)
    sys.set_coroutine_origin_tracking_depth(depth)
