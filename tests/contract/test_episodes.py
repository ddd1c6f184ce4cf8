"""Section 5 of the contract: what happens when, in the AEC and in the single view."""

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

VIEWS = pytest.mark.parametrize("view", [aec_env, single_env])

# -- 5.2: the order of agents ---------------------------------------------------------------------


@pytest.mark.parametrize("order", ["aaaa", "abba", "cab", "abcccbbbaaac", "c"])
def test_agents_are_selected_in_the_order_in_which_the_simulation_calls_them(order):
    points = {name: decision(agent=f"{name}_0") for name in "abc"}
    env = aec_env(calling(*[points[name] for name in order]), list(points.values()))
    for _ in range(2):
        turns = play(env, lambda agent, env: len(env.agents))
        assert decisions(turns) == [f"{name}_0" for name in order]
        assert sorted(turn.agent for turn in turns if turn.terminated) == ["a_0", "b_0", "c_0"]
        assert len(turns) == len(order) + 3
    assert env.agents == []


def test_agents_that_are_named_at_the_call_join_when_they_first_decide_and_stay():
    def is_booked(agents):
        assert sorted(env.agents) == sorted(agents)
        books = (env.rewards, env.terminations, env.truncations, env.infos)
        assert all(set(book) == set(agents) for book in books)

    order = "abacdda"
    decide = decision(lambda name: 0, agent=lambda name: name)
    env = aec_env(calling(*[lambda name=name: decide(name) for name in order]), decide)
    env.reset()
    for number, name in enumerate(order):
        assert env.agents == list(dict.fromkeys(order[: number + 1]))
        is_booked(env.agents)
        assert env.agent_selection == name
        env.step(1)
    left = list("abcd")
    is_booked(left)
    for agent in env.agent_iter():
        left.remove(agent)
        assert env.last()[2:4] == (True, False)
        env.step(None)
        is_booked(left)
    assert left == []
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
    env = aec_env(calling(decide), decide)
    env.reset()
    for observation in (single_env(calling(decide), decide).reset()[0], env.last()[0], env.observe("choose_0")):
        assert type(observation) is type(expected)
        assert observation.dtype == expected.dtype
        assert observation.shape == expected.shape
        assert np.array_equal(observation, expected)
        assert observation in space


def test_observations_of_composed_spaces_are_cast_part_by_part():
    parts = spaces.Tuple((spaces.Discrete(2), spaces.Box(0, 1, (1,), np.float32)))
    space = spaces.Dict({"level": spaces.Box(0, 10, (2,), np.float32), "parts": parts, "name": spaces.Text(5)})
    value = {"name": "abc", "level": [1, 2], "parts": [1, [0.5]]}
    decide = decision(observation_space=space, observation_space_mapping=lambda: value)
    env = aec_env(calling(decide), decide)
    env.reset()
    observation = env.last()[0]
    assert observation in space
    assert observation["level"].tolist() == [1, 2]
    assert type(observation["parts"][0]) is np.int64
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
        with pytest.raises(ObservationError):
            make(calling(decide), decide).reset()
    assert issubclass(ObservationError, ValueError)


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


ROW = spaces.Box(0, 10, (4,), np.float32)
LISTED = spaces.Tuple((ROW, spaces.Discrete(9)))
KINDS = {
    "own": (ROW, lambda array, parts: array),
    "copy": (ROW, lambda array, parts: array.copy()),
    "computed": (ROW, lambda array, parts: array + 0),
    "view": (ROW, lambda array, parts: array[:]),
    "reversed": (ROW, lambda array, parts: array[::-1][::-1]),
    "cast": (ROW, lambda array, parts: array.astype(np.float64)),
    "list of numbers": (ROW, lambda array, parts: array.tolist()),
    "dict": (spaces.Dict({"a": ROW, "b": LISTED}), lambda array, parts: parts),
    "list": (LISTED, lambda array, parts: parts["b"]),
}
"""What a model may give: its own array, one that it has just made, a view, or parts of these."""


