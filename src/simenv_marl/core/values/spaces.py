"""Observations: casts to their space, copies, comparisons, and blank observations.

Each space is analysed once, when an environment is made. The functions that run at each decision
are closures over the result.
"""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable, Mapping
from sys import getrefcount
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ...errors import ObservationError, short_repr
from ...simulation import Sentinel

Cast = Callable[[Any], Any]
"""Takes an observation. Returns it cast to its space's dtype, with no memory shared."""


def observation_cast(space: spaces.Space[Any]) -> Cast:
    """Make the function that casts observations to a space, or raises ``ObservationError`` if they do not fit."""
    if isinstance(space, (spaces.Box, spaces.MultiBinary, spaces.MultiDiscrete)):
        return _array_cast(space)
    if isinstance(space, spaces.Discrete):
        return _discrete_cast(space)
    if isinstance(space, spaces.Dict):
        return _dict_cast(space)
    if isinstance(space, spaces.Tuple):
        return _tuple_cast(space)

    def cast(value: Any) -> Any:
        if not space.contains(value):
            raise ObservationError(
                f"the observation {short_repr(value)} is not in {short_repr(space)}"
            )
        return copy.deepcopy(value)

    return cast


def _array_cast(space: spaces.Box | spaces.MultiBinary | spaces.MultiDiscrete) -> Cast:
    ndarray, dtype, shape = np.ndarray, space.dtype, space.shape
    fresh = _FRESH

    def cast(value: Any) -> NDArray[Any]:
        if type(value) is ndarray and value.dtype is dtype and value.shape == shape:
            # An array without any other reference needs no copy.
            if value.base is None and getrefcount(value) <= fresh:
                return value
            return value.copy()
        return _convert(value, space)

    return cast


def _convert(value: Any, space: spaces.Space[Any]) -> NDArray[Any]:
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
    assert space.dtype is not None
    if space.dtype.kind in "iu" and array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ObservationError(
            f"the observation {short_repr(value)} is not finite, and {space.dtype} holds only"
            " finite numbers"
        )
    if space.dtype.kind in "iu" and array.size and not np.can_cast(array.dtype, space.dtype):
        limits = np.iinfo(space.dtype)
        if array.min() < limits.min or array.max() > limits.max:
            raise ObservationError(
                f"the observation {short_repr(value)} has numbers that {space.dtype} cannot hold"
            )
    return array.astype(space.dtype, copy=True)


def _discrete_cast(space: spaces.Discrete) -> Cast:
    kind = space.dtype.type

    def cast(value: Any) -> Any:
        if type(value) is kind:
            return value
        if np.ndim(value) == 0:
            try:
                number = kind(value)
                if number == value:
                    return number
            except (TypeError, ValueError, OverflowError):
                pass
        raise ObservationError(
            f"the observation {short_repr(value)} must be an integer for {short_repr(space)}"
        )

    return cast


def _dict_cast(space: spaces.Dict) -> Cast:
    casts = {key: observation_cast(part) for key, part in space.spaces.items()}

    def cast(value: Any) -> dict[str, Any]:
        try:
            if len(value) == len(casts):
                return {key: part(value[key]) for key, part in casts.items()}
        except (TypeError, KeyError):
            pass
        raise ObservationError(
            f"the observation {short_repr(value)} must have exactly the keys"
            f" {short_repr(sorted(casts))} of {short_repr(space)}"
        )

    return cast


def _tuple_cast(space: spaces.Tuple[Any]) -> Cast:
    casts = tuple(observation_cast(part) for part in space.spaces)

    def cast(value: Any) -> tuple[Any, ...]:
        if not isinstance(value, (tuple, list)) or len(value) != len(casts):
            raise ObservationError(
                f"the observation {short_repr(value)} must have the {len(casts)} parts of"
                f" {short_repr(space)}"
            )
        return tuple(part(item) for part, item in zip(casts, value, strict=True))

    return cast


_UNCHANGING: Final = (np.generic, int, float, str, Sentinel)


def duplicate(observation: Any) -> Any:
    """Copy an observation, so that the receiver may change it."""
    if type(observation) is np.ndarray:
        return observation.copy()
    if isinstance(observation, _UNCHANGING):
        return observation
    if type(observation) is dict:
        return {key: duplicate(value) for key, value in observation.items()}
    if type(observation) is tuple:
        return tuple(duplicate(value) for value in observation)
    return copy.deepcopy(observation)


def same(one: Any, other: Any) -> bool:
    """Whether two observations are equal, number for number."""
    if isinstance(one, Mapping):
        return (
            isinstance(other, Mapping)
            and one.keys() == other.keys()
            and all(same(one[k], other[k]) for k in one)
        )
    if isinstance(one, (tuple, list)):
        return (
            isinstance(other, (tuple, list))
            and len(one) == len(other)
            and all(map(same, one, other))
        )
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other, equal_nan=one.dtype.kind == "f")
    return bool(one == other)


def blank(space: spaces.Space[Any]) -> Any:
    """Make the blank observation of an agent that was not observed yet: zero, clipped into the space.

    For spaces without a zero (text, graphs, ...) it is a fixed sample.
    """
    if isinstance(space, spaces.Box):
        return np.clip(np.zeros(space.shape, space.dtype), space.low, space.high).astype(
            space.dtype
        )
    if isinstance(space, spaces.Discrete):
        return space.dtype.type(np.clip(0, space.start, space.start + space.n - 1))
    if isinstance(space, spaces.MultiDiscrete):
        return np.clip(0, space.start, space.start + space.nvec - 1).astype(space.dtype)
    if isinstance(space, spaces.MultiBinary):
        return np.zeros(space.shape, space.dtype)
    if isinstance(space, spaces.Dict):
        return {key: blank(part) for key, part in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(blank(part) for part in space.spaces)
    sampled = copy.deepcopy(space)
    sampled.seed(0)
    return sampled.sample()


def _calibrate() -> int:
    """Count the references to an array that only the running ``cast`` holds.

    The number differs between versions of Python, so it is measured with a function of the same
    form. Without the global interpreter lock another thread may take a reference at any time, and
    so every array is copied.
    """
    if not getattr(sys, "_is_gil_enabled", lambda: True)():
        return -1
    seen: list[int] = []

    def cast(value: Any) -> Any:
        seen.append(getrefcount(value))
        return value

    cast(np.zeros(1))
    held = np.zeros(1)
    cast(held)
    return seen[0] if seen[0] < seen[1] else -1


_FRESH = _calibrate()
