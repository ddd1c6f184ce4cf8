"""Observations: casts to their space, copies, comparisons, and blank observations.

An environment analyses each space once, when it is made. The functions that run at each decision
are closures over the result.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from copy import deepcopy
from functools import partial
from sys import getrefcount
from typing import Any, Final, NoReturn, TypeAlias

import numpy as np
from gymnasium import spaces
from gymnasium.spaces import (
    Box,
    Dict,
    Discrete,
    Graph,
    GraphInstance,
    MultiBinary,
    MultiDiscrete,
    OneOf,
    Sequence,
    Text,
    Tuple,
)
from gymnasium.vector.utils import batch_space
from numpy import ndarray
from numpy.typing import NDArray

from ...errors import InvalidActionError, ObservationError, short_repr
from ...simulation import Observation, Sentinel

ILLEGAL: Final = Sentinel("ILLEGAL")
"""An action check returns this for an action outside its space."""

Cast = Callable[[Observation], Observation]
"""Takes an observation. Returns it cast to its space's dtype, with no memory shared."""

Space: TypeAlias = spaces.Space[Any]

CompoundSpace: TypeAlias = "Dict | Tuple[Any]"
"""Spaces whose elements have parts."""

_REFUSALS: Final = (ObservationError, InvalidActionError)

Array: TypeAlias = NDArray[Any]

ArraySpace = Box | MultiBinary | MultiDiscrete
"""Spaces whose elements are arrays."""


# -- casts ----------------------------------------------------------------------------------------


def observation_cast(space: Space) -> Cast:
    """Make the function that casts observations to a space.

    It raises ``ObservationError`` for an observation that does not fit the space.
    """
    match space:
        case Box() | MultiBinary() | MultiDiscrete():
            return _array_cast(space)
        case Discrete():
            return _discrete_cast(space)
        case Dict() | Tuple() | Sequence() | OneOf() | Graph():
            return _parts_cast(space)

    def cast(value: Observation) -> Observation:
        if not space.contains(value):
            raise ObservationError(
                f"the observation {short_repr(value)} is not in {short_repr(space)}"
            )
        return deepcopy(value)

    return cast


def _references_to_fresh_argument() -> int:
    """Count the references to an array that only the called function refers to.

    The number differs between versions of Python, so a function with the form of ``cast`` measures
    it. The result is -1, which makes ``cast`` copy every array, if the number does not tell a fresh
    array from another one. Without the global interpreter lock it never does, because another
    thread may take a reference at any time.
    """
    if not getattr(sys, "_is_gil_enabled", lambda: True)():
        return -1

    def count(value: Array) -> int:
        return getrefcount(value)

    array = np.zeros(1)
    fresh = count(np.zeros(1))
    if fresh < count(array):
        return fresh
    return -1


_FRESH: Final = _references_to_fresh_argument()


def _array_cast(space: ArraySpace) -> Cast:
    # Local variables and comparisons by identity, because the cast runs at each decision.
    dtype = space.dtype
    shape = space.shape

    def cast(value: Observation) -> Array:
        if type(value) is ndarray and value.dtype is dtype and value.shape == shape:
            # An array without any other reference needs no copy.
            if value.base is None and getrefcount(value) <= _FRESH:
                return value
            return value.copy()
        return _convert(value, space)

    return cast


def _convert(value: Observation, space: ArraySpace) -> Array:
    """Convert an observation that is not yet an array of a space's dtype and shape."""
    dtype: np.dtype[Any] = space.dtype
    try:
        array = np.asarray(value)
    except ValueError as error:
        raise ObservationError(
            f"the observation {short_repr(value)} does not fit {short_repr(space)}: {error}"
        ) from error
    if array.shape != space.shape:
        raise ObservationError(
            f"the observation has shape {array.shape}, its space {short_repr(space)} has shape"
            f" {space.shape}; it was {short_repr(value)}"
        )
    if array.dtype.kind not in "biuf":
        raise ObservationError(
            f"the observation {short_repr(value)} has dtype {array.dtype}, which is not numeric"
        )
    if dtype.kind == "b" and not np.isin(array, (0, 1)).all():
        raise ObservationError(f"the observation {short_repr(value)} has numbers but 0 and 1")
    if dtype.kind in "iu" and array.size and not np.can_cast(array.dtype, dtype):
        limits = np.iinfo(dtype)
        if not (array.min() >= limits.min and array.max() <= limits.max):  # also for NaN
            raise ObservationError(
                f"the observation {short_repr(value)} has numbers that {dtype} cannot hold"
            )
    return array.astype(dtype)


def _discrete_cast(space: Discrete) -> Cast:
    integer = space.dtype.type

    def cast(value: Observation) -> Observation:
        if type(value) is integer:
            return value
        if np.ndim(value) == 0:
            try:
                number = integer(value)
                if number == value:
                    return number
            except (TypeError, ValueError, OverflowError):
                pass
        raise ObservationError(
            f"the observation {short_repr(value)} must be an integer for {short_repr(space)}"
        )

    return cast


def parts_of(space: CompoundSpace) -> dict[Any, Space]:
    """Return the spaces of the parts of a space, by key or by place."""
    return dict(space.spaces if isinstance(space, Dict) else enumerate(space.spaces))


