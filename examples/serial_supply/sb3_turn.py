"""PPO of Stable-Baselines3 in the turn view: one network takes each decision as it arises.

``python -m examples.serial_supply.sb3_turn --seed 0`` trains it and prints the cost.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import torch
from gymnasium.wrappers import RescaleAction
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

from simenv_marl import turn_env
from simenv_marl.data import turn_policy

from .command import Policies, command
from .env import OPTIONS, SerialSupply, profit

STEPS: Final = 400_000
"""The number of decisions: three in each period."""

# -- glue: begin ----------------------------------------------------------------------------------


def make() -> Any:
    """Make the environment, with actions as Stable-Baselines3 expects them."""
    env = turn_env(SerialSupply, team_reward=profit, flatten=True, **OPTIONS)
    return RescaleAction(env, np.float32(-1), np.float32(1))


def train(seed: int, steps: int = STEPS) -> Policies:
    """Train with the team's reward."""
    learner = PPO(
        "MlpPolicy",
        make_vec_env(make, n_envs=16),
        n_steps=300,
        batch_size=600,
        gamma=0.98,
        gae_lambda=0.9,
        learning_rate=lambda left: 3e-3 * left,
        policy_kwargs={"log_std_init": -0.7},
        seed=seed,
    )
    learner.learn(steps)
    env, policy = make(), learner.policy.to("cpu")

    def predict(observation: Any) -> Any:
        with torch.no_grad():
            action, _ = policy.predict(observation, deterministic=True)
        return env.action(action)

    return turn_policy(predict, like=env, batched=True)


# -- glue: end ------------------------------------------------------------------------------------

if __name__ == "__main__":
    command(train, STEPS)
