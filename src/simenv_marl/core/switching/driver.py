"""Drivers: how control switches between a simulation's stack and its user's stack.

A driver has one stack for a simulation, over all its episodes: a greenlet, or a thread. *Jobs* run
on it one after the other: the making of the simulation, then its ``reset`` and its ``run`` for each
episode. On the user's side ``begin`` prepares a job. ``resume`` starts it, and later passes replies
to the simulation. ``throw`` raises ``SimulationExit`` in it. Both return the simulation's next
``Event``. The episode calls ``handle`` of the event's handler, which returns the reply.

On the simulation's side a driver enters its stack into the hooks of the model's functions. Each
hook gets an interceptor, which sends an event and carries out the reply.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from asyncio import _get_running_loop as running_loop
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import AbstractContextManager
from contextvars import Context, copy_context
from functools import partial
from sys import exception, modules
from threading import Thread, get_ident, local
from types import FrameType, coroutine
from typing import Any, Final, NoReturn, Protocol, TypeAlias, TypeVar
from weakref import WeakSet, ref

from greenlet import getcurrent, greenlet

from ...errors import SimulationError, WrongThreadError, annotate, warn_user
from ...hooks.hook import BOUND, Hook
from ...hooks.limits import SECONDS_TO_UNWIND
from ...hooks.stacks import STACKS, Args, Interceptor, Kwargs, spawner_of
from ...plugins import Plugins
from ...simulation import RULE, Function, Model, Sentinel
from .exits import UNWINDING_TRIES, LoopExit, SimulationExit, is_exit, make_exit
from .loops import NO_LOOP, Tasks, swap_loop
from .opened import Resource, watch_resources

WAIT: Final = Sentinel("WAIT")
"""What ``handle`` returns instead of a reply if the episode waits for an action, or is over."""


class Receiver(Protocol):
    """An episode, as the handlers of events use it."""

    def receive_end(self) -> Sentinel:
        """Handle the end of ``run``. Return ``WAIT``, or raise the error of ``run``.

        After a refused decision, raise the error of that.
        """


EpisodeType = TypeVar("EpisodeType", contravariant=True)


class EventHandler(Protocol[EpisodeType]):
    """Handles one kind of event of a simulation.

    Attributes:
        deliver: Turns the reply, on the simulation's side, into the value of the call. It gets the
            reply and the call's arguments. None if the reply is the value.
        report: Handles the decisions of the rule. None if they are not reported.
        reports_itself: Whether ``deliver`` sends the decisions of the rule. It gets the function
            that sends them first, or None.
    """

    reports_itself: bool

    @property
    def deliver(self) -> Function | None:
        """Return the function that makes the value of the call."""

    @property
    def report(self) -> AnyHandler | None:
        """Return the handler of the decisions of the rule."""

    def handle(self, episode: EpisodeType, args: Args, kwargs: Kwargs, /) -> Model:
        """Handle an event with the arguments of the call. Return the reply, or ``WAIT``."""


AnyHandler: TypeAlias = EventHandler[Any]
Event: TypeAlias = tuple[AnyHandler, Args, Kwargs]
"""A handler, and the arguments of the call."""

Job: TypeAlias = tuple[Callable[[], Model], Mapping[Hook, AnyHandler]]
"""A function to run on the stack, and the handlers of the events that it sends, by hook."""


class Observer:
    """The base class of handlers whose events ask for no decision."""

    deliver = None
    reports_itself = False

    @property
    def report(self) -> AnyHandler | None:
        """Return None: there is no decision."""
        return None


class Notice(Observer):
    """Warns of the first call of some functions. The calls are no events: the functions run."""

    def __init__(self, message: str) -> None:
        self._message = message

    def handle(self, hook: Hook, args: Args, kwargs: Kwargs) -> Model:
        """Run the function of a hook where it was called."""
        message, self._message = self._message, ""
        if message:
            warn_user(message)
        return hook.run_rule(args, kwargs)


class _Ended(Observer):
    """Handles the end of a job, and the first event after a refused decision."""

    def handle(self, episode: Receiver, args: Args, kwargs: Kwargs) -> Sentinel:
        return episode.receive_end()


_ENDED: Final = _Ended()

ENDED: Final[Event] = _ENDED, (), BOUND
"""The event of the end of a job."""


class _Identity(local):
    """What identifies a thread. Unlike the thread's number, it is never used for another thread."""

    token: object = object  # seen by finalizers that run while a token is made

    def __init__(self) -> None:
        self.token = set()  # because it can be referenced weakly


