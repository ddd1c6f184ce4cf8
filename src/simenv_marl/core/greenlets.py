"""The driver that runs a simulation in a greenlet: a separate stack in the user's thread."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from contextvars import copy_context
from os import getpid
from sys import modules
from threading import local
from typing import Any, Final
from weakref import ref

from greenlet import GreenletExit, getcurrent, greenlet

from ..errors import WrongThreadError
from ..hooks.hook import Hook
from ..hooks.stacks import STACKS, Interceptor
from ..simulation import RULE
from .driver import FINISHED, NO_EVENTS, Driver, Event, SimulationExit, reporting_rule
from .loops import ASYNCIO, Loops, silence_unwound_tasks


class _Home:
    """The identity of a thread. Unlike the thread's number, it is never reused for another thread."""


_homes = local()


def _home() -> _Home:
    try:
        home: _Home = _homes.home
    except AttributeError:
        home = _homes.home = _Home()
    return home


class GreenletDriver(Driver):
    """A driver that runs a simulation in a greenlet of the thread that begins the first job."""

    __slots__ = ("_asker", "_body", "_direct", "_home", "_leave", "_loops", "_process", "resume")

    def __init__(self, plugins: Any = None, opened: list[Any] | None = None, *, direct: bool = True) -> None:
        """Prepare a greenlet, as ``Driver`` does.

        Args:
            plugins: The plugins of the simulation's environment.
            opened: What the simulation has opened on an earlier stack.
            direct: Whether ``resume`` may be called without ``enter``. If False, ``caller`` stays None.
        """
        super().__init__(plugins, opened)
        self._direct = direct
        self._home, self._process = ref(_home()), getpid()
        self._loops = Loops()
        self._body: Any = greenlet(self._serve)
        self._asker: greenlet | None = None  # the model's own greenlet that waits for an answer
        self._leave: Any = None
        self.resume: Any = self._body.switch

    # -- on the user's side -----------------------------------------------------------------------

    def begin(self, job: Callable[[], Any], events: Mapping[Hook, Any] = NO_EVENTS, context: Any = None) -> None:
        """Prepare a job. The next ``resume`` starts it on the stack."""
        self.enter()
        self._job, self._events, self._refused = job, events, None
        # A new greenlet has an empty context, but the model expects the user's context variables.
        self._body.gr_context = copy_context() if context is None else context

    def enter(self) -> None:
        """Prepare to resume the simulation from the current greenlet.

        Raises:
            WrongThreadError: The simulation belongs to another thread.
        """
        if self._body is None or not self.reachable:
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
        return self._home() is _home()

    @property
    def lost(self) -> bool:
        """Whether the simulation's thread has ended, or does not exist in this forked process."""
        return self._home() is None or (getpid() != self._process and not self.reachable)

    @property
    def usable(self) -> bool:
        """Whether a job can begin in the current thread."""
        return super().usable and not self._body.dead

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
                self._loops.begin()
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
        deliver, driver, loops = event.deliver, self, self._loops
        rule: Any = hook.rule
        if event.report is not None:
            rule = reporting_rule(hook, event, lambda report: self._decider(hook, report, away))

        def decide(args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
            if away:
                driver._ask_from(getcurrent())
            leave, running = driver._leave, loops.running
            if running is None and ASYNCIO in modules:
                running = loops.running = modules[ASYNCIO]._get_running_loop
            looped = running is not None and (running() is not None or loops.users is not None)
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
