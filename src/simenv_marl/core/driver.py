"""Drivers: how control switches between a simulation's stack and its user's stack.

A driver keeps one stack for a simulation, over all its episodes: a greenlet, or a thread. *Jobs*
run on it one after the other: the making of the simulation, then its ``reset`` and its ``run`` for
each episode. On the user's side ``begin`` prepares a job. ``resume`` starts it, and later passes
replies to the simulation. ``throw`` raises ``SimulationExit`` in it. Both return the simulation's
next *event*, a tuple ``(event, args, kwargs)``. For a decision these are an object of the plan or
the episode, and the arguments of the call. For the end of a job they are ``ENDED``, a list with the
result or the error, and whether it is an error. The receiver must empty that list, because the
waiting stack still refers to it. The episode calls the event's ``handle``, which returns the reply.

On the simulation's side a driver enters its stack into the hooks of the model's functions, each
with the interceptor that sends an event and carries out the reply. It also notes which threads,
processes and sockets the simulation opens.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping
from contextlib import suppress
from contextvars import Context, copy_context
from functools import partial, wraps
from gc import collect, get_referrers
from linecache import getlines
from multiprocessing.process import BaseProcess
from socket import socket
from subprocess import Popen
from threading import Thread, local
from traceback import walk_tb
from types import coroutine
from typing import Any, Final
from weakref import WeakSet, ref

from greenlet import getcurrent, greenlet

from ..errors import SimulationError, WrongThreadError, annotate, error_text
from ..hooks.hook import BOUND, Hook
from ..hooks.stacks import LOCK, STACKS, Interceptor, spawner_of, stack_of
from ..simulation import TRUNCATED, Sentinel

Event = tuple[Any, Any, Any]
WAIT: Final = Sentinel("WAIT")
"""What an event's ``handle`` returns instead of a reply if the episode waits for an action, or is over."""

SECONDS_TO_UNWIND: Final = 5.0
"""The seconds that a simulation in a thread may take, while it is unwound, to its next decision or its end."""

UNWINDING_TRIES: Final = 1000
"""How often ``SimulationExit`` is raised in a simulation.

A SimPy model loses one of its processes at each try.
"""


class SimulationExit(BaseException):
    """Raised in a suspended simulation to unwind it.

    It is not an error, and models should not catch it.
    """

    # It is no ``SystemExit``: C code that prints what a callback raises would end the process.
    def __init__(
        self, text: str = "SimulationExit: the environment was closed, reset or dropped"
    ) -> None:
        """Say what it is in its text, because some engines keep only the text of what they catch."""
        super().__init__(text)


class LoopExit(SimulationExit, KeyboardInterrupt):
    """A ``SimulationExit`` for code in an event loop, which keeps all but exits and interrupts for who awaits it."""


def is_exit(error: BaseException | None) -> bool:
    """Whether an error is a ``SimulationExit``, has one as its cause or in its text, or was raised by its ``except``.

    A group is one if all its errors are. What only arises while the exit passes (a ``finally``) is
    not.
    """
    seen = set()  # causes may be cyclic
    while error is not None and id(error) not in seen:
        if isinstance(error, SimulationExit) or SimulationExit.__name__ in error_text(error):
            return True
        if isinstance(error, BaseExceptionGroup):
            return all(map(is_exit, error.exceptions))
        seen.add(id(error))
        error = error.__cause__ or (error.__context__ if _is_replacement(error) else None)
    return False


def _is_replacement(error: BaseException) -> bool:
    """Whether an error was raised, or the process ended, by the ``except`` that has caught the error's context."""
    frames, caught = (
        [*walk_tb(error.__traceback__)],
        getattr(error.__context__, "__traceback__", None),
    )
    if not frames or caught is None or caught.tb_frame is not frames[-1][0]:
        return False
    frame, line = frames[-1]
    kind = ast.stmt if isinstance(error, SystemExit) else ast.Raise
    # bytecode does not tell an ``except`` from a ``finally``
    with suppress(SyntaxError, ValueError):
        tree = ast.parse("".join(getlines(frame.f_code.co_filename, frame.f_globals)))
        handlers = [node for node in ast.walk(tree) if isinstance(node, ast.ExceptHandler)]
        nodes = [
            node for handler in handlers for node in ast.walk(handler) if isinstance(node, kind)
        ]
        return any(node.lineno <= line <= (node.end_lineno or line) for node in nodes)
    return False


