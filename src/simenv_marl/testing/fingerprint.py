"""Fingerprints: everything that a simulation holds after a run, to compare two runs.

Models need not be comparable. Therefore their attributes are followed down to numbers, strings,
arrays and the states of random generators. Each of these *parts* has a path, which a difference
reports. What cannot be followed (open files, generators, locks) is compared by its class.
"""

from __future__ import annotations

import random
import re
from collections import deque
from collections.abc import Iterator, Mapping
from enum import Enum
from functools import cached_property
from types import BuiltinFunctionType, FunctionType, ModuleType
from typing import Any, Final

import numpy as np

from ..errors import name_of, short_repr
from ..simulation import Sentinel

MOST_PARTS: Final = 50_000  # larger models are compared by the parts that both fingerprints have
ABSENT: Final = Sentinel("nothing")  # in differences, the value of a part that does not exist
STATE: Final = "state of the generator"

_ATOMS: Final = (
    int,
    float,
    complex,
    str,
    bytes,
    bool,
    type(None),
    range,
    type(Ellipsis),
    Enum,
    np.generic,
)
_NAMED: Final = (type, FunctionType, BuiltinFunctionType, ModuleType)

Fingerprint = dict[str, Any]
"""The parts of an object, by path."""

Difference = tuple[str, Any, Any]
"""A path, the value here and the value there, of which one may be ``ABSENT``."""


def fingerprint(name: str, root: Any, *, follow: bool = True) -> Fingerprint:
    """Return the fingerprint of any object; all paths begin with its name.

    Without ``follow``, only lists, tuples and dicts are followed.
    """
    parts: Fingerprint = {}
    # paths of objects, which are referred to so that no id is used again
    found: dict[int, tuple[str, Any]] = {}
    # breadth first, so that a long history in the model does not hide the rest
    queue = deque([(name, root)])
    while queue and len(parts) < MOST_PARTS:
        path, value = queue.popleft()
        if isinstance(value, _ATOMS):
            parts[path] = value
        elif isinstance(value, np.ndarray) and value.dtype != object:
            parts[path] = value.copy()
        elif isinstance(value, _NAMED):
            parts[path] = name_of(value)
        elif isinstance(value, (random.Random, np.random.Generator, np.random.RandomState)):
            parts[f"{path} ({STATE})"] = _state_of(value)
        elif id(value) in found:
            parts[path] = f"the same object as {found[id(value)][0]}"
        else:
            parts[path] = name_of(type(value))
            if not follow and not isinstance(value, (list, tuple, dict)):
                continue
            # equal ones may or may not be the same object
            if not isinstance(value, (tuple, frozenset)):
                found[id(value)] = path, value
            try:
                queue += [(path + end, part) for end, part in _members(value)]
            except Exception:  # an open file, a lock, a generator, for whatever reason
                continue
    return parts


def _state_of(generator: Any) -> str:
    """Return the state of a random generator as a text."""
    if isinstance(generator, np.random.Generator):
        return str(generator.bit_generator.state)
    return str(
        generator.getstate()
        if isinstance(generator, random.Random)
        else generator.get_state(legacy=False)
    )


def _members(value: Any) -> Iterator[tuple[str, Any]]:
    """Yield what a value holds, by the end of its path. Raises an exception if that is unknown."""
    attributes = object.__getstate__(value)
    for state in attributes if isinstance(attributes, tuple) else (attributes,):
        for name, part in (state or {}).items():
            # computed when it is first read
            if not isinstance(getattr(type(value), str(name), None), cached_property):
                yield f".{name}", part
    if isinstance(value, (set, frozenset)):  # it has no order: of other objects, only the classes
        yield (
            " (members)",
            sorted(
                repr(item) if isinstance(item, _ATOMS) else name_of(type(item)) for item in value
            ),
        )
    elif isinstance(value, (list, tuple, deque, np.ndarray)):
        items = value.ravel() if isinstance(value, np.ndarray) else value
        yield from ((f"[{number}]", item) for number, item in enumerate(items))
    elif isinstance(value, Mapping):
        for number, (key, item) in enumerate(list(value.items())):
            simple = all(
                isinstance(part, _ATOMS) for part in (key if isinstance(key, tuple) else (key,))
            )
            yield f"[{key!r}]" if simple else f"[key {number}]", item
            if not simple:
                yield f" (key {number})", key
    # an iterator or a counter, for example
    elif attributes is None and not hasattr(value, "__dict__"):
        reduced = value.__reduce_ex__(4)
        yield (
            " (itself)",
            [list(part) if isinstance(part, Iterator) else part for part in reduced[1:]],
        )


def differences(
    one: Fingerprint, other: Fingerprint, ignored: frozenset[str] = frozenset()
) -> list[Difference]:
    """Return the differences in all parts but those whose paths, as ``general`` writes them, are ignored."""
    cut = max(len(one), len(other)) >= MOST_PARTS
    found = []
    for path in dict.fromkeys([*one, *other]):
        here, there = one.get(path, ABSENT), other.get(path, ABSENT)
        comparable = not cut or (path in one and path in other)
        if comparable and not _same(here, there) and general(path) not in ignored:
            found.append((path, here, there))
    return found


def _same(one: Any, other: Any) -> bool:
    """Return whether two parts are the same, bit for bit."""
    if type(one) is not type(other):
        return False
    if isinstance(one, (np.ndarray, np.generic)):
        return bool(
            one.dtype == other.dtype
            and one.shape == other.shape
            and one.tobytes() == other.tobytes()
        )
    return bool(one == other or (one != one and other != other))


def general(path: str) -> str:
    """Return a path that is the same for all members of a list or dict."""
    return re.sub(r"\[[^\]]*\]", "[]", path)


def describe_differences(parts: list[Difference]) -> str:
    """Describe the differences of two fingerprints."""
    texts = [
        f"{path} is first {short_repr(one, 60)}, then {short_repr(other, 60)}"
        for path, one, other in parts
    ]
    return "; ".join(texts[:3]) + (f"; {len(texts) - 3} more" if len(texts) > 3 else "")
