"""A driver that runs a simulation on a greenlet: a stack of its own in the thread of its user."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextvars import copy_context
from functools import partial
from sys import modules
from threading import get_ident, local
from typing import Any, Final
from weakref import ref

from greenlet import getcurrent, greenlet

from ..errors import WrongThreadError
from ..simulation import RULE
from .switch import FINISHED, RUNNING, Ask, Bound, Event, Offspring, SimulationExit, Watchful

LOOPS: Final = "asyncio.events"
"""What knows the event loop that runs in a thread, whichever stack it runs on: a simulation's and its user's are to be
kept apart. Where nobody has imported it, nobody runs a loop."""


class _Home:
    """Stands for a thread; unlike the thread's number it is never given to another one."""


_homes = local()


def _home() -> _Home:
    try:
        home: _Home = _homes.home
    except AttributeError:
        home = _homes.home = _Home()
    return home


class GreenletDriver(Watchful):
    """Runs a simulation on a greenlet of the thread in which it is made."""

    __slots__ = (
        "_ask", "_body", "_get_loop", "_home", "_inside", "_switch_out", "_thread", "_users_loop", "caller", "resume",
    )  # fmt: skip

    def __init__(self, run: Callable[[], Any], bindings: Mapping[Any, Bound], offspring: Offspring) -> None:
        """Prepare a greenlet; the first ``resume`` starts it.

        Args:
            run: The simulation's main loop.
            bindings: The decision points that are handed over; all others run their rule.
            offspring: The threads that the simulation has started or is going to.
        """
        super().__init__(bindings, offspring)
        self._ask: Ask | None = self.ask
        self._thread = get_ident()
        self._home = ref(_home())
        self._get_loop: Any = None  # found where asyncio has been imported
        self._users_loop: Any = None
        self._body = greenlet(self._run)
        # A new greenlet has an empty context; a model expects the one that its user has set up.
        self._body.gr_context = copy_context()
        self._inside: Any = self._body
        self.resume: Callable[[Any], Event] = partial(self._body.switch, run)
        self.caller: Any = getcurrent()
        self._switch_out = self.caller.switch

    def _run(self, run: Callable[[], Any], _: Any) -> Event:
        self._inside = None  # the first decision sets ``resume`` to what resumes it
        try:
            self._go_in(None)
            return self._live(run)
        finally:
            self._go_out()

    def ask(self, point: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """In the simulation: decide a call of a decision point."""
        binding = self._bindings.get(point)
        if binding is None:
            return point.rule(*args, **kwargs)
        if getcurrent() is not self._inside:
            self._come_back_here()
        switch_out = self._switch_out
        thread = self._thread
        # What ``_go_out`` and ``_go_in`` do, without the calls.
        loop = None
        get_loop = self._get_loop
        if get_loop is None and LOOPS in modules:
            get_loop = self._get_loop = modules[LOOPS]._get_running_loop
        if get_loop is not None:
            loop = get_loop()
            if loop is not None or self._users_loop is not None:
                self._leave_loop()
        try:
            del RUNNING[thread]
            reply = switch_out(binding, args, kwargs)
            RUNNING[thread] = self._ask  # type: ignore[assignment]  # it is only forgotten when something is thrown
        except BaseException:
            self._go_in(loop)
            raise
        if get_loop is not None and (loop is not None or get_loop() is not None):
            self._enter_loop(loop)
        if reply is RULE:
            if binding.by_rule is not None:
                return binding.by_rule(point, args, kwargs)
            return point.rule(*args, **kwargs) if kwargs else point.rule(*args)
        deliver = binding.deliver
        return reply if deliver is None else deliver(reply, *args, **kwargs)

    def _come_back_here(self) -> None:
        """A model may switch stacks of its own: remember the one that asks."""
        # The stack that asks must not refer to itself, which nobody could collect.
        self._inside = getcurrent()
        self.resume = self._inside.switch

    def _go_in(self, loop: Any) -> None:
        """The simulation goes on, in the event loop in which it was."""
        if self._ask is not None:  # else it is forgotten, and unwinds without having been asked to
            RUNNING[self._thread] = self._ask
            if LOOPS in modules:
                self._enter_loop(loop)

    def _go_out(self) -> None:
        """The simulation's user goes on, in the event loop in which that was."""
        if self._ask is not None:
            RUNNING.pop(self._thread, None)  # an interrupt may have taken it out already
            if LOOPS in modules:
                self._leave_loop()

    def _leave_loop(self) -> Any:
        events = modules[LOOPS]
        loop = events._get_running_loop()
        if loop is not None or self._users_loop is not None:
            events._set_running_loop(self._users_loop)
            self._users_loop = None
        return loop

    def _enter_loop(self, loop: Any) -> None:
        events = modules[LOOPS]
        self._users_loop = events._get_running_loop()
        if loop is not None or self._users_loop is not None:
            events._set_running_loop(loop)

    def enter(self) -> None:
        """Make ready to be resumed from here.

        Raises:
            WrongThreadError: The simulation lives in another thread.
        """
        caller = getcurrent()
        if caller is self.caller:
            return
        if not self.reachable():
            raise WrongThreadError(
                "the simulation is suspended in another thread, the one that has begun the episode, and only there it"
                ' can be stepped, closed and reset; made with driver="thread", an environment can be used from any'
            )
        self.caller, self._switch_out = caller, caller.switch
        self._body.parent = caller  # where the simulation's end arrives

    def throw(self) -> Event:
        """Raise ``SimulationExit`` in the suspended simulation; return the event that comes from it next."""
        self.enter()
        if not self._body:  # it has ended, or was interrupted before it began
            return FINISHED, None, None
        event: Event = self._inside.throw(SimulationExit())
        return event

    def reachable(self) -> bool:
        """Whether the simulation can be resumed from here."""
        return self._home() is _home()

    def lost(self) -> bool:
        """Whether the thread has ended in which alone the simulation could be resumed."""
        return self._home() is None

    def forget(self) -> None:
        """Let go of all references to the simulation. Should it still be suspended, it unwinds by itself."""
        self._ask = None
        self._disown()
        del self._body, self._inside, self._switch_out, self.caller, self.resume

    def give_up(self) -> None:
        """Leave a simulation that does not unwind where it is."""
        self.offspring.driver = None
        _given_up.append(self)


_given_up: list[GreenletDriver] = []
"""Simulations that refused to unwind: dropping them would resume them at some random moment."""
