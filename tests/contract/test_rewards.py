"""What a reward may be, at each decision of an agent and at its end, in every view."""

import math

import numpy as np
import pytest

from simenv_marl import aec_env, joint_env, parallel_env, single_env
from simenv_marl.errors import RewardError
from tests.worlds.models import calling, decision

VIEWS = pytest.mark.parametrize("view", [aec_env, single_env, parallel_env, joint_env])


def paying(rewards, view):
    """An environment whose agent decides four times and is paid these; the first one is for nothing."""
    left = iter([None, *rewards])
    decide = decision(agent="ant_0", reward_mapping=lambda: next(left))
    return view(calling(*[decide] * 4), decide)


def step(env, view):
    """Take a step. Returns the reward."""
    if view is aec_env:
        env.step(1)
        return env.rewards["ant_0"]
    if view is single_env:
        return env.step(1)[1]
    return env.step({"ant_0": 1})[1] if view is joint_env else env.step({"ant_0": 1})[1]["ant_0"]


@VIEWS
def test_rewards_are_python_floats_at_every_decision_and_at_the_end(view):
    env = paying([2, np.float32(0.5), np.array([3]), np.bool_(True)], view)
    env.reset()
    rewards = [step(env, view) for _ in range(4)]
    assert rewards == [2.0, 0.5, 3.0, 1.0]
    assert {type(reward) for reward in rewards} == {float}


@VIEWS
@pytest.mark.parametrize("place", range(4))
@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        (math.nan, "not finite"),
        (-math.inf, "not finite"),
        (np.float64("inf"), "not finite"),
        ("much", "not one number"),
        (None, "not one number"),
        (np.zeros(2), "not one number"),
        (10**400, "too large"),
    ],
)
def test_what_is_no_finite_number_is_an_error_at_every_decision_and_at_the_end(view, place, wrong, why):
    env = paying([*[1.0] * place, wrong], view)
    env.reset()
    for _ in range(place):
        assert step(env, view) == 1.0
    with pytest.raises(RewardError, match=why):
        step(env, view)
