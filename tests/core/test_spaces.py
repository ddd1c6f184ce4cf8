"""Spaces: observations are cast to them, and actions and masks are checked against them."""

import copy
from collections import deque

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import single_env
from simenv_marl.core.values.actions import ILLEGAL, action_check, mask_cast
from simenv_marl.core.values.spaces import blank, duplicate, observation_cast, same
from simenv_marl.errors import InvalidActionError, MaskError, ObservationError
from tests.worlds.models import calling, decision

BOX = spaces.Box(-1.0, 3.0, (2,), np.float32)
BYTES = spaces.Box(0, 255, (2,), np.uint8)
DIAL = spaces.Discrete(3, start=5)
DIALS = spaces.MultiDiscrete([2, 3], start=[0, 4])
BITS = spaces.MultiBinary(3)
TREE = spaces.Dict({"box": BOX, "pair": spaces.Tuple((DIAL, spaces.Dict({"bits": BITS})))})
WORDS = spaces.Text(5)
SWITCHES = spaces.Box(0, 1, (2,), bool)
ROW = spaces.Sequence(BOX)
STACK = spaces.Sequence(BOX, stack=True)
EITHER = spaces.OneOf((DIAL, BOX, SWITCHES))
NET = spaces.Graph(BOX, spaces.Discrete(4))
DEEP = spaces.Dict({"row": spaces.Sequence(spaces.Tuple((EITHER, ROW)))})


def assert_alike(one, other):
    """Also in their types, and in those of their parts."""
    assert same(one, other)
    assert repr(one) == repr(other)


# -- observations ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("space", "value", "expected"),
    [
        (BOX, np.array([1.5, 9.0]), np.float32([1.5, 9.0])),
        (BYTES, [1.0, 2.9], np.uint8([1, 2])),
        (BYTES, np.array([0, 255]), np.uint8([0, 255])),
        (DIAL, np.array(7), np.int64(7)),
        (
            TREE,
            {"pair": [6.0, {"bits": [True, False, False]}], "box": [1, 2]},
            {"box": np.float32([1, 2]), "pair": (np.int64(6), {"bits": np.int8([1, 0, 0])})},
        ),
        (SWITCHES, [True, 0.0], np.array([True, False])),
        (ROW, [], ()),
        (ROW, deque([[1, 2], np.array([3.0, 9.0])]), (np.float32([1, 2]), np.float32([3, 9]))),
        (STACK, [[1, 2], (3, 4)], np.float32([[1, 2], [3, 4]])),
        (STACK, np.ones((3, 2)), np.ones((3, 2), np.float32)),
        (EITHER, [1, [1, 2]], (np.int64(1), np.float32([1, 2]))),
        (EITHER, (np.int64(2), [1, 0]), (np.int64(2), np.array([True, False]))),
        (NET, ([[1, 2]], None, None), spaces.GraphInstance(np.float32([[1, 2]]), None, None)),
        (
            NET,
            ([[1, 2], [3, 9]], [3.0, 0], [[0, 1], [1, 1]]),
            spaces.GraphInstance(
                np.float32([[1, 2], [3, 9]]), np.array([3, 0]), np.array([[0, 1], [1, 1]])
            ),
        ),
        (
            DEEP,
            {"row": [((0, 7.0), [[1, 2]])]},
            {"row": (((np.int64(0), np.int64(7)), (np.float32([1, 2]),)),)},
        ),
    ],
    ids=str,
)
def test_env_observations_are_cast_to_their_space(space, value, expected):
    assert_alike(observation_cast(space)(value), expected)