def level_of(observation):
    """The first number in each of its arrays, of which the others are never changed."""
    if isinstance(observation, dict):
        assert set(observation) == {"a", "b"}
        assert level_of(observation["a"]) == level_of(observation["b"])
        return level_of(observation["a"])
    if isinstance(observation, tuple):
        assert observation[1] == 3
        return level_of(observation[0])
    assert observation.tolist()[1:] == [6, 7, 8]
    return observation[0]


@pytest.mark.parametrize("kind", KINDS)
@VIEWS
def test_observations_are_never_shared_between_calls_or_with_the_model(kind, view):
    space, observe = KINDS[kind]
    array = np.array([5, 6, 7, 8], np.float32)
    parts = {"a": array, "b": [array, 3]}
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
            assert level_of(observation) == level
            if level == 2:
                kept.append(observation)
            else:
                fill(observation)
        held += [observation for observation in seen if isinstance(observation, np.ndarray)]
        result = env.step(1)
    assert [level_of(observation) for observation in kept] == [2] * len(kept)
    assert not any(np.shares_memory(one, array) for one in held)
    assert not any(np.shares_memory(one, two) for one in held for two in held if one is not two)


class Holder:
    """Holds an array as an attribute."""

    def __init__(self, array):
        self.array = array

    def observe(self):
        return self.array


