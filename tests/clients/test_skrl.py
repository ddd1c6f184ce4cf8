"""skrl: the parallel view, and the single one."""

import torch
from examples.greenhouse_coop.env import WATERING, GreenhouseSim
from hive import BEES, DEFINITION, HiveSim, points
from skrl.envs.wrappers.torch import wrap_env

from simenv_marl import parallel_env, single_env, vector_env
from simenv_marl.envs import pad_agents

from . import page


def test_skrl_gets_all_agents_at_all_times_from_pad_agents():
    options = {"possible_agents": BEES, "state_space": "observations"}
    env = wrap_env(
        pad_agents(parallel_env(HiveSim, points(DEFINITION), **options)), wrapper="pettingzoo"
    )
    observations, _ = env.reset()
    days = 0
    while env.agents:
        assert observations.keys() == set(BEES)
        assert {state.shape for state in env.state().values()} == {(1, 4 * len(BEES))}
        observations, rewards, *_ = env.step({agent: torch.tensor([[0]]) for agent in BEES})
        assert rewards.keys() == set(BEES)
        days += 1
    assert days >= 8  # the last bee hatches on the sixth day, and lives two days at least
    env.close()


def test_code_of_the_skrl_page_runs_as_printed(monkeypatch):
    steps = page.steps("skrl", monkeypatch)
    names = next(steps)
    env, learner = names["env"], names["learners"]

    def worth():
        """What the policies earn while they explore."""
        earned = 0.0
        learner.enable_training_mode(False)
        with torch.no_grad():
            for _ in range(20):
                observations, _ = env.reset()
                while True:
                    actions, _ = learner.act(observations, env.state(), timestep=0, timesteps=0)
                    observations, rewards, *_ = env.step(actions)
                    earned += sum(reward.item() for reward in rewards.values())
                    if not env.agents:
                        break
        return earned / 20

    before = worth()
    names = next(steps)
    assert worth() > before + 150
    env.close()


def test_skrl_wraps_single_env_and_vector_env():
    env = wrap_env(single_env(GreenhouseSim, WATERING), wrapper="gymnasium", verbose=False)
    observation, _ = env.reset()
    assert observation.shape == (1, 6)
    assert env.step(torch.tensor([[0.25]]))[1].shape == (1, 1)
    env.close()
    envs = wrap_env(
        vector_env(GreenhouseSim, WATERING, num_envs=3), wrapper="gymnasium", verbose=False
    )
    observations, _ = envs.reset()
    assert observations.shape == (3, 6)
    assert envs.step(torch.zeros(3, 1))[1].isfinite().all()
    envs.close()
