"""Fingerprints: everything that a simulation holds after a run, to compare two runs.

Models need not be comparable. Therefore their attributes are followed down to numbers, strings, arrays and the states
of random generators. Each of these *parts* has a path, which a difference reports. Objects that cannot be compared
(open files, generators, locks) are left out, and their kinds are recorded.
"""

from __future__ import annotations

import random
import re
import warnings
import weakref
from collections import Counter, deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import cached_property, partial
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import Any, Final

import numpy as np

from ..errors import short_repr
from ..simulation import Sentinel

MOST_PARTS: Final = 50_000
"""The largest number of parts. Larger models are compared by this many parts."""

ABSENT: Final = Sentinel("nothing")
"""In differences, the value of a part that does not exist."""

_ATOMS: Final = (int, float, complex, str, bytes, bool, type(None), range, type(Ellipsis), type(NotImplemented))
_NAMED: Final = (type, FunctionType, BuiltinFunctionType, ModuleType)

Difference = tuple[str, Any, Any]
"""A path, the value here and the value there, of which one may be ``ABSENT``."""


@dataclass(frozen=True)
class Fingerprint:
    """All parts of a simulation at one moment."""

    parts: dict[str, Any]  # by path
    left_out: frozenset[str]  # the kinds of objects that cannot be compared
    complete: bool  # whether there were at most MOST_PARTS

    def differences(self, other: Fingerprint, ignored: frozenset[str] = frozenset()) -> list[Difference]:
        """Return the differences in all parts but those whose paths, as ``general`` writes them, are ignored."""
        found = []
        for path in dict.fromkeys([*self.parts, *other.parts]):
            here, there = self.parts.get(path, ABSENT), other.parts.get(path, ABSENT)
            comparable = (here is not ABSENT or self.complete) and (there is not ABSENT or other.complete)
            if comparable and not _same(here, there) and general(path) not in ignored:
                found.append((path, here, there))
        return found


def fingerprint(name: str, root: Any) -> Fingerprint:
    """Return the fingerprint of any object; all paths begin with its name."""
    parts: dict[str, Any] = {}
    left_out: set[str] = set()
    met: dict[int, str] = {}
    alive = []  # temporary objects, so that their ids are not reused
    # Breadth first, so that a long history in the model does not hide the rest.
    queue = deque([(name, root)])
    while queue and len(parts) < MOST_PARTS:
        path, value = queue.popleft()
        if isinstance(value, Enum):
            parts[path] = str(value)
        elif isinstance(value, _ATOMS):
            parts[path] = value
        elif isinstance(value, (np.ndarray, np.generic)) and value.dtype != object:
            parts[path] = value.copy()
        elif isinstance(value, _NAMED):
            parts[path] = title(value)
        elif id(value) in met:
            parts[path] = f"the same object as {met[id(value)]}"
        else:
            parts[path] = title(type(value))
            if not isinstance(value, (tuple, frozenset)):  # equal ones may or may not be the same object
                met[id(value)] = path
            alive.append(value)
            try:
                queue += list(_members(path, value))
            except Exception:  # an open file, a lock, a generator, for whatever reason
                left_out.add(title(type(value)))
    return Fingerprint(parts, frozenset(left_out), not queue)


def _members(path: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield what a value holds, by path. Raises an exception if that is unknown."""
    if isinstance(value, random.Random):
        yield f"{path} (state of the generator)", str(value.getstate())
    elif isinstance(value, (np.random.Generator, np.random.RandomState)):
        generator: Any = value
        bits = getattr(generator, "bit_generator", None) or generator._bit_generator
        yield f"{path} (state of the generator)", str(bits.state)
    elif isinstance(value, (set, frozenset)):
        # It has no order: of objects that are not atoms, only the number of each kind.
        yield f"{path} (members)", ", ".join(sorted(repr(item) for item in value if isinstance(item, _ATOMS)))
        others = Counter(title(type(item)) for item in value if not isinstance(item, _ATOMS))
        yield f"{path} (kinds)", str(sorted(others.items()))
    elif isinstance(value, weakref.ref):
        yield f"{path}()", value()
    elif isinstance(value, (MethodType, partial)):
        yield f"{path} (itself)", _reduced(value)
    else:
        attributes = list(_attributes(path, value))
        yield from attributes
        if isinstance(value, (list, tuple, deque, np.ndarray)):
            items = value.ravel() if isinstance(value, np.ndarray) else value
            yield from ((f"{path}[{number}]", item) for number, item in enumerate(items))
        elif isinstance(value, Mapping):
            yield from _items(path, value)
        elif not attributes and not hasattr(value, "__dict__"):
            yield f"{path} (itself)", _reduced(value)


def _attributes(path: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield instance attributes, in ``__dict__`` and in slots, but not those that are computed once when first read."""
    state = object.__getstate__(value)
    for attributes in state if isinstance(state, tuple) else (state,):
        for name, part in (attributes or {}).items():
            if not isinstance(getattr(type(value), str(name), None), cached_property):
                yield f"{path}.{name}", part


def _items(path: str, values: Any) -> Iterator[tuple[str, Any]]:
    for number, (key, value) in enumerate(list(values.items())):
        if isinstance(key, (*_ATOMS, np.generic, tuple, Enum)) and len(text := repr(key)) < 80:
            yield f"{path}[{text}]", value
        else:
            yield f"{path} (key {number})", key
            yield f"{path}[key {number}]", value


def _reduced(value: Any) -> Any:
    """Return what a pickle of an object holds. Raises an exception if it cannot be pickled."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        reduced = value.__reduce_ex__(4)
    if isinstance(reduced, str):
        return reduced
    return [list(part) if isinstance(part, Iterator) else part for part in reduced[1:]]


def _same(one: Any, other: Any) -> bool:
    """Return whether two parts are the same, bit for bit."""
    if type(one) is not type(other):
        return False
    if isinstance(one, (np.ndarray, np.generic)):
        return bool(one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes())
    return bool(one == other or (one != one and other != other))


def alike(one: Any, other: Any) -> bool:
    """Return whether two objects have the same parts."""
    return not fingerprint("", one).differences(fingerprint("", other))


def brief(value: Any, depth: int = 3) -> Any:
    """Copy what is cheap to compare of a rule's result: atoms, arrays, containers of these; for others, their class."""
    if isinstance(value, (list, tuple)) and depth and len(value) <= 1000:
        return type(value).__name__, [brief(part, depth - 1) for part in value]
    if isinstance(value, dict) and depth and len(value) <= 1000:
        return [(brief(key, depth - 1), brief(part, depth - 1)) for key, part in value.items()]
    if isinstance(value, (np.ndarray, np.generic)) and value.dtype != object:
        return value.copy()
    return value if isinstance(value, (*_ATOMS, Enum)) else f"<{title(type(value))}>"


def general(path: str) -> str:
    """Return a path that is the same for all members of a list or dict."""
    return re.sub(r"\[[^\]]*\]", "[]", path)


def title(thing: Any) -> str:
    """Return the name of a class, function or module."""
    name = getattr(thing, "__qualname__", None) or getattr(thing, "__name__", None)
    return str(name) if name else type(thing).__qualname__


def describe_differences(parts: list[Difference], here: str = "first", there: str = "then") -> str:
    """Describe the differences of two fingerprints."""
    texts = [f"{path} is {here} {short_repr(one, 60)}, {there} {short_repr(other, 60)}" for path, one, other in parts]
    return "; ".join(texts[:3]) + (f"; {len(texts) - 3} more" if len(texts) > 3 else "")
