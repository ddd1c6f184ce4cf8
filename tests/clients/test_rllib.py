"""RLlib's new API stack: its wrappers, its checker, its training, and its modules in our loop."""

import os
import random

os.environ["RAY_USAGE_STATS_ENABLED"] = "0"

import numpy as np
import pytest
import ray
from hive import BEES, DEFINITION, MASK_OBSERVED, HiveSim, points
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv, PettingZooEnv
from ray.rllib.examples.rl_modules.classes.action_masking_rlm import ActionMaskingTorchRLModule
from ray.rllib.utils.pre_checks.env import check_multiagent_environments
from ray.tune.registry import register_env

from simenv_marl import aec_env, parallel_env
from simenv_marl.envs import pad_agents
from tests.worlds.models import play

from .page import blocks
from .returns import mean_return

HIVES = {"parallel": (ParallelPettingZooEnv, parallel_env), "aec": (PettingZooEnv, aec_env)}


def hive(view, definition=DEFINITION):
    """Bees that are born and die, in RLlib's wrapper."""
    wrapper, make = HIVES[view]
    return wrapper(pad_agents(make(HiveSim, points(definition), possible_agents=BEES)))


@pytest.fixture(autouse=True, scope="module")
def _ray():
    exec(blocks("_clients_rllib.md")[0], {})
    yield
    ray.shutdown()


@pytest.fixture(autouse=True)
def _also_without_torch():
    random.seed(0)
    np.random.seed(0)


@pytest.mark.parametrize("view", HIVES)
def test_rllib_checker_accepts_envs_with_pad_agents(view):
    """Without padding, a death and a time limit in one step set neither flag of ``__all__``."""
    env = hive(view)
    check_multiagent_environments(env)
    assert set(env.possible_agents) == set(BEES)
    ends = []
    for seed in range(40):
        env.reset(seed=seed)
        over = [False, False]
        while not any(over):
            *_, terminateds, truncateds, _ = env.step(dict.fromkeys(BEES, seed % 3))
            over = [terminateds["__all__"], truncateds["__all__"]]
        ends.append(over)
    assert [True, True] not in ends
    assert [True, False] in ends
    assert [False, True] in ends


def hive_config(view, definition, **environment):
    name = f"{view} hive, {sorted(environment)}"
    register_env(name, lambda config: hive(view, definition))
    return (
        PPOConfig()
        .environment(name, **environment)
        .env_runners(num_env_runners=0)
        .multi_agent(policies={"bee"}, policy_mapping_fn=lambda agent, episode, **_: "bee")
        .rl_module(model_config=DefaultModelConfig(fcnet_hiddens=[32, 32]))
        .training(
            train_batch_size_per_learner=512,
            minibatch_size=128,
            num_epochs=8,
            lr=3e-3,
            gamma=0.9,
            grad_clip=1.0,
        )
        .debugging(seed=0)
    )


def test_rllib_page_trains_two_agents_and_extracts_their_policies():
    _, spaces, build, train, define, take_out = blocks("_clients_rllib.md")
    names = {"__name__": "__main__"}
    for code in (spaces, build, define):
        exec(code, names)

    def worth():
        exec(take_out, names)
        return mean_return(
            names["FourWeeks"],
            names["points"],
            lambda agent, seen, _: names["policies"][agent](seen),
        )

    names["checkpoint"] = names["algorithm"].save_to_path()
    before = worth()
    exec(train, names)
    assert worth() > before + 3
    names["algorithm"].stop()
    # The model's own loop runs just as the environment's in which one decides after the other.
    env = aec_env(names["FourWeeks"], names["points"])
    play(env, lambda agent, env: names["policies"][agent](env.observe(agent)), seed=1)
    assert names["shop"].cash == env.simulation.shop.cash


@pytest.mark.parametrize("view", HIVES)
def test_policy_shared_by_agents_that_are_born_and_die_learns(view):
    names = {"__name__": "__main__"}
    exec(blocks("_clients_rllib.md")[4], names)
    algorithm = hive_config(view, DEFINITION).build_algo()
    policy = names["policy_of"](algorithm.get_module("bee"))

    def worth():
        return mean_return(
            HiveSim, points(DEFINITION), lambda bee, seen, _: policy(seen), possible_agents=BEES
        )

    before = worth()
    for _ in range(8):
        algorithm.train()
    assert worth() > before + 3
    algorithm.stop()


def test_rllib_reads_action_masks_from_observations():
    masking = RLModuleSpec(module_class=ActionMaskingTorchRLModule)
    config = hive_config("parallel", MASK_OBSERVED, disable_env_checking=True)
    algorithm = config.rl_module(rl_module_spec=masking).build_algo()
    algorithm.train()  # an illegal action of the one who decides would be an error
    algorithm.stop()
