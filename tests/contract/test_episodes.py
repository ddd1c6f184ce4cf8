"""Section 5 of the contract: what happens when, in the AEC and in the single view."""

import math
import operator
import weakref
from functools import partial
from itertools import repeat
from types import MethodType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import RULE, aec_env, joint_env, parallel_env, single_env
from simenv_marl.errors import InvalidActionError, ObservationError, RewardError
from tests.worlds.counters import same
from tests.worlds.models import calling, decision, decisions, define, follow_the_rule, play, script

VIEWS = pytest.mark.parametrize("view", [aec_env, single_env])

# -- 5.2: the order of agents ---------------------------------------------------------------------


@pytest.mark.parametrize("order", ["cab", "abcccbbbaaac"])
def test_agents_are_selected_in_the_order_in_which_the_simulation_calls_them(order):
    points = {name: decision(agent=f"{name}_0") for name in "abc"}
    env = aec_env(calling(*[points[name] for name in order]), list(points.values()))
    for _ in range(2):
        turns = play(env, lambda agent, env: len(env.agents))
        assert decisions(turns) == [f"{name}_0" for name in order]
        assert sorted(turn.agent for turn in turns if turn.terminated) == ["a_0", "b_0", "c_0"]
        assert len(turns) == len(order) + 3
    assert env.agents == []


# -- 5.3: observations ----------------------------------------------------------------------------


ROW = spaces.Box(0, 10, (4,), np.float32)
NESTED = spaces.Dict({"row": ROW, "parts": spaces.Tuple((spaces.Discrete(2), spaces.Text(5)))})


@pytest.mark.parametrize(
    ("space", "value", "expected"),
    [
        (ROW, [1, 2, 3, 4.5], np.array([1, 2, 3, 4.5], np.float32)),
        (ROW, np.arange(8)[::2], np.array([0, 2, 4, 6], np.float32)),
        (spaces.Box(0, 10, (), np.float32), 3, np.array(3, np.float32)),
        (spaces.MultiBinary(3), [True, False, 1], np.array([1, 0, 1], np.int8)),
        (spaces.MultiDiscrete([3, 4]), [2, 3.0], np.array([2, 3], np.int64)),
        (spaces.Discrete(5, start=-2), -1.0, np.int64(-1)),
        (
            NESTED,
            {"parts": [1, "abc"], "row": [1, 2, 3, 4]},
            {"row": np.array([1, 2, 3, 4], np.float32), "parts": (np.int64(1), "abc")},
        ),
    ],
    ids=str,
)
def test_observations_are_cast_to_their_spaces_dtype(space, value, expected):
    decide = decision(observation_space=space, observation_space_mapping=lambda: value)
    env = aec_env(calling(decide), decide)
    env.reset()
    for observation in (single_env(calling(decide), decide).reset()[0], env.last()[0], env.observe("choose_0")):
        assert same(observation, expected)
        assert observation in space


@pytest.mark.parametrize("at", range(3), ids=["first", "second", "at the end"])
@pytest.mark.parametrize(
    ("space", "value"),
    [
        (ROW, [1, 2, 3]),
        (ROW, None),
        (ROW, [[1], [2, 3]]),
        (spaces.Box(0, 255, (2,), np.uint8), [0, -1]),
        (spaces.Discrete(5), 1.5),
        (NESTED, {"row": [0] * 4}),
        (spaces.Text(3), 3),
    ],
    ids=str,
)
@VIEWS
def test_observations_that_do_not_fit_are_errors(view, space, value, at):
    observed = [*[space.sample()] * at, value]
    decide = decision(observation_space=space, observation_space_mapping=lambda: observed.pop(0))
    env = view(calling(decide, decide), decide)
    with pytest.raises(ObservationError) as caught:
        follow_the_rule(env)
    assert isinstance(caught.value, ValueError)
    assert observed == []


def fill(observation: Any) -> None:
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
    "parts": (NESTED, lambda array, parts: parts, lambda row: {"row": row, "parts": (np.int64(1), "abc")}),
}
"""What a model may give: its own array, one that it has just made, a view, or parts of these."""
"""What a model may give: its own array, one that it has just made, a view, or parts of these."""


