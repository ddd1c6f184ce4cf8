"""The driver that runs a simulation in a greenlet: a separate stack in the user's thread."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from os import getpid
from sys import modules
from threading import local
from typing import Any, Final
from weakref import WeakSet, ref

from greenlet import GreenletExit, getcurrent, greenlet

from ..errors import WrongThreadError
from ..hooks.hook import Hook
from ..hooks.stacks import STACKS, Interceptor
from ..simulation import RULE
from .driver import FINISHED, Driver, Event, SimulationExit, is_exit, reporting_rule


class _Home(local):
    """What identifies a thread. Unlike the thread's number, it is never reused for another thread."""

    def __init__(self) -> None:
        self.identity: Any = type("Thread", (), {})()


_home: Final = _Home()


class GreenletDriver(Driver):
    """A driver that runs a simulation in a greenlet of the thread that begins the first job."""

    __slots__ = ("_asker", "_body", "_direct", "_home", "_leave", "_loops", "_process", "resume")

    def __init__(self, plugins: Any = None, opened: WeakSet[Any] | None = None, *, direct: bool = True) -> None:
        """Prepare a greenlet, as ``Driver`` does; unless ``direct``, ``caller`` stays None."""
        super().__init__(plugins, opened)
        self._direct = direct
        self._home, self._process = ref(_home.identity), getpid()
        self._loops = _Loops()
        self._body: Any = greenlet(self._serve)
        self._asker: greenlet | None = None  # the model's own greenlet that waits for an answer
        self._leave: Any = None
        self.resume: Any = self._body.switch

    # -- on the user's side -----------------------------------------------------------------------

    def enter(self) -> None:
        """Prepare to resume the simulation from the current greenlet."""
        if self._body is None or self._home() is not _home.identity:
            raise WrongThreadError(
                "the simulation is suspended in another thread, the one that called reset(); step, reset and close the"
                ' environment there, or make it with driver="thread", which allows any thread'
            )
        here = getcurrent()
        self._leave, self._body.parent = here.switch, here  # control returns here when the stack ends
        # Inside another environment's simulation, ``enter`` is needed before each step, to hide that simulation.
        self.caller = here if self._direct and here not in STACKS else None

    def throw(self) -> Event | None:
        """Raise ``SimulationExit`` in the suspended simulation; return its next event."""
        self.enter()
        if self.idle or not self._body:  # the job has ended, or was interrupted before it began
            self._job = None
            return FINISHED, [None], None
        self._exiting = True
        event: Event = (self._asker or self._body).throw(SimulationExit())
        return event

    @property
    def reachable(self) -> bool:
        """Whether the simulation can be resumed from the current thread."""
        return self._home() is _home.identity

    at_home = reachable

    @property
    def lost(self) -> bool:
        """Whether the simulation's thread has ended, or does not exist in this forked process."""
        return self._home() is None or (getpid() != self._process and not self.reachable)

    @property
    def usable(self) -> bool:
        """Whether a job can begin in the current thread."""
        return self.idle and not self.ended and self._home() is _home.identity and not self._body.dead

    def end(self) -> None:
        """End the stack."""
        if self.ended:
            return
        self._forget_stack()
        body, self._body = self._body, None
        self._asker = self._leave = self.caller = self.resume = None
        if self.idle and body and self.reachable:
            body.parent = getcurrent()
            body.throw()

    def abandon(self) -> None:
        """Leave a job suspended that does not unwind."""
        self._forget_stack()
        _abandoned.append(self)

    # -- on the simulation's side -----------------------------------------------------------------

    def _serve(self, _: Any) -> None:
        with suppress(GreenletExit):
            self._register()
            while not self.ended:
                # A new greenlet has an empty context, but the model expects the user's context variables.
                self._body.gr_context, self._context = self._context, None
                self._loops.simulations = _NO_LOOP  # each job begins without a loop
                self._loops.enter()
                try:
                    event = self._work()
                finally:
                    if not self.ended:  # once the driver has ended, the stack unwinds by itself
                        self._loops.leave()
                if self.ended:
                    return
                self._body.gr_context = None
                self.idle = True
                self._leave(*event)

    def _decider(self, hook: Hook, event: Any, away: bool = False) -> Interceptor:
        """Make the function that sends an event for the calls of a hook, and carries out the replies."""
        deliver, driver, loops = event.deliver, self, self._loops
        rule: Any = hook.rule
        if event.report is not None:
            rule = reporting_rule(hook, self._decider(hook, event.report, away))

        def decide(args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
            if away:
                driver._ask_from(getcurrent())
            leave, running = driver._leave, loops.running
            if running is None and _ASYNCIO in modules:
                running = loops.running = modules[_ASYNCIO]._get_running_loop
            looped = running is not None and (running() is not None or loops.swapped)
            if looped:
                loops.leave()
            try:
                reply = leave(event, args, kwargs)
            except BaseException:
                if not driver.ended:  # once the driver has ended, the stack unwinds by itself
                    if away:
                        driver._ask_from(None)
                    loops.enter()
                    silence_unwound_tasks()
                raise
            if away:
                driver._ask_from(None)
            if looped or (running is not None and running() is not None):
                loops.enter()
            if reply is RULE:
                return rule(*args, **kwargs) if kwargs else rule(*args)
            return reply if deliver is None else deliver(reply, *args, **kwargs)

        return decide

    def _ask_from(self, asker: greenlet | None) -> None:
        """Remember the model's own greenlet that asks for a decision, so that ``resume`` switches to it."""
        self._asker = asker
        self.resume = (self._body if asker is None else asker).switch


_abandoned: Final[list[GreenletDriver]] = []
"""Drivers of simulations that did not unwind. Freeing a greenlet would resume it, at an arbitrary moment."""


# -- asyncio --------------------------------------------------------------------------------------

_ASYNCIO: Final = "asyncio.events"
"""The module that knows a thread's running event loop, whatever its stack. If it is not imported, no loop runs."""

_NO_LOOP: Final = (None, (None, None), 0)
"""The state of a thread without a loop: the loop, the hooks of asynchronous generators, and the depth of coroutine
origin tracking."""


class _Loops:
    """The asyncio event loops of a simulation and of its user, which share a thread.

    Attributes:
        running: Returns the loop that runs in this thread. None until it is known that asyncio is imported.
        simulations: The simulation's state while the user runs.
        swapped: Whether the simulation's state has replaced the user's while the simulation runs.
    """

    __slots__ = ("_users", "running", "simulations", "swapped")

    def __init__(self) -> None:
        self.running: Callable[[], Any] | None = None
        self.simulations: Any = _NO_LOOP

    def enter(self) -> None:
        """Switch to the simulation's loop, if it or the user has one."""
        self._users = _present_loop()
        self.swapped = self._users[0] is not None or self.simulations[0] is not None
        if self.swapped:
            _set_loop(self.simulations)

    def leave(self) -> None:
        """Switch to the user's loop, if the user or the simulation has one."""
        present = _present_loop()
        if self.swapped or present[0] is not None:
            self.simulations = present
            _set_loop(self._users)


def _present_loop() -> Any:
    events = modules.get(_ASYNCIO)
    loop = None if events is None else events._get_running_loop()
    return loop, sys.get_asyncgen_hooks(), sys.get_coroutine_origin_tracking_depth()


def _set_loop(state: Any) -> None:
    loop, hooks, depth = state
    modules[_ASYNCIO]._set_running_loop(loop)
    sys.set_asyncgen_hooks(*hooks)
    sys.set_coroutine_origin_tracking_depth(depth)


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
