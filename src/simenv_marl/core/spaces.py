"""What goes through a space: observations are cast to it, actions and masks are checked against it.

Everything that can be known of a space is found out once, when an environment is made; what runs at
each decision are closures over it.
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

from ..errors import MaskError, ObservationError
from ..simulation import Sentinel

ILLEGAL: Final = Sentinel("ILLEGAL")
"""What an action check answers for an action outside its space."""

Cast = Callable[[Any], Any]
"""Takes an observation, returns it cast to its space's dtype and not shared."""

Check = Callable[[Any], Any]
"""Takes an action, returns it as its mapping is to receive it, or ``ILLEGAL``."""

MASK: Final = "action_mask"
"""Where PettingZoo and Gymnasium look for the legal actions, in infos and in observations."""

_SMALL = 16  # elements up to which comparing python floats beats four numpy calls


# -- observations ---------------------------------------------------------------------------------


def observation_cast(space: spaces.Space[Any]) -> Cast:
    """Make the function that casts observations to a space.

    Args:
        space: The observation space, of any kind.

    Returns:
        A function that raises ``ObservationError`` for what does not fit.
    """
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
            raise ObservationError(f"the observation {value!r} is not in {space}")
        return copy.deepcopy(value)

    return cast


def _array_cast(space: spaces.Box | spaces.MultiBinary | spaces.MultiDiscrete) -> Cast:
    ndarray, dtype, shape = np.ndarray, space.dtype, space.shape
    fresh = _FRESH

    def cast(value: Any) -> NDArray[Any]:
        if type(value) is ndarray and value.dtype is dtype and value.shape == shape:
            # An array that is held only here needs no copy in order not to be shared.
            if value.base is None and getrefcount(value) <= fresh:
                return value
            return value.copy()
        return _convert(value, space)

    return cast


def _convert(value: Any, space: spaces.Space[Any]) -> NDArray[Any]:
    try:
        array = np.asarray(value)
    except ValueError as error:
        raise ObservationError(f"the observation {value!r} is no array for {space}: {error}") from error
    if array.shape != space.shape:
        raise ObservationError(
            f"the observation has shape {array.shape}, its space {space} has shape {space.shape}; it was {value!r}"
        )
    if array.dtype.kind not in "biuf":
        raise ObservationError(f"the observation {value!r} has dtype {array.dtype}, which is no number")
    assert space.dtype is not None
    if space.dtype.kind in "iu" and array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ObservationError(f"the observation {value!r} is not finite, which {space.dtype} cannot hold")
    if space.dtype.kind in "iu" and array.size and not np.can_cast(array.dtype, space.dtype):
        limits = np.iinfo(space.dtype)
        if array.min() < limits.min or array.max() > limits.max:
            raise ObservationError(f"the observation {value!r} has numbers that {space.dtype} cannot hold")
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
        raise ObservationError(f"the observation {value!r} is no integer for {space}")

    return cast


def _dict_cast(space: spaces.Dict) -> Cast:
    casts = {key: observation_cast(part) for key, part in space.spaces.items()}

    def cast(value: Any) -> dict[str, Any]:
        try:
            if len(value) == len(casts):
                return {key: part(value[key]) for key, part in casts.items()}
        except (TypeError, KeyError):
            pass
        raise ObservationError(f"the observation {value!r} has not just the keys {sorted(casts)} of {space}")

    return cast


def _tuple_cast(space: spaces.Tuple[Any]) -> Cast:
    casts = tuple(observation_cast(part) for part in space.spaces)

    def cast(value: Any) -> tuple[Any, ...]:
        if not isinstance(value, (tuple, list)) or len(value) != len(casts):
            raise ObservationError(f"the observation {value!r} has not the {len(casts)} parts of {space}")
        return tuple(part(item) for part, item in zip(casts, value, strict=True))

    return cast


_UNCHANGING: Final = (np.generic, int, float, str, Sentinel)


def duplicate(observation: Any) -> Any:
    """Copy an observation, so that its receiver may change it."""
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
        return isinstance(other, Mapping) and one.keys() == other.keys() and all(same(one[k], other[k]) for k in one)
    if isinstance(one, (tuple, list)):
        return isinstance(other, (tuple, list)) and len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other, equal_nan=one.dtype.kind == "f")
    return bool(one == other)


