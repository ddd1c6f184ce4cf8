"""Stable-Baselines3 and sb3-contrib: single views, joint views, goals, masks."""

import gc
import multiprocessing
import os
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from bakery_env import FourWeeks
from examples.greenhouse_coop import env as greenhouse
from gymnasium import spaces
from hive import DEFINITION, HiveSim, points
from sb3_contrib import MaskablePPO
from sb3_contrib.common.maskable.utils import get_action_masks
from stable_baselines3 import PPO, SAC, HerReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from simenv_marl import TRUNCATED, joint_env, make_step, single_env, vector_env
from tests.processes import descriptors

from . import page

TWO_BEES = {"possible_agents": ["bee_0", "bee_1"], "undeclared": "rule", "flatten": True}
two_bees = partial(joint_env, HiveSim, points(DEFINITION), **TWO_BEES)


def above(achieved, desired, info):
    return -(np.linalg.norm(achieved - desired, axis=-1) > 0.3).astype(float)


class Crane:
    """A crane that brings its hook above a load; all that is told is whether it is there."""

    def reset(self, seed=None):
        self.hook, self.load = np.zeros(2), np.random.default_rng(seed).uniform(-1, 1, 2)

    def run(self):
        for _ in range(10):
            self.hook = np.clip(self.hook + self.choose_move(), -1, 1)
        return TRUNCATED

    @make_step(
        observation_space=spaces.Box(-1, 1, (2,), np.float32),
        observation_space_mapping=lambda crane: crane.hook,
        action_space=spaces.Box(-1, 1, (2,), np.float32),
        action_space_mapping=lambda action: 0.4 * action.astype(float),
        reward_mapping=lambda crane: above(np.float32(crane.hook), np.float32(crane.load), None),
        goal_space=spaces.Box(-1, 1, (2,), np.float32),
        achieved_goal_mapping=lambda crane: crane.hook,
        desired_goal_mapping=lambda crane: crane.load,
        compute_reward=above,
    )
    def choose_move(self):
        return np.zeros(2)


crane = partial(single_env, Crane, Crane.choose_move)


def worth(model, env, **options):
    """The mean return of a policy over seeds that no training has seen."""
    env.reset(seed=10_000)
    return evaluate_policy(model, env, n_eval_episodes=30, warn=False, **options)[0]


def rescaled(env):
    """With actions from -1 to 1, as Stable-Baselines3 recommends."""
    return gymnasium.wrappers.RescaleAction(env, -1, 1)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "make",
    [
        lambda: single_env(HiveSim, points(DEFINITION), agent="bee_0"),
        crane,
        two_bees,
        lambda: rescaled(greenhouse.watering_env()),
        lambda: rescaled(greenhouse.joint_env(flatten=True)),
        lambda: gymnasium.make("greenhouse_coop/Watering-v0", max_steps=20),
    ],
    ids=["single", "goal", "joint", "greenhouse", "joint greenhouse", "registered"],
)
def test_stable_baselines3_accepts_single_joint_and_turn_env(make):
    env = make()
    check_env(env, warn=env.action_space == spaces.Box(-1, 1, env.action_space.shape))
    env.close()


def test_stable_baselines3_learns_the_same_with_and_without_workers():
    learnt = []
    for kind in (DummyVecEnv, SubprocVecEnv):
        envs = make_vec_env(two_bees, n_envs=2, vec_env_cls=kind)
        model = PPO("MlpPolicy", envs, n_steps=100, batch_size=100, seed=0).learn(200)
        envs.close()
        learnt.append(worth(model, two_bees()))
    assert learnt[0] == learnt[1]


BATCH = "bakery.Bakery.choose_batch"


class Vector(VecEnv):
    """A vector environment of Gymnasium, with ``SAME_STEP``, for Stable-Baselines3.

    It notes the episodes of each simulation, up to the first that is lost.
    """

    def __init__(self, envs):
        self.envs, self.lost = envs, 0
        self.episodes = [[] for _ in range(envs.num_envs)]
        self.is_whole = np.ones(envs.num_envs, bool)
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self):
        return self.envs.reset(seed=0)[0]

    def step_async(self, actions):
        self.actions = actions

    def step_wait(self):
        observations, rewards, terminations, truncations, infos = self.envs.step(self.actions)
        ends = terminations | truncations
        final = infos.get("final_info", {})
        lost = np.asarray(final.get("lost", np.zeros(self.num_envs, bool)))
        assert not (lost & ~truncations).any()
        self.lost += lost.sum()
        self.is_whole &= ~lost
        each = [{"TimeLimit.truncated": bool(truncated)} for truncated in truncations]
        for place in range(self.num_envs):
            if ends[place]:
                each[place]["terminal_observation"] = infos["final_obs"][place]
            if self.is_whole[place]:
                seen = observations[place].tolist(), rewards[place], ends[place]
                self.episodes[place].append((self.actions[place].tolist(), *seen))
        return observations, rewards, ends, each

    def close(self):
        self.envs.close()

    def get_attr(self, name, indices=None):
        return [getattr(self.envs, name)] * self.num_envs

    def set_attr(self, name, value, indices=None):
        raise NotImplementedError

    def env_method(self, name, *args, indices=None, **kwargs):
        raise NotImplementedError

    def env_is_wrapped(self, kind, indices=None):
        return [False] * self.num_envs


