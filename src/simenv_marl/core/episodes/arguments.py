"""The arguments of an agent's latest decision. The environment keeps nothing of the model alive.

Mappings read them again when the agent ends, and at the returns of rounds. Objects of the model are
held by weak references, also inside of lists, tuples, dicts, sets and deques.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from copy import copy
from functools import partial
from types import BuiltinFunctionType, FunctionType, MethodType
from typing import Final
from weakref import ReferenceType, ref

import numpy as np

from ...hooks.hook import BOUND
from ...simulation import Model
from ..plans.point import Args, Kwargs, Point

_ATOMS: Final = frozenset((bool, bytes, complex, float, int, str, type(None)))
"""Types of values that refer to nothing."""

_KEPT: Final = (
    BuiltinFunctionType, FunctionType, MethodType, complex, float, int, str, bytes, type,
    np.ndarray, np.generic,
)  # fmt: skip
"""Types of values that are kept: functions, classes, arrays, numbers and text."""

_LIBRARY: Final = __name__.partition(".")[0]


class _Gone:
    """The place of an object that the model has freed."""

    def __repr__(self) -> str:
        return "<an object that the model has freed>"


GONE: Final = _Gone()


class Recalled:
    """Arguments, as they were held.

    Attributes:
        args: The positional arguments that mappings take. ``GONE`` in place of those that are gone.
        kwargs: The keyword arguments that mappings take.
        is_whole: Whether none of them is gone.
    """

    __slots__ = ("args", "is_whole", "kwargs")

    def __init__(self, args: Args, kwargs: Kwargs) -> None:
        self.args = args
        self.kwargs = kwargs
        self.is_whole = GONE not in args and GONE not in kwargs.values()

    @property
    def places(self) -> set[int]:
        """The numbers of the positional arguments that are gone."""
        return {place for place, value in enumerate(self.args) if value is GONE}

    @property
    def keys(self) -> set[str]:
        """The keyword arguments that are gone."""
        return {key for key, value in self.kwargs.items() if value is GONE}


class Arguments:
    """The arguments of the latest decision of an agent, as far as mappings take them.

    Attributes:
        first: Returns the first argument. None if the model has freed it.
        is_single: Whether it is the only argument that mappings take, and held weakly.
        is_empty: Whether no arguments are held.
    """

    __slots__ = ("_args", "_keys", "_kwargs", "_number", "first", "is_empty", "is_single")

    def __init__(self, point: Point) -> None:
        """Prepare to hold the arguments of decisions at a point."""
        self._number = point.taken_places
        self._keys = point.taken_keys
        self.first: Callable[[], Model] = _nothing
        self.is_single = False
        self.is_empty = True
        self._args: tuple[Model, ...] = ()
        self._kwargs: Kwargs = BOUND

    def clear(self) -> None:
        """Hold nothing."""
        self.first = _nothing
        self.is_single = False
        self.is_empty = True
        self._args = ()
        self._kwargs = BOUND

    def store(self, args: Args, kwargs: Kwargs) -> None:
        """Hold the arguments of a call."""
        self.is_empty = False
        self.first = _nothing
        if args and type(args[0]) not in _ATOMS:
            try:
                self.first = ref(args[0])
            except TypeError:  # of a class without weak references
                self.first = partial(_same, args[0])
        if self._number is not None:
            args = args[: self._number]
        self._args = tuple(map(weaken, args))
        self._kwargs = BOUND
        if kwargs and self._keys != frozenset():
            self._kwargs = {
                key: weaken(value)
                for key, value in kwargs.items()
                if self._keys is None or key in self._keys
            }
        self.is_single = self._args == (self.first,) and self._kwargs is BOUND

    def recall(self) -> Recalled:
        """Return the arguments that are held, with those that are gone."""
        if self.is_single:
            entity = self.first()
            return Recalled((GONE if entity is None else entity,), BOUND)
        args = tuple(map(restore, self._args))
        kwargs = {key: restore(value) for key, value in self._kwargs.items()}
        return Recalled(args, kwargs)


def _nothing() -> None:
    return None


def _same(value: Model) -> Model:
    return value


# -- values that are held weakly ------------------------------------------------------------------


class _Held:
    """The place of a container that has weakly held content."""

    __slots__ = ()

    def restore(self) -> Model:
        """Return the container with its living elements."""
        raise NotImplementedError


class _Constant(_Held):
    """A weak reference that the model itself has passed."""

    __slots__ = ("_value",)

    def __init__(self, value: Model) -> None:
        self._value = value

    def restore(self) -> Model:
        return self._value


class _Sequence(_Held):
    """A list or a tuple. A named tuple is gone with any of its elements."""

    __slots__ = ("_elements", "_kind")

    def __init__(self, value: list[Model] | tuple[Model, ...], elements: list[Model]) -> None:
        self._elements = elements
        self._kind: Model = type(value)

    def restore(self) -> Model:
        elements = [restore(element) for element in self._elements]
        living = [element for element in elements if element is not GONE]
        if hasattr(self._kind, "_make"):
            return self._kind._make(living) if len(living) == len(elements) else GONE
        return tuple(living) if issubclass(self._kind, tuple) else living


class _Dict(_Held):
    """A dict. Its entries go with their keys and with their values."""

    __slots__ = ("_entries", "_shell")

    def __init__(self, value: dict[Model, Model], entries: list[tuple[Model, Model]]) -> None:
        self._entries = entries
        self._shell = copy(value)
        self._shell.clear()

    def restore(self) -> Model:
        made = copy(self._shell)
        for held_key, held_value in self._entries:
            key = restore(held_key)
            value = restore(held_value)
            if key is not GONE and value is not GONE:
                made[key] = value
        return made


class _Shared(_Held):
    """A set or a deque: itself while the model holds it, else one with its living elements."""

    __slots__ = ("_elements", "_make", "_reference")

    def __init__(self, value: Model, elements: list[Model]) -> None:
        self._elements = elements
        self._reference = ref(value)
        self._make: Callable[[list[Model]], Model] = type(value)

    def restore(self) -> Model:
        value = self._reference()
        if value is not None:
            return value
        elements = [restore(element) for element in self._elements]
        return self._make([element for element in elements if element is not GONE])


def weaken(value: Model, outer: frozenset[int] = frozenset()) -> Model:
    """Return a value, or what holds it weakly.

    Args:
        value: The value.
        outer: The identities of the containers around it, because a container may contain itself.
    """
    kind = type(value)
    if kind in _ATOMS or isinstance(value, _KEPT):
        return value
    if isinstance(value, (list, tuple, dict, set, frozenset, deque)):
        return _weaken_container(value, outer)
    if kind.__module__.partition(".")[0] == _LIBRARY or hasattr(kind, "__array__"):
        return value
    if isinstance(value, ReferenceType):
        return _Constant(value)
    try:
        return ref(value)
    except TypeError:  # of a class without weak references
        return value


def _weaken_container(value: Model, outer: frozenset[int]) -> Model:
    kind = type(value)
    if kind.__module__ not in ("builtins", "collections"):
        try:
            return ref(value)  # because it is an object of the model
        except TypeError:
            pass
    if id(value) in outer:
        return value
    inner = outer | {id(value)}
    if isinstance(value, dict):
        keys = [weaken(key, inner) for key in value]
        values = [weaken(part, inner) for part in value.values()]
        if _is_same(keys, value) and _is_same(values, value.values()):
            return value
        return _Dict(value, list(zip(keys, values, strict=True)))
    elements = [weaken(element, inner) for element in value]
    if not isinstance(value, (list, tuple)):
        return _Shared(value, elements)
    return value if _is_same(elements, value) else _Sequence(value, elements)


def _is_same(held: list[Model], values: Iterable[Model]) -> bool:
    """Return whether nothing is held in another form."""
    return all(one is other for one, other in zip(held, values, strict=True))


def restore(held: Model) -> Model:
    """Return a value that ``weaken`` has returned in another form. ``GONE`` if it was freed."""
    if isinstance(held, ReferenceType):
        value = held()
        return GONE if value is None else value
    return held.restore() if isinstance(held, _Held) else held
