"""Between a simulation's stack and its user's: who runs, and how a decision crosses over.

On the user's side a driver has two moves: ``resume`` hands a reply to the simulation and returns what comes
from it next, and ``throw`` raises ``SimulationExit`` in it instead. On the simulation's side its ``ask`` is
what decision functions call: it hands the call over and carries out the reply. What crosses from the
simulation is an *event*, a tuple of three: a decision (its binding, args, kwargs), or ``FINISHED`` or
``FAILED`` (with what ``run`` has returned or raised, and None).

While a simulation runs, ``RUNNING`` holds the ``ask`` of its driver for its thread. A thread that a simulation
has started has an entry of its own, its ``Offspring``, which refuses to decide. Else ``RUNNING`` is empty, so
that a decision function which is called outside any environment finds that out by one test.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from functools import wraps
from threading import Thread, get_ident
from typing import Any, Final, Protocol

from ..errors import WrongThreadError, annotate
from ..simulation import Sentinel

Ask = Callable[[Any, tuple[Any, ...], dict[str, Any]], Any]
"""Decides a call of a decision point: of the point, and of the call's arguments."""


class _Running(dict[int, Ask]):
    """There is one in a process: decision functions that are pickled by value find that of their new process."""

    def __reduce__(self) -> str:
        return "RUNNING"


RUNNING: Final = _Running()
"""By thread: whom decision functions ask there. Touched by drivers and by this module alone."""

EVALUATING: dict[int, dict[Any, Any]] = {}
"""By thread: what differences remember for the agent whose mapping is being evaluated there."""


PLUGGED: dict[int, Any] = {}
"""By thread: the plugins of the environment that is at work there, if it has any."""


class Surrounding(Protocol):
    """Something that an environment's simulation is to find around it whenever it is at work.

    The environment's user enters it before anything runs for the environment, and leaves it afterwards. That may
    be nested, and ``unattended`` may lie in between.
    """

    def begin(self, seed: int) -> None:
        """An episode begins, with that seed. Called between ``enter`` and ``leave``."""

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

    @property
    def by_rule(self) -> Callable[..., Any] | None:
        """Has the rule of a point decide a call; None: nobody wants to know what comes of it."""


class Refused:
    """Stands for the binding of every decision once one was refused; the event tells the user."""

    deliver = by_rule = None


FINISHED: Final = Sentinel("FINISHED")
FAILED: Final = Sentinel("FAILED")
STUCK: Final = Sentinel("STUCK")
"""What ``throw`` returns, with for how many seconds it has waited, where nothing comes from the simulation."""
REFUSED: Final = Refused()

Event = tuple[Any, Any, Any]


class Driver(Protocol):
    """What an episode needs of a driver.

    Attributes:
        caller: On whose stack ``resume`` may be called without ``enter`` before.
    """

    caller: Any

    @property
    def resume(self) -> Callable[[Any], Event]:
        """Lets the simulation go on with a reply; returns the event that comes from it next."""

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

    def give_up(self) -> None:
        """Leave a simulation that does not unwind where it is."""

    def refusal(self) -> WrongThreadError:
        """The error that tells the user of a decision that was refused to a thread of the simulation's."""


class Watchful:
    """What all drivers do about the threads that their simulation starts."""

    __slots__ = ("_bindings", "_refused", "offspring")

    def __init__(self, bindings: Mapping[Any, Bound], offspring: Offspring) -> None:
        self._bindings = bindings
        self._refused: WrongThreadError | None = None
        self.offspring = offspring
        offspring.driver = self

    def decides(self, point: Any) -> bool:
        """Whether calls of a decision point are handed over."""
        return point in self._bindings

    def refuse(self, point: Any) -> WrongThreadError:
        """Refuse a decision, for the user to be told at the simulation's next event; return the error for the caller.

        Called in whichever thread has asked.
        """
        error = WrongThreadError(
            f"{point.name} was called in a thread that the simulation has started, where nobody can be asked: the"
            " simulation itself goes on meanwhile. Call it where run() runs, and have the thread wait for the answer"
        )
        if self._refused is None:
            self._refused = error
            self._bindings = dict.fromkeys(self._bindings, REFUSED)
        return error

    def refusal(self) -> WrongThreadError:
        """The error that tells the user of a decision that was refused to a thread of the simulation's."""
        refused, self._refused = self._refused, None
        error = WrongThreadError(*(() if refused is None else refused.args))
        error.__cause__ = refused
        return error

    def _live(self, run: Callable[[], Any]) -> Event:
        """In the simulation: run it to its end; return the event that this is."""
        try:
            result = run()
        except BaseException as error:
            if self._refused is not None and self._refused is not error:
                if isinstance(error, SimulationExit):
                    return FAILED, self.refusal(), None
                annotate(error, f"simenv_marl: and before that a decision was refused: {self._refused}")
            return FAILED, error, None
        return (FINISHED, result, None) if self._refused is None else (FAILED, self.refusal(), None)

    def _disown(self) -> None:
        """Have nothing to do any more with threads that the simulation has started."""
        self._bindings = {}
        if self.offspring.driver is self:
            self.offspring.driver = None


