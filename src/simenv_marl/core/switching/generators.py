"""Random generators: the global ones of the process, a simulation's own, and seeds for futures."""

import random
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Iterator
from functools import cache
from gc import get_referents
from numbers import Real
from sys import modules
from threading import current_thread
from threading import enumerate as enumerate_threads
from time import process_time_ns, thread_time_ns
from types import CodeType, FunctionType, ModuleType
from typing import Any, Final
from weakref import WeakKeyDictionary

import numpy as np
from numpy.random import (
    MT19937,
    BitGenerator,
    Generator,
    RandomState,
    SeedSequence,
    default_rng,
)

from ...errors import OptionValueError, SimulationError, short_repr, warn_user
from ...hooks.stacks import SIMULATION
from ...simulation import Model, is_integer

PYTHON: Final[Any] = random.seed.__self__  # type: ignore[attr-defined]
"""The generator behind the functions of ``random``."""

NUMPY: Final[Any] = np.random.mtrand._rand
"""The generator behind the functions of ``numpy.random``."""

LEGACY: Final[Any] = np.random  # NumPy's type stubs lack some of its functions


def is_seed(value: object) -> bool:
    """Return whether a value is a non-negative integer."""
    return is_integer(value) and value >= 0


# -- simulations that draw from the generators of the process --------------------------------------

_CHECKED: Final[WeakKeyDictionary[type, bool]] = WeakKeyDictionary()
"""The classes of simulations that were checked, and whether they draw."""

_SHORT: Final = 100_000
"""A time in nanoseconds.

Another thread that wakes up and draws runs for longer; the clocks differ by less.
"""

_MOST_REFILLS: Final = 200
"""How many times 624 draws are tried to find out whether a generator was seeded."""


def draws_check(
    simulation: Model, *, in_thread: bool, beside: bool | None
) -> Callable[[], str] | None:
    """Begin to check whether a simulation draws from the global generators.

    Args:
        simulation: The simulation, before it runs.
        in_thread: Whether it runs in a thread beside which threads of the user may run.
        beside: Whether others run beside it. None: one check of its class is enough.

    Returns:
        The function that ends the check, warns once for each class, and returns why the results
        will be wrong, or "". None without a check.
    """
    kind = type(simulation)
    if beside is None and kind in _CHECKED:
        return None
    states = global_states()
    time_before = _time_of_other_threads()

    def warn_of_draws() -> str:
        is_known = _CHECKED.setdefault(kind, False)
        after = global_states()
        names = [name for name, state in after.items() if state != states[name]]
        if not names:
            return ""
        is_alone = all(
            thread is current_thread() or thread.name == SIMULATION
            for thread in enumerate_threads()
        )
        is_idle = not in_thread and _time_of_other_threads() - time_before < _SHORT
        if not (is_alone or is_idle or is_known):
            return ""
        problem = (
            f"{kind.__name__} draws from the global generator of {' and '.join(names)}, which"
            " all code in the process shares: its environments influence each other, and a"
            " seed does not repeat an episode. Make them with global_rng=True"
        )
        if not is_known:
            _CHECKED[kind] = True
            warn_user(problem)
        is_wrong = beside or any(_has_drawn(states[name], after[name]) for name in names)
        return problem if is_wrong else ""

    return warn_of_draws


def _has_drawn(before: Model, after: Model) -> bool:
    """Return whether draws alone lead from one state to another: the generator was not seeded."""
    if isinstance(after, str):  # of a generator of the user
        return True
    if len(after) == 2:  # of NumPy
        before, after = (
            (3, (*np.frombuffer(key, np.uint32).tolist(), place), None)
            for key, place in (before, after)
        )
    generator = random.Random()
    generator.setstate(before)
    for _ in range(_MOST_REFILLS):
        if generator.getstate()[1][:-1] == after[1][:-1]:
            return True
        generator.getrandbits(32 * 624)
    return False


def _time_of_other_threads() -> int:
    """Return the processor time of the other threads, in nanoseconds."""
    return process_time_ns() - thread_time_ns()


