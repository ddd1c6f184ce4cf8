"""Section 5 of the contract: what happens when, in the AEC and in the single view."""

import gc
import random
import weakref
from functools import partial
from itertools import repeat
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import RULE, aec_env, single_env
from simenv_marl.errors import InvalidActionError, ObservationError, RewardError
from tests.worlds.models import Script, calling, decision, decisions, define, play, rewards_of, script

# -- 5.2: the order of agents ---------------------------------------------------------------------


@pytest.mark.parametrize("order", ["a", "aaaa", "ab", "abba", "aab" * 5, "cab", "bbbb", "abcabc", "abcccbbbaaac", "c"])
def test_agents_are_selected_in_the_order_in_which_the_simulation_calls_them(order):
    points = {name: decision(agent=f"{name}_0") for name in "abc"}
    env = aec_env(calling(*[points[name] for name in order]), list(points.values()))
    for _ in range(2):
        turns = play(env, lambda agent, env: len(env.agents))
        assert decisions(turns) == [f"{name}_0" for name in order]
        assert [turn.agent for turn in turns if turn.terminated].sort() == ["a_0", "b_0", "c_0"].sort()
        assert len(turns) == len(order) + 3
    assert env.agents == []


def test_agents_that_are_named_at_the_call_join_when_they_first_decide_and_stay():
    order = "abacdda"
    decide = decision(lambda name: 0, agent=lambda name: name)
    env = aec_env(calling(*[lambda name=name: decide(name) for name in order]), decide)
    env.reset()
    joined = []
    for name in order:
        joined += [name] if name not in joined else []
        assert env.agents == joined
        assert env.agent_selection == name
        books = (env.rewards, env.terminations, env.truncations, env.infos)
        assert all(set(book) == set(joined) for book in books)
        env.step(1)
    assert sorted(env.agents) == sorted(joined)
    assert all(env.terminations.values())
    gone = []
    for agent in env.agent_iter():
        gone.append(agent)
        assert env.last()[2:4] == (True, False)
        env.step(None)
        assert agent not in env.agents
        books = (env.rewards, env.terminations, env.truncations, env.infos)
        assert all(set(book) == set(env.agents) for book in books)
    assert sorted(gone) == sorted(joined)
    env.reset()
    assert env.agents == ["a"]


def test_declared_agents_stand_in_agents_from_reset_on():
    a, b = decision(agent="a_0"), decision(agent="b_0")
    env = aec_env(calling(a, a), [b, a])
    env.reset()
    assert env.agents == env.possible_agents == ["b_0", "a_0"]
    assert env.agents is not env.possible_agents
    assert env.num_agents == env.max_num_agents == 2
    play(env)
    assert env.possible_agents == ["b_0", "a_0"]


def test_num_cycles_of_agent_iter_may_be_limited():
    a = decision(agent="a_0")
    env = aec_env(calling(*[a] * 5), a)
    env.reset()
    for _ in env.agent_iter(max_iter=2):
        env.step(1)
    assert env.unwrapped.simulation.log == [1, 1]


# -- 5.3: observations ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("space", "value", "expected"),
    [
        (spaces.Box(0, 10, (2,), np.float32), [1, 2], np.array([1, 2], np.float32)),
        (spaces.Box(0, 10, (2,), np.float32), (1.5, np.float64(2)), np.array([1.5, 2], np.float32)),
        (spaces.Box(0, 10, (2,), np.float32), np.array([1, 2]), np.array([1, 2], np.float32)),
        (spaces.Box(0, 10, (2,), np.float64), np.array([1, 2], np.float32), np.array([1, 2], np.float64)),
        (spaces.Box(0, 255, (2, 2), np.uint8), [[1, 2], [3, 4.0]], np.array([[1, 2], [3, 4]], np.uint8)),
        (spaces.Box(0, 10, (), np.float32), 3, np.array(3, np.float32)),
        (spaces.Box(0, 10, (1,), np.float32), [3], np.array([3], np.float32)),
        (spaces.Box(0, 10, (4,), np.float32), np.arange(8)[::2], np.array([0, 2, 4, 6], np.float32)),
        (spaces.MultiBinary(3), [True, False, 1], np.array([1, 0, 1], np.int8)),
        (spaces.MultiDiscrete([3, 4]), [2, 3.0], np.array([2, 3], np.int64)),
        (spaces.Discrete(5), 3, np.int64(3)),
        (spaces.Discrete(5), True, np.int64(1)),
        (spaces.Discrete(5), 4.0, np.int64(4)),
        (spaces.Discrete(5), np.uint8(2), np.int64(2)),
        (spaces.Discrete(5), np.array(2), np.int64(2)),
        (spaces.Discrete(5, start=-2), -1, np.int64(-1)),
    ],
    ids=str,
)
def test_observations_are_cast_to_their_spaces_dtype(space, value, expected):
    decide = decision(observation_space=space, observation_space_mapping=lambda: value)
    observations = [single_env(calling(decide), decide).reset()[0]]
    env = aec_env(calling(decide), decide)
    env.reset()
    observations += [env.last()[0], env.observe("choose_0")]
    for observation in observations:
        assert type(observation) is type(expected)
        assert observation.dtype == expected.dtype
        assert observation.shape == expected.shape
        assert np.array_equal(observation, expected)
        assert observation in space


