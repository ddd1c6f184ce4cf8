"""SuperSuit, whose wrappers people bring along: around our views they do what they do around those written by hand."""

import copy
import importlib

import gymnasium
import numpy as np
import pettingzoo
import pytest
from pettingzoo.test import api_test, seed_test
from stable_baselines3 import PPO

from simenv_marl import TRUNCATED, aec_env, parallel_env
from tests.worlds.counters import alike
from tests.worlds.dials import ACTIONS, SEEN, Dial, DialEnv, dial_env, points, turned_by

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
OF_AGENTS = {"agent_indicator_v0", "pad_action_space_v0", "pad_observations_v0"}
VECTORS = {
    "black_death_v3",
    "concat_vec_envs_v1",
    "gym_vec_env_v0",
    "pettingzoo_env_to_vec_env_v1",
    "stable_baselines3_vec_env_v0",
    "vectorize_aec_env_v0",
}
FOR_OTHERS = {"stable_baselines_vec_env_v0"}  # what came before Stable-Baselines3
EVERY_WRAPPER = pytest.mark.parametrize("name", WRAPPERS)


def test_no_wrapper_is_left_out():
    versioned = {name for name in suit if name.rpartition("_v")[2].isdigit()}
    assert versioned == WRAPPERS.keys() | VECTORS | FOR_OTHERS


@EVERY_WRAPPER
def test_around_turns(name):
    arguments, seen = WRAPPERS[name]

    def make():
        return suit[name](hands(aec_env, seen), **arguments)

    api_test(make(), num_cycles=20)
    seed_test(make, num_cycles=20)


def story_around(name, env):
    """Its spaces, and what it tells in some episodes of sampled actions."""
    env = suit[name](env, **WRAPPERS[name][0])
    if one := isinstance(env, gymnasium.Env):
        found = [env.observation_space, env.action_space]
    else:
        found = [env.observation_space(agent) for agent in HANDS] + [env.action_space(agent) for agent in HANDS]
    sampled = copy.deepcopy(found[-1] if one else env.action_space("hand_0"))
    sampled.seed(1)
    told = [found, env.reset(seed=3)]
    for number in range(14):
        told.append(env.step(sampled.sample() if one else {agent: sampled.sample() for agent in env.agents}))
        if any(told[-1][2:4]) if one else not env.agents:
            told.append(env.reset(seed=number))
    return told


@EVERY_WRAPPER
def test_around_rounds(name):
    seen = WRAPPERS[name][1]
    assert alike(story_around(name, hands(parallel_env, seen)), story_around(name, HandsEnv(seen)))


@pytest.mark.parametrize("name", WRAPPERS.keys() - OF_AGENTS)
def test_around_one(name):
    seen = WRAPPERS[name][1]
    assert alike(story_around(name, dial_env(seen)), story_around(name, DialEnv(seen)))


def herds(env, all_there):
    """A few episodes, in which all go out every day: what they were paid, and in how many rounds."""
    told = []
    for seed in range(4):
        env.reset(seed=seed)
        paid, rounds = dict.fromkeys(FORAGERS, 0.0), 0
        while env.agents:
            assert list(env.agents) == FORAGERS or not all_there
            observations, rewards, *_ = env.step(dict.fromkeys(env.agents, 1))
            assert observations.keys() == set(FORAGERS) or not all_there
            paid = {agent: paid[agent] + rewards.get(agent, 0.0) for agent in FORAGERS}
            rounds += 1
        told.append((paid, rounds))
    return told


def test_the_dead_go_on_as_black_death_has_it():
    plain = herds(parallel_env(HerdSim, possible_agents=FORAGERS), all_there=False)
    black = herds(suit["black_death_v3"](parallel_env(HerdSim, possible_agents=FORAGERS)), all_there=True)
    # It notices the end a step later: by an environment that has nothing more to tell.
    assert black == [(paid, rounds + 1) for paid, rounds in plain]


def vectors_of(env, processes):
    return suit["concat_vec_envs_v1"](suit["pettingzoo_env_to_vec_env_v1"](env), 3, num_cpus=processes)


