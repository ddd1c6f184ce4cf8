"""Fingerprints: the contents of a simulation after a run, to compare two runs.

Models need not be comparable. Therefore a fingerprint follows their attributes down to numbers,
strings, arrays and the states of random generators. Each of these *parts* has a path, which
reports show. Objects that cannot be followed (open files, generators, locks) are compared by class.
"""

from __future__ import annotations

import random
import re
from collections import deque
from collections.abc import Collection, Iterable, Iterator, Mapping
from enum import Enum
from functools import cached_property
from itertools import groupby
from types import (
    BuiltinFunctionType,
    EllipsisType,
    FunctionType,
    ModuleType,
)
from typing import Any, Final, NamedTuple

import numpy as np

from ..errors import name_of, short_repr
from ..simulation import Model, Sentinel

MOST_PARTS: Final = 50_000
"""The limit of parts. Larger models are compared by the parts that both fingerprints have."""

ABSENT: Final = Sentinel("nothing")
"""In a difference, the value of a part that one of the fingerprints does not have."""

STATE: Final = "state of the generator"
"""Stands in the path of the state of a random generator."""

STEP: Final = "in step"
"""Stands at the beginning of the path of a decision."""

_ATOMS: Final = (
    int,
    float,
    complex,
    str,
    bytes,
    bool,
    range,
    type(None),
    EllipsisType,
    Enum,
    np.generic,
)
_NAMED: Final = (type, FunctionType, BuiltinFunctionType, ModuleType)
_GENERATORS: Final = (random.Random, np.random.Generator, np.random.RandomState)

Fingerprint = dict[str, Any]
"""The parts of an object, by path."""


class Difference(NamedTuple):
    """A difference of two fingerprints: the path and values of a part, or ``ABSENT``."""

    path: str
    first: Model
    second: Model


def fingerprint(name: str, root: Model, *, follow: bool = True) -> Fingerprint:
    """Return the fingerprint of any object; all paths begin with its name.

    Without ``follow``, only lists, tuples and dicts are followed.
    """
    parts: Fingerprint = {}
    # Also keeps the objects alive, because a new object could reuse the id of a dead one.
    paths_by_id: dict[int, tuple[str, Model]] = {}
    # Breadth first, because a long history in the model would hide everything else.
    queue = deque([(name, root)])
    while queue and len(parts) < MOST_PARTS:
        path, value = queue.popleft()
        if isinstance(value, _ATOMS):
            parts[path] = value
        elif isinstance(value, np.ndarray) and value.dtype != object:
            parts[path] = value.copy()
        elif isinstance(value, _NAMED):
            parts[path] = name_of(value)
        elif isinstance(value, _GENERATORS):
            parts[f"{path} ({STATE})"] = _state_of(value)
        elif id(value) in paths_by_id:
            parts[path] = f"the same object as {paths_by_id[id(value)][0]}"
        else:
            parts[path] = name_of(type(value))
            if not follow and not isinstance(value, (list, tuple, dict)):
                continue
            # Python may share equal immutable objects between places, or not.
            if not isinstance(value, (tuple, frozenset)):
                paths_by_id[id(value)] = path, value
            try:
                queue += [(path + end, part) for end, part in _members(value)]
            except Exception:  # open files, locks and generators raise many types
                continue
    return parts


def _state_of(generator: Model) -> str:
    """Return the state of a random generator as a text."""
    if isinstance(generator, random.Random):
        return str(generator.getstate())
    if isinstance(generator, np.random.Generator):
        return str(generator.bit_generator.state)
    return str(generator.get_state(legacy=False))


def _members(value: Model) -> Iterator[tuple[str, Model]]:
    """Yield the attributes and items of an object, each with the last part of its path.

    Raises:
        Exception: The object does not show its contents.
    """
    attributes = object.__getstate__(value)
    for state in attributes if isinstance(attributes, tuple) else (attributes,):
        for name, part in (state or {}).items():
            # A cached property appears when it is first read, which does not change the model.
            if not isinstance(getattr(type(value), str(name), None), cached_property):
                yield f".{name}", part
    if isinstance(value, (set, frozenset)):
        # A set has no order, so other objects than atoms cannot be matched.
        texts = [repr(item) if isinstance(item, _ATOMS) else name_of(type(item)) for item in value]
        yield " (members)", sorted(texts)
    elif isinstance(value, (list, tuple, deque, np.ndarray)):
        for number, item in enumerate(value.flat if isinstance(value, np.ndarray) else value):
            yield f"[{number}]", item
    elif isinstance(value, Mapping):
        for number, (key, item) in enumerate(list(value.items())):
            if all(isinstance(part, _ATOMS) for part in (key if isinstance(key, tuple) else [key])):
                yield f"[{key!r}]", item
            else:
                yield f"[key {number}]", item
                yield f" (key {number})", key
    elif attributes is None and not hasattr(value, "__dict__"):
        # An iterator or a counter, for example: its pickle holds its position.
        state = value.__reduce_ex__(4)[1:]
        yield " (itself)", [list(part) if isinstance(part, Iterator) else part for part in state]


def differences(
    one: Fingerprint, other: Fingerprint, ignored: Collection[str] = ()
) -> list[Difference]:
    """Return the parts that differ, unless ``ignored`` has the general form of their path."""
    paths = list(dict.fromkeys([*one, *other]))
    if max(len(one), len(other)) >= MOST_PARTS:
        common = one.keys() & other.keys()
        paths = [path for path in paths if path in common or path.startswith(STEP)]
    parts = [Difference(path, one.get(path, ABSENT), other.get(path, ABSENT)) for path in paths]
    return [
        part
        for part in parts
        if _key(part.first) != _key(part.second) and generalize(part.path) not in ignored
    ]


def _key(value: Model) -> tuple[Model, ...]:
    """Return values that are equal for equal parts; arrays are compared bit for bit."""
    if isinstance(value, (np.ndarray, np.generic)):
        return type(value), value.dtype, value.shape, value.tobytes()
    is_nan = value != value
    return type(value), None if is_nan else value


def is_essential(path: str) -> bool:
    """Return whether a path is one of a decision or of a generator, which must not differ."""
    return path.startswith(STEP) or STATE in path


def generalize(path: str) -> str:
    """Return the general form of a path, which is the same for all members of a list or dict."""
    return re.sub(r"\[[^\]]*\]", "[]", path)


def describe_differences(parts: Iterable[Difference]) -> str:
    """Describe the first differences: of the decisions, and of the simulation."""
    lines = []
    for _, group in groupby(parts, lambda part: part.path.startswith(STEP)):
        texts = [
            f"{path} is first {short_repr(first, 60)}, then {short_repr(second, 60)}"
            for path, first, second in group
        ]
        if len(texts) > 3:
            texts[3:] = [f"{len(texts) - 3} more"]
        lines.append("; ".join(texts))
    return "\n".join(lines)