def test_observations_of_composed_spaces():
    space = spaces.Dict(
        {
            "level": spaces.Box(0, 10, (2,), np.float32),
            "kind": spaces.Discrete(3),
            "parts": spaces.Tuple((spaces.Discrete(2), spaces.Box(0, 1, (1,), np.float32))),
            "name": spaces.Text(5),
        }
    )
    value = {"name": "abc", "kind": 2, "level": [1, 2], "parts": [1, [0.5]]}
    decide = decision(observation_space=space, observation_space_mapping=lambda: value)
    env = aec_env(calling(decide), decide)
    env.reset()
    observation = env.last()[0]
    assert observation in space
    assert observation["level"].tolist() == [1, 2]
    assert type(observation["kind"]) is np.int64
    assert observation["parts"][1].tolist() == [0.5]
    assert observation["name"] == "abc"


BOX2 = spaces.Box(0, 1, (2,), np.float32)


@pytest.mark.parametrize(
    ("space", "value"),
    [
        (BOX2, [1, 2, 3]),
        (BOX2, 1.0),
        (BOX2, [[1, 2]]),
        (BOX2, None),
        (BOX2, "ab"),
        (BOX2, ["a", "b"]),
        (BOX2, [1j, 2j]),
        (BOX2, [[1], [2, 3]]),
        (BOX2, {"a": 1, "b": 2}),
        (spaces.Box(0, 255, (1,), np.uint8), [np.nan]),
        (spaces.Box(0, 255, (2,), np.uint8), [0, -1]),
        (spaces.Box(0, 255, (2,), np.uint8), np.array([256, 0])),
        (spaces.Box(0, 255, (1,), np.uint8), [1e9]),
        (spaces.Box(-9, 9, (1,), np.int8), [200.5]),
        (spaces.Discrete(5), 1.5),
        (spaces.Discrete(5), "1"),
        (spaces.Discrete(5), None),
        (spaces.Discrete(5), [1, 2]),
        (spaces.Discrete(5), [3]),
        (spaces.Discrete(5), np.array([3])),
        (spaces.Dict({"a": BOX2}), {"b": [0, 0]}),
        (spaces.Dict({"a": BOX2}), {"a": [0, 0], "b": [0, 0]}),
        (spaces.Dict({"a": BOX2}), {"a": [0]}),
        (spaces.Dict({"a": BOX2}), [0, 0]),
        (spaces.Tuple((BOX2, BOX2)), ([0, 0],)),
        (spaces.Text(3), 3),
    ],
    ids=str,
)
def test_observations_that_do_not_fit_are_errors(space, value):
    decide = decision(observation_space=space, observation_space_mapping=lambda: value)
    for make in (aec_env, single_env):
        env = make(calling(decide), decide)
        with pytest.raises(ObservationError) as caught:
            env.reset()
        assert isinstance(caught.value, ValueError)


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


class Mutable:
    """A model whose observation is its own array, one that it has just made, a view, or parts of these."""

    def __init__(self, kind):
        self.kind = kind
        self.array = np.array([5, 6, 7, 8], np.float32)
        self.parts = {"a": self.array, "b": (self.array, 3)}
        self.listed = [self.array, 3]

    def observe(self):
        array = self.array
        return {
            "own": lambda: array,
            "copy": lambda: array.copy(),
            "computed": lambda: array + 0,
            "view": lambda: array[:],
            "reversed": lambda: array[::-1][::-1],
            "cast": lambda: array.astype(np.float64),
            "fromlist": lambda: array.tolist(),
            "dict": lambda: self.parts,
            "list": lambda: self.listed,
        }[self.kind]()


SPACES = {
    "dict": spaces.Dict(
        {
            "a": spaces.Box(0, 10, (4,), np.float32),
            "b": spaces.Tuple((spaces.Box(0, 10, (4,), np.float32), spaces.Discrete(9))),
        }
    ),
    "list": spaces.Tuple((spaces.Box(0, 10, (4,), np.float32), spaces.Discrete(9))),
}


def expected_observation(observation, level):
    if isinstance(observation, dict):
        return set(observation) == {"a", "b"} and all(expected_observation(o, level) for o in observation.values())
    if isinstance(observation, tuple):
        return expected_observation(observation[0], level) and observation[1] == 3
    return observation.tolist() == [level, 6, 7, 8]


