"""Actions: checks against the action space, and masks of the legal actions."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from operator import le
from typing import Final, NoReturn

import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, Graph, MultiDiscrete, OneOf, Sequence, Tuple
from numpy import ndarray
from numpy.typing import ArrayLike, NDArray

from ...errors import InvalidActionError, MaskError, short_repr
from ...simulation import Action
from .spaces import ILLEGAL as ILLEGAL
from .spaces import Array, ArraySpace, Space, by_parts, duplicate

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


def action_check(space: Space, *, clips: bool = False, raises: bool = False) -> Check:
    """Make the function that checks actions against a space.

    The function returns ``ILLEGAL`` for an action outside the space, a Python integer for an action
    of a ``Discrete``, and a scalar for a one-element ``Box`` unchanged. All other actions are
    copied, for a ``Box`` in its dtype. If it ``clips``, it clips the parts of actions that belong
    to a ``Box``. If it ``raises``, an ``InvalidActionError`` names the illegal element instead.
    """

    def refuse(action: Action) -> NoReturn:
        raise InvalidActionError(f"{short_repr(action)} is not in {short_repr(space)}")

    def duplicate_legal(action: Action) -> Action:
        if not space.contains(action):
            return ILLEGAL
        is_list = isinstance(action, list) and isinstance(space, ArraySpace)
        return np.array(action, space.dtype) if is_list else duplicate(action)

    check: Check = duplicate_legal
    match space:
        case Discrete():
            check = _discrete_check(space)
        case Box():
            check = _box_check(space, clips)
        case Dict() | Tuple() | Sequence() | OneOf() | Graph():
            check = by_parts(space, partial(action_check, clips=clips, raises=True), refuse)
            if raises:
                return check
    if not raises and isinstance(space, (Box, Discrete)):
        return check

    def call(action: Action) -> Action:
        try:
            legal = check(action)
        except Exception:  # some spaces raise for a value outside
            legal = ILLEGAL
        return refuse(action) if raises and legal is ILLEGAL else legal

    return call


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
    is_integer = dtype.kind in "biu"  # bools are compared before the cast, too
    takes_float = is_scalar and not is_integer
    low, *_ = lows or [0.0]
    high, *_ = highs or [0.0]
    kinds = {"b": "biu", "f": "iuf"}.get(dtype.kind, "iu")

    def is_legal(array: Array) -> bool:
        if len(lows) > _SMALL:
            return bool(((array >= space.low) & (array <= space.high)).all())
        numbers = array.ravel().tolist()
        return all(map(le, lows, numbers)) and all(map(le, numbers, highs))

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


def mask_cast(space: Space) -> Callable[[ArrayLike], Mask]:
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
        marks = mask if mask.dtype.char in _ONE_BYTE else mask.astype(bool)
        legal = marks.tobytes()  # comparing bytes is faster than three calls of NumPy
        if legal.strip(b"\0\1") or (marks is not mask and not (marks == mask).all()):
            raise MaskError(f"the mask {short_repr(value)} has values other than 0 and 1")
        if 1 not in legal:
            raise MaskError(
                f"the mask {short_repr(value)} leaves no legal action of {short_repr(space)}"
            )
        return marks.astype(int8)

    return cast


def open_mask(space: Space) -> Mask:
    """Make the mask of an action space that allows every action."""
    if isinstance(space, Discrete):
        return np.ones(space.n, np.int8)
    assert isinstance(space, MultiDiscrete)
    return tuple(open_mask(Discrete(size)) for size in space.nvec.ravel())


def mask_allows(space: Space, mask: Mask, action: Action) -> bool:
    """Return whether a mask that ``mask_cast`` returned allows an action of the space."""
    if isinstance(space, Discrete):
        return bool(mask[action - int(space.start)])
    assert isinstance(space, MultiDiscrete)
    choices = (action - space.start).ravel().tolist()
    return all(part[choice] for part, choice in zip(mask, choices, strict=True))


def only_choice(space: Space, mask: Mask | None) -> Action:
    """Return the only legal action of a space; None if there are several.

    ``mask`` is a mask of ``mask_cast``. None: all actions are legal.
    """
    if not isinstance(space, (Discrete, MultiDiscrete)):
        return None
    if mask is None:
        mask = open_mask(space)
    choices = [np.flatnonzero(part) for part in (mask if isinstance(mask, tuple) else (mask,))]
    if any(len(legal) != 1 for legal in choices):
        return None
    choice = np.reshape(choices, space.shape or ()) + space.start
    return int(choice) if isinstance(space, Discrete) else choice.astype(space.dtype)
