"""What factors do."""

import itertools
import math

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from simenv_marl.errors import OptionValueError
from simenv_marl.experiments import design, effects, run_experiment, sobol_indices
from tests.worlds.shops import POINTS


class Sum:
    def __init__(self, a, b, c="x", noise=0.0):
        self.a, self.b, self.c, self.noise = a, b, c, noise

    def reset(self, seed):
        self.generator = np.random.default_rng(seed)

    def run(self):
        self.y = self.a + 2 * self.b * (1 if self.c == "x" else 3) + self.noise * self.generator.normal()


def results(table, store, make=Sum, **arguments):
    given = {"metric": {"y": lambda s: s.y}, "points": POINTS, "seeds": [1, 2], **arguments}
    return run_experiment(make, table, store=store, **given)


def labels(axes):
    return [label.get_text() for label in axes.get_xticklabels()]


def test_main_effects_and_interactions_are_those_of_the_model(tmp_path):
    found = effects(results(design({"a": [0, 1], "b": (0.0, 1.0), "c": ["x", "y"]}), tmp_path), "y")
    assert list(found.main.columns) == ["mean", "low", "high", "effect", "count"]
    for factor, difference in (("a", 1), ("b", 4)):
        low, high = found.main.loc[factor]["effect"]
        assert high - low == pytest.approx(difference)
    strengths = found.interactions["strength"]
    assert strengths.index[0] == ("b", "c")
    assert strengths.tolist() == pytest.approx([1, 0, 0], abs=1e-9)
    cells = found.cells("b", "c")
    assert (cells.loc[1.0, "y"] - cells.loc[1.0, "x"]) == pytest.approx(4)
    assert found.cells("c", "b").equals(cells.T)
    panels = found.plot().axes
    assert sum(axes.get_visible() for axes in panels) == 4
    assert len({axes.get_ylim() for axes in panels[:3]}) == 1  # main effects can be compared
    with pytest.raises(OptionValueError, match="not two factors"):
        found.cells("a", "z")


def test_many_numbers_are_grouped(tmp_path):
    table = design({"a": (0.0, 1.0), "b": (0.0, 1.0), "c": ["x", "y"]}, "sobol", 64)
    found = effects(results(table, tmp_path), "y")
    assert found.main.loc["a"]["count"].tolist() == [32] * 4
    assert found.main.loc["b"]["mean"].is_monotonic_increasing
    slants = [[label.get_rotation() for label in axes.get_xticklabels()] for axes in found.plot().axes[:3]]
    assert slants == [[30] * 4, [30] * 4, [0] * 2]  # names that are long do not run into each other


def test_all_that_is_missing_is_one_level(tmp_path):
    table = pd.DataFrame({"a": [0, 1, 0, 1], "b": 0.0, "c": [1.0, 1.0, math.nan, math.nan]})
    found = effects(results(table, tmp_path), "y")
    assert found.main.loc["c"][["mean", "count"]].values.tolist() == [[0.5, 4], [0.5, 4]]
    assert found.cells("a", "c").to_numpy().tolist() == [[0, 0], [1, 1]]
    assert labels(found.plot().axes[1]) == ["1", "nan"]


def test_many_factors_are_drawn_in_rows(tmp_path):
    table = design({f"x{place}": [0, 1] for place in range(7)}, "plackett_burman")
    figure = effects(results(table, tmp_path, lambda **row: Sum(sum(row.values()), 0), seeds=[1]), "y").plot()
    drawn = [axes.get_xlabel() for axes in figure.axes if axes.get_visible()]
    assert drawn[:7] == list(table.columns)
    assert figure.get_figwidth() < 14


def test_sobol_indices_are_those_of_the_model(tmp_path):
    found = sobol_indices(results(design({"a": (0.0, 1.0), "b": (0.0, 1.0)}, "saltelli", 512), tmp_path), "y")
    assert list(found.index) == ["a", "b"]
    for column in ("first", "total"):
        assert found[column].tolist() == pytest.approx([0.2, 0.8], abs=0.03)


