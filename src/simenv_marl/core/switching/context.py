"""The context of an environment's code on the user's side: its lock, plugins and generators.

Models that draw from ``random`` and ``numpy.random`` share one state with the whole process. With
``global_rng=True`` an environment has a state of its own, which is in place while the environment
runs.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from os import getpid
from threading import RLock, current_thread, get_ident
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from numpy.random import MT19937, RandomState

from ...errors import ReentrancyError, WrongThreadError
from ...hooks.stacks import SIMULATION, outside_simulation
from ...plugins import Plugins
from .generators import LEGACY, NUMPY, generator_of_torch

if TYPE_CHECKING:
    from .driver import Driver


class ExclusiveLock:
    """A lock for an environment that any thread may use, but only one at a time.

    One thread may enter it repeatedly.
    """

    def __init__(self) -> None:
        self._lock = RLock()
        self._process = getpid()

    @property
    def held(self) -> bool:
        """Whether the current thread uses the environment."""
        # The method is private, but ``threading.Condition`` relies on it, too.
        is_owned: bool = self._lock._is_owned()  # type: ignore[attr-defined]
        return is_owned and self._process == getpid()

    def __enter__(self) -> None:
        if self._process != getpid():  # after a fork, the thread that held the lock may not exist
            self._lock = RLock()
            self._process = getpid()
        try:
            acquired = self._lock.acquire(blocking=False)
        except BaseException:  # an interrupt
            with suppress(RuntimeError):
                self._lock.release()
            raise
        if not acquired:
            raise ReentrancyError(
                "the environment was used from inside its own simulation, or while another thread"
                " was stepping, resetting or closing it; any thread may use it, but one at a time"
            )

    def __exit__(self, *error: object) -> None:
        self._lock.release()


class environment_context(outside_simulation):  # noqa: N801 - it is used like a function
    """Run code of an environment in its own context, with its plugins and random generators.

    All code that runs for an environment on the user's side needs this context. Only steps in which
    ``getcurrent()`` is the driver's ``caller`` and ``EVALUATING`` is empty do without it.
    """

    __slots__ = ("_lock", "_rng", "_simulation")

    def __init__(
        self,
        plugins: Plugins | None,
        rng: GlobalRandom | None,
        lock: ExclusiveLock | None = None,
        driver: Driver | None = None,
    ) -> None:
        """Prepare the context. Without a driver, the simulation cannot be resumed inside."""
        super().__init__(plugins)
        self._rng = rng
        self._lock = lock
        self._simulation = driver

    def __enter__(self) -> None:
        if self._lock is not None:
            self._lock.__enter__()
        try:
            super().__enter__()
            if self._simulation is not None:
                # With generators of its own, each step must enter this context.
                self._simulation.enter(direct=self._rng is None)
            if self._rng is not None:
                self._rng.enter()
        except BaseException:
            self._rng = None  # it was not entered
            self.__exit__()
            raise

    def __exit__(self, *error: object) -> None:
        try:
            if self._rng is not None:
                self._rng.leave()
        finally:
            super().__exit__()
            if self._lock is not None:
                self._lock.__exit__()


# -- states of the global generators --------------------------------------------------------------


def save_generators(generator: RandomState = NUMPY) -> Callable[[], None]:
    """Return a function that puts the present state of the global generators in place.

    This is Python's state, and NumPy's or that of another generator for NumPy: its bit generator,
    and its state with the bits that it has drawn in advance.
    """
    python = random.getstate()
    bits = generator._bit_generator
    numpy = generator.get_state(legacy=False)

    def load() -> None:
        random.setstate(python)
        LEGACY.set_bit_generator(bits)
        NUMPY.set_state(numpy)

    return load


class _Entry(NamedTuple):
    """A state that was put in place: whose it is, in which thread, and the state before."""

    owner: GlobalRandom
    thread: int
    before: Callable[[], None] | None


class GlobalRandom:
    """The context in which a simulation has its own state of the global generators."""

    _entered: Final[list[_Entry]] = []

    def __init__(self) -> None:
        """Copy the present state, which is used until ``begin`` seeds it."""
        own = RandomState(MT19937())  # ``numpy.random.seed`` can seed no other type
        with suppress(ValueError):  # the user's bits are of another type
            own.set_state(NUMPY.get_state(legacy=False))
        self._load_own = save_generators(own)

    @staticmethod
    def begin(seed: int) -> None:
        """Seed the generators that are in place with the seed of an episode."""
        random.seed(seed)
        np.random.seed(seed % 2**32)

    def enter(self) -> None:
        """Put this state in place, unless another thread has put that of an environment there."""
        thread = get_ident()
        entered = self._entered
        is_nested = current_thread().name == SIMULATION  # its user waits in another thread
        if entered and entered[-1].thread != thread and not is_nested:
            raise WrongThreadError(
                "two environments with global_rng=True ran in two threads at once, but a process"
                " has only one state of the global generators; run them one after the other, or in"
                " separate processes"
            )
        before = None
        if not entered or entered[-1].owner is not self:
            before = save_generators()
            self._load_own()
        entered.append(_Entry(self, thread, before))

    def leave(self) -> None:
        """Restore the state that was in place before."""
        before = self._entered.pop().before
        if before is not None:
            self._load_own = save_generators()
            before()

    def leave_all(self) -> None:
        """Leave as often as this state was entered in a row."""
        while self._entered and self._entered[-1].owner is self:
            self.leave()


class preserve_generators:  # noqa: N801 - it is used like a function
    """Restore the global generators of the process on exit: Python's, NumPy's and torch's.

    This is a class because the context manager of a generator cannot pass on immutable errors.
    """

    def __enter__(self) -> None:
        torch = generator_of_torch()
        self._loads = [save_generators()]
        if torch is not None:
            self._loads.append(partial(torch.set_state, torch.get_state()))

    def __exit__(self, *error: object) -> None:
        for load in self._loads:
            load()
