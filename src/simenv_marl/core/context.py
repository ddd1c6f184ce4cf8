"""The context in which an environment's code runs on the user's side."""

from __future__ import annotations

from contextlib import suppress
from os import getpid
from threading import RLock
from typing import Any

from ..errors import ReentrancyError
from ..hooks.stacks import Evaluation, outside_simulation
from .rng import GlobalRandom


class ExclusiveLock:
    """A lock for an environment that any thread may use, but only one at a time. One thread may enter it repeatedly."""

    def __init__(self) -> None:
        self._lock: Any = RLock()  # ``_is_owned`` is private, but ``threading.Condition`` relies on it, too
        self._process = getpid()

    @property
    def held(self) -> bool:
        """Whether the current thread uses the environment."""
        return bool(self._lock._is_owned()) and self._process == getpid()

    def __enter__(self) -> None:
        if self._process != getpid():  # after a fork, the thread that held the lock may not exist
            self._lock, self._process = RLock(), getpid()
        try:
            acquired = self._lock.acquire(blocking=False)
        except BaseException:  # an interrupt
            with suppress(RuntimeError):
                self._lock.release()
            raise
        if not acquired:
            raise ReentrancyError(
                "the environment was used from inside its own simulation, or while another thread was stepping,"
                " resetting or closing it; any thread may use it, but one at a time"
            )

    def __exit__(self, *error: object) -> None:
        self._lock.release()


class environment_context(outside_simulation):  # noqa: N801 - it is used like a function
    """Run code of an environment in its own context, with its plugins and random generators.

    All code that runs for an environment on the user's side needs this context. The exception are steps in which
    ``getcurrent()`` is the driver's ``caller`` and ``EVALUATING`` is empty.
    """

    __slots__ = ("_enters", "_lock", "_rng")

    def __init__(
        self,
        evaluation: Evaluation | None = None,
        rng: GlobalRandom | None = None,
        lock: ExclusiveLock | None = None,
        driver: Any = None,
    ) -> None:
        """Prepare the context.

        Args:
            evaluation: The environment's plugins. None if it has none.
            rng: The environment's own state of the global generators. None if it has none.
            lock: The lock that lets one thread at a time use the environment. None if only one thread can use it.
            driver: The driver to enter, if the simulation is going to be resumed. None if it is not.
        """
        super().__init__(evaluation)
        self._rng, self._lock, self._enters = rng, lock, driver

    def __enter__(self) -> None:
        if self._lock is not None:
            self._lock.__enter__()
        try:
            super().__enter__()
            try:
                if self._enters is not None:
                    self._enters.enter()
                if self._rng is not None:
                    self._rng.enter()
            except BaseException:
                super().__exit__()
                raise
        except BaseException:
            if self._lock is not None:
                self._lock.__exit__()
            raise

    def __exit__(self, *error: object) -> None:
        try:
            if self._rng is not None:
                self._rng.leave()
        finally:
            super().__exit__()
            if self._lock is not None:
                self._lock.__exit__()