@pytest.mark.parametrize("kind", ["own", "copy", "computed", "view", "reversed", "cast", "fromlist", "dict", "list"])
@pytest.mark.parametrize("make", [aec_env, single_env])
def test_observations_are_never_shared_between_calls_or_with_the_model(kind, make):
    model = Mutable(kind)
    decide = decision(
        observation_space=SPACES.get(kind, spaces.Box(0, 10, (4,), np.float32)),
        observation_space_mapping=lambda: model.observe(),
    )
    held = []

    def main(simulation):
        for level in (1, 2, 3):
            model.array[0] = level
            decide()
            # What the user did to its observation is nothing to the model.
            assert model.array.tolist() == [level, 6, 7, 8]
            assert len(model.parts) == 2
            model.array[0] = 9  # and what the model does now is nothing to what the user holds

    env = make(script(main), decide)
    first = env.reset()
    for level in (1, 2, 3):
        seen = [env.last()[0], env.observe("choose_0"), env.last()[0]] if make is aec_env else [first[0]]
        for observation in seen:
            assert expected_observation(observation, level)
            held.append(observation)
            if level != 2:
                fill(observation)
        first = env.step(1)
    kept = held[len(held) // 3 : 2 * len(held) // 3]
    assert all(expected_observation(observation, 2) for observation in kept)
    arrays = [observation for observation in held if isinstance(observation, np.ndarray)]
    assert not any(np.shares_memory(one, model.array) for one in arrays)
    assert not any(np.shares_memory(one, two) for one in arrays for two in arrays if one is not two)


class Holder:
    """Holds an array once, in one of the places in which things are held."""

    def __init__(self, place):
        array = np.array([1.0, 2.0])
        if place == "attribute":
            self.array = array
            self.observe = lambda: self.array
        elif place == "list":
            listed = [array]
            self.observe = lambda: listed[0]
        elif place == "closure":
            self.observe = lambda: array
        elif place == "default":
            self.observe = partial(self._given, array)
        elif place == "dict":
            held = {"array": array}
            self.observe = partial(held.get, "array")
        elif place == "iterator":
            self.observe = partial(next, repeat(array))

    @staticmethod
    def _given(array):
        return array


@pytest.mark.parametrize("place", ["attribute", "list", "closure", "default", "dict", "iterator"])
def test_an_array_that_is_held_but_once_is_held(place):
    observe = Holder(place).observe
    decide = decision(observation_space_mapping=observe)
    for env in (single_env(calling(decide, decide), decide), aec_env(calling(decide, decide), decide)):
        for observation in (env.reset() or env.last())[0], (env.step(1) or env.last())[0]:
            observation[:] = 0
        assert observe().tolist() == [1.0, 2.0]


@pytest.mark.parametrize("make", [aec_env, single_env])
def test_infos_are_never_shared_between_steps(make):
    decide = decision(action_mask_mapping=lambda: MASK)
    env = make(calling(*[decide] * 3), decide)
    first = env.reset()
    infos = [env.last()[4] if make is aec_env else first[1]]
    for _ in range(2):
        result = env.step(1)
        infos.append(env.last()[4] if make is aec_env else result[4])
    assert len({id(info) for info in infos}) == 3
    for info in infos:
        info["action_mask"][:] = 0
        info.clear()
    assert MASK.tolist() == [1] * 10


MASK = np.ones(10, np.int8)


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
    assert env.observe("a_0").tolist() == [122, 0]
    assert env.observe("b_0").tolist() == [122, 1]


def test_at_the_end_observation_and_reward_are_computed_from_the_last_arguments():
    def decide(entity, *, size):
        return 0

    decide = define(
        observation_space_mapping=lambda entity, size: [entity["level"], size],
        reward_mapping=lambda entity, size: size,
    )(decide)
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
        (spaces.Box(-1, 1, (2,), np.float32), [0, 0]),
        (spaces.Box(np.array([1, -5], np.float32), np.array([3, -2], np.float32)), [1, -2]),
        (spaces.Box(-np.inf, np.inf, (1,), np.float64), [0]),
        (spaces.Box(3, 200, (2,), np.uint8), [3, 3]),
        (spaces.Discrete(3), 0),
        (spaces.Discrete(3, start=5), 5),
        (spaces.Discrete(3, start=-9), -7),
        (spaces.MultiBinary(2), [0, 0]),
        (spaces.MultiDiscrete([2, 3]), [0, 0]),
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
        assert observation.tolist() == expected
        assert observation in space
        assert observation.dtype == space.dtype
        assert env.observe("late_0") is not observation or np.isscalar(observation)
        env.step(1)


def test_before_its_first_decision_composed_and_strange_observations_are_in_their_space():
    space = spaces.Dict(
        {"a": spaces.Box(1, 2, (1,)), "b": spaces.Tuple((spaces.Discrete(2, start=1),)), "c": spaces.Text(3)}
    )
    other, late = decision(agent="other_0"), decision(agent="late_0", observation_space=space)
    env = aec_env(calling(other), [other, late])
    env.reset()
    assert env.observe("late_0") in space


class Foreseeing(Script):
    """Knows which calls are to come."""

    def __init__(self, main, expected):
        super().__init__(main)
        self.expected = expected

    def expected_calls(self, point):
        return self.expected.get(point.rpartition(".")[2], [])


def test_before_its_first_decision_an_agents_observation_comes_from_expected_calls():
    level = [7]

    def early(room):
        return 0

    def late(room):
        return 0

    observe = {"observation_space_mapping": lambda room: [level[0], room]}
    early, late = define(agent="early_0", **observe)(early), define(agent="late_0", **observe)(late)

    def main(simulation):
        early(1)
        level[0] += 1
        late(2)

    env = aec_env(lambda: Foreseeing(main, {"early": [(1,)], "late": [(4,)]}), [early, late])
    for _ in range(2):
        level[0] = 7
        env.reset()
        observation = env.observe("late_0")
        assert observation.tolist() == [7, 4]
        fill(observation)
        assert env.observe("late_0").tolist() == [7, 4]
        assert env.observe("early_0").tolist() == [7, 1]
        env.step(1)
        assert env.last()[0].tolist() == [8, 2]
        env.step(1)


def test_agents_that_are_announced_are_rewarded_from_their_own_first_action_on():
    class Ant:
        def __init__(self, name):
            self.name = name

        @define(
            agent=lambda self: self.name,
            reward_mapping=lambda self: len(log),
            observation_space_mapping=lambda self: [len(log), ord(self.name[0])],
        )
        def dig(self):
            return 0

    log = []
    ants = [Ant("a"), Ant("b")]

    def main(simulation):
        log.clear()
        for ant in (ants[0], ants[0], ants[1], ants[1]):
            log.append(ant.dig())

    env = aec_env(lambda: Foreseeing(main, {"dig": [(ant,) for ant in ants]}), Ant.dig)
    env.reset()
    assert env.observe("b").tolist() == [0, ord("b")]
    turns = play(env, 1)
    assert decisions(turns) == ["a", "a", "b", "b"]
    assert [(turn.agent, turn.reward) for turn in turns[:4]] == [("a", 0.0), ("a", 1.0), ("b", 0.0), ("b", 3.0)]
    assert {turn.agent: turn.reward for turn in turns[4:]} == {"a": 4.0, "b": 4.0}


# -- 5.4: rewards ---------------------------------------------------------------------------------


class Ledger:
    """Counts how often its rewards are asked for; pays its balance when it is."""

    def __init__(self):
        self.balance = {"a": 0.0, "b": 0.0}
        self.asked = {"a": 0, "b": 0}

    def point(self, name):
        def pay():
            self.asked[name] += 1
            paid, self.balance[name] = self.balance[name], 0.0
            return paid

        return decision(agent=f"{name}_0", reward_mapping=pay)


def test_in_aec_each_action_is_rewarded_once():
    ledger = Ledger()
    a, b = ledger.point("a"), ledger.point("b")

    def earn(a_earns, b_earns):
        ledger.balance["a"] += a_earns
        ledger.balance["b"] += b_earns

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
        ledger.balance = {"a": 0.0, "b": 0.0}
        turns = play(env, 1)
        assert decisions(turns) == ["a_0", "b_0", "a_0", "a_0"]
        assert rewards_of(turns, "a_0") == [3.0, 4.0, 8.0]
        assert rewards_of(turns, "b_0") == [70.0]
        assert [turn.reward for turn in turns[:2]] == [0.0, 0.0]
        assert ledger.asked == {"a": 4 * number, "b": 2 * number}
        assert all(type(turn.reward) is float for turn in turns)


def test_the_book_of_rewards_adds_up_to_what_last_tells():
    ledger = Ledger()
    a, b = ledger.point("a"), ledger.point("b")

    def main(simulation):
        for number in range(6):
            (a if number % 3 else b)()
            ledger.balance["a"] += 2.0**number
            ledger.balance["b"] += 100 * 2.0**number

    env = aec_env(script(main), [a, b])
    env.reset()
    told, booked = {"a_0": 0.0, "b_0": 0.0}, {"a_0": 0.0, "b_0": 0.0}
    for agent in env.agent_iter():
        _, reward, terminated, *_ = env.last()
        assert env.last()[1] == reward
        told[agent] += reward
        dying = env.terminations[agent]
        env.step(None if terminated else 1)
        if not dying:
            for name, value in env.rewards.items():
                assert type(value) is float
                booked[name] += value
    assert told == booked
    assert told["a_0"] == sum(2.0**n for n in range(1, 6))
    assert told["b_0"] == sum(100 * 2.0**n for n in range(6))


def test_in_the_single_view_a_steps_reward_is_that_of_its_action():
    ledger = Ledger()
    a = ledger.point("a")

    def main(simulation):
        ledger.balance["a"] = 1000
        for _ in range(3):
            earned = a()
            ledger.balance["a"] += earned

    env = single_env(script(main), a)
    for number in (1, 2):
        env.reset()
        assert [env.step(action)[1] for action in (5, 6, 7)] == [5.0, 6.0, 7.0]
        assert ledger.asked["a"] == 4 * number


@pytest.mark.parametrize("expected", [{}, {"idle": [(7,)]}], ids=["unknown", "announced"])
def test_agents_that_never_act_are_never_rewarded(expected):
    asked, level = [], [0]

    def idle(room):
        return 0

    a = decision(lambda: level.__setitem__(0, level[0] + 1), agent="a_0")
    b = define(
        agent="b_0",
        observation_space_mapping=lambda room: [room, level[0]],
        reward_mapping=lambda room: asked.append(1) or 1.0,
    )(idle)
    env = aec_env(lambda: Foreseeing(lambda simulation: [a(), a()], expected), [a, b])
    turns = [turn for turn in play(env) if turn.agent == "b_0"]
    assert [(turn.reward, turn.terminated) for turn in turns] == [(0.0, True)]
    # At the end it is observed anew on the call that was to come.
    assert turns[0].observation.tolist() == ([7, 2] if expected else [0, 0])
    assert not asked


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (1, 1.0),
        (True, 1.0),
        (np.float32(0.5), 0.5),
        (np.float64(0.1), 0.1),
        (np.int64(3), 3.0),
        (np.array(2.5), 2.5),
        (np.array([2.5]), 2.5),
        (-0.0, 0.0),
    ],
    ids=repr,
)
def test_rewards_are_python_floats(value, expected):
    decide = decision(reward_mapping=lambda: value, agent="a_0")
    env = single_env(calling(decide), decide)
    env.reset()
    reward = env.step(1)[1]
    assert type(reward) is float
    assert reward == expected
    turns = play(aec_env(calling(decide), decide))
    assert [type(turn.reward) for turn in turns] == [float, float]
    assert turns[-1].reward == expected


