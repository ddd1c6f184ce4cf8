"""Separate states of Python's and NumPy's global random generators, for environments that ask for them.

Models that draw from ``random`` and ``numpy.random`` share one state with the whole process. With ``global_rng=True``
an environment has a state of its own, which is in place while the environment runs; afterwards the state of whatever
ran before is restored.
"""

from __future__ import annotations

import random
from _random import Random as Twister
from collections.abc import Callable
from ctypes import memmove, string_at
from sys import modules
from threading import current_thread, get_ident
from threading import enumerate as enumerate_threads
from time import process_time_ns, thread_time_ns
from typing import Any, Final
from weakref import WeakSet

import numpy as np

from ..errors import WrongThreadError, warn_user
from ..hooks.stacks import SIMULATION

_python: Any = random.seed.__self__  # type: ignore[attr-defined]  # the generator behind the functions of ``random``
_numpy: Any = np.random.mtrand._rand
_legacy: Any = np.random  # NumPy's type stubs lack some of its functions

_HEADER: Final = object.__basicsize__
_WORDS: Final = 4 * 625  # bytes: the 624 words of a Mersenne twister, and the number of words that are used up


class _State:
    """A saved state of the global generators.

    Where the generators have the expected memory layout, their state is copied as bytes, which takes a microsecond.
    Otherwise their own functions save and load it, which takes 150 microseconds.
    """

    gauss_at = 0
    """The offset in NumPy's generator of the second normally distributed number, which it keeps for the next call. 0:
    the layout is not the expected one."""

    def save(self) -> None:
        """Save the state that is in place."""
        self._generator = _legacy.get_bit_generator()
        if _State.gauss_at:
            self._python: Any = string_at(id(_python) + _HEADER, _WORDS), _python.gauss_next
            self._gauss: Any = string_at(id(_numpy) + self.gauss_at, 16)
        else:
            self._python, self._gauss = random.getstate(), np.random.get_state(legacy=False)

    def load(self) -> None:
        """Put the saved state in place."""
        _legacy.set_bit_generator(self._generator)  # this drops the number that NumPy keeps
        if _State.gauss_at:
            words, _python.gauss_next = self._python
            memmove(id(_python) + _HEADER, words, _WORDS)
            memmove(id(_numpy) + self.gauss_at, self._gauss, 16)
        else:
            random.setstate(self._python)
            np.random.set_state(self._gauss)

    def separate(self) -> None:
        """Copy the bit generator, so that other code that draws from it does not change the saved state.

        A generator of another type is replaced: ``numpy.random.seed`` can seed a Mersenne twister only.
        """
        twister = np.random.MT19937()
        if type(self._generator) is np.random.MT19937:
            twister.state = self._generator.state
        self._generator = twister
        if not _State.gauss_at:
            self._gauss |= twister.state


def _find_gauss() -> int:
    """Return ``_State.gauss_at``: test whether a state that is copied as bytes is exact. Leave the generators alone."""
    before, copied = random.getstate(), np.random.get_state(legacy=False)
    generator = _legacy.get_bit_generator()
    try:
        _legacy.set_bit_generator(np.random.MT19937(1))
        kept = _legacy.standard_normal(1) * 0 + _legacy.get_state(legacy=False)["gauss"]
        place = string_at(id(_numpy), type(_numpy).__basicsize__).find(kept.tobytes())
        if place < 8 + _HEADER or Twister.__basicsize__ not in range(_WORDS, _WORDS + 64):
            return 0
        _State.gauss_at = place - 8  # the flag before it says whether a number is kept
        random.gauss(0, 1)
        state = _State()
        state.save()
        state.separate()
        first = _draws()
        state.load()
        return _State.gauss_at if first == _draws() else 0
    except Exception:  # any error means that the layout differs
        return 0
    finally:
        _legacy.set_bit_generator(generator)
        np.random.set_state(copied)
        random.setstate(before)


def _draws() -> list[float]:
    """Draw from both generators; then seed them differently."""
    drawn = [random.gauss(0, 1), np.random.standard_normal(), random.random(), np.random.random()]
    drawn += [random.gauss(0, 1), np.random.standard_normal()]
    random.seed(2)
    np.random.seed(2)
    np.random.standard_normal()
    return drawn


_State.gauss_at = _find_gauss()


class GlobalRandom:
    """The context in which a simulation has its own state of the global generators."""

    _entered: Final[list[GlobalRandom]] = []

    def __init__(self) -> None:
        """Copy the present state, which is used until ``begin`` seeds it."""
        self._own, self._thread = _State(), 0
        self._outer: list[_State] = []
        self._own.save()
        self._own.separate()

    def begin(self, seed: int) -> None:
        """Seed both generators, whose state must be in place, with the seed of an episode."""
        random.seed(seed)
        np.random.seed(seed % 2**32)

    def begin_anew(self, seed: int) -> None:
        """Seed the generators, whose state must be in place, for another future."""
        _seed_globals(seed, _OWN)

    def enter(self) -> None:
        """Put this state in place.

        Raises:
            WrongThreadError: The state of another environment, which runs in another thread, is in place.
        """
        thread = get_ident()
        nested = current_thread().name == SIMULATION  # its user waits in another thread meanwhile
        if self._entered and self._entered[-1]._thread != thread and not nested:
            raise WrongThreadError(
                "two environments with global_rng=True ran in two threads at once, but a process has only one state of"
                " the global generators; run them one after the other, or in separate processes"
            )
        self._thread = thread
        if self not in self._entered[-1:]:
            outer = _State()
            outer.save()
            self._own.load()
            self._outer.append(outer)
        self._entered.append(self)

    def leave(self) -> None:
        """Restore the state that was in place before."""
        self._entered.pop()
        if self not in self._entered[-1:]:
            self._own.save()
            self._outer.pop().load()

    def step_out(self) -> None:
        """Leave as often as this state was entered in a row."""
        while self in self._entered[-1:]:
            self.leave()


