"""What goes through a space: observations are cast to it, actions and masks are checked against it."""

import copy

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl.core.actions import ILLEGAL, action_check, mask_allows, mask_cast, open_mask
from simenv_marl.core.spaces import blank, duplicate, observation_cast, same
from simenv_marl.errors import MaskError, ObservationError

BOX = spaces.Box(-1.0, 3.0, (2,), np.float32)
BYTES = spaces.Box(0, 255, (2,), np.uint8)
DIAL = spaces.Discrete(3, start=5)
DIALS = spaces.MultiDiscrete([2, 3], start=[0, 4])
BITS = spaces.MultiBinary(3)
TREE = spaces.Dict({"box": BOX, "pair": spaces.Tuple((DIAL, spaces.Dict({"bits": BITS})))})
WORDS = spaces.Text(5)


@pytest.mark.parametrize(
    ("space", "value", "expected"),
    [
        (BOX, [1, 2], np.array([1, 2], np.float32)),
        (BOX, np.array([1.5, 9.0]), np.array([1.5, 9.0], np.float32)),
        (BOX, (True, False), np.array([1, 0], np.float32)),
        (BYTES, [1.0, 2.9], np.array([1, 2], np.uint8)),
        (DIAL, 6.0, np.int64(6)),
        (DIAL, np.array(7), np.int64(7)),
        (DIALS, [1, 5], np.array([1, 5], np.int64)),
        (BYTES, np.array([0, 255]), np.array([0, 255], np.uint8)),
        (BITS, [True, False, True], np.array([1, 0, 1], np.int8)),
        (WORDS, "word", "word"),
    ],
    ids=str,
)
def test_observations_are_cast(space, value, expected):
    found = observation_cast(space)(value)
    assert type(found) is type(expected)
    assert getattr(found, "dtype", None) == getattr(expected, "dtype", None)
    assert np.array_equal(found, expected)


def test_observations_in_observations_are_cast():
    found = observation_cast(TREE)({"pair": [6.0, {"bits": [1, 0, 0]}], "box": [1, 2]})
    assert list(found) == ["box", "pair"]
    assert [type(found["pair"]), type(found["pair"][0])] == [tuple, np.int64]
    assert found in TREE


@pytest.mark.parametrize(
    ("space", "value", "match"),
    [
        (BOX, [1, 2, 3], r"shape \(3,\)"),
        (BOX, [[1], [2, 3]], "does not fit"),
        (BOX, ["a", "b"], "not numeric"),
        (BYTES, [0, np.inf], "not finite"),
        (BYTES, [0, 256], "cannot hold"),
        (BYTES, [-1, 0], "cannot hold"),
        (DIAL, 6.5, "must be an integer"),
        (DIAL, "6x", "must be an integer"),
        (DIAL, None, "must be an integer"),
        (DIAL, np.inf, "must be an integer"),
        (TREE, {"box": [1, 2]}, "keys"),
        (TREE, {"box": [1, 2], "pear": [6, {"bits": [1, 0, 0]}]}, "keys"),
        (TREE, 3, "keys"),
        (TREE, {"box": [1, 2], "pair": [6]}, "2 parts"),
        (TREE, {"box": [1, 2], "pair": {0: 6, 1: 7}}, "2 parts"),
        (TREE, {"box": [1, 2], "pair": [6, {"bits": [1, 0]}]}, "shape"),
        (WORDS, "too many words", "not in"),
    ],
    ids=str,
)
def test_invalid_observations_are_refused(space, value, match):
    with pytest.raises(ObservationError, match=match):
        observation_cast(space)(value)