@pytest.mark.parametrize(
    "value",
    [None, "much", "1.0", [1, 2], np.array([1.0, 2.0]), 1j, np.nan, np.inf, -np.inf, {}, 10**400],
    ids=lambda value: str(value)[:9],
)
def test_rewards_that_are_no_finite_number_are_errors(value):
    decide = decision(reward_mapping=lambda: value, agent="a_0")
    for env in (aec_env(calling(decide), decide), single_env(calling(decide), decide)):
        env.reset()
        with pytest.raises(RewardError) as caught:
            env.step(1)
        assert isinstance(caught.value, ValueError)


class Paid:
    """Is paid what it has, at each of its decisions; a method, as most decisions are."""

    value: Any = 0.0
    observed: Any = (0.0, 0.0)

    @define(
        agent="paid_0",
        reward_mapping=lambda self: self.value,
        observation_space_mapping=lambda self: self.observed,
    )
    def choose(self):
        return "rule"


def paid(values, attribute="value"):
    def main(simulation):
        being = Paid()
        for value in values:
            being.choose()
            setattr(being, attribute, value)

    return script(main)


VALUES = [2, np.float32(0.5), True, np.array([2.5]), np.array(1.5), -3.25, np.int8(4)]


def test_rewards_of_methods_are_python_floats_at_every_step():
    env = single_env(paid(VALUES), Paid.choose)
    env.reset()
    rewards = [env.step(1)[1] for _ in VALUES]
    assert rewards == [2.0, 0.5, 1.0, 2.5, 1.5, -3.25, 4.0]
    assert {type(reward) for reward in rewards} == {float}
    turns = play(aec_env(paid(VALUES), Paid.choose), 1)
    assert rewards_of(turns, "paid_0") == rewards
    assert {type(turn.reward) for turn in turns} == {float}