@pytest.mark.parametrize(("space", "observe", "expected"), KINDS.values(), ids=KINDS)
@VIEWS
def test_observations_are_never_shared_between_calls_or_with_the_model(view, space, observe, expected):
    array = np.array([5, 6, 7, 8], np.float32)
    parts = {"row": array, "parts": [1, "abc"]}
    decide = decision(observation_space=space, observation_space_mapping=lambda: observe(array, parts))

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
        seen = [env.last()[0], env.observe("choose_0"), env.last()[0]] if view is aec_env else [result[0]]
        for observation in seen:
            assert same(observation, expected(np.float32([level, 6, 7, 8])))
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
@VIEWS
def test_an_array_that_is_held_but_once_is_held(place, view):
    observe = HOLDERS[place](np.array([1.0, 2.0]))
    decide = decision(observation_space_mapping=observe)
    env = view(calling(decide, decide), decide)
    for observation in (env.reset() or env.last())[0], (env.step(1) or env.last())[0]:
        observation[:] = 0
    assert observe().tolist() == [1.0, 2.0]


def test_an_observation_is_computed_when_its_decision_arises():
    level = [0]
    a = decision(agent="a_0", observation_space_mapping=lambda: [level[0], 0])
    b = decision(agent="b_0", observation_space_mapping=lambda: [level[0], 1])

    def main(simulation):
        level[0] = 0
        for _ in range(2):
            level[0] += 1
            a()
            level[0] += 10
            b()
        level[0] += 100

    env = aec_env(script(main), [a, b])
    env.reset()
    seen = []
    while not any(env.terminations.values()):
        seen.append((env.agent_selection, env.last()[0].tolist(), env.observe("a_0")[0], env.observe("b_0")[0]))
        env.step(1)
    assert seen == [
        ("a_0", [1, 0], 1, 0),
        ("b_0", [11, 1], 1, 11),
        ("a_0", [12, 0], 12, 11),
        ("b_0", [22, 1], 12, 22),
    ]
    # At the end it is computed anew.
    env.observe("a_0")[:] = 0  # a copy
    assert env.observe("a_0").tolist() == [122, 0]
    assert env.observe("b_0").tolist() == [122, 1]


def test_at_the_end_observation_and_reward_are_computed_from_the_last_arguments():
    @define(
        observation_space_mapping=lambda entity, size: [entity["level"], size],
        reward_mapping=lambda entity, size: size,
    )
    def decide(entity, *, size):
        return 0

    entities = [{"level": 1}, {"level": 2}]

    def main(simulation):
        decide(entities[0], size=5)
        decide(entities[1], size=6)
        entities[1]["level"] = 20

    env = single_env(script(main), decide)
    assert env.reset()[0].tolist() == [1, 5]
    for expected, observed in ((6.0, [2, 6]), (6.0, [20, 6])):
        observation, reward, *_ = env.step(1)
        assert (observation.tolist(), reward) == (observed, expected)


@pytest.mark.parametrize(
    ("space", "expected"),
    [
        (spaces.Box(np.array([1, -5, -1], np.float32), np.array([3, -2, 1], np.float32)), np.float32([1, -2, 0])),
        (spaces.Discrete(3, start=-9), np.int64(-7)),
        (spaces.MultiDiscrete([2, 3]), np.array([0, 0])),
        (spaces.Dict(a=spaces.Box(1, 2, (1,)), b=spaces.MultiBinary(2)), {"a": np.float32([1]), "b": np.int8([0, 0])}),
    ],
    ids=str,
)
def test_before_its_first_decision_an_agents_observation_is_zero_clipped_into_its_space(space, expected):
    other = decision(agent="other_0")
    late = decision(agent="late_0", observation_space=space, observation_space_mapping=lambda: space.sample())
    env = aec_env(calling(other, late), [other, late])
    for _ in range(2):
        env.reset()
        observation = env.observe("late_0")
        assert same(observation, expected)
        fill(observation)
        assert same(env.observe("late_0"), expected)
        env.step(1)


# -- 5.4: rewards ---------------------------------------------------------------------------------


