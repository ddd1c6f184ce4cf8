"""Tianshou: the AEC view, with an algorithm for each agent."""

import numpy as np
import torch
from gymnasium import spaces
from tianshou.algorithm import DQN
from tianshou.algorithm.modelfree.dqn import DiscreteQLearningPolicy
from tianshou.algorithm.multiagent.marl import MultiAgentOffPolicyAlgorithm
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Batch, Collector, VectorReplayBuffer
from tianshou.env import DummyVectorEnv, PettingZooEnv
from tianshou.trainer import OffPolicyTrainerParams
from tianshou.utils.net.common import Net

from simenv_marl import aec_env, make_step, single_env
from simenv_marl.envs import pad_agents

from . import page
from .returns import aec_return
from .worlds import FORAGERS, HerdSim, Shop, ShopSim, Workbench, WorkbenchSim


def learner(space, observed):
    net = Net(state_shape=observed, action_shape=int(space.n), hidden_sizes=[32])
    policy = DiscreteQLearningPolicy(model=net, action_space=space, eps_training=0.3)
    return DQN(
        policy=policy, optim=AdamOptimizerFactory(lr=5e-3), gamma=0.5, n_step_return_horizon=2, target_update_freq=50
    )


def collector_of(algorithm, make, number=4):
    envs = DummyVectorEnv([make] * number)
    envs.seed(1)
    return Collector(algorithm, envs, VectorReplayBuffer(1000 * number, number), exploration_noise=True)


def train(algorithm, collector, steps):
    params = OffPolicyTrainerParams(
        training_collector=collector,
        max_epochs=1,
        epoch_num_steps=steps,
        collection_step_num_env_steps=40,
        update_step_num_gradient_steps_per_sample=0.3,
        multi_agent_return_reduction=lambda returns: returns.mean(axis=1),
        verbose=False,
        show_progress=False,
    )
    algorithm.run_training(params)


def greedy(algorithm):
    """The policies of a multi-agent algorithm."""

    def act(agent, observation, info):
        with torch.no_grad():
            values, _ = algorithm.get_algorithm(agent).policy.model(observation[None])
        return int(values.argmax())

    return act


def test_masks_in_observations():
    """It draws no masked action, not even to explore: that would be an error."""
    bench = make_step(
        observation_space=spaces.Dict(
            observation=spaces.Box(0, 1, (5,), np.float32), action_mask=spaces.MultiBinary(5)
        ),
        observation_space_mapping=lambda bench: {"observation": bench.jobs},
        action_space=spaces.Discrete(5),
        action_space_mapping=lambda action: action,
        action_mask_mapping=lambda bench: [job > 0 for job in bench.jobs],
        reward_mapping=lambda bench: -bench.waiting,
        agent="joiner_0",
    )

    def make():
        return PettingZooEnv(aec_env(WorkbenchSim, {Workbench.choose_job: bench}))

    np.random.seed(0)
    algorithm = MultiAgentOffPolicyAlgorithm(algorithms=[learner(spaces.Discrete(5), 5)], env=make())
    train(algorithm, collector_of(algorithm, make), 80)


def test_one_agent():
    """The single view is a Gymnasium environment like any other."""
    np.random.seed(0)
    algorithm = learner(spaces.Discrete(4), 4)
    envs = DummyVectorEnv([lambda: single_env(ShopSim, Shop.choose_display)] * 2)
    collected = Collector(algorithm, envs).collect(n_episode=2, reset_before_collect=True)
    assert collected.lens.tolist() == [10, 10]


def test_agents_that_are_born_and_die():
    """Without padding an episode ends for it when the first of them dies."""
    days = {}
    for padded in (False, True):
        env = aec_env(HerdSim, possible_agents=FORAGERS)
        env = PettingZooEnv(pad_agents(env) if padded else env)
        days[padded] = []
        for seed in range(5):
            env.reset(seed=seed)
            over = False
            while not over:
                _, _, terminated, truncated, _ = env.step(1)
                over = terminated or truncated
            days[padded].append(env.env.simulation.herd.day)
        env.close()
    assert days[True] == [15] * 5
    assert min(days[False]) < 15


def test_training_of_agents_that_are_born_and_die():
    def make():
        return PettingZooEnv(pad_agents(aec_env(HerdSim, possible_agents=FORAGERS)))

    np.random.seed(0)
    algorithms = [learner(spaces.Discrete(2), 2) for _ in FORAGERS]
    algorithm = MultiAgentOffPolicyAlgorithm(algorithms=algorithms, env=make())
    collector = collector_of(algorithm, make)
    train(algorithm, collector, 160)
    assert set(collector.buffer.obs.agent_id[: collector.buffer.maxsize]) >= set(FORAGERS[:2])


def test_the_page(monkeypatch):
    np.random.seed(0)
    steps = page.steps("Tianshou", monkeypatch)
    names = next(steps)
    env = aec_env(names["FourWeeks"], names["points"])
    before = aec_return(env, greedy(names["algorithm"]))
    names = next(steps)
    after = aec_return(env, greedy(names["algorithm"]))
    assert after > before + 3
    assert names["baker"](Batch(obs=np.array([[0, 0.5]]), info=Batch())).act[0] in spaces.Discrete(5)
