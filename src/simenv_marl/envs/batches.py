"""Batches of observations, rewards, flags and actions of many simulations."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import batch_space, iterate

from ..core.bound import BoundPoint
from ..errors import InvalidActionError, shown
from ..simulation import RULE

IGNORED: Final = None
"""A placeholder for an action that is not used; no space contains it."""


class Batch:
    """The results of many simulations.

    Attributes:
        observations: The batched observations.
        rewards: Shape ``(n,)``, float64.
        terminations, truncations: Shape ``(n,)``, bool.
    """

    def __init__(self, observations: Any, number: int) -> None:
        self.observations = observations
        self.rewards = np.zeros(number, np.float64)
        self.terminations = np.zeros(number, np.bool_)
        self.truncations = np.zeros(number, np.bool_)


class Actions:
    """Splits batches of actions, and checks them as far as that needs no simulation.

    Attributes:
        complete: Whether these checks are complete, so that the simulations need not check the actions.
    """

    def __init__(self, space: spaces.Space[Any], number: int, point: BoundPoint | None) -> None:
        """Prepare for batches of a space.

        Args:
            space: The action space of one simulation.
            number: The number of simulations.
            point: The decision point of the actions; None if there are several.
        """
        self._number, self._point = number, point
        self._space, self._batch = space, batch_space(space, number)
        self.complete = point is not None and point.legal is None

    def split(self, actions: Any, unused: Any = ()) -> list[Any]:
        """Split a batch.

        Args:
            actions: A batch of the action space; if batches are arrays, a sequence works, too.
            unused: The numbers of the actions that are not used, and so not checked.

        Returns:
            An action for each simulation; ``IGNORED`` instead of those that are not used.

        Raises:
            InvalidActionError: There is not one action for each simulation, or one is not legal. The message names it.
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
    """Return the message of an error about one of many actions."""
    return f"sub-environment {number}: {error}"