def test_in_aec_each_action_is_rewarded_once_and_rewards_add_up_to_those_of_last():
    balance, asked = {}, {"a_0": 0, "b_0": 0}

    def point(name):
        def pay():
            asked[name] += 1
            paid, balance[name] = balance[name], 0.0
            return paid

        return decision(agent=name, reward_mapping=pay)

    def earn(of_a, of_b):
        balance["a_0"] += of_a
        balance["b_0"] += of_b

    a, b = point("a_0"), point("b_0")

    def main(simulation):
        earn(0.5, 0.25)  # before a has done anything: discarded
        a()
        earn(1, 0.25)  # b has done nothing yet
        b()
        earn(2, 10)
        a()
        earn(4, 20)
        a()
        earn(8, 40)

    env = aec_env(script(main), [a, b])
    for number in (1, 2):
        balance.update(a_0=0.0, b_0=0.0)
        told, booked = {"a_0": [], "b_0": []}, {"a_0": 0.0, "b_0": 0.0}
        env.reset()
        for agent in env.agent_iter():
            _, reward, ended, *_ = env.last()
            assert env.last()[1] == reward
            assert type(reward) is float
            told[agent].append(reward)
            env.step(None if ended else 1)
            for name, value in env.rewards.items() if not ended else ():
                assert type(value) is float
                booked[name] += value
        assert told == {"a_0": [0.0, 3.0, 4.0, 8.0], "b_0": [0.0, 70.0]}
        assert booked == {"a_0": 15.0, "b_0": 70.0}
        assert asked == {"a_0": 4 * number, "b_0": 2 * number}


EVERY_VIEW = pytest.mark.parametrize("view", [aec_env, single_env, parallel_env, joint_env])


def paying(rewards, view):
    """An environment whose agent decides as often as it is paid these; the first one is for nothing."""
    left = iter([None, *rewards])
    decide = decision(agent="ant_0", reward_mapping=lambda: next(left))
    return view(calling(*[decide] * len(rewards)), decide)


def reward_of_step(env, view):
    if view is aec_env:
        env.step(1)
        return env.rewards["ant_0"]
    if view is parallel_env:
        return env.step({"ant_0": 1})[1]["ant_0"]
    return env.step(1 if view is single_env else {"ant_0": 1})[1]


@EVERY_VIEW
def test_rewards_are_python_floats_at_every_decision_and_at_the_end(view):
    paid = [2, np.float32(0.5), np.int8(-4), np.array(1.5), np.array([3]), np.bool_(True)]
    env = paying(paid, view)
    env.reset()
    rewards = [reward_of_step(env, view) for _ in paid]
    assert rewards == [2.0, 0.5, -4.0, 1.5, 3.0, 1.0]
    assert {type(reward) for reward in rewards} == {float}


@EVERY_VIEW
@pytest.mark.parametrize("place", [0, 1, 3])
@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        (math.nan, "not finite"),
        (-math.inf, "not finite"),
        (np.float64("inf"), "not finite"),
        ("1.0", "not one number"),
        (None, "not one number"),
        (1j, "not one number"),
        (np.zeros(2), "not one number"),
        (10**400, "too large"),
    ],
)
def test_rewards_that_are_not_finite_are_errors_at_every_decision_and_at_the_end(view, place, wrong, why):
    env = paying([1.0] * place + [wrong] + [1.0] * (3 - place), view)
    env.reset()
    for _ in range(place):
        assert reward_of_step(env, view) == 1.0
    with pytest.raises(RewardError, match=why) as caught:
        reward_of_step(env, view)
    assert isinstance(caught.value, ValueError)


