"""Section 5 of the contract: what happens when, in the AEC and in the single view."""

import math
import weakref
from functools import partial
from itertools import repeat
from types import MethodType, SimpleNamespace

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import RULE, aec_env, joint_env, parallel_env, single_env
from simenv_marl.errors import InvalidActionError, ObservationError, RewardError
from tests.worlds.entities import Being, beings, life
from tests.worlds.models import (
    EVERY_VIEW,
    begun,
    calling,
    decision,
    decisions,
    follow_the_rule,
    play,
    script,
    step,
)
from tests.worlds.vectors import same

VIEWS = pytest.mark.parametrize("view", [aec_env, single_env])

# -- 5.3: observations ----------------------------------------------------------------------------


ROW = spaces.Box(0, 10, (4,), np.float32)
NESTED = spaces.Dict({"row": ROW, "parts": spaces.Tuple((spaces.Discrete(2), spaces.Text(5)))})


@pytest.mark.parametrize("at", range(3), ids=["first", "second", "at the end"])
@pytest.mark.parametrize(
    ("space", "value"),
    [(ROW, [1, 2, 3]), (spaces.Discrete(5), 1.5), (NESTED, {"row": [0] * 4})],
    ids=str,
)
@VIEWS
def test_env_raises_an_error_for_observations_outside_their_space(view, space, value, at):
    observed = [*[space.sample()] * at, value]
    decide = decision(observation_space=space, observation_space_mapping=lambda: observed.pop(0))
    env = view(calling(decide, decide), decide)
    with pytest.raises(ObservationError):
        follow_the_rule(env)
    assert observed == []


def fill(observation):
    """Overwrite everything that can be overwritten."""
    if isinstance(observation, dict):
        for value in observation.values():
            fill(value)
        observation.clear()
    elif isinstance(observation, tuple):
        for value in observation:
            fill(value)
    elif isinstance(observation, np.ndarray):
        observation[...] = 0


KINDS = {
    "own": (ROW, lambda array, parts: array, lambda row: row),
    "copy": (ROW, lambda array, parts: array.copy(), lambda row: row),
    "view": (ROW, lambda array, parts: array[:], lambda row: row),
    "parts": (
        NESTED,
        lambda array, parts: parts,
        lambda row: {"row": row, "parts": (np.int64(1), "abc")},
    ),
}
"""What a model may give: its own array, one that it has just made, a view, or parts of these."""


@pytest.mark.parametrize(("space", "observe", "expected"), KINDS.values(), ids=KINDS)
@VIEWS
def test_env_observations_share_no_memory_with_the_model(view, space, observe, expected):
    array = np.array([5, 6, 7, 8], np.float32)
    parts = {"row": array, "parts": [1, "abc"]}
    decide = decision(
        observation_space=space, observation_space_mapping=lambda: observe(array, parts)
    )

    def main(simulation):
        for level in (1, 2, 3):
            array[0] = level
            decide()
            # What the user did to its observation is nothing to the model.
            assert array.tolist() == [level, 6, 7, 8]
            assert len(parts) == 2
            array[0] = 9  # and what the model does now is nothing to what the user holds

    env = view(script(main), decide)
    result = env.reset()
    held, kept = [], []
    for level in (1, 2, 3):
        seen = (
            [env.last()[0], env.observe("choose_0"), env.last()[0]]
            if view is aec_env
            else [result[0]]
        )
        for observation in seen:
            assert same(observation, expected(np.float32([level, 6, 7, 8])))
            assert observation in space
            if level == 2:
                kept.append(observation)
            else:
                fill(observation)
        held += [observation for observation in seen if isinstance(observation, np.ndarray)]
        result = env.step(1)
    assert all(same(observation, expected(np.float32([2, 6, 7, 8]))) for observation in kept)
    assert not any(np.shares_memory(one, array) for one in held)
    assert not any(np.shares_memory(one, two) for one in held for two in held if one is not two)


HOLDERS = {
    "attribute": lambda array: MethodType(lambda self: self.array, SimpleNamespace(array=array)),
    "closure": lambda array: lambda: array,
    "list": lambda array: partial([array].__getitem__, 0),
    "iterator": lambda array: partial(next, repeat(array)),
}


