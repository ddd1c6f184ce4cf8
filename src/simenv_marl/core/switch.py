"""Between a simulation's stack and its user's: who runs, and how a decision crosses over.

A *driver* keeps one stack for a simulation, on which *jobs* run one after the other: the making of the simulation, its
``reset`` and its ``run``, episode after episode. On the user's side ``prepare`` readies a job, ``resume`` begins it,
and then hands replies to the simulation; ``throw`` raises ``SimulationExit`` in it. Each returns the *event* that comes
from the simulation next, a tuple of three: a decision (what the plan has for it, and the call's args and kwargs), or
the end of the job: ``FINISHED`` or ``FAILED``, with a list that holds the result or the error, and None. The list is
to be emptied: the stack waits for the next job with it in its hands. ``STALLED``, with such a list and a number of
seconds, is a job that has failed and does not come to its end for so long.

On the simulation's side a driver enters its stack in the hooks of the functions that are decided, with a function that
hands a call over and carries out the reply.
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
    """Raised in a suspended simulation to unwind it. Neither an error nor anything to be caught.

    A ``SystemExit``, because event loops pass that on at once, where they would keep any other exception for
    what awaits the task and let the other tasks go on.
    """


class Crossing(Protocol):
    """What a driver needs of what the plan has for a decided function."""

    @property
    def deliver(self) -> Callable[..., Any] | None:
        """Turns a reply and the call's arguments into what the call returns; None: the reply is that."""

    @property
    def told(self) -> Crossing | None:
        """What crosses, with the decision, args and kwargs, once the rule has decided a call; None: nothing."""


Event = tuple[Any, Any, Any]

NO_DECISIONS: Final[Mapping[Hook, Crossing]] = MappingProxyType({})
"""What crosses while a simulation is made, reset or closed: nothing."""

SECONDS_TO_UNWIND: Final = 5.0
"""How long a simulation that is to be unwound may take to its next decision or to its end."""

UNWINDING_TRIES: Final = 1000
"""How often a simulation that is to be unwound may decide or swallow before it is given up. A SimPy model loses one of
its processes at each try."""


def is_exit(error: BaseException | None) -> bool:
    """Whether an error is the exit that was raised in a simulation, passed on in whatever guise."""
    seen = set()  # causes may go in circles
    while error is not None and not isinstance(error, SimulationExit) and id(error) not in seen:
        if isinstance(error, BaseExceptionGroup) and all(is_exit(member) for member in error.exceptions):
            return True
        seen.add(id(error))
        error = error.__cause__
    return isinstance(error, SimulationExit)


def _stray(error: SimulationExit) -> SimulationError:
    """The error in place of an exit that was not raised in this episode."""
    stray = SimulationError(
        "the simulation raised a SimulationExit of an earlier episode, which a task, a greenlet or a thread of that"
        " episode has kept; let nothing that belongs to an episode outlive it (cancel it in stop or in a finally)"
    )
    stray.__cause__ = error
    return stray


def nothing_to_end() -> Event:
    """What ``throw`` returns where no job is under way."""
    return FINISHED, [None], None


