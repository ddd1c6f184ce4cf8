"""SuperSuit, whose wrappers people bring along: around our views they do what they do around those written by hand."""

import copy
import importlib

import numpy as np
import pettingzoo
import pytest
from gymnasium.spaces import Box
from pettingzoo.test import api_test, seed_test
from stable_baselines3 import PPO

from simenv_marl import TRUNCATED, SimulationInterface, aec_env, difference, make_step, parallel_env
from simenv_marl.envs import pad_agents
from tests.worlds.counters import alike
from tests.worlds.dials import ACTIONS, SEEN, Dial, points, turned_by

from . import page
from .returns import parallel_return
from .worlds import FORAGERS, HerdSim

suit = vars(importlib.import_module("supersuit"))  # asked for what it has not, the module itself raises ImportErrors
HANDS = ["hand_0", "hand_1"]


class Hand(Dial):
    def __init__(self, number):
        super().__init__(number)
        self.name = HANDS[number]


class HandsSim:
    """Two dials, which are turned at once."""

    def reset(self):
        self.dials = [Hand(number) for number in range(2)]

    def expected_calls(self, point):
        return [(dial,) for dial in self.dials]

    def run(self):
        while not self.dials[0].ended:
            for dial in self.dials:
                dial.turn(dial.choose())
        return TRUNCATED


class HandsEnv(pettingzoo.ParallelEnv):
    """The same, written by hand."""

    metadata = {"name": "hands_v0", "render_modes": [], "is_parallelizable": True}  # noqa: RUF012 - PettingZoo's way
    render_mode = None
    np_random = np.random.default_rng(0)
    possible_agents = HANDS

    def __init__(self, seen="numbers"):
        self.space, self.look = SEEN[seen]

    def observation_space(self, agent):
        return self.space

    def action_space(self, agent):
        return ACTIONS

    def reset(self, seed=None, options=None):
        self.agents = list(HANDS)
        self.dials = {name: Hand(number) for number, name in enumerate(HANDS)}
        return self.seen(), self.infos(False)

    def step(self, actions):
        for name, dial in self.dials.items():
            dial.turn(turned_by(actions[name]))
        over = self.dials["hand_0"].ended
        self.agents = [] if over else self.agents
        rewards = {name: dial.place for name, dial in self.dials.items()}
        return self.seen(), rewards, dict.fromkeys(HANDS, False), dict.fromkeys(HANDS, over), self.infos(True)

    def seen(self):
        return {name: self.look(dial) for name, dial in self.dials.items()}

    def infos(self, acted):
        return {name: {"deciding": name in self.agents[:1], "acted": acted} for name in HANDS}


def hands(view, seen="numbers"):
    return view(HandsSim, points(seen, lambda dial: dial.name), possible_agents=HANDS)


def halved(value, *space):
    return value / 2


WRAPPERS = {
    "action_lambda_v1": ({"change_action_fn": halved, "change_space_fn": lambda space: space}, "numbers"),
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
    found = [env.observation_space(agent) for agent in HANDS] + [env.action_space(agent) for agent in HANDS]
    sampled = copy.deepcopy(env.action_space("hand_0"))
    sampled.seed(1)
    told = [found, env.reset(seed=3)]
    for number in range(14):
        told.append(env.step({agent: sampled.sample() for agent in env.agents}))
        if not env.agents:
            told.append(env.reset(seed=number))
    return told


@pytest.mark.parametrize("name", WRAPPERS)
def test_wrappers_do_in_turns_and_rounds_what_they_do_around_environments_written_by_hand(name):
    arguments, seen = WRAPPERS[name]

    def make():
        return suit[name](hands(aec_env, seen), **arguments)

    api_test(make(), num_cycles=20)
    seed_test(make, num_cycles=20)
    wrapped, by_hand = (suit[name](env, **arguments) for env in (hands(parallel_env, seen), HandsEnv(seen)))
    assert alike(story_around(wrapped), story_around(by_hand))


def test_one_policy_of_stable_baselines3_for_all_agents():
    """As PettingZoo's tutorial has it."""
    env = suit["black_death_v3"](parallel_env(HerdSim, possible_agents=FORAGERS))
    envs = suit["pettingzoo_env_to_vec_env_v1"](env)
    envs = suit["concat_vec_envs_v1"](envs, 4, num_cpus=1, base_class="stable_baselines3")
    envs.venv.reset(seed=0)  # PPO's own seed=0 asks SuperSuit's vectors for a method that they have not
    np.random.seed(0)
    model = PPO("MlpPolicy", envs, n_steps=64, batch_size=256, gamma=0.5, learning_rate=3e-3)

    tested = parallel_env(HerdSim, possible_agents=FORAGERS)
    model.learn(10_000)
    after = parallel_return(tested, lambda agent, seen, info: int(model.predict(seen, deterministic=True)[0]))
    assert after > parallel_return(tested, lambda agent, seen, info: 1) + 5


class Boat:
    def __init__(self, name):
        self.name, self.cash = name, 2.0

    def choose_effort(self):
        return 0.5


class Harbour(SimulationInterface):
    def reset(self):
        self.boats = [Boat("boat_0"), Boat("boat_1")]

    def run(self):
        for _ in range(8):
            for boat in list(self.boats):
                boat.cash += 2 * boat.choose_effort() - 1
                if boat.cash <= 0:
                    self.boats.remove(boat)
                    self.end_agent(boat.name)

    def expected_calls(self, point):
        return [(boat,) for boat in self.boats]


BOATS = ["boat_0", "boat_1"]


def harbour(bounds, cash, reward, **options):
    definition = make_step(
        observation_space=Box(-bounds, bounds, (1,)),
        observation_space_mapping=cash,
        action_space=Box(0, 1, (1,)),
        action_space_mapping=lambda action: float(action[0]),
        reward_mapping=reward,
        agent=lambda boat: boat.name,
    )
    return parallel_env(Harbour, {Boat.choose_effort: definition}, possible_agents=BOATS, **options)


def with_wrappers():
    env = suit["clip_actions_v0"](harbour(20, lambda boat: [boat.cash], difference(lambda boat: boat.cash)))
    env = suit["clip_reward_v0"](env, -0.5, 0.5)
    env = suit["observation_lambda_v0"](env, lambda seen, space: seen / 20, lambda space: Box(-1, 1, (1,)))
    return suit["black_death_v3"](env)


def with_options():
    earned = difference(lambda boat: boat.cash)
    env = harbour(1, lambda boat: [boat.cash / 20], lambda boat: max(-0.5, min(0.5, earned(boat))), clip_actions=True)
    return pad_agents(env)


def test_options_replace_wrappers():
    told = []
    for env in (with_wrappers(), with_options()):
        drawn = np.random.default_rng(3)
        told.append([env.reset(seed=1)[0]])
        while env.agents:
            actions = {name: drawn.uniform(-0.5, 1.0, 1).astype(np.float32) for name in BOATS}
            observations, rewards, *_ = env.step({agent: actions[agent] for agent in env.agents})
            alive = {boat.name for boat in env.unwrapped.simulation.boats}
            told[-1].append(({name: observations[name] for name in sorted(alive)}, rewards))
    wrapped, ours = told
    assert alike(wrapped[: len(ours)], ours)
    assert 3 < len(ours) == len(wrapped) - 1  # black_death_v3 notices the end a step later
    assert min(rewards["boat_0"] for _, rewards in ours[1:]) == -0.5


def test_the_code_of_the_page_runs(monkeypatch):
    (names,) = page.steps("SuperSuit", monkeypatch)
    assert names["observations"].shape == (4, 6)
    assert names["rewards"].shape == (4,)