@pytest.mark.parametrize("value", [None, "1.0", np.nan, np.inf, [1.0, 2.0]], ids=str)
@pytest.mark.parametrize("number", [1, 2, 3])
def test_rewards_of_methods_that_are_no_finite_number_are_errors_at_every_step(value, number):
    values = [1.0] * 3
    values[number - 1] = value
    for make in (aec_env, single_env):
        env = make(paid(values), Paid.choose)
        env.reset()
        for _ in range(number - 1):
            env.step(1)
        with pytest.raises(RewardError):
            env.step(1)


@pytest.mark.parametrize("value", [None, "1.0", [1.0], [[1.0, 2.0]]], ids=str)
@pytest.mark.parametrize("number", [1, 2, 3])
def test_observations_of_methods_that_do_not_fit_are_errors_at_every_step(value, number):
    values = [[1.0, 2.0]] * 3
    values[number - 1] = value
    for make in (aec_env, single_env):
        env = make(paid(values, "observed"), Paid.choose)
        env.reset()
        for _ in range(number - 1):
            env.step(1)
        with pytest.raises(ObservationError, match="its space Box"):
            env.step(1)


def test_the_first_reward_of_an_episode_is_discarded_whatever_it_is():
    values = iter([None, 1.0, "nothing yet", 2.0])
    decide = decision(reward_mapping=lambda: next(values))
    env = single_env(calling(decide), decide)
    for expected in (1.0, 2.0):
        env.reset()
        assert env.step(1)[1] == expected


# -- 5.6: the rule --------------------------------------------------------------------------------


class Walk:
    """Random in all the ways in which models are."""

    def __init__(self, seed):
        self.random, self.numpy, self.place, self.trace = random.Random(seed), np.random.default_rng(seed), 0.0, []

    @define(
        observation_space_mapping=lambda self, *args, **kwargs: [self.place, len(self.trace)],
        reward_mapping=lambda self, *args, **kwargs: self.place,
        action_space=spaces.Box(-1, 1),
    )
    def stride(self, most, *, least=0.0):
        return least + self.random.random() * (most - least) + float(self.numpy.normal())

    @define(observation_space_mapping=lambda self: [self.place, 0])
    def turns(self):
        return self.random.random() < 0.5 and self.stride(0.1) > 0

    def walk(self):
        for _ in range(20):
            self.place += -self.stride(1.0, least=0.1) if self.turns() else self.stride(2.0)
            self.trace.append(self.place)
        return self.trace


