"""Actions: checks against the action space, and masks of the legal actions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, MultiDiscrete, Space, Tuple
from numpy import ndarray
from numpy.typing import ArrayLike, NDArray

from ...errors import MaskError, short_repr
from ...simulation import Action, Sentinel
from .spaces import duplicate, parts_of

ILLEGAL: Final = Sentinel("ILLEGAL")
"""An action check returns this for an action outside its space."""

Check = Callable[[Action], Action]
"""Takes an action. Returns it in the form that its mapping receives, or ``ILLEGAL``."""

Mask = NDArray[np.int8] | tuple["Mask", ...]
"""The legal actions: of a ``Discrete`` an array ``(n,)`` of 0 and 1, of a ``MultiDiscrete`` a tuple
with such an array for each component.
"""

MASK: Final = "action_mask"
"""The key of the action mask in infos and in observations, as in PettingZoo and Gymnasium."""

_ONE_BYTE = "?bB"  # dtypes with one byte per number
_SMALL = 16  # up to this many elements, comparing Python floats is faster than NumPy


# -- checks ----------------------------------------------------------------------------------------


def action_check(space: Space[Any], *, clips: bool = False) -> Check:
    """Make the function that checks actions against a space.

    The function returns ``ILLEGAL`` for an action outside the space, a Python integer for an action
    of a ``Discrete``, and a scalar for a one-element ``Box`` unchanged. All other actions are
    copied, for a ``Box`` in its dtype. If it ``clips``, it clips the parts of actions that belong
    to a ``Box``.
    """
    match space:
        case Discrete():
            return _discrete_check(space)
        case Box():
            return _box_check(space, clips)
        case Dict() | Tuple():
            return _parts_check(space, clips)

    def check(action: Action) -> Action:
        try:
            if space.contains(action):
                return duplicate(action)
        except Exception:  # some spaces raise for a value outside
            pass
        return ILLEGAL

    return check


def _parts_check(space: Dict | Tuple[Any], clips: bool) -> Check:
    is_dict = isinstance(space, Dict)
    checks = {key: action_check(part, clips=clips) for key, part in parts_of(space).items()}

    def check(action: Action) -> Action:
        if not isinstance(action, Mapping if is_dict else (tuple, list)):
            return ILLEGAL
        if len(action) != len(checks):
            return ILLEGAL
        checked = {}
        for key, check_part in checks.items():
            try:
                part = check_part(action[key])
            except KeyError:
                return ILLEGAL
            if part is ILLEGAL:
                return ILLEGAL
            checked[key] = part
        if is_dict:
            return checked
        return tuple(checked.values())

    return check


def _discrete_check(space: Discrete) -> Check:
    low = int(space.start)
    high = low + int(space.n)
    integers = (int, np.integer, np.bool_)

    def check(action: Action) -> Action:
        if type(action) is not int:
            if isinstance(action, ndarray) and action.shape == ():
                action = action[()]
            if not isinstance(action, integers):
                return ILLEGAL
            action = int(action)
        if low <= action < high:
            return action
        return ILLEGAL

    return check


def _box_check(space: Box, clips: bool) -> Check:
    # Local variables and Python numbers, because the check runs at each decision.
    shape = space.shape
    dtype = space.dtype
    lows = space.low.ravel().tolist()
    highs = space.high.ravel().tolist()
    is_scalar = len(lows) == 1
    is_small = len(lows) <= _SMALL
    is_integer = dtype.kind in "iu"
    takes_float = is_scalar and not is_integer
    low = lows[0] if is_scalar else 0.0
    high = highs[0] if is_scalar else 0.0
    kinds = "iu" if is_integer else "iuf"

    def is_legal(array: NDArray[Any]) -> bool:
        if not is_small:
            return bool(((array >= space.low) & (array <= space.high)).all())
        return all(
            least <= value <= most
            for least, value, most in zip(lows, array.ravel().tolist(), highs, strict=True)
        )

    def check(action: Action) -> Action:
        if type(action) is ndarray and action.dtype is dtype and action.shape == shape:
            if low <= action.item() <= high if is_scalar else is_legal(action):
                return action.copy()
        elif takes_float and type(action) is float and low <= action <= high:
            return action
        try:
            array = np.asarray(action)
        except (ValueError, TypeError):
            return ILLEGAL
        if array.dtype.kind not in kinds:
            return ILLEGAL
        if array.shape != shape and not (is_scalar and array.shape == ()):
            return ILLEGAL
        numbers = array
        if clips:
            numbers = array.reshape(shape)
            if is_integer:
                # Python integers, because NumPy has no type for both int64 and uint64.
                numbers = numbers.astype(object)
            # An array again, because ``clip`` returns a Python integer without dimensions.
            numbers = np.asarray(np.clip(numbers, space.low, space.high))
        with np.errstate(over="ignore"):
            cast = numbers.astype(dtype)
        # The cast may wrap integers around, so they are compared before it. Floats are compared
        # after it, so that a bound is legal in every precision.
        if not is_legal(numbers if is_integer else cast):
            return ILLEGAL
        if array.shape == shape:
            return cast
        if numbers == array:
            return action
        return cast.item()

    return check


# -- masks ----------------------------------------------------------------------------------------


def mask_cast(space: Space[Any]) -> Callable[[ArrayLike], Mask]:
    """Make the function that casts a mask of the legal actions to np.int8.

    It raises ``MaskError`` for another shape, for values other than 0 and 1, and if no action is
    legal. A mask of a ``MultiDiscrete`` is a tuple or a list of masks.
    """
    if isinstance(space, MultiDiscrete):
        casts = [mask_cast(Discrete(size)) for size in space.nvec.ravel()]

        def cast_parts(value: ArrayLike) -> Mask:
            if not isinstance(value, (tuple, list)) or len(value) != len(casts):
                raise MaskError(
                    f"the mask {short_repr(value)} must have the {len(casts)} parts of"
                    f" {short_repr(space)}"
                )
            return tuple(part(item) for part, item in zip(casts, value, strict=True))

        return cast_parts
    assert isinstance(space, Discrete)
    shape = (int(space.n),)
    int8 = np.dtype(np.int8)

    def cast(value: ArrayLike) -> Mask:
        mask = np.asarray(value)
        if mask.shape != shape:
            raise MaskError(
                f"the mask {short_repr(value)} has shape {mask.shape}; {short_repr(space)} needs"
                f" {shape}"
            )
        if mask.dtype.char not in _ONE_BYTE:
            numbers = mask
            mask = numbers.astype(bool)
            if not (mask == numbers).all():
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


def open_mask(space: Space[Any]) -> Mask:
    """Make the mask of an action space that allows every action."""
    if isinstance(space, Discrete):
        return np.ones(space.n, np.int8)
    assert isinstance(space, MultiDiscrete)
    return tuple(np.ones(size, np.int8) for size in space.nvec.ravel())


def mask_allows(space: Space[Any], mask: Mask, action: Action) -> bool:
    """Return whether a mask that ``mask_cast`` returned allows an action of the space."""
    if isinstance(space, Discrete):
        return bool(mask[action - int(space.start)])
    assert isinstance(space, MultiDiscrete)
    choices = (action - space.start).ravel().tolist()
    return all(part[choice] for part, choice in zip(mask, choices, strict=True))


def only_choice(space: Space[Any], mask: Mask | None) -> Action:
    """Return the only legal action of a space; None if there are several.

    ``mask`` is a mask of ``mask_cast``. None: all actions are legal.
    """
    match space:
        case Discrete():
            if mask is None and space.n == 1:
                return int(space.start)
            if mask is not None and np.count_nonzero(mask) == 1:
                return int(space.start + np.argmax(mask))
        case MultiDiscrete():
            parts = open_mask(space) if mask is None else mask
            if all(np.count_nonzero(part) == 1 for part in parts):
                choices = np.array([np.argmax(part) for part in parts]).reshape(space.shape)
                return (choices + space.start).astype(space.dtype)
    return None
