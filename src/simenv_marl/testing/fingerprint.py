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
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import cached_property, partial
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import Any, Final

import numpy as np

from ..simulation import Sentinel

MOST_PARTS: Final = 50_000
"""The largest number of parts. Larger models are compared by this many parts."""

ABSENT: Final = Sentinel("nothing")

_ATOMS: Final = (int, float, complex, str, bytes, bool, type(None), range, type(Ellipsis), type(NotImplemented))
_NAMED: Final = (type, FunctionType, BuiltinFunctionType, ModuleType)


@dataclass(frozen=True)
class Fingerprint:
    """All parts of a simulation at one moment.

    Attributes:
        parts: The parts, by path.
        left_out: The kinds of objects that cannot be compared.
        complete: Whether there were at most ``MOST_PARTS``.
    """

    parts: dict[str, Any]
    left_out: frozenset[str]
    complete: bool

    def differences(self, other: Fingerprint, but: frozenset[str] = frozenset()) -> list[tuple[str, Any, Any]]:
        """Return the differences: path, this value and the other value; ``ABSENT`` for a missing part.

        Args:
            other: The other fingerprint.
            but: Paths that are not compared, as ``general`` writes them.
        """
        found = []
        for path, here in self.parts.items():
            there = other.parts.get(path, ABSENT)
            if not alike(here, there) and general(path) not in but and (there is not ABSENT or other.complete):
                found.append((path, here, there))
        if self.complete:
            found += [
                (path, ABSENT, there)
                for path, there in other.parts.items()
                if path not in self.parts and general(path) not in but
            ]
        return found


def fingerprint(simulation: Any, own: Callable[[Any], Any] | None = None) -> Fingerprint:
    """Return the fingerprint of a simulation.

    Args:
        simulation: The simulation.
        own: The user's callable of the simulation that returns what is compared. Without it: the simulation's own
            ``state()``, or else all its attributes.
    """
    tell = getattr(simulation, "state", None)
    if own is not None:
        return _written("fingerprint", own(simulation))
    return _written("state()", tell()) if callable(tell) else _written("simulation", simulation)


def _written(name: str, root: Any) -> Fingerprint:
    parts: dict[str, Any] = {}
    left_out: set[str] = set()
    met: dict[int, str] = {}
    kept = []  # keeps temporary objects alive, so that their ids are not reused
    # Breadth first, so that a long history in the model does not hide the rest.
    left = deque([(name, root)])
    while left and len(parts) < MOST_PARTS:
        path, value = left.popleft()
        if isinstance(value, _ATOMS) and not isinstance(value, Enum):
            parts[path] = value
        elif isinstance(value, np.ndarray) and value.dtype != object:
            parts[path] = value.copy()
        elif isinstance(value, np.generic):
            parts[path] = value
        elif isinstance(value, Enum):
            parts[path] = str(value)
        elif isinstance(value, _NAMED):
            parts[path] = title(value)
        elif id(value) in met:
            parts[path] = f"the same object as {met[id(value)]}"
        else:
            if not isinstance(value, (tuple, frozenset)):  # equal ones may or may not be the same object
                met[id(value)] = path
            kept.append(value)
            parts[path] = title(type(value))
            inside = _inside(path, value)
            if inside is None:
                left_out.add(title(type(value)))
            else:
                left += inside
    return Fingerprint(parts, frozenset(left_out), not left)


def _inside(path: str, value: Any) -> Iterator[tuple[str, Any]] | None:
    """Return what a value holds, by path; None if that is unknown."""
    if isinstance(value, (set, frozenset, weakref.WeakSet)):
        return _of_set(path, value)
    if isinstance(value, random.Random):
        return iter([(f"{path} (state of the generator)", str(value.getstate()))])
    if isinstance(value, (np.random.Generator, np.random.RandomState)):
        bits = value.bit_generator if isinstance(value, np.random.Generator) else value._bit_generator
        return iter([(f"{path} (state of the generator)", str(bits.state))])
    if isinstance(value, weakref.ref):
        return iter([(f"{path}()", value())])
    if isinstance(value, MethodType):
        return iter([(f"{path}.__func__", value.__func__), (f"{path}.__self__", value.__self__)])
    if isinstance(value, partial):
        return iter([(f"{path}.func", value.func), (f"{path}.args", value.args), (f"{path}.keywords", value.keywords)])
    if isinstance(value, np.ndarray):
        return _of_sequence(path, value.ravel())
    return _of_object(path, value)