def story_of(envs, number):
    sampled = copy.deepcopy(envs.action_space)
    sampled.seed(1)
    told = [envs.reset(seed=3)]
    for _ in range(14):
        told.append(envs.step(np.stack([sampled.sample() for _ in range(number)])))
    envs.close()
    return told


@pytest.mark.parametrize("processes", [0, 2])
def test_environments_of_many_hands(processes):
    """Also of one that was reset before it is copied, as PettingZoo's tutorial does it."""
    begun = hands(parallel_env)
    begun.reset(seed=7)
    theirs = story_of(vectors_of(HandsEnv(), processes), 6)
    for env in (hands(parallel_env), begun):
        assert alike(story_of(vectors_of(env, processes), 6), theirs)


@pytest.mark.parametrize(
    ("wrapper", "options", "reset"),
    [
        ("gym_vec_env_v0", {"multiprocessing": False}, {"seed": 1}),
        ("gym_vec_env_v0", {"multiprocessing": True}, {"seed": 1}),
        ("stable_baselines3_vec_env_v0", {}, {}),
    ],
    ids=["vector", "processes", "stable-baselines3"],
)
def test_many_single_views(wrapper, options, reset):
    actions, told = np.full((2, 2), 0.5, np.float32), []
    for env in (dial_env(), DialEnv()):
        envs = suit[wrapper](env, 2, **options)
        told.append([envs.reset(**reset), *(envs.step(actions) for _ in range(9))])
        envs.close()
    assert alike(*told)


def test_many_environments_of_turns():
    # In processes of their own it asks environments for `terms`, which none of PettingZoo's has.
    envs = suit["vectorize_aec_env_v0"](hands(aec_env), 3)
    envs.reset(seed=1)
    turned = dict.fromkeys(HANDS, 0)
    for agent in envs.agent_iter(12):
        observations, *_, passes, _ = envs.last()
        assert observations.shape == (3, 4)
        assert not passes.any()
        turned[agent] += observations[0, 1] == turned[agent]
        envs.step(np.full((3, 2), 0.5, np.float32))
    assert min(turned.values()) == 5


def test_one_policy_of_stable_baselines3_for_all_agents():
    """As PettingZoo's tutorial has it."""
    env = suit["black_death_v3"](parallel_env(HerdSim, possible_agents=FORAGERS))
    envs = suit["pettingzoo_env_to_vec_env_v1"](env)
    envs = suit["concat_vec_envs_v1"](envs, 4, num_cpus=1, base_class="stable_baselines3")
    envs.venv.reset(seed=0)  # PPO's own seed=0 asks SuperSuit's vectors for a method that they have not
    np.random.seed(0)
    model = PPO("MlpPolicy", envs, n_steps=64, batch_size=256, gamma=0.5, learning_rate=3e-3)

    def greedy(agent, observation, info):
        return int(model.predict(observation, deterministic=True)[0])

    def untrained(agent, observation, info):
        return 1

    tested = parallel_env(HerdSim, possible_agents=FORAGERS)
    model.learn(10_000)
    after = parallel_return(tested, greedy)
    assert after > parallel_return(tested, untrained) + 5


def test_what_options_say_in_place_of_wrappers():
    common, before, after = page.blocks("coming-from-supersuit.md")
    told = []
    for code in (before, after):
        names = {}
        exec(common, names)
        exec(code, names)
        env, drawn = names["env"], np.random.default_rng(3)
        told.append([env.reset(seed=1)[0]])
        while env.agents:
            actions = {name: drawn.uniform(-0.5, 1.0, 1).astype(np.float32) for name in names["names"]}
            observations, rewards, *_ = env.step({agent: actions[agent] for agent in env.agents})
            alive = {boat.name for boat in env.unwrapped.simulation.boats}
            told[-1].append(({name: observations[name] for name in sorted(alive)}, rewards))
    wrapped, ours = told
    assert alike(wrapped[: len(ours)], ours)
    assert 3 < len(ours) == len(wrapped) - 1  # black_death_v3 notices the end a step later
    assert min(rewards["boat_0"] for _, rewards in ours[1:]) == -0.5


def test_the_page(monkeypatch):
    (names,) = page.steps("SuperSuit", monkeypatch)
    assert names["observations"].shape == (4, 6)
    assert names["rewards"].shape == (4,)
