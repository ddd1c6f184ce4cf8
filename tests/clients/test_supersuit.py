"""SuperSuit: its wrappers act on our views as on environments written by hand."""

import copy
import importlib

import numpy as np
import pettingzoo
import pytest
from gymnasium.spaces import Box
from hive import BEES, DEFINITION, HiveSim
from hive import points as bees
from pettingzoo.test import api_test, seed_test
from stable_baselines3 import PPO

from simenv_marl import RULE, aec_env, parallel_env
from simenv_marl.envs import pad_agents
from tests.worlds.vectors import ACTIONS, DialEnv, DialSim, alike, dial_points

from . import page
from .returns import mean_return

# asked for what it has not, the module itself raises ImportErrors
suit = vars(importlib.import_module("supersuit"))
HANDS = ["hand_0"]


class HandEnv(pettingzoo.ParallelEnv):
    """What was written by hand, for one agent."""

    metadata = {  # noqa: RUF012 - PettingZoo's way
        "name": "hand_v0",
        "render_modes": [],
        "is_parallelizable": True,
    }
    render_mode = None
    np_random = np.random.default_rng(0)
    possible_agents = HANDS

    def __init__(self, seen):
        self.env = DialEnv(seen)

    def observation_space(self, agent):
        return self.env.observation_space

    def action_space(self, agent):
        return ACTIONS

    def reset(self, seed=None, options=None):
        self.agents = list(HANDS)
        return self.told(*self.env.reset(), acted=False)

    def step(self, actions):
        told = self.env.step(actions["hand_0"])
        self.agents = [] if self.env.dial.ended else self.agents
        return self.told(*told, acted=True)

    def told(self, *parts, acted):
        infos = {"deciding": bool(self.agents), "acted": acted}
        return tuple({"hand_0": part | infos if part is parts[-1] else part} for part in parts)


def hive(clip_actions=False, **changes):
    return parallel_env(
        HiveSim, bees(DEFINITION | changes), possible_agents=BEES, clip_actions=clip_actions
    )


def halved(value, *space):
    return value / 2


WRAPPERS = {
    "action_lambda_v1": (
        {"change_action_fn": halved, "change_space_fn": lambda space: space},
        "numbers",
    ),
    "agent_indicator_v0": ({}, "numbers"),
    "clip_actions_v0": ({}, "numbers"),
    "clip_reward_v0": ({}, "numbers"),
    "color_reduction_v0": ({}, "picture"),
    "delay_observations_v0": ({"delay": 2}, "numbers"),
    "dtype_v0": ({"dtype": np.float16}, "numbers"),
    "flatten_v0": ({}, "picture"),
    "frame_skip_v0": ({"num_frames": 2}, "numbers"),
    "frame_stack_v1": ({"stack_size": 3}, "numbers"),
    "frame_stack_v2": ({"stack_size": 3}, "numbers"),
    "max_observation_v0": ({"memory": 2}, "picture"),
    "nan_noop_v0": ({"no_op_action": np.zeros(2, np.float32)}, "numbers"),
    "nan_random_v0": ({}, "numbers"),
    "nan_zeros_v0": ({}, "numbers"),
    "normalize_obs_v0": ({}, "numbers"),
    "observation_lambda_v0": ({"change_observation_fn": halved}, "numbers"),
    "pad_action_space_v0": ({}, "numbers"),
    "pad_observations_v0": ({}, "numbers"),
    "reshape_v0": ({"shape": (2, 2)}, "numbers"),
    "resize_v1": ({"x_size": 2, "y_size": 3}, "picture"),
    "reward_lambda_v0": ({"change_reward_fn": halved}, "numbers"),
    "scale_actions_v0": ({"scale": 0.5}, "numbers"),
    "sticky_actions_v0": ({"repeat_action_probability": 0.5}, "numbers"),
}


