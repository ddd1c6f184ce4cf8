"""Drivers: how control switches between a simulation's stack and its user's stack.

A driver keeps one stack for a simulation, over all its episodes: a greenlet, or a thread. *Jobs* run on it one after
the other: the making of the simulation, then its ``reset`` and its ``run`` for each episode. On the user's side
``begin`` prepares a job. ``resume`` starts it, and later passes replies to the simulation. ``throw`` raises
``SimulationExit`` in it. ``resume`` and ``throw`` return the simulation's next *event*, a tuple ``(event, args,
kwargs)``. For a decision these are an object of the plan or the episode, and the arguments of the call. For the end of
a job they are ``FINISHED`` or ``FAILED``, a list with the result or the error, and None. The receiver must empty that
list, because the waiting stack still refers to it. The episode calls the event's ``handle``, which returns the reply.

On the simulation's side a driver enters its stack into the hooks of the model's functions, each with the interceptor
that sends an event and carries out the reply.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextvars import Context
from types import MappingProxyType
from typing import Any, Final

from greenlet import getcurrent, greenlet

from ..errors import SimulationError, WrongThreadError, annotate
from ..hooks.hook import Hook
from ..hooks.stacks import STACKS, Interceptor
from ..simulation import TRUNCATED, Sentinel
from .resources import watch_resources

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

    Attributes:
        stack: The simulation's stack. None before the first job, and after the end.
        caller: The greenlet from which ``resume`` may be called directly. None: ``enter`` must be called before.
        plugins: The plugins of the simulation's environment. None if it has none.
        given_up: The reason why a job was given up. None if no job was.
        ended: Whether the stack has ended.
        idle: Whether no job is under way.
        has_started_threads: Whether the simulation has started threads.
        opened: Weak references to the sockets, processes and threads that the simulation has opened: see
            ``open_resources``.
    """

    __slots__ = (
        "__weakref__", "_events", "_exiting", "_job", "_process_refused", "_refused", "caller", "ended", "given_up",
        "has_started_threads",
        "idle", "opened", "plugins", "stack",
    )  # fmt: skip

    resume: Any

    own_thread = False
    """Whether the simulation has a thread of its own."""

    def __init__(self, plugins: Any = None, opened: list[Any] | None = None) -> None:
        """Prepare a driver. The first job begins the stack.

        Args:
            plugins: The plugins of the simulation's environment. They apply to all code that runs on the stack.
            opened: What the simulation has opened on an earlier stack.
        """
        self.plugins = plugins
        self.opened: list[Any] = [] if opened is None else opened
        self.stack: greenlet | None = None
        self.caller: greenlet | None = None
        self.given_up: str | None = None
        self.ended, self.idle, self._exiting, self.has_started_threads = False, True, False, False
        self._job: Any = None
        self._events = NO_EVENTS
        self._refused: WrongThreadError | None = None
        self._process_refused: str | None = None

    # -- on the user's side -----------------------------------------------------------------------

    def begin(self, job: Callable[[], Any], events: Mapping[Hook, Any] = NO_EVENTS, context: Any = None) -> None:
        """Prepare a job. The next ``resume`` starts it on the stack.

        Args:
            job: The function to run.
            events: The events to send, by hook. All other functions run their rule.
            context: The context variables of the job. None: a copy of the user's.

        Raises:
            WrongThreadError: The stack cannot be resumed from here.
        """
        raise NotImplementedError

    def enter(self) -> None:
        """Prepare to resume the simulation from the current thread and greenlet.

        Raises:
            WrongThreadError: The simulation cannot be resumed from here.
        """
        raise NotImplementedError

    def throw(self) -> Event | None:
        """Raise ``SimulationExit`` in the suspended simulation; return its next event, or None if none comes."""
        raise NotImplementedError

    def end(self) -> None:
        """End the stack. A job that cannot be reached from here unwinds by itself."""
        raise NotImplementedError

    def abandon(self) -> None:
        """Give up a job that does not unwind. The driver can start no other job."""
        raise NotImplementedError

    @property
    def reachable(self) -> bool:
        """Whether the simulation can be resumed from here."""
        raise NotImplementedError

    @property
    def lost(self) -> bool:
        """Whether no thread of this process can resume the simulation any more."""
        raise NotImplementedError

    @property
    def usable(self) -> bool:
        """Whether a job can begin here."""
        return self.idle and not self.ended and self.reachable

    def run(self, job: Callable[[], Any], context: Context | None = None) -> Any:
        """Run a job to its end, during which decision functions run their rule; return its result.

        Raises:
            BaseException: Any error that the job raises.
        """
        try:
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
        watch_resources(True)
        self.show()

    def _work(self) -> Event:
        """On the stack: run a job; return the event for its end."""
        # No frame here may refer to the stack: it would then refer to itself, and could not be collected.
        self.idle = self._exiting = False
        job, self._job = self._job, None
        try:
            self.show()
            return self._outcome(job)
        finally:
            job = None
            events, self._events = self._events, NO_EVENTS
            for hook in events:
                hook.enter(getcurrent(), None, None if self.ended else self.plugins)

    def _outcome(self, job: Any) -> Event:
        try:
            result = job()
        except BaseException as error:
            if self._refused is not None and self._refused is not error:
                if isinstance(error, SimulationExit):
                    return FAILED, [self.refusal()], None
                annotate(error, f"simenv_marl: before that, a decision was refused: {self._refused}")
            if type(error) is SimulationExit and not self._exiting:
                stray = SimulationError(
                    "the simulation raised a SimulationExit of an earlier episode, which a task, a greenlet or a thread"
                    " of that episode has kept; end all of these with their episode (cancel them in stop or in a"
                    " finally)"
                )
                stray.__cause__ = error
                return FAILED, [stray], None
            return FAILED, [error], None
        return (FINISHED, [result], None) if self._refused is None else (FAILED, [self.refusal()], None)

    def _forget_stack(self) -> None:
        """Unregister the stack. From now on it takes no part in decisions."""
        self.ended = True
        self.hide()
        self._events = NO_EVENTS
        stack, self.stack = self.stack, None
        if stack is not None:
            STACKS.pop(stack, None)
        if not STACKS:
            watch_resources(False)

    def decides(self, hook: Hook) -> bool:
        """Whether the current job sends events for the calls of a hook."""
        return hook in self._events

    def interceptor(self, hook: Hook) -> Interceptor | None:
        """The interceptor for calls of a hook in the simulation's own greenlets. None: the rule decides."""
        return self._interceptor(hook, away=True)

    def _interceptor(self, hook: Hook, away: bool = False) -> Interceptor | None:
        event = self._events.get(hook)
        if event is None:
            return None
        if self._process_refused is not None:
            return self.refuse(hook, self._process_refused)
        return self._decider(hook, event, away)

    def _decider(self, hook: Hook, event: Any, away: bool) -> Interceptor:
        """Make the function that sends an event for the calls of a hook, and carries out the replies.

        Args:
            hook: The hook.
            event: The event.
            away: Whether the calls come from the model's own greenlets, and not from the stack itself.
        """
        raise NotImplementedError

    def hide(self) -> None:
        """Leave all hooks, so that the driver takes no part in calls on the stack until ``show``."""
        if self.stack is not None:
            for hook in self._hooks():
                hook.leave(self.stack)

    def show(self) -> None:
        """Enter all hooks, so that the driver takes part in calls on the stack."""
        stack = self.stack
        if stack is not None:
            for hook in self._hooks():
                hook.enter(stack, self._interceptor(hook), self.plugins)

    def _hooks(self) -> list[Hook]:
        return [*self._events, *(() if self.plugins is None else self.plugins.hooks)]

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
                self.show()
            raise error

        return refuse

    def refuse_all(self, where: str) -> None:
        """Refuse all decisions in this process. Only the model gets the errors."""
        self._process_refused = where
        self.show()

    def refusal(self) -> WrongThreadError:
        """Make the error that tells the user of a refused decision."""
        refused, self._refused = self._refused, None
        error = WrongThreadError(*(() if refused is None else refused.args))
        error.__cause__ = refused
        return error


# -- the rule's decisions -------------------------------------------------------------------------


def reporting_rule(hook: Hook, event: Any, send: Callable[[Any], Interceptor]) -> Callable[..., Any]:
    """Return the rule of a hook, which sends the event's ``report`` with each decision.

    Args:
        hook: The hook.
        event: The event of the hook.
        send: Makes the interceptor that sends an event.
    """
    rule: Callable[..., Any] = hook.rule
    report = send(event.report)

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