# -- 5.6: the rule --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "space",
    [
        spaces.Discrete(3, start=2),
        spaces.Box(np.float32([0, -np.inf]), np.float32([np.inf, 0])),
        spaces.Dict({"a": spaces.Tuple((spaces.MultiBinary(3), spaces.Text(4))), "b": spaces.Box(0, 1)}),
        spaces.Sequence(spaces.Discrete(3)),
        spaces.OneOf((spaces.Discrete(3), spaces.Box(0, 1))),
    ],
    ids=str,
)
@VIEWS
def test_rule_and_whatever_is_sampled_are_actions(view, space):
    decide = decision(action_space=space, agent="a_0", action_space_mapping=lambda action: "sample")
    env = view(calling(*[decide] * 6), decide)
    env.reset(seed=1)
    env.step(RULE)
    for _ in range(5):
        env.step((env.action_space("a_0") if view is aec_env else env.action_space).sample())
    assert env.unwrapped.simulation.log == ["rule"] + ["sample"] * 5


# -- 5.6: entities --------------------------------------------------------------------------------


class Sheep:
    def __init__(self, number):
        self.number = number
        self.eaten = 0

    def choose(self, meadow):
        return 1

    def choose_freely(self):
        return 1


GRAZING = {
    "agent": lambda sheep, *_: f"sheep_{sheep.number}",
    "observation_space_mapping": lambda sheep, *_: [sheep.number, sheep.eaten],
    "reward_mapping": lambda sheep, *_: sheep.eaten,
}
Sheep.choose = define(**GRAZING, choices=lambda sheep, meadow: [1, 2, 3])(Sheep.choose)
Sheep.choose_freely = define(**GRAZING)(Sheep.choose_freely)


@pytest.mark.usefixtures("_collected")
@pytest.mark.parametrize("point", [Sheep.choose, Sheep.choose_freely])
@pytest.mark.parametrize("actions", [RULE, 0, 1])
@pytest.mark.parametrize("policy", [None, RULE, lambda *_: 1], ids=["no policy", "rule", "policy"])
def test_the_environment_keeps_no_entity_alive_that_the_model_has_let_go(point, actions, policy):
    arguments = (None,) if point is Sheep.choose else ()

    def main(simulation):
        herd = [Sheep(number) for number in range(3)]
        watched = [weakref.ref(sheep) for sheep in herd]
        for sheep in herd:
            sheep.eaten += point(sheep, *arguments)
        del sheep
        while herd:
            herd.pop(0)
            simulation.log.append([watch() is None for watch in watched])
            for sheep in herd:
                sheep.eaten += point(sheep, *arguments)
                del sheep

    env = aec_env(script(main), point, policies=policy and {"sheep_2": policy})
    turns = play(env, actions)
    assert env.unwrapped.simulation.log == [[True, False, False], [True, True, False], [True, True, True]]
    asked = [0, 1, 2, 1, 2, 2] if policy is None else [0, 1, 1]
    assert decisions(turns) == [f"sheep_{number}" for number in asked]
    # Nothing is known any more of those who are gone: their last observation stays, and earns nothing.
    assert sorted(turn.agent for turn in turns if turn.terminated) == [f"sheep_{n}" for n in sorted(set(asked))]


@pytest.mark.parametrize(
    ("view", "action", "gone"),
    [(single_env, RULE, [True, False]), (single_env, 0, [True, False]), (aec_env, 1, [False, True])],
)
def test_a_choice_that_the_model_lets_go_goes_at_once(view, action, gone):
    flock = []
    chase = decision(lambda: flock[0], choices=lambda: list(flock), action_space=spaces.Discrete(2))

    def main(simulation):
        flock[:] = [Sheep(0), Sheep(1)]
        watched = [weakref.ref(sheep) for sheep in flock]
        flock.remove(chase())
        simulation.log += [watch() is None for watch in watched]

    env = view(script(main), chase)
    env.reset()
    env.step(action)
    assert env.unwrapped.simulation.log == gone


def test_entities_that_live_are_rewarded_and_observed_at_the_end():
    def main(simulation):
        simulation.herd = [Sheep(number) for number in range(3)]
        for sheep in simulation.herd:
            sheep.eaten += sheep.choose_freely()
        del simulation.herd[1], sheep
        simulation.herd[0].eaten = 50

    env = aec_env(script(main), Sheep.choose_freely)
    turns = play(env, 5)
    ended = {turn.agent: (turn.observation.tolist(), turn.reward) for turn in turns if turn.terminated}
    assert ended == {"sheep_0": ([0, 50], 50.0), "sheep_1": ([1, 0], 0.0), "sheep_2": ([2, 5], 5.0)}