@pytest.mark.parametrize("place", HOLDERS)
def test_env_copies_an_observed_array_that_only_the_model_refers_to(place):
    observe = HOLDERS[place](np.array([1.0, 2.0]))
    decide = decision(observation_space_mapping=observe)
    env = single_env(calling(decide, decide), decide)
    for observation in env.reset()[0], env.step(1)[0]:
        observation[:] = 0
    assert observe().tolist() == [1.0, 2.0]


def test_env_computes_observations_at_each_decision_and_at_the_end():
    program = (
        "0 health 1, 0 acts, 0 health 2, 1 health 3, 1 acts, 0 health 4, 0 acts, 2 acts, 0 health"
        " 6, 1 health 5, 2 forgotten"
    )
    env = begun(aec_env(life(program), beings()))
    seen = []
    while not any(env.terminations.values()):
        seen.append((env.agent_selection, env.last()[0].tolist(), env.observe("being_0").tolist()))
        env.step(1)
    assert seen == [
        ("being_0", [0, 1], [0, 1]),
        ("being_1", [1, 3], [0, 1]),
        ("being_0", [0, 4], [0, 4]),
        ("being_2", [2, 0], [0, 4]),
    ]
    env.observe("being_0")[:] = 0  # a copy
    ended = {
        turn.agent: (turn.observation.tolist(), turn.reward) for turn in play(env, reset=False)
    }
    assert ended == {"being_0": ([0, 6], 6.0), "being_1": ([1, 5], 5.0), "being_2": ([2, 0], 0.0)}


def test_observation_before_an_agents_first_decision_is_nearest_to_zero():
    dials = spaces.MultiDiscrete([2, 2], start=[-5, -1])
    parts = spaces.Tuple([dials, spaces.MultiBinary(2)])
    space = spaces.Dict(a=spaces.Box(1, 2, (1,)), b=spaces.Discrete(3, start=-9), c=parts)
    other = decision(agent="other_0")
    late = decision(agent="late_0", observation_space=space, observation_space_mapping=space.sample)
    env = aec_env(calling(other, late), [other, late])
    for _ in range(2):
        env.reset()
        for _ in range(2):
            observation = env.observe("late_0")
            parts = np.array([-4, 0]), np.zeros(2, np.int8)
            assert same(observation, {"a": np.float32([1]), "b": np.int64(-7), "c": parts})
            fill(observation)
        env.step(1)


# -- 5.4: rewards ---------------------------------------------------------------------------------


@EVERY_VIEW
@pytest.mark.parametrize("before", [0, 1, 2], ids=["first", "second", "at the end"])
@pytest.mark.parametrize(
    ("paid", "told"),
    [
        (2, 2.0),
        (np.float32(0.5), 0.5),
        (np.array([3]), 3.0),
        (np.bool_(True), 1.0),
        (math.nan, "not finite"),
        (np.float64("-inf"), "not finite"),
        ("1.0", "not one number"),
        (np.zeros(2), "not one number"),
        (10**400, "too large"),
    ],
)
def test_env_rewards_are_finite_python_floats(view, before, paid, told):
    rewards = iter([None, *[1.0] * before, paid, 1.0, 1.0])  # the first one is discarded
    decide = decision(agent="ant_0", reward_mapping=lambda: next(rewards))
    env = view(calling(decide, decide, decide), decide)

    def reward_of_step():
        result = env.step({"ant_0": 1} if view in (parallel_env, joint_env) else 1)
        found = env.rewards if view is aec_env else result[1]
        return found if view in (single_env, joint_env) else found["ant_0"]

    env.reset()
    assert [reward_of_step() for _ in range(before)] == [1.0] * before
    if isinstance(told, float):
        reward = reward_of_step()
        assert (reward, type(reward)) == (told, float)
    else:
        with pytest.raises(RewardError, match=told):
            reward_of_step()


