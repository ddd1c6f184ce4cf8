"""Finds the random generators of a simulation and seeds them anew, for other futures."""

import random
from collections.abc import Iterator
from gc import get_referents
from types import CodeType, ModuleType
from typing import Any, Final

import numpy as np

from ..errors import OptionValueError, SimulationError, short_repr
from .rng import HELD, SHARED, is_seed, reseed_one, streams

_GENERATORS: Final = (random.Random, np.random.Generator, np.random.RandomState, np.random.BitGenerator)

_ELSEWHERE: Final = (type, ModuleType, CodeType, np.ndarray, str, int, float, random.SystemRandom)
"""Classes that are not searched: they lead to everything in the process, or to nothing. Nor are functions."""


def reseed_generators(simulation: Any, seed: int) -> int:
    """Seed all random generators of a simulation, each with a stream of its own.

    The generators are found in its attributes, in the attributes of these, and so on: ``random.Random``, and NumPy's
    ``Generator``, ``RandomState`` and ``BitGenerator``. In a Mesa model these are ``random`` and ``rng``, which all of
    its agents share. Each generator is seeded in place, so that all references to it stay valid. The same seed gives
    the same states, whatever was drawn before. Several generators in one ``set`` get their streams in the order of the
    set.

    Modules, classes, functions and arrays are not searched. The global generators of Python and NumPy are left alone:
    an environment with ``global_rng=True`` seeds its own copies of these.

    Args:
        simulation: The simulation, which calls this in its method ``reseed(self, seed)``; or any other object.
        seed: A non-negative integer.

    Returns:
        The number of generators.

    Raises:
        SimulationError: There are no generators.
        OptionValueError: The seed is not a non-negative integer.
    """
    if not is_seed(seed):
        raise OptionValueError(f"seed must be a non-negative integer, not {short_repr(seed)}")
    found = list(_generators(simulation))
    if not found:
        raise SimulationError(
            f"{short_repr(simulation)} holds no random generator to seed: keep a random.Random or"
            " numpy.random.Generator in"
            " an attribute; make the environment with global_rng=True if the model draws from random or numpy.random;"
            " seed other libraries' generators in the simulation's reseed"
        )
    for generator, stream in zip(found, streams(seed, HELD, len(found)), strict=True):
        reseed_one(generator, stream)
    return len(found)


def _generators(simulation: Any) -> Iterator[Any]:
    """Yield the generators that an object holds, the nearest first, each of them once."""
    known = {id(generator) for generator in SHARED}
    kinds: dict[type, bool | None] = {}  # whether objects of a class are generators; None: they are not searched
    level = [simulation]
    while level:
        following = []
        for thing in level:
            kind = type(thing)
            if kind not in kinds:
                elsewhere = issubclass(kind, _ELSEWHERE) or hasattr(kind, "__globals__")  # as functions have
                kinds[kind] = None if elsewhere else issubclass(kind, _GENERATORS)
            wanted = kinds[kind]
            if wanted is None or id(thing) in known:
                continue
            known.add(id(thing))
            if wanted:
                yield thing
            else:
                following.append(thing)
        level = get_referents(*following)