# -- simulations that draw from the generators of the process ---------------------------------------

_CHECKED: Final[WeakSet[type]] = WeakSet()
"""The classes of simulations that were checked."""

TOO_SHORT: Final = 100_000
"""A time in nanoseconds. Another thread that wakes up and draws runs for longer; the clocks differ by less."""


def draws_check(simulation: Any, *, in_thread: bool) -> Callable[[], None] | None:
    """Begin to check whether a simulation draws from the global generators.

    Args:
        simulation: The simulation.
        in_thread: Whether it runs in a thread of its own, beside which other threads of the user may run.

    Returns:
        A function that ends the check, and warns if the simulation has drawn. None if its class was checked before.
    """
    kind = type(simulation)
    if kind in _CHECKED:
        return None
    states, time = global_states(), _time_of_others()

    def warn_of_draws() -> None:
        _CHECKED.add(kind)
        names = [name for name, state in global_states().items() if state != states[name]]
        alone = all(thread is current_thread() or thread.name == SIMULATION for thread in enumerate_threads())
        if names and (alone or (not in_thread and _time_of_others() - time < TOO_SHORT)):
            warn_user(
                f"{kind.__name__} draws from the global generator of {' and '.join(names)}, which all code in the"
                " process shares: its environments influence each other, and a seed does not repeat an episode. Make"
                " them with global_rng=True"
            )

    return warn_of_draws


def global_states() -> dict[str, Any]:
    """Return values that change when a number is drawn from Python's or NumPy's global generator."""
    return {"random": random.getstate(), "numpy.random": repr(_legacy.get_bit_generator().state)}


def _time_of_others() -> int:
    """The time in nanoseconds for which all other threads have run."""
    return process_time_ns() - thread_time_ns()


# -- other futures --------------------------------------------------------------------------------

_FUTURES: Final = 2**32 - 1
"""The spawn key of the seeds of futures. A model that uses the same seed, or spawns from it, never gets this key."""

_OWN: Final = 0
_PROCESS: Final = 1
HELD: Final = 2
"""Whose generators are seeded: the three have separate streams. A base policy that draws from the generators of the
process must not get the same numbers as the simulation."""

SHARED: Final = (_python, _numpy)
"""The generators behind the functions of ``random`` and ``numpy.random``."""


def is_seed(value: Any) -> bool:
    """Whether a value is a non-negative integer."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool) and bool(value >= 0)


def streams(seed: int, whose: int, number: int) -> list[np.random.SeedSequence]:
    """Make the seeds of some number of generators for a future."""
    return np.random.SeedSequence(int(seed), spawn_key=(_FUTURES, whose)).spawn(number)


def reseed_one(generator: Any, stream: np.random.SeedSequence) -> None:
    """Seed a generator in place, so that all references to it see the new state.

    Args:
        generator: A ``random.Random``, or NumPy's ``Generator``, ``RandomState`` or ``BitGenerator``.
        stream: The seed.
    """
    if isinstance(generator, random.Random):
        generator.seed(_integer(stream))
        return
    legacy = isinstance(generator, np.random.RandomState)
    bits = getattr(generator, "_bit_generator" if legacy else "bit_generator", generator)
    bits.__setstate__(type(bits)(stream).__getstate__())  # new NumPy: the seed sequence for ``spawn``, too
    if legacy:
        generator.set_state(bits.state)  # this drops the second normally distributed number


def _integer(stream: np.random.SeedSequence) -> int:
    return int(stream.generate_state(1, np.uint64)[0])


def _seed_globals(seed: int, whose: int) -> np.random.SeedSequence:
    """Seed Python's and NumPy's global generators for a future from separate streams; return a third stream."""
    python, numpy, another = streams(seed, whose, 3)
    reseed_one(_python, python)
    _legacy.set_bit_generator(type(_legacy.get_bit_generator())(numpy))  # leaves the old bit generator as it is
    return another


def seed_process(seed: int) -> None:
    """Seed the global generators of the process for a future: Python's, NumPy's, and torch's if it is imported."""
    another, torchs = _seed_globals(seed, _PROCESS), _generator_of_torch()
    if torchs is not None:
        torchs.manual_seed(_integer(another))


class process_kept:  # noqa: N801 - it is used like a function
    """Restore the global generators of the process on exit.

    This is a class, as ``outside_simulation`` is, because some errors cannot pass through a generator-based context
    manager.
    """

    def __enter__(self) -> None:
        torchs = _generator_of_torch()
        self._python, self._numpy = random.getstate(), np.random.get_state(legacy=False)
        self._generator = _legacy.get_bit_generator()
        self._torch = None if torchs is None else torchs.get_state()

    def __exit__(self, *error: object) -> None:
        random.setstate(self._python)
        _legacy.set_bit_generator(self._generator)
        np.random.set_state(self._numpy)
        if self._torch is not None:
            _generator_of_torch().set_state(self._torch)


def _generator_of_torch() -> Any:
    return getattr(modules.get("torch"), "default_generator", None)
