"""Actions: checks against the action space, and masks of the legal actions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ..errors import MaskError, short_repr
from ..simulation import Sentinel
from .spaces import duplicate

ILLEGAL: Final = Sentinel("ILLEGAL")
"""An action check returns this for an action outside its space."""

Check = Callable[[Any], Any]
"""Takes an action. Returns it in the form that its mapping receives, or ``ILLEGAL``."""

MASK: Final = "action_mask"
"""The key of the action mask in infos and in observations, by the convention of PettingZoo and Gymnasium."""

_ONE_BYTE = "?bB"  # dtypes with one byte per number
_SMALL = 16  # up to this many elements, comparing Python floats is faster than four calls of NumPy


# -- checks ----------------------------------------------------------------------------------------


def action_check(space: spaces.Space[Any], *, clips: bool = False) -> Check:
    """Make the function that checks actions against a space.

    The function returns ``ILLEGAL`` for an action outside the space, a Python integer for an action
    of a ``Discrete``, and a scalar for a one-element ``Box`` unchanged. All other actions are
    copied, for a ``Box`` in its dtype. If it ``clips``, it clips the parts of actions that belong
    to a ``Box``.
    """
    if isinstance(space, spaces.Discrete):
        return _discrete_check(space)
    if isinstance(space, spaces.Box):
        return _box_check(space, clips)
    if isinstance(space, (spaces.Dict, spaces.Tuple)):
        return _parts_check(space, clips)

    def check(action: Any) -> Any:
        try:
            return duplicate(action) if space.contains(action) else ILLEGAL
        except Exception:  # some spaces raise for a value that is not in them
            return ILLEGAL

    return check


def _parts_check(space: spaces.Dict | spaces.Tuple[Any], clips: bool) -> Check:
    named = isinstance(space, spaces.Dict)
    parts: Any = space.spaces.items() if isinstance(space, spaces.Dict) else enumerate(space.spaces)
    checks: dict[Any, Check] = {key: action_check(part, clips=clips) for key, part in parts}

    def check(action: Any) -> Any:
        if not isinstance(action, Mapping if named else (tuple, list)) or len(action) != len(
            checks
        ):
            return ILLEGAL
        try:
            found = {key: check_part(action[key]) for key, check_part in checks.items()}
        except KeyError:
            return ILLEGAL
        if any(part is ILLEGAL for part in found.values()):
            return ILLEGAL
        return found if named else tuple(found.values())

    return check


def _discrete_check(space: spaces.Discrete) -> Check:
    low, high = int(space.start), int(space.start + space.n)
    integers = (int, np.integer, np.bool_)

    def check(action: Any) -> Any:
        if type(action) is not int:
            if isinstance(action, np.ndarray) and action.shape == ():
                action = action[()]
            if not isinstance(action, integers):
                return ILLEGAL
            action = int(action)
        if low <= action < high:
            return action
        return ILLEGAL

    return check


def _box_check(space: spaces.Box, clips: bool) -> Check:
    shape, dtype = space.shape, space.dtype
    lows, highs = space.low.ravel().tolist(), space.high.ravel().tolist()
    scalar, small = len(lows) == 1, len(lows) <= _SMALL
    kinds = "iu" if dtype.kind in "iu" else "iuf"

    ndarray, first_low, first_high = (
        np.ndarray,
        lows[0] if scalar else 0.0,
        highs[0] if scalar else -1.0,
    )

    def legal(array: NDArray[Any]) -> bool:
        if not small:
            return bool(((array >= space.low) & (array <= space.high)).all())
        return all(
            low <= value <= high
            for low, value, high in zip(lows, array.ravel().tolist(), highs, strict=True)
        )

    def check(action: Any) -> Any:
        if type(action) is ndarray and action.dtype is dtype and action.shape == shape:
            if first_low <= action.item() <= first_high if scalar else legal(action):
                return action.copy()
        elif type(action) is float and kinds == "iuf" and first_low <= action <= first_high:
            return action
        try:
            given = array = np.asarray(action)
        except (ValueError, TypeError):
            return ILLEGAL
        if array.dtype.kind not in kinds or (
            array.shape != shape and not (scalar and array.shape == ())
        ):
            return ILLEGAL
        if clips:
            bounds = [bound.reshape(array.shape) for bound in (space.low, space.high)]
            # as integers of Python, because NumPy has no type for both int64 and uint64
            if kinds == "iu":
                array, *bounds = (part.astype(object) for part in (array, *bounds))
            # of a single integer, NumPy returns no array
            array = np.asarray(np.clip(array, *bounds))
        # before the cast, because the cast may wrap integers around
        if kinds == "iu" and not legal(array):
            return ILLEGAL
        with np.errstate(over="ignore"):
            cast = array.astype(dtype, copy=True)
        # after the cast, so that a bound is legal in every precision
        if kinds != "iu" and not legal(cast):
            return ILLEGAL
        if array.shape == shape:
            return cast
        return action if array == given else cast.item()

    return check


# -- masks ----------------------------------------------------------------------------------------


def mask_cast(space: Any) -> Callable[[Any], Any]:
    """Make the function that casts a mask of the legal actions to np.int8.

    That of a ``MultiDiscrete`` is a tuple.

    It raises ``MaskError`` for another shape, for values other than 0 and 1, and if no action is
    legal.
    """
    if isinstance(space, spaces.MultiDiscrete):
        parts = [_mask_of(int(number), space) for number in space.nvec.ravel()]

        def cast(value: Any) -> Any:
            if not isinstance(value, (tuple, list)) or len(value) != len(parts):
                raise MaskError(
                    f"the mask {short_repr(value)} must have the {len(parts)} parts of"
                    f" {short_repr(space)}"
                )
            return tuple(part(item) for part, item in zip(parts, value, strict=True))

        return cast
    return _mask_of(int(space.n), space)


def _mask_of(number: int, space: spaces.Space[Any]) -> Callable[[Any], NDArray[np.int8]]:
    shape, int8 = (number,), np.dtype(np.int8)

    def cast(value: Any) -> NDArray[np.int8]:
        mask = np.asarray(value)
        if mask.shape != shape:
            raise MaskError(
                f"the mask {short_repr(value)} has shape {mask.shape}; {short_repr(space)} needs"
                f" {shape}"
            )
        if mask.dtype.char not in _ONE_BYTE:
            given, mask = mask, mask.astype(bool)
            if not (mask == given).all():
                raise MaskError(f"the mask {short_repr(value)} has values other than 0 and 1")
        marks = mask.tobytes()  # comparing bytes is faster than three calls of NumPy
        if marks.strip(b"\0\1"):
            raise MaskError(f"the mask {short_repr(value)} has values other than 0 and 1")
        if 1 not in marks:
            raise MaskError(
                f"the mask {short_repr(value)} leaves no legal action of {short_repr(space)}"
            )
        return mask.astype(int8)

    return cast


def open_mask(space: Any) -> Any:
    """Make the mask of an action space that allows every action."""
    if isinstance(space, spaces.MultiDiscrete):
        return tuple(np.ones(int(number), np.int8) for number in space.nvec.ravel())
    return np.ones(int(space.n), np.int8)


def mask_allows(space: Any, mask: Any, action: Any) -> bool:
    """Whether a mask that ``mask_cast`` returned allows an action of the space."""
    if isinstance(space, spaces.MultiDiscrete):
        choices = (action - space.start).ravel()
        return all(part[choice] for part, choice in zip(mask, choices, strict=True))
    return bool(mask[action - int(space.start)])


def only_choice(space: spaces.Space[Any], mask: Any) -> Any:
    """The only action that a mask of ``mask_cast`` allows (None: all are legal).

    None if there are several.
    """
    if isinstance(space, spaces.MultiDiscrete):
        parts = open_mask(space) if mask is None else mask
        if any(np.count_nonzero(part) != 1 for part in parts):
            return None
        chosen = np.array([np.argmax(part) for part in parts], space.dtype).reshape(space.shape)
        return (chosen + space.start).astype(space.dtype)
    if (
        not isinstance(space, spaces.Discrete)
        or (int(space.n) if mask is None else np.count_nonzero(mask)) != 1
    ):
        return None
    return int(space.start) + (0 if mask is None else int(np.argmax(mask)))
