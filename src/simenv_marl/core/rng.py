"""Separate states of Python's and NumPy's global random generators, for environments that ask for them.

Models that draw from ``random`` and ``numpy.random`` share one state with the whole process. With ``global_rng=True``
an environment has a state of its own, which is in place while the environment runs; afterwards the user's state is
restored. The *owner* of the generators is the one whose state is in place. There always is exactly one owner.
"""

from __future__ import annotations

import random
from _random import Random as Twister
from collections.abc import Callable
from ctypes import c_char, memmove, string_at
from sys import modules
from threading import get_ident
from typing import Any, Final, Protocol

import numpy as np

from ..errors import WrongThreadError

_HEADER: Final = object.__basicsize__
_WORDS: Final = 4 * 625  # bytes: the 624 words of a Mersenne twister, and the number of words that are used up

_KEY: Final = 4 * 624
"""The size, in bytes, of the words of a Mersenne twister. The number of used words follows them in memory."""

_UNKNOWN: Final = (c_char * 4)()

_python: Any = random.seed.__self__  # type: ignore[attr-defined]  # the generator behind the functions of ``random``
_numpy: Any = np.random.mtrand._rand
_legacy: Any = np.random  # NumPy's type stubs lack some of its functions


class State(Protocol):
    """A saved state of the global generators."""

    def save(self) -> None:
        """Save the state that is in place."""

    def load(self) -> None:
        """Put the saved state in place."""

    def separate(self) -> None:
        """Copy the bit generator, so that other code that draws from it does not change the saved state."""


class PortableState:
    """A state that the generators' own functions save and load. This takes about 150 microseconds."""

    def save(self) -> None:
        """Save the state that is in place."""
        self._python, self._generator = random.getstate(), _legacy.get_bit_generator()
        self._numpy = np.random.get_state(legacy=False)

    def load(self) -> None:
        """Put the saved state in place."""
        random.setstate(self._python)
        _legacy.set_bit_generator(self._generator)
        np.random.set_state(self._numpy)

    def separate(self) -> None:
        """Copy the bit generator."""
        self._generator = _copied(self._generator)
        self._numpy |= self._generator.state  # a new state if the user has set a bit generator of another type


class SwiftState:
    """A state that is saved and loaded by copying memory. This takes about a microsecond; ``_is_swift`` tests it."""

    gauss_at = 0
    """The offset in NumPy's generator of the second normally distributed number, which it keeps for the next call."""

    def save(self) -> None:
        """Save the state that is in place."""
        self._python = string_at(id(_python) + _HEADER, _WORDS)
        self._next = _python.gauss_next
        self._generator = _legacy.get_bit_generator()
        self._gauss = string_at(id(_numpy) + self.gauss_at, 16)

    def load(self) -> None:
        """Put the saved state in place."""
        memmove(id(_python) + _HEADER, self._python, _WORDS)
        _python.gauss_next = self._next
        _legacy.set_bit_generator(self._generator)  # this drops the number that NumPy keeps
        memmove(id(_numpy) + self.gauss_at, self._gauss, 16)

    def separate(self) -> None:
        """Copy the bit generator."""
        self._generator = _copied(self._generator)


def _is_swift() -> bool:
    """Test whether the generators have the expected memory layout. Leave their state unchanged."""
    before, swift = PortableState(), SwiftState()
    before.save()
    try:
        random.seed(1)
        np.random.seed(1)
        kept = _legacy.standard_normal(1) * 0 + _legacy.get_state(legacy=False)["gauss"]
        place = string_at(id(_numpy), type(_numpy).__basicsize__).find(kept.tobytes())
        if place < 8 + _HEADER or Twister.__basicsize__ not in range(_WORDS, _WORDS + 64):
            return False
        SwiftState.gauss_at = place - 8  # the flag before it says whether a number is kept
        random.gauss(0, 1)
        found = _draws(swift)
        swift.load()
        return found == _draws(None)
    except Exception:  # any error means that the layout differs
        return False
    finally:
        before.load()


