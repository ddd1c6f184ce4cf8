"""Intervals that cover what they say, by one rule wherever an interval is shown."""

import numpy as np
import pandas as pd
import pytest
from statsmodels.stats.power import TTestPower
from tools.coverage_of_intervals import measure

from simenv_marl.data import plot_returns
from simenv_marl.data.plots import is_proportion
from simenv_marl.experiments import Evaluation, effects
from tests.data.test_plots import paid_by_seed


def table(**returns):
    """A table of the team's returns of contenders, by seed."""
    return pd.DataFrame(
        {"contender": name, "seed": seed, "agent": "team", "return": value, "length": 1, "status": "ok", "error": None}
        for name, values in returns.items()
        for seed, value in enumerate(values)
    )


@pytest.mark.parametrize("number", [5, 16])
@pytest.mark.parametrize(("name", "least"), [("normal", 0.93), ("lognormal", 0.78), ("0/1, p=0.5", 0.9)])
def test_intervals_cover_and_equal_contenders_seldom_differ(name, least, number):
    covered, unknown, different = measure(name, number, 600)
    assert covered > least
    assert unknown < 0.02
    assert different < 0.08


def test_events_that_were_not_seen_have_no_interval_of_zero_width():
    covered, unknown, _ = measure("0/1, p=0.1", 5, 600)
    assert covered > 0.8  # of those that are known; with Student's t it was 0.4
    assert 0.25 < unknown < 0.45


@pytest.mark.parametrize("confidence", [0.8, 0.95])
@pytest.mark.parametrize(("size", "power"), [(0.1, 0.5), (0.5, 0.8), (1.5, 0.99)])
def test_the_number_of_seeds_is_that_of_the_paired_t_test(size, power, confidence):
    apart = np.random.default_rng(1).normal(size=20)
    found = Evaluation(table(a=np.zeros(20), b=apart), "a", confidence)
    expected = TTestPower().solve_power(effect_size=size, alpha=1 - confidence, power=power)
    assert found.seeds_needed(size * apart.std(ddof=1), power=power)["b"] == np.ceil(expected)


@pytest.mark.parametrize(("factor", "number"), [(1e3, 2), (1e15, 2), (1e-12, np.inf)])
def test_differences_that_are_far_too_large_or_small_have_a_number_of_seeds(factor, number):
    found = Evaluation(table(a=[0, 0, 0], b=[1, 2, 3]), "a", 0.95)
    assert found.seeds_needed(factor)["b"] == number


@pytest.mark.parametrize("values", [[1, 0, None], [True, False, None], [True, True], [np.nan, 1.0, 0.0]])
def test_missing_values_do_not_hide_a_proportion(values):
    assert is_proportion(np.array(values))
    assert not is_proportion(np.array([*values, 2], object))


def test_plots_of_returns_show_the_intervals_of_the_summary():
    for seeds, expected in ((paid_by_seed(1), [2, 4, 12]), (paid_by_seed(1, 0.0), [0, 0, 0])):
        summary = Evaluation(table(a=np.array(expected)), None, 0.95).summary().loc["a"]
        text = plot_returns(seeds).axes[0].texts[0].get_text()
        bounds = f"  [{summary['low']:.4g}, {summary['high']:.4g}]" if summary["low"] == summary["low"] else ""
        assert text == f"{summary['mean']:.4g}{bounds}"


# -- effects --------------------------------------------------------------------------------------


def runs(rows):
    """A table of results, of rows with a level ``a``, a seed, a return, and perhaps more."""
    told = {"contender": "rule", "agent": "team", "length": 1, "status": "ok", "error": None}
    return pd.DataFrame([{"a": a, **more, **told, "seed": seed, "return": value} for a, seed, value, more in rows])


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
