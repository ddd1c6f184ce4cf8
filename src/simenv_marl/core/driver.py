"""Drivers: how control switches between a simulation's stack and its user's stack.

A driver keeps one stack for a simulation, over all its episodes: a greenlet, or a thread. *Jobs* run on it one after
the other: the making of the simulation, then its ``reset`` and its ``run`` for each episode. On the user's side
``begin`` prepares a job. ``resume`` starts it, and later passes replies to the simulation. ``throw`` raises
``SimulationExit`` in it. ``resume`` and ``throw`` return the simulation's next *event*, a tuple ``(event, args,
kwargs)``. For a decision these are an object of the plan or the episode, and the arguments of the call. For the end of
a job they are ``FINISHED`` or ``FAILED``, a list with the result or the error, and None. The receiver must empty that
list, because the waiting stack still refers to it. The episode calls the event's ``handle``, which returns the reply.

On the simulation's side a driver enters its stack into the hooks of the model's functions, each with the interceptor
that sends an event and carries out the reply. It also notes what the simulation opens: decisions in its threads are
refused, and threads, processes and sockets do not continue in a forked process.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextvars import Context, copy_context
from functools import partial, wraps
from multiprocessing.process import BaseProcess
from socket import socket
from subprocess import Popen
from threading import Thread
from types import MappingProxyType
from typing import Any, Final
from weakref import WeakSet

from greenlet import getcurrent, greenlet

from ..errors import SimulationError, WrongThreadError, annotate
from ..hooks.hook import Hook
from ..hooks.stacks import LOCK, STACKS, Interceptor, stack_of
from ..simulation import TRUNCATED, Sentinel

Event = tuple[Any, Any, Any]

NO_EVENTS: Final[Mapping[Hook, Any]] = MappingProxyType({})
"""The events while a simulation is made, reset or closed: none, so that decision functions run their rule."""

WAIT: Final = Sentinel("WAIT")
"""What an event's ``handle`` returns instead of a reply if the episode waits for an action, or is over."""

SECONDS_TO_UNWIND: Final = 5.0
"""The seconds that a simulation in a thread may take, while it is unwound, to its next decision or its end."""

UNWINDING_TRIES: Final = 1000
"""How often ``SimulationExit`` is raised in a simulation before it is given up. It may decide again, or swallow the
exit. A SimPy model loses one of its processes at each try."""


class SimulationExit(SystemExit):
    """Raised in a suspended simulation to unwind it. It is not an error, and models should not catch it.

    It is a ``SystemExit``, because event loops pass that on at once. They would keep any other exception for the code
    that awaits the task, and let the other tasks continue.
    """


def is_exit(error: BaseException | None) -> bool:
    """Whether an error is a ``SimulationExit``, was caused by one, or is an exception group of only such errors."""
    seen = set()  # causes may be cyclic
    while error is not None and id(error) not in seen:
        if isinstance(error, SimulationExit):
            return True
        if isinstance(error, BaseExceptionGroup) and all(map(is_exit, error.exceptions)):
            return True
        seen.add(id(error))
        error = error.__cause__
    return False


class _Finished:
    """The event of a job that has returned."""

    def handle(self, episode: Any, box: list[Any], _: Any) -> Any:
        """End the episode of all agents. The box holds the value that ``run`` returned."""
        episode.running = False
        episode.finish(truncated=box.pop() is TRUNCATED)
        return WAIT


class _Failed:
    """The event of a job that has raised."""

    def handle(self, episode: Any, box: list[Any], _: Any) -> Any:
        """Raise the error in the box."""
        episode.running, episode.failed_in_model = False, True
        raise box.pop()


class _Refused:
    """The event of a decision after another one was refused: see ``Driver.refuse``."""

    deliver = report = None

    def handle(self, episode: Any, args: Any, kwargs: Any) -> Any:
        """Raise the error that describes the refused call."""
        episode.failed_in_model = True
        raise episode.driver.refusal()


