"""Tianshou: the AEC view, with an algorithm for each agent."""

from dataclasses import replace

import numpy as np
import torch
from gymnasium import spaces
from tianshou.data import Batch
from tianshou.env import PettingZooEnv

from simenv_marl import aec_env
from simenv_marl.envs import pad_agents

from . import page
from .returns import aec_return
from .worlds import FORAGERS, HerdSim


def greedy(algorithm):
    """The policies of a multi-agent algorithm."""

    def act(agent, observation, info):
        with torch.no_grad():
            values, _ = algorithm.get_algorithm(agent).policy.model(observation[None])
        return int(values.argmax())

    return act


def test_masks_in_observations_reach_the_policy(monkeypatch):
    """It draws no masked action, not even to explore: that would be an error."""
    np.random.seed(0)
    steps = page.steps("Tianshou", monkeypatch)
    names = next(steps)
    masked = {
        "observation_space": spaces.Dict(
            observation=spaces.Box(0, 1, (2,), np.float32), action_mask=spaces.MultiBinary(5)
        ),
        "observation_space_mapping": lambda shop: {"observation": [shop.day % 7 / 7, shop.asked / 60]},
        "action_mask_mapping": lambda shop: [True, shop.day % 2 == 0, False, shop.day % 3 == 0, True],
    }
    for point, definition in names["points"].items():
        names["points"][point] = replace(definition, **masked)
    learners = [names["learner"](), names["learner"]()]
    names["algorithm"] = type(names["algorithm"])(algorithms=learners, env=names["make"]())
    next(steps)  # trains


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


def test_the_code_of_the_page_runs(monkeypatch):
    np.random.seed(0)
    steps = page.steps("Tianshou", monkeypatch)
    names = next(steps)
    env = aec_env(names["FourWeeks"], names["points"])
    before = aec_return(env, greedy(names["algorithm"]))
    names = next(steps)
    after = aec_return(env, greedy(names["algorithm"]))
    assert after > before + 3
    assert names["baker"](Batch(obs=np.array([[0, 0.5]]), info=Batch())).act[0] in spaces.Discrete(5)