def global_states() -> dict[str, object]:
    """Return values that change when Python's or NumPy's global generator draws a number."""
    state = LEGACY.get_bit_generator().state["state"]
    is_mersenne = "key" in state  # as Python's
    of_numpy = (state["key"].tobytes(), state["pos"]) if is_mersenne else repr(state)
    return {"random": random.getstate(), "numpy.random": of_numpy}


# -- other futures --------------------------------------------------------------------------------

_FUTURES: Final = 2**32 - 1
"""The spawn key of the seeds of futures.

A model that uses the same seed, or spawns from it, never gets this key.
"""

ENVIRONMENT: Final = 0
PROCESS: Final = 1
_SIMULATION: Final = 2
"""The owners of generators. Each has separate streams, because a base policy that draws from the
generators of the process must not get the same numbers as the simulation.
"""

_NAMES: Final = 2**32 - 2
"""The spawn key before the name of a stream.

A model that spawns from the same seed never gets this key.
"""


_OTHERS: Final = 256
"""The spawn key before a name that is no text. No byte of a text is this number."""


class Streams(dict[Hashable, Generator]):
    """The random generators of a model, by name: one for each entity or process.

    ::

        self.streams = Streams(seed)
        self.failures = self.streams[f"failures of {self.name}"]

    A generator is made when it is first used. Its numbers depend on the seed and its name alone. So
    further entities, and their actions, change no other entity's chance. This makes runs that
    differ in one action, or in one entity, comparable with few seeds.

    A name is a text, a number, a tuple, or any other value with a hash. Objects whose hash is their
    identity are refused, because another process could not find their generators.
    """

    def __init__(self, seed: int | None = None) -> None:
        """Begin with no generators.

        Args:
            seed: A non-negative integer. None: the system draws it.
        """
        super().__init__()
        self._key = SeedSequence(None if seed is None else _validate(seed))

    def __missing__(self, name: Hashable) -> Generator:
        return self.setdefault(name, default_rng(self._stream(name)))

    def reseed(self, seed: int) -> None:
        """Seed all generators in place, also the later ones: for a simulation's ``reseed``.

        Raises:
            OptionValueError: The seed is not a non-negative integer.
        """
        self._key = SeedSequence(_validate(seed), spawn_key=(_FUTURES, _SIMULATION))
        for name, generator in self.items():
            _seed_bits(generator.bit_generator, self._stream(name))

    def _stream(self, name: Hashable) -> SeedSequence:
        words = (*name.encode(),) if isinstance(name, str) else (_OTHERS, *_text_of(name).encode())
        return SeedSequence(self._key.entropy, spawn_key=(*self._key.spawn_key, _NAMES, *words))


def _text_of(name: Any) -> str:
    """Return a text for the name of a stream: the same for equal names, in every process."""
    match name:
        case None | bytes():
            return repr(name)
        case str():
            return ascii(str(name))
        case tuple() | list():
            return f"({','.join(map(_text_of, name))})"
        case frozenset():
            return f"{{{','.join(sorted(map(_text_of, name)))}}}"
        case dict():
            return _text_of(frozenset(name.items()))
        case Real() | np.bool_() if name == name:  # NaN equals nothing
            number: Any = name
            return repr(int(number) if number % 1 == 0 else float(number))
        case type() | FunctionType() if "<" not in name.__qualname__:
            return f"{name.__module__}.{name.__qualname__}".replace("__mp_main__", "__main__")
    if type(name).__hash__ is object.__hash__ or isinstance(name, Real):
        raise OptionValueError(
            f"a stream cannot be named by {short_repr(name)}: another process could not find it"
            ' again. Use a text, a number, or a tuple of these, such as ("pump", 2)'
        )
    return _text_of(name.__reduce_ex__(2))


_GENERATORS: Final = (
    Streams,
    random.Random,
    Generator,
    RandomState,
    BitGenerator,
)

_SKIPPED: Final = (
    # They lead to the whole process.
    type,
    ModuleType,
    CodeType,
    # They lead to nothing else.
    str,
    int,
    float,
    random.SystemRandom,
)
"""Classes whose objects are not searched."""


