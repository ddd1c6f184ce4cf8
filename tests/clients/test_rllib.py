"""RLlib's new API stack: its own wrappers, its own checker, its own training, and its modules in our loop."""

import os
import random

os.environ["RAY_USAGE_STATS_ENABLED"] = "0"

import numpy as np
import pytest
import ray
from examples.greenhouse_coop.env import parallel_env as parallel_greenhouse
from examples.greenhouse_coop.env import raw_env as aec_greenhouse
from hive import BEES, DEFINITION, MASK_OBSERVED, Bee, HiveSim, points
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.env.multi_agent_episode import MultiAgentEpisode
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv, PettingZooEnv
from ray.rllib.examples.rl_modules.classes.action_masking_rlm import ActionMaskingTorchRLModule
from ray.rllib.utils.pre_checks.env import check_multiagent_environments
from ray.tune.registry import register_env

from simenv_marl import aec_env, parallel_env, simulate
from simenv_marl.envs import pad_agents

from .page import blocks
from .returns import parallel_return

HELD_OUT = range(10_000, 10_010)
GREENHOUSES = {
    "parallel": lambda: ParallelPettingZooEnv(parallel_greenhouse()),
    "aec": lambda: PettingZooEnv(aec_greenhouse()),
}
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
def test_its_checker_finds_nothing(view):
    check_multiagent_environments(GREENHOUSES[view]())
    check_multiagent_environments(hive(view))


@pytest.mark.parametrize("view", HIVES)
def test_its_roster_is_ours_and_its_episodes_end_when_ours_do(view):
    """A death and a time limit in the same step are neither ``terminated`` nor ``truncated`` for all, unless padded."""
    env = hive(view)
    assert set(env.possible_agents) == set(BEES)
    ends = set()
    for seed in range(40):
        choose = random.Random(seed)
        observations, infos = env.reset(seed=seed)
        episode = MultiAgentEpisode(observation_space=env.observation_space, action_space=env.action_space)
        episode.add_env_reset(observations=observations, infos=infos)
        total = 0.0
        while not episode.is_done:
            actions = {agent: choose.randrange(3) for agent in episode.get_agents_to_act()}
            observations, rewards, terminateds, truncateds, infos = env.step(actions)
            total += sum(rewards.values())
            episode.add_env_step(
                observations=observations,
                actions=actions,
                rewards=rewards,
                terminateds=terminateds,
                truncateds=truncateds,
                infos=infos,
            )
        episode.validate()
        assert terminateds["__all__"] != truncateds["__all__"]
        assert episode.get_return() == pytest.approx(total)
        ends.add(truncateds["__all__"])
    assert ends == {True, False}


def hive_config(view, definition, **environment):
    name = f"{view} hive, {sorted(environment)}"
    register_env(name, lambda config: hive(view, definition))
    return (
        PPOConfig()
        .environment(name, **environment)
        .env_runners(num_env_runners=0)
        .multi_agent(policies={"bee"}, policy_mapping_fn=lambda agent, episode, **_: "bee")
        .rl_module(model_config=DefaultModelConfig(fcnet_hiddens=[32, 32]))
        .training(train_batch_size_per_learner=512, minibatch_size=128, num_epochs=8, lr=3e-3, gamma=0.9, grad_clip=1.0)
        .debugging(seed=0)
    )


def in_the_hive(policy):
    """The nectar that bees bring home when a policy decides for each."""
    env = parallel_env(HiveSim, points(DEFINITION), possible_agents=BEES)
    return parallel_return(env, lambda agent, observation, info: policy(observation), range(10_000, 10_040))


def in_the_bakery(names):
    """The mean cash in the end when the page's policies decide in turns, over seeds that none has seen."""
    shops = [simulate(names["FourWeeks"], names["policies"], points=names["points"], seed=seed) for seed in HELD_OUT]
    return np.mean([shop.shop.cash for shop in shops])


def test_the_pages_code_trains_two_agents_and_takes_their_policies_out():
    _, spaces, build, train, define, take_out = blocks("_clients_rllib.md")
    names = {"__name__": "__main__"}
    for code in (spaces, build, define):
        exec(code, names)
    algorithm = names["algorithm"]
    early = algorithm.save_to_path()
    exec(train, names)
    trained, names["checkpoint"] = names["checkpoint"], early
    exec(take_out, names)
    before = in_the_bakery(names)
    names["checkpoint"] = trained
    exec(take_out, names)
    policies = names["policies"]
    algorithm.stop()
    assert in_the_bakery(names) > before + 150
    # The model's own loop runs just as the environment's in which one decides after the other.
    env = aec_env(names["FourWeeks"], names["points"])
    env.reset(seed=1)
    while not any(env.terminations.values()) and not any(env.truncations.values()):
        env.step(policies[env.agent_selection](env.observe(env.agent_selection)))
    assert names["shop"].cash == env.simulation.shop.cash


@pytest.mark.parametrize("view", HIVES)
def test_one_policy_for_all_who_are_born(view):
    names = {"__name__": "__main__"}
    exec(blocks("_clients_rllib.md")[4], names)
    algorithm = hive_config(view, DEFINITION).build_algo()
    policy = names["policy_of"](algorithm.get_module("bee"))
    before = in_the_hive(policy)
    for _ in range(8):
        algorithm.train()
    after = in_the_hive(policy)
    algorithm.stop()
    assert after > before + 3
    # All bees of a hive, born whenever, in the model's own loop.
    policies = {Bee.choose_meadow: policy}
    hives = [simulate(HiveSim, policies, points=points(DEFINITION), seed=seed).hive for seed in range(20)]
    assert np.mean([hive.day for hive in hives]) > 10


def test_masks_are_read_from_observations():
    masking = RLModuleSpec(module_class=ActionMaskingTorchRLModule)
    config = hive_config("parallel", MASK_OBSERVED, disable_env_checking=True)
    algorithm = config.rl_module(rl_module_spec=masking).build_algo()
    algorithm.train()  # an illegal action of the one who decides would be an error
    algorithm.stop()