@pytest.mark.parametrize(
    ("space", "value", "match"),
    [
        (BOX, [1, 2, 3], r"shape \(3,\)"),
        (BOX, [[1], [2, 3]], "does not fit"),
        (BOX, ["a", "b"], "not numeric"),
        (BYTES, [0, np.inf], "cannot hold"),
        (BYTES, [0, 256], "cannot hold"),
        (BYTES, [-1, 0], "cannot hold"),
        *((DIAL, value, "must be an integer") for value in (6.5, "6x", None, np.inf)),
        (TREE, {"box": [1, 2]}, "keys"),
        (TREE, {"box": [1, 2], "pear": [6, {"bits": [1, 0, 0]}]}, "keys"),
        (TREE, {"box": [1, 2], "pair": [6, {"bits": [1, 0, 0]}], "pear": 3}, "keys"),
        (TREE, 3, "keys"),
        (TREE, {"box": [1, 2], "pair": [6]}, "2 parts"),
        (TREE, {"box": [1, 2], "pair": {0: 6, 1: 7}}, "2 parts"),
        (WORDS, "too many words", "not in"),
        (SWITCHES, [0.5, 1], "numbers but 0 and 1"),
        (TREE, {"box": [1, 2], "pair": [6, {"bits": [1]}]}, r"'pair'.*'bits'.*shape \(1,\)"),
        (ROW, [[1, 2], [3, 4, 5]], r"in the element 1: .* shape \(3,\)"),
        (ROW, 3, "must have exactly the parts"),
        (spaces.Sequence(WORDS), "abc", "must have exactly the parts"),
        (EITHER, (3, [1, 2]), "must have exactly the parts"),
        (EITHER, (-1, [1, 0]), "must have exactly the parts"),
        (EITHER, (0, 6.5), "in the element 0: .* must be an integer"),
        (NET, ([[1, 2, 3]], None, None), "in the element 'nodes': .*shape"),
        (NET, ([[1, 2]], [1], [[0, 1]]), "pairs of the numbers of nodes"),
        (NET, ([[1, 2]], [1], [[0]]), "in the element 'edge_links': .*shape"),
        (NET, ([[1, 2]], ["x"], [[0, 0]]), "in the element 'edges': .*not numeric"),
        (NET, ([[1, 2]], None, [[0, 0]]), "pairs of the numbers of nodes"),
        (DEEP, {"row": [((1, [0, 1]), [[1]])]}, "'row'.* 0: .* 1: .* 0: .*shape"),
    ],
    ids=str,
)
def test_observation_cast_refuses_invalid_observations(space, value, match):
    with pytest.raises(ObservationError, match=match):
        observation_cast(space)(value)


def leaves(value):
    """The values in a nested value that have no parts."""
    if isinstance(value, dict | tuple | list):
        return [
            leaf
            for part in (value.values() if isinstance(value, dict) else value)
            for leaf in leaves(part)
        ]
    return [value]


@pytest.mark.parametrize(
    ("made_of", "value"),
    [
        (observation_cast(BOX), np.ones((3, 2), np.float32)[1]),
        (observation_cast(DIALS), np.array([1, 5])),
        (observation_cast(spaces.Tuple((spaces.Sequence(BOX),))), ((np.ones(2, np.float32),),)),
        (duplicate, {"a": np.arange(3.0), "b": ({"c": np.arange(2)}, 3)}),
        (duplicate, {"a": [np.arange(2), 3]}),
    ],
    ids=["box", "integers", "tuple", "dict", "list"],
)
def test_observation_cast_and_copy_share_no_memory_with_the_original(made_of, value):
    kept = copy.deepcopy(value)
    found = made_of(value)
    assert_alike(found, value)
    for array in leaves(found):
        array += 1
    assert same(value, kept)
    assert not same(found, kept)


def test_observation_comparison_compares_arrays_dicts_and_tuples_by_value():
    """Each of these is the same as its copy alone."""
    arrays = [
        np.array(numbers) for numbers in ([1.0, np.nan], [1.0, 2.0], [1.0, 4.0], [1.0, 2.0, 5.0])
    ]
    dicts = [{"a": np.array([1])}, {"a": np.array([2])}, {"a": 1, "b": 1}, {"b": 1}]
    tuples = [(1, np.array([2])), (1, 3), (1, 2, 3)]
    values = [*arrays, *dicts, *tuples]
    for one in values:
        assert [other is one for other in values] == [
            same(one, copy.deepcopy(other)) for other in values
        ]
    assert [same((1, 2), 3), same(3, 4), same("word", "word")] == [False, False, True]


def test_blank_observation_of_a_space_without_zero_is_always_the_same():
    found = blank(WORDS)
    WORDS.seed(3)
    state = WORDS.np_random.bit_generator.state
    assert blank(WORDS) == found
    assert found in WORDS
    assert WORDS.np_random.bit_generator.state == state


# -- actions --------------------------------------------------------------------------------------


class Choking(spaces.Space):
    """Raises for what is not in it."""

    def contains(self, x):
        raise RuntimeError("what is that")


