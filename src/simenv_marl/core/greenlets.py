"""The driver that runs a simulation in a greenlet: a separate stack in the user's thread."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from contextvars import Context, copy_context
from sys import modules
from threading import get_ident, local
from typing import Any
from weakref import ref

from greenlet import GreenletExit, getcurrent, greenlet

from ..errors import WrongThreadError
from ..hooks.hook import Hook
from ..hooks.stacks import STACKS, Taker
from ..simulation import RULE
from .loops import LOOPS, Sides, hush
from .switch import BaseDriver, Crossing, Event, SimulationExit, nothing_to_end


class _Home:
    """The identity of a thread. Unlike the thread's number, it is never reused for another thread."""


_homes = local()


def _home() -> _Home:
    try:
        home: _Home = _homes.home
    except AttributeError:
        home = _homes.home = _Home()
    return home


class GreenletDriver(BaseDriver):
    """A driver that runs a simulation in a greenlet of the thread that starts the first job."""

    __slots__ = (
        "_asker", "_body", "_direct", "_here", "_home", "_sides", "_switch_out", "_thread", "resume",
    )  # fmt: skip

    def __init__(self, *, plugins: Any = None, before: BaseDriver | None = None, direct: bool = True) -> None:
        """Prepare a greenlet, as ``BaseDriver`` does.

        Args:
            plugins: The plugins of the simulation's environment.
            before: The simulation's previous driver.
            direct: Whether ``resume`` may be called without ``enter``. If False, ``caller`` stays None.
        """
        super().__init__(plugins=plugins, before=before)
        self._direct = direct
        self._thread = get_ident()
        self._home = ref(_home())
        self._sides = Sides()
        self._body: Any = greenlet(self._serve)
        self._asker: greenlet | None = None  # the model's own greenlet that waits for an answer
        self._here: Any = None
        self._switch_out: Any = None
        self.resume: Callable[[Any], Event] = self._body.switch

    # -- on the simulation's side -----------------------------------------------------------------

    def _serve(self, _: Any) -> None:
        with suppress(GreenletExit):
            self._begin()
            while not self._ended:
                self._sides.begin()
                try:
                    event = self._work()
                finally:
                    if not self._ended:  # once the driver has ended, the stack unwinds by itself
                        self._sides.leave()
                if self._ended:
                    return  # the driver was dropped, and the stack has unwound by itself
                self._body.gr_context = None
                self._idle = True
                self._switch_out(*event)

    def _decider(self, hook: Hook, event: Crossing, away: bool = False) -> Taker:
        rule, deliver, driver, sides = self._rule_of(hook, event, away), event.deliver, self, self._sides

        def decide(args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
            if away:
                driver._ask_from(getcurrent())
            switch_out = driver._switch_out
            find_loop = sides.find
            own = None
            try:
                if find_loop is None:
                    if LOOPS in modules:
                        own = sides.look()
                        find_loop = sides.find
                elif find_loop() is not None or sides.users is not None:
                    own = sides.leave()
                reply = switch_out(event, args, kwargs)
            except BaseException:
                if not driver._ended:  # once the driver has ended, the stack unwinds by itself
                    if away:
                        driver._ask_from(None)
                    sides.enter()
                    hush()
                raise
            if away:
                driver._ask_from(None)
            if find_loop is not None and (own is not None or find_loop() is not None):
                sides.enter()
            if reply is RULE:
                return rule(*args, **kwargs) if kwargs else rule(*args)
            return reply if deliver is None else deliver(reply, *args, **kwargs)

        return decide

    def _ask_from(self, asker: greenlet | None) -> None:
        """Remember the model's own greenlet that asks for a decision, so that ``resume`` switches to it."""
        self._asker = asker
        self.resume = (self._body if asker is None else asker).switch

    # -- on the user's side -----------------------------------------------------------------------

    def prepare(
        self, job: Callable[[], Any], decisions: Mapping[Hook, Crossing] | None = None, context: Context | None = None
    ) -> None:
        """Prepare a job. The next ``resume`` begins to run it on the stack."""
        self.enter()
        if "gevent" in modules:
            _share_hub(modules["gevent"].get_hub())
        self._prepare(job, decisions, None)
        # A new greenlet has an empty context, but the model expects the user's context variables.
        self._body.gr_context = copy_context() if context is None else context

    def enter(self) -> None:
        """Prepare to resume the simulation from the current greenlet.

        Raises:
            WrongThreadError: The simulation belongs to another thread.
        """
        here = getcurrent()
        if here is self._here:
            return
        if self._body is None or not self.reachable():
            raise WrongThreadError(
                "the simulation is suspended in another thread, the one that called reset(); step, reset and close the"
                ' environment there, or make it with driver="thread", which allows any thread'
            )
        self._here, self._switch_out = here, here.switch
        self._body.parent = here  # control returns here when the stack ends
        # Inside another environment's simulation, ``enter`` is needed before each step, to hide that simulation.
        self.caller = here if self._direct and here not in STACKS else None

    def throw(self) -> Event:
        """Raise ``SimulationExit`` in the suspended simulation; return its next event."""
        self.enter()
        if self._idle or not self._body:  # the job has ended, or was interrupted before it began
            self._job = None
            return nothing_to_end()
        self._exiting = True
        event: Event = (self._asker or self._body).throw(SimulationExit())
        return event

    def reachable(self) -> bool:
        """Whether the simulation can be resumed from the current thread."""
        return self._home() is _home()

    def lost(self) -> bool:
        """Whether the simulation's thread has ended, so that nothing can resume the simulation."""
        return self._home() is None

    @property
    def usable(self) -> bool:
        """Whether the current thread can start a job."""
        return super().usable and not self._body.dead

    def end(self) -> None:
        """End the stack."""
        if self._ended:
            return
        self._forget_stack()
        body, self._body = self._body, None
        self._asker = self._here = self._switch_out = self.caller = self.resume = None  # type: ignore[assignment]
        if self._idle and self.reachable() and body:
            body.parent = getcurrent()
            body.throw()

    def give_up(self) -> None:
        """Abandon a job that does not unwind, and leave it suspended."""
        self._forget_stack()
        _given_up.append(self)

    def forked(self) -> None:
        """Handle a fork in the child process, in which only one thread is left."""
        if self._thread != get_ident():
            self._stay_behind()


def _share_hub(hub: Any) -> None:
    """Attach gevent's hub to its thread's main greenlet, even if a simulation was the first to use the hub."""
    root = getcurrent()
    while root.parent is not None:
        root = root.parent
    if hub.parent is not root:
        hub.parent = root


_given_up: list[GreenletDriver] = []
"""Simulations that did not unwind. They are kept, because freeing a greenlet resumes it, at an arbitrary moment."""
