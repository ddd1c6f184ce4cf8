"""Question 4a, answered by RLlib's PPO (new API stack), with one module per agent.

Run ``python -m studies.greenhouse_experiment.rllib`` in a virtual environment with ``ray[rllib]``,
whose dependencies conflict with those of the other libraries.

RLlib's own wrapper contains the PettingZoo parallel environment. Learning is, as far as the
libraries allow, the same as in ``sb3`` and ``torchrl``:

- RLlib itself rescales actions from [-1, 1]. Their standard deviation is a parameter of each module
  (``free_log_std``), and starts at 0.37.
- Rewards are divided by 20, about the standard deviation of returns, and the critic's error is not
  clipped.
"""

from __future__ import annotations

import logging
import os
import shutil
import warnings
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, Final

import numpy as np
import torch
from examples.greenhouse_coop.env import parallel_env
from examples.greenhouse_coop.train import Team
from numpy.typing import NDArray
from pettingzoo.utils import BaseParallelWrapper

from .questions import BOTH, Verdict, team_of
from .runs import Log, Run, carry_out, parser

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")

import ray
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module import MultiRLModuleSpec, RLModule, RLModuleSpec
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
from ray.tune.registry import register_env

from .rllib_module import LOG_STD, Module

LIBRARY: Final = "rllib"

GREENHOUSES: Final = 16
"""The number of parallel environments for training."""

SETTINGS: Final[dict[str, Any]] = {
    "lr": 3e-4,
    "train_batch_size_per_learner": 1024,
    "minibatch_size": 128,
    "num_epochs": 10,
    "gamma": 0.99,
    "lambda_": 0.95,
    "clip_param": 0.2,
    "vf_clip_param": 1e9,
    "vf_loss_coeff": 0.5,
    "entropy_coeff": 0.0,
    "use_kl_loss": False,
    "grad_clip": 0.5,
}
CELLS: Final = (64, 64)
REWARD_SCALE: Final = 1 / 20

BATCHES_A_POINT: Final = 5
"""The number of batches between two points of the learning curve."""


class ScaledRewards(BaseParallelWrapper):
    """A parallel environment with rewards scaled for the critic."""

    def step(self, actions: Mapping[str, Any]) -> Any:
        """Step the environment, and scale the rewards."""
        observations, rewards, *others = super().step(actions)
        return (
            observations,
            {agent: reward * REWARD_SCALE for agent, reward in rewards.items()},
            *others,
        )


def environment(_: Mapping[str, Any]) -> ParallelPettingZooEnv:
    """Make the environment of both agents in RLlib's wrapper."""
    return ParallelPettingZooEnv(ScaledRewards(parallel_env()))


def configuration(seed: int) -> PPOConfig:
    """Make the configuration of PPO; all of it runs in this process."""
    register_env("greenhouse_coop", environment)
    networks = DefaultModelConfig(
        fcnet_hiddens=list(CELLS),
        fcnet_activation="tanh",
        head_fcnet_hiddens=[],
        free_log_std=True,
        vf_share_layers=False,
    )
    modules = {agent: RLModuleSpec(module_class=Module, model_config=networks) for agent in BOTH}
    return (
        PPOConfig()
        .environment("greenhouse_coop")
        .env_runners(num_env_runners=0, num_envs_per_env_runner=GREENHOUSES)
        .learners(num_learners=0)
        .multi_agent(policies=set(BOTH), policy_mapping_fn=lambda agent, episode, **_: agent)
        .rl_module(rl_module_spec=MultiRLModuleSpec(rl_module_specs=modules))
        .training(**SETTINGS)
        .debugging(seed=seed, log_level="ERROR")
    )


def learn(run: Run) -> Verdict:
    """Train for a run, and evaluate the result."""
    start()
    torch.set_num_threads(1)
    algorithm = configuration(run.seed).build_algo()
    modules = [algorithm.get_module(agent) for agent in BOTH]
    team = team_of(run.asked, partial(act, modules))
    log = Log(
        run,
        {
            "greenhouses": GREENHOUSES,
            **SETTINGS,
            "cells": CELLS,
            "reward_scale": REWARD_SCALE,
            "log_std": LOG_STD,
        },
    )
    log.judge(0, team)
    size = SETTINGS["train_batch_size_per_learner"]
    batches = -(-run.budget // size)  # whole batches: the last one may exceed the budget
    for number in range(1, batches + 1):
        algorithm.train()
        if number % BATCHES_A_POINT == 0 or number == batches:
            log.judge(number * size, team)
    for agent, module in zip(BOTH, modules, strict=True):
        folder = run.stem / agent
        shutil.rmtree(folder, ignore_errors=True)  # left by an interrupted run
        module.save_to_path(folder.absolute())
    algorithm.stop()
    return log.close(batches * size, team)


def start() -> None:
    """Start Ray, within this process alone."""
    warnings.filterwarnings("ignore", category=DeprecationWarning)
    if not ray.is_initialized():
        ray.init(
            num_cpus=1, include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR
        )


def act(modules: Sequence[RLModule], observation: NDArray[np.float32]) -> NDArray[np.float32]:
    """Compute the modules' actions without exploration.

    At the beginning of a day, both agents observe the same.

    Args:
        modules: The waterer's module and the ventilator's.
        observation: The observation of one agent, float32 ``(6,)``.
    """
    batch = {"obs": torch.from_numpy(observation)[None]}
    with torch.no_grad():
        means = [
            float(module.forward_inference(batch)["action_dist_inputs"][0, 0]) for module in modules
        ]
    return np.asarray((np.clip(means, -1, 1) + 1) / 2, np.float32)


def load(run: Run) -> Team:
    """Load the team that a run has trained."""
    if not run.stem.is_dir():
        raise SystemExit(
            f"{run.stem} is missing: question {run.question} of seed {run.seed} has to be answered"
            " first"
        )
    modules = [RLModule.from_checkpoint((run.stem / agent).absolute()) for agent in BOTH]
    return team_of(run.asked, partial(act, modules))


def main(arguments: Sequence[str] | None = None) -> None:
    """Carry out the missing runs."""
    options = parser(__doc__ or "", budget=60_000, questions=("4a",)).parse_args(arguments)
    carry_out(LIBRARY, learn, options)


if __name__ == "__main__":
    main()