@pytest.mark.parametrize(
    ("space", "value"),
    [
        (BOX, np.array([1, 2], np.float32)),
        (BOX, np.ones((3, 2), np.float32)[1]),
        (DIALS, np.array([1, 5], np.int64)),
        (BITS, np.array([1, 1, 1], np.int8)),
        (spaces.Dict({"box": BOX}), {"box": np.array([1, 2], np.float32)}),
        (spaces.Tuple((BOX,)), (np.array([1, 2], np.float32),)),
        (spaces.Sequence(BOX), (np.ones(2, np.float32),)),
    ],
    ids=str,
)
def test_observations_are_shared_with_no_model(space, value):
    kept = copy.deepcopy(value)
    found = observation_cast(space)(value)
    assert same(found, value)
    for array in leaves(found):
        array[...] = 0
    assert same(kept, value)


def leaves(value):
    """The arrays in a nested value."""
    if isinstance(value, np.ndarray):
        return [value]
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, tuple | list) else ()
    return [leaf for part in parts for leaf in leaves(part)]


@pytest.mark.parametrize(
    "value",
    [{"a": np.arange(3.0), "b": {"c": np.arange(2)}}, (np.arange(3.0), (np.arange(2), 3)), {"a": [np.arange(2), 3]}],
    ids=str,
)
def test_duplicates_share_nothing(value):
    kept = copy.deepcopy(value)
    found = duplicate(value)
    assert type(found) is type(value)
    assert same(found, value)
    for array in leaves(found):
        array += 1
    assert same(value, kept)
    assert not same(found, kept)


@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [
        (np.array([1.0, np.nan]), np.array([1.0, np.nan]), True),
        (np.array([1.0, 2.0]), np.array([1.0, 3.0]), False),
        (np.array([1, 2]), np.array([1, 2, 3]), False),
        ({"a": np.array([1])}, {"a": np.array([1])}, True),
        ({"a": np.array([1])}, {"a": np.array([2])}, False),
        ({"a": 1}, {"b": 1}, False),
        ({"a": 1}, {"a": 1, "b": 1}, False),
        ({"a": 1}, [1], False),
        ((1, np.array([2])), (1, np.array([2])), True),
        ((1, 2), (1, 3), False),
        ((1, 2), (1, 2, 3), False),
        ((1, 2), 3, False),
        (3, 4, False),
        ("word", "word", True),
    ],
    ids=str,
)
def test_same_compares_number_for_number(one, other, expected):
    assert same(one, other) is expected


@pytest.mark.parametrize(
    ("space", "expected"),
    [
        (spaces.Box(2.0, 3.0, (2,), np.float32), np.full(2, 2, np.float32)),
        (spaces.Box(-3.0, -2.0, (1,), np.float64), np.full(1, -2.0)),
        (spaces.Discrete(3, start=-7), np.int64(-5)),
        (spaces.Discrete(9, start=-4), np.int64(0)),
        (DIALS, np.array([0, 4])),
        (spaces.MultiDiscrete([2, 2], start=[-5, -1]), np.array([-4, 0])),
        (TREE, {"box": np.zeros(2), "pair": (5, {"bits": np.zeros(3)})}),
    ],
    ids=str,
)
def test_blanks_are_zero_clipped_into_their_space(space, expected):
    found = blank(space)
    assert found in space
    assert same(found, expected)
    assert type(found) is type(expected)
    assert getattr(found, "dtype", None) == getattr(expected, "dtype", None)


def test_the_blank_of_a_space_without_a_zero_is_always_the_same():
    found = blank(WORDS)
    WORDS.seed(3)
    state = WORDS.np_random.bit_generator.state
    assert blank(WORDS) == found
    assert found in WORDS
    assert WORDS.np_random.bit_generator.state == state


@pytest.mark.parametrize("action", [5, 7, np.int8(6), np.array(6), np.int64(7)], ids=repr)
def test_actions_of_discrete_spaces_are_python_integers(action):
    found = action_check(DIAL)(action)
    assert type(found) is int
    assert found == int(action)
    assert action_check(spaces.Discrete(2))(True) == 1  # truth is a number
    assert action_check(spaces.Discrete(2))(np.bool_(0)) == 0


class Choking(spaces.Space):
    """Raises for what is not in it."""

    def contains(self, x):
        raise RuntimeError("what is that")


