"""Tianshou: the AEC view, with an algorithm for each agent."""

from dataclasses import replace

import numpy as np
import torch
from gymnasium import spaces
from hive import BEES, DEFINITION, Bee, HiveSim, points
from tianshou.data import Batch
from tianshou.env import PettingZooEnv

from simenv_marl import aec_env, simulate
from simenv_marl.envs import pad_agents

from . import page
from .returns import mean_return


def greedy(algorithm):
    """The policies of a multi-agent algorithm."""

    def act(agent, observation, info):
        with torch.no_grad():
            values, _ = algorithm.get_algorithm(agent).policy.model(observation[None])
        return int(values.argmax())

    return act


def test_tianshou_policy_draws_no_masked_action(monkeypatch):
    """It draws no masked action, not even to explore: that would be an error."""
    np.random.seed(0)
    steps = page.steps("Tianshou", monkeypatch)
    names = next(steps)
    masked = {
        "observation_space": spaces.Dict(
            observation=spaces.Box(0, 1, (2,), np.float32), action_mask=spaces.MultiBinary(5)
        ),
        "observation_space_mapping": lambda shop: {
            "observation": [shop.day % 7 / 7, shop.asked / 60]
        },
        "action_mask_mapping": lambda shop: [
            True,
            shop.day % 2 == 0,
            False,
            shop.day % 3 == 0,
            True,
        ],
    }
    for point, definition in names["points"].items():
        names["points"][point] = replace(definition, **masked)
    learners = [names["learner"](), names["learner"]()]
    names["algorithm"] = type(names["algorithm"])(algorithms=learners, env=names["make"]())
    next(steps)  # trains


def test_tianshou_collects_whole_episodes_with_births_if_agents_are_padded():
    """Without padding an episode ends for it when the first of them dies."""

    def days(env):
        lived = []
        for seed in range(5):
            env.reset(seed=seed)
            while not any(env.step(0)[2:4]):
                pass
            lived.append(env.env.unwrapped.simulation.hive.day)
        return lived

    hive, policies = points(DEFINITION), {Bee.choose_meadow: lambda seen: 0}
    plain = [simulate(HiveSim, policies, points=hive, seed=seed).hive.day for seed in range(5)]
    env = aec_env(HiveSim, hive, possible_agents=BEES)
    assert sum(days(PettingZooEnv(env))) < sum(plain)
    assert days(PettingZooEnv(pad_agents(env))) == plain


def test_code_of_the_tianshou_page_runs_as_printed(monkeypatch):
    np.random.seed(0)
    steps = page.steps("Tianshou", monkeypatch)
    names = next(steps)
    before = mean_return(names["FourWeeks"], names["points"], greedy(names["algorithm"]))
    names = next(steps)
    assert mean_return(names["FourWeeks"], names["points"], greedy(names["algorithm"])) > before + 3
    assert names["baker"](Batch(obs=np.array([[0, 0.5]]), info=Batch())).act[0] in spaces.Discrete(
        5
    )
