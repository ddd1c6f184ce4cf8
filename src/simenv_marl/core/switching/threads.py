"""The driver that runs a simulation in a thread of its own, for models that need a thread."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import Context
from queue import Empty, SimpleQueue
from sys import _current_frames
from threading import Thread
from time import monotonic
from types import FrameType
from typing import Final

from greenlet import greenlet

from ...errors import SimulationError, WrongThreadError
from ...hooks.limits import SECONDS_TO_UNWIND, step_timeout_error
from ...hooks.locks import LOOKS, explain_wait
from ...hooks.stacks import SIMULATION
from ...simulation import Model, Sentinel
from .driver import ENDED, Driver, Event
from .exits import LoopExit, SimulationExit

_LONGEST_WAIT: Final = 1.0
"""The longest single wait of the user's thread, in seconds, because Ctrl-C may come before it."""

_raise_in: Final = ctypes.PYFUNCTYPE(ctypes.c_int, ctypes.c_ulong, ctypes.c_void_p)(
    ("PyThreadState_SetAsyncExc", ctypes.pythonapi)
)
"""Raises an error, given by the address of its class, in a thread. None: not any more."""

_EXIT: Final = Sentinel("EXIT")
_JOB: Final = Sentinel("JOB")
_END: Final = Sentinel("END")


class ThreadDriver(Driver):
    """A driver that runs a simulation in a thread. The first ``begin`` starts it; ``end`` joins it.

    Only one of the two threads runs at a time. They pass replies and events through two queues. An
    interrupt may leave something in a queue, or lose an event. So replies between two jobs are
    ignored, and each job has a queue of events. ``caller`` is always None.
    """

    __slots__ = ("_arrived", "_limit", "_replies")

    _shares_thread = False

    # -- in the user's thread ---------------------------------------------------------------------

    def _make_stack(self) -> None:
        self._arrived: SimpleQueue[Event] = SimpleQueue()
        self._limit: tuple[float, float] | None = None  # the end of the step, and its seconds
        if self._thread is not None:
            with suppress(Empty):
                while True:
                    self._replies.get_nowait()
            return
        self._replies: SimpleQueue[Model] = SimpleQueue()
        self._thread = Thread(target=self._serve, name=SIMULATION, daemon=True)
        try:
            self._thread.start()
        except Exception:  # there are too many threads
            self._thread = None
            raise

    def enter(self, *, direct: bool = True) -> None:
        """Check that this process was not forked, because the simulation's thread stayed behind."""
        if self.lost:
            raise WrongThreadError(
                "this process was forked in mid-episode, but the simulation is suspended in a"
                ' thread of the parent process; call reset(), or use driver="greenlet"'
            )

    def resume(self, reply: Model) -> Event:
        """Resume the simulation with a reply; return its next event."""
        self._replies.put(reply if self._prepare is None else _JOB)
        looks = 0
        wait = _LONGEST_WAIT
        while True:
            if self._limit is not None:
                end, seconds = self._limit
                wait = min(_LONGEST_WAIT, end - monotonic())
                if wait <= 0:
                    raise step_timeout_error(seconds, self._innermost())
            with suppress(Empty):
                return self._arrived.get(True, wait)
            looks += 1
            running = self._innermost()
            if looks % LOOKS == 0 and running is not None:
                with suppress(Exception):  # the simulation may go on meanwhile
                    self._deadlock = explain_wait(running, self.user)
                if self._deadlock is not None:
                    raise SimulationError(self._deadlock)

    @contextmanager
    def limit(self, seconds: float) -> Iterator[None]:
        """Return a context that ends the wait for the simulation."""
        self._limit = monotonic() + seconds, seconds
        try:
            yield
        finally:
            self._limit = None

    def _innermost(self) -> FrameType | None:
        return _current_frames().get(getattr(self._thread, "ident", 0))

    @property
    def frame(self) -> FrameType | None:
        """The innermost frame of the simulation while it is suspended."""
        frame = self._innermost()
        return frame if frame and frame.f_code.co_name == "_leave" else None

    def throw(self) -> Event | None:
        """Raise ``SimulationExit`` in the simulation, at its next decision if it still runs.

        Return its next event.
        """
        self._replies.put(_EXIT)
        late = 0
        if self._limit is not None and monotonic() > self._limit[0] and self.frame is None:
            late = getattr(self._thread, "ident", 0)  # it may be in a loop, without decisions
            _raise_in(late, id(LoopExit))
        try:
            event = self._arrived.get(self._deadlock is None, SECONDS_TO_UNWIND)
        except Empty:
            return None
        if late:
            _raise_in(late, None)
        return event

    def end(self) -> None:
        """End the stack, and join its thread. After an interrupt this can be called again.

        A job that was given up gets another chance to unwind if it decides again.
        """
        if self.ended and not self.idle:
            return
        if self.idle and self._thread is not None and not self.lost:
            self.ended = True  # before ``_END``, so that no job can come after it
            self._replies.put(_END)
            # A RuntimeError means that this is that thread, or that it was never started.
            with suppress(RuntimeError):
                self._thread.join(SECONDS_TO_UNWIND)
        self._forget_stack()
        self._thread = None

    # -- in the simulation's thread ---------------------------------------------------------------

    def _serve(self) -> None:
        try:
            self._register()
        except BaseException as error:  # its user waits for the first job
            self._outcome = [None, error]
            self._arrived.put(ENDED)
            return
        try:
            while not self.ended:
                with suppress(SimulationExit):  # that came after the end of its job
                    reply = self._replies.get()
                    if reply is _END:
                        break
                    if reply is _JOB:
                        self._do()
                    reply = None
        finally:
            self._forget_stack()

    def _do(self) -> None:
        context, self._context = self._context, Context()
        try:
            context.run(self._work)
        except BaseException as error:  # raised from another thread, so that its user does not wait
            self._outcome = [None, error]
        del context
        if self.forked:
            self.ended = True
            self.take_outcome()  # raises an error here, because this process has no user
        self.idle = True
        self._arrived.put(ENDED)

    def _leave(self, *event: Model) -> Model:
        """Pass an event to the user, and return the reply."""
        self._arrived.put(event)
        reply = self._replies.get()
        if reply is _EXIT:
            raise SimulationExit
        return reply

    def _reply_to(self, receiver: greenlet | None) -> None:
        """Do nothing: while a greenlet of the model waits, its whole thread does."""