def _of_object(path: str, value: Any) -> Iterator[tuple[str, Any]] | None:
    attributes = list(_attributes(path, value))
    known = bool(attributes)
    if isinstance(value, (list, tuple, deque)):
        attributes += _of_sequence(path, value)
        known = True
    elif isinstance(value, (dict, weakref.WeakKeyDictionary, weakref.WeakValueDictionary, Mapping)):
        attributes += _of_mapping(path, value)
        known = True
    if known or hasattr(value, "__dict__"):
        return iter(attributes)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            reduced = value.__reduce_ex__(4)
    except Exception:  # an open file, a lock, a generator, for whatever reason
        return None
    if isinstance(reduced, str):
        return iter([(f"{path} (itself)", reduced)])
    lists = [list(part) if number > 2 and part is not None else part for number, part in enumerate(reduced[:5])]
    return iter([(f"{path} (itself)", lists[1:])])


def _attributes(path: str, value: Any) -> Iterator[tuple[str, Any]]:
    kind = type(value)
    for name, part in list(getattr(value, "__dict__", {}).items()):
        if not isinstance(getattr(kind, name, None) if isinstance(name, str) else None, cached_property):
            yield f"{path}.{name}", part
    for owner in kind.__mro__:
        slots = vars(owner).get("__slots__", ())
        for name in [slots] if isinstance(slots, str) else slots:
            private = name.startswith("__") and not name.endswith("__")
            held = f"_{owner.__name__.lstrip('_')}{name}" if private else name
            if name not in ("__dict__", "__weakref__") and hasattr(value, held):
                yield f"{path}.{name}", getattr(value, held)


def _of_sequence(path: str, values: Any) -> Iterator[tuple[str, Any]]:
    return ((f"{path}[{number}]", value) for number, value in enumerate(values))


def _of_mapping(path: str, values: Any) -> Iterator[tuple[str, Any]]:
    for number, (key, value) in enumerate(list(values.items())):
        if isinstance(key, (*_ATOMS, np.generic, tuple, Enum)) and len(shown := repr(key)) < 80:
            yield f"{path}[{shown}]", value
        else:
            yield f"{path} (key {number})", key
            yield f"{path}[key {number}]", value


def _of_set(path: str, values: Any) -> Iterator[tuple[str, Any]]:
    """Return the parts of a set. It has no order: of objects that are not atoms, only the number of each kind."""
    atoms = sorted(repr(value) for value in values if isinstance(value, _ATOMS))
    others = Counter(title(type(value)) for value in values if not isinstance(value, _ATOMS))
    return iter([(f"{path} (members)", ", ".join(atoms)), (f"{path} (kinds)", str(sorted(others.items())))])


def general(path: str) -> str:
    """Return a path that is the same for all members of a list or dict."""
    return re.sub(r"\[[^\]]*\]", "[]", path)


def title(thing: Any) -> str:
    """Return the name of a class, function or module."""
    name = getattr(thing, "__qualname__", None) or getattr(thing, "__name__", None)
    return str(name) if name else type(thing).__qualname__


def alike(one: Any, other: Any) -> bool:
    """Return whether two values (atoms, arrays and containers of these) are the same, bit for bit."""
    if type(one) is not type(other):
        return False
    if isinstance(one, (np.ndarray, np.generic)):
        return bool(one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes())
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(alike(value, other[key]) for key, value in one.items())
    if isinstance(one, (list, tuple)):
        return len(one) == len(other) and all(map(alike, one, other))
    return bool(one == other or (one != one and other != other))


def brief(value: Any, depth: int = 3) -> Any:
    """Return what is cheap to compare of a rule's result: atoms, arrays, containers of these; else its kind."""
    if isinstance(value, _ATOMS) and not isinstance(value, Enum):
        return value
    if isinstance(value, (np.ndarray, np.generic)) and value.dtype != object:
        return value.copy()
    if depth and isinstance(value, (list, tuple)) and len(value) <= 1000:
        return [type(value).__name__, *(brief(part, depth - 1) for part in value)]
    if depth and type(value) is dict and len(value) <= 1000:
        return {"dict": [(brief(key, depth - 1), brief(part, depth - 1)) for key, part in value.items()]}
    return f"<{title(type(value))}>" if not isinstance(value, Enum) else str(value)


def shown(value: Any, most: int = 60) -> str:
    """Return a value as a short text."""
    if value is ABSENT:
        return "nothing"
    text = " ".join(repr(value).split())
    return text if len(text) <= most else f"{text[: most - 4]} ..."


def differences_in_words(parts: list[tuple[str, Any, Any]], here: str = "first", there: str = "then") -> str:
    """Describe the differences of two fingerprints."""
    listed = [f"{path} is {here} {shown(left)}, {there} {shown(right)}" for path, left, right in parts[:3]]
    more = f"; {len(parts) - 3} more" if len(parts) > 3 else ""
    return "; ".join(listed) + more
