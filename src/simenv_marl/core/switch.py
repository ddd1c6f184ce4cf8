"""The switch between a simulation's stack and its user's stack.

A *driver* keeps one stack for a simulation. *Jobs* run on it one after the other: the making of the simulation, then
its ``reset`` and its ``run`` for each episode. On the user's side ``prepare`` prepares a job. ``resume`` begins it, and
later hands replies to the simulation. ``throw`` raises ``SimulationExit`` in it. ``resume`` and ``throw`` return the
simulation's next *event*, a tuple of three. A decision is the plan's event object with the call's args and kwargs. The
end of a job is ``FINISHED`` or ``FAILED``, a list with the result or the error, and None. The receiver must empty this
list, because the waiting stack still refers to it. ``STALLED``, such a list and a number of seconds mean that a job has
failed and has not ended for that time.

On the simulation's side a driver registers its stack with the hooks of the decided functions, together with a function
that hands a call over and carries out the reply.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextvars import Context
from types import MappingProxyType, SimpleNamespace
from typing import Any, Final, Protocol

from greenlet import getcurrent, greenlet

from ..errors import SimulationError, WrongThreadError, annotate
from ..hooks.hook import Hook
from ..hooks.stacks import STACKS, Taker, stack_of
from .children import Children, ChildThread, unwatch, watch
from .events import FAILED, FINISHED, REFUSED, STALLED


class SimulationExit(SystemExit):
    """Raised in a suspended simulation to unwind it. It is not an error, and models should not catch it.

    It is a ``SystemExit``, because event loops pass that on at once. They would keep any other exception for the code
    that awaits the task, and let the other tasks continue.
    """


class Crossing(Protocol):
    """The part of an event that a driver needs."""

    @property
    def deliver(self) -> Callable[..., Any] | None:
        """Turns a reply and the call's arguments into the call's return value. None: the reply is that value."""

    @property
    def told(self) -> Crossing | None:
        """The event that reports the rule's decision, with the call's args and kwargs. None: it is not reported."""


Event = tuple[Any, Any, Any]

NO_DECISIONS: Final[Mapping[Hook, Crossing]] = MappingProxyType({})
"""The events while a simulation is made, reset or closed: none."""

SECONDS_TO_UNWIND: Final = 5.0
"""The seconds that a simulation may take, while it is unwound, to its next decision or its end."""

UNWINDING_TRIES: Final = 1000
"""How often ``SimulationExit`` is raised in a simulation before it is given up. It may decide again, or swallow the
exit. A SimPy model loses one of its processes at each try."""


def is_exit(error: BaseException | None) -> bool:
    """Whether an error is a ``SimulationExit``, was caused by one, or is an exception group of only such errors."""
    seen = set()  # causes may be cyclic
    while error is not None and not isinstance(error, SimulationExit) and id(error) not in seen:
        if isinstance(error, BaseExceptionGroup) and all(is_exit(member) for member in error.exceptions):
            return True
        seen.add(id(error))
        error = error.__cause__
    return isinstance(error, SimulationExit)


def _stray(error: SimulationExit) -> SimulationError:
    """Make the error that replaces an exit from an earlier episode."""
    stray = SimulationError(
        "the simulation raised a SimulationExit of an earlier episode, which a task, a greenlet or a thread of that"
        " episode has kept; end all of these with their episode (cancel them in stop or in a finally)"
    )
    stray.__cause__ = error
    return stray


def nothing_to_end() -> Event:
    """Make the event that ``throw`` returns if no job is under way."""
    return FINISHED, [None], None


class BaseDriver:
    """The base class of drivers.

    Attributes:
        stack: The simulation's stack. None before the first job, and after the end.
        caller: The greenlet from which ``resume`` may be called directly. None: ``enter`` must be called before.
        resume: Resumes the simulation with a reply and returns its next event. The attribute may change, so it must be
            read again before each call.
        plugins: The plugins of the simulation's environment. None if it has none.
        given_up: The reason why a job was given up. None if no job was.
    """

    __slots__ = (
        "__weakref__", "_astray", "_children", "_context", "_ended", "_events", "_exiting", "_idle", "_job", "_refused",
        "caller", "given_up", "plugins", "stack",
    )  # fmt: skip

    resume: Any

    def __init__(self, *, plugins: Any = None, before: BaseDriver | None = None) -> None:
        """Prepare a driver. The first job begins the stack.

        Args:
            plugins: The plugins of the simulation's environment. They apply to all code that runs on the stack.
            before: The simulation's previous driver. Threads that ran under it may still run.
        """
        self.plugins = plugins
        self.stack: greenlet | None = None
        self.caller: greenlet | None = None
        self.given_up: str | None = None
        self._ended, self._idle, self._exiting = False, True, False
        self._job: Callable[[], Any] | None = None
        self._context: Context | None = None
        self._events: Mapping[Hook, Crossing] = NO_DECISIONS
        self._refused: WrongThreadError | None = None
        self._astray: str | None = None  # after a fork that left the user behind: a description of the place
        self._children: Children | None = None
        if before is not None and before._children is not None:
            self._children = before._children
            self._children.driver = self

    # -- the user's side, which each kind of driver implements ------------------------------------

    def prepare(
        self, job: Callable[[], Any], decisions: Mapping[Hook, Crossing] | None = None, context: Context | None = None
    ) -> None:
        """Prepare a job. The next ``resume`` begins to run it on the stack.

        Args:
            job: The function to run.
            decisions: The events to send, by hook. All other hooks run their rule. The driver does not change this.
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

    def throw(self) -> Event:
        """Raise ``SimulationExit`` in the suspended simulation; return its next event."""
        raise NotImplementedError

    def reachable(self) -> bool:
        """Whether the simulation can be resumed from here."""
        raise NotImplementedError

    def lost(self) -> bool:
        """Whether nothing can resume the simulation any more."""
        raise NotImplementedError

    def give_up(self) -> None:
        """Abandon a job that does not unwind. The driver can start no other job."""
        raise NotImplementedError

    def end(self) -> None:
        """End the stack. A job that cannot be reached from here unwinds by itself."""
        raise NotImplementedError

    def unwind(self) -> list[BaseException]:
        """Raise ``SimulationExit`` in the current job until it ends. Return the other errors that it raised.

        A job that does not end is given up.
        """
        problems: list[BaseException] = []
        for _ in range(UNWINDING_TRIES):
            kind, box, seconds = self.throw()
            if kind is STALLED:
                problems += [error for error in box if not is_exit(error)]
                box.clear()
                self.given_up = f"neither decided anything nor ended within {seconds} s; it is abandoned"
                break
            if kind is FINISHED or kind is FAILED:
                value = box.pop()
                if kind is FAILED and not is_exit(value):
                    problems.append(value)
                return problems
        if self.given_up is None:
            self.given_up = (
                f"refuses to end: it went on after SimulationExit was raised in it {UNWINDING_TRIES} times; it is left"
                " suspended. Let the model re-raise exceptions that it does not know; callbacks from C need a"
                " CallbackGuard"
            )
        self.give_up()
        return problems

    @property
    def usable(self) -> bool:
        """Whether a job can be started from here."""
        return not self._ended and self._idle and self.reachable()

    @property
    def children(self) -> Children:
        """The threads, processes and sockets that the simulation has opened, over all its episodes."""
        if self._children is None:
            self._children = Children(self)
        return self._children

    # -- jobs -------------------------------------------------------------------------------------

    def _prepare(
        self, job: Callable[[], Any], decisions: Mapping[Hook, Crossing] | None, context: Context | None
    ) -> None:
        self._refused = None
        self._events = NO_DECISIONS if decisions is None else decisions
        self._context, self._job = context, job

    def _begin(self) -> None:
        """On the stack: register it as a simulation's stack."""
        self.stack = stack = getcurrent()
        STACKS[stack] = self
        watch()
        self.show()

    def _work(self) -> Event:
        """On the stack: run a job; return the event for its end."""
        # No frame here may refer to the stack: it would then refer to itself, and could not be collected.
        self._idle = self._exiting = False
        job, self._job = self._job, None
        try:
            self.show()
            return self._live(job)
        finally:
            job = None
            events, self._events = self._events, NO_DECISIONS
            for hook in events:
                if self._ended:
                    hook.leave(getcurrent())
                else:
                    hook.enter(getcurrent(), None, self.plugins)

    def _live(self, job: Any) -> Event:
        try:
            result = job()
        except BaseException as error:
            if self._refused is not None and self._refused is not error:
                if isinstance(error, SimulationExit):
                    return FAILED, [self.refusal()], None
                annotate(error, f"simenv_marl: before that, a decision was refused: {self._refused}")
            return FAILED, [error if self._exiting or type(error) is not SimulationExit else _stray(error)], None
        return (FINISHED, [result], None) if self._refused is None else (FAILED, [self.refusal()], None)

    def _forget_stack(self) -> None:
        """Unregister the stack. From now on it takes no part in decisions."""
        self._ended = True
        self.hide()
        self._events = NO_DECISIONS
        stack, self.stack = self.stack, None
        if stack is not None:
            STACKS.pop(stack, None)
        if self._children is not None and self._children.driver is self:
            self._children.driver = None
        unwatch()

    # -- decisions --------------------------------------------------------------------------------

    def _decider(self, hook: Hook, event: Crossing, away: bool = False) -> Taker:
        """Make the function that hands over the calls of a hook and carries out the replies.

        Args:
            hook: The hook.
            event: The event to send.
            away: Whether the calls come from the model's own greenlets, and not from the stack itself.
        """
        raise NotImplementedError

    def _rule_of(self, hook: Hook, event: Crossing, away: bool) -> Callable[..., Any]:
        """The rule of a hook, wrapped to report its decision to the user's side if the event asks for that."""
        if event.told is None:
            rule: Callable[..., Any] = hook.rule
            return rule
        tell, events = self._decider(hook, event.told, away), self._events

        def told(decision: Any, args: Any, kwargs: Any) -> Any:
            if self._events is events:  # otherwise the job is over
                tell((decision, args, kwargs), {})
            return decision

        return _TELLING[hook.kind](hook.rule, told)

    def stall(self, error: BaseException, seconds: float) -> None:
        """On the stack: report an error that cannot surface, because the code that called a callback does not end.

        Args:
            error: The error.
            seconds: How long the callback has waited for that end.

        Raises:
            SimulationExit: The user unwinds the simulation in reply.
        """
        self._decider(_NO_HOOK, STALLED, away=True)([error], seconds)  # type: ignore[arg-type]

    def decides(self, hook: Hook) -> bool:
        """Whether the current job hands over the calls of a hook."""
        return hook in self._events

    def taker(self, hook: Hook, here: greenlet) -> Taker | None:
        """The function that decides calls of a hook in the simulation's own greenlets. None: the rule decides."""
        return self._taker(hook, away=True)

    def _taker(self, hook: Hook, away: bool = False) -> Taker | None:
        event = self._events.get(hook)
        if event is None:
            return None
        return self._decider(hook, event, away) if self._astray is None else self.refusal_of(hook, self._astray)

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
                hook.enter(stack, self._taker(hook), self.plugins)

    def _hooks(self) -> list[Hook]:
        return [*self._events, *(() if self.plugins is None else self.plugins.hooks)]

    # -- refusals ---------------------------------------------------------------------------------

    def refusal_of(self, hook: Hook, where: str) -> Taker | None:
        """The function that refuses decisions where the simulation cannot wait; None for a hook without decisions."""
        if not self.decides(hook):
            return None

        def refuse(args: Any, kwargs: Any) -> Any:
            raise self._refuse(hook, where)

        return refuse

    def _refuse(self, hook: Hook, where: str) -> WrongThreadError:
        """Refuse a decision. Return the error for the caller; the user gets one at the simulation's next event.

        This is called in the thread that has asked for the decision.
        """
        error = WrongThreadError(
            f"{hook.name} was called in {where}, where the environment cannot ask for a decision. Call it where run()"
            " runs, and pass the decision on"
        )
        if self._refused is None and self._astray is None:
            self._refused = error
            self._events = dict.fromkeys(self._events, REFUSED)
            self.show()
        return error

    def _go_astray(self, where: str) -> None:
        """Refuse all decisions of the simulation. Only the model gets the errors."""
        self._astray = where
        self.show()

    def _stay_behind(self) -> None:
        """Drop the stack in this forked process. A thread of the simulation that forked it is still refused."""
        events = self._events
        self._forget_stack()
        here = getcurrent()
        thread = stack_of(here)
        if isinstance(thread, ChildThread) and thread.children is self._children:
            self.stack, self._events, thread.children.driver = here, events, self
            self._go_astray("a process that a thread of the simulation has forked")

    def refusal(self) -> WrongThreadError:
        """Make the error that tells the user of a refused decision."""
        refused, self._refused = self._refused, None
        error = WrongThreadError(*(() if refused is None else refused.args))
        error.__cause__ = refused
        return error

    def forked(self) -> None:
        """Handle a fork in the child process."""
        raise NotImplementedError

    def forked_worker(self) -> None:
        """Handle a fork in a ``multiprocessing`` worker that the simulation has started."""
        self._go_astray("a process that the simulation has forked as a worker")


_NO_HOOK: Final[Any] = SimpleNamespace(rule=None)


def _telling(rule: Any, told: Any) -> Any:
    return lambda *args, **kwargs: told(rule(*args, **kwargs), args, kwargs)


def _telling_generator(rule: Any, told: Any) -> Any:
    def tell(*args: Any, **kwargs: Any) -> Any:
        return told((yield from rule(*args, **kwargs)), args, kwargs)

    return tell


def _telling_coroutine(rule: Any, told: Any) -> Any:
    async def tell(*args: Any, **kwargs: Any) -> Any:
        return told(await rule(*args, **kwargs), args, kwargs)

    return tell


_TELLING: Final[Mapping[str, Callable[[Any, Any], Callable[..., Any]]]] = {
    "function": _telling,
    "generator": _telling_generator,
    "coroutine": _telling_coroutine,
}