FINISHED: Final[Any] = _Finished()
FAILED: Final[Any] = _Failed()
_REFUSED: Final[Any] = _Refused()


class Driver:
    """The base class of drivers.

    Besides the methods here, a driver has ``resume(reply)``, which returns the simulation's next event; ``throw()``,
    which raises ``SimulationExit`` in the suspended simulation and returns its next event, or None if none comes in
    time; ``enter()``, which prepares to resume the simulation from the current thread and greenlet, or raises a
    ``WrongThreadError``; ``end()``, which ends the stack; and ``abandon()``, which gives up a job that does not unwind.

    Attributes:
        stack: The simulation's stack. None before the first job, and after the end.
        caller: The greenlet from which ``resume`` may be called directly. None: ``enter`` must be called before.
        plugins: The plugins of the simulation's environment, which apply to all code on the stack. None if it has none.
        given_up: The reason why a job was given up. None if no job was.
        ended: Whether the stack has ended.
        idle: Whether no job is under way.
        reachable: Whether the simulation can be resumed from the current thread and process.
        lost: Whether no thread of this process can resume the simulation any more.
        at_home: Whether this code runs in the simulation's thread.
        own_thread: Whether the simulation has a thread of its own.
        opened: The sockets, processes and threads that the simulation has opened; None before the first one.
    """

    __slots__ = (
        "__weakref__", "_context", "_events", "_exiting", "_handled", "_job",
        "_process_refused", "_refused", "caller", "ended", "given_up", "idle", "opened", "plugins", "stack",
    )  # fmt: skip

    resume: Any
    throw: Any
    enter: Any
    end: Any
    abandon: Any
    reachable: Any
    lost: Any
    at_home: Any
    _decider: Any

    own_thread = False

    def __init__(self, plugins: Any = None, opened: WeakSet[Any] | None = None) -> None:
        """Prepare a driver. The first job begins the stack. ``opened``: what was opened on an earlier stack."""
        self.plugins = plugins
        self._handled: tuple[Hook, ...] = () if plugins is None else tuple(plugins.hooks)
        self.opened = opened
        self.stack: greenlet | None = None
        self.caller: greenlet | None = None
        self.given_up: str | None = None
        self.ended, self.idle, self._exiting = False, True, False
        self._job: Any = None
        self._context: Any = None
        self._events = NO_EVENTS
        self._refused: WrongThreadError | None = None
        self._process_refused: str | None = None

    # -- on the user's side -----------------------------------------------------------------------

    def begin(self, job: Callable[[], Any], events: Mapping[Hook, Any] = NO_EVENTS, context: Any = None) -> None:
        """Prepare a job, with the events to send by hook. After ``enter``, the next ``resume`` starts it on the stack.

        All other functions run their rule. Without a context, the job gets a copy of the user's context variables.
        """
        self._job, self._events, self._refused = job, events, None
        self._context = copy_context() if context is None else context

    @property
    def usable(self) -> bool:
        """Whether a job can begin here."""
        return self.idle and not self.ended and bool(self.reachable)

    def run(self, job: Callable[[], Any], context: Context | None = None) -> Any:
        """Run a job to its end, during which decision functions run their rule; return its result."""
        try:
            self.enter()
            self.begin(job, context=context)
            kind, box, _ = self.resume(None)
        except BaseException:
            self.unwind()  # an interrupt has ended the wait
            raise
        value = box.pop()
        if kind is FINISHED:
            return value
        try:
            raise value
        finally:
            del value

    def unwind(self) -> list[BaseException]:
        """Raise ``SimulationExit`` in the current job until it ends. Return the other errors that it raised.

        A job that does not end is given up.
        """
        for _ in range(UNWINDING_TRIES):
            event = self.throw()
            if event is None:
                self.given_up = f"neither decided anything nor ended within {SECONDS_TO_UNWIND} s; it is abandoned"
                break
            kind, box, _ = event
            if kind is FINISHED or kind is FAILED:
                value = box.pop()
                return [value] if kind is FAILED and not is_exit(value) else []
        else:
            self.given_up = (
                f"refuses to end: it went on after SimulationExit was raised in it {UNWINDING_TRIES} times; it is left"
                " suspended. Let the model re-raise exceptions that it does not know; callbacks from C need a"
                " CallbackGuard"
            )
        self.abandon()
        return []

    # -- on the simulation's side -----------------------------------------------------------------

    def _register(self) -> None:
        """On the stack: register it as a simulation's stack."""
        self.stack = stack = getcurrent()
        STACKS[stack] = self
        _watch_resources()

    def _work(self) -> Event:
        """On the stack: run a job; return the event for its end."""
        # No frame here may refer to the stack: it would then refer to itself, and could not be collected.
        self.idle = self._exiting = False
        job, self._job = self._job, None
        try:
            if self._events or self._handled:
                self.enter_hooks()
            result = job()
        except BaseException as error:
            return FAILED, [self._explain(error)], None
        finally:
            job = None
            self._leave_hooks()
            self._events = NO_EVENTS
        return (FINISHED, [result], None) if self._refused is None else (FAILED, [self.refusal()], None)

    def _explain(self, error: BaseException) -> BaseException:
        """Return the error to raise on the user's side for an error of the simulation."""
        if self._refused is not None and self._refused is not error:
            if isinstance(error, SimulationExit):
                return self.refusal()
            annotate(error, f"simenv_marl: before that, a decision was refused: {self._refused}")
        if type(error) is not SimulationExit or self._exiting:
            return error
        stray = SimulationError(
            "the simulation raised a SimulationExit of an earlier episode, which a task, a greenlet or a thread of that"
            " episode has kept; end all of these with their episode (cancel them in stop or in a finally)"
        )
        stray.__cause__ = error
        return stray

    def _forget_stack(self) -> None:
        """Unregister the stack. From now on it takes no part in decisions."""
        self.ended = True
        self._leave_hooks()
        self._events = NO_EVENTS
        stack, self.stack = self.stack, None
        if stack is not None:
            STACKS.pop(stack, None)
        _watch_resources()

    def decides(self, hook: Hook) -> bool:
        """Whether the current job sends events for the calls of a hook."""
        return hook in self._events

    def interceptor(self, hook: Hook, away: bool = True) -> Interceptor | None:
        """Return the interceptor for calls of a hook; None if the rule decides.

        Calls that are ``away`` come from the model's own greenlets or threads, and not from the stack itself.
        """
        event = self._events.get(hook)
        if event is None:
            return None
        if self._process_refused is not None:
            return self.refuse(hook, self._process_refused)
        if away and not self.at_home:
            return self.refuse(hook, "a thread that the simulation has started")
        decide: Interceptor = self._decider(hook, event, away)
        return decide

    def hide(self) -> None:
        """On the stack, leave all hooks, so that the driver takes no part in calls until ``show``."""
        if getcurrent() is self.stack:
            self._leave_hooks()

    def show(self) -> None:
        """On the stack, enter all hooks, so that the driver takes part in calls."""
        if getcurrent() is self.stack:
            self.enter_hooks()

    def enter_hooks(self) -> None:
        """Enter all hooks with the interceptors that they need now. Any code may call this."""
        stack = self.stack
        if stack is not None:
            for hook in (*self._events, *self._handled):
                hook.enter(stack, self.interceptor(hook, away=False), self.plugins)

    def _leave_hooks(self) -> None:
        stack = self.stack
        if stack is not None:
            for hook in (*self._events, *self._handled):
                hook.leave(stack)

    # -- refusals ---------------------------------------------------------------------------------

    def refuse(self, hook: Hook, where: str) -> Interceptor:
        """Make the interceptor that refuses a decision in a place where the simulation cannot wait for it.

        The caller gets the error at once, and the user gets one at the simulation's next event.
        """

        def refuse(args: Any, kwargs: Any) -> Any:
            error = WrongThreadError(
                f"{hook.name} was called in {where}, where the environment cannot ask for a decision. Call it where"
                " run() runs, and pass the decision on"
            )
            if self._refused is None and self._process_refused is None:
                self._refused = error
                self._events = dict.fromkeys(self._events, _REFUSED)
                self.enter_hooks()
            raise error

        return refuse

    def refuse_all(self, where: str) -> None:
        """Refuse all decisions in this process. Only the model gets the errors."""
        self._process_refused = where
        self.enter_hooks()

    def refusal(self) -> WrongThreadError:
        """Make the error that tells the user of a refused decision."""
        refused, self._refused = self._refused, None
        error = WrongThreadError(*(() if refused is None else refused.args))
        error.__cause__ = refused
        return error