def seed_globals(seed: int, owner: int) -> None:
    """Seed Python's and NumPy's global generators for a future.

    For the owner ``PROCESS`` also torch's, if torch is imported.
    """
    key = SeedSequence(int(seed), spawn_key=(_FUTURES, owner))
    of_python, of_numpy, of_torch = key.spawn(3)
    PYTHON.seed(_integer(of_python))
    # A new bit generator, because other code may hold the old one.
    LEGACY.set_bit_generator(type(LEGACY.get_bit_generator())(of_numpy))
    torch = generator_of_torch()
    if owner == PROCESS and torch is not None:
        torch.manual_seed(_integer(of_torch))


def generator_of_torch() -> Any:
    """Return torch's global generator; None if torch is not imported."""
    return getattr(modules.get("torch"), "default_generator", None)


def reseed_generators(simulation: Model, seed: int) -> int:
    """Seed all random generators of a simulation, each with another stream.

    It looks for generators in the attributes, in the attributes of these, and so on:
    ``random.Random``, NumPy's ``Generator``, ``RandomState`` and ``BitGenerator``, and ``Streams``.
    In a Mesa model these are ``random`` and ``rng``, which all of its agents share. Each generator
    is seeded in place, so that all references to it stay valid. The same seed gives the same
    states, regardless of earlier draws. Several generators in one ``set`` get their streams in the
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
    key = SeedSequence(_validate(seed), spawn_key=(_FUTURES, _SIMULATION))
    generators = list(generators_of(simulation))
    if not generators:
        raise SimulationError(
            f"{short_repr(simulation)} holds no random generator to seed: keep a random.Random or"
            " numpy.random.Generator in an attribute; make the environment with global_rng=True if"
            " the model draws from random or numpy.random; seed other libraries' generators in the"
            " simulation's reseed"
        )
    for generator, stream in zip(generators, key.spawn(len(generators)), strict=True):
        match generator:
            case Streams():
                generator.reseed(_integer(stream))
            case random.Random():
                generator.seed(_integer(stream))
            case RandomState():
                generator.set_state(RandomState(MT19937(stream)).get_state())
            case Generator(bit_generator=bits) | (BitGenerator() as bits):
                _seed_bits(bits, stream)
    return len(generators)


def generators_of(simulation: Model) -> Iterator[Model]:
    """Yield the generators that an object holds, the nearest first, each of them once.

    ``Streams`` count as one.
    """
    known = {id(PYTHON), id(NUMPY)}
    for generator in find_objects([simulation], _GENERATORS, known):
        yield generator
        if isinstance(generator, Streams):
            known.update(map(id, generator.values()))


def find_objects(
    roots: Iterable[Model], kinds: tuple[type, ...], known: set[int]
) -> Iterator[Model]:
    """Yield the objects of some classes that others hold, the nearest first, each of them once.

    Args:
        roots: The other objects.
        kinds: The classes.
        known: The identities of objects to leave out. Those of all objects are added.
    """

    @cache
    def classify(kind: type) -> bool | None:
        """Return whether objects of a class are yielded. None: they are not searched."""
        if hasattr(kind, "__globals__") or issubclass(kind, _SKIPPED):  # functions have globals
            return None
        return issubclass(kind, kinds)

    queue = deque(roots)
    while queue:
        thing = queue.popleft()
        is_wanted = classify(type(thing))  # type: ignore[arg-type] # mypy doubts its hash
        if is_wanted is None or id(thing) in known:
            continue
        known.add(id(thing))
        if is_wanted:
            yield thing
            continue
        queue.extend(get_referents(thing))
        if isinstance(thing, np.ndarray):
            queue.append(thing.base)


def _seed_bits(bits: BitGenerator, stream: SeedSequence) -> None:
    """Seed a bit generator in place, in new NumPy also its seed sequence for ``spawn``."""
    bits.__setstate__(type(bits)(stream).__getstate__())  # type: ignore[attr-defined]


def _validate(seed: int) -> int:
    """Return a seed as a Python integer."""
    if not is_seed(seed):
        raise OptionValueError(f"seed must be a non-negative integer, not {short_repr(seed)}")
    return int(seed)


def _integer(stream: SeedSequence) -> int:
    return int(stream.generate_state(1, np.uint64)[0])
