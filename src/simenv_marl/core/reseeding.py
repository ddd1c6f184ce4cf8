"""Finding the random generators that a simulation holds, for futures that are drawn anew."""

import random
from collections.abc import Iterator
from gc import get_referents
from types import CodeType, ModuleType
from typing import Any, Final

import numpy as np

from ..errors import OptionValueError, SimulationError, shown
from .rng import HELD, SHARED, is_seed, reseed_one, streams

_GENERATORS: Final = (random.Random, np.random.Generator, np.random.RandomState, np.random.BitGenerator)

_ELSEWHERE: Final = (type, ModuleType, CodeType, np.ndarray, str, int, float, random.SystemRandom)
"""What leads to all that is in the process, or to nothing; functions do, too."""


def reseed_generators(simulation: Any, seed: int) -> int:
    """Seed all random generators that a simulation holds, each with a stream of its own.

    They are those of its attributes, of what its attributes hold, and so on: ``random.Random``, and NumPy's
    ``Generator``, ``RandomState`` and ``BitGenerator``; with a model of Mesa its ``random`` and ``rng``, which all that
    is in it shares. Each is seeded in place, for all that refer to it. The same seed gives the same states, whatever
    was drawn before; of several generators in one ``set`` each gets its stream in the order of that.

    Not looked into are modules, classes, functions and arrays. The global generators of Python and NumPy are left
    alone: with ``global_rng=True`` an environment seeds its own of these by itself.

    Args:
        simulation: The simulation, which calls this in its method ``reseed(self, seed)``; or any object.
        seed: A non-negative integer.

    Returns:
        How many generators were seeded.

    Raises:
        SimulationError: There are none.
        OptionValueError: The seed is no non-negative integer.
    """
    if not is_seed(seed):
        raise OptionValueError(f"seed must be a non-negative integer, not {shown(seed)}")
    found = list(_generators(simulation))
    if not found:
        raise SimulationError(
            f"{shown(simulation)} holds no random generator that could be seeded: keep one in an attribute"
            " (random.Random, numpy.random.Generator) and draw from that; for a model that draws from Python's or"
            " NumPy's global generators make the environment with global_rng=True; seed those of other libraries in"
            " the simulation's reseed"
        )
    for generator, stream in zip(found, streams(seed, HELD, len(found)), strict=True):
        reseed_one(generator, stream)
    return len(found)


def _generators(simulation: Any) -> Iterator[Any]:
    """The generators that an object holds, the nearest first, each of them once."""
    known = {id(generator) for generator in SHARED}
    kinds: dict[type, bool | None] = {}  # whether a thing of a class is a generator; None: it is not looked at
    level = [simulation]
    while level:
        following = []
        for thing in level:
            kind = type(thing)
            if kind not in kinds:
                elsewhere = issubclass(kind, _ELSEWHERE) or hasattr(kind, "__globals__")  # as functions have them
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