def test_invalid_arguments_are_refused(tmp_path):
    factors = {"a": (0.0, 1.0), "b": (0.0, 1.0)}
    frame = results(design(factors, "sobol", 6), tmp_path)
    odd = {"text": lambda s: "x", "some": lambda s: s.y if s.a > 0.5 else None}
    whole = results(design(factors, "saltelli", 2), tmp_path / "odd", metric=odd)
    single = results(design(factors, "saltelli", 1), tmp_path / "single")
    both = (effects, sobol_indices)
    for looks, tables, given, message in (
        (both, [None, frame["y"], frame[["a"]]], {}, "that run_experiment returned"),
        (both, [frame], {"metric": "y", "confidence": 95}, "confidence must lie between 0 and 1"),
        (both, [whole], {"metric": "text"}, "'text' is not a column of numbers"),
        ([effects], [frame], {"metric": "a"}, "not a column of numbers"),
        ([effects], [frame], {"metric": "y", "contender": "x"}, r"no contender 'x'; there are \['rule'\]"),
        ([sobol_indices], [frame], {"metric": "y"}, "saltelli"),
        ([sobol_indices], [whole], {"metric": "some"}, "'some' is missing or not finite"),
        ([sobol_indices], [whole], {"metric": "return"}, "no variance"),
        ([sobol_indices], [single], {"metric": "y"}, "one sample tells nothing"),
    ):
        for look, table in itertools.product(looks, tables):
            with pytest.raises(OptionValueError, match=message):
                look(table, **given)


def runs(rows):
    """A table of results, of rows with a level ``a``, a seed, a return, and perhaps more factors."""
    told = {"contender": "rule", "agent": "team", "length": 1, "status": "ok", "error": None}
    return pd.DataFrame([{"a": a, **more, **told, "seed": seed, "return": value} for a, seed, value, more in rows])


def test_intervals_are_over_seeds_and_not_over_what_other_factors_do():
    rows = [
        (a, seed, 100 * b + noise * (seed - 1.5), {"b": b})
        for a, noise in (("quiet", 0), ("still", 0), ("loud", 4))
        for b in (0, 1)
        for seed in range(4)
    ]
    found = effects(runs(rows)).main
    for a in ("quiet", "still"):
        assert found.loc[("a", a), "mean"] == 50
        assert found.loc[("a", a), ["low", "high"]].isna().all()  # the same on all seeds
    expected = stats.t.interval(0.95, 3, 50, stats.sem([44, 48, 52, 56]))
    assert found.loc[("a", "loud"), ["low", "high"]].tolist() == pytest.approx(expected)
    alone = effects(runs([own for own in rows if own[1] == 1])).main
    assert alone.loc[("a", "quiet"), "low"] < 50 < alone.loc[("a", "quiet"), "high"]


def test_shares_have_the_intervals_of_shares():
    found = effects(runs([(a, seed, float(seed < 3 * a), {}) for a in (0, 1) for seed in range(12)])).main
    for a in (0, 1):
        expected = stats.binomtest(3 * a, 12).proportion_ci(0.95, method="wilson")
        assert found.loc[("a", a), ["low", "high"]].tolist() == pytest.approx(list(expected))


def test_a_numeric_factor_most_of_whose_values_are_equal_is_grouped():
    found = effects(runs([(a, seed, a + seed, {}) for a in [0] * 36 + [*range(1, 10)] for seed in range(2)])).main
    assert found["count"].tolist() == [76, 4, 4, 6]
    assert found["mean"].is_monotonic_increasing


def test_levels_that_are_equal_but_of_other_types_stay_apart():
    levels = [False, 0, True, 1, 1.0]
    frame = runs([(a, seed, 10 * place + seed, {"b": b}) for place, a in enumerate(levels)
                  for b in "xy" for seed in range(2)])  # fmt: skip
    frame["a"] = np.repeat(np.array(levels, object), 4)
    found = effects(frame)
    assert found.main.loc["a", "mean"].to_dict() == {"False": 0.5, "0": 10.5, "True": 20.5, "1": 30.5, "1.0": 40.5}
    assert [repr(level) for level in found.levels["a"]] == [repr(level) for level in levels]
    assert found.cells("a", "b").loc["1.0"].tolist() == [40.5, 40.5]
    assert "_cells" not in repr(found)


def test_the_mean_lies_in_its_interval_where_runs_have_failed():
    frame = runs([(a, seed, 100 * b + seed / 10 + a, {"b": b}) for a in (0, 1) for b in (0, 1) for seed in range(8)])
    frame.loc[(frame["b"] == 1) & (frame["seed"] > 0), ["status", "return"]] = ["error", np.nan]
    for _, row in effects(frame).main.loc["a"].iterrows():
        assert row["mean"] == pytest.approx((row["low"] + row["high"]) / 2)