def story_around(env):
    """Its spaces, and what it tells in some episodes of sampled actions."""
    found = [env.observation_space(agent) for agent in HANDS] + [
        env.action_space(agent) for agent in HANDS
    ]
    sampled = copy.deepcopy(env.action_space("hand_0"))
    sampled.seed(1)
    told = [found, env.reset(seed=3)]
    for number in range(14):
        told.append(env.step({agent: sampled.sample() for agent in env.agents}))
        if not env.agents:
            told.append(env.reset(seed=number))
    return told


@pytest.mark.parametrize("name", WRAPPERS)
def test_supersuit_wrappers_work_as_around_an_env_written_by_hand(name):
    arguments, seen = WRAPPERS[name]

    def make():
        return suit[name](aec_env(DialSim, dial_points(seen)), **arguments)

    api_test(make(), num_cycles=20)
    seed_test(make, num_cycles=20)
    wrapped, by_hand = (
        suit[name](env, **arguments)
        for env in (parallel_env(DialSim, dial_points(seen)), HandEnv(seen))
    )
    assert alike(story_around(wrapped), story_around(by_hand))


def test_supersuit_trains_one_stable_baselines3_policy_for_all_agents():
    """As PettingZoo's tutorial has it."""
    envs = suit["pettingzoo_env_to_vec_env_v1"](suit["black_death_v3"](hive()))
    envs = suit["concat_vec_envs_v1"](envs, 4, num_cpus=1, base_class="stable_baselines3")
    # PPO's own seed=0 asks SuperSuit's vectors for a method that they have not
    envs.venv.reset(seed=0)
    np.random.seed(0)
    model = PPO("MlpPolicy", envs, n_steps=64, batch_size=256, gamma=0.5, learning_rate=3e-3)
    model.learn(10_000)

    def worth(act):
        return mean_return(HiveSim, bees(DEFINITION), act, possible_agents=BEES)

    by_rule = worth(lambda bee, seen, info: RULE)
    assert (
        worth(lambda bee, seen, info: int(model.predict(seen, deterministic=True)[0])) > by_rule + 3
    )


def test_env_options_give_the_same_results_as_supersuit_wrappers():
    boxes = {
        "action_space": Box(0, 1, (1,)),
        "action_space_mapping": lambda action: int(2.9 * action[0]),
    }
    wrapped = suit["clip_reward_v0"](suit["clip_actions_v0"](hive(**boxes)), 0, 0.5)
    halves = Box(0, 0.5, (4,))
    wrapped = suit["observation_lambda_v0"](
        wrapped, lambda seen, space: halved(seen), lambda space: halves
    )
    wrapped = suit["black_death_v3"](wrapped)
    boxes |= {
        "observation_space": halves,
        "observation_space_mapping": lambda bee: halved(np.array(bee.observed())),
    }
    ours = pad_agents(
        hive(reward_mapping=lambda bee: min(bee.brought, 0.5), clip_actions=True, **boxes)
    )
    told = []
    for env in (wrapped, ours):
        drawn = np.random.default_rng(3)
        told.append([env.reset(seed=1)[0]])
        while env.agents:
            actions = {name: drawn.uniform(-0.5, 1.5, 1).astype(np.float32) for name in BEES}
            observations, rewards, *_ = env.step({agent: actions[agent] for agent in env.agents})
            alive = {bee.name for bee in env.unwrapped.simulation.hive.bees}
            told[-1].append(({name: observations[name] for name in sorted(alive)}, rewards))
    by_wrappers, by_options = told
    assert alike(by_wrappers[: len(by_options)], by_options)
    # black_death_v3 notices the end a step later
    assert 3 < len(by_options) == len(by_wrappers) - 1
    assert max(rewards["bee_0"] for _, rewards in by_options[1:]) == 0.5


def test_code_of_the_supersuit_page_runs_as_printed(monkeypatch):
    (names,) = page.steps("SuperSuit", monkeypatch)
    assert names["observations"].shape == (4, 6)
    assert names["rewards"].shape == (4,)