# -- 5.6: the rule --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "space",
    [
        spaces.Discrete(3, start=2),
        spaces.Dict(
            {"a": spaces.Tuple((spaces.MultiBinary(3), spaces.Text(4))), "b": spaces.Box(0, np.inf)}
        ),
        spaces.OneOf((spaces.Sequence(spaces.Discrete(3)), spaces.Box(0, 1))),
    ],
    ids=str,
)
@VIEWS
def test_env_accepts_the_rule_constant_and_samples_as_actions(view, space):
    decide = decision(action_space=space, agent="a_0", action_space_mapping=lambda action: "sample")
    env = begun(view(calling(*[decide] * 6), decide), 1)
    env.step(RULE)
    for _ in range(5):
        env.step((env.action_space("a_0") if view is aec_env else env.action_space).sample())
    assert env.simulation.log == ["rule"] + ["sample"] * 5


# -- 5.6: entities --------------------------------------------------------------------------------


@pytest.mark.usefixtures("_collected")
@pytest.mark.parametrize("choices", [None, lambda being: [1, 2, 3]], ids=["no choices", "choices"])
@pytest.mark.parametrize("actions", [RULE, 0, 1])
@pytest.mark.parametrize("policy", [None, RULE, lambda *_: 1], ids=["no policy", "rule", "policy"])
def test_env_keeps_no_entity_alive_that_the_model_has_dropped(choices, actions, policy):
    def main(simulation):
        herd = [Being(number) for number in range(3)]
        watched = [weakref.ref(being) for being in herd]
        for being in herd:
            being.act()
        del being
        while herd:
            herd.pop(0)
            simulation.log.append([watch() is None for watch in watched])
            for being in herd:
                being.act()
                del being

    changes = {"choices": choices} if choices else {}
    env = aec_env(
        script(main), beings(removed_by=(), **changes), policies=policy and {"being_2": policy}
    )
    turns = play(env, actions)
    assert env.simulation.log == [
        [True, False, False],
        [True, True, False],
        [True, True, True],
    ]
    asked = [0, 1, 2, 1, 2, 2] if policy is None else [0, 1, 1]
    assert decisions(turns) == [f"being_{number}" for number in asked]
    assert sorted(turn.agent for turn in turns if turn.terminated) == [
        f"being_{n}" for n in sorted(set(asked))
    ]


# -- 5.7: actions ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("space", "legal", "illegal"),
    [
        (spaces.Discrete(3, start=5), [np.uint8(6), np.array(7)], [4, 8, 6.0, "6", None, [6], {}]),
        (
            spaces.Box(0, 1, (2,), np.float32),
            [[0, 1], np.array([0.5, 0.25], np.float16)],
            [0.5, [0.5, 1.5], [0.5, np.nan], None, "ab", [1j, 0]],
        ),
        (
            spaces.Dict({"a": spaces.Tuple([spaces.Discrete(2)])}),
            [{"a": (1,)}, {"a": (np.int8(0),)}],
            [{}, {"a": (2,)}, {"b": (0,)}, 1, None],
        ),
        (spaces.Text(3), ["abc", "b"], ["abcd", 3, None]),
    ],
    ids=str,
)
@VIEWS
def test_env_is_unchanged_after_it_refuses_an_illegal_action(view, space, legal, illegal):
    moved = []
    decide = decision(
        action_space=space,
        agent="a_0",
        action_space_mapping=lambda action: moved.append(action) or "done",
    )
    env = begun(view(calling(decide, decide), decide), 3)
    for number, right in enumerate(legal):
        for action in illegal:
            before = env.last() if view is aec_env else None
            with pytest.raises(InvalidActionError, match="a_0"):
                env.step(action)
            assert len(moved) == len(env.simulation.log) == number
            if view is aec_env:
                assert env.agent_selection == "a_0"
                after = env.last()
                assert after[1:] == before[1:]
                assert np.array_equal(after[0], before[0])
        env.step(right)
        assert np.array_equal(
            np.asarray(moved[-1]), np.asarray(right).astype(space.dtype or object)
        )
    assert env.simulation.log == ["done", "done"]


@EVERY_VIEW
def test_env_continues_after_it_has_refused_a_masked_action(view):
    ant = decision(agent="ant_0", action_mask_mapping=lambda: [1] * 9 + [0])
    env = begun(view(calling(ant, ant), ant))
    with pytest.raises(InvalidActionError, match="masked"):
        step(env, 9, "ant_0")
    step(env, 4, "ant_0")
    assert env.simulation.log == [4]