class Walking(Script):
    def __init__(self):
        super().__init__(lambda simulation: simulation.log.extend(Walk(simulation.seed).walk()))


@pytest.mark.parametrize(
    "points", [[Walk.stride, Walk.turns], [Walk.stride], [Walk.turns]], ids=["both", "one", "other"]
)
@pytest.mark.parametrize("seed", range(5))
def test_with_rule_throughout_a_run_is_the_plain_one_bit_for_bit(points, seed):
    env = aec_env(Walking, points)
    for _ in range(2):
        turns = play(env, RULE, seed=seed)
        assert len(turns) > 20
        assert env.unwrapped.simulation.log == Walk(seed).walk()


@pytest.mark.filterwarnings("ignore:Script draws from the global generator")
@pytest.mark.parametrize("seed", range(3))
def test_with_rule_throughout_a_run_of_global_generators_is_the_plain_one(seed):
    decide = decision(lambda: random.random() + np.random.random(), agent="a_0")

    def main(simulation):
        for _ in range(10):
            simulation.log.append(decide() + random.random())

    def seeded():
        random.seed(seed)
        np.random.seed(seed)

    plain, env = Script(main), single_env(script(main), decide)
    plain.reset()
    seeded()
    plain.run()
    seeded()
    env.reset(seed=1)
    while not env.step(RULE)[2]:
        pass
    assert env.unwrapped.simulation.log == plain.log


@pytest.mark.parametrize("space", [spaces.Discrete(2), spaces.Box(0, 1, (3,)), spaces.MultiBinary(2), spaces.Text(3)])
def test_rule_is_an_action_whatever_the_space(space):
    decide = decision(action_space=space)
    for env in (aec_env(calling(decide), decide), single_env(calling(decide), decide)):
        env.reset()
        env.step(RULE)
        assert env.unwrapped.simulation.log == ["rule"]


def test_rule_is_rewarded_and_observed_like_an_action():
    level = [0]

    def rule():
        level[0] += 1
        return level[0]

    decide = decision(rule, reward_mapping=lambda: level[0], observation_space_mapping=lambda: [level[0], 0])
    env = single_env(calling(decide, decide), decide)
    env.reset()
    observation, reward, terminated, *_ = env.step(RULE)
    assert (observation.tolist(), reward, terminated) == ([1.0, 0.0], 1.0, False)
    observation, reward, terminated, *_ = env.step(5)
    assert (observation.tolist(), reward, terminated) == ([1.0, 0.0], 1.0, True)


# -- 5.6: entities --------------------------------------------------------------------------------


class Sheep:
    def __init__(self, number):
        self.number = number
        self.eaten = 0

    def choose(self, meadow):
        return 1

    def choose_freely(self):
        return 1


Sheep.choose = define(
    agent=lambda self, meadow: f"sheep_{self.number}",
    observation_space_mapping=lambda self, meadow: [self.number, self.eaten],
    reward_mapping=lambda self, meadow: self.eaten,
    choices=lambda self, meadow: [1, 2, 3],
)(Sheep.choose)
Sheep.choose_freely = define(
    agent=lambda self: f"sheep_{self.number}",
    observation_space_mapping=lambda self: [self.number, self.eaten],
    reward_mapping=lambda self: self.eaten,
)(Sheep.choose_freely)


@pytest.mark.parametrize("point", [Sheep.choose, Sheep.choose_freely])
@pytest.mark.parametrize("actions", [RULE, 0, 1])
def test_the_environment_keeps_no_entity_alive_that_the_model_has_let_go(point, actions):
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

    gc.collect()
    gc.disable()
    try:
        env = aec_env(script(main), point)
        turns = play(env, actions)
    finally:
        gc.enable()
    gone = env.unwrapped.simulation.log
    assert gone == [[True, False, False], [True, True, False], [True, True, True]]
    assert decisions(turns) == [f"sheep_{number}" for number in (0, 1, 2, 1, 2, 2)]
    # Nothing is known any more of those who are gone: their last observation stays, and earns nothing.
    assert sorted(turn.agent for turn in turns if turn.terminated) == ["sheep_0", "sheep_1", "sheep_2"]


class Grass:
    pass


class Goat:
    def __init__(self):
        self.meadow = [Grass(), Grass()]

    def browse(self):
        return self.meadow[0]


def browsing(agent):
    return {Goat.browse: define(agent=agent, action_space=spaces.Discrete(2), choices=lambda goat: list(goat.meadow))}


def test_the_environment_keeps_no_choice_alive_that_the_model_has_let_go():
    def main(simulation):
        goat = Goat()
        watched = [weakref.ref(grass) for grass in goat.meadow]
        goat.meadow.remove(goat.browse())
        other()
        simulation.log.append([watch() is None for watch in watched])
        other()

    other = decision(agent="other_0")
    env = aec_env(script(main), browsing(lambda goat: "goat_0") | {other: define(agent="other_0")})
    env.reset()
    env.step(1)
    env.step(0)
    assert env.unwrapped.simulation.log == [[False, True]]