def blank(space: spaces.Space[Any]) -> Any:
    """Make the observation of an agent of which nothing is known yet: zero, clipped into its space.

    Args:
        space: The observation space.

    Returns:
        An observation in the space; for kinds without a zero (text, graphs, ...) a fixed sample.
    """
    if isinstance(space, spaces.Box):
        return np.clip(np.zeros(space.shape, space.dtype), space.low, space.high).astype(space.dtype)
    if isinstance(space, spaces.Discrete):
        start, number = int(space.start), int(space.n)
        return space.dtype.type(min(max(0, start), start + number - 1))
    if isinstance(space, spaces.MultiDiscrete):
        zeros = np.zeros(space.shape, space.dtype)
        return np.clip(zeros, space.start, space.start + space.nvec - 1).astype(space.dtype)
    if isinstance(space, spaces.MultiBinary):
        return np.zeros(space.shape, space.dtype)
    if isinstance(space, spaces.Dict):
        return {key: blank(part) for key, part in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(blank(part) for part in space.spaces)
    sampled = copy.deepcopy(space)
    sampled.seed(0)
    return sampled.sample()


# -- actions --------------------------------------------------------------------------------------


def action_check(space: spaces.Space[Any]) -> Check:
    """Make the function that checks actions against a space.

    Integers for a ``Discrete`` come out as python integers, a scalar for a one-element ``Box`` as it went in,
    and all else as copies, for a ``Box`` in its dtype.

    Args:
        space: The action space, of any kind.

    Returns:
        A function that answers ``ILLEGAL`` for what is not in the space.
    """
    if isinstance(space, spaces.Discrete):
        return _discrete_check(space)
    if isinstance(space, spaces.Box):
        return _box_check(space)

    def check(action: Any) -> Any:
        try:
            return duplicate(action) if space.contains(action) else ILLEGAL
        except Exception:  # a space may choke on what is none of its elements
            return ILLEGAL

    return check


def _discrete_check(space: spaces.Discrete) -> Check:
    low, high = int(space.start), int(space.start + space.n)

    def check(action: Any) -> Any:
        if type(action) is not int:
            if isinstance(action, np.ndarray) and action.shape == ():
                action = action[()]
            if not isinstance(action, (int, np.integer, np.bool_)):
                return ILLEGAL
            action = int(action)
        return action if low <= action < high else ILLEGAL

    return check


def _box_check(space: spaces.Box) -> Check:
    shape, dtype = space.shape, space.dtype
    lows, highs = space.low.ravel().tolist(), space.high.ravel().tolist()
    scalar, small = len(lows) == 1, len(lows) <= _SMALL
    kinds = "iu" if dtype.kind in "iu" else "iuf"

    ndarray, first_low, first_high = np.ndarray, lows[0] if scalar else 0.0, highs[0] if scalar else -1.0

    def legal(array: NDArray[Any]) -> bool:
        if not small:
            return bool(((array >= space.low) & (array <= space.high)).all())
        return all(low <= value <= high for low, value, high in zip(lows, array.ravel().tolist(), highs, strict=True))

    def check(action: Any) -> Any:
        if type(action) is ndarray and action.dtype is dtype and action.shape == shape:
            if scalar:
                return action.copy() if first_low <= action.item() <= first_high else ILLEGAL
            return action.copy() if legal(action) else ILLEGAL
        if type(action) is float and kinds == "iuf" and first_low <= action <= first_high:
            return action
        try:
            array = np.asarray(action)
        except (ValueError, TypeError):
            return ILLEGAL
        if array.dtype.kind not in kinds or (array.shape != shape and not (scalar and array.shape == ())):
            return ILLEGAL
        if kinds == "iu":  # compared before the cast, which may wrap integers around
            cast = array.astype(dtype, copy=True) if legal(array) else None
        else:  # compared after the cast, so that a bound is legal in every precision
            with np.errstate(over="ignore"):
                cast = array.astype(dtype, copy=True)
            cast = cast if legal(cast) else None
        if cast is None:
            return ILLEGAL
        return cast if array.shape == shape else action

    return check


# -- masks ----------------------------------------------------------------------------------------


def mask_cast(space: spaces.Space[Any]) -> Callable[[Any], Any]:
    """Make the function that casts the legal actions to a mask of an action space.

    Args:
        space: A ``Discrete`` (mask of shape ``(n,)``) or ``MultiDiscrete`` (a tuple of masks).

    Returns:
        A function that gives the mask as new np.int8 arrays of 0 and 1, and raises ``MaskError`` for a
        mask of another shape, with other values or with no legal action.
    """
    if isinstance(space, spaces.MultiDiscrete):
        parts = [_mask_of(int(number), space) for number in space.nvec.ravel()]

        def cast(value: Any) -> Any:
            if not isinstance(value, (tuple, list)) or len(value) != len(parts):
                raise MaskError(f"the mask {value!r} has not the {len(parts)} parts of {space}")
            return tuple(part(item) for part, item in zip(parts, value, strict=True))

        return cast
    assert isinstance(space, spaces.Discrete)
    return _mask_of(int(space.n), space)


def _mask_of(number: int, space: spaces.Space[Any]) -> Callable[[Any], NDArray[np.int8]]:
    def cast(value: Any) -> NDArray[np.int8]:
        mask = np.asarray(value)
        if mask.shape != (number,):
            raise MaskError(f"the mask {value!r} has shape {mask.shape} and not ({number},), as {space} asks")
        legal = mask.astype(bool)
        if not (legal == mask).all():
            raise MaskError(f"the mask {value!r} has values other than 0 and 1")
        if not legal.any():
            raise MaskError(f"the mask {value!r} leaves no legal action of {space}")
        return legal.astype(np.int8)

    return cast


def open_mask(space: spaces.Space[Any]) -> Any:
    """Make the mask of an action space that allows everything."""
    if isinstance(space, spaces.MultiDiscrete):
        return tuple(np.ones(int(number), np.int8) for number in space.nvec.ravel())
    assert isinstance(space, spaces.Discrete)
    return np.ones(int(space.n), np.int8)


def mask_allows(space: spaces.Space[Any], mask: Any, action: Any) -> bool:
    """Whether a mask of ``mask_cast`` allows an action that is in the space."""
    if isinstance(space, spaces.MultiDiscrete):
        choices = (action - space.start).ravel()
        return all(part[choice] for part, choice in zip(mask, choices, strict=True))
    assert isinstance(space, spaces.Discrete)
    return bool(mask[action - int(space.start)])


# -- freshness ------------------------------------------------------------------------------------


def _calibrate() -> int:
    """Count the references to an array that only the running ``cast`` holds.

    The number differs between versions of Python, so it is measured on a function of the same shape.
    Without a global lock another thread may take a reference at any time: then nothing is ever fresh.
    """
    if not getattr(sys, "_is_gil_enabled", lambda: True)():
        return -1
    seen: list[int] = []

    def cast(value: Any) -> Any:
        seen.append(getrefcount(value))
        return value

    def mapping() -> NDArray[Any]:
        return np.zeros(1)

    cast(mapping())
    held = np.zeros(1)
    cast(held)
    return seen[0] if seen[0] < seen[1] else -1


_FRESH = _calibrate()
