"""The driver that runs a simulation in a thread of its own, for models that cannot run in a greenlet."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from queue import Empty, SimpleQueue
from threading import Thread
from typing import Any, Final

from ..errors import WrongThreadError
from ..hooks.hook import BOUND, Hook
from ..hooks.stacks import SIMULATION, Interceptor
from ..simulation import RULE, Sentinel
from .driver import ENDED, SECONDS_TO_UNWIND, Driver, Event, SimulationExit
from .greenlets import make_exit

_LONGEST_WAIT: Final = 1.0
"""The longest single wait of the user's thread, in seconds.

A Ctrl-C just before a wait does not end that wait.
"""

_EXIT: Final = Sentinel("EXIT")
_JOB: Final = Sentinel("JOB")
_END: Final = Sentinel("END")


class ThreadDriver(Driver):
    """A driver that runs a simulation in a thread of its own. The first ``begin`` starts it, and ``end`` joins it.

    Only one of the two threads runs at a time. They hand over replies and events in two queues. An
    interrupt may leave something in a queue, or lose an event. So replies between two jobs are
    ignored, and each job has a queue of events.
    """

    __slots__ = ("_arrived", "_replies", "_thread")

    _shares_thread = False

    def __init__(self, plugins: Any = None) -> None:
        """Prepare a thread. ``caller`` is always None."""
        super().__init__(plugins)
        self._replies: SimpleQueue[Any] = SimpleQueue()
        self._arrived: SimpleQueue[Event] = SimpleQueue()
        self._thread: Thread | None = None

    # -- in the user's thread ---------------------------------------------------------------------

    def begin(
        self, job: Callable[[], Any], events: Mapping[Hook, Any] | None = None, context: Any = None
    ) -> None:
        """Prepare a job, and start the thread if there is none."""
        with suppress(Empty):
            while True:
                self._replies.get_nowait()
        self._arrived = SimpleQueue()
        super().begin(job, events, context)
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
                "this process was forked in mid-episode, but the simulation is suspended in a"
                " thread of the parent"
                ' process; call reset(), or use driver="greenlet"'
            )

    def resume(self, reply: Any) -> Event:
        """Resume the simulation with a reply; return its next event."""
        self._replies.put(reply if self._job is None else _JOB)
        while True:
            with suppress(Empty):
                return self._arrived.get(True, _LONGEST_WAIT)

    def throw(self) -> Event | None:
        """Raise ``SimulationExit`` in the simulation, at its next decision if it still runs.

        Return its next event.
        """
        self._replies.put(_EXIT)
        try:
            return self._arrived.get(True, SECONDS_TO_UNWIND)
        except Empty:
            return None

    def end(self) -> None:
        """End the stack, and wait for the end of its thread. After an interrupt this can be called again.

        A job that was given up gets another chance to unwind if it decides again.
        """
        if self.ended and not self.idle:
            return
        if self.idle and self._thread is not None and not self.lost:
            # first, because after an interrupt no job must begin that would come after ``_END``
            self.ended = True
            self._replies.put(_END)
            # this is that thread, or an interrupt came before it started
            with suppress(RuntimeError):
                self._thread.join(SECONDS_TO_UNWIND)
        self._forget_stack()
        self._thread = None

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
            event = context.run(self._work)
        # raised from another thread; without an event the user would wait for ever
        except BaseException as error:
            event = ENDED, [error], True
        context = None
        _, box, failed = event
        if isinstance(box[0], SimulationExit):
            # Nothing reads this traceback. Its frames must be freed while this thread runs, because
            # the model's own greenlets can unwind in no other thread.
            box[0].__traceback__ = box[0].__context__ = None
        if self.forked:
            self.ended = True
            if failed:
                raise box.pop()  # this process has no user to tell
        self.idle = True
        self._arrived.put(event)

    def _decider(self, hook: Hook, rule: Any, event: Any, away: bool) -> Interceptor:
        """Make the function that sends an event for the calls of a hook, and carries out the replies."""
        deliver, bind, ask, answer = event.deliver, hook.bind, self._arrived.put, self._replies.get

        def decide(args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
            bound, named = args, kwargs
            if kwargs is not BOUND:
                call = bind(args, kwargs)
                if call is None:  # a handler has changed the arguments
                    return rule(*args, **kwargs)
                bound, named = call
            ask((event, bound, named))
            reply = answer()
            if reply is RULE:
                return rule(*args, **kwargs)
            if reply is _EXIT:
                raise make_exit()
            return reply if deliver is None else deliver(reply, *bound, **named)

        return decide