class _Ended:
    """The event of the end of a job."""

    def handle(self, episode: Any, box: list[Any], failed: bool) -> Any:
        """End the episode of all agents with the value that ``run`` returned, or raise its error."""
        episode.running, episode.failed_in_model = False, failed
        if failed:
            raise box.pop()
        episode.finish(truncated=box.pop() is TRUNCATED)
        return WAIT


class _Refused:
    """The event of a decision after another one was refused."""

    deliver = report = None

    def handle(self, episode: Any, args: Any, kwargs: Any) -> Any:
        """Raise the error that describes the refused call."""
        episode.failed_in_model = True
        raise episode.driver.refusal()


ENDED: Final[Any] = _Ended()
_REFUSED: Final[Any] = _Refused()


class _Thread(local):
    """What identifies a thread.

    Unlike the thread's number, it is never reused for another thread.
    """

    # of no thread: seen by what the garbage collector runs while that of a thread is made
    identity: Any = Thread

    def __init__(self) -> None:
        self.identity = set[None]()  # an object of this thread that can be referenced weakly


THREAD: Final = _Thread()


class Driver:
    """The base class of drivers.

    A driver adds ``enter()``, which prepares to resume the simulation from here, or raises a
    ``WrongThreadError``; ``resume(reply)``; ``throw()``, which returns None if no event comes in
    time; and ``end()``, which ends the stack.

    Attributes:
        events: The events that the simulation sends, by hook. Empty while it is made, reset or
            closed.
        caller: The greenlet from which ``resume`` may be called directly. None: ``enter`` must be
            called before.
        given_up: The reason why a job was given up. None if no job was.
        ended: Whether the stack has ended, or was given up.
        forked: Whether this process was forked by the simulation.
        opened: The sockets, processes and threads that the simulation has opened; None before the
            first one.
    """

    __slots__ = (
        "__weakref__", "_context", "_exiting", "_handled", "_home", "_job", "_past", "_refused",
        "_stack", "caller", "ended", "events", "forked", "given_up", "idle", "opened", "plugins",
    )  # fmt: skip

    resume: Any
    throw: Any
    enter: Any
    end: Any
    _decider: Any
    _shares_thread = True  # with its user

    def __init__(self, plugins: Any = None) -> None:
        """Prepare a driver. The first job begins the stack."""
        self.plugins = plugins
        self._handled: tuple[Hook, ...] = () if plugins is None else tuple(plugins.hooks)
        self.events: Mapping[Hook, Any] = {}
        self._stack: greenlet | None = None
        self._past: ref[greenlet] | None = None  # the stack, after its end
        self._home = ref(THREAD.identity)  # the thread of the stack
        self.caller: greenlet | None = None
        self.opened: WeakSet[Any] | None = None
        self.given_up: str | None = None
        self.ended, self.idle, self.forked, self._exiting = False, True, False, False
        self._job: Any = None
        self._context: Any = None  # of the job, until it begins
        self._refused: Any = None  # the error of a refused decision, until the user gets it

    # -- on the user's side -----------------------------------------------------------------------

    def begin(
        self, job: Callable[[], Any], events: Mapping[Hook, Any] | None = None, context: Any = None
    ) -> None:
        """Prepare a job, with the events to send by hook, and a context or else a copy of the user's context variables.

        After ``enter``, the next ``resume`` starts it on the stack.
        """
        self._job, self.events, self._refused = job, events or {}, None
        self._context = copy_context() if context is None else context

    @property
    def reachable(self) -> bool:
        """Whether the simulation can be resumed from the current thread and process."""
        return self._home() is THREAD.identity if self._shares_thread else not self.lost

    @property
    def lost(self) -> bool:
        """Whether the thread of the stack has ended, or does not exist in this forked process."""
        return self._home() is None

    @property
    def outlived(self) -> bool:
        """Whether the model has kept greenlets that belong to the stack, which has ended: they can decide nowhere."""
        if self._past is None or self._past() is None:
            return False
        collect()  # what only waits for the garbage collector was not kept
        stack = self._past()  # of a thread that has just ended, greenlet may still hold it
        kept = () if stack is None else get_referrers(stack)
        return any(isinstance(other, greenlet) and other.parent is stack for other in kept)

    def run(self, job: Callable[[], Any], context: Context | None = None) -> Any:
        """Run a job to its end, during which decision functions run their rule.

        Return its result.
        """
        try:
            self.enter()
            self.begin(job, context=context)
            _, box, failed = self.resume(None)
        except BaseException:
            self.unwind()  # an interrupt has ended the wait
            raise
        if failed:
            raise box.pop()
        return box.pop()

    def unwind(self) -> list[BaseException]:
        """Raise ``SimulationExit`` in the current job until it ends, or give it up.

        Return errors that it raised.
        """
        self.enter()
        if self.idle or self.ended:  # the job has ended, or was interrupted before it began
            self._job = None
            return []
        self._exiting = True
        for _ in range(UNWINDING_TRIES):
            event = self.throw()
            if event is None:
                self.given_up = f"neither decided anything nor ended within {SECONDS_TO_UNWIND} s; it is abandoned"
                break
            kind, box, failed = event
            if kind is ENDED:
                value = box.pop()
                return [value] if failed and not is_exit(value) else []
        else:
            self.given_up = (
                "refuses to end: it went on after SimulationExit was raised in it"
                f" {UNWINDING_TRIES} times; it is left suspended. Let the model re-raise"
                " exceptions that it does not know; callbacks from C need a CallbackGuard"
            )
        self.ended = True
        return []

    # -- on the simulation's side -----------------------------------------------------------------

    def _register(self) -> None:
        """On the stack: register it as a simulation's stack."""
        self._stack, self._home = getcurrent(), ref(THREAD.identity)
        STACKS[self._stack] = self
        _watch_resources()

    def _work(self) -> Event:
        """On the stack: run a job; return the event of its end."""
        # No frame here may refer to the stack: it would then refer to itself, and could not be
        # collected.
        self.idle = self._exiting = False
        job, self._job = self._job, None
        try:
            self.enter_hooks()
            result = job()
        except BaseException as error:
            return ENDED, [self._explain(error)], True
        finally:
            job = None
            self.leave_hooks(self._stack)
            self.events = {}
        failed = self._refused is not None
        return ENDED, [self.refusal() if failed else result], failed

    def _explain(self, error: BaseException) -> BaseException:
        """Return the error to raise on the user's side for an error of the simulation."""
        if self._refused is not None and self._refused is not error:
            if isinstance(error, SimulationExit):
                return self.refusal()
            annotate(error, f"simenv_marl: before that, a decision was refused: {self._refused}")
        if type(error) in (SimulationExit, LoopExit) and not self._exiting:
            stray = SimulationError(
                "the simulation raised a SimulationExit of an earlier episode, which a task, a"
                " greenlet or a thread of that episode has kept; end all of these with their"
                " episode (cancel them in stop or in a finally)"
            )
            stray.__cause__ = error
            return stray
        return error

    def _forget_stack(self) -> None:
        """Unregister the stack. From now on it takes no part in decisions."""
        self.ended = True
        stack, self._stack = self._stack, None
        if stack is not None:
            self._past = ref(stack)
        self.leave_hooks(stack)
        self.events = {}
        STACKS.pop(stack, None)  # type: ignore[arg-type]
        _watch_resources()

    def enter_hooks(self) -> None:
        """Enter all hooks with the interceptors that they need now, unless another environment runs on the stack."""
        stack = self._stack
        if stack is not None and STACKS.get(stack) is self:
            hooks = (*self.events, *self._handled)
            for hook in hooks:
                hook.enter(stack, self.interceptor(hook, away=False), self.plugins)
            if STACKS.get(stack) is not self:  # garbage collection has ended it meanwhile
                for hook in hooks:
                    hook.leave(stack)

    def leave_hooks(self, here: greenlet | None) -> None:
        """Leave all hooks, so that the stack takes no part in calls until ``enter_hooks``."""
        if here is not None:
            for hook in (*self.events, *self._handled):
                hook.leave(here)

    def interceptor(self, hook: Hook, away: bool = True) -> Interceptor | None:
        """Return the interceptor for calls of a hook, from the stack or ``away`` from it.

        None if the rule decides.
        """
        event = self.events.get(hook)
        if event is None:
            return None
        where = None
        if self.forked:
            where = "a process that the simulation has forked"
        elif away and self._home() is not THREAD.identity:
            where = "a thread that the simulation has started"
        elif away and self._shares_thread and spawner_of(getcurrent()) is not None:
            where = 'a greenlet that the simulation has spawned with gevent (driver="thread" allows that)'
        if where is not None:
            return partial(self.refuse, hook, where)
        rule = hook.rule
        if event.report is not None:
            report = _report if hook.kind == "function" else _report_later
            rule = partial(report, rule, self._decider(hook, None, event.report, away), hook)
        decide: Interceptor = self._decider(hook, rule, event, away)
        return decide

    def refuse(self, hook: Hook, where: str, args: Any, kwargs: Any) -> Any:
        """Refuse a decision with an error.

        The user gets another one at the simulation's next event.
        """
        error = WrongThreadError(
            f"{hook.name} was called in {where}, where the environment cannot ask for a decision."
            " Call it where run() runs, and pass the decision on"
        )
        if self._refused is None and not self.forked:
            self._refused = error
            self.events = dict.fromkeys(self.events, _REFUSED)
            self.enter_hooks()
        raise error

    def refusal(self) -> WrongThreadError:
        """Make the error that tells the user of a refused decision."""
        refused, self._refused = self._refused, None
        error = WrongThreadError(*refused.args)
        error.__cause__ = refused
        return error


