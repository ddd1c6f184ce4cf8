"""Stable-Baselines3 and sb3-contrib: single views, joint views, goals, masks."""

from functools import partial

import gymnasium
import numpy as np
import pytest
from examples.greenhouse_coop import env as greenhouse
from gymnasium import spaces
from hive import DEFINITION, HiveSim, points
from sb3_contrib import MaskablePPO
from sb3_contrib.common.maskable.utils import get_action_masks
from stable_baselines3 import PPO, SAC, HerReplayBuffer
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from simenv_marl import TRUNCATED, joint_env, make_step, single_env

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
def test_sb3_accepts_the_views(make):
    env = make()
    check_env(env, warn=env.action_space == spaces.Box(-1, 1, env.action_space.shape))
    env.close()


def test_vectors_in_one_process_and_in_many_learn_the_same():
    learnt = []
    for kind in (DummyVecEnv, SubprocVecEnv):
        envs = make_vec_env(two_bees, n_envs=2, vec_env_cls=kind)
        model = PPO("MlpPolicy", envs, n_steps=100, batch_size=100, seed=0).learn(200)
        envs.close()
        learnt.append(worth(model, two_bees()))
    assert learnt[0] == learnt[1]


def test_hindsight_replay_learns_a_goal():
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


def test_masks_of_a_joint_view_reach_the_policy():
    env = joint_env(HiveSim, points(), **TWO_BEES)
    MaskablePPO("MlpPolicy", env, n_steps=100, batch_size=50, seed=0).learn(200)
    env.reset(seed=0)
    nectar = env.unwrapped.simulation.hive.nectar
    assert 0.0 in nectar
    assert get_action_masks(env).tolist() == [amount > 0 for amount in nectar] + [True] * 3


def test_the_code_of_the_page_runs(monkeypatch):
    steps = page.steps("Stable-Baselines3 and sb3-contrib", monkeypatch)
    names = next(steps)
    env = single_env(names["FourWeeks"], names["points"])
    before = worth(names["model"], env, deterministic=False)
    names = next(steps)
    assert worth(names["model"], env, deterministic=False) > before + 100
    together, masked = [dict(names) for names in steps]
    assert together["env"].action_space == spaces.MultiDiscrete([5, 3])
    assert masked["env"].action_masks()[masked["action"]]