def _draws(saved: State | None) -> list[float]:
    """Save a state and draw from both generators; then seed them differently."""
    if saved is not None:
        saved.save()
        saved.separate()
    drawn = [random.gauss(0, 1), np.random.standard_normal(), random.random(), np.random.random()]
    drawn += [random.gauss(0, 1), np.random.standard_normal()]
    random.seed(2)
    np.random.seed(2)
    np.random.standard_normal()
    return drawn


def _copied(generator: Any) -> Any:
    """Copy a Mersenne twister, or make a new one if the generator is of another type.

    ``numpy.random.seed`` can seed a Mersenne twister only.
    """
    twister = np.random.MT19937()
    if type(generator) is np.random.MT19937:
        twister.state = generator.state
    return twister


_State: Final[Callable[[], State]] = SwiftState if _is_swift() else PortableState


class _Used:
    """A reader of how many of the numbers that the generators have made in advance are used up."""

    def __init__(self) -> None:
        self._python = (c_char * 4).from_address(id(_python) + _HEADER) if _State is SwiftState else _UNKNOWN
        self._generator: Any = None
        self._numpy = _UNKNOWN

    def __call__(self) -> tuple[bytes, bytes]:
        generator = _numpy._bit_generator
        if generator is not self._generator:
            known = type(generator) is np.random.MT19937
            self._numpy = (c_char * 4).from_address(generator.ctypes.state_address + _KEY) if known else _UNKNOWN
            self._generator = generator
        return self._python.raw, self._numpy.raw


used_up: Final = _Used()
"""Returns four bytes for Python's global generator and four for NumPy's. They change when a number is drawn."""


class _Owner:
    """An owner of the global generators, with a state of its own.

    Attributes:
        state: The owner's state, while it is not in place.
        threads: The identifiers of the threads in which the owner's code may run.
    """

    def __init__(self) -> None:
        self.state = _State()
        self.threads: set[int] = set()


_owners: Final = [_Owner()]
"""The stack of owners. The first is the user; the last is the present owner."""


class GlobalRandom:
    """The context in which a simulation has its own state of the global generators."""

    def __init__(self) -> None:
        """Copy the present state, which is used until ``begin`` seeds it."""
        self._owner = _Owner()
        self._owner.state.save()
        self._owner.state.separate()

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
        thread, now = get_ident(), _owners[-1]
        if len(_owners) > 1 and thread not in now.threads:
            raise WrongThreadError(
                "two environments with global_rng=True ran in two threads at once, but a process has only one state of"
                " the global generators; run them one after the other, or in separate processes"
            )
        self._owner.threads.add(thread)
        _owners.append(self._owner)
        self._hand_over(now, self._owner)

    def leave(self) -> None:
        """Restore the state that was in place before."""
        _owners.pop()
        self._hand_over(self._owner, _owners[-1])
        if self._owner not in _owners:
            self._owner.threads.clear()

    def step_out(self) -> None:
        """Leave as often as this state was entered in a row."""
        while _owners[-1] is self._owner:
            self.leave()

    def around(self, run: Callable[[], Any]) -> Callable[[], Any]:
        """Wrap a job of the simulation's stack, so that the job's thread is known as one of this owner's.

        While the job runs the user waits, and so this state is in place.
        """
        threads = self._owner.threads

        def run_and_tell() -> Any:
            threads.add(get_ident())
            return run()

        return run_and_tell

    @staticmethod
    def _hand_over(before: _Owner, after: _Owner) -> None:
        if before is not after:
            before.state.save()
            after.state.load()


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
        self._before, torchs = PortableState(), _generator_of_torch()
        self._before.save()
        self._drawn = None if torchs is None else torchs.get_state()

    def __exit__(self, *error: object) -> None:
        self._before.load()
        if self._drawn is not None:
            _generator_of_torch().set_state(self._drawn)


def _generator_of_torch() -> Any:
    return getattr(modules.get("torch"), "default_generator", None)