@pytest.mark.parametrize(
    ("space", "actions"),
    [
        (DIAL, [np.float32(5), True]),
        (BOX, [[[0.0, 0.0]], [None, 0.0], [[1], [2, 3]]]),
        (spaces.Box(0, 9, (1,), np.int8), [5.0]),
        (
            spaces.Box(np.array([0, 10]), np.array([1, 11]), dtype=np.float64),
            [np.array([10.0, 1.0])],
        ),
        (Choking((), np.int8), [3]),
    ],
    ids=lambda given: type(given).__name__,
)
def test_action_check_refuses_actions_outside_the_space(space, actions):
    check = action_check(space)
    assert [action for action in actions if check(action) is not ILLEGAL] == []


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("number", [1, 2, 40])
def test_action_check_of_a_box_checks_each_element_and_accepts_the_bounds(number, dtype):
    high = np.full(number, 0.1, dtype)
    check = action_check(spaces.Box(-high, high, dtype=dtype))
    for legal in (
        high,
        -high,
        high.astype(np.float64),
        high.tolist(),
        np.zeros(number, np.float32),
    ):
        assert_alike(check(legal), np.asarray(legal, dtype))
        assert check(legal) is not legal
    for at in (0, -1):
        for wrong in (0.2, -0.2, np.nan, np.inf):
            action = np.zeros(number)
            action[at] = wrong
            for given in (action, action.astype(np.float32), action.tolist()):
                assert check(given) is ILLEGAL


@pytest.mark.parametrize("shape", [(1,), (2,)])
def test_action_clipping_of_integers_does_not_wrap_around(shape):
    check = action_check(spaces.Box(-5, 2**63 - 1, shape, np.int64), clips=True)
    for given, clipped in (
        (np.uint64(2**64 - 1), 2**63 - 1),
        (np.int64(-(2**63)), -5),
        (np.int64(7), 7),
    ):
        assert_alike(check(np.full(shape, given)), np.full(shape, clipped))


@pytest.mark.parametrize("shape", [(), (1,)])
@pytest.mark.parametrize(("given", "clipped"), [(5, 3), (np.int64(-5), 0), (np.array(2), 2)])
def test_action_clipping_works_for_a_single_integer(shape, given, clipped):
    check = action_check(spaces.Box(0, 3, shape, np.int64), clips=True)
    assert check(given) == clipped


def test_action_check_converts_each_part_of_a_dict_or_tuple_action():
    given = {"pair": [np.int8(6), {"bits": np.array([1, 0, 1], np.int8)}], "box": [0.5, 1]}
    found = action_check(TREE)(given)
    assert_alike(found, {"box": np.float32([0.5, 1]), "pair": (6, {"bits": np.int8([1, 0, 1])})})
    assert found["pair"][1]["bits"] is not given["pair"][1]["bits"]


@pytest.mark.parametrize(
    "change",
    [
        {"box": [0.5, np.nan]},
        {"pear": 3},
        {"pair": (6,)},
        {"pair": {0: 6, 1: {"bits": np.zeros(3, np.int8)}}},
        {"pair": (6, {"bits": np.zeros(2, np.int8)})},
        {"pair": (6, {"bats": np.zeros(3, np.int8)})},
    ],
    ids=str,
)
@pytest.mark.parametrize("clips", [False, True])
def test_action_check_refuses_an_action_with_an_illegal_part(change, clips):
    action = {"pair": (6, {"bits": np.zeros(3, np.int8)}), "box": [0.5, 1]}
    check = action_check(TREE, clips=clips)
    assert check(action) is not ILLEGAL
    assert check({**action, **change}) is ILLEGAL


@pytest.mark.parametrize(
    ("space", "action", "expected"),
    [
        (SWITCHES, [True, False], np.array([True, False])),
        (SWITCHES, np.array([1, 0]), np.array([True, False])),
        (ROW, [[1, 2], np.array([3.0, 0.0])], (np.float32([1, 2]), np.float32([3, 0]))),
        (STACK, [[1, 2]], np.float32([[1, 2]])),
        (EITHER, [0, np.int8(6)], (np.int64(0), 6)),
        (EITHER, (2, [1, 0]), (np.int64(2), np.array([True, False]))),
        (
            NET,
            ([[1, 2]], [3], [[0, 0]]),
            spaces.GraphInstance(np.float32([[1, 2]]), np.array([3]), np.array([[0, 0]])),
        ),
        (
            DEEP,
            {"row": [((0, 7), [[1, 2]])]},
            {"row": (((np.int64(0), 7), (np.float32([1, 2]),)),)},
        ),
    ],
    ids=str,
)
@pytest.mark.parametrize("clips", [False, True])
def test_action_check_converts_each_item_of_a_sequence_action(space, action, expected, clips):
    assert_alike(action_check(space, clips=clips)(action), expected)


