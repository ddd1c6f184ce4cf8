"""Random generators: those that all code in the process shares, and those of a simulation.

New seeds for futures.
"""

import random
from collections.abc import Callable, Iterator
from gc import get_referents
from sys import modules
from threading import current_thread
from threading import enumerate as enumerate_threads
from time import process_time_ns, thread_time_ns
from types import CodeType, ModuleType
from typing import Any, Final
from weakref import WeakSet

import numpy as np

from ...errors import OptionValueError, SimulationError, short_repr, warn_user
from ...hooks.stacks import SIMULATION

PYTHON: Final[Any] = random.seed.__self__  # type: ignore[attr-defined]
"""The generator behind the functions of ``random``."""

NUMPY: Final[Any] = np.random.mtrand._rand
"""The generator behind the functions of ``numpy.random``."""

LEGACY: Final[Any] = np.random  # NumPy's type stubs lack some of its functions


def is_seed(value: Any) -> bool:
    """Whether a value is a non-negative integer."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool) and bool(value >= 0)


# -- simulations that draw from the generators of the process --------------------------------------

_CHECKED: Final[WeakSet[type]] = WeakSet()
"""The classes of simulations that were checked."""

_SHORT: Final = 100_000
"""A time in nanoseconds.

Another thread that wakes up and draws runs for longer; the clocks differ by less.
"""


def draws_check(simulation: Any, *, in_thread: bool) -> Callable[[], None] | None:
    """Begin to check whether a simulation draws from the global generators, unless its class was checked before.

    Return a function that ends the check, and warns. Beside one that runs ``in_thread``, the user's
    threads may run.
    """
    kind = type(simulation)
    if kind in _CHECKED:
        return None
    states, time = global_states(), process_time_ns() - thread_time_ns()

    def warn_of_draws() -> None:
        _CHECKED.add(kind)
        names = [name for name, state in global_states().items() if state != states[name]]
        alone = all(
            thread is current_thread() or thread.name == SIMULATION
            for thread in enumerate_threads()
        )
        time_of_others = process_time_ns() - thread_time_ns() - time
        if names and (alone or (not in_thread and time_of_others < _SHORT)):
            warn_user(
                f"{kind.__name__} draws from the global generator of {' and '.join(names)}, which"
                " all code in the process shares: its environments influence each other, and a"
                " seed does not repeat an episode. Make them with global_rng=True"
            )

    return warn_of_draws


def global_states() -> dict[str, Any]:
    """Return values that change when a number is drawn from Python's or NumPy's global generator."""
    return {"random": random.getstate(), "numpy.random": repr(LEGACY.get_bit_generator().state)}


# -- other futures --------------------------------------------------------------------------------

_FUTURES: Final = 2**32 - 1
"""The spawn key of the seeds of futures.

A model that uses the same seed, or spawns from it, never gets this key.
"""

ENVIRONMENT: Final = 0
PROCESS: Final = 1
_SIMULATION: Final = 2
"""Whose generators are seeded: the three have separate streams. A base policy that draws from the generators of the
process must not get the same numbers as the simulation."""


class Streams(dict[str, np.random.Generator]):
    """The random generators of a model, by name: one for each entity or process, made when it is first asked for.

    ::

        self.streams = Streams(seed)
        self.failures = self.streams[f"failures of {self.name}"]

    What a generator draws depends on the seed and its name alone. So further entities, and their
    actions, change no other entity's chance. This makes runs that differ in one action, or in one
    entity, comparable with few seeds.
    """

    def __init__(self, seed: int | None = None) -> None:
        """Begin with no generators.

        ``seed``: a non-negative integer; None: one that the system draws.
        """
        super().__init__()
        self._key = np.random.SeedSequence(None if seed is None else _checked(seed))

    def __missing__(self, name: str) -> np.random.Generator:
        self[name] = generator = np.random.default_rng(self._stream(name))
        return generator

    def reseed(self, seed: int) -> None:
        """Seed all generators in place, and those that are asked for later: for a simulation's ``reseed``.

        Raises:
            OptionValueError: The seed is not a non-negative integer.
        """
        self._key = np.random.SeedSequence(_checked(seed), spawn_key=(_FUTURES, _SIMULATION))
        for name, generator in self.items():
            _seed_bits(generator.bit_generator, self._stream(name))

    def _stream(self, name: str) -> np.random.SeedSequence:
        return np.random.SeedSequence(
            self._key.entropy, spawn_key=(*self._key.spawn_key, _NAMES, *name.encode())
        )


_GENERATORS: Final = (
    Streams,
    random.Random,
    np.random.Generator,
    np.random.RandomState,
    np.random.BitGenerator,
)

_NAMES: Final = 2**32 - 2
"""The spawn key before the name of a stream.

