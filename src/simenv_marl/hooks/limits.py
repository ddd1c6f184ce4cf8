"""The time limit of a step: a signal in the main thread, because only that interrupts C code."""

from __future__ import annotations

import _signal  # type: ignore[import-not-found]  # without the enums of signal, which take time
from math import inf
from threading import current_thread, main_thread
from time import monotonic
from types import FrameType
from typing import Any, Final

from greenlet import getcurrent

from ..errors import StepTimeoutError, WrongThreadError, model_stack
from .stacks import stack_of

SECONDS_TO_UNWIND: Final = 5.0
"""How long a simulation may take to its next decision or its end while it unwinds."""


def step_timeout_error(seconds: float, frame: FrameType | None) -> StepTimeoutError:
    """Make the error of a step, with the stack of the code that ran."""
    return StepTimeoutError(
        f"the step took longer than step_timeout={seconds} s, and was here:\n{model_stack(frame)}"
    )


class StepAlarm:
    """A context that ends a step by an error when its time is over.

    It borrows the timer and the handler of SIGALRM. The user's own alarms still ring meanwhile.
    """

    __slots__ = ("_end", "_handler", "_interval", "_late", "_next", "_seconds")

    def __init__(self, seconds: float) -> None:
        """Check that there can be an alarm here.

        Raises:
            WrongThreadError: Python handles no signals in this thread, or on this system.
        """
        if current_thread() is not main_thread() or not hasattr(_signal, "setitimer"):
            raise WrongThreadError(
                "step_timeout= needs a signal, which Python handles in the main thread only, and"
                ' not on Windows; use driver="thread", which allows it everywhere'
            )
        self._seconds = seconds

    def __enter__(self) -> None:
        self._late = False
        self._next = inf  # when the user's timer rings
        self._end = monotonic() + self._seconds
        self._handler: Any = _signal.getsignal(_signal.SIGALRM)
        try:
            _signal.signal(_signal.SIGALRM, self._ring)
            rest, self._interval = _signal.setitimer(
                _signal.ITIMER_REAL, self._seconds, SECONDS_TO_UNWIND
            )
            if rest:
                self._next = monotonic() + rest
                self._wind_up()
        except BaseException:  # an interrupt
            self.__exit__()
            raise

    def __exit__(self, *error: object) -> None:
        try:
            self._restore()
        except BaseException:  # an interrupt, or the user's handler
            self._restore()
            raise

    def _restore(self) -> None:
        """Give the timer and the handler back, unless the model has set its own handler."""
        if _signal.getsignal(_signal.SIGALRM) == self._ring:
            rest = 0.0 if self._next == inf else max(self._next - monotonic(), 1e-6)
            _signal.setitimer(_signal.ITIMER_REAL, rest, self._interval)
            _signal.signal(_signal.SIGALRM, self._handler)

    def _wind_up(self) -> None:
        """Set the timer to the next event. Then it rings again and again, until the step ends."""
        rest = max(min(self._next, self._end) - monotonic(), 1e-6)
        _signal.setitimer(_signal.ITIMER_REAL, rest, SECONDS_TO_UNWIND)

    def _ring(self, number: int, frame: FrameType) -> None:
        """Handle the signal."""
        now = monotonic()
        if now < self._end:
            if now > self._next - 0.001:  # clocks differ a little
                self._next = self._next + self._interval if self._interval else inf
            self._wind_up()
            if self._handler is _signal.SIG_DFL:
                self._restore()
                _signal.raise_signal(number)
            elif callable(self._handler):
                self._handler(number, frame)
            return
        if frame.f_code.co_filename == __file__:  # the step has just ended
            return
        was_late, self._late = self._late, True
        driver = stack_of(getcurrent())
        if driver is not None:
            driver.interrupt(step_timeout_error(self._seconds, frame), was_late)
        elif not was_late:  # once, because then the simulation unwinds
            raise step_timeout_error(self._seconds, frame)
