"""Costs of actions, beside their rewards, in all views."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from simenv_marl import (
    RULE,
    aec_env,
    difference,
    joint_env,
    parallel_env,
    single_env,
    turn_env,
    vector_env,
)
from simenv_marl.errors import DefinitionError, RewardError
from tests.extent import examples
from tests.worlds.models import calling, decision, define, play, script
from tests.worlds.random_worlds import YARD_POINTS, YARD_ROSTER, Yard, seeds, yard_designs

FORTUNES = {
    name: (lambda yard: yard.fortune) if "plan" in name else (lambda machine: machine.yard.fortune)
    for name in YARD_POINTS
}


def one_in_two(thing):
    """A mask with one legal action, or with all."""
    number = thing.planned if hasattr(thing, "planned") else thing.decided
    return [1, *[0] * 9] if number % 2 else [1] * 10


def charged(masked):
    """The points of yards, whose costs are their rewards."""
    return {
        name: replace(
            definition,
            cost_mapping=difference(FORTUNES[name]),
            action_mask_mapping=one_in_two if masked else None,
        )
        for name, definition in YARD_POINTS.items()
    }


def pairs(make, yard, points, options, seed):
    """Each reward of an episode by the rule, and the cost in its info."""
    env = make(yard, points, **options)
    if make is aec_env:
        return [(turn.reward, turn.info.get("cost", 0.0)) for turn in play(env, RULE, seed=seed)]
    found = []
    _, infos = env.reset(seed=seed)
    if make is parallel_env:
        found = [(0.0, info.get("cost", 0.0)) for info in infos.values()]
        while env.agents:
            _, rewards, *_, infos = env.step(dict.fromkeys(env.agents, RULE))
            found += [(rewards[name], infos[name].get("cost", 0.0)) for name in rewards]
        return found
    ended = env.episode.pending is None
    while not ended:
        _, reward, terminated, truncated, info = env.step(RULE)
        found.append((reward, info.get("cost", 0.0)))
        ended = terminated or truncated
    return found


@pytest.mark.parametrize("make", [aec_env, parallel_env, joint_env, turn_env])
@examples(25)
@given(design=yard_designs, seed=seeds, skip=st.booleans(), masked=st.booleans())
def test_info_costs_are_summed_over_the_same_decisions_as_rewards(make, design, seed, skip, masked):
    options = {"skip_forced": skip}
    if make is not aec_env:
        options["possible_agents"] = YARD_ROSTER
    found = pairs(make, lambda: Yard(design), charged(masked), options, seed)
    assert [cost for _, cost in found] == pytest.approx([reward for reward, _ in found])


def test_info_cost_is_that_of_the_agents_previous_action():
    costs = iter([100, 1.5, 2.5])
    point = decision(agent="ant_0", cost_mapping=lambda: next(costs))
    env = single_env(calling(point, point), [point])
    _, info = env.reset()
    assert info["cost"] == 0.0
    assert [env.step(1)[4]["cost"] for _ in range(2)] == [1.5, 2.5]


def test_info_has_no_cost_without_a_cost_mapping():
    point = decision(agent="ant_0")
    env = single_env(calling(point, point), [point])
    assert "cost" not in env.reset()[1]
    assert "cost" not in env.step(1)[4]


def test_vector_env_infos_have_an_array_of_costs():
    point = decision(agent="ant_0", cost_mapping=lambda: 2)
    env = vector_env(calling(point, point), points=[point], num_envs=3)
    env.reset(seed=1)
    assert env.step([1, 1, 1])[4]["cost"].tolist() == [2.0] * 3


def test_cost_mapping_that_returns_no_number_raises_an_error():
    costs = iter([0, "dear"])
    point = decision(agent="ant_0", cost_mapping=lambda: next(costs))
    env = single_env(calling(point, point), [point])
    env.reset()
    with pytest.raises(RewardError, match="the cost 'dear' of 'ant_0' is not one number"):
        env.step(1)


def test_make_step_refuses_a_cost_mapping_that_is_not_callable():
    with pytest.raises(DefinitionError, match="cost_mapping must be callable"):
        define(cost_mapping=1.0)


def test_last_cost_is_zero_if_the_model_has_freed_the_entity(recwarn):
    class Tree:
        pass

    @define(agent="tree_0", cost_mapping=lambda tree: 3.0)
    def grow(tree):
        return 0

    def main(simulation):
        tree = Tree()
        grow(tree)
        grow(tree)
        del tree

    env = single_env(script(main), [grow])
    env.reset()
    assert env.step(1)[4]["cost"] == 3.0
    *_, info = env.step(1)
    assert info["cost"] == 0.0
    assert any("the reward is 0.0" in str(warning.message) for warning in recwarn)