A model that spawns from the same seed never gets this key.
"""

_ELSEWHERE: Final = (type, ModuleType, CodeType, np.ndarray, str, int, float, random.SystemRandom)
"""Classes that are not searched: they lead to everything in the process, or to nothing.

Nor are functions.
"""


def seed_globals(seed: int, whose: int) -> None:
    """Seed Python's and NumPy's global generators for a future.

    For the process also torch's, if it is imported.
    """
    python, numpy, third = np.random.SeedSequence(int(seed), spawn_key=(_FUTURES, whose)).spawn(3)
    PYTHON.seed(_integer(python))
    # leaves the old bit generator as it is
    LEGACY.set_bit_generator(type(LEGACY.get_bit_generator())(numpy))
    torchs = generator_of_torch()
    if whose == PROCESS and torchs is not None:
        torchs.manual_seed(_integer(third))


def generator_of_torch() -> Any:
    """Return torch's global generator; None if torch is not imported."""
    return getattr(modules.get("torch"), "default_generator", None)


def reseed_generators(simulation: Any, seed: int) -> int:
    """Seed all random generators of a simulation, each with a stream of its own.

    The generators are found in its attributes, in the attributes of these, and so on:
    ``random.Random``, NumPy's ``Generator``, ``RandomState`` and ``BitGenerator``, and ``Streams``.
    In a Mesa model these are ``random`` and ``rng``, which all of its agents share. Each generator
    is seeded in place, so that all references to it stay valid. The same seed gives the same
    states, whatever was drawn before. Several generators in one ``set`` get their streams in the
    order of the set.

    Modules, classes, functions and arrays are not searched. The global generators of Python and
    NumPy are left alone: an environment with ``global_rng=True`` seeds its own copies of these.

    Args:
        simulation: The simulation, which calls this in its method ``reseed(self, seed)``; or any
            other object.
        seed: A non-negative integer.

    Returns:
        The number of generators.

    Raises:
        SimulationError: There are no generators.
        OptionValueError: The seed is not a non-negative integer.
    """
    key = np.random.SeedSequence(_checked(seed), spawn_key=(_FUTURES, _SIMULATION))
    found = list(generators_of(simulation))
    if not found:
        raise SimulationError(
            f"{short_repr(simulation)} holds no random generator to seed: keep a random.Random or"
            " numpy.random.Generator in an attribute; make the environment with global_rng=True if"
            " the model draws from random or numpy.random; seed other libraries' generators in the"
            " simulation's reseed"
        )
    for generator, stream in zip(found, key.spawn(len(found)), strict=True):
        if isinstance(generator, (Streams, random.Random)):
            (generator.reseed if isinstance(generator, Streams) else generator.seed)(
                _integer(stream)
            )
            continue
        legacy = isinstance(generator, np.random.RandomState)
        bits = getattr(generator, "_bit_generator" if legacy else "bit_generator", generator)
        _seed_bits(bits, stream)
        if legacy:
            generator.set_state(bits.state)  # this drops the second normally distributed number
    return len(found)


def generators_of(simulation: Any) -> Iterator[Any]:
    """Yield the generators that an object holds, the nearest first, each of them once.

    ``Streams`` count as one.
    """
    known = {id(PYTHON), id(NUMPY)}
    # whether objects of a class are generators; None: they are not searched
    kinds: dict[type, bool | None] = {}
    level = [simulation]
    while level:
        following = []
        for thing in level:
            kind = type(thing)
            if kind not in kinds:
                # as functions have
                elsewhere = issubclass(kind, _ELSEWHERE) or hasattr(kind, "__globals__")
                kinds[kind] = None if elsewhere else issubclass(kind, _GENERATORS)
            if kinds[kind] is None or id(thing) in known:
                continue
            known.add(id(thing))
            if kinds[kind]:
                yield thing
                if isinstance(thing, Streams):
                    known.update(map(id, thing.values()))
            else:
                following.append(thing)
        level = get_referents(*following)


def _seed_bits(bits: Any, stream: np.random.SeedSequence) -> None:
    """Seed a bit generator in place."""
    # new NumPy: the seed sequence for ``spawn``, too
    bits.__setstate__(type(bits)(stream).__getstate__())


def _checked(seed: Any) -> int:
    if not is_seed(seed):
        raise OptionValueError(f"seed must be a non-negative integer, not {short_repr(seed)}")
    return int(seed)


def _integer(stream: np.random.SeedSequence) -> int:
    return int(stream.generate_state(1, np.uint64)[0])
