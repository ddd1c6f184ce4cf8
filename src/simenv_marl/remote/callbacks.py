"""Callbacks that C code calls: exceptions in them are raised where C was called."""

import sys
from collections.abc import Callable
from functools import wraps
from time import monotonic
from types import CodeType
from typing import Any, Final

from greenlet import getcurrent

from ..core.driver import SECONDS_TO_UNWIND, Driver, SimulationExit
from ..hooks.stacks import stack_of


class CallbackGuard:
    """Carries exceptions of callbacks past the C code that called them.

    An exception cannot cross C frames: ctypes and cffi print it, return zero to C, and C goes on. A guard keeps the
    first exception of a callback, asks C to stop, skips all further callbacks, and raises the exception when C has
    returned. This applies to errors, to Ctrl-C, and to the unwinding of a simulation in mid-episode. It also works
    outside an environment::

        class Model:
            def __init__(self):
                self.guard = CallbackGuard(stop=library.request_stop)
                self.on_step = library.CALLBACK(self.guard.callback(self.step))

            def run(self):
                with self.guard:
                    library.run(self.on_step)

    Make one guard for each simulation. The block may be nested, also within a callback: an exception is raised at the
    end of the innermost block around the C code that called the callback. Outside a block, the guard does not affect
    callbacks.
    """

    __slots__ = ("__weakref__", "_depth", "_error", "_patience", "_stop")

    def __init__(self, stop: Callable[[], Any] | None = None) -> None:
        """Make a guard.

        Args:
            stop: Asks the C code to return. It is called within the callback that failed. None: C returns by itself, or
                because of the callback's result.
        """
        self._stop = stop
        self._depth = 0
        self._error: BaseException | None = None

    def callback(self, function: Callable[..., Any], result: Any = 0) -> Callable[..., Any]:
        """Wrap a function that C is going to call.

        Args:
            function: The function.
            result: The result that C gets from the call that failed, and from all later calls. 0 works for numbers,
                pointers and void functions of ctypes; void functions of cffi need None.

        Returns:
            The function to pass to ctypes, cffi, or another caller in C.
        """
        guard = self

        @wraps(function, updated=())  # the wrapper of a decision function is not a decision function
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
            # The exception that C's caller raised because it was stopped says nothing; the error's own context does.
            object.__setattr__(error, "__context__", context)
            del error, context, raised

    def _keep(self, error: BaseException) -> None:
        """Keep an error to be raised where C was called, and ask C to return."""
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
        """End the wait of the environment's user if C goes on calling."""
        if monotonic() < self._patience:
            return
        self._patience = monotonic() + SECONDS_TO_UNWIND
        driver = stack_of(getcurrent())
        if isinstance(driver, Driver):
            assert self._error is not None
            driver.stall(self._error, SECONDS_TO_UNWIND)


_CALLBACK: Final[CodeType] = CallbackGuard().callback(int).__code__


class _Rescue:
    """Wraps ``sys.unraisablehook`` once a guard was entered. It passes on everything that does not concern a guard.

    Ctrl-C mostly arrives while C code runs, and is then raised before the first line of the next callback.
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
