"""Callbacks that C code calls: what is raised in them surfaces where C was called."""

import sys
from collections.abc import Callable
from functools import wraps
from time import monotonic
from types import CodeType
from typing import Any, Final

from greenlet import getcurrent

from .core.switch import SECONDS_TO_UNWIND, BaseDriver, SimulationExit
from .hooks.stacks import stack_of


class CallbackGuard:
    """Carries what is raised in callbacks past the C code that has called them.

    An exception cannot cross frames of C: ctypes and cffi print it, answer C with zero, and C goes on. A guard keeps
    the first exception of a callback, asks C to stop, keeps all other callbacks from running, and raises the exception
    once C has returned. That holds for errors, for Ctrl-C, and for the unwinding of a simulation in mid-episode. It
    serves outside an environment, too::

        class Model:
            def __init__(self):
                self.guard = CallbackGuard(stop=library.request_stop)
                self.on_step = library.CALLBACK(self.guard.callback(self.step))

            def run(self):
                with self.guard:
                    library.run(self.on_step)

    To be made once for each simulation. The block may be entered again, also from within a callback: an exception
    surfaces at the innermost block around the C code that has called back. Outside any block callbacks are called as
    they are.
    """

    __slots__ = ("__weakref__", "_depth", "_error", "_patience", "_stop")

    def __init__(self, stop: Callable[[], Any] | None = None) -> None:
        """Make a guard.

        Args:
            stop: Asks the C code to return; called within the callback that has failed. None: C returns by itself,
                or because of what it is answered.
        """
        self._stop = stop
        self._depth = 0
        self._error: BaseException | None = None

    def callback(self, function: Callable[..., Any], result: Any = 0) -> Callable[..., Any]:
        """Wrap a function that C is going to call.

        Args:
            function: The function.
            result: What C is answered by the call that has failed, and by those that come after it. 0 serves for
                numbers, pointers and void functions of ctypes; void functions of cffi take None.

        Returns:
            The function to be given to ctypes, cffi, or whatever calls it from C.
        """
        guard = self

        @wraps(function, updated=())  # it is no decision point, should the function be one
        def callback(*args: Any) -> Any:
            try:
                if guard._error is None:
                    return function(*args)
                guard._wait()
            except BaseException as error:
                if not guard._depth:
                    raise
                guard._keep(error)
            return result

        return callback

    def __enter__(self) -> None:
        if not isinstance(sys.unraisablehook, _Rescue):
            sys.unraisablehook = _Rescue()
        self._depth += 1

    def __exit__(self, *raised: object) -> None:
        self._depth -= 1
        error, self._error = self._error, None
        if error is None:
            return
        context = error.__context__
        try:
            raise error
        finally:
            # What C code's caller has raised for having been stopped says nothing, and the error's own context does.
            object.__setattr__(error, "__context__", context)
            del error, context, raised

    def _keep(self, error: BaseException) -> None:
        """Have an error surface where C was called, and C return there."""
        kept = self._error
        if kept is None:
            self._patience = monotonic() + SECONDS_TO_UNWIND
        if kept is None or isinstance(error, SimulationExit) or isinstance(kept, SimulationExit):
            self._error = error
        if kept is None and self._stop is not None:
            try:
                self._stop()
            except BaseException as problem:
                self._error = problem

    def _wait(self) -> None:
        """C calls on: do not let the environment's user wait for ever."""
        if monotonic() < self._patience:
            return
        self._patience = monotonic() + SECONDS_TO_UNWIND
        driver = stack_of(getcurrent())
        if isinstance(driver, BaseDriver):
            assert self._error is not None
            driver.stall(self._error, SECONDS_TO_UNWIND)


_CALLBACK: Final[CodeType] = CallbackGuard().callback(int).__code__


class _Rescue:
    """Stands before ``sys.unraisablehook`` once a guard was entered; to what is not a guard's it changes nothing.

    Ctrl-C mostly comes while C code runs, and is then raised before the first line of the callback that is called next.
    """

    __slots__ = ("_before",)

    def __init__(self) -> None:
        self._before = sys.unraisablehook

    def __call__(self, unraisable: Any) -> None:
        trace = unraisable.exc_traceback
        if trace is not None and trace.tb_frame.f_code is _CALLBACK:
            guard = trace.tb_frame.f_locals["guard"]
            if guard._depth:
                guard._keep(unraisable.exc_value)
                return
        self._before(unraisable)
