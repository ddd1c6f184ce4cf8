"""Common spaces: one space that holds the observations or actions of agents with different ones.

A *code* turns a value of an agent's own space into one of the common space, or back.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from gymnasium import spaces

from ...errors import InvalidActionError, ViewError, short_repr
from ...simulation import Action, Observation
from .actions import ILLEGAL, Mask, action_check, open_mask
from .spaces import Array, Space, duplicate

Encode: TypeAlias = Callable[[Observation], Observation]
"""Turns an observation of an agent's own space into one of the common space."""


# -- observations ---------------------------------------------------------------------------------


def common_observations(parts: Sequence[Space]) -> tuple[Space, list[Encode | None]]:
    """Return the common space of observations, and a code for each of the spaces.

    Equal spaces are the common one, and need no code. Others are flattened, and padded with zeros.

    Raises:
        ViewError: The spaces differ, and one cannot be flattened.
    """
    if all(part == parts[0] for part in parts):
        return parts[0], [None] * len(parts)
    flat: list[Any] = list(map(spaces.flatten_space, parts))
    for part, vector in zip(parts, flat, strict=True):
        if not isinstance(vector, spaces.Box):
            raise ViewError(
                "observations in different spaces must be flattened to share one, and this space"
                f" cannot be: {part}"
            )
    size = max(len(vector.low) for vector in flat)
    padded = [
        np.pad((vector.low, vector.high), ((0, 0), (0, size - len(vector.low)))) for vector in flat
    ]
    # Zero is in the common space only where it pads one of the others.
    lows, highs = np.swapaxes(padded, 0, 1)
    common = spaces.Box(lows.min(0), highs.max(0), dtype=lows.dtype.type)
    return common, [_padding(part, common) for part in parts]


def _padding(part: Space, common: spaces.Box) -> Encode:
    def encode(observation: Observation) -> Observation:
        padded = np.zeros(common.shape, common.dtype)
        flat: Any = spaces.flatten(part, observation)
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
        return parts[0], [ActionCode(parts[0], parts[0])] * len(parts)
    most = max(int(part.n) if isinstance(part, spaces.Discrete) else 0 for part in parts)
    longest = max(map(_length, parts))
    if not longest:
        numbers = spaces.Discrete(most)
        return numbers, [_Numbered(part, numbers, most) for part in parts]
    common = spaces.Box(-1.0, 1.0, (most + longest,), np.float32)
    return common, [
        (_Preferred if isinstance(part, spaces.Discrete) else _Scaled)(part, common, most, clips)
        for part in parts
    ]


def preferences(own: spaces.Discrete) -> tuple[spaces.Box, ActionCode]:
    """Return a vector of preferences for the actions of a ``Discrete``, and its code."""
    most = int(own.n)
    common = spaces.Box(-1.0, 1.0, (most,), np.float32)
    return common, _Preferred(own, common, most)


def _length(part: Space) -> int:
    """Return the number of an action's parts in a common vector, beside preferences."""
    if isinstance(part, spaces.Discrete):
        return 0
    if not isinstance(part, spaces.Box) or not part.low.size:
        raise ViewError(
            "agents with different action spaces share one where each is a Discrete or a Box, not"
            f" {part}"
        )
    if not part.is_bounded():
        raise ViewError(
            f"the bounds of {part} must be finite, so that actions in [-1, 1] can be scaled to them"
        )
    return part.low.size


class ActionCode:
    """Translates between the actions of an agent and those of a common space.

    This is the code of an agent whose own space is the common one.
    """

    def __init__(self, own: Space, common: Space, most: int = 0, clips: bool = False) -> None:
        """Translate actions. ``most``: the number of actions of the largest ``Discrete``."""
        self._own: Any = own
        self._common = common
        self._most = most
        self._check = action_check(common, clips=clips)

    def decode(self, action: Action, mask: Mask | None) -> Action:
        """Return the agent's own action for a common one.

        Raises:
            InvalidActionError: The action is not legal.
        """
        return action

    def encode(self, action: Action) -> Action:
        """Return the common action for the agent's own one."""
        return action

    def widen(self, mask: Mask | None) -> Mask | None:
        """Return the mask of the common space. ``mask``: the agent's own; None: all is legal."""
        if mask is None and isinstance(self._own, spaces.Discrete):
            return open_mask(self._own)
        own: Mask | None = duplicate(mask)
        return own

    def _checked(self, action: Action) -> Action:
        legal = self._check(action)
        if legal is ILLEGAL:
            raise InvalidActionError(f"{short_repr(action)} is not in {short_repr(self._common)}")
        return legal


class _Numbered(ActionCode):
    """The code of a ``Discrete`` among larger ones."""

    def decode(self, action: Action, mask: Mask | None) -> Action:
        number = self._checked(action)
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


class _Preferred(_Numbered):
    """The code of a ``Discrete`` beside a ``Box``: a preference for each action."""

    def decode(self, action: Action, mask: Mask | None) -> Action:
        preferences = np.atleast_1d(self._checked(action))[: self._own.n]
        if mask is not None:
            preferences = np.where(mask, preferences, -np.inf)
        return int(preferences.argmax()) + int(self._own.start)

    def encode(self, action: Action) -> Action:
        vector = np.zeros(self._common.shape or (), np.float32)
        vector[: self._most] = -1.0
        vector[super().encode(action)] = 1.0
        return vector


class _Scaled(ActionCode):
    """The code of a ``Box``: a part of a common vector, after the preferences."""

    @cached_property
    def _bounds(self) -> tuple[Array, Array]:
        """The lower bounds, and the widths up to the upper ones."""
        low = self._own.low.astype(np.float64)
        return low, self._own.high - low

    def decode(self, action: Action, mask: Mask | None) -> Action:
        own = self._own
        low, width = self._bounds
        parts = np.atleast_1d(self._checked(action))[self._most : self._most + low.size]
        values = low + (parts.astype(np.float64).reshape(low.shape) + 1.0) / 2.0 * width
        if own.dtype.kind != "f":
            values = np.rint(values)
        return np.clip(values.astype(own.dtype), own.low, own.high)

    def encode(self, action: Action) -> Action:
        low, width = self._bounds
        values = (action - low) / np.where(width > 0.0, width, 1.0)
        vector = np.zeros(self._common.shape or (), np.float32)
        vector[self._most :][: values.size] = np.clip(2.0 * values.ravel() - 1.0, -1.0, 1.0)
        return vector

    def widen(self, mask: Mask | None) -> Mask | None:
        return np.ones(self._most, np.int8) if self._most else None