def test_a_choice_that_the_model_lets_go_at_once_goes_at_once():
    def main(simulation):
        goat = Goat()
        watched = [weakref.ref(grass) for grass in goat.meadow]
        goat.meadow.remove(goat.browse())
        simulation.log.append([watch() is None for watch in watched])

    for action, gone in ((RULE, [True, False]), (0, [True, False]), (1, [False, True])):
        env = single_env(script(main), browsing("goat_0"))
        env.reset()
        env.step(action)
        assert env.unwrapped.simulation.log == [gone]


@pytest.mark.parametrize("policy", [None, RULE, lambda observation: 1], ids=["nobody", "rule", "policy"])
@pytest.mark.parametrize("actions", [RULE, 1])
def test_nor_any_entity_that_is_no_agent_or_a_policys(policy, actions):
    class Lamb:
        def __init__(self, number):
            self.number = number

        @define(agent=lambda self: None if policy is None and self.number == 2 else f"lamb_{self.number}")
        def choose(self):
            return 1

    def main(simulation):
        lambs = [Lamb(1), Lamb(2), Lamb(1)]
        watched = [weakref.ref(lamb) for lamb in lambs]
        while lambs:
            lambs.pop(0).choose()
            simulation.log.append([watch() is None for watch in watched])

    gc.collect()
    gc.disable()
    try:
        env = aec_env(script(main), Lamb.choose, policies=policy and {"lamb_2": policy})
        turns = play(env, actions)
    finally:
        gc.enable()
    assert decisions(turns) == ["lamb_1", "lamb_1"]
    assert env.unwrapped.simulation.log == [[True, False, False], [True, True, False], [True, True, True]]


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


def test_weak_sets_of_a_model_behave_as_in_the_plain_run():
    class Cell:
        def __init__(self, number, cells):
            self.number = number
            cells.add(self)

        @define(agent=lambda self: f"cell_{self.number}")
        def age(self):
            return 1

    def main(simulation):
        cells: Any = weakref.WeakSet()
        held = [Cell(number, cells) for number in range(5)]
        for _ in range(6):
            for cell in sorted(cells, key=lambda cell: cell.number):
                simulation.log.append((cell.number, cell.age()))
            cell = None
            if held:
                held.pop(0)
            simulation.log.append(sorted(cell.number for cell in cells))

    plain, env = Script(main), aec_env(script(main), Cell.age)
    plain.reset()
    gc.collect()
    gc.disable()
    try:
        plain.run()
        play(env, RULE)
    finally:
        gc.enable()
    assert env.unwrapped.simulation.log == plain.log


def test_entities_that_cannot_be_held_weakly_are_entities_too():
    decide = decision(lambda name: 0, agent=lambda name: f"{name}_0", reward_mapping=lambda name: len(name))
    env = aec_env(calling(lambda: decide("ab"), lambda: decide("abc")), decide)
    turns = play(env, 1)
    assert {turn.agent: turn.reward for turn in turns if turn.terminated} == {"ab_0": 2.0, "abc_0": 3.0}


# -- 5.7: actions ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("space", "illegal"),
    [
        (spaces.Discrete(3), [-1, 3, 1.0, 0.5, "1", None, [1], (1,), np.array([1]), np.float64(1), np.int64(3), {}]),
        (spaces.Discrete(3, start=5), [0, 4, 8, np.int8(1), np.array(4)]),
        (
            spaces.Box(0, 1, (2,), np.float32),
            [0.5, [0.5], [0.5, 1.5], [0.5, -0.1], [0.5, np.nan], [[0.5, 0.5]], None, "ab", [None, 1], [1j, 0], {}, 1],
        ),
        (spaces.Box(0, 1, (1,), np.float32), [1.5, -0.1, np.nan, np.inf, [[0.5]], [0.5, 0.5], "a", None, 2, [2]]),
        (spaces.Box(0, 10, (1,), np.int32), [0.5, 11, -1, [1.5], None]),
        (spaces.Box(0, 10, (2,), np.uint8), [[256, 1], [-1, 1], [1.0, 1.5]]),
        (spaces.Box(-1, 1, (5, 5), np.float32), [np.full((5, 5), 1.5), np.full((5, 5), np.nan), np.zeros(25), 0.5]),
        (spaces.Box(0, 9, (25,), np.uint8), [np.full(25, 10), np.full(25, -1), np.full(25, 256), np.full(25, 1.0)]),
        (spaces.MultiDiscrete([2, 3]), [[0, 3], [2, 0], [0], 1, None, [-1, 0]]),
        (spaces.MultiBinary(2), [[0, 2], [1], 1, None]),
        (spaces.Tuple((spaces.Discrete(2), spaces.Discrete(2))), [(0,), (0, 2), 1, None]),
        (spaces.Dict({"a": spaces.Discrete(2)}), [{}, {"a": 2}, {"b": 0}, 1, None]),
        (spaces.Text(3), ["abcd", 3, None]),
    ],
    ids=str,
)
@pytest.mark.parametrize("make", [aec_env, single_env])
def test_illegal_actions_are_errors_and_leave_everything_where_it_stood(make, space, illegal):
    moved = []
    decide = decision(
        action_space=space, agent="a_0", action_space_mapping=lambda action: moved.append(action) or ("done", action)
    )
    env = make(calling(decide, decide), decide)
    env.reset(seed=3)
    for step in (0, 1):
        for action in illegal:
            before = env.last() if make is aec_env else None
            with pytest.raises(InvalidActionError, match="a_0") as caught:
                env.step(action)
            assert isinstance(caught.value, ValueError)
            assert len(moved) == len(env.unwrapped.simulation.log) == step
            if make is aec_env:
                assert env.agent_selection == "a_0"
                after = env.last()
                assert after[1:] == before[1:]
                assert np.array_equal(after[0], before[0])
        env.step(env.action_space("a_0").sample() if make is aec_env else env.action_space.sample())
    assert [done for done, _ in env.unwrapped.simulation.log] == ["done", "done"]


