"""The base class of views with one agent, which are Gymnasium environments."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ..core.episode import Episode, When
from ..core.session import checked_seed, seed_space
from ..errors import ViewError
from .base import View


class OneAgentView(View, gym.Env[Any, Any]):
    """A view with one agent, which is a Gymnasium environment."""

    _agent: str
    _own_spaces: tuple[spaces.Space[Any], spaces.Space[Any]] | None = None

    def _make_spaces(self) -> tuple[spaces.Space[Any], spaces.Space[Any]]:
        """Make the observation space and the action space, which this environment does not share."""
        raise NotImplementedError

    @property
    def _spaces(self) -> tuple[spaces.Space[Any], spaces.Space[Any]]:
        if self._own_spaces is None:  # made on demand: many simulations side by side share spaces if possible
            self._own_spaces = self._make_spaces()
            seed = self._session.np_random_seed
            if seed is not None and seed >= 0:
                self._seed_spaces(seed)
        return self._own_spaces

    @property
    def observation_space(self) -> spaces.Space[Any]:
        """The observation space, which this environment does not share."""
        return self._spaces[0]

    @observation_space.setter
    def observation_space(self, space: spaces.Space[Any]) -> None:
        self._own_spaces = space, self._spaces[1]

    @property
    def action_space(self) -> spaces.Space[Any]:
        """The action space, which this environment does not share."""
        return self._spaces[1]

    @action_space.setter
    def action_space(self, space: spaces.Space[Any]) -> None:
        self._own_spaces = self._spaces[0], space

    _np_random, _np_random_seed = View.np_random, View.np_random_seed  # where Gymnasium's checks look

    def _seed_spaces(self, seed: int) -> None:
        for space in self._spaces:
            seed_space(space, seed, self._agent)

    def _seen_spaces(self) -> list[spaces.Space[Any]]:
        return [self.observation_space]

    def action_masks(self) -> NDArray[np.bool_]:
        """Return the action mask of the pending decision, in the shape that sb3-contrib's ``MaskablePPO`` needs.

        Returns:
            A bool array. Shape ``(n,)`` for a ``Discrete``; for a ``MultiDiscrete`` the concatenated masks of its
            parts. All values are True if the decision point does not restrict its actions.

        Raises:
            ViewError: The action space is neither of these, and so has no masks.
            ResetNeededError: There is no episode.
        """
        if not isinstance(self.action_space, (spaces.Discrete, spaces.MultiDiscrete)):
            raise ViewError(
                f"there are only masks of Discrete and MultiDiscrete action spaces, and not of {self.action_space}; a"
                " joint environment of discrete actions has a MultiDiscrete with flatten=True"
            )
        masks = self._legal(self._running())
        parts = [part for mask in masks for part in (mask if isinstance(mask, tuple) else (mask,))]
        return np.concatenate(parts).astype(np.bool_)

    def _legal(self, episode: Episode) -> list[Any]:
        """Return the masks of all decisions of a step."""
        raise NotImplementedError

    def _begin(self, seed: int | None, options: dict[str, Any] | None, when: When) -> Episode:
        """End the running episode, begin another, and seed the generator and the spaces."""
        seed = checked_seed(seed)
        self._make_way()
        if seed is not None and self._own_spaces is not None:
            self._seed_spaces(seed)
        return self._session.start(seed, options, when)
