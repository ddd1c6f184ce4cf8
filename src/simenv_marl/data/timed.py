"""Buffers of Stable-Baselines3 that discount each transition by its own time.

Stable-Baselines3 has one discount for all decisions. In models whose decisions come at irregular
times, the discount of an interval is ``info["discount"]``, with the option ``discount_rate=``
(Bradtke and Duff, "Reinforcement Learning Methods for Continuous-Time Markov Decision Problems",
1994).
"""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import Any, Self

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common import buffers

from ..core import Info
from ..errors import OptionValueError

try:
    from sb3_contrib.common.maskable import buffers as masked
except ImportError:
    masked = None


def _discounts(infos: Sequence[Info]) -> list[float]:
    """Return the discounts in infos."""
    try:
        return [info["discount"] for info in infos]
    except KeyError:
        raise OptionValueError(
            'the infos have no "discount"; give the environment discount_rate=, and the simulation'
            " a method time"
        ) from None


def _space(name: str, place: int, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    """Return a space among the arguments of a buffer. None if the buffer is being unpickled."""
    return kwargs.get(name, args[place] if len(args) > place else None)


class TimedReplayBuffer(buffers.ReplayBuffer):
    """A replay buffer whose samples have the discounts of their intervals.

    Pass it as ``replay_buffer_class=`` to ``DQN``, ``SAC`` or ``TD3``, which do not use ``gamma``
    then. It serves several environments, and observations of a ``Dict``.

    Attributes:
        discounts: The discounts, of shape ``(buffer_size, n_envs)``.
    """

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Make the buffer for a ``Dict``, if observations are one."""
        kind: Any = cls
        is_dict = isinstance(_space("observation_space", 1, args, kwargs), spaces.Dict)
        if cls is TimedReplayBuffer and is_dict:
            kind = _TimedDictReplayBuffer
        made: Self = super().__new__(kind)
        return made

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.discounts = np.ones((self.buffer_size, self.n_envs), np.float32)

    def add(
        self,
        obs: Any,
        next_obs: Any,
        action: Any,
        reward: Any,
        done: Any,
        infos: list[Info],
    ) -> None:
        """Store a transition of each environment.

        Raises:
            OptionValueError: The infos have no discount.
        """
        self.discounts[self.pos] = _discounts(infos)
        super().add(obs, next_obs, action, reward, done, infos)

    def _get_samples(self, batch_inds: NDArray[np.int_], env: Any = None) -> Any:
        state = np.random.get_state()
        places = np.random.randint(0, high=self.n_envs, size=(len(batch_inds),))
        np.random.set_state(state)  # so that the samples are of the same environments
        samples = super()._get_samples(batch_inds, env)
        discounts = self.discounts[batch_inds, places].reshape(-1, 1)
        *others, _ = samples
        return type(samples)(*others, self.to_torch(discounts))


class TimedRolloutBuffer(buffers.RolloutBuffer):
    """A rollout buffer whose returns and advantages have the discounts of their intervals.

    Pass it as ``rollout_buffer_class=`` to ``PPO``, ``A2C`` or ``MaskablePPO``, which do not use
    ``gamma`` then. It serves several environments, observations of a ``Dict``, and masks.

    Attributes:
        discounts: The discounts, of shape ``(buffer_size, n_envs)``.
    """

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Make the buffer for a ``Dict``, and for masks, if they are needed."""
        kind: Any = cls
        if cls is TimedRolloutBuffer:
            is_dict = isinstance(_space("observation_space", 1, args, kwargs), spaces.Dict)
            action_space = _space("action_space", 2, args, kwargs)
            masks = masked is not None and not isinstance(action_space, spaces.Box)
            kind = _ROLLOUT_BUFFERS.get((is_dict, masks), cls)
        made: Self = super().__new__(kind)
        return made

    def reset(self) -> None:
        """Begin a rollout."""
        super().reset()
        self.discounts = np.ones((self.buffer_size, self.n_envs), np.float32)

    def add(self, obs: Any, action: Any, reward: Any, *others: Any, **kwargs: Any) -> None:
        """Store a transition of each environment.

        Raises:
            OptionValueError: The infos have no discount, or a learner collects in another way.
        """
        # Only the caller knows the infos. Its local variables are public: callbacks get them.
        frame = inspect.currentframe()
        caller = {} if frame is None or frame.f_back is None else frame.f_back.f_locals
        if not {"infos", "dones", "self"} <= caller.keys():
            raise OptionValueError(
                "TimedRolloutBuffer must be filled by collect_rollouts of Stable-Baselines3, where"
                " it finds the infos"
            )
        infos = caller["infos"]
        discounts = np.array(_discounts(infos), np.float32)
        self.discounts[self.pos] = discounts
        for place, info in enumerate(infos):
            if caller["dones"][place] and info.get("TimeLimit.truncated", False):
                value = _value(caller["self"].policy, info["terminal_observation"])
                reward[place] += (discounts[place] - self.gamma) * value
        super().add(obs, action, reward, *others, **kwargs)

    def compute_returns_and_advantage(self, last_values: Any, dones: Any) -> None:
        """Estimate advantages (GAE), with a discount for each step."""
        values = np.vstack([self.values, last_values.cpu().numpy().reshape(1, -1)])
        weights = self.discounts * (1 - np.vstack([self.episode_starts[1:], dones]))
        advantage = 0.0
        for step in reversed(range(self.buffer_size)):
            error = self.rewards[step] + weights[step] * values[step + 1] - values[step]
            self.advantages[step] = advantage = error + self.gae_lambda * weights[step] * advantage
        self.returns = self.advantages + self.values


def _value(policy: Any, observation: Any) -> float:
    """Return the value of the last observation of a truncated episode, as the learner adds it."""
    with torch.no_grad():
        return float(policy.predict_values(policy.obs_to_tensor(observation)[0]))


class _TimedDictReplayBuffer(TimedReplayBuffer, buffers.DictReplayBuffer):
    pass


class _TimedDictRolloutBuffer(TimedRolloutBuffer, buffers.DictRolloutBuffer):
    pass


_ROLLOUT_BUFFERS: dict[tuple[bool, bool], type[TimedRolloutBuffer]] = {
    (True, False): _TimedDictRolloutBuffer
}
"""The buffers by whether observations are a ``Dict``, and whether there may be masks."""

if masked is not None:

    class _MaskedRolloutBuffer(TimedRolloutBuffer, masked.MaskableRolloutBuffer):
        pass

    class _MaskedDictRolloutBuffer(TimedRolloutBuffer, masked.MaskableDictRolloutBuffer):
        pass

    _ROLLOUT_BUFFERS[False, True] = _MaskedRolloutBuffer
    _ROLLOUT_BUFFERS[True, True] = _MaskedDictRolloutBuffer
