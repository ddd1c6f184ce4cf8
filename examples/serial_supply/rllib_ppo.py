"""PPO of RLlib, in the parallel view: each stage has its own network.

``python -m examples.serial_supply.rllib_ppo --seed 0`` trains it and prints the cost. It needs a
virtual environment without the other learners, since RLlib pins Gymnasium.
"""

from __future__ import annotations

from typing import Any, Final

import ray
import torch
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
from ray.rllib.utils.spaces.space_utils import unsquash_action
from ray.tune.registry import register_env

from simenv_marl import parallel_env

from .command import Policies, command
from .env import OPTIONS, PERIODS, STAGES, SerialSupply, order, profit

STEPS: Final = 64_000
"""The number of periods."""

BATCH: Final = 1600

# -- glue: begin ----------------------------------------------------------------------------------


def make(config: Any) -> ParallelPettingZooEnv:
    """Make the environment."""
    return ParallelPettingZooEnv(parallel_env(SerialSupply, team_reward=profit, **OPTIONS))


def train(seed: int, steps: int = STEPS) -> Policies:
    """Train with the team's reward."""
    ray.init(num_cpus=2, include_dashboard=False, _node_ip_address="127.0.0.1")
    register_env("chain", make)
    network = DefaultModelConfig(fcnet_hiddens=[64, 64], fcnet_activation="tanh")
    algorithm = (
        PPOConfig()
        .environment("chain")
        .env_runners(num_env_runners=0, rollout_fragment_length=PERIODS)
        .multi_agent(policies=set(STAGES), policy_mapping_fn=lambda agent, episode, **_: agent)
        .rl_module(model_config=network)
        .training(train_batch_size_per_learner=BATCH, minibatch_size=100, num_epochs=10)
        .training(lr=[[0, 2e-3], [steps, 0.0]], gamma=0.95, lambda_=0.9, grad_clip=1.0)
        .training(use_kl_loss=False, vf_clip_param=float("inf"))
        .debugging(seed=seed)
        .build_algo()
    )
    for _ in range(max(1, steps // BATCH)):
        algorithm.train()
    modules = {stage: algorithm.get_module(stage) for stage in STAGES}
    algorithm.stop()
    ray.shutdown()
    return {stage: single(module) for stage, module in modules.items()}


def single(module: Any) -> Any:
    """Make a policy of one stage, which takes one observation or a stack of them."""
    distribution = module.get_inference_action_dist_cls()

    def decide(observation: Any) -> Any:
        seen = torch.as_tensor(observation)
        with torch.no_grad():
            outputs = module.forward_inference({Columns.OBS: seen.reshape(-1, seen.shape[-1])})
        action = distribution.from_logits(outputs[Columns.ACTION_DIST_INPUTS])
        found = action.to_deterministic().sample().numpy().reshape(*seen.shape[:-1], -1)
        return unsquash_action(found, order.action_space)

    return decide


# -- glue: end ------------------------------------------------------------------------------------

if __name__ == "__main__":
    command(train, STEPS)