ONE = spaces.Box(0, 1, (1,), np.float32)
SMALL = spaces.Box(0, 10, (2,), np.uint8)


@pytest.mark.parametrize(
    ("space", "actions"),
    [
        (DIAL, [4, 8, 5.0, "5", None, np.array([5]), [5], np.float32(5), True]),
        (BOX, [[0.0], [0.0, 0.0, 0.0], 0.0, "ab", None, [[0.0, 0.0]], [None, 0.0], [[1], [2, 3]]]),
        (ONE, [1.5, -0.5, np.float32(2), 2, np.array(-1.0), np.nan]),
        (SMALL, [[256, 0], np.array([-255, 0]), [1.0, 2.0]]),
        (spaces.Box(0, 9, (1,), np.int8), [5.0]),
        (spaces.Box(np.array([0, 10]), np.array([1, 11]), dtype=np.float64), [np.array([10.0, 1.0])]),
        (DIALS, [np.array([2, 6])]),
        (WORDS, ["too many words"]),
        (TREE, [3]),
        (Choking((), np.int8), [3]),
    ],
    ids=lambda given: type(given).__name__,
)
def test_actions_outside_the_space_are_illegal(space, actions):
    check = action_check(space)
    assert [action for action in actions if check(action) is not ILLEGAL] == []


@pytest.mark.parametrize("number", [1, 2, 40])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_actions_of_boxes_are_copies_in_their_dtype(number, dtype):
    check = action_check(spaces.Box(-1, 1, (number,), dtype))
    for given in (np.full(number, 0.1, np.float64), np.full(number, 0.1, np.float32), [0.1] * number):
        found = check(given)
        assert found.dtype == dtype
        assert found.shape == (number,)
        assert np.allclose(found, 0.1)
        if isinstance(given, np.ndarray):
            found[:] = 9
            assert given[0] != 9


@pytest.mark.parametrize("number", [1, 2, 40])
@pytest.mark.parametrize("at", [0, -1])
@pytest.mark.parametrize("wrong", [1.5, -1.5, np.nan, np.inf])
def test_each_element_of_a_box_counts(number, at, wrong):
    check = action_check(spaces.Box(-1, 1, (number,), np.float64))
    for bound in (-1.0, 1.0):
        assert check(np.full(number, bound)) is not ILLEGAL
    action = np.zeros(number)
    action[at] = wrong
    for given in (action, action.astype(np.float32), action.tolist()):
        assert check(given) is ILLEGAL


@pytest.mark.parametrize("action", [0.5, np.float32(0.5), 1, np.array(0.5)], ids=repr)
def test_the_one_number_of_a_box_comes_out_as_it_went_in(action):
    assert action_check(ONE)(action) is action


@pytest.mark.parametrize("bound", [0.1, 0.3, np.array([0.7, 7.0])], ids=str)
def test_a_bound_is_legal_in_every_precision(bound):
    high = np.broadcast_to(bound, 2)
    check = action_check(spaces.Box(-high.astype(np.float32), high.astype(np.float32)))
    for given in (np.float32, np.float64):
        assert check(high.astype(given)) is not ILLEGAL
        assert check(-high.astype(given)) is not ILLEGAL


@pytest.mark.parametrize("pair", [tuple, list])
def test_parts_of_actions_are_checked_like_actions(pair):
    given = {"pair": pair([np.int8(6), {"bits": np.array([1, 0, 1], np.int8)}]), "box": [0.5, 1]}
    found = action_check(TREE)(given)
    assert same(found, {"box": np.array([0.5, 1]), "pair": (6, {"bits": np.array([1, 0, 1])})})
    assert found["box"].dtype == np.float32
    assert (type(found["pair"]), type(found["pair"][0])) == (tuple, int)
    assert found["pair"][1]["bits"] is not given["pair"][1]["bits"]