# -- threads that simulations start ---------------------------------------------------------------


class Offspring:
    """The threads that one simulation has started, over all its episodes. As an ``Ask``, it is theirs.

    Attributes:
        driver: Of the episode that is going on; None between episodes, when decision functions run their rule.
    """

    __slots__ = ("driver",)

    def __init__(self) -> None:
        watch_threads()
        self.driver: Watchful | None = None

    def __call__(self, point: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Refuse a decision that the environment would have to make.

        Raises:
            WrongThreadError: It is one.
        """
        driver = self.driver
        if driver is not None and driver.decides(point):
            raise driver.refuse(point)
        return point.rule(*args, **kwargs)


def watch_threads() -> None:
    """Find out, from now on, which threads are started by simulations.

    Threads do not know by whom they were started, and inherit nothing that would tell.
    """
    if _watching:
        return
    _watching.append(True)
    original = Thread.start

    @wraps(original)
    def start(self: Thread) -> None:
        ask: Any = RUNNING.get(get_ident()) if RUNNING else None
        if ask is None:
            original(self)
            return
        disown = _adopt(self, ask if type(ask) is Offspring else ask.__self__.offspring)
        try:
            original(self)
        except BaseException:
            disown()
            raise

    Thread.start = start  # type: ignore[method-assign]


_watching: list[bool] = []


def _adopt(thread: Thread, offspring: Offspring) -> Callable[[], None]:
    """Enter a thread that is about to be started as one of a simulation's. Returns what undoes that."""
    run, own = thread.run, vars(thread).get("run")

    def adopted() -> None:
        disown()
        ident = get_ident()
        RUNNING[ident] = offspring
        try:
            run()
        finally:
            RUNNING.pop(ident, None)

    def disown() -> None:
        if vars(thread).get("run") is adopted:
            del thread.run
            if own is not None:
                thread.run = own  # type: ignore[method-assign]

    thread.run = adopted  # type: ignore[method-assign]
    return disown


def _alone() -> None:
    """In the child of a fork, where no other thread is."""
    thread = get_ident()
    for book in (RUNNING, EVALUATING):
        for other in [other for other in book if other != thread]:
            del book[other]


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_alone)


# -- what runs around us --------------------------------------------------------------------------


def attended() -> bool:
    """Whether a simulation, or a mapping, runs around us in this thread."""
    thread = get_ident()
    return thread in RUNNING or thread in EVALUATING or thread in PLUGGED


def interrupted() -> None:
    """An episode was ended by an error, on its user's side: in this thread nothing of it runs any more."""
    thread = get_ident()
    RUNNING.pop(thread, None)
    EVALUATING.pop(thread, None)


class unattended:  # noqa: N801 - it is used like a function
    """Keep apart what runs in this thread from the simulation or mapping that runs around it.

    Decision functions run their rule, differences are asked for nobody, and there are no plugins but those of the
    whole process, until an episode says otherwise. This and its like are classes, because a context manager made of
    a generator cannot pass on errors that refuse to be changed, as frozen dataclasses do.
    """

    __slots__ = ("_around",)

    def __enter__(self) -> None:
        thread = get_ident()
        self._around: tuple[Any, ...] = (
            RUNNING.pop(thread, None),
            EVALUATING.pop(thread, None),
            PLUGGED.pop(thread, None),
        )

    def __exit__(self, *error: object) -> None:
        thread = get_ident()
        books: tuple[dict[int, Any], ...] = (RUNNING, EVALUATING, PLUGGED)
        for book, before in zip(books, self._around, strict=True):
            if before is not None:
                book[thread] = before
            else:
                book.pop(thread, None)


class preparing:  # noqa: N801
    """Make or reset a simulation, ``unattended``: nothing is decided, but threads that are started are its own."""

    __slots__ = ("_offspring",)

    def __init__(self, offspring: Offspring) -> None:
        self._offspring = offspring

    def __enter__(self) -> None:
        self._offspring.driver = None  # also where an interrupt has kept the episode before from ending
        RUNNING[get_ident()] = self._offspring

    def __exit__(self, *error: object) -> None:
        RUNNING.pop(get_ident(), None)