THREAD: Final = _Identity()


class Driver(ABC):
    """The base class of drivers.

    Attributes:
        resume: Passes a reply to the simulation, and returns its next event.
        events: The handlers of the events that the simulation sends, by hook. Empty while it is
            made, reset or closed.
        caller: The greenlet that may call ``resume`` directly. None: ``enter`` must be called
            before.
        given_up: Why a job was given up. None if no job was.
        ended: Whether the stack has ended, or was given up.
        idle: Whether no job runs.
        forked: Whether the simulation has forked this process.
        opened: The resources that the simulation has opened. None before the first one.
        tasks: The tasks that wait for replies.
        stale: Whether it must be made anew, because code of an earlier stack may still use it.
        user: The number of the thread that began the latest job.
    """

    __slots__ = (
        "__weakref__", "_context", "_deadlock", "_exiting", "_handled", "_home", "_loop",
        "_outcome", "_prepare", "_refused", "_spawned", "_stack", "_thread",
        "_users_loop", "caller", "ended", "events", "forked", "given_up", "idle", "opened",
        "plugins", "stale", "tasks", "user",
    )  # fmt: skip

    resume: Callable[[Model], Event]
    _leave: Function  # passes an event to the user, and returns the reply
    _shares_thread = True  # with its user

    def __init__(self, plugins: Plugins | None = None, earlier: Driver | None = None) -> None:
        """Prepare a driver. The first job begins the stack.

        Args:
            plugins: The handlers that take part in the simulation.
            earlier: The driver of the same simulation that this one replaces.

        Raises:
            SimulationError: gevent has replaced threads or queues.
        """
        _refuse_replaced_threads()
        self.plugins = plugins
        self._handled: tuple[Hook, ...] = () if plugins is None else tuple(plugins.hooks)
        self.events: Mapping[Hook, AnyHandler] = {}
        self._stack: greenlet | None = None
        self._thread: Thread | None = None  # that was made for the stack
        self._home: Callable[[], object] = ref(THREAD.token)  # the thread of the stack
        self._spawned = False  # whether other greenlets have decided on this stack
        self.caller: greenlet | None = None
        self.opened: WeakSet[Resource] | None = None if earlier is None else earlier.opened
        self.given_up: str | None = None
        self.stale = False
        if earlier is not None:
            self.stale = earlier.stale or earlier._spawned or earlier.given_up is not None
        self.ended = False
        self.idle = True
        self.forked = False
        self._exiting = False
        self._prepare: Callable[[], Job] | None = None  # until the job begins
        self._context = Context()  # of the job, until it begins
        self.tasks = Tasks()
        self._loop = NO_LOOP  # of the simulation, while it waits
        self._users_loop = NO_LOOP
        self._outcome: list[Model] = []  # the result of the job, or its error
        self._refused: WrongThreadError | None = None  # until the user gets it

    # -- on the user's side -----------------------------------------------------------------------

    @abstractmethod
    def _make_stack(self) -> None:
        """Make the stack, which runs ``_serve``, or forget replies after its latest job."""

    @abstractmethod
    def enter(self, *, direct: bool = True) -> None:
        """Prepare to resume the simulation from here, or raise a ``WrongThreadError``.

        ``direct``: whether later steps may do without this.
        """

    @abstractmethod
    def throw(self) -> Event | None:
        """Raise ``SimulationExit``. Return the next event, or None if it does not come in time."""

    @abstractmethod
    def end(self) -> None:
        """End the stack."""

    @abstractmethod
    def limit(self, seconds: float) -> AbstractContextManager[None]:
        """Return a context that raises a ``StepTimeoutError`` after some seconds."""

    def begin(self, prepare: Callable[[], Job]) -> None:
        """Prepare a job. After ``enter``, the next ``resume`` starts it on the stack.

        Args:
            prepare: Returns the job. It runs on the stack, too, where decisions follow the rule
                until it has returned.
        """
        self.user = get_ident()
        self._deadlock: str | None = None  # why the job waits for ever
        self._make_stack()
        self._prepare = prepare
        self.events = {}
        self._refused = None
        self._outcome = []
        self._context = copy_context()

    def variables(self) -> Iterator[dict[str, Model]]:
        """Yield the variables of each frame of the suspended simulation."""
        frame = self.frame
        while frame is not None:
            yield dict(frame.f_locals)  # from Python 3.13 on, f_locals shows no values to others
            frame = frame.f_back

    @property
    def frame(self) -> FrameType | None:
        """The innermost frame of the simulation while it is suspended."""
        return None if self._stack is None else self._stack.gr_frame

    @property
    def loop(self) -> Model:
        """The running event loop of the suspended simulation."""
        return self._loop[0]

    @property
    def reachable(self) -> bool:
        """Whether the simulation can be resumed from the current thread and process."""
        return self._home() is THREAD.token if self._shares_thread else not self.lost

    @property
    def lost(self) -> bool:
        """Whether the thread of the stack has ended, or does not exist in this process."""
        return self._home() is None

    def ready(self) -> Driver:
        """Return this driver if it can run another job from here, else one that replaces it."""
        if self.idle and not self.ended and self.reachable:
            return self
        self.end()  # before there is another, so that an interrupt leaves no unknown stack behind
        return type(self)(self.plugins, self)

    def renew(self) -> None:
        """Note that the simulation was made anew."""
        self.stale = False

    def run(self, job: Callable[[], Model]) -> Model:
        """Run a job to its end, after ``enter``; return its result. Decisions follow the rule."""
        try:
            self.begin(lambda: (job, {}))
            self.resume(None)
        except BaseException:
            self.unwind()  # because an interrupt has ended the wait
            raise
        return self.take_outcome()

    def take_outcome(self) -> Model:
        """Return the result of the job that has ended, or raise its error, or that of a refusal."""
        outcome = self._outcome
        if len(outcome) > 1:
            raise outcome.pop()  # the waiting stack must not keep the error
        if self._refused is not None:
            raise self._refusal(self._refused)
        return outcome.pop()

    def unwind(self) -> list[BaseException]:
        """Raise ``SimulationExit`` in the job until it ends, or give it up, after ``enter``.

        Return the errors that the job raised instead.
        """
        if self.idle or self.ended:
            self._prepare = None  # an interrupt may have come before it began
            return []
        self._exiting = True
        for _ in range(UNWINDING_TRIES):
            event = self.throw()
            if event is None:
                self.give_up(
                    f"neither decided anything nor ended within {SECONDS_TO_UNWIND} s; it is"
                    " abandoned"
                    if self._deadlock is None
                    else "waits for a lock; it is abandoned"
                )
                break
            if event is ENDED:
                try:
                    self.take_outcome()
                except BaseException as error:
                    return [] if is_exit(error) else [error]
                return []
        else:
            self.give_up(
                "refuses to end: it went on after SimulationExit was raised in it"
                f" {UNWINDING_TRIES} times; it is left suspended. Let the model re-raise exceptions"
                " that it does not know; callbacks from C need a CallbackGuard"
            )
        self.ended = True
        return []

    def give_up(self, reason: str) -> None:
        """Note why the job on the stack cannot be unwound."""
        self.given_up = reason

    def note_deadlock(self, text: str) -> None:
        """Note why the job waits for ever. An interrupt of it becomes an error with this text."""
        self._deadlock = text

    # -- on the simulation's side -----------------------------------------------------------------

    def _decider(
        self,
        hook: Hook,
        rule: Function,
        handler: AnyHandler,
        deliver: Function | None,
        away: bool,
    ) -> Interceptor:
        """Make the function that sends an event for each call of a hook, and returns its value."""
        bind = hook.bind

        def decide(args: Args, kwargs: Kwargs) -> Model:
            # See ``interceptor``. The first comparison is the fastest.
            if exception() is not None and type(exception()) is GeneratorExit:
                if self._exiting:
                    raise make_exit()
                return rule(*args, **kwargs)
            bound = args
            named = kwargs
            if kwargs is not BOUND:
                call = bind(args, kwargs)
                if call is None:  # a handler has changed the arguments
                    return rule(*args, **kwargs)
                bound, named = call
            if away:
                self._reply_to(getcurrent())
            looped = running_loop() is not None or self._users_loop[0] is not None
            if looped:
                self._loop = swap_loop(self._users_loop)
            leave = self._leave
            try:
                reply = leave(handler, bound, named)
            except BaseException as error:
                exits = isinstance(error, SimulationExit)
                if exits or not self.ended:  # else the stack unwinds by itself
                    self._reply_to(None)
                    self._enter_loop()
                if exits:
                    raise make_exit() from None
                raise
            if away:
                self._reply_to(None)
            if looped or running_loop() is not None:
                self._enter_loop()
            if reply is RULE:
                return rule(*args, **kwargs) if kwargs else rule(*args)
            return reply if deliver is None else deliver(reply, *bound, **named)

        return decide

    @abstractmethod
    def _reply_to(self, receiver: greenlet | None) -> None:
        """Let the next reply go to a greenlet of the model. None: to the stack itself."""

    def _enter_loop(self) -> None:
        """Switch from the user's event loop to the simulation's."""
        self._users_loop = swap_loop(self._loop)
        self._loop = NO_LOOP

    def note_opened(self, resource: Resource) -> None:
        """Note a resource that the simulation has opened."""
        if self.opened is None:
            self.opened = WeakSet()  # not before, because an empty one takes a kilobyte
        self.opened.add(resource)

    def _register(self) -> None:
        """On the stack: register it as a simulation's stack."""
        self._stack = getcurrent()
        self._home = ref(THREAD.token)
        STACKS[self._stack] = self
        watch_resources()

    def _work(self) -> None:
        """On the stack: run a job, and note its outcome."""
        # No variable here refers to the stack, because a stack that refers to itself cannot be
        # collected.
        self.idle = False
        self._exiting = False
        prepare, self._prepare = self._prepare, None
        job = None
        try:
            self.enter_hooks()
            if prepare is not None:
                job, self.events = prepare()
                prepare = None  # the job must not keep what it refers to
            if self.events:
                self.enter_hooks()
            result = None if job is None else job()
        except BaseException as error:
            self._outcome = [None, self._explain(error)]
            return
        finally:
            prepare = job = None
            self.leave_hooks(self._stack)
            self.events = {}
            self.tasks.clear()
        self._outcome = [result]

    def _explain(self, error: BaseException) -> BaseException:
        """Return the error to raise on the user's side for an error of the simulation."""
        if self._deadlock is not None and isinstance(error, KeyboardInterrupt):
            return SimulationError(self._deadlock).with_traceback(error.__traceback__)
        refused = self._refused
        if refused is not None and refused is not error:
            if isinstance(error, SimulationExit):
                return self._refusal(refused)
            annotate(error, f"simenv_marl: before that, a decision was refused: {refused}")
        if self._exiting and isinstance(error, SimulationExit):
            # Free its frames in this thread, because the model's greenlets can unwind in no other.
            error.__traceback__ = None
            error.__context__ = None
        elif type(error) in (SimulationExit, LoopExit):  # a check raises a subclass
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
        self.leave_hooks(stack)
        if stack is not None:
            STACKS.pop(stack, None)
        watch_resources()

    def enter_hooks(self) -> None:
        """Enter the stack into all hooks, unless another environment runs on it."""
        stack = self._stack
        if stack is None or STACKS.get(stack) is not self:
            return
        hooks = (*self.events, *self._handled)
        for hook in hooks:
            hook.enter(stack, self.interceptor(hook, away=False), self.plugins)
        if STACKS.get(stack) is not self:  # garbage collection has ended it meanwhile
            for hook in hooks:
                hook.leave(stack)

    def leave_hooks(self, stack: greenlet | None) -> None:
        """Leave all hooks, so that a stack takes no part in calls until ``enter_hooks``."""
        if stack is not None:
            for hook in (*self.events, *self._handled):
                hook.leave(stack)

    def interceptor(self, hook: Hook, away: bool = True) -> Interceptor:
        """Return the interceptor of a hook's calls: ``run_rule`` if it sends no events.

        It lets the rule decide also while a generator is closed, because that may be a process of
        an earlier episode: another one frees it, perhaps in the garbage collector, where a switch
        would be fatal.

        Args:
            hook: The hook.
            away: Whether the call comes from another greenlet or thread than the stack's.
        """
        handler = self.events.get(hook)
        if handler is None:
            return hook.run_rule
        if isinstance(handler, Notice):
            return partial(handler.handle, hook)
        if away or self.forked:
            obstacle = self._obstacle()
            if obstacle is not None:
                return partial(self.refuse, hook, obstacle)
            self._spawned = True
        rule = hook.rule
        deliver = handler.deliver
        send = None
        if handler.report is not None:
            send = self._decider(hook, _ignore, handler.report, None, away)
        if handler.reports_itself and deliver is not None:
            deliver = partial(deliver, send)
        elif send is not None:
            rule = _reporting(hook, send)
        if hook.kind == "coroutine" and deliver is not None:
            sender = partial(self._decider, hook, _ignore, deliver=None, away=away)
            deliver = partial(self.tasks.deliver, sender, rule, deliver)
        return self._decider(hook, rule, handler, deliver, away)

    def _obstacle(self) -> str | None:
        """Return where a call comes from if the environment cannot be asked there."""
        if self.forked:
            return "a process that the simulation has forked"
        if self._home() is not THREAD.token:
            return "a thread that the simulation has started"
        if self._shares_thread and spawner_of(getcurrent()) is not None:
            return (
                "a greenlet that the simulation has spawned with gevent"
                ' (driver="thread" allows that)'
            )
        return None

    def refuse(self, hook: Hook, where: str, args: Args, kwargs: Kwargs) -> NoReturn:
        """Refuse a decision. The user gets the error at the simulation's next event."""
        error = WrongThreadError(
            f"{hook.name} was called in {where}, where the environment cannot ask for a decision."
            " Call it where run() runs, as executors that run in turn do, or pass the decision on"
        )
        if self._refused is None and not self.forked:
            self._refused = error
            self.events = dict.fromkeys(self.events, _ENDED)
            self.enter_hooks()
        raise error

    def refuse_all(self) -> None:
        """Refuse all decisions: the simulation has forked this process, which has no user."""
        self.forked = True
        self.enter_hooks()

    def _refusal(self, refused: WrongThreadError) -> WrongThreadError:
        """Make the error that tells the user of a refused decision."""
        self._refused = None
        error = WrongThreadError(*refused.args)
        error.__cause__ = refused
        return error


