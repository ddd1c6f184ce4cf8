"""Observations that views return are the user's own: changes of them reach nothing else."""

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import aec_env, branch, clone, joint_env, parallel_env, simulate, single_env
from simenv_marl.core.values.spaces import same
from tests.worlds.models import Timed, begun, decision, define

PAIR = spaces.Box(-1e6, 1e6, (2,), np.float64)
TREE = spaces.Dict({"pair": PAIR, "row": spaces.Sequence(PAIR)})


class Farm:
    """Two fields that are watered in turn; what grows is seen."""

    def __init__(self):
        self.fields = [Field(), Field()]

    def reset(self, seed=None):
        for field in self.fields:
            field.height = 100.0

    def run(self):
        for _ in range(4):
            for field, water in zip(self.fields, (Field.water, Field.water_more), strict=True):
                field.height += water(field)


class Field:
    height = 0.0

    def water(self):
        return 1

    def water_more(self):
        return 2


def see_pair(field):
    return np.array([field.height, 1.0])


def see_tree(field):
    return {"pair": see_pair(field), "row": (see_pair(field), see_pair(field))}


def points(tree):
    given = {"reward_mapping": lambda field: field.height}
    given["observation_space"] = TREE if tree else PAIR
    given["observation_space_mapping"] = see_tree if tree else see_pair
    return {
        f"{__name__}.Field.{name}": define(agent=agent, **given)
        for name, agent in (("water", "a"), ("water_more", "b"))
    }


def spoil(observation):
    """Change every array of an observation in place."""
    if isinstance(observation, np.ndarray):
        observation /= 100
    elif isinstance(observation, dict):
        for part in observation.values():
            spoil(part)
    else:
        for part in observation:
            spoil(part)


VIEWS = {
    "single": (lambda **options: single_env(Farm, agent="a", **options), 3),
    "parallel": (lambda **options: parallel_env(Farm, **options), {"a": 1, "b": 2}),
    "joint": (lambda **options: joint_env(Farm, **options), {"a": 1, "b": 2}),
    "aec": (lambda **options: aec_env(Farm, **options), 3),
}


def look(env, told):
    """The observation that a view returns."""
    return env.last()[0] if hasattr(env, "last") else told[0]


@pytest.mark.parametrize("view", ["single", "parallel", "joint", "aec"])
@pytest.mark.parametrize("method", ["fork", "replay"])
@pytest.mark.parametrize("tree", [False, True])
def test_observation_changed_by_the_user_affects_no_clone_and_no_state(view, method, tree):
    make, action = VIEWS[view]
    options = {"points": points(tree)}
    if not tree:
        options["state_space"] = "observations"
    one, other = make(**options), make(**options)
    for env in (one, other):
        told = env.reset(seed=1)
        if env is other:
            spoil(look(env, told))
        told = env.step(action)
        if env is other:
            spoil(look(env, told))
    if not tree:
        assert same(one.state(), other.state())
    copied = clone(other, method=method)
    seen = [look(env, env.step(action)) for env in (copied, one, other)]
    assert same(seen[0], seen[1])
    assert same(seen[2], seen[1])
    spoil(seen[0])
    if not tree:
        assert same(one.state(), copied.state())
        assert same(one.state(), other.state())
    seen = [look(env, env.step(action)) for env in (copied, one)]
    assert same(*seen)
    copied.close()


def test_planning_policy_can_change_its_observation_before_it_branches():
    def grow(env, number):
        return float(env.step(1)[0][0])

    def plan(observation, *, _environment):
        observation /= 100
        return int(min(branch(_environment, grow, 2, method="replay")) > 100)

    farm = simulate(Farm, {"a": plan}, points=points(False))
    assert [field.height for field in farm.fields] == [104.0, 108.0]


def test_observation_with_equal_values_is_a_new_object_each_time():
    class Herd:
        def reset(self, seed=None):
            self.field = Field()

        def run(self):
            self.field.water()
            self.field = None
            for _ in range(3):
                Farm.keeper.water_more()

    Farm.keeper = Field()
    env = begun(parallel_env(Herd, points(False)), 1)
    observations, *_ = env.step({"a": 1})
    for _ in range(2):
        before = observations["a"]
        expected = before.copy()
        before /= 100
        observations, *_ = env.step({"b": 1})
        assert same(observations["a"], expected)


def test_policy_that_changes_its_observation_affects_nothing_else():
    def halve(observation):
        observation /= 2
        return 1

    states = []
    for policy in (halve, lambda observation: 1):
        env = begun(
            single_env(
                Farm, points(False), agent="b", policies={"a": policy}, state_space="observations"
            ),
            1,
        )
        states.append(env.state().tolist())
    assert states[0] == states[1]


@pytest.mark.parametrize("make", [parallel_env, single_env, joint_env])
def test_elapsed_time_in_info_counts_skipped_decisions_too(make):
    masks = [[1, 1], [1, 0], [0, 1], [1, 1], [1, 1], [1, 1]]
    decide = decision(
        agent="a",
        action_space=spaces.Discrete(2),
        action_mask_mapping=lambda *, _simulation: masks[len(_simulation.log)],
    )

    def main(simulation):
        for _ in range(5):
            simulation.log.append(decide())

    env = begun(make(lambda: Timed(main), decide, skip_forced=True, discount_rate=0.1), 1)
    action = 1 if make is single_env else {"a": 1}
    info = env.step(action)[-1]
    info = info.get("a", info)
    assert info["elapsed"] == 30.0
    assert info["discount"] == pytest.approx(np.exp(-3.0))
