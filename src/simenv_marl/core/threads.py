"""The driver that runs a simulation in a thread of its own, for models that cannot run in a greenlet."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from os import getpid
from queue import Empty, SimpleQueue
from threading import Thread, current_thread
from typing import Any, Final
from weakref import WeakSet

from ..errors import WrongThreadError, warn_user
from ..hooks.hook import Hook
from ..hooks.stacks import SIMULATION, Interceptor
from ..simulation import RULE, Sentinel
from .driver import FAILED, FINISHED, NO_EVENTS, SECONDS_TO_UNWIND, Driver, Event, SimulationExit, reporting_rule
from .greenlets import silence_unwound_tasks

_LONGEST_WAIT: Final = 1.0
"""The longest single wait of the user's thread, in seconds. A Ctrl-C just before a wait does not end that wait."""

_EXIT: Final = Sentinel("EXIT")
_JOB: Final = Sentinel("JOB")
_END: Final = Sentinel("END")


class ThreadDriver(Driver):
    """A driver that runs a simulation in a thread of its own. The first ``begin`` starts it, and ``end`` joins it.

    Only one of the two threads runs at a time. They hand over replies and events in two queues. An interrupt (Ctrl-C,
    for instance) may leave a reply or an event in its queue, or lose an event. So the simulation's thread ignores all
    replies between two jobs, and each job has a queue of its own for events.
    """

    __slots__ = ("_arrived", "_process", "_replies", "_thread")

    own_thread = True

    def __init__(self, plugins: Any = None, opened: WeakSet[Any] | None = None, *, direct: bool = True) -> None:
        """Prepare a thread, as ``Driver`` does; ``caller`` is always None."""
        super().__init__(plugins, opened)
        self._process = getpid()
        self._replies: SimpleQueue[Any] = SimpleQueue()
        self._arrived: SimpleQueue[Event] = SimpleQueue()
        self._thread: Thread | None = None

    # -- in the user's thread ---------------------------------------------------------------------

    def begin(self, job: Callable[[], Any], events: Mapping[Hook, Any] = NO_EVENTS, context: Any = None) -> None:
        """Prepare a job, and start the thread if there is none."""
        super().begin(job, events, context)
        self._arrived = SimpleQueue()
        if self._thread is None:
            self._thread = thread = Thread(target=self._serve, name=SIMULATION, daemon=True)
            try:
                thread.start()
            except Exception:  # there are too many threads
                self._thread = None
                raise

    def enter(self) -> None:
        """Check that this process was not forked, because the simulation's thread stayed behind."""
        if self.lost:
            raise WrongThreadError(
                "this process was forked in mid-episode, but the simulation is suspended in a thread of the parent"
                ' process; call reset(), or use driver="greenlet"'
            )

    def resume(self, reply: Any) -> Event:
        """Resume the simulation with a reply; return its next event."""
        self._replies.put(reply if self._job is None else _JOB)
        while True:
            try:
                return self._arrived.get(True, _LONGEST_WAIT)
            except Empty:
                continue

    def throw(self) -> Event | None:
        """Raise ``SimulationExit`` in the suspended simulation; return its next event, or None if none comes in time.

        If the simulation still runs, because the user's wait was interrupted, the exit is raised at its next decision.
        """
        self.enter()
        if self.idle:  # the job has ended, or was interrupted before it began
            with suppress(Empty):
                while True:
                    self._replies.get_nowait()
            self._job = None
            return (FINISHED, [None], None) if self._arrived.empty() else self._arrived.get()
        self._exiting = True
        self._replies.put(_EXIT)
        try:
            return self._arrived.get(True, SECONDS_TO_UNWIND)
        except Empty:
            return None

    @property
    def lost(self) -> bool:
        """Whether this process is a fork, in which the simulation's thread does not exist."""
        return getpid() != self._process

    @property
    def reachable(self) -> bool:
        """Whether the simulation can be resumed from the current process."""
        return not self.lost

    @property
    def at_home(self) -> bool:
        """Whether this code runs in the simulation's thread."""
        return current_thread() is self._thread

    def end(self) -> None:
        """End the stack, whose job has ended or is lost, and wait for the end of its thread.

        After an interrupt this can be called again.
        """
        if self.ended and not self.idle:
            return
        thread = self._thread
        self._arrived = SimpleQueue()
        if self.idle and thread is not None and thread is not current_thread() and not self.lost:
            self.ended = True  # first, because after an interrupt no job must begin that would come after ``_END``
            self._replies.put(_END)
            if thread.ident is not None:  # otherwise an interrupt came before the thread started
                thread.join(SECONDS_TO_UNWIND)
            if thread.is_alive():
                warn_user(
                    f"the thread of a simulation that has ended is still alive after {SECONDS_TO_UNWIND} s",
                    ResourceWarning,
                )
        self._forget_stack()
        self._thread = None

    def abandon(self) -> None:
        """Give up a job that does not unwind. If it decides again, it gets another chance to unwind."""
        self.ended = True

    # -- in the simulation's thread ---------------------------------------------------------------

    def _serve(self) -> None:
        self._register()
        try:
            while not self.ended and (reply := self._replies.get()) is not _END:
                if reply is _JOB:
                    self._do()
                reply = None
        finally:
            self._forget_stack()

    def _do(self) -> None:
        context, self._context = self._context, None
        try:
            event: Event = context.run(self._work)
        except BaseException as error:  # raised from another thread; without an event the user would wait for ever
            event = FAILED, [error], None
        context = None
        if isinstance(event[1][0], SimulationExit):
            # Nothing reads this traceback. Its frames must be freed while this thread runs, because the model's own
            # greenlets can unwind in no other thread.
            event[1][0].__traceback__ = event[1][0].__context__ = None
        if self.lost:
            self.ended = True
            if event[0] is FAILED:
                raise event[1].pop()  # the model has forked, and this process has no user to tell
            return
        self.idle = True
        self._arrived.put(event)

    def _decider(self, hook: Hook, event: Any, away: bool = False) -> Interceptor:
        """Make the function that sends an event for the calls of a hook, and carries out the replies."""
        deliver, ask, answer = event.deliver, self._arrived.put, self._replies.get
        rule: Any = hook.rule
        if event.report is not None:
            rule = reporting_rule(hook, self._decider(hook, event.report))

        def decide(args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
            ask((event, args, kwargs))
            reply = answer()
            if reply is RULE:
                return rule(*args, **kwargs)
            if reply is _EXIT:
                silence_unwound_tasks()
                raise SimulationExit
            return reply if deliver is None else deliver(reply, *args, **kwargs)

        return decide
