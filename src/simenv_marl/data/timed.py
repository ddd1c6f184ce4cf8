"""Buffers of Stable-Baselines3 that discount each transition by its own time.

Stable-Baselines3 has one discount for all decisions. In models whose decisions come at irregular
times, the discount of an interval is ``info["discount"]``, with the option ``discount_rate=``
(Bradtke and Duff, "Reinforcement Learning Methods for Continuous-Time Markov Decision Problems",
1994).
"""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, Dict
from numpy.typing import NDArray
from stable_baselines3.common import buffers

from ..core import Info
from ..errors import OptionValueError

try:
    from sb3_contrib.common.maskable import buffers as masked
except ImportError:
    masked = None


def _discounts(infos: list[Info]) -> list[float]:
    """Return the discounts in infos."""
    try:
        return [info["discount"] for info in infos]
    except KeyError:
        raise OptionValueError(
            'the infos have no "discount"; give the environment discount_rate=, and the simulation'
            " a method time"
        ) from None


class TimedReplayBuffer(buffers.ReplayBuffer):
    """A replay buffer whose samples have the discounts of their intervals.

    Pass it as ``replay_buffer_class=`` to ``DQN``, ``SAC`` or ``TD3``, which do not use ``gamma``
    then. It serves several environments, and observations of a ``Dict``.

    Attributes:
        discounts: The discounts, of shape ``(buffer_size, n_envs)``.
    """

    def __new__(
        cls, buffer_size: int = 0, observation_space: Any = None, *_: Any, **__: Any
    ) -> Any:
        """Make the buffer for a ``Dict``, if observations are one."""
        if cls is TimedReplayBuffer and isinstance(observation_space, Dict):
            return _TimedDictReplayBuffer.__new__(_TimedDictReplayBuffer)
        return super().__new__(cls)

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
        return type(samples)(*samples[:-1], self.to_torch(discounts))


class TimedRolloutBuffer(buffers.RolloutBuffer):
    """A rollout buffer whose returns and advantages have the discounts of their intervals.

    Pass it as ``rollout_buffer_class=`` to ``PPO``, ``A2C`` or ``MaskablePPO``, which do not use
    ``gamma`` then. It serves several environments, observations of a ``Dict``, and masks.

    Attributes:
        discounts: The discounts, of shape ``(buffer_size, n_envs)``.
    """

    def __new__(
        cls,
        buffer_size: int = 0,
        observation_space: Any = None,
        action_space: Any = None,
        *_: Any,
        **__: Any,
    ) -> Any:
        """Make the buffer for a ``Dict``, and for masks, if they are needed."""
        kind: Any = cls
        if cls is TimedRolloutBuffer:
            masks = masked is not None and not isinstance(action_space, Box)
            kind = _ROLLOUT_BUFFERS.get((isinstance(observation_space, Dict), masks), cls)
        return super().__new__(kind)

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
        frame: Any = inspect.currentframe()
        caller = frame.f_back.f_locals
        if not {"infos", "dones", "self"} <= caller.keys():
            raise OptionValueError(
                "TimedRolloutBuffer must be filled by collect_rollouts of Stable-Baselines3, where"
                " it finds the infos"
            )
        policy = caller["self"].policy
        self.discounts[self.pos] = discounts = np.array(_discounts(caller["infos"]), np.float32)
        for place, info in enumerate(caller["infos"]):
            if caller["dones"][place] and info.get("TimeLimit.truncated", False):
                last = policy.obs_to_tensor(info["terminal_observation"])[0]
                with torch.no_grad():
                    value = policy.predict_values(last).item()
                reward[place] += (discounts[place] - self.gamma) * value  # it has gamma's already
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
