"""The base class of the views with one agent, which are Gymnasium environments."""

from __future__ import annotations

from functools import cached_property
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
    _np_random, _np_random_seed = View.np_random, View.np_random_seed  # where Gymnasium's checks look

    # The spaces are made on demand, because many simulations side by side may never need them.

    @cached_property
    def observation_space(self) -> spaces.Space[Any]:  # type: ignore[override]
        """The observation space. No other environment shares it."""
        return self._seeded(self._make_spaces()[0])

    @cached_property
    def action_space(self) -> spaces.Space[Any]:  # type: ignore[override]
        """The action space. No other environment shares it."""
        return self._seeded(self._make_spaces()[1])

    def _seeded(self, space: spaces.Space[Any]) -> spaces.Space[Any]:
        seed = self._session.np_random_seed
        if seed is not None and seed >= 0:
            seed_space(space, seed, self._agent)
        return space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the simulation and run it to its first decision.

        The arguments and errors are those of ``SimulationAECEnv.reset``.

        Returns:
            The observation and the info.
        """
        with self._session.exclusive():
            episode = self._start(seed, options)
            for name in ("observation_space", "action_space") if seed is not None else ():
                if name in vars(self):
                    self._seeded(vars(self)[name])
            if self._shows:
                self.render()
            return self._first_results(episode)

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
        masks = self._masks(self._running())
        parts = [part for mask in masks for part in (mask if isinstance(mask, tuple) else (mask,))]
        return np.concatenate(parts).astype(np.bool_)

    def _all_observation_spaces(self) -> list[spaces.Space[Any]]:
        return [self.observation_space]

    def _make_spaces(self) -> tuple[spaces.Space[Any], spaces.Space[Any]]:
        """Make the observation space and the action space of this environment, which it shares with no other."""
        raise NotImplementedError

    def _first_results(self, episode: Episode) -> tuple[Any, dict[str, Any]]:
        """The observation and the info of a reset."""
        raise NotImplementedError

    def _masks(self, episode: Episode) -> list[Any]:
        """The masks of all decisions that one step answers."""
        raise NotImplementedError
