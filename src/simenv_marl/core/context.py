"""Contexts: an environment's code on the user's side, with its own global generators.

Reused resources.

Models that draw from ``random`` and ``numpy.random`` share one state with the whole process. With
``global_rng=True`` an environment has a state of its own, which is in place while the environment
runs.
"""

from __future__ import annotations

import random
from _random import Random as Twister
from contextlib import suppress
from contextvars import ContextVar
from copy import deepcopy
from ctypes import memmove, string_at
from os import getpid
from threading import RLock, current_thread, get_ident
from types import SimpleNamespace
from typing import Any, Final

import numpy as np

from ..errors import ReentrancyError, WrongThreadError
from ..hooks.stacks import SIMULATION, outside_simulation
from .rng import LEGACY, NUMPY, PYTHON, generator_of_torch


class ExclusiveLock:
    """A lock for an environment that any thread may use, but only one at a time.

    One thread may enter it repeatedly.
    """

    def __init__(self) -> None:
        # ``_is_owned`` is private, but ``threading.Condition`` relies on it, too
        self._lock: Any = RLock()
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
                "the environment was used from inside its own simulation, or while another thread"
                " was stepping, resetting or closing it; any thread may use it, but one at a time"
            )

    def __exit__(self, *error: object) -> None:
        self._lock.release()


class environment_context(outside_simulation):  # noqa: N801 - it is used like a function
    """Run code of an environment in its own context, with its plugins and random generators.

    All code that runs for an environment on the user's side needs this context. The exception are
    steps in which ``getcurrent()`` is the driver's ``caller`` and ``EVALUATING`` is empty.
    """

    __slots__ = ("_enters", "_lock", "_rng")

    def __init__(
        self,
        evaluation: Any,
        rng: GlobalRandom | None,
        lock: ExclusiveLock | None = None,
        driver: Any = None,
    ) -> None:
        """Prepare the context.

        The driver is entered; without one, the simulation cannot be resumed inside.
        """
        super().__init__(evaluation)
        self._rng, self._lock, self._enters = rng, lock, driver

    def __enter__(self) -> None:
        if self._lock is not None:
            self._lock.__enter__()
        try:
            super().__enter__()
            if self._enters is not None:
                self._enters.enter()
            if self._rng is not None:
                if self._enters is not None:
                    # each step must enter the generators, and so is never direct
                    self._enters.caller = None
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

_HEADER: Final = object.__basicsize__
# bytes: the number of words that are used up, and the 624 words of a Mersenne twister
_WORDS: Final = 4 * 625


def _is_layout_known() -> bool:
    """Return whether the words of Python's generator are where they are expected in the memory."""
    if Twister.__basicsize__ < _HEADER + _WORDS:
        return False
    words = memoryview(string_at(id(PYTHON) + _HEADER, _WORDS)).cast("I")
    return bool((*words[1:], *words[:1]) == random.getstate()[1])


IS_COPIED: Final = _is_layout_known()
"""Whether the state of Python's generator is copied as bytes, which is ten times as fast as its own functions."""

_NO_BITS: Final = SimpleNamespace()
"""Takes the place of NumPy's bit generator, which takes long to copy, while the normal number beside it is copied."""


def save_generators(*, copy: bool = False) -> tuple[Any, Any, Any]:
    """Return the state of the global generators: NumPy's bit generator, and what else the two hold.

    Other code that draws from a bit generator that is not copied changes the saved state.
    """
    generator = NUMPY._bit_generator
    python = (
        (string_at(id(PYTHON) + _HEADER, _WORDS), PYTHON.gauss_next)
        if IS_COPIED
        else random.getstate()
    )
    _NO_BITS.state = {"bit_generator": "", "state": None}
    try:
        NUMPY._bit_generator = _NO_BITS
        kept = NUMPY.get_state(legacy=False)
    finally:
        NUMPY._bit_generator = generator
    return deepcopy(generator) if copy else generator, python, kept


