"""What goes to and comes from many simulations at once: batches of observations, rewards, flags and actions."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import batch_space, iterate

from ..core.bound import BoundPoint
from ..errors import InvalidActionError, shown
from ..simulation import RULE

IGNORED: Final = None
"""Stands for an action that is not used; no space has it."""


class Batch:
    """What many simulations tell at once.

    Attributes:
        observations: Of the single space, batched.
        rewards: Shape ``(n,)``, float64.
        terminations, truncations: Shape ``(n,)``, bool.
    """

    def __init__(self, observations: Any, number: int) -> None:
        self.observations = observations
        self.rewards = np.zeros(number, np.float64)
        self.terminations = np.zeros(number, np.bool_)
        self.truncations = np.zeros(number, np.bool_)


class Actions:
    """Takes batches of actions apart, and checks them as far as that needs no simulation.

    Attributes:
        complete: Whether nothing is left to be checked with the simulations.
    """

    def __init__(self, space: spaces.Space[Any], number: int, point: BoundPoint | None) -> None:
        """Make ready for batches of a space.

        Args:
            space: The action space of one simulation.
            number: How many simulations there are.
            point: The decision point that takes the actions; None where several do.
        """
        self._number, self._point = number, point
        self._space, self._batch = space, batch_space(space, number)
        self.complete = point is not None and point.legal is None

    def split(self, actions: Any, unused: Any = ()) -> list[Any]:
        """Take a batch apart.

        Args:
            actions: A batch of the action space; for spaces whose batches are arrays, a sequence serves.
            unused: The numbers of the actions that are not used, and so not checked.

        Returns:
            An action for each simulation; ``IGNORED`` in place of those that are not used.

        Raises:
            InvalidActionError: There is not an action for each, or one is not legal. It says which.
        """
        space = self._space
        if actions is RULE:
            raise InvalidActionError("RULE is no action in vector environments; use single_env, or policies=")
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
            return list(actions.copy())  # which the caller cannot change
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
                f"{shown(actions)} is no batch of {self._number} actions of {shown(self._space)}"
            ) from error
        if len(apart) != self._number:
            raise InvalidActionError(f"there are {len(apart)} actions for {self._number} simulations: {shown(actions)}")
        return apart


def of_one(number: int, error: Any) -> str:
    """The message of an error about the action of one of many."""
    return f"sub-environment {number}: {error}"
