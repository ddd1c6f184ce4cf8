"""MAPPO, QMIX and VDN of BenchMARL, in the parallel view.

``python -m examples.serial_supply.benchmarl_recipe qmix --seed 0`` trains QMIX and prints the cost.
QMIX and VDN take discrete actions only.
"""

from __future__ import annotations

import sys
from functools import partial
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
import torch
from benchmarl.algorithms import MappoConfig, QmixConfig, VdnConfig
from benchmarl.environments.pettingzoo.common import PettingZooClass
from benchmarl.experiment import Experiment, ExperimentConfig
from benchmarl.models import MlpConfig
from tensordict import TensorDict
from torchrl.envs import ExplorationType, PettingZooWrapper, set_exploration_type

from simenv_marl import parallel_env

from .command import Policies, command
from .env import DISCRETE, OPTIONS, PERIODS, QUANTITIES, STAGES, SerialSupply, profit

ALGORITHMS: Final = {"mappo": MappoConfig, "qmix": QmixConfig, "vdn": VdnConfig}

STEPS: Final = 64_000
"""The number of periods."""

# -- glue: begin ----------------------------------------------------------------------------------


class Task(PettingZooClass):
    """The chain as a task of BenchMARL."""

    def get_env_fun(self, num_envs: int, continuous_actions: bool, seed: Any, device: Any) -> Any:
        """Return a function that makes the environment."""
        points = SerialSupply.points if continuous_actions else DISCRETE
        make = partial(parallel_env, SerialSupply, points, team_reward=profit, **OPTIONS)
        group = {"stages": list(STAGES)}
        return lambda: PettingZooWrapper(make(), group_map=group, seed=seed, device=device)

    def supports_continuous_actions(self) -> bool:
        """Return whether the environment can have orders of any size."""
        return True

    def supports_discrete_actions(self) -> bool:
        """Return whether the environment can have orders in steps."""
        return True

    def has_state(self) -> bool:
        """Return False: the critic takes the observations of all stages together."""
        return False

    def max_steps(self, env: Any) -> int:
        """Return the length of an episode."""
        return PERIODS


def train(seed: int, steps: int = STEPS, *, algorithm: str = "mappo") -> Policies:
    """Train with the team's reward."""
    config = ExperimentConfig.get_from_yaml()
    changes = {
        "evaluation": False, "loggers": [], "create_json": False, "share_policy_params": False,
        "max_n_frames": steps, "gamma": 0.95, "lr": 1e-3, "adam_eps": 1e-5, "clip_grad_val": 1.0,
        "on_policy_collected_frames_per_batch": 1600, "on_policy_n_envs_per_worker": 16,
        "on_policy_n_minibatch_iters": 10, "on_policy_minibatch_size": 100,
        "off_policy_collected_frames_per_batch": 800, "off_policy_n_envs_per_worker": 8,
        "off_policy_n_optimizer_steps": 200, "exploration_eps_init": 0.5,
        "exploration_eps_end": 0.02, "exploration_anneal_frames": steps // 2,
        "off_policy_memory_size": 50_000, "polyak_tau": 0.01,
    }  # fmt: skip
    with TemporaryDirectory() as folder:
        vars(config).update(changes, save_folder=folder)
        network = MlpConfig(
            num_cells=[64, 64], layer_class=torch.nn.Linear, activation_class=torch.nn.Tanh
        )
        task, learner = Task("chain", {}), ALGORITHMS[algorithm].get_from_yaml()
        experiment = Experiment(task, learner, network, seed, config)
        experiment.run()
    return {name: single(experiment.policy, number) for number, name in enumerate(STAGES)}


def single(policy: Any, stage: int) -> Any:
    """Make a policy of one stage, which takes one observation or a stack of them."""
    quantities = np.array(QUANTITIES, np.float32)

    def decide(observation: Any) -> Any:
        rows = torch.as_tensor(observation).unsqueeze(-2)
        rows = rows.expand(*rows.shape[:-2], len(STAGES), -1)  # the network takes all stages
        seen = TensorDict({"stages": {"observation": rows}}, rows.shape[:-2])
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            found = policy(seen)["stages", "action"].select(rows.ndim - 2, stage).numpy()
        return found if found.dtype == np.float32 else quantities[found][..., None]

    return decide


# -- glue: end ------------------------------------------------------------------------------------

if __name__ == "__main__":
    command(partial(train, algorithm=sys.argv.pop(1)), STEPS)