# -- the rule's decisions -------------------------------------------------------------------------


def reporting_rule(hook: Hook, report: Interceptor) -> Callable[..., Any]:
    """Return the rule of a hook, which passes each decision to the interceptor ``report``."""
    rule: Callable[..., Any] = hook.rule

    def call(*args: Any, **kwargs: Any) -> Any:
        decision = rule(*args, **kwargs)
        report((decision, args, kwargs), {})
        return decision

    def generate(*args: Any, **kwargs: Any) -> Any:
        decision = yield from rule(*args, **kwargs)
        report((decision, args, kwargs), {})
        return decision

    async def wait(*args: Any, **kwargs: Any) -> Any:
        decision = await rule(*args, **kwargs)
        report((decision, args, kwargs), {})
        return decision

    return {"function": call, "generator": generate, "coroutine": wait}[hook.kind]


# -- what simulations open ------------------------------------------------------------------------

_OPENING: Final = ((Thread, "start"), (socket, "__init__"), (Popen, "__init__"), (BaseProcess, "start"))

_PATCHES: Final[list[tuple[type, str, Any, Any]]] = []
"""The patched methods: what was there before, and the patch. Empty while no simulation lives."""


def _watch_resources() -> None:
    """Note what simulations open, while there are simulations."""
    if bool(STACKS) == bool(_PATCHES):
        return
    with LOCK:
        for owner, name in _OPENING if STACKS and not _PATCHES else ():
            before = vars(owner)[name]
            patch = _noting(before)
            setattr(owner, name, patch)
            _PATCHES.append((owner, name, before, patch))
        while _PATCHES and not STACKS:
            patched, name, before, patch = _PATCHES.pop()
            if vars(patched)[name] is patch:  # else other code has replaced the patch, and may still call it
                setattr(patched, name, before)