@pytest.mark.parametrize(
    "change",
    [
        {"box": [0.5, np.nan]},
        {"box": None},
        {"pear": 3},
        {"pair": (6,)},
        {"pair": {0: 6, 1: {"bits": np.zeros(3, np.int8)}}},
        {"pair": (6, {"bits": np.zeros(2, np.int8)})},
        {"pair": (6, {"bats": np.zeros(3, np.int8)})},
    ],
    ids=str,
)
def test_an_action_with_an_illegal_part_is_illegal(change):
    action = {"pair": (6, {"bits": np.zeros(3, np.int8)}), "box": [0.5, 1]}
    for clips in (False, True):
        check = action_check(TREE, clips=clips)
        assert check(action) is not ILLEGAL
        assert check({**action, **change}) is ILLEGAL


def test_other_spaces_are_asked_themselves_and_actions_are_copied():
    given = np.array([1, 6])
    found = action_check(DIALS)(given)
    assert found.tolist() == [1, 6]
    assert found is not given
    assert action_check(WORDS)("word") == "word"
    assert action_check(SMALL)([10, 0]).dtype == np.uint8


@pytest.mark.parametrize(
    "given",
    [
        [1, 0, 1],
        np.array([1.0, 0.0, 1.0]),
        np.array([1, 0, 1], np.int8),
        np.array([[1, 9], [0, 9], [1, 9]], np.int8)[:, 0],
        np.array([True, False, True]),
    ],
    ids=repr,
)
def test_masks_are_new_arrays(given):
    found = mask_cast(DIAL)(given)
    assert found.tolist() == [1, 0, 1]
    assert found.dtype == np.int8
    found[:] = 0
    assert list(given) == [1, 0, 1]


@pytest.mark.parametrize(
    ("given", "match"),
    [
        ([1, 0], "shape"),
        ([[1, 0, 1]], "shape"),
        (1, "shape"),
        ([1, 2, 0], "other than 0 and 1"),
        ([0.5, 1, 0], "other than 0 and 1"),
        ([0, 0, 0], "no legal action"),
        ([1, 256, 0], "other than 0 and 1"),
        (np.array([1, 2, 1], np.int8), "other than 0 and 1"),
        (np.array([0, -1, 0], np.int8), "other than 0 and 1"),
        (np.array([False, False, False]), "no legal action"),
    ],
    ids=repr,
)
def test_invalid_masks_are_refused(given, match):
    with pytest.raises(MaskError, match=match):
        mask_cast(DIAL)(given)
    with pytest.raises(MaskError, match=match):
        mask_cast(DIALS)(([1, 1], given))


@pytest.mark.parametrize("given", [([1, 1],), ([1, 1], [1, 1, 1], [1]), np.ones((2, 3)), None], ids=str)
def test_masks_of_several_numbers_are_tuples(given):
    with pytest.raises(MaskError, match="2 parts"):
        mask_cast(DIALS)(given)
    found = mask_cast(DIALS)([[1, 0], [0, 1, 1]])
    assert type(found) is tuple
    assert [part.tolist() for part in found] == [[1, 0], [0, 1, 1]]


PAIRS = [(one, other) for one in (0, 1) for other in (4, 5, 6)]


def test_a_mask_allows_its_actions_and_an_open_one_allows_all():
    mask = np.array([0, 1, 0], np.int8)
    assert [mask_allows(DIAL, mask, action) for action in (5, 6, 7)] == [False, True, False]
    masks = (np.array([1, 0], np.int8), np.array([0, 0, 1], np.int8))
    assert [pair for pair in PAIRS if mask_allows(DIALS, masks, np.array(pair))] == [(0, 6)]
    assert open_mask(DIAL).tolist() == [1, 1, 1]
    assert open_mask(DIAL).dtype == np.int8
    assert [pair for pair in PAIRS if mask_allows(DIALS, open_mask(DIALS), np.array(pair))] == PAIRS
    assert open_mask(DIAL) is not open_mask(DIAL)