HOLDERS = {
    "attribute": lambda array: Holder(array).observe,
    "closure": lambda array: lambda: array,
    "argument": lambda array: partial(lambda given: given, array),
    "list": lambda array: partial([array].__getitem__, 0),
    "dict": lambda array: partial({"array": array}.get, "array"),
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


@VIEWS
def test_infos_are_never_shared_between_steps(view):
    mask = np.ones(10, np.int8)
    decide = decision(action_mask_mapping=lambda: mask)
    env = view(calling(*[decide] * 3), decide)
    infos = [(env.reset() or env.last())[-1]]
    infos += [(env.step(1) or env.last())[-1] for _ in range(2)]
    assert len({id(info) for info in infos}) == 3
    for info in infos:
        info["action_mask"][:] = 0
        info.clear()
    assert mask.tolist() == [1] * 10


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
        (spaces.Box(-1, 1, (2,), np.float32), [0, 0]),
        (spaces.Box(np.array([1, -5], np.float32), np.array([3, -2], np.float32)), [1, -2]),
        (spaces.Box(-np.inf, np.inf, (1,), np.float64), [0]),
        (spaces.Box(3, 200, (2,), np.uint8), [3, 3]),
        (spaces.Discrete(3), 0),
        (spaces.Discrete(3, start=5), 5),
        (spaces.Discrete(3, start=-9), -7),
        (spaces.MultiBinary(2), [0, 0]),
        (spaces.MultiDiscrete([2, 3]), [0, 0]),
        (spaces.Dict({"a": spaces.Box(1, 2, (1,)), "b": spaces.Tuple((spaces.Discrete(2, start=1),))}), None),
        (spaces.Text(3), None),
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
        assert observation in space
        if expected is not None:
            assert observation.tolist() == expected
            assert observation.dtype == space.dtype
        assert env.observe("late_0") is not observation or np.isscalar(observation)
        env.step(1)


class Foreseeing(Script):
    """Knows which calls are to come."""

    def __init__(self, main, expected):
        super().__init__(main)
        self.expected = expected

    def expected_calls(self, point):
        return self.expected.get(point.rpartition(".")[2], [])


def test_before_its_first_decision_an_agents_observation_comes_from_expected_calls():
    level = [7]
    observe = {"observation_space_mapping": lambda room: [level[0], room]}

    @define(agent="early_0", **observe)
    def early(room):
        return 0

    @define(agent="late_0", **observe)
    def late(room):
        return 0

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

    def point(self, name, rule=None):
        def pay():
            self.asked[name] += 1
            paid, self.balance[name] = self.balance[name], 0.0
            return paid

        return decision(rule, agent=f"{name}_0", reward_mapping=pay)

    def earn(self, a, b=0.0):
        self.balance["a"] += a
        self.balance["b"] += b


def test_in_aec_each_action_is_rewarded_once_and_the_book_adds_up_to_what_last_tells():
    ledger = Ledger()
    a, b = ledger.point("a"), ledger.point("b")

    def main(simulation):
        ledger.earn(0.5, 0.25)  # before a has done anything: discarded
        a()
        ledger.earn(1, 0.25)  # b has done nothing yet
        b()
        ledger.earn(2, 10)
        a()
        ledger.earn(4, 20)
        a()
        ledger.earn(8, 40)

    env = aec_env(script(main), [a, b])
    for number in (1, 2):
        ledger.balance = {"a": 0.0, "b": 0.0}
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
        assert ledger.asked == {"a": 4 * number, "b": 2 * number}


def test_in_the_single_view_a_steps_reward_is_that_of_its_action_or_of_the_rule():
    ledger = Ledger()
    a = ledger.point("a", lambda: 6)

    def main(simulation):
        ledger.earn(1000)
        for _ in range(3):
            ledger.earn(a())

    env = single_env(script(main), a)
    for number in (1, 2):
        env.reset()
        assert [env.step(action)[1] for action in (5, RULE, 7)] == [5.0, 6.0, 7.0]
        assert ledger.asked["a"] == 4 * number


@pytest.mark.parametrize("expected", [{}, {"idle": [(7,)]}], ids=["unknown", "announced"])
def test_agents_that_never_act_are_never_rewarded(expected):
    asked, level = [], [0]

    @define(
        agent="b_0",
        observation_space_mapping=lambda room: [room, level[0]],
        reward_mapping=lambda room: asked.append(1) or 1.0,
    )
    def idle(room):
        return 0

    a = decision(lambda: level.__setitem__(0, level[0] + 1), agent="a_0")
    env = aec_env(lambda: Foreseeing(lambda simulation: [a(), a()], expected), [a, idle])
    turns = [turn for turn in play(env) if turn.agent == "b_0"]
    assert [(turn.reward, turn.terminated) for turn in turns] == [(0.0, True)]
    # At the end it is observed anew on the call that was to come.
    assert turns[0].observation.tolist() == ([7, 2] if expected else [0, 0])
    assert not asked


class Paid:
    """Is paid and observes what it has."""

    value: Any = 0.0
    observed: Any = (0.0, 0.0)

    def choose(self):
        return "rule"


@pytest.fixture(params=["method", "function"])
def paid(request):
    """A decision point, and what makes simulations in which it is called once for each of some values."""
    point = define(
        agent="paid_0",
        reward_mapping=lambda being: being.value,
        observation_space_mapping=lambda being: being.observed,
    )
    holder = type("Being", (Paid,), {"choose": point(Paid.choose)}) if request.param == "method" else Paid
    choose = holder.choose if request.param == "method" else point(lambda being: "rule")

    def of(values, attribute="value"):
        def main(simulation):
            being = holder()
            for value in values:
                choose(being)
                setattr(being, attribute, value)

        return script(main)

    return choose, of


def test_rewards_are_python_floats_at_every_step(paid):
    choose, of = paid
    values = [2, True, -0.0, np.float32(0.5), np.float64(0.1), np.int8(4), np.array(1.5), np.array([2.5])]
    env = single_env(of(values), choose)
    env.reset()
    rewards = [env.step(1)[1] for _ in values]
    assert rewards == [2.0, 1.0, 0.0, 0.5, 0.1, 4.0, 1.5, 2.5]
    assert {type(reward) for reward in rewards} == {float}
    turns = play(aec_env(of(values), choose), 1)
    assert rewards_of(turns, "paid_0") == rewards
    assert {type(turn.reward) for turn in turns} == {float}


NO_REWARDS = [None, "much", "1.0", [1, 2], np.array([1.0, 2.0]), 1j, np.nan, np.inf, -np.inf, {}, 10**400]
NO_OBSERVATIONS = [None, "1.0", [1.0], [[1.0, 2.0]]]


@pytest.mark.parametrize("number", [1, 2, 3])
@pytest.mark.parametrize(
    ("attribute", "legal", "illegal", "error", "said"),
    [
        ("value", 1.0, NO_REWARDS, RewardError, "reward"),
        ("observed", [1.0, 2.0], NO_OBSERVATIONS, ObservationError, "its space Box"),
    ],
    ids=["rewards", "observations"],
)
def test_what_is_no_finite_number_or_does_not_fit_is_an_error_at_every_step(
    paid, attribute, legal, illegal, error, said, number
):
    choose, of = paid
    for value in illegal:
        values = [legal] * 3
        values[number - 1] = value
        for view in (aec_env, single_env):
            env = view(of(values, attribute), choose)
            env.reset()
            for _ in range(number - 1):
                env.step(1)
            with pytest.raises(error, match=said) as caught:
                env.step(1)
            assert isinstance(caught.value, ValueError)


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


@pytest.mark.parametrize(
    "points", [[Walk.stride, Walk.turns], [Walk.stride], [Walk.turns]], ids=["both", "one", "other"]
)
@pytest.mark.parametrize("seed", range(3))
def test_with_rule_throughout_a_run_is_the_plain_one_bit_for_bit(points, seed):
    env = aec_env(script(lambda simulation: simulation.log.extend(Walk(simulation.seed).walk())), points)
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

    env = aec_env(script(main), point)
    turns = play(env, actions)
    assert env.unwrapped.simulation.log == [[True, False, False], [True, True, False], [True, True, True]]
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


@pytest.mark.parametrize(
    ("view", "agent", "action", "gone"),
    [
        (single_env, "goat_0", RULE, [True, False]),
        (single_env, "goat_0", 0, [True, False]),
        (aec_env, "goat_0", 1, [False, True]),
        (aec_env, lambda goat: "goat_0", 1, [False, True]),
    ],
    ids=["rule", "first", "second", "of an entity"],
)
def test_a_choice_that_the_model_lets_go_goes_at_once(view, agent, action, gone):
    def main(simulation):
        goat = Goat()
        watched = [weakref.ref(grass) for grass in goat.meadow]
        goat.meadow.remove(goat.browse())
        simulation.log += [watch() is None for watch in watched]

    choices = {"choices": lambda goat: list(goat.meadow), "action_space": spaces.Discrete(2)}
    env = view(script(main), {Goat.browse: define(agent=agent, **choices)})
    env.reset()
    env.step(action)
    assert env.unwrapped.simulation.log == gone


@pytest.mark.usefixtures("_collected")
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

    env = aec_env(script(main), Lamb.choose, policies=policy and {"lamb_2": policy})
    assert decisions(play(env, actions)) == ["lamb_1", "lamb_1"]
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
@VIEWS
def test_illegal_actions_are_errors_and_leave_everything_where_it_stood(view, space, illegal):
    moved = []
    decide = decision(
        action_space=space, agent="a_0", action_space_mapping=lambda action: moved.append(action) or ("done", action)
    )
    env = view(calling(decide, decide), decide)
    env.reset(seed=3)
    actions = env.action_space("a_0") if view is aec_env else env.action_space
    for step in (0, 1):
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
        env.step(actions.sample())
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
        expected = np.asarray(action).astype(space.dtype or object)
        assert np.array_equal(np.asarray(env.unwrapped.simulation.log[0]), expected)


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


def test_arrays_reach_the_mapping_in_the_spaces_dtype_unshared_and_discrete_actions_as_python_integers():
    decide = decision(action_space=spaces.Box(0, 1, (2,), np.float32))
    env = single_env(calling(decide, decide), decide)
    env.reset()
    action = np.array([0.5, 0.25], np.float32)
    env.step(action)
    action[:] = 1
    env.step([0.5, 0.25])
    for received in env.unwrapped.simulation.log:
        assert received.tolist() == [0.5, 0.25]
        assert received.dtype == np.float32
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
