"""What factors do."""

import itertools
import math

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from simenv_marl.errors import OptionValueError
from simenv_marl.experiments import design, effects, run_experiment, sobol_indices
from tests.worlds.models import Script
from tests.worlds.valued import POINTS


def told(table, value, seeds=(1, 2)):
    """A table of results: of each row of a design a run with each seed, and what comes of both."""
    rows = [(row, seed) for row in table.to_dict("records") for seed in seeds]
    same = {"contender": "rule", "agent": "team", "length": 1, "status": "ok", "error": None}
    return pd.DataFrame(
        [{**row, **same, "seed": seed, "return": value(seed=seed, **row)} for row, seed in rows]
    )


def linear(a=0, b=0, c="x", seed=0):
    return a + 2 * b * (1 if c == "x" else 3)


def test_effects_and_interactions_match_a_known_model(tmp_path):
    def model(**row):
        return Script(lambda simulation: simulation.log.append(linear(**row)))

    table = design({"a": [0, 1], "b": (0.0, 1.0), "c": ["x", "y"]})
    given = {
        "metric": {"y": lambda simulation: simulation.log[0]},
        "points": POINTS,
        "seeds": [1, 2],
    }
    found = effects(run_experiment(model, table, store=tmp_path, **given), "y")
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


def test_effects_group_a_factor_with_many_values_into_quarters():
    found = effects(
        told(design({"a": (0.0, 1.0), "b": (0.0, 1.0), "c": ["x", "y"]}, "sobol", 64), linear)
    )
    assert found.main.loc["a"]["count"].tolist() == [32] * 4
    assert found.main.loc["b"]["mean"].is_monotonic_increasing
    slants = [
        [label.get_rotation() for label in axes.get_xticklabels()] for axes in found.plot().axes[:3]
    ]
    assert slants == [[30] * 4, [30] * 4, [0] * 2]  # names that are long do not run into each other
    found = effects(
        told(pd.DataFrame({"a": [0] * 36 + [*range(1, 10)]}), lambda a, seed: a + seed)
    ).main
    assert found["count"].tolist() == [76, 4, 4, 6]  # most of whose values are equal
    assert found["mean"].is_monotonic_increasing


def test_effects_treat_missing_values_of_a_factor_as_one_level():
    table = pd.DataFrame({"a": [0, 1, 0, 1], "b": 0.0, "c": [1.0, 1.0, math.nan, math.nan]})
    found = effects(told(table, lambda a, b, c, seed: a))
    assert found.main.loc["c"][["mean", "count"]].values.tolist() == [[0.5, 4], [0.5, 4]]
    assert found.cells("a", "c").to_numpy().tolist() == [[0, 0], [1, 1]]
    assert [label.get_text() for label in found.plot().axes[1].get_xticklabels()] == ["1", "nan"]


def test_effects_plot_draws_many_factors_in_rows():
    table = design({f"x{place}": [0, 1] for place in range(7)}, "plackett_burman")
    figure = effects(told(table, lambda seed, **row: sum(row.values()))).plot()
    drawn = [axes.get_xlabel() for axes in figure.axes if axes.get_visible()]
    assert drawn[:7] == list(table.columns)
    assert figure.get_figwidth() < 14


def test_sobol_indices_match_a_known_model():
    found = sobol_indices(told(design({"a": (0.0, 1.0), "b": (0.0, 1.0)}, "saltelli", 512), linear))
    assert list(found.index) == ["a", "b"]
    for column in ("first", "total"):
        assert found[column].tolist() == pytest.approx([0.2, 0.8], abs=0.03)


def test_effects_refuse_invalid_arguments():
    factors = {"a": (0.0, 1.0), "b": (0.0, 1.0)}
    frame = told(design(factors, "halton", 6), linear)
    whole, single = (told(design(factors, "saltelli", number), linear) for number in (2, 1))
    whole = whole.assign(text="x", equal=1.0, some=whole["return"].where(whole["a"] > 0.5))
    both = (effects, sobol_indices)
    for looks, tables, given, message in (
        (both, [None, frame["return"], frame[["a"]]], {}, "that run_experiment returned"),
        (both, [frame], {"confidence": 95}, "confidence must lie between 0 and 1"),
        (both, [whole], {"metric": "text"}, "'text' is not a column of numbers"),
        ([effects], [frame], {"metric": "a"}, "not a column of numbers"),
        ([effects], [frame], {"contender": "x"}, r"no contender 'x'; there are \['rule'\]"),
        ([sobol_indices], [frame], {}, "saltelli"),
        ([sobol_indices], [whole], {"metric": "some"}, "'some' is missing or not finite"),
        ([sobol_indices], [whole], {"metric": "equal"}, "no variance"),
        ([sobol_indices], [single], {}, "one sample tells nothing"),
    ):
        for look, table in itertools.product(looks, tables):
            with pytest.raises(OptionValueError, match=message):
                look(table, **given)


def test_effects_intervals_measure_variation_over_seeds_only():
    noise = {"quiet": 0, "still": 0, "loud": 4}
    table, value = (
        design({"a": list(noise), "b": [0, 1]}),
        lambda a, b, seed: 100 * b + noise[a] * (seed - 1.5),
    )
    found = effects(told(table, value, range(4))).main
    for a in ("quiet", "still"):
        assert found.loc[("a", a), "mean"] == 50
        assert found.loc[("a", a), ["low", "high"]].isna().all()  # the same on all seeds
    expected = stats.t.interval(0.95, 3, 50, stats.sem([44, 48, 52, 56]))
    assert found.loc[("a", "loud"), ["low", "high"]].tolist() == pytest.approx(expected)
    alone = effects(told(table, value, [1])).main
    assert alone.loc[("a", "quiet"), "low"] < 50 < alone.loc[("a", "quiet"), "high"]


def test_effects_on_proportions_have_wilson_intervals():
    found = effects(
        told(design({"a": [0, 1]}), lambda a, seed: float(seed < 3 * a), range(12))
    ).main
    for a in (0, 1):
        expected = stats.binomtest(3 * a, 12).proportion_ci(0.95, method="wilson")
        assert found.loc[("a", a), ["low", "high"]].tolist() == pytest.approx(list(expected))


def test_effects_refuse_equal_levels_of_different_types():
    frame = told(design({"a": [False, 0, 1.0], "b": ["x", "y"]}), lambda a, b, seed: seed)
    with pytest.raises(OptionValueError, match="'a' has levels that are equal"):
        effects(frame)
    found = effects(told(design({"a": ["x", 1, None]}), lambda a, seed: seed))
    assert found.levels["a"][:2] == ["x", 1]
    assert len(found.levels["a"]) == 3
    assert "_cells" not in repr(found)


def test_effects_mean_lies_in_its_interval_if_runs_have_failed():
    frame = told(
        design({"a": [0, 1], "b": [0, 1]}), lambda a, b, seed: 100 * b + seed / 10 + a, range(8)
    )
    frame.loc[(frame["b"] == 1) & (frame["seed"] > 0), ["status", "return"]] = ["error", np.nan]
    for _, row in effects(frame).main.loc["a"].iterrows():
        assert row["mean"] == pytest.approx((row["low"] + row["high"]) / 2)
