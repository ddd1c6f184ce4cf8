"""Planned over a poor rule, beside the optimum of a model that can be solved."""

import numpy as np
import pytest

from simenv_marl import RULE, simulate, single_env
from simenv_marl.planning import RolloutPolicy, action_values
from tests.worlds.inventory import MOST, Shop, best_values, state

VALUES = best_values()
BEST = VALUES[0, 4, 2].max()


def share(policy, seeds):
    """What a policy is worth, as a share of the optimum.

    What it loses is added up decision by decision: what the best order was worth, and what its own was. That is free of
    most of the chance that is in profits.
    """
    lost = []

    def watched(observation, info, *, _environment):
        order = policy(_environment)
        here = VALUES[state(observation)]
        lost.append(here.max() - here[order])
        return order

    for seed in seeds:
        simulate(Shop, {"buyer": watched}, points=Shop.order, seed=seed)
    return 1 - sum(lost) / len(seeds) / BEST


def test_the_optimum_is_that_of_the_model():
    def best(observation):
        return int(VALUES[state(observation)].argmax())

    profits = [simulate(Shop, {"buyer": best}, points=Shop.order, seed=seed).profit for seed in range(400)]
    assert np.mean(profits) == pytest.approx(BEST, abs=3 * np.std(profits) / 20)
    rule = np.mean([simulate(Shop, seed=seed).profit for seed in range(400)])
    assert rule / BEST == pytest.approx(share(lambda env: 1, range(40)), abs=0.03)
    assert rule / BEST < 0.75


def test_planned_over_a_poor_rule():
    planner = RolloutPolicy(futures=16, horizon=3)
    assert share(lambda env: planner.choose(env).best, [1, 2]) >= 0.95


def test_values_are_those_of_the_model():
    env = single_env(Shop, Shop.order)
    env.reset(seed=3)
    for _ in range(11):
        observation = env.step(RULE)[0]
    told = action_values(env, futures=64)
    assert told.means.tolist() == [told.means[0]] * (MOST + 1)  # an order comes too late
    assert told.means[0] == pytest.approx(VALUES[state(observation)][0], abs=4 * told.standard_errors[0])
