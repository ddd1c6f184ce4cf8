"""The exception that unwinds a suspended simulation, also after a model has caught it."""

from __future__ import annotations

from asyncio import AbstractEventLoop, Runner, _get_running_loop
from collections.abc import Callable
from functools import partial
from traceback import walk_stack
from typing import Any, Final

from greenlet import getcurrent, greenlet

from ...errors import error_text
from ...hooks.stacks import STACKS
from ...simulation import Model

Context = dict[str, Any]
"""The context that an event loop passes to its exception handler."""


UNWINDING_TRIES: Final = 1000
"""How often ``SimulationExit`` is raised. A SimPy model loses one of its processes at each try."""


class SimulationExit(BaseException):
    """Raised in a suspended simulation to unwind it. It is not an error; models must not catch it.

    It does not derive from ``SystemExit``, because C code that prints the exceptions of callbacks
    would end the process.
    """

    def __init__(
        self, text: str = "SimulationExit: the environment was closed, reset or dropped"
    ) -> None:
        """Name the exit in its text, because some engines keep only the text of an exception."""
        super().__init__(text)


class LoopExit(SimulationExit, KeyboardInterrupt):
    """A ``SimulationExit`` in an event loop, which stores other exceptions in its tasks."""


def is_exit(error: BaseException | None) -> bool:
    """Return whether an error is a ``SimulationExit``, or was raised ``from`` one.

    The text counts too, because some engines keep only that. So does a ``SystemExit`` that was
    raised because of an exit. A group is an exit if all its errors are.
    """
    known = set()  # causes may be cyclic
    while error is not None and id(error) not in known:
        if isinstance(error, SimulationExit) or SimulationExit.__name__ in error_text(error):
            return True
        if isinstance(error, BaseExceptionGroup):
            return all(map(is_exit, error.exceptions))
        known.add(id(error))
        ends_process = isinstance(error, SystemExit)
        error = error.__cause__ or (error.__context__ if ends_process else None)
    return False


def make_exit() -> SimulationExit:
    """Return the exit to raise in this greenlet. Silence the event loop that runs here.

    A ``LoopExit`` ends a loop at once. Where asyncio already closes its loop, the exit must not end
    it, so that the other tasks end, too.
    """
    here: greenlet | None = getcurrent()
    while here is not None and here not in STACKS and not hasattr(here, "NOT_ERROR"):
        here = here.parent
    if hasattr(here, "NOT_ERROR"):  # gevent's hub, which has spawned this greenlet
        _spare_hub(here)
        return LoopExit()
    loop = _get_running_loop()
    if loop is None:
        return SimulationExit()
    _silence(loop)
    return SimulationExit() if _is_closing_loop() else LoopExit()


def _spare_hub(hub: Model) -> None:
    """Let gevent's hub not print the exits of greenlets."""
    setattr(hub, "NOT_ERROR", (*{*hub.NOT_ERROR, SimulationExit},))  # noqa: B010 - it has no type


def _is_closing_loop() -> bool:
    close = Runner.close.__code__
    return any(frame.f_code is close for frame, _ in walk_stack(None))


def _silence(loop: AbstractEventLoop) -> None:
    """Let a loop report no tasks that were unwound: no code awaits them any more."""
    handler = loop.get_exception_handler()
    if not isinstance(handler, partial):  # an earlier episode has not silenced it yet
        report = handler or type(loop).default_exception_handler
        loop.set_exception_handler(partial(_report_task, report))


def _report_task(
    report: Callable[[AbstractEventLoop, Context], object],
    loop: AbstractEventLoop,
    context: Context,
) -> None:
    """Report an exception of a loop, unless its task was unwound or the loop was closed."""
    error = context.get("exception")
    if not (loop.is_closed() if error is None else is_exit(error)):
        report(loop, context)
