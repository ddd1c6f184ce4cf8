"""Callbacks that C code calls: an exception in one of them is raised where C was called."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial, wraps

from ..simulation import Model


class CallbackGuard:
    """Carries exceptions of callbacks (errors, Ctrl-C, the exit from an episode) past the C code.

    The first one is raised at the end of the block ``with guard:`` around the call into C. ``stop``
    asks C to return.
    """

    def __init__(self, stop: Callable[[], object] | None = None) -> None:
        self._stop = stop or (lambda: None)
        self._depth = 0
        self._error: BaseException | None = None

    def callback(self, function: Callable[..., Model], result: Model = 0) -> Callable[..., Model]:
        """Wrap a function for C, which gets ``result`` after an exception.

        Void functions of cffi need None.
        """

        # ``updated=()``, because the wrapper of a decision function is not a decision function
        @wraps(function, updated=())
        def callback(*args: Model) -> Model:
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

    def _record(self, error: BaseException, replace: bool = False) -> None:
        """Record the first exception and stop C, or replace the first exception."""
        if self._error is None:
            self._error = error
            self._stop()
        elif replace:
            self._error = error


def _record_interrupt(
    print_error: Callable[[sys.UnraisableHookArgs], object], unraisable: sys.UnraisableHookArgs
) -> None:
    """Record Ctrl-C with the guard of its callback; print other errors.

    Ctrl-C mostly arrives while C runs. Python raises it before the first line of the next callback,
    and passes it to this hook.
    """
    traceback = unraisable.exc_traceback
    error = unraisable.exc_value
    guard = traceback and traceback.tb_frame.f_locals.get("self")
    if isinstance(guard, CallbackGuard) and guard._depth and error:
        guard._record(error, replace=True)  # even in place of the exit from an episode
    else:
        print_error(unraisable)
