"""Batches of observations, rewards, flags and actions of many simulations."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import batch_space, iterate

from ..core.point import Point
from ..errors import InvalidActionError, short_repr
from ..simulation import RULE

IGNORED: Final = None
"""The placeholder for an action that is not used. It is in no space."""


class Batch:
    """The results of one step of many simulations.

    Attributes:
        observations: A batch of observations, each of the single observation space.
        rewards: An array of shape ``(n,)`` and dtype float64.
        terminations, truncations: Arrays of shape ``(n,)`` and dtype bool.
    """

    def __init__(self, observations: Any, number: int) -> None:
        self.observations = observations
        self.rewards = np.zeros(number, np.float64)
        self.terminations = np.zeros(number, np.bool_)
        self.truncations = np.zeros(number, np.bool_)


class Actions:
    """Splits batches of actions, and checks them as far as this is possible without the simulations.

    Attributes:
        complete: Whether this check is complete, so that the simulations need not check the actions.
    """

    def __init__(self, space: spaces.Space[Any], number: int, point: Point | None) -> None:
        """Prepare for batches of a space.

        Args:
            space: The action space of one simulation.
            number: The number of simulations.
            point: The decision point that takes the actions. None if there are several.
        """
        self._number, self._point = number, point
        self._space, self._batch = space, batch_space(space, number)
        self.complete = point is not None and point.legal is None

    def split(self, actions: Any, unused: Any = ()) -> list[Any]:
        """Split a batch into actions.

        Args:
            actions: A batch of the action space. If batches of the space are arrays, it may be a sequence.
            unused: The numbers of the simulations whose actions are not used, and so not checked.

        Returns:
            A list with an action for each simulation, and ``IGNORED`` for each unused action.

        Raises:
            InvalidActionError: The number of actions is wrong, or an action is not legal. The message says which.
        """
        space = self._space
        if actions is RULE:
            raise InvalidActionError("RULE is not an action in vector environments; use single_env, or policies=")
        swift = self.complete and type(actions) is np.ndarray and actions.shape == (self._number, *(space.shape or ()))
        if swift and isinstance(space, spaces.Discrete) and actions.dtype.kind in "iu":
            if actions.min() >= space.start and actions.max() < space.start + space.n:
                return actions.tolist()  # type: ignore[no-any-return]
        elif (
            swift
            and isinstance(space, spaces.Box)
            and actions.dtype is space.dtype
            and ((actions >= space.low) & (actions <= space.high)).all()
        ):
            return list(actions.copy())  # so that the caller cannot change them
        apart = self._apart(actions)
        for number in range(self._number):
            if number in unused:
                apart[number] = IGNORED
            elif self._point is not None:
                try:
                    apart[number] = self._point.checked(apart[number], str(self._point.agent), None)
                except InvalidActionError as error:
                    raise InvalidActionError(of_one(number, error)) from None
        return apart

    def _apart(self, actions: Any) -> list[Any]:
        try:
            apart = list(iterate(self._batch, actions))
        except Exception as error:
            raise InvalidActionError(
                f"{short_repr(actions)} is not a batch of {self._number} actions of {short_repr(self._space)}"
            ) from error
        if len(apart) != self._number:
            raise InvalidActionError(
                f"there are {len(apart)} actions for {self._number} simulations: {short_repr(actions)}"
            )
        return apart


def of_one(number: int, error: Any) -> str:
    """Make the message of an error about the action of one sub-environment."""
    return f"sub-environment {number}: {error}"
