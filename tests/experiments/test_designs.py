"""Which combinations of factors are run."""

import itertools
import sys
from fractions import Fraction

import numpy as np
import pydoe
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simenv_marl.errors import MissingExtraError, OptionValueError
from simenv_marl.experiments import design
from tests.extent import examples

SIZED = ("latin_hypercube", "sobol", "halton")
TWO_LEVELS = ("fractional_factorial", "plackett_burman")
METHODS = ("full_factorial", *TWO_LEVELS, *SIZED, "central_composite", "one_at_a_time", "saltelli")

ranges = st.one_of(
    st.tuples(st.integers(-50, 50), st.integers(1, 60)).map(
        lambda pair: (pair[0], pair[0] + pair[1])
    ),
    st.tuples(st.floats(-1e6, 1e6), st.floats(1e-3, 1e6)).map(
        lambda pair: (pair[0], pair[0] + pair[1])
    ),
)
levels = st.lists(
    st.one_of(st.integers(), st.booleans(), st.none(), st.text(max_size=3)),
    min_size=1,
    max_size=4,
    unique_by=lambda level: (type(level), level),
)
factors = st.dictionaries(
    st.text(min_size=1, max_size=3), st.one_of(ranges, levels), min_size=1, max_size=4
)


def allowed(value, given):
    if isinstance(given, tuple):
        whole = all(type(bound) is int for bound in given)
        return type(value) is (int if whole else float) and given[0] <= value <= given[1]
    return any(type(value) is type(level) and value == level for level in given)


def values(table, name):
    return table[name].tolist()


@examples(60)
@given(
    factors=factors,
    method=st.sampled_from(METHODS),
    n=st.sampled_from([2, 4, 8, 16]),
    seed=st.integers(0, 99),
)
def test_design_values_are_of_the_factors_and_repeatable(factors, method, n, seed):
    chosen = n if method in (*SIZED, "saltelli") else None
    try:
        table = design(factors, method, chosen, seed=seed)
    except OptionValueError:
        few = any(isinstance(given, list) and len(given) != 2 for given in factors.values())
        are_ranges = all(isinstance(given, tuple) for given in factors.values())
        is_surface = len(factors) > 1 and are_ranges
        assert (method in TWO_LEVELS and few) or (method == "central_composite" and not is_surface)
        return
    assert list(table.columns) == list(factors)
    for name, own in factors.items():
        assert all(allowed(value, own) for value in values(table, name)), (name, own)
    assert design(factors, method, chosen, seed=seed).equals(table)
    assert len(table) == n or method not in SIZED


@pytest.mark.parametrize("method", METHODS)
def test_design_columns_have_the_types_of_the_factors(method):
    factors = {
        "f": (0.0, 1),
        "i": (1, 9),
        "s": ["a", "b"],
        "b": [True, False],
        "o": ["a", 1],
        "n": [3, 1],
    }
    if method == "central_composite":
        factors = {name: own for name, own in factors.items() if isinstance(own, tuple)}
    table = design(factors, method, 4 if method in (*SIZED, "saltelli") else None)
    kinds = {"f": "f", "i": "i", "b": "b", "o": "O", "n": "i"}
    for name in table:
        assert name == "s" or table[name].dtype.kind == kinds[name]
        assert name != "s" or set(map(type, values(table, name))) == {str}
    assert all(
        allowed(value, given_) for name, given_ in factors.items() for value in values(table, name)
    )


def test_design_full_factorial_has_all_combinations():
    table = design({"a": [3, 1], "b": ["x", "y", "z"], "c": (0.0, 1.0)}, n=3)
    expected = list(itertools.product([3, 1], "xyz", [0.0, 0.5, 1.0]))
    assert list(table.itertuples(index=False, name=None)) == expected
    assert values(design({"c": (1, 2)}, n=9), "c") == [1, 2]
    assert values(design({"x": [1, True, 1.0, [1], (1,)]}), "x") == [1, True, 1.0, [1], (1,)]


@pytest.mark.parametrize(
    "bounds", [(0, 2**53), (-(2**53), 2**53), (1, 2**53 - 1), (-7, 7)], ids=str
)
def test_design_integer_ranges_stay_integers_and_reach_their_bounds(bounds):
    low, high = bounds
    for method, number in (
        ("full_factorial", 3),
        ("one_at_a_time", 3),
        ("latin_hypercube", 64),
        ("sobol", 64),
    ):
        found = values(design({"x": bounds}, method, number), "x")
        assert {type(value) for value in found} == {int}
        assert low <= min(found) < max(found) <= high
        assert "full" not in method or found == [low, round(Fraction(low + high, 2)), high]


@pytest.mark.parametrize(
    ("number", "n", "clear"),
    [
        (3, 4, 0),
        (4, 8, 1),
        (5, 8, 0),
        (5, 16, 1),
        (6, 16, 1),
        (7, 8, 0),
        (8, 16, 1),
        (15, 16, 0),
        (9, 128, 1),
    ],
)
def test_design_fractional_factorial_is_balanced_and_orthogonal(number, n, clear):
    table = design({f"x{place}": (-1, 1) for place in range(number)}, "fractional_factorial", n)
    matrix = table.to_numpy()
    assert len(table) == n
    assert (matrix.T @ matrix == n * np.eye(number)).all()
    assert (matrix.sum(axis=0) == 0).all()
    pairs = itertools.combinations(range(number), 2) if clear else ()
    assert not any((matrix.T @ (matrix[:, one] * matrix[:, other])).any() for one, other in pairs)


