"""A driver that runs a simulation on a greenlet: a stack of its own in the thread of its user."""

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
    """Stands for a thread; unlike the thread's number it is never given to another one."""


_homes = local()


def _home() -> _Home:
    try:
        home: _Home = _homes.home
    except AttributeError:
        home = _homes.home = _Home()
    return home


class GreenletDriver(BaseDriver):
    """Runs a simulation on a greenlet of the thread in which the first job is started."""

    __slots__ = (
        "_asker", "_body", "_direct", "_here", "_home", "_sides", "_switch_out", "_thread", "resume",
    )  # fmt: skip

    def __init__(self, *, plugins: Any = None, before: BaseDriver | None = None, direct: bool = True) -> None:
        """Prepare a greenlet, as ``BaseDriver`` does.

        Args:
            plugins: The plugins of the simulation's environment.
            before: The driver that the simulation had before.
            direct: Whether ``resume`` may be called without anything else; no: ``caller`` stays None.
        """
        super().__init__(plugins=plugins, before=before)
        self._direct = direct
        self._thread = get_ident()
        self._home = ref(_home())
        self._sides = Sides()
        self._body: Any = greenlet(self._serve)
        self._asker: greenlet | None = None  # the greenlet of the model's own that waits for an answer
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
                    if not self._ended:  # else it unwinds without having been asked to
                        self._sides.leave()
                if self._ended:
                    return  # it was let go of, and has unwound by itself
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
                if not driver._ended:  # else it unwinds without having been asked to
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
        """A model may switch stacks of its own: remember the one that asks for as long as it does."""
        self._asker = asker
        self.resume = (self._body if asker is None else asker).switch

    # -- on its user's ----------------------------------------------------------------------------

    def prepare(
        self, job: Callable[[], Any], decisions: Mapping[Hook, Crossing] | None = None, context: Context | None = None
    ) -> None:
        """Have the next ``resume`` begin to run something on the stack."""
        self.enter()
        if "gevent" in modules:
            _share_hub(modules["gevent"].get_hub())
        self._prepare(job, decisions, None)
        # A new greenlet has an empty context; a model expects the one that its user has set up.
        self._body.gr_context = copy_context() if context is None else context

    def enter(self) -> None:
        """Make ready to be resumed from here.

        Raises:
            WrongThreadError: The simulation lives in another thread.
        """
        here = getcurrent()
        if here is self._here:
            return
        if self._body is None or not self.reachable():
            raise WrongThreadError(
                "the simulation is suspended in another thread, the one that has begun the episode, and only there it"
                ' can be stepped, closed and reset; made with driver="thread", an environment can be used from any'
            )
        self._here, self._switch_out = here, here.switch
        self._body.parent = here  # where the stack's end arrives
        # Inside another environment's simulation, that is to be masked before each step.
        self.caller = here if self._direct and here not in STACKS else None

    def throw(self) -> Event:
        """Raise ``SimulationExit`` in the suspended simulation; return the event that comes from it next."""
        self.enter()
        if self._idle or not self._body:  # the job has ended, or was interrupted before it began
            self._job = None
            return nothing_to_end()
        self._exiting = True
        event: Event = (self._asker or self._body).throw(SimulationExit())
        return event

    def reachable(self) -> bool:
        """Whether the simulation can be resumed from here."""
        return self._home() is _home()

    def lost(self) -> bool:
        """Whether the thread has ended in which alone the simulation could be resumed."""
        return self._home() is None

    @property
    def usable(self) -> bool:
        """Whether a job can be started from here."""
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
        """Leave a job that does not unwind where it is."""
        self._forget_stack()
        _given_up.append(self)

    def forked(self) -> None:
        """The process was forked, and this is the child, in which only one thread is left."""
        if self._thread != get_ident():
            self._stay_behind()


def _share_hub(hub: Any) -> None:
    """Have gevent's hub belong to the thread that it serves, and not to a simulation that was the first to use it."""
    root = getcurrent()
    while root.parent is not None:
        root = root.parent
    if hub.parent is not root:
        hub.parent = root


_given_up: list[GreenletDriver] = []
"""Simulations that refused to unwind: dropping them would resume them at some random moment."""