# -- 5.7: actions ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("space", "legal", "illegal"),
    [
        (
            spaces.Discrete(3, start=5),
            [np.uint8(6), np.array(7)],
            [4, 8, 6.0, "6", None, [6], np.array([6]), np.int64(8), {}],
        ),
        (
            spaces.Box(0, 1, (2,), np.float32),
            [[0, 1], np.array([0.5, 0.25], np.float16)],
            [0.5, [0.5], [0.5, 1.5], [0.5, -0.1], [0.5, np.nan], None, "ab", [1j, 0]],
        ),
        (
            spaces.Box(0, 1, (1,), np.float32),
            [0.5, (1,)],
            [1.5, -0.1, np.nan, np.inf, [[0.5]], [0.5, 0.5], "a", None, 2, [2]],
        ),
        (spaces.Box(0, 10, (2,), np.uint8), [[0, 10], np.array([1, 2])], [[256, 1], [-1, 1], [1.0, 1.5]]),
        (
            spaces.Box(0.1, 0.7, (5, 5), np.float32),
            [np.full((5, 5), 0.1), np.full((5, 5), 0.7).tolist()],
            [np.full((5, 5), 0.8), np.full((5, 5), np.nan), np.full(25, 0.5)],
        ),
        (spaces.MultiDiscrete([2, 3]), [[1, 2], np.array([0, 0])], [[0, 3], [0], 1, None, [-1, 0]]),
        (spaces.MultiBinary(2), [[1, 0], np.array([1, 1], np.int8)], [[0, 2], [1], 1, None]),
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
def test_illegal_actions_are_errors_and_leave_everything_where_it_stood(view, space, legal, illegal):
    moved = []
    decide = decision(
        action_space=space, agent="a_0", action_space_mapping=lambda action: moved.append(action) or "done"
    )
    env = view(calling(decide, decide), decide)
    env.reset(seed=3)
    for step, right in enumerate(legal):
        for action in illegal:
            before = env.last() if view is aec_env else None
            with pytest.raises(InvalidActionError, match="a_0") as caught:
                env.step(action)
            assert isinstance(caught.value, ValueError)
            assert len(moved) == len(env.unwrapped.simulation.log) == step
            if view is aec_env:
                assert env.agent_selection == "a_0"
                after = env.last()
                assert after[1:] == before[1:]
                assert np.array_equal(after[0], before[0])
        env.step(right)
        assert np.array_equal(np.asarray(moved[-1]), np.asarray(right).astype(space.dtype or object))
    assert env.unwrapped.simulation.log == ["done", "done"]


def test_actions_reach_the_mapping_as_unshared_arrays_of_the_spaces_dtype_and_as_python_numbers():
    def mapped(space, actions):
        decide = decision(action_space=space)
        env = single_env(calling(*[decide] * len(actions)), decide)
        env.reset()
        for action in actions:
            env.step(action)
            if isinstance(action, np.ndarray) and action.ndim:
                action[:] = 1
        return env.unwrapped.simulation.log

    for received in mapped(spaces.Box(0, 1, (2,), np.float32), [np.array([0.5, 0.25], np.float32), [0.5, 0.25]]):
        assert received.tolist() == [0.5, 0.25]
        assert received.dtype == np.float32
    assert [type(action) for action in mapped(spaces.Discrete(5), [np.int64(3), np.array(3), 3])] == [int] * 3
    # One number stands for a box of one element, as it is.
    scalars = [0.5, 1, np.float32(0.25), np.array(0.5)]
    assert all(map(operator.is_, mapped(spaces.Box(0, 1, (1,), np.float32), scalars), scalars))


def test_a_dead_agents_only_action_is_none():
    a, b = decision(agent="a_0"), decision(agent="b_0")
    env = aec_env(calling(a, b), [a, b])
    env.reset()
    env.step(1)
    env.step(1)
    for _ in range(2):
        agents = list(env.agents)
        with pytest.raises(InvalidActionError, match="has ended"):
            env.step(1)
        assert env.agents == agents
        env.step(None)
    assert env.agents == []
