"""A state of Python's and NumPy's global generators for each environment that asks for one.

Models that draw from ``random`` and ``numpy.random`` share one state with all else in the process. With
``global_rng=True`` an environment's simulation finds a state of its own there whenever it is at work, and its user
finds theirs again afterwards. The one whose state is in place *owns* the generators; there is always one owner.
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
_WORDS: Final = 4 * 625  # of both generators: 624 words of a Mersenne twister, and how many of them are used up

_KEY: Final = 4 * 624
"""Bytes of a Mersenne twister, before the number that tells how many of its words are used up."""

_UNKNOWN: Final = (c_char * 4)()

_python: Any = random.seed.__self__  # type: ignore[attr-defined]  # the generator behind the functions of ``random``
_numpy: Any = np.random.mtrand._rand
_legacy: Any = np.random  # some of whose functions its stubs leave out


class State(Protocol):
    """A state of the global generators, while it is not in place."""

    def save(self) -> None:
        """Take it from there."""

    def load(self) -> None:
        """Put it in place."""

    def separate(self) -> None:
        """Share it with nothing that might go on drawing from it."""


class PortableState:
    """A state that is saved and loaded by the generators' own functions; takes some 150 microseconds."""

    def save(self) -> None:
        """Take it from there."""
        self._python, self._generator = random.getstate(), _legacy.get_bit_generator()
        self._numpy = np.random.get_state(legacy=False)

    def load(self) -> None:
        """Put it in place."""
        random.setstate(self._python)
        _legacy.set_bit_generator(self._generator)
        np.random.set_state(self._numpy)

    def separate(self) -> None:
        """Share it no more."""
        self._generator = _copied(self._generator)
        self._numpy |= self._generator.state  # which is another one where the user has set a generator of another kind


class SwiftState:
    """The same by copying memory; takes about a microsecond. Used where ``_is_swift`` has seen it work."""

    gauss_at = 0
    """Where, in NumPy's generator, its second normally distributed number is kept until it is asked for."""

    def save(self) -> None:
        """Take it from there."""
        self._python = string_at(id(_python) + _HEADER, _WORDS)
        self._next = _python.gauss_next
        self._generator = _legacy.get_bit_generator()
        self._gauss = string_at(id(_numpy) + self.gauss_at, 16)

    def load(self) -> None:
        """Put it in place."""
        memmove(id(_python) + _HEADER, self._python, _WORDS)
        _python.gauss_next = self._next
        _legacy.set_bit_generator(self._generator)  # which forgets the number that is kept
        memmove(id(_numpy) + self.gauss_at, self._gauss, 16)

    def separate(self) -> None:
        """Share it no more."""
        self._generator = _copied(self._generator)


def _is_swift() -> bool:
    """Whether the memory of the generators is what it is thought to be. Leaves them as they were."""
    before, swift = PortableState(), SwiftState()
    before.save()
    try:
        random.seed(1)
        np.random.seed(1)
        kept = _legacy.standard_normal(1) * 0 + _legacy.get_state(legacy=False)["gauss"]
        place = string_at(id(_numpy), type(_numpy).__basicsize__).find(kept.tobytes())
        if place < 8 + _HEADER or Twister.__basicsize__ not in range(_WORDS, _WORDS + 64):
            return False
        SwiftState.gauss_at = place - 8  # before it, whether it is there
        random.gauss(0, 1)
        found = _draws(swift)
        swift.load()
        return found == _draws(None)
    except Exception:  # whatever it is, it is not what was thought
        return False
    finally:
        before.load()


def _draws(saved: State | None) -> list[float]:
    """Draw from everything that there is, after a state was saved; then make everything different."""
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
    """A Mersenne twister, which alone can be seeded by ``numpy.random.seed``: the same, or a new one."""
    twister = np.random.MT19937()
    if type(generator) is np.random.MT19937:
        twister.state = generator.state
    return twister


_State: Final[Callable[[], State]] = SwiftState if _is_swift() else PortableState


class _Used:
    """Reads how much of the numbers that the generators have made in advance is used up."""

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
"""Called, returns four bytes each of Python's and of NumPy's global generator, which change when that is drawn from."""


class _Owner:
    """An owner of the global generators, whose state is kept apart from all others'.

    Attributes:
        state: It, while it is not in place.
        threads: In which threads the owner may be at work.
    """

    def __init__(self) -> None:
        self.state = _State()
        self.threads: set[int] = set()