@pytest.mark.parametrize(
    ("space", "legal"),
    [
        (spaces.Discrete(3), [0, 2, np.int64(1), np.uint8(2), np.array(1), True]),
        (spaces.Discrete(3, start=-1), [-1, 1, np.int64(0)]),
        (
            spaces.Box(0, 1, (2,), np.float32),
            [[0, 1], [0.5, 0.25], (1, 1), np.array([0.1, 0.9]), np.array([0, 1]), np.array([0.5, 0.5], np.float16)],
        ),
        (spaces.Box(0.1, 0.7, (2,), np.float32), [[0.1, 0.7], np.array([0.1, 0.7]), np.float32([0.1, 0.7])]),
        (spaces.Box(-np.inf, np.inf, (2,), np.float32), [[1e30, -1e30]]),
        (spaces.Box(0, 10, (2,), np.int32), [[0, 10], np.array([1, 2], np.uint8)]),
        (spaces.Box(0.1, 0.7, (5, 5), np.float32), [np.full((5, 5), 0.1), np.full((5, 5), 0.7).tolist()]),
        (spaces.Box(0, 9, (25,), np.uint8), [np.full(25, 9), np.zeros(25, np.int64)]),
        (spaces.MultiDiscrete([2, 3]), [[1, 2], np.array([0, 0])]),
        (spaces.MultiBinary(2), [[1, 0], np.array([1, 1], np.int8)]),
        (spaces.Text(3), ["abc"]),
    ],
    ids=str,
)
def test_legal_actions_come_in_many_shapes(space, legal):
    decide = decision(action_space=space)
    for action in legal:
        env = single_env(calling(decide), decide)
        env.reset()
        env.step(action)
        assert np.array_equal(
            np.asarray(env.unwrapped.simulation.log[0]), np.asarray(action).astype(space.dtype or object)
        )


def test_sampled_actions_are_legal():
    for space in (
        spaces.Discrete(3, start=2),
        spaces.Box(-1, 1, (2, 2), np.float16),
        spaces.Box(np.float32([0, -np.inf]), np.float32([np.inf, 0])),
        spaces.Box(0, 255, (3,), np.uint8),
        spaces.Dict({"a": spaces.Discrete(2), "b": spaces.Box(0, 1)}),
        spaces.Tuple((spaces.MultiBinary(3), spaces.Text(4))),
        spaces.Sequence(spaces.Discrete(3)),
        spaces.Graph(spaces.Discrete(3), None),
        spaces.OneOf((spaces.Discrete(3), spaces.Box(0, 1))),
    ):
        decide = decision(action_space=space)
        env = single_env(calling(*[decide] * 10), decide)
        env.reset(seed=1)
        for _ in range(10):
            env.step(env.action_space.sample())


@pytest.mark.parametrize("action", [0.5, 1, 0, np.float32(0.25), np.float64(0.1), np.array(0.5)], ids=repr)
def test_a_scalar_for_a_one_element_box_reaches_the_mapping_as_it_is(action):
    seen = []
    decide = decision(
        action_space=spaces.Box(0, 1, (1,), np.float32), action_space_mapping=lambda action: seen.append(action)
    )
    for env in (aec_env(calling(decide), decide), single_env(calling(decide), decide)):
        env.reset()
        env.step(action)
    assert seen == [action, action]
    assert all(got is action for got in seen)


def test_arrays_for_a_box_reach_the_mapping_in_its_dtype_and_are_not_shared():
    decide = decision(action_space=spaces.Box(0, 1, (2,), np.float32))
    env = single_env(calling(decide, decide), decide)
    env.reset()
    action = np.array([0.5, 0.25], np.float32)
    env.step(action)
    action[:] = 1
    received = env.unwrapped.simulation.log[0]
    assert received.tolist() == [0.5, 0.25]
    assert received.dtype == np.float32
    env.step([0.5, 0.25])
    assert env.unwrapped.simulation.log[1].dtype == np.float32


def test_discrete_actions_reach_the_mapping_as_python_integers():
    decide = decision()
    env = single_env(calling(*[decide] * 3), decide)
    env.reset()
    for action in (np.int64(3), np.array(3), 3):
        env.step(action)
    assert [type(action) for action in env.unwrapped.simulation.log] == [int] * 3


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
