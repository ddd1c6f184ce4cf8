"""Common spaces: one space that holds the observations or actions of agents with different ones.

A *code* turns a value of an agent's own space into one of the common space, or back.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, TypeAlias

import numpy as np
from gymnasium import spaces

from ...errors import InvalidActionError, ViewError, short_repr
from ...simulation import Action, Observation
from .actions import ILLEGAL, Check, Mask, action_check, open_mask
from .spaces import Array, Space, duplicate

Encode: TypeAlias = Callable[[Observation], Observation]
"""Turns an observation of an agent's own space into one of the common space."""


class ActionCode(Protocol):
    """Translates between the actions of an agent and those of the common space."""

    def decode(self, action: Action, mask: Mask | None) -> Action:
        """Return the agent's own action for a common one.

        Raises:
            InvalidActionError: The action is not legal.
        """

    def encode(self, action: Action) -> Action:
        """Return the common action for the agent's own one."""

    def widen(self, mask: Mask | None) -> Mask | None:
        """Return the mask of the common space. ``mask``: the agent's own; None: all is legal."""


# -- observations ---------------------------------------------------------------------------------


def common_observations(parts: Sequence[Space]) -> tuple[Space, list[Encode | None]]:
    """Return the common space of observations, and a code for each of the spaces.

    Equal spaces are the common one, and need no code. Others are flattened, and padded with zeros.

    Raises:
        ViewError: The spaces differ, and one cannot be flattened.
    """
    if all(part == parts[0] for part in parts):
        return parts[0], [None] * len(parts)
    flat = [_flat(part) for part in parts]
    size = max(part.shape[0] for part in flat)
    dtype = np.result_type(*(part.dtype for part in flat))
    # Zero is in the common space only where it pads one of the others.
    lows, highs = np.array([_padded_bounds(part, size) for part in flat]).swapaxes(0, 1)
    common = spaces.Box(lows.min(0).astype(dtype), highs.max(0).astype(dtype), dtype=dtype.type)
    return common, [_padding(part, size, dtype) for part in parts]


def _padded_bounds(part: spaces.Box, size: int) -> tuple[Array, Array]:
    padding = (0, size - part.shape[0])
    return np.pad(part.low, padding), np.pad(part.high, padding)


def _flat(part: Space) -> spaces.Box:
    flat = spaces.flatten_space(part)
    if not isinstance(flat, spaces.Box):
        raise ViewError(
            "observations in different spaces must be flattened to share one, and this space cannot"
            f" be: {part}"
        )
    return flat


def _padding(part: Space, size: int, dtype: np.dtype[np.generic]) -> Encode:
    def encode(observation: Observation) -> Observation:
        padded = np.zeros(size, dtype)
        flat = spaces.flatten(part, observation)
        padded[: len(flat)] = flat
        return padded

    return encode


# -- actions --------------------------------------------------------------------------------------


def common_actions(
    parts: Sequence[Space], *, clips: bool = False
) -> tuple[Space, list[ActionCode]]:
    """Return the common space of actions, and a code for each of the spaces.

    - Equal spaces are the common one.
    - Of ``Discrete`` spaces it is the largest. An agent's own actions come first.
    - Of ``Box`` spaces it is one vector in [-1, 1], scaled to the agent's own bounds.
    - Of both, the vector begins with a preference for each action of the largest ``Discrete``. The
      legal action with the largest preference is taken.

    ``clips``: actions are clipped to a vector's bounds.

    Raises:
        ViewError: A ``Box`` has no bounds, or a space is neither.
    """
    if all(part == parts[0] for part in parts):
        return parts[0], [_Same(parts[0])] * len(parts)
    sizes = [int(part.n) if isinstance(part, spaces.Discrete) else 0 for part in parts]
    lengths = [_length(part) if isinstance(part, spaces.Box) else 0 for part in parts]
    for part, size, length in zip(parts, sizes, lengths, strict=True):
        if not size and not length:
            raise ViewError(
                "agents with different action spaces share one where each is a Discrete or a Box,"
                f" not {part}"
            )
    most = max(sizes)
    longest = max(lengths)
    if not longest:
        numbers = [part for part in parts if isinstance(part, spaces.Discrete)]
        return spaces.Discrete(most), [_Numbered(part, most) for part in numbers]
    common = spaces.Box(-1.0, 1.0, (most + longest,), np.float32)
    check = action_check(common, clips=clips)
    codes: list[ActionCode] = []
    for part in parts:
        if isinstance(part, spaces.Discrete):
            codes.append(_Preferred(part, common, check, most))
        elif isinstance(part, spaces.Box):
            codes.append(_Scaled(part, common, check, most))
    return common, codes