@pytest.mark.parametrize("number", [*range(1, 20), 24, 27])
def test_design_plackett_burman_is_orthogonal_in_few_runs(number):
    table = design({f"x{place}": (-1, 1) for place in range(number)}, "plackett_burman")
    matrix = table.to_numpy()
    assert len(table) % 4 == 0
    assert number < len(table) <= number + 8
    assert (matrix.T @ matrix == len(table) * np.eye(number)).all()


def test_design_latin_hypercube_has_one_row_in_each_slice():
    factors = {"f": (0.0, 10.0), "i": (1, 10), "s": list("abcde")}
    table = design(factors, "latin_hypercube", 10, seed=3)
    assert sorted(int(value) for value in table["f"]) == list(range(10))
    assert sorted(table["i"]) == list(range(1, 11))
    assert sorted(table["s"]) == sorted("aabbccddee")
    assert not table.equals(design(factors, "latin_hypercube", 10, seed=4))
    with pytest.raises(OptionValueError, match="seed"):
        design(factors, "latin_hypercube", 10, seed=-1)


def test_design_rounded_samples_stay_within_their_range():
    narrow = design({"x": (0.1, np.nextafter(0.1, 1))}, "latin_hypercube", 64)["x"]
    assert set(narrow) == {0.1, np.nextafter(0.1, 1)}


def test_design_one_at_a_time_changes_one_factor_per_row():
    table = design({"a": (0, 10), "b": ["x", "y", "z"], "c": (0.0, 1.0)}, "one_at_a_time")
    changed = [
        (0, "x", 0.5),
        (10, "x", 0.5),
        (5, "y", 0.5),
        (5, "z", 0.5),
        (5, "x", 0.0),
        (5, "x", 1.0),
    ]
    assert list(table.itertuples(index=False, name=None)) == [(5, "x", 0.5), *changed]


def test_design_central_composite_lies_within_the_ranges():
    table = design({"a": (0.0, 2.0), "b": (-4.0, 4.0)}, "central_composite")
    assert len(table) == 9
    assert (table.min().tolist(), table.max().tolist()) == ([0.0, -4.0], [2.0, 4.0])
    assert not table.duplicated().any()


THREE, LEVELS = {"a": (0, 1), "b": (0, 1), "c": (0, 1)}, {"a": [1, 2, 3], "b": (0, 1)}


def test_design_levels_can_be_arrays():
    one, other = np.zeros(2), np.ones(2)
    assert design({"start": [one, other]})["start"].tolist() == [one, other]


@pytest.mark.parametrize(
    ("match", "arguments"),
    [
        *(("must be a dict", (factors,)) for factors in ({}, [1])),
        ("has no levels", ({"a": []},)),
        *(("twice", ({"a": own},)) for own in ([1, 2, 1], [[1], [1]], [np.ones(2), np.ones(2)])),
        *(
            ("a tuple is a range", ({"a": own},))
            for own in ((1, 2, 3), ("x", "y"), (0.0, float("inf")))
        ),
        *(
            ("that a float can hold", ({"a": own},))
            for own in ((0, 2**53 + 1), (0, 10**5000), (0.5, 10**400))
        ),
        ("is empty", ({"a": (2, 2)},)),
        *(("must be a range", ({"a": own},)) for own in ("levels", 3, {"x", "y"}, frozenset([1]))),
        *(("method must be one of", ({"a": [1]}, method)) for method in ("best", ["sobol"])),
        ("needs n", ({"a": (0, 1)}, "sobol")),
        ("positive integer", ({"a": (0, 1)}, "sobol", 0)),
        *(("power of two", (THREE, "fractional_factorial", number)) for number in (6, 2, 16)),
        *(
            ("two levels", (LEVELS, method))
            for method in ("fractional_factorial", "plackett_burman")
        ),
        ("has 4 runs", ({"a": (0, 1)}, "plackett_burman", 8)),
        *(
            ("two ranges", (factors, "central_composite"))
            for factors in ({"a": [1, 2], "b": (0, 1), "c": (0, 1)}, {"a": (0, 1)})
        ),
        ("has 9 runs, not 18", ({"a": (0, 1), "b": (0, 1)}, "central_composite", 18)),
        ("more than 10,000,000", ({f"x{i}": (0, 1) for i in range(30)}, "central_composite")),
        ("more than 10,000,000", ({"a": (0, 1), "b": (0, 1)}, "saltelli", 2**22)),
        ("more than 10,000,000", ({"a": (0.0, 1.0)}, "full_factorial", 10**12)),
        ("more than 10,000,000", ({f"x{i}": list(range(100)) for i in range(4)},)),
    ],
)
def test_design_refuses_invalid_arguments(match, arguments):
    with pytest.raises(OptionValueError, match=match):
        design(*arguments)


def test_design_finds_pydoe_under_either_name_or_names_its_extra(monkeypatch):
    expected = design({"x": (0.0, 1.0)}, "plackett_burman")
    monkeypatch.setitem(sys.modules, "pyDOE", pydoe)  # its name in releases for older NumPy
    monkeypatch.setitem(sys.modules, "pydoe", None)
    assert design({"x": (0.0, 1.0)}, "plackett_burman").equals(expected)
    monkeypatch.setitem(sys.modules, "pyDOE", None)
    with pytest.raises(MissingExtraError, match=r"simenv-marl\[design\]"):
        design({"x": (0.0, 1.0)}, "plackett_burman")