def kill_workers(seconds, every, ended):
    """Kill a random worker again and again for some seconds; return how many."""
    number, until = 0, time.monotonic() + seconds
    random = np.random.default_rng(0)
    while time.monotonic() < until and not ended.wait(every):
        there = [each for each in multiprocessing.active_children() if "worker" in each.name]
        if there:
            os.kill(random.choice([each.pid for each in there]), signal.SIGKILL)
            number += 1
    ended.wait(every)  # the last one is noticed
    ended.set()
    return number


class Deaths(BaseCallback):
    """Ends a training some time after the last death."""

    def __init__(self, ended):
        super().__init__()
        self.ended = ended

    def _on_step(self):
        return not self.ended.is_set()


@pytest.mark.parametrize("seconds", [int(os.environ.get("SECONDS_OF_DEATHS", "9"))])
@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="descriptors are not told of")
def test_stable_baselines3_training_survives_dead_workers(seconds):
    def learn(kill):
        envs = Vector(
            vector_env(
                FourWeeks,
                BATCH,
                num_envs=4,
                workers=2,
                restart=True,
                most_restarts=100,
                autoreset_mode="SameStep",
            )
        )
        model = PPO("MlpPolicy", envs, n_steps=64, batch_size=64, seed=0)
        ended = threading.Event()
        with ThreadPoolExecutor(1) as killer:
            killed = killer.submit(kill_workers, seconds, 3.0, ended) if kill else None
            model.learn(10**9 if kill else 512, callback=Deaths(ended))
        envs.close()
        return envs, 0 if killed is None else killed.result()

    learn(False)
    gc.collect()
    before = descriptors(), threading.active_count()
    with pytest.warns(UserWarning, match="restart"):
        envs, deaths = learn(True)
    assert deaths >= seconds // 3 - 1
    assert envs.envs.restarts == deaths
    assert envs.lost == 2 * deaths
    gc.collect()  # errors of dead workers hold their processes, whose sentinels are pipes
    assert (descriptors(), threading.active_count()) == before
    assert [each.name for each in multiprocessing.active_children() if "worker" in each.name] == []
    # Each simulation, played with the same actions in this process, tells the same.
    for place, steps in enumerate(envs.episodes):
        env = vector_env(FourWeeks, BATCH, num_envs=1, autoreset_mode="SameStep")
        env.reset(seed=place)
        for action, *seen in steps:
            observations, rewards, terminations, truncations, _ = env.step(np.array([action]))
            ends = terminations | truncations
            assert [observations[0].tolist(), rewards[0], ends[0]] == seen
        env.close()
        print(f"{len(steps)} steps of simulation {place}, {deaths} deaths")


def test_stable_baselines3_learns_a_goal_by_hindsight_replay():
    model = SAC(
        "MultiInputPolicy",
        crane(),
        replay_buffer_class=HerReplayBuffer,
        learning_rate=3e-3,
        gamma=0.9,
        tau=0.02,
        batch_size=128,
        learning_starts=200,
        policy_kwargs={"net_arch": [32, 32]},
        seed=0,
    )
    assert worth(model, crane()) < -8
    model.learn(1500)
    assert worth(model, crane()) > -3


def test_stable_baselines3_policy_gets_masks_of_joint_env():
    env = joint_env(HiveSim, points(), **TWO_BEES)
    MaskablePPO("MlpPolicy", env, n_steps=100, batch_size=50, seed=0).learn(200)
    env.reset(seed=0)
    nectar = env.unwrapped.simulation.hive.nectar
    assert 0.0 in nectar
    assert get_action_masks(env).tolist() == [amount > 0 for amount in nectar] + [True] * 3


def test_code_of_the_stable_baselines3_page_runs_as_printed(monkeypatch):
    steps = page.steps("Stable-Baselines3 and sb3-contrib", monkeypatch)
    names = next(steps)
    env = single_env(names["FourWeeks"], names["points"])
    before = worth(names["model"], env, deterministic=False)
    names = next(steps)
    assert worth(names["model"], env, deterministic=False) > before + 100
    together, masked = [dict(names) for names in steps]
    assert together["env"].action_space == spaces.MultiDiscrete([5, 3])
    assert masked["env"].action_masks()[masked["action"]]
