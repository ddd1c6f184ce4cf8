"""The context in which an environment's code runs on the user's side: plugins, generators, claim and driver."""

from __future__ import annotations

import os
from contextlib import suppress
from threading import RLock
from typing import Any

from ..errors import ReentrancyError
from ..hooks.stacks import Evaluation, outside_simulation
from .rng import GlobalRandom


class Claim:
    """A lock for an environment that any thread may use, but only one at a time."""

    def __init__(self) -> None:
        # ``_is_owned`` is private, but ``threading.Condition`` relies on it, too.
        self._lock: Any = RLock()
        self._process = os.getpid()

    @property
    def held(self) -> bool:
        """Whether the current thread uses the environment."""
        owned: bool = self._lock._is_owned()
        return owned and self._process == os.getpid()

    def __enter__(self) -> None:
        if self._process != os.getpid():  # after a fork, the thread that held the lock may not exist
            self._lock, self._process = RLock(), os.getpid()
        try:
            claimed = self._lock.acquire(blocking=False)
        except BaseException:  # an interrupt
            with suppress(RuntimeError):
                self._lock.release()
            raise
        if not claimed:
            raise ReentrancyError(
                "the environment was used from inside its own simulation, or while another thread was stepping,"
                " resetting or closing it; any thread may use it, but one at a time"
            )

    def __exit__(self, *error: object) -> None:
        self._lock.release()


class at_work(outside_simulation):  # noqa: N801 - it is used like a function
    """Run code of an environment in its own context, with its plugins and random generators.

    All code that runs for an environment on the user's side needs this context. The exception are steps in which
    ``getcurrent()`` is the driver's ``caller`` and ``EVALUATING`` is empty.
    """

    __slots__ = ("_claim", "_driver", "_rng")

    def __init__(
        self,
        evaluation: Evaluation | None = None,
        rng: GlobalRandom | None = None,
        claim: Claim | None = None,
        driver: Any = None,
    ) -> None:
        """Prepare the context.

        Args:
            evaluation: The environment's plugins. None if it has none.
            rng: The environment's own state of the global generators. None if it has none.
            claim: The lock that lets one thread at a time use the environment. None if only one thread can use it.
            driver: The driver to enter, if the simulation is going to be resumed. None if it is not.
        """
        super().__init__(evaluation)
        self._rng, self._claim, self._driver = rng, claim, driver

    def __enter__(self) -> None:
        if self._claim is not None:
            self._claim.__enter__()
        try:
            super().__enter__()
            try:
                if self._driver is not None:
                    self._driver.enter()
                if self._rng is not None:
                    self._rng.enter()
            except BaseException:
                super().__exit__()
                raise
        except BaseException:
            if self._claim is not None:
                self._claim.__exit__()
            raise

    def __exit__(self, *error: object) -> None:
        try:
            if self._rng is not None:
                self._rng.leave()
        finally:
            super().__exit__()
            if self._claim is not None:
                self._claim.__exit__()
