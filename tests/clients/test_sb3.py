"""Stable-Baselines3 and sb3-contrib: single views, joint views, goals, masks."""

import gymnasium
import pytest
from examples.greenhouse_coop import env as greenhouse
from sb3_contrib import MaskablePPO
from sb3_contrib.common.maskable.utils import get_action_masks
from stable_baselines3 import PPO, SAC, HerReplayBuffer
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from simenv_marl import joint_env, single_env

from . import page
from .returns import single_return
from .worlds import CraneSim, HerdSim, Shop, ShopSim


def policy_of(model):
    return lambda observation, info: model.predict(observation, deterministic=True)[0]


def rescaled(env):
    """With actions from -1 to 1, as Stable-Baselines3 recommends."""
    return gymnasium.wrappers.RescaleAction(env, -1, 1)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "make",
    [
        lambda: single_env(ShopSim, Shop.choose_display),
        lambda: single_env(CraneSim),
        lambda: joint_env(ShopSim, flatten=True),
        lambda: rescaled(greenhouse.watering_env()),
        lambda: rescaled(greenhouse.joint_env(flatten=True)),
        lambda: gymnasium.make("greenhouse_coop/Watering-v0", max_steps=20),
    ],
    ids=["single", "goal", "joint", "greenhouse", "joint greenhouse", "registered"],
)
def test_sb3_accepts_the_views(make):
    env = make()
    check_env(env, warn=env.action_space == gymnasium.spaces.Box(-1, 1, env.action_space.shape))
    env.close()


def test_many_shops_in_processes_of_their_own():
    """They are told what they are told side by side in one process, and so learn the same."""
    learnt = []
    for kind in (DummyVecEnv, SubprocVecEnv):
        envs = make_vec_env(lambda: joint_env(ShopSim, flatten=True), n_envs=2, vec_env_cls=kind)
        model = PPO("MlpPolicy", envs, n_steps=100, batch_size=100, seed=0).learn(200)
        envs.close()
        learnt.append(single_return(joint_env(ShopSim, flatten=True), policy_of(model)))
    assert learnt[0] == learnt[1]


def test_hindsight_replay_learns_a_goal():
    model = SAC(
        "MultiInputPolicy",
        single_env(CraneSim),
        replay_buffer_class=HerReplayBuffer,
        learning_rate=3e-3,
        gamma=0.9,
        tau=0.02,
        batch_size=128,
        learning_starts=200,
        policy_kwargs={"net_arch": [32, 32]},
        seed=0,
    )
    env = single_env(CraneSim)
    assert single_return(env, policy_of(model)) < -8
    model.learn(1500)
    assert single_return(env, policy_of(model)) > -3


def test_masked_decisions_of_a_joint_view():
    env = joint_env(HerdSim, possible_agents=["forager_0", "forager_1"], undeclared="rule", flatten=True)
    model = MaskablePPO("MlpPolicy", env, n_steps=100, batch_size=50, seed=0)
    model.learn(200)
    assert get_action_masks(env).tolist() == [True] * 4


def test_the_code_of_the_page_runs(monkeypatch):
    steps = page.steps("Stable-Baselines3 and sb3-contrib", monkeypatch)
    names = next(steps)
    env = single_env(names["FourWeeks"], names["points"])

    def act(observation, info):
        return names["model"].predict(observation)[0]

    before = single_return(env, act)
    names = next(steps)
    assert single_return(env, act) > before + 100
    together, masked = [dict(names) for names in steps]
    assert together["env"].action_space == gymnasium.spaces.MultiDiscrete([5, 3])
    assert masked["env"].action_masks()[masked["action"]]