def by_parts(
    space: Space,
    make: Callable[[Space], Cast],
    refuse: Callable[[Observation], NoReturn],
) -> Cast:
    """Make the function that calls a function for each part of a value, and joins the results.

    Args:
        space: The space of the values: a ``Dict``, ``Tuple``, ``Sequence``, ``OneOf`` or ``Graph``.
        make: Makes the function for the space of a part. Its error is raised with the part's name.
        refuse: Called with a value that does not have these parts.
    """
    if not isinstance(space, (Dict, Tuple)):
        return partial(_convert_items, space, make, refuse)
    is_tuple = isinstance(space, Tuple)
    functions = {key: make(part) for key, part in parts_of(space).items()}

    def call(value: Observation) -> Observation:
        key = None
        try:
            if len(value) == len(functions) and (not is_tuple or isinstance(value, (tuple, list))):
                parts = {}
                for key, function in functions.items():
                    parts[key] = function(value[key])
                return tuple(parts.values()) if is_tuple else parts
        except _REFUSALS as error:
            raise type(error)(f"in the element {key!r}: {error}") from error
        except (TypeError, LookupError):
            pass
        return refuse(value)

    return call


def _convert_items(
    space: Space,
    make: Callable[[Space], Cast],
    refuse: Callable[[Observation], Observation],
    value: Observation,
) -> Observation:
    """Do as a function of ``by_parts`` does, for elements with other parts each time.

    The parts become an element of a ``Dict`` or a ``Tuple``.
    """
    part: Any
    try:
        match space:
            case OneOf(spaces=options):
                key, item = value
                chosen = Dict({key: dict(enumerate(options))[key]})
                return np.int64(key), make(chosen)({key: item})[key]
            case Sequence(feature_space=part, stack=True):
                return make(batch_space(part, _size(part, value)))(value)
            case Sequence(feature_space=part) if not isinstance(value, (str, Mapping)):
                return make(Tuple([part] * len(value)))(list(value))
            case Graph(node_space=part):
                nodes, edges, links = value
                number = _size(part, nodes)
                parts = {"nodes": batch_space(part, number)}
                items = {"nodes": nodes}
                if edges is not None or links is not None:
                    part = space.edge_space
                    size = _size(part, edges)
                    parts["edges"] = batch_space(part, size)
                    parts["edge_links"] = Box(0, number - 1, (size, 2), np.int64)
                    items |= {"edges": edges, "edge_links": links}
                graph = make(Dict(parts))(items)
                ends = parts.get("edge_links")
                if ends is None or ends.contains(graph["edge_links"]):
                    return GraphInstance(*map(graph.get, GraphInstance._fields))
    except _REFUSALS:
        raise
    except (TypeError, ValueError, LookupError, AssertionError):
        pass
    return refuse(value)


def _size(space: Space, stack: Observation) -> int:
    """Return the number of elements of a space in a stack."""
    while isinstance(space, (Dict, Tuple)):
        key, space = next(iter(parts_of(space).items()))
        stack = stack[key]
    return len(stack)


def _parts_cast(space: Space) -> Cast:
    def refuse(value: Observation) -> NoReturn:
        expected = "parts"
        match space:
            case Dict() | Tuple():
                names = list(parts_of(space))
                expected = f"keys {names}" if isinstance(space, Dict) else f"{len(names)} parts"
            case Graph():
                expected = "nodes, edges, and edge_links, pairs of the numbers of nodes,"
        raise ObservationError(
            f"the observation {short_repr(value)} must have exactly the {expected} of"
            f" {short_repr(space)}"
        )

    return by_parts(space, observation_cast, refuse)


# -- copies, comparisons, blanks ------------------------------------------------------------------

_IMMUTABLE: Final = (np.generic, int, float, str, Sentinel)


def duplicate(observation: Observation) -> Observation:
    """Copy an observation, so that the receiver may change it."""
    # The frequent types come first, because this runs at each decision.
    if type(observation) is ndarray:
        return observation.copy()
    if isinstance(observation, _IMMUTABLE):
        return observation
    if type(observation) is dict:
        return {key: duplicate(value) for key, value in observation.items()}
    if type(observation) is tuple:
        return tuple(map(duplicate, observation))
    return deepcopy(observation)


def same(one: Observation, other: Observation) -> bool:
    """Return whether two observations are equal, number for number. NaN equals NaN."""
    match one:
        case Mapping():
            if not isinstance(other, Mapping):
                return False
            if one.keys() != other.keys():
                return False
            return all(same(one[key], other[key]) for key in one)
        case tuple() | list():
            if not isinstance(other, (tuple, list)):
                return False
            if len(one) != len(other):
                return False
            return all(map(same, one, other))
        case ndarray():
            return np.array_equal(one, other, equal_nan=one.dtype.kind == "f")
    return bool(one == other)


def blank(space: Space) -> Observation:
    """Make the blank observation of an agent that was not observed yet.

    It is zero, clipped into the space, or an empty text. For a space without a zero (graphs, ...),
    it is a fixed sample.
    """
    match space:
        case Box():
            return np.zeros(space.shape, space.dtype).clip(space.low, space.high)
        case Discrete(n=size) | MultiDiscrete(nvec=size):
            return np.clip(0, space.start, space.start + size - 1).astype(space.dtype)
        case MultiBinary():
            return np.zeros(space.shape, space.dtype)
        case Dict():
            return {key: blank(part) for key, part in space.items()}
        case Tuple():
            return tuple(map(blank, space))
        case Text(min_length=0):
            return ""
    unseeded = deepcopy(space)  # the user may have seeded the space itself
    unseeded.seed(0)
    return unseeded.sample()