def _refuse_replaced_threads() -> None:
    """Refuse threads and queues of gevent, because their locks wait in its hub, not in threads."""
    monkey = modules.get("gevent.monkey")
    needed = ("threading", "queue")
    replaced = [] if monkey is None else [n for n in needed if monkey.is_module_patched(n)]
    if replaced:
        raise SimulationError(
            f"gevent.monkey has replaced {' and '.join(replaced)}, which simulations need as they"
            " are; call gevent.monkey.patch_all(thread=False, queue=False)"
        )


def _ignore(*args: Model) -> None:
    """Do nothing, in place of a rule, where no decision of the rule can be reported."""


def _reporting(hook: Hook, send: Interceptor) -> Function:
    """Make a function that runs a rule, and sends its decision with the bound call."""
    rule = hook.rule

    def report(decision: Model, args: Args, kwargs: Kwargs) -> Model:
        send(((decision, *(hook.bind(args, kwargs) or (args, kwargs))),), BOUND)
        return decision

    if hook.kind == "function":
        return lambda *args, **kwargs: report(rule(*args, **kwargs), args, kwargs)

    @coroutine
    def report_later(*args: Model, **kwargs: Model) -> Generator[Model, Model, Model]:
        return report((yield from rule(*args, **kwargs)), args, kwargs)

    return report_later