class BaseDriver:
    """What all drivers have in common.

    Attributes:
        stack: The simulation's stack; None before the first job, and after the end.
        caller: The greenlet from which ``resume`` may be called directly; None: ``enter`` is to be called before.
        resume: Lets the simulation go on with a reply; returns the event that comes from it next. To be fetched anew
            before each call.
        plugins: The plugins of the simulation's environment; None if it has none.
        given_up: Why a job was left where it is; None as long as none was.
    """

    __slots__ = (
        "__weakref__", "_astray", "_children", "_context", "_ended", "_events", "_exiting", "_idle", "_job", "_refused",
        "caller", "given_up", "plugins", "stack",
    )  # fmt: skip

    resume: Any

    def __init__(self, *, plugins: Any = None, before: BaseDriver | None = None) -> None:
        """Prepare a stack; the first ``start`` makes it.

        Args:
            plugins: The plugins of the simulation's environment, which take part in all that runs on the stack.
            before: The driver that the simulation had before, whose threads it may still have.
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
        self._astray: str | None = None  # where the stack has been taken without its user, by a fork
        self._children: Children | None = None
        if before is not None and before._children is not None:
            self._children = before._children
            self._children.driver = self

    # -- the user's side, for each kind of driver to see to ---------------------------------------

    def prepare(
        self, job: Callable[[], Any], decisions: Mapping[Hook, Crossing] | None = None, context: Context | None = None
    ) -> None:
        """Have the next ``resume`` begin to run something on the stack.

        Args:
            job: What is run.
            decisions: By hook: what crosses where it is called. All others run their rule. Never changed here.
            context: The context variables that it sees; None: a copy of the user's.

        Raises:
            WrongThreadError: The stack cannot be resumed from here.
        """
        raise NotImplementedError

    def enter(self) -> None:
        """Make ready to be resumed from here.

        Raises:
            WrongThreadError: The simulation cannot be resumed from here.
        """
        raise NotImplementedError

    def throw(self) -> Event:
        """Raise ``SimulationExit`` in the suspended simulation; return the event that comes from it next."""
        raise NotImplementedError

    def reachable(self) -> bool:
        """Whether the simulation can be resumed from here."""
        raise NotImplementedError

    def lost(self) -> bool:
        """Whether the simulation cannot be resumed from anywhere any more."""
        raise NotImplementedError

    def give_up(self) -> None:
        """Leave a job that does not unwind where it is; nothing else can be started."""
        raise NotImplementedError

    def end(self) -> None:
        """End the stack. Should a job be under way that cannot be reached from here, it unwinds by itself."""
        raise NotImplementedError

    def unwind(self) -> list[BaseException]:
        """Raise ``SimulationExit`` in the job that is under way until it has ended. Returns what else it raised.

        Where it does not end it is given up.
        """
        problems: list[BaseException] = []
        for _ in range(UNWINDING_TRIES):
            kind, box, seconds = self.throw()
            if kind is STALLED:
                problems += [error for error in box if not is_exit(error)]
                box.clear()
                self.given_up = f"has neither decided anything nor ended for {seconds} s; it is left where it is"
                break
            if kind is FINISHED or kind is FAILED:
                value = box.pop()
                if kind is FAILED and not is_exit(value):
                    problems.append(value)
                return problems
        if self.given_up is None:
            self.given_up = (
                f"refuses to end: it went on after {UNWINDING_TRIES} times SimulationExit was raised in it; it is left"
                " suspended. Let it re-raise what it does not know; what is called back by C code needs a CallbackGuard"
            )
        self.give_up()
        return problems

    @property
    def usable(self) -> bool:
        """Whether a job can be started from here."""
        return not self._ended and self._idle and self.reachable()

    @property
    def children(self) -> Children:
        """The threads that the simulation has started, over all its episodes."""
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
        """On the stack: it is one of a simulation's from now on."""
        self.stack = stack = getcurrent()
        STACKS[stack] = self
        watch()
        self.show()

    def _work(self) -> Event:
        """On the stack: do a job; return the event that its end is."""
        # No frame here holds the stack, which would refer to itself then, and could not be collected.
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
                annotate(error, f"simenv_marl: and before that a decision was refused: {self._refused}")
            return FAILED, [error if self._exiting or type(error) is not SimulationExit else _stray(error)], None
        return (FINISHED, [result], None) if self._refused is None else (FAILED, [self.refusal()], None)

    def _forget_stack(self) -> None:
        """Take no part in anything any more."""
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
        """Make what decides the calls of a hook.

        Args:
            hook: The hook.
            event: What crosses.
            away: Whether the calls arise in greenlets of the model's own, and not on the stack itself.
        """
        raise NotImplementedError

    def _rule_of(self, hook: Hook, event: Crossing, away: bool) -> Callable[..., Any]:
        """The rule of a hook, which tells the user's side what it has decided if that is to be told."""
        if event.told is None:
            rule: Callable[..., Any] = hook.rule
            return rule
        tell, events = self._decider(hook, event.told, away), self._events

        def told(decision: Any, args: Any, kwargs: Any) -> Any:
            if self._events is events:  # else the job is over
                tell((decision, args, kwargs), {})
            return decision

        return _TELLING[hook.kind](hook.rule, told)

    def stall(self, error: BaseException, seconds: float) -> None:
        """On the stack: tell the user of an error that cannot surface, since something does not come to its end.

        Args:
            error: The error.
            seconds: For how long it has been waited.

        Raises:
            SimulationExit: The answer to it.
        """
        self._decider(_NO_HOOK, STALLED, away=True)([error], seconds)  # type: ignore[arg-type]

    def decides(self, hook: Hook) -> bool:
        """Whether calls of a hook are handed over by the job that is under way."""
        return hook in self._events

    def taker(self, hook: Hook, here: greenlet) -> Taker | None:
        """Who decides a call in a greenlet of the simulation's; None: the rule."""
        return self._taker(hook, away=True)

    def _taker(self, hook: Hook, away: bool = False) -> Taker | None:
        event = self._events.get(hook)
        if event is None:
            return None
        return self._decider(hook, event, away) if self._astray is None else self.refusal_of(hook, self._astray)

    def hide(self) -> None:
        """Take no part in calls on the stack until ``show``."""
        if self.stack is not None:
            for hook in self._hooks():
                hook.leave(self.stack)

    def show(self) -> None:
        """Take part again."""
        stack = self.stack
        if stack is not None:
            for hook in self._hooks():
                hook.enter(stack, self._taker(hook), self.plugins)

    def _hooks(self) -> list[Hook]:
        return [*self._events, *(() if self.plugins is None else self.plugins.hooks)]

    # -- refusals ---------------------------------------------------------------------------------

    def refusal_of(self, hook: Hook, where: str) -> Taker | None:
        """What refuses a decision that was asked for where the simulation cannot wait; None where it is none."""
        if not self.decides(hook):
            return None

        def refuse(args: Any, kwargs: Any) -> Any:
            raise self._refuse(hook, where)

        return refuse

    def _refuse(self, hook: Hook, where: str) -> WrongThreadError:
        """Refuse a decision, for the user to be told at the simulation's next event; return the error for the caller.

        Called wherever that has been asked for, in other threads too.
        """
        error = WrongThreadError(
            f"{hook.name} was called in {where}, where no user can be asked. Call it where run() runs, and have others"
            " wait for the answer"
        )
        if self._refused is None and self._astray is None:
            self._refused = error
            self._events = dict.fromkeys(self._events, REFUSED)
            self.show()
        return error

    def _go_astray(self, where: str) -> None:
        """Refuse all decisions of the simulation, for the model alone to be told."""
        self._astray = where
        self.show()

    def _stay_behind(self) -> None:
        """Take no part in this forked process; a thread of the simulation's that has forked it is refused as before."""
        events = self._events
        self._forget_stack()
        here = getcurrent()
        thread = stack_of(here)
        if isinstance(thread, ChildThread) and thread.children is self._children:
            self.stack, self._events, thread.children.driver = here, events, self
            self._go_astray("a process that a thread of the simulation has forked")

    def refusal(self) -> WrongThreadError:
        """The error that tells the user of a decision that was refused."""
        refused, self._refused = self._refused, None
        error = WrongThreadError(*(() if refused is None else refused.args))
        error.__cause__ = refused
        return error

    def forked(self) -> None:
        """The process was forked, and this is the child."""
        raise NotImplementedError

    def forked_worker(self) -> None:
        """The simulation has begun a worker of ``multiprocessing`` by a fork, and this is the worker."""
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
