"""Contexts: an environment's code on the user's side, with its own global generators; reused resources.

Models that draw from ``random`` and ``numpy.random`` share one state with the whole process. With ``global_rng=True``
an environment has a state of its own, which is in place while the environment runs; afterwards the state of whatever
ran before is restored.
"""

from __future__ import annotations

import random
import sys
from _random import Random as Twister
from collections.abc import Hashable
from contextlib import suppress
from contextvars import ContextVar
from copy import deepcopy
from ctypes import memmove, string_at
from os import getpid
from threading import RLock, current_thread, get_ident
from typing import Any, Final

import numpy as np

from ..errors import ReentrancyError, WrongThreadError
from ..hooks.stacks import SIMULATION, Evaluation, outside_simulation
from .rng import ENVIRONMENT, NUMPY, PYTHON, generator_of_torch, seed_globals


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
        """Prepare the context of an environment's plugins, generators and lock, where it has these.

        The driver is entered; without one, the simulation cannot be resumed inside.
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


# -- states of the global generators --------------------------------------------------------------

_HEADER: Final = object.__basicsize__
_WORDS: Final = 4 * 625  # bytes: the number of words that are used up, and the 624 words of a Mersenne twister
_legacy: Any = np.random  # NumPy's type stubs lack some of its functions


def _find_gauss() -> int:
    """Return the offset in NumPy's generator of the second normally distributed number, which it keeps.

    A flag before the number says whether there is one. 0: the generators do not have the expected memory layout.
    """
    if Twister.__basicsize__ < _HEADER + _WORDS:
        return 0
    generator, state = _legacy.get_bit_generator(), np.random.get_state(legacy=False)
    try:
        words = memoryview(string_at(id(PYTHON) + _HEADER, _WORDS)).cast("I")
        _legacy.set_bit_generator(np.random.MT19937(1))
        number = np.random.standard_normal(1) * 0 + _legacy.get_state(legacy=False)["gauss"]
        memory = string_at(id(NUMPY), type(NUMPY).__basicsize__)
        place = memory.find(number.tobytes()) - 8
        known = (*words[1:], words[0]) == random.getstate()[1] and place >= _HEADER
        return place if known and int.from_bytes(memory[place : place + 4], sys.byteorder) == 1 else 0
    except Exception:  # any error means that the layout differs
        return 0
    finally:
        _legacy.set_bit_generator(generator)
        np.random.set_state(state)


GAUSS_AT: Final = _find_gauss()
"""What ``_find_gauss`` returned. If it is not 0, states are copied as bytes, which takes a microsecond. Otherwise the
generators' own functions copy them, which takes 150 microseconds."""


def save_generators(*, copy: bool = False) -> tuple[Any, Any, Any]:
    """Return the state of the global generators: NumPy's bit generator, and what else the two hold.

    Other code that draws from a bit generator that is not copied changes the saved state.
    """
    generator = _legacy.get_bit_generator()
    if copy:
        generator = deepcopy(generator)
    if not GAUSS_AT:
        return generator, random.getstate(), np.random.get_state(legacy=False)
    words = string_at(id(PYTHON) + _HEADER, _WORDS)
    return generator, (words, PYTHON.gauss_next), string_at(id(NUMPY) + GAUSS_AT, 16)


def load_generators(state: tuple[Any, Any, Any]) -> None:
    """Put a saved state of the global generators in place."""
    generator, python, numpy = state
    _legacy.set_bit_generator(generator)  # this drops the number that NumPy keeps
    if GAUSS_AT:
        words, PYTHON.gauss_next = python
        memmove(id(PYTHON) + _HEADER, words, _WORDS)
        memmove(id(NUMPY) + GAUSS_AT, numpy, 16)
    else:
        random.setstate(python)
        np.random.set_state(numpy)


class GlobalRandom:
    """The context in which a simulation has its own state of the global generators."""

    _entered: Final[list[GlobalRandom]] = []

    def __init__(self) -> None:
        """Copy the present state, which is used until ``begin`` seeds it."""
        self._thread = 0
        self._outer: list[Any] = []
        outer = save_generators()
        if type(outer[0]) is not np.random.MT19937:
            _legacy.set_bit_generator(np.random.MT19937())  # ``numpy.random.seed`` can seed no other type
        self._own = save_generators(copy=True)
        load_generators(outer)

    def begin(self, seed: int) -> None:
        """Seed both generators, whose state must be in place, with the seed of an episode."""
        random.seed(seed)
        np.random.seed(seed % 2**32)

    def begin_anew(self, seed: int) -> None:
        """Seed the generators, whose state must be in place, for another future."""
        seed_globals(seed, ENVIRONMENT)

    def enter(self) -> None:
        """Put this state in place, unless another thread has put that of another environment in place."""
        thread = get_ident()
        nested = current_thread().name == SIMULATION  # its user waits in another thread meanwhile
        if self._entered and self._entered[-1]._thread != thread and not nested:
            raise WrongThreadError(
                "two environments with global_rng=True ran in two threads at once, but a process has only one state of"
                " the global generators; run them one after the other, or in separate processes"
            )
        self._thread = thread
        if self not in self._entered[-1:]:
            outer = save_generators()
            load_generators(self._own)
            self._outer.append(outer)
        self._entered.append(self)

    def leave(self) -> None:
        """Restore the state that was in place before."""
        self._entered.pop()
        if self not in self._entered[-1:]:
            self._own = save_generators()
            load_generators(self._outer.pop())

    def step_out(self) -> None:
        """Leave as often as this state was entered in a row."""
        while self in self._entered[-1:]:
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

_FREE: Final[ContextVar[dict[Hashable, list[Any]] | None]] = ContextVar("simenv_marl.free", default=None)
"""The free resources of the current block, by the arguments that made them. None outside of a block."""


class reuse_resources:  # noqa: N801 - as above
    """Reuse the resources of closed simulations for new ones, until the end of the block.

    Starting a process often takes longer than an episode. A resource has ``usable``, ``close_input()``, which asks it
    to end, and ``close()``, which waits for its end. Within another such block this does nothing.
    """

    def __enter__(self) -> None:
        self._token = _FREE.set({}) if _FREE.get() is None else None

    def __exit__(self, *error: object) -> None:
        if self._token is None:
            return
        resources = [resource for alike in (_FREE.get() or {}).values() for resource in alike]
        _FREE.reset(self._token)
        for resource in resources:  # first for all of them, so that they end at the same time
            resource.close_input()
        for resource in resources:
            resource.close()


def release(key: Hashable, resource: Any) -> bool:
    """Leave a resource to later simulations; return False if it is not usable, or if there is no block."""
    free = _FREE.get()
    if free is None or not resource.usable:
        return False
    free.setdefault(key, []).append(resource)
    return True


def acquire(key: Hashable) -> Any:
    """Return a usable resource that was released under an equal key; None if there is none."""
    alike = (_FREE.get() or {}).get(key, [])
    while alike:
        resource = alike.pop()
        if resource.usable:
            return resource
    return None