def _report(rule: Any, report: Interceptor, hook: Hook, /, *args: Any, **kwargs: Any) -> Any:
    """Run a rule, and pass its decision and the bound call to an interceptor."""
    decision = rule(*args, **kwargs)
    report((decision, *(hook.bind(args, kwargs) or (args, kwargs))), BOUND)
    return decision


@coroutine
def _report_later(rule: Any, report: Interceptor, hook: Hook, /, *args: Any, **kwargs: Any) -> Any:
    decision = yield from rule(*args, **kwargs)
    report((decision, *(hook.bind(args, kwargs) or (args, kwargs))), BOUND)
    return decision


# -- what simulations open ------------------------------------------------------------------------

_OPENING: Final = (
    (Thread, "start"),
    (socket, "__init__"),
    (Popen, "__init__"),
    (BaseProcess, "start"),
)

_PATCHES: Final[list[tuple[type, str, Any, Any]]] = []
"""The patched methods: what was there before, and the patch. Empty while no simulation lives."""


def _watch_resources() -> None:
    """Note what simulations open, while there are simulations."""
    if bool(STACKS) == bool(_PATCHES):
        return
    with LOCK:
        for owner, name in () if _PATCHES else _OPENING:
            before = vars(owner)[name]
            patch = _noting(before)
            setattr(owner, name, patch)
            _PATCHES.append((owner, name, before, patch))
        while _PATCHES and not STACKS:
            patched, name, before, patch = _PATCHES.pop()
            # else other code has replaced the patch, and may still call it
            if vars(patched)[name] is patch:
                setattr(patched, name, before)


def _noting(method: Any) -> Any:
    @wraps(method)
    def note(self: Any, *args: Any, **kwargs: Any) -> None:
        driver = stack_of(getcurrent()) if STACKS else None
        if driver is not None and isinstance(self, Thread):
            self.run = partial(_run_registered, driver, self.run)  # type: ignore[method-assign]
        method(self, *args, **kwargs)
        if driver is not None:
            # made when it is needed, because an empty one takes a kilobyte
            if driver.opened is None:
                driver.opened = WeakSet()
            driver.opened.add(self)

    return note


def _run_registered(driver: Driver, run: Callable[[], None]) -> None:
    """Run a thread that a simulation has started, as a stack of that simulation's driver."""
    # Not in a variable: tracebacks keep variables, and a root that outlives its thread makes
    # greenlets crash.
    STACKS[getcurrent()] = driver
    try:
        run()
    finally:
        STACKS.pop(getcurrent(), None)