_owners: Final = [_Owner()]
"""Who owns the generators, last; before it those whose work lies around that. The first is the user."""


class GlobalRandom:
    """The surrounding in which a simulation finds global generators of its own."""

    def __init__(self) -> None:
        """Make a state that is the present one, until ``begin`` says otherwise."""
        self._owner = _Owner()
        self._owner.state.save()
        self._owner.state.separate()

    def begin(self, seed: int) -> None:
        """Seed the generators, which are in place, for an episode: both with its seed."""
        random.seed(seed)
        np.random.seed(seed % 2**32)

    def begin_anew(self, seed: int) -> None:
        """Seed the generators, which are in place, for another future."""
        _seed_globals(seed, _OWN)

    def enter(self) -> None:
        """Put the own state in place.

        Raises:
            WrongThreadError: Another environment's is, and that is at work in another thread.
        """
        thread, now = get_ident(), _owners[-1]
        if len(_owners) > 1 and thread not in now.threads:
            raise WrongThreadError(
                "two environments with global_rng=True were at work in two threads at once, but there is one state of"
                " the global generators in a process; run them one after the other, or in processes of their own"
            )
        self._owner.threads.add(thread)
        _owners.append(self._owner)
        self._hand_over(now, self._owner)

    def leave(self) -> None:
        """Put back the state that was in place before."""
        _owners.pop()
        self._hand_over(self._owner, _owners[-1])
        if self._owner not in _owners:
            self._owner.threads.clear()

    def step_out(self) -> None:
        """Put back the state that was in place before all that is under way."""
        while _owners[-1] is self._owner:
            self.leave()

    def around(self, run: Callable[[], Any]) -> Callable[[], Any]:
        """What the simulation's stack runs. The state is in place, whatever thread that is, while its user waits."""
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
"""The key of their streams, which spawning never gives. A model may seed with the bare seed, or spawn from it."""

_OWN: Final = 0
_PROCESS: Final = 1
HELD: Final = 2
"""Whose generators are seeded. A base that draws from those of the process is not to meet the simulation's numbers."""

SHARED: Final = (_python, _numpy)
"""The generators behind the functions of ``random`` and ``numpy.random``."""


def is_seed(value: Any) -> bool:
    """Whether a value is a non-negative integer."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool) and bool(value >= 0)


def streams(seed: int, whose: int, number: int) -> list[np.random.SeedSequence]:
    """What so many generators are seeded with for a future."""
    return np.random.SeedSequence(int(seed), spawn_key=(_FUTURES, whose)).spawn(number)


def reseed_one(generator: Any, stream: np.random.SeedSequence) -> None:
    """Seed a generator where it is, for all that refer to it.

    Args:
        generator: A ``random.Random``, or NumPy's ``Generator``, ``RandomState`` or ``BitGenerator``.
        stream: With what.
    """
    if isinstance(generator, random.Random):
        generator.seed(_integer(stream))
        return
    legacy = isinstance(generator, np.random.RandomState)
    bits = getattr(generator, "_bit_generator" if legacy else "bit_generator", generator)
    bits.__setstate__(type(bits)(stream).__getstate__())  # with what it spawns from, where NumPy is new enough
    if legacy:
        generator.set_state(bits.state)  # which forgets the second normally distributed number


def _integer(stream: np.random.SeedSequence) -> int:
    return int(stream.generate_state(1, np.uint64)[0])


def _seed_globals(seed: int, whose: int) -> np.random.SeedSequence:
    """Seed Python's and NumPy's global generators for a future, each with a stream of its own; return one more."""
    python, numpy, another = streams(seed, whose, 3)
    reseed_one(_python, python)
    _legacy.set_bit_generator(type(_legacy.get_bit_generator())(numpy))  # the one that is there is left as it is
    return another


def seed_process(seed: int) -> None:
    """Seed the global generators of the process for a future: Python's, NumPy's, and torch's if it is there."""
    another, torchs = _seed_globals(seed, _PROCESS), _generator_of_torch()
    if torchs is not None:
        torchs.manual_seed(_integer(another))


class process_kept:  # noqa: N801 - it is used like a function
    """Put the global generators of the process back to where they were.

    It is a class, as ``outside_simulation`` is, since some errors cannot pass a context manager made of a generator.
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
