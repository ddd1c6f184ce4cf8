"""Faults of designs, stores, contenders and workers that were found by use, each as a row of a table."""

from fractions import Fraction

import pytest

from simenv_marl.errors import OptionValueError
from simenv_marl.experiments import design, sobol_indices
from tests.experiments.test_effects import results

# -- designs --------------------------------------------------------------------------------------


@pytest.mark.parametrize("bounds", [(0, 2**53 + 1), (-(2**63), 2**63 - 1), (0, 10**30), (-7, 7)], ids=str)
def test_whole_ranges_stay_whole_and_reach_their_bounds(bounds):
    low, high = bounds
    for method, number in (("full_factorial", 3), ("one_at_a_time", 3), ("latin_hypercube", 64), ("sobol", 64)):
        values = design({"x": bounds}, method, number)["x"].tolist()
        assert {type(value) for value in values} == {int}
        assert low <= min(values) < max(values) <= high
        assert "full" not in method or values == [low, round(Fraction(low + high, 2)), high]


def test_levels_are_compared_once(monkeypatch):
    class Level:
        compared = 0

        def __init__(self, number):
            self.number = number

        def __hash__(self):
            return self.number

        def __eq__(self, other):
            Level.compared += 1
            return self.number == other.number

    design({"x": [Level(number) for number in range(1000)]})
    assert Level.compared < 1000
    for twice in ([Level(1), Level(1)], [[1], [1]], [1, 2, 1]):
        with pytest.raises(OptionValueError, match="twice"):
            design({"x": twice})
    assert design({"x": [1, True, 1.0, [1], (1,)]})["x"].tolist() == [1, True, 1.0, [1], (1,)]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (({"x": (0, 10**5000)},), "that a float can hold"),
        (({"x": (0.5, 10**400)},), "that a float can hold"),
        (({"x": (0.0, 1.0)}, "full_factorial", 10**12), "rows"),
    ],
)
def test_designs_that_cannot_be_are_refused_with_reasons(arguments, message):
    with pytest.raises(OptionValueError, match=message):
        design(*arguments)


def test_one_sample_has_no_shares(tmp_path):
    frame = results(design({"a": (0.0, 1.0), "b": (0.0, 1.0)}, "saltelli", 1), tmp_path)
    with pytest.raises(OptionValueError, match="one sample tells nothing"):
        sobol_indices(frame, "y")