def _noting(method: Any) -> Any:
    @wraps(method)
    def note(self: Any, *args: Any, **kwargs: Any) -> None:
        driver = stack_of(getcurrent()) if STACKS else None
        if driver is not None and isinstance(self, Thread):
            self.run = partial(_run_registered, driver, self.run)  # type: ignore[method-assign]
        method(self, *args, **kwargs)
        if driver is not None:
            if driver.opened is None:  # made when it is needed, because an empty one takes a kilobyte
                driver.opened = WeakSet()
            driver.opened.add(self)

    return note


def _run_registered(driver: Driver, run: Callable[[], None]) -> None:
    """Run a thread that a simulation has started, as a stack of that simulation's driver."""
    here = getcurrent()
    STACKS[here] = driver
    try:
        run()
    finally:
        STACKS.pop(here, None)


def open_resources(opened: Iterable[Any] | None) -> dict[Any, str]:
    """Describe each thing that is still alive or open, in a few words; sockets by their descriptor."""
    found: dict[Any, str] = {}
    for thing in list(opened or ()):
        if isinstance(thing, socket) and thing.fileno() >= 0:
            found[thing.fileno()] = f"a socket (descriptor {thing.fileno()})"
        elif isinstance(thing, Thread) and thing.is_alive():
            found[thing] = "a thread"
        elif isinstance(thing, (Popen, BaseProcess)):
            code = thing.returncode if isinstance(thing, Popen) else thing.exitcode
            if code is None:
                found[thing] = f"a child process ({thing.pid})"
    return found
