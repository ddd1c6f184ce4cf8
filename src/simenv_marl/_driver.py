"""Switching between a simulation's stack and its user's: who runs, and how a decision crosses over.

On the user's side a driver has two moves: ``resume`` hands a reply to the simulation and returns what comes
from it next, and ``throw`` raises ``SimulationExit`` in it instead. On the simulation's side its ``ask`` is
what decision functions call: it hands the call over and carries out the reply. What crosses from the
simulation is an *event*, a tuple of three: a decision (its binding, args, kwargs), or ``FINISHED`` or
``FAILED`` (with what ``run`` has returned or raised, and None).

While a simulation runs, ``RUNNING`` holds the ``ask`` of its driver for its thread. It is empty whenever no
simulation runs behind an environment, so that a decision function which is called outside any environment
finds that out by one test.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import copy_context
from functools import partial
from sys import modules
from threading import get_ident, local
from typing import Any, Final, Protocol
from weakref import ref

from greenlet import getcurrent, greenlet

from .errors import WrongThreadError
from .simulation import RULE, Sentinel

Ask = Callable[[Any, tuple[Any, ...], dict[str, Any]], Any]
"""Decides a call of a decision point: of the point, and of the call's arguments."""

RUNNING: dict[int, Ask] = {}
"""By thread: whom decision functions ask there. Touched by drivers and ``unattended`` alone."""


EVALUATING: dict[int, dict[Any, Any]] = {}
"""By thread: what differences remember for the agent whose mapping is being evaluated there."""


PLUGGED: dict[int, Any] = {}
"""By thread: the plugins of the environment that is at work there, if it has any."""


class Surrounding(Protocol):
    """Something that an environment's simulation is to find around it whenever it is at work.

    The environment's user enters it before anything runs for the environment, and leaves it afterwards. That may
    be nested, and ``unattended`` may lie in between.
    """

    def enter(self) -> None:
        """Put it up."""

    def leave(self) -> None:
        """Take it down: what was there before is there again."""

    def around(self, run: Callable[[], Any]) -> Callable[[], Any]:
        """The simulation's main loop with this around it, in whatever thread that runs.

        Where it runs in its user's thread, ``enter`` has already been called whenever it is resumed.
        """


class SimulationExit(SystemExit):
    """Raised in a suspended simulation to unwind it. Neither an error nor anything to be caught.

    A ``SystemExit``, because event loops pass that on at once, where they would keep any other exception for
    whoever awaits the task and let the other tasks go on.
    """


class Bound(Protocol):
    """What a driver needs of a function under an environment's definition."""

    @property
    def deliver(self) -> Callable[..., Any] | None:
        """Turns a reply and the call's arguments into what the call returns; None: the reply is that."""


FINISHED: Final = Sentinel("FINISHED")
FAILED: Final = Sentinel("FAILED")

Event = tuple[Any, Any, Any]


class Driver(Protocol):
    """What an episode needs of a driver.

    Attributes:
        resume: Lets the simulation go on with a reply; returns the event that comes from it next.
        caller: On whose stack that may be called without ``enter`` before.
    """

    resume: Callable[[Any], Event]
    caller: Any

    def enter(self) -> None:
        """Make ready to be resumed from here.

        Raises:
            WrongThreadError: The simulation cannot be resumed from here.
        """

    def throw(self) -> Event:
        """Raise ``SimulationExit`` in the suspended simulation; return the event that comes from it next."""

    def reachable(self) -> bool:
        """Whether the simulation can be resumed from here."""

    def lost(self) -> bool:
        """Whether the simulation cannot be resumed from anywhere any more."""

    def forget(self) -> None:
        """Let go of all references to the simulation. Should it still be suspended, it unwinds by itself."""


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


class GreenletDriver:
    """Runs a simulation on a greenlet of the thread in which it is made."""

    __slots__ = (
        "_ask", "_bindings", "_body", "_get_loop", "_home", "_inside", "_switch_out", "_thread", "_users_loop",
        "caller", "resume",
    )  # fmt: skip

    def __init__(self, run: Callable[[], Any], bindings: Mapping[Any, Bound]) -> None:
        """Prepare a greenlet; the first ``resume`` starts it.

        Args:
            run: The simulation's main loop.
            bindings: The decision points that are handed over; all others run their rule.
        """
        self._bindings = bindings
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
        self._go_in(None)
        try:
            return FINISHED, run(), None
        except BaseException as error:
            return FAILED, error, None
        finally:
            self._go_out()

    def ask(self, point: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """In the simulation: decide a call of a decision point."""
        binding = self._bindings.get(point)
        if binding is None:
            return point.rule(*args, **kwargs)
        if getcurrent() is not self._inside:
            self._come_back_here()
        switch_out, thread, deliver, loop = self._switch_out, self._thread, binding.deliver, None
        # What ``_go_out`` and ``_go_in`` do, without the calls.
        get_loop = self._get_loop
        if get_loop is None and LOOPS in modules:
            get_loop = self._get_loop = modules[LOOPS]._get_running_loop
        if get_loop is not None:
            loop = get_loop()
            if loop is not None or self._users_loop is not None:
                self._leave_loop()
        del RUNNING[thread]
        try:
            reply = switch_out(binding, args, kwargs)
        except BaseException:
            self._go_in(loop)
            raise
        RUNNING[thread] = self._ask  # type: ignore[assignment]  # it is only forgotten when something is thrown
        if get_loop is not None and (loop is not None or get_loop() is not None):
            self._enter_loop(loop)
        if reply is RULE:
            return point.rule(*args, **kwargs) if kwargs else point.rule(*args)
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
            if LOOPS in modules:
                self._leave_loop()
            del RUNNING[self._thread]

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
                "a simulation on a greenlet can only be stepped, reset and closed in mid-episode from the thread"
                " that has begun the episode"
            )
        self.caller, self._switch_out = caller, caller.switch
        self._body.parent = caller  # where the simulation's end arrives

    def throw(self) -> Event:
        """Raise ``SimulationExit`` in the suspended simulation; return the event that comes from it next."""
        self.enter()
        if self._body.dead:
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
        del self._bindings, self._body, self._inside, self._switch_out, self.caller, self.resume


def attended() -> bool:
    """Whether a simulation, or a mapping, runs around us in this thread."""
    thread = get_ident()
    return thread in RUNNING or thread in EVALUATING or thread in PLUGGED


@contextmanager
def unattended() -> Iterator[None]:
    """Keep apart what runs in this thread from the simulation or mapping that runs around it.

    Decision functions run their rule, differences are asked for nobody, and there are no plugins but those of the
    whole process, until an episode says otherwise.
    """
    thread = get_ident()
    ask, memory, plugins = RUNNING.pop(thread, None), EVALUATING.pop(thread, None), PLUGGED.pop(thread, None)
    try:
        yield
    finally:
        if ask is not None:
            RUNNING[thread] = ask
        if memory is not None:
            EVALUATING[thread] = memory
        if plugins is not None:
            PLUGGED[thread] = plugins