def preferences(own: spaces.Discrete) -> tuple[spaces.Box, ActionCode]:
    """Return a vector of preferences for the actions of a ``Discrete``, and its code."""
    common = spaces.Box(-1.0, 1.0, (int(own.n),), np.float32)
    return common, _Preferred(own, common, action_check(common), int(own.n))


def _length(part: spaces.Box) -> int:
    if not part.is_bounded():
        raise ViewError(
            f"the bounds of {part} must be finite, so that actions in [-1, 1] can be scaled to them"
        )
    return int(np.prod(part.shape))


class _Same:
    """The code of an agent whose own space is the common one."""

    def __init__(self, own: Space) -> None:
        self._open = open_mask(own) if isinstance(own, spaces.Discrete) else None

    def decode(self, action: Action, mask: Mask | None) -> Action:
        return action

    def encode(self, action: Action) -> Action:
        return action

    def widen(self, mask: Mask | None) -> Mask | None:
        own: Mask | None = duplicate(self._open if mask is None else mask)
        return own


class _Numbered:
    """The code of a ``Discrete`` among larger ones."""

    def __init__(self, own: spaces.Discrete, most: int) -> None:
        self._own = own
        self._check = action_check(spaces.Discrete(most))
        self._most = most

    def decode(self, action: Action, mask: Mask | None) -> Action:
        number = self._check(action)
        if number is ILLEGAL:
            raise InvalidActionError(f"{short_repr(action)} is not in Discrete({self._most})")
        if number >= self._own.n:
            raise InvalidActionError(
                f"{short_repr(action)} is not an action of the agent, which has {self._own.n} of"
                f" the {self._most} actions"
            )
        return number + int(self._own.start)

    def encode(self, action: Action) -> Action:
        return int(action - self._own.start)

    def widen(self, mask: Mask | None) -> Mask:
        widened = np.zeros(self._most, np.int8)
        widened[: self._own.n] = 1 if mask is None else mask
        return widened


class _Vector:
    """The code of an agent whose actions are parts of a common vector."""

    def __init__(self, common: spaces.Box, check: Check, begin: int) -> None:
        self._begin = begin  # after the preferences
        self._size = common.shape[0]
        self._common = common
        self._check = check

    def _checked(self, action: Action) -> Array:
        legal = self._check(action)
        if legal is ILLEGAL:
            raise InvalidActionError(f"{short_repr(action)} is not in {short_repr(self._common)}")
        return np.atleast_1d(legal)


class _Scaled(_Vector):
    """The code of a ``Box``."""

    def __init__(self, own: spaces.Box, common: spaces.Box, check: Check, begin: int) -> None:
        super().__init__(common, check, begin)
        self._own = own
        self._low = own.low.ravel().astype(np.float64)
        self._width = own.high.ravel().astype(np.float64) - self._low
        self._end = begin + len(self._low)

    def decode(self, action: Action, mask: Mask | None) -> Action:
        parts = self._checked(action)[self._begin : self._end].astype(np.float64)
        values = self._low + (parts + 1.0) / 2.0 * self._width
        if self._own.dtype.kind != "f":
            values = np.rint(values)
        own = values.astype(self._own.dtype).reshape(self._own.shape)
        return np.clip(own, self._own.low, self._own.high)

    def encode(self, action: Action) -> Action:
        vector = np.zeros(self._size, np.float32)
        width = np.where(self._width > 0.0, self._width, 1.0)
        values = np.ravel(action) - self._low
        vector[self._begin : self._end] = np.clip(2.0 * values / width - 1.0, -1.0, 1.0)
        return vector

    def widen(self, mask: Mask | None) -> Mask | None:
        return np.ones(self._begin, np.int8) if self._begin else None


class _Preferred(_Vector):
    """The code of a ``Discrete`` beside a ``Box``: a preference for each action."""

    def __init__(self, own: spaces.Discrete, common: spaces.Box, check: Check, begin: int) -> None:
        super().__init__(common, check, begin)
        self._own = own
        self._numbers = _Numbered(own, begin)

    def decode(self, action: Action, mask: Mask | None) -> Action:
        preferences = self._checked(action)[: self._own.n]
        if mask is not None:
            preferences = np.where(mask, preferences, -np.inf)
        return int(preferences.argmax()) + int(self._own.start)

    def encode(self, action: Action) -> Action:
        vector = np.zeros(self._size, np.float32)
        vector[: self._begin] = -1.0
        vector[self._numbers.encode(action)] = 1.0
        return vector

    def widen(self, mask: Mask | None) -> Mask:
        return self._numbers.widen(mask)