@pytest.mark.parametrize(
    ("space", "action", "match"),
    [
        (SWITCHES, [2, 0], r"\[2, 0\] is not in Box"),
        (TREE, {"box": [0.5, np.nan], "pair": (6, {"bits": np.int8([0] * 3)})}, "'box': .* Box"),
        (ROW, [[1, 2], [1, 4]], r"in the element 1: \[1, 4\] is not in Box"),
        (STACK, [[1, 4]], r"\[\[1, 4\]\] is not in Box"),
        (EITHER, (0, 9), "in the element 0: 9 is not in Discrete"),
        (EITHER, (7, 9), "is not in OneOf"),
        (NET, ([[1, 2]], [3], [[0, 1]]), "in the element 'edge_links'"),
        (DEEP, {"row": [((0, 7), [[1, 2], "x"])]}, "'row': .* 0: .* 1: .* 1: 'x' is not in Box"),
    ],
    ids=str,
)
def test_action_check_error_names_the_illegal_element(space, action, match):
    assert action_check(space)(action) is ILLEGAL
    with pytest.raises(InvalidActionError, match=match):
        action_check(space, raises=True)(action)
    env = single_env(calling(decide := decision(agent="a", action_space=space)), decide)
    env.reset()
    with pytest.raises(InvalidActionError, match=match if "element" in match else "action space"):
        env.step(action)


@pytest.mark.parametrize(
    "space",
    [
        SWITCHES,
        spaces.Box(0, 1, (1,), bool),
        spaces.Box(0, 1, (), bool),
        ROW,
        STACK,
        EITHER,
        NET,
        DEEP,
        spaces.Graph(spaces.Dict(a=DIAL), spaces.Tuple((BOX, SWITCHES))),
        spaces.Sequence(spaces.Dict(a=BOX, b=DIAL), stack=True),
        spaces.Sequence(WORDS),
    ],
    ids=str,
)
def test_samples_of_every_space_are_legal_actions_and_observations(space):
    space.seed(1)
    for _ in range(20):
        sample = space.sample()
        for convert in (observation_cast(space), action_check(space)):
            found = convert(sample)
            assert same(found, sample)
            assert space.contains(found)
    assert observation_cast(space)(blank(space)) in space


def test_action_check_of_other_spaces_uses_contains_and_copies_the_action():
    given = np.array([1, 6])
    found = action_check(DIALS)(given)
    assert_alike(found, given)
    assert found is not given
    assert_alike(action_check(BYTES)([10, 0]), np.uint8([10, 0]))
    assert [action_check(spaces.Discrete(2))(truth) for truth in (True, np.bool_(0))] == [1, 0]
    for number in (0.1, 1, np.float32(0.25), np.array(0.5)):  # for a box of one element
        assert action_check(spaces.Box(0, 1, (1,), np.float32))(number) is number


# -- masks ----------------------------------------------------------------------------------------


def test_action_mask_cast_returns_a_new_int8_array():
    column = np.int8([[1, 9], [0, 9], [1, 9]])[:, 0]
    for given in ([1, 0, 1], np.array([1.0, 0.0, 1.0]), column, np.array([True, False, True])):
        found = mask_cast(DIAL)(given)
        assert_alike(found, np.int8([1, 0, 1]))
        found[:] = 0
        assert list(given) == [1, 0, 1]


@pytest.mark.parametrize(
    ("given", "match"),
    [
        *((given, "shape") for given in ([1, 0], [[1, 0, 1]], 1)),
        *(
            (given, "other than 0 and 1")
            for given in ([0.5, 1, 0], [1, 256, 0], np.int8([1, 2, 1]), np.int8([0, -1, 0]))
        ),
        *((given, "no legal action") for given in ([0, 0, 0], np.array([False, False, False]))),
    ],
    ids=repr,
)
def test_action_mask_cast_refuses_invalid_masks(given, match):
    for space, mask in ((DIAL, given), (DIALS, ([1, 1], given))):
        with pytest.raises(MaskError, match=match):
            mask_cast(space)(mask)


@pytest.mark.parametrize(
    "given", [([1, 1],), ([1, 1], [1, 1, 1], [1]), np.ones((2, 3)), None], ids=str
)
def test_action_mask_of_a_multi_discrete_space_needs_a_part_per_number(given):
    with pytest.raises(MaskError, match="2 parts"):
        mask_cast(DIALS)(given)
