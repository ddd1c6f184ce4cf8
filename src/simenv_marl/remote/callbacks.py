"""Callbacks that C code calls: an exception in one of them is raised where C was called."""

import sys
from collections.abc import Callable
from functools import partial, wraps
from typing import Any


class CallbackGuard:
    """Carries exceptions of callbacks (errors, Ctrl-C, the exit from an episode) past the C code that called them.

    The first one is raised at the end of the block ``with guard:`` around the call into C. ``stop``
    asks C to return.
    """

    def __init__(self, stop: Callable[[], Any] | None = None) -> None:
        self._stop, self._depth = stop or (lambda: None), 0
        self._error: BaseException | None = None

    def callback(self, function: Callable[..., Any], result: Any = 0) -> Callable[..., Any]:
        """Wrap a function for C, which gets ``result`` after an exception.

        Void functions of cffi need None.
        """

        # the wrapper of a decision function is not a decision function
        @wraps(function, updated=())
        def callback(*args: Any) -> Any:
            try:
                return function(*args) if self._error is None else result
            except BaseException as error:
                if not self._depth:
                    raise
                self._record(error)
            return result

        return callback

    def __enter__(self) -> None:
        if getattr(sys.unraisablehook, "func", None) is not _record_interrupt:
            sys.unraisablehook = partial(_record_interrupt, sys.unraisablehook)
        self._depth += 1

    def __exit__(self, *_: object) -> None:
        self._depth -= 1
        if self._error is not None:
            try:
                raise self._error
            finally:
                self._error = None

    def _record(self, error: BaseException) -> None:
        if self._error is None:
            self._error = error
            self._stop()


def _record_interrupt(print_error: Callable[[Any], Any], unraisable: Any) -> None:
    """Record Ctrl-C: it mostly arrives while C runs, and is raised before the first line of the next callback."""
    guard = unraisable.exc_traceback and unraisable.exc_traceback.tb_frame.f_locals.get("self")
    if isinstance(guard, CallbackGuard) and guard._depth:
        guard._record(unraisable.exc_value)
        guard._error = unraisable.exc_value  # also in place of an exit
    else:
        print_error(unraisable)
