"""skrl: the parallel view, and the single one."""

import numpy as np
import pytest
import torch
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import CategoricalMixin, DeterministicMixin, Model
from skrl.multi_agents.torch.ippo import IPPO
from skrl.multi_agents.torch.mappo import MAPPO
from skrl.trainers.torch import SequentialTrainer
from skrl.utils import set_seed
from torch import nn

from simenv_marl import parallel_env, single_env, vector_env
from simenv_marl.envs import pad_agents

from . import page
from .returns import parallel_return
from .worlds import FORAGERS, SHOP_STATE, HerdSim, ReservoirSim, ShopSim

QUIET = {"write_interval": 0, "checkpoint_interval": 0}


class Policy(CategoricalMixin, Model):
    def __init__(self, spaces):
        Model.__init__(self, **spaces)
        CategoricalMixin.__init__(self)
        self.net = nn.Sequential(nn.Linear(self.num_observations, 32), nn.Tanh(), nn.Linear(32, self.num_actions))

    def compute(self, inputs, role):
        return self.net(inputs["observations"]), {}


class Value(DeterministicMixin, Model):
    def __init__(self, spaces, sees):
        Model.__init__(self, **spaces)
        DeterministicMixin.__init__(self)
        self.sees = sees
        inputs = self.num_states if sees == "states" else self.num_observations
        self.net = nn.Sequential(nn.Linear(inputs, 32), nn.Tanh(), nn.Linear(32, 1))

    def compute(self, inputs, role):
        return self.net(inputs[self.sees]), {}


def learners(kind, env, sees):
    """An untrained learner for each agent."""
    models = {}
    for agent in env.possible_agents:
        spaces = {
            "observation_space": env.observation_space(agent),
            "state_space": env.state_space(agent),
            "action_space": env.action_space(agent),
        }
        models[agent] = {"policy": Policy(spaces), "value": Value(spaces, sees)}
    by_agent = {agent: {} for agent in env.possible_agents}
    parts = ("learning_rate_scheduler", "observation_preprocessor", "state_preprocessor", "value_preprocessor")
    return kind(
        possible_agents=env.possible_agents,
        models=models,
        memories={agent: RandomMemory(memory_size=100) for agent in env.possible_agents},
        observation_spaces=env.observation_spaces,
        state_spaces=env.state_spaces,
        action_spaces=env.action_spaces,
        cfg={
            "rollouts": 100,
            "mini_batches": 4,
            "learning_rate": 3e-3,
            "discount_factor": 0.5,
            "entropy_loss_scale": 0.01,
            "experiment": QUIET,
            **{f"{part}_kwargs": by_agent for part in parts},
        },
    )


def train(env, learner, steps):
    cfg = {"timesteps": steps, "headless": True, "disable_progressbar": True, "close_environment_at_exit": False}
    SequentialTrainer(env=env, agents=learner, cfg=cfg).train()


def greedy(learner):
    def act(agent, observation, info):
        with torch.no_grad():
            return int(learner.policies[agent].net(torch.from_numpy(observation)).argmax())

    return act


@pytest.mark.parametrize(
    ("kind", "sees", "state_space"),
    [(IPPO, "observations", None), (MAPPO, "states", SHOP_STATE)],
    ids=["independent", "a state"],
)
def test_two_agents_that_need_each_other(kind, sees, state_space):
    set_seed(0)
    env = wrap_env(parallel_env(ShopSim, state_space=state_space))
    learner = learners(kind, env, sees)
    before = parallel_return(parallel_env(ShopSim), greedy(learner))
    train(env, learner, 2000)
    after = parallel_return(parallel_env(ShopSim), greedy(learner))
    env.close()
    assert after > before + 5
    assert after > 22  # of 30


def test_agents_that_are_born_and_die():
    """All of them are there all the time, as it wants them."""
    set_seed(0)
    options = {"possible_agents": FORAGERS, "state_space": "observations"}
    env = wrap_env(pad_agents(parallel_env(HerdSim, **options)))
    learner = learners(IPPO, env, "observations")
    act, evaluation = greedy(learner), parallel_env(HerdSim, possible_agents=FORAGERS)
    before = parallel_return(evaluation, act)
    train(env, learner, 1500)
    assert parallel_return(evaluation, act) > before + 5
    env.close()


def test_the_page(monkeypatch):
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


def test_single_views_and_vectors_of_them_are_wrapped():
    env = wrap_env(single_env(ReservoirSim), wrapper="gymnasium", verbose=False)
    observation, _ = env.reset()
    assert observation.shape == (1, 2)
    assert env.step(torch.tensor([[0.25]]))[1].shape == (1, 1)
    env.close()
    envs = wrap_env(vector_env(ReservoirSim, num_envs=3), wrapper="gymnasium", verbose=False)
    observations, _ = envs.reset()
    assert observations.shape == (3, 2)
    assert np.isfinite(envs.step(torch.zeros(3, 1))[1].numpy()).all()
    envs.close()