def load_generators(state: tuple[Any, Any, Any]) -> None:
    """Put a saved state of the global generators in place."""
    generator, python, kept = state
    if IS_COPIED:
        words, PYTHON.gauss_next = python
        memmove(id(PYTHON) + _HEADER, words, _WORDS)
    else:
        random.setstate(python)
    LEGACY.set_bit_generator(generator)  # this drops the number that NumPy keeps
    try:
        NUMPY._bit_generator = _NO_BITS
        NUMPY.set_state(kept)
    finally:
        NUMPY._bit_generator = generator


class GlobalRandom:
    """The context in which a simulation has its own state of the global generators."""

    # each with its thread and the state before
    _entered: Final[list[tuple[GlobalRandom, int, Any]]] = []

    def __init__(self) -> None:
        """Copy the present state, which is used until ``begin`` seeds it."""
        generator, *others = save_generators(copy=True)
        if type(generator) is not np.random.MT19937:
            generator = np.random.MT19937()  # ``numpy.random.seed`` can seed no other type
        self._own: Any = generator, *others

    def begin(self, seed: int) -> None:
        """Seed both generators, whose state must be in place, with the seed of an episode."""
        random.seed(seed)
        np.random.seed(seed % 2**32)

    def enter(self) -> None:
        """Put this state in place, unless another thread has put that of another environment in place."""
        thread, present = get_ident(), None
        nested = current_thread().name == SIMULATION  # its user waits in another thread meanwhile
        if self._entered and self._entered[-1][1] != thread and not nested:
            raise WrongThreadError(
                "two environments with global_rng=True ran in two threads at once, but a process"
                " has only one state of the global generators; run them one after the other, or in"
                " separate processes"
            )
        if not self._entered or self._entered[-1][0] is not self:
            present = save_generators()
            load_generators(self._own)
        self._entered.append((self, thread, present))

    def leave(self) -> None:
        """Restore the state that was in place before."""
        before = self._entered.pop()[2]
        if before is not None:
            self._own = save_generators()
            load_generators(before)

    def step_out(self) -> None:
        """Leave as often as this state was entered in a row."""
        while self._entered and self._entered[-1][0] is self:
            self.leave()


class preserve_generators:  # noqa: N801 - it is used like a function; not a generator: immutable errors cannot pass one
    """Restore the global generators of the process on exit: Python's, NumPy's, and torch's if it is imported."""

    def __enter__(self) -> None:
        torchs = generator_of_torch()
        self._torch = None if torchs is None else torchs.get_state()
        self._state = save_generators()
        load_generators(save_generators(copy=True))

    def __exit__(self, *error: object) -> None:
        load_generators(self._state)
        if self._torch is not None:
            generator_of_torch().set_state(self._torch)


# -- resources that several simulations use -------------------------------------------------------

_FREE: Final[ContextVar[list[tuple[Any, Any]] | None]] = ContextVar(
    "simenv_marl.free", default=None
)
"""The free resources of the current block, with what identifies those that are alike.

None outside of a block.
"""


class reuse_resources:  # noqa: N801 - as above
    """Reuse the resources of closed simulations for new ones, until the end of the block.

    Starting a process often takes longer than an episode. A resource has ``usable``,
    ``close_input()``, which asks it to end, and ``close()``, which waits for its end. Within
    another such block this does nothing.
    """

    def __enter__(self) -> None:
        self._token = _FREE.set([]) if _FREE.get() is None else None

    def __exit__(self, *error: object) -> None:
        if self._token is not None:
            free = _FREE.get() or []
            _FREE.reset(self._token)
            for _, resource in free:  # first for all of them, so that they end at the same time
                resource.close_input()
            for _, resource in free:
                resource.close()


def release(key: Any, resource: Any) -> bool:
    """Leave a resource to later simulations.

    Return False if it is not usable, or if there is no block.
    """
    free = _FREE.get()
    if free is None or not resource.usable:
        return False
    free.append((key, resource))
    return True


def acquire(key: Any) -> Any:
    """Return a resource that was released under an equal key; None if there is none."""
    free = _FREE.get() or []
    return next(
        (free.pop(number)[1] for number, (other, _) in enumerate(free) if other == key), None
    )
