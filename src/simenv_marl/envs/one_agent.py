"""The base class of the views with one agent, which are Gymnasium environments."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ..core.episode import Episode
from ..core.session import seed_space
from ..errors import ViewError
from .base import View


class OneAgentView(View, gym.Env[Any, Any]):
    """A view with one agent: a Gymnasium environment."""

    _agent: str
    _own_spaces: tuple[spaces.Space[Any], spaces.Space[Any]] | None = None

    def _make_spaces(self) -> tuple[spaces.Space[Any], spaces.Space[Any]]:
        """Make the observation space and the action space of this environment, which it shares with no other."""
        raise NotImplementedError

    @property
    def _spaces(self) -> tuple[spaces.Space[Any], spaces.Space[Any]]:
        if self._own_spaces is None:  # made on demand, because many simulations side by side may never need them
            self._own_spaces = self._make_spaces()
            seed = self._session.np_random_seed
            if seed is not None and seed >= 0:
                self._seed_spaces(seed)
        return self._own_spaces

    @property
    def observation_space(self) -> spaces.Space[Any]:
        """The observation space. No other environment shares it."""
        return self._spaces[0]

    @observation_space.setter
    def observation_space(self, space: spaces.Space[Any]) -> None:
        self._own_spaces = space, self._spaces[1]

    @property
    def action_space(self) -> spaces.Space[Any]:
        """The action space. No other environment shares it."""
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
        """The mask of the legal actions, in the form that ``MaskablePPO`` of sb3-contrib expects.

        Returns:
            A bool array. For a ``Discrete`` it has shape ``(n,)``. For a ``MultiDiscrete`` it is the concatenation of
            the masks of the parts. If the decision point does not restrict its actions, all entries are True.

        Raises:
            ViewError: The action space is neither ``Discrete`` nor ``MultiDiscrete``, and so has no masks.
            ResetNeededError: There is no episode.
        """
        if not isinstance(self.action_space, (spaces.Discrete, spaces.MultiDiscrete)):
            raise ViewError(
                f"action masks need a Discrete or MultiDiscrete action space, not {self.action_space}; a joint"
                " environment of discrete actions has a MultiDiscrete with flatten=True"
            )
        masks = self._legal(self._running())
        parts = [part for mask in masks for part in (mask if isinstance(mask, tuple) else (mask,))]
        return np.concatenate(parts).astype(np.bool_)

    def _legal(self, episode: Episode) -> list[Any]:
        """The masks of all decisions that one step answers."""
        raise NotImplementedError

    def _start(self, seed: int | None, options: dict[str, Any] | None) -> Episode:
        """End the current episode, begin another, and seed the generator and the spaces."""
        episode = super()._start(seed, options)
        if seed is not None and self._own_spaces is not None:
            self._seed_spaces(int(seed))
        return episode
