"""The arguments of an agent's latest decision. The environment keeps nothing of the model alive.

Mappings read them again when the agent ends, and at the returns of rounds. Objects of the model are
held by weak references, also inside of lists, tuples, dicts, sets and deques.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from copy import copy
from functools import partial
from operator import is_
from types import BuiltinFunctionType, FunctionType, MethodType
from typing import Final
from weakref import ReferenceType, ref

from ...hooks.hook import BOUND
from ...simulation import Model, Sentinel
from ..plans.point import Args, Kwargs, Point

_ATOMS: Final[frozenset[type]] = frozenset((bool, bytes, complex, float, int, str, type(None)))
"""Types of values that refer to nothing."""

_KEPT: Final = (*_ATOMS, BuiltinFunctionType, FunctionType, MethodType, type)
"""Types of values that are kept: numbers, text, functions and classes."""

_CONTAINERS: Final[frozenset[type]] = frozenset((deque, dict, list, set))
"""Types of containers that a model may empty after a decision."""

_LIBRARY: Final = __name__.partition(".")[0]

GONE: Final = Sentinel("GONE")
"""The place of an object that the model has freed."""


def freed(args: Args, kwargs: Kwargs) -> set[int | str]:
    """Return the numbers and the keywords of the arguments that the model has freed."""
    gone: set[int | str] = set()
    for place, value in enumerate(args):
        if value is GONE:
            gone.add(place)
    for key, value in kwargs.items():
        if value is GONE:
            gone.add(key)
    return gone


class Arguments:
    """The arguments of the latest decision of an agent, as far as mappings take them.

    Attributes:
        first: Returns the first argument. None if the model has freed it.
        is_single: Whether it is the only argument that mappings take, and held weakly.
        is_empty: Whether no arguments are held.
    """

    __slots__ = ("_args", "_filled", "_kwargs", "_point", "first", "is_empty", "is_single")

    def __init__(self, point: Point) -> None:
        """Prepare to hold the arguments of decisions at a point."""
        self._point = point
        self._filled: set[int | str] = set()  # the places of containers that were not empty
        self.first: Callable[[], Model] = _nothing
        self.is_single = False
        self.is_empty = True
        self._args: Args = ()
        self._kwargs: Kwargs = BOUND

    def store(self, args: Args, kwargs: Kwargs) -> None:
        """Hold the arguments of a call."""
        self.is_empty = False
        self._args = tuple(map(weaken, args[: self._point.taken_places]))
        self._kwargs = BOUND
        keys = self._point.taken_keys
        if kwargs and (keys is None or keys):
            self._kwargs = {
                key: weaken(value) for key, value in kwargs.items() if keys is None or key in keys
            }
        self._filled = _filled(args[: len(self._args)], kwargs)
        first = _nothing
        if args:
            held = self._args[0] if self._args else weaken(args[0])
            if isinstance(held, (ReferenceType, _Held)):
                first = held
            elif type(held) not in _ATOMS:  # of a class without weak references
                first = partial(_same, held)
        self.first = first
        self.is_single = (
            isinstance(first, ReferenceType) and len(self._args) == 1 and not self._kwargs
        )

    def recall(self) -> tuple[Args, Kwargs]:
        """Return the held arguments, with ``GONE`` in place of each that the model has freed."""
        if self.is_single:
            entity = self.first()
            return (GONE if entity is None else entity,), BOUND
        args = tuple(map(restore, self._args))
        return args, {key: restore(value) for key, value in self._kwargs.items()}

    def emptied(self, args: Args, kwargs: Kwargs) -> set[int | str]:
        """Return the numbers and the keywords of containers that the model has emptied since.

        ``args`` and ``kwargs``: what ``recall`` has returned.
        """
        empty = self._filled - _filled(args, kwargs)
        if empty:
            held: dict[int | str, Model] = dict(enumerate(self._args))
            held.update(self._kwargs)
            empty = {key for key in empty if not _is_rebuilt(held.get(key))}
        return empty


def _filled(args: Args, kwargs: Kwargs) -> set[int | str]:
    """Return the numbers and the keywords of the containers that are not empty."""
    filled: set[int | str] = set()
    for place, value in enumerate(args):
        if type(value) in _CONTAINERS and value:
            filled.add(place)
    for key, value in kwargs.items():
        if type(value) in _CONTAINERS and value:
            filled.add(key)
    return filled


def _is_rebuilt(held: Model) -> bool:
    """Return whether a held container is made anew from its living elements."""
    return isinstance(held, _Held) and held.func is not _set


def _nothing() -> None:
    return None


def _same(value: Model) -> Model:
    return value


# -- values that are held weakly ------------------------------------------------------------------


class _Held(partial[Model]):
    """The place of a container with weakly held content. A call returns its living content."""


def _living(elements: Iterable[Model]) -> list[Model]:
    values = map(restore, elements)
    return [value for value in values if value is not GONE]


def _sequence(kind: Model, elements: list[Model]) -> Model:
    """Return a list or a tuple. A named tuple is gone with any of its elements."""
    living = _living(elements)
    if hasattr(kind, "_make"):
        return kind._make(living) if len(living) == len(elements) else GONE
    return tuple(living) if issubclass(kind, tuple) else living


def _dict(empty: dict[Model, Model], entries: list[Model]) -> Model:
    """Return a dict. Its entries go with their keys and with their values."""
    made = copy(empty)
    made.update(entry for entry in _living(entries) if len(entry) == 2)
    return made


def _set(reference: Callable[[], Model], kind: type, elements: list[Model]) -> Model:
    """Return a set or a deque: itself while the model holds it."""
    value = reference()
    return kind(_living(elements)) if value is None else value


def weaken(value: Model, outer: frozenset[int] = frozenset()) -> Model:
    """Return a value, or its place, which holds it weakly.

    Args:
        value: The value.
        outer: The identities of the containers around it, because a container may contain itself.
    """
    kind = type(value)
    if kind in _ATOMS or isinstance(value, _KEPT) or hasattr(kind, "__array__"):
        return value
    if isinstance(value, (list, tuple, dict, set, frozenset, deque)):
        return _weaken_container(value, outer)
    if kind.__module__.partition(".")[0] == _LIBRARY:
        return value
    if isinstance(value, ReferenceType):
        return _Held(_same, value)
    try:
        return ref(value)
    except TypeError:  # of a class without weak references
        return value


def _weaken_container(value: Model, outer: frozenset[int]) -> Model:
    kind = type(value)
    if kind.__module__ not in ("builtins", "collections"):
        with suppress(TypeError):
            return ref(value)  # because it is an object of the model
    if id(value) in outer:
        return value
    inner = outer | {id(value)}
    parts = list(value.items() if isinstance(value, dict) else value)
    elements = [weaken(part, inner) for part in parts]
    if not isinstance(value, (list, tuple, dict)):
        return _Held(_set, ref(value), kind, elements)
    if all(map(is_, elements, parts)):  # nothing is held in another form
        return value
    if not isinstance(value, dict):
        return _Held(_sequence, kind, elements)
    empty = copy(value)
    empty.clear()
    return _Held(_dict, empty, elements)


def restore(held: Model) -> Model:
    """Return the value of a place that ``weaken`` has returned. ``GONE`` if it was freed."""
    if isinstance(held, ReferenceType):
        value = held()
        return GONE if value is None else value
    return held() if type(held) is _Held else held
