"""Contenders on the same seeds."""

import sys
import threading
from collections import Counter
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from statsmodels.stats.power import TTestPower
from tools.coverage_of_intervals import measure

from simenv_marl import RULE, aec_env, evaluate, simulate
from simenv_marl.data import Mixture
from simenv_marl.data.plots import interval, is_proportion
from simenv_marl.decision import decision_points
from simenv_marl.errors import AgentError, MissingExtraError, OptionValueError, UnknownPointError
from simenv_marl.experiments import Evaluation, Variant
from simenv_marl.planning import RolloutPolicy
from tests.processes import run_code
from tests.worlds.entities import Colony, ColonyDesign, colony_points
from tests.worlds.models import EVERY_DRIVER, fails, play
from tests.worlds.valued import NEAR, POINTS, Shop, level, much, much_of_many, some

SEEDS = range(12)
CONTENDERS = {"rule": {}, "much": {"keeper": much}}


def of_teams(**returns):
    """A table of the team's returns of contenders, by seed."""
    return pd.DataFrame(
        {"contender": name, "seed": seed, "agent": "team", "return": value, "length": 1}
        for name, values in returns.items()
        for seed, value in enumerate(values)
    )


def returns_by_hand(policies, seed, make=Shop, points=POINTS, **options):
    found = Counter()

    def decide(agent, env):
        return policies[agent](env.observe(agent)) if agent in policies else RULE

    for turn in play(aec_env(make, points, **options), decide, seed=seed):
        found[turn.agent] += turn.reward
    return found


def test_evaluate_frame_has_a_row_for_each_agent_and_the_team():
    found = evaluate(Shop, CONTENDERS, seeds=SEEDS, points=POINTS, metric={"level": level})
    frame = found.frame
    assert list(frame.columns) == ["contender", "seed", "agent", "return", "length", "level"]
    assert len(frame) == 2 * len(SEEDS) * 3
    for name, policies in CONTENDERS.items():
        for seed in SEEDS:
            rows = frame[(frame.contender == name) & (frame.seed == seed)].set_index("agent")
            assert list(rows.index) == ["keeper", "helper", "team"]
            expected = returns_by_hand(policies, seed)
            assert rows.loc[["keeper", "helper"], "return"].to_dict() == expected
            assert rows.loc["team", "return"] == sum(expected.values())
            assert rows["length"].to_dict() == {"keeper": 3, "helper": 3, "team": 6}
            assert set(rows["level"]) == {simulate(Shop, policies, points=POINTS, seed=seed).level}


COLONY = ColonyDesign(initial=3, most=8, ticks=4, overseen="before", truncates=True)


def by_number(observation):
    return int(abs(observation.sum())) % 6


@pytest.mark.filterwarnings("ignore:policies= or possible_agents= name agents that did not appear")
@EVERY_DRIVER
@pytest.mark.parametrize("options", [{}, {"max_steps": 5}], ids=str)
@pytest.mark.parametrize("batched", [False, True])
def test_evaluate_returns_match_aec_env_with_births_and_deaths(batched, options):
    def make():
        return Colony(COLONY)

    points, seeds = colony_points(overseen=True), range(8)
    policies = dict.fromkeys(("creature_0", "creature_4", "overseer_0"), by_number)
    of_many = dict.fromkeys(policies, lambda observations: list(map(by_number, observations)))
    contenders = {"rule": {}, "some": of_many if batched else policies}
    given = {"points": points, "possible_agents": ["creature_4"], "batched": batched, **options}
    found = evaluate(make, contenders, seeds=seeds, baseline="rule", **given)
    for (name, seed), rows in found.frame.groupby(["contender", "seed"]):
        returns = dict(zip(rows["agent"], rows["return"], strict=True))
        total = returns.pop("team")
        expected = returns_by_hand(
            {} if name == "rule" else policies, seed, make, points, **options
        )
        assert returns == {agent: value for agent, value in expected.items() if agent in returns}
        assert not any(value for agent, value in expected.items() if agent not in returns)
        assert total == pytest.approx(sum(returns.values()))
    sizes = found.frame.groupby(["contender", "seed"]).size()
    assert len(sizes) == 16
    assert sizes.nunique() > 1
    assert np.isfinite(found.summary().to_numpy()).all()


@pytest.mark.parametrize("arguments", [{}, {"workers": 2}, {"batched": True}], ids=str)
def test_evaluate_runs_planning_policies_as_simulate_does(arguments):
    planner = RolloutPolicy([0, 1, 2], futures=2, horizon=1, method="replay")
    contenders = {"one": {"helper": planner}, "both": {"keeper": planner, "helper": planner}}
    found = evaluate(
        Shop, contenders, seeds=range(2), points=NEAR, metric=level, **arguments
    ).values("metric")
    for name, policies in contenders.items():
        assert found[name].tolist() == [
            simulate(Shop, policies, points=NEAR, seed=seed).level for seed in range(2)
        ]


MIXED = {
    "mixed": {"keeper": Mixture({RULE: 0.5, much_of_many: 0.5})},
    "much": {"keeper": much_of_many},
}


@pytest.mark.parametrize("workers", [0, 2])
def test_evaluate_runs_a_mixture_as_simulate_many_does(workers, capsys):
    found = evaluate(
        Shop, MIXED, seeds=SEEDS, points=POINTS, batched=True, workers=workers, progress=True
    )
    assert "24/24" in capsys.readouterr().err
    values, alone = found.values(), evaluate(Shop, CONTENDERS, seeds=SEEDS, points=POINTS).values()
    assert values["much"].equals(alone["much"])
    assert (values["mixed"] <= values["much"]).all()
    assert values["mixed"].mean() < values["much"].mean() - 2
    sizes = []
    many = {"keeper": lambda seen: sizes.append(len(seen)) or much_of_many(seen)}
    evaluate(Shop, {"a": many}, seeds=SEEDS, points=POINTS, batched=True)
    assert max(sizes) == len(SEEDS)


@pytest.mark.parametrize("confidence", [0.8, 0.95])
def test_evaluate_summary_is_paired_by_seed(confidence):
    contenders = {"rule": {}, "some": {"keeper": some}}
    given = {"points": POINTS, "confidence": confidence}
    found = evaluate(Shop, contenders, seeds=range(32), baseline="rule", **given)
    summary, values = found.summary(), found.values()
    assert summary.index.name == "contender"
    assert list(summary.index) == ["rule", "some"]
    assert list(summary.columns) == [
        "mean",
        "low",
        "high",
        "difference",
        "difference_low",
        "difference_high",
    ]
    assert summary.loc["rule", ["difference", "difference_low", "difference_high"]].tolist() == [
        0.0,
        0.0,
        0.0,
    ]
    assert summary.loc["some", "difference"] == pytest.approx(
        (values["some"] - values["rule"]).mean()
    )
    expected = stats.ttest_rel(values["some"], values["rule"]).confidence_interval(confidence)
    assert summary.loc["some", ["difference_low", "difference_high"]].tolist() == pytest.approx(
        list(expected)
    )
    expected = stats.ttest_1samp(values["some"], 0).confidence_interval(confidence)
    assert summary.loc["some", ["low", "high"]].tolist() == pytest.approx(list(expected))
    assert list(evaluate(Shop, CONTENDERS, seeds=[1, 2], **given).summary().columns) == [
        "mean",
        "low",
        "high",
    ]
    assert np.isnan(evaluate(Shop, CONTENDERS, seeds=[1], **given).summary()["low"]).all()


@pytest.mark.parametrize(
    ("values", "note", "proportion"),
    [
        *(
            (values, "a single", proportion)
            for values in ([], [1.0])
            for proportion in (False, True)
        ),
        *(
            ([1.0, odd], "missing", proportion)
            for odd in (np.nan, np.inf)
            for proportion in (False, True)
        ),
        *((equal, "equal", False) for equal in ([2.0] * 5, [0.1 + 0.2, 0.3, 0.3], [0.0, 0.0])),
    ],
)
def test_evaluate_interval_is_nan_with_a_reason_if_it_has_no_value(values, note, proportion):
    low, high, why = interval(np.array(values), 0.95, proportion=proportion)
    assert np.isnan([low, high]).all()
    assert note in why


@pytest.mark.thorough
@pytest.mark.parametrize("number", [5, 16])
@pytest.mark.parametrize(
    ("name", "least"), [("normal", 0.93), ("lognormal", 0.78), ("0/1, p=0.5", 0.9)]
)
def test_evaluate_intervals_cover_the_true_mean(name, least, number):
    covered, unknown, different = measure(name, number, 600)
    assert covered > least
    assert unknown < 0.02
    assert different < 0.08


def test_evaluate_gives_no_zero_width_interval_for_unseen_events():
    covered, unknown, _ = measure("0/1, p=0.1", 5, 600)
    assert covered > 0.8  # of those that are known; with Student's t it was 0.4
    assert 0.25 < unknown < 0.45


def test_evaluate_summary_notes_missing_intervals_and_counts_ties_half():
    contenders = {"a": {}, "same": {}, "some": {"keeper": some}, "much": {"keeper": much}}
    found = evaluate(
        Shop, contenders, seeds=SEEDS, points=POINTS, baseline="a", metric={"one": lambda shop: 1}
    )
    summary, equal = found.summary(), "differences: all are equal"
    assert summary.loc["a", ["difference", "difference_low", "difference_high"]].tolist() == [
        0,
        0,
        0,
    ]
    assert summary.loc["same", ["difference_low", "difference_high"]].isna().all()
    assert summary["note"].to_dict() == {"a": "", "same": equal, "some": "", "much": equal}
    assert set(found.summary("one")["note"]) == {"all are equal"}
    assert np.isnan(found.seeds_needed(1.0)["same"])
    assert f"{summary['mean']['much']:.4g}" in str(found).splitlines()[4]
    assert "more than a" in str(found).splitlines()[0]
    assert equal in str(found)
    improvement = found.improvement()
    assert improvement["probability"][["same", "much"]].tolist() == [0.5, 1.0]
    expected = stats.binomtest(12, 12).proportion_ci(0.95, method="wilson")
    assert improvement.loc["much", ["low", "high"]].tolist() == pytest.approx(list(expected))
    assert improvement.loc["same", ["low", "high"]].isna().all()
    found = evaluate(Shop, contenders, seeds=[1], points=POINTS)
    assert set(found.summary()["note"]) == {"a single value"}
    found.plot()


def test_evaluate_gives_proportions_wilson_intervals():
    some_seeds = np.arange(12) < 3
    wilson = stats.binomtest(3, 12).proportion_ci(0.95, method="wilson")
    student = stats.ttest_1samp(2.0 * some_seeds, 0).confidence_interval(0.95)
    for values, expected in (
        (some_seeds, wilson),
        (some_seeds.astype(int), wilson),
        (2 * some_seeds, student),
    ):
        low, high = Evaluation(of_teams(a=values), None, 0.95).summary().loc["a", ["low", "high"]]
        assert (low, high) == pytest.approx(tuple(expected))
    for values in ([1, 0, None], [True, False, None], [True, True], [np.nan, 1.0, 0.0]):
        assert is_proportion(np.array(values))
        assert not is_proportion(np.array([*values, 2], object))


@pytest.mark.parametrize("confidence", [0.8, 0.95])
@pytest.mark.parametrize(("size", "power"), [(0.1, 0.5), (0.5, 0.8), (1.5, 0.99)])
def test_evaluate_seeds_needed_match_a_paired_t_test(size, power, confidence):
    apart = np.random.default_rng(1).normal(size=20)
    found = Evaluation(of_teams(a=np.zeros(20), b=apart), "a", confidence)
    expected = TTestPower().solve_power(effect_size=size, alpha=1 - confidence, power=power)
    assert found.seeds_needed(size * apart.std(ddof=1), power=power)["b"] == np.ceil(expected)


def test_evaluate_seeds_needed_are_bounded():
    returns = of_teams(a=[0, 0, 0], b=[1, 2, 3], same=[0, 0, 0])
    found = Evaluation(returns, "a", 0.95)
    for difference, number in ((1e3, 2), (1e15, 2), (1e-12, np.inf)):
        assert found.seeds_needed(difference)["b"] == number
        assert np.isnan(found.seeds_needed(difference)["same"])
    for wrong, difference, power in (
        ("diff", 0, 0.8),
        ("diff", "a", 2),
        ("power", 1, 1),
        ("power", 1, "a"),
    ):
        with pytest.raises(OptionValueError, match=f"^{wrong}"):
            found.seeds_needed(difference, power=power)
    with pytest.raises(OptionValueError, match="no baseline"):
        Evaluation(returns, None, 0.95).seeds_needed(1)


def test_evaluate_stops_as_soon_as_intervals_are_narrow_enough():
    def seeds_run(contenders, number, **given):
        return len(evaluate(Shop, contenders, seeds=range(number), points=POINTS, **given).values())

    some_of_both = {"rule": {}, "some": {"keeper": some}}
    assert seeds_run(some_of_both, 400, baseline="rule", width=1e9) == 16
    assert seeds_run(CONTENDERS, 40, baseline="rule", width=1e9) == 40  # all differences are equal
    assert seeds_run({"rule": {}}, 40, width=1e-9) == 40
    found = evaluate(Shop, {"rule": {}}, seeds=range(400), points=POINTS, width=2.0)
    summary = found.summary()
    assert 16 < len(found.values()) < 400
    assert float((summary["high"] - summary["low"]).iloc[0]) <= 2.0


def test_evaluate_team_argument_computes_the_return_of_the_team():
    def team(returns):
        assert "keeper" in returns
        assert "stranger" not in returns
        assert dict(returns)["keeper"] == returns["keeper"] == max(returns) == np.max(returns)
        return returns.get("stranger", returns["keeper"])

    found = evaluate(Shop, {"much": {"keeper": much}}, seeds=[1], points=POINTS, team=team)
    rows = found.frame.set_index("agent")["return"]
    assert rows["team"] == rows["keeper"] > rows["helper"]


# As joblib closes, loky's thread may find that tasks which it has cancelled are gone.
@pytest.mark.filterwarnings(
    "ignore:Exception in thread ExecutorManager:pytest.PytestUnhandledThreadExceptionWarning"
)
@pytest.mark.parametrize(
    "arguments", [{}, {"workers": 2}, {"batched": True, "batch_size": 1}], ids=str
)
@pytest.mark.parametrize(
    ("match", "contender", "keeper", "given"),
    [
        (
            "'stranger' did not decide .*: keeper, helper",
            "rule",
            much,
            {"team": lambda returns: returns["stranger"]},
        ),
        ("stranger", "bad", lambda seen: {}["stranger"], {}),
    ],
    ids=["team", "policy"],
)
def test_evaluate_raises_errors_at_once_and_names_the_seed(
    match, contender, keeper, given, arguments
):
    with fails(KeyError, "seed 0", f"of the contender '{contender}'", match=match):
        evaluate(
            Shop,
            {"rule": {}, "bad": {"keeper": keeper}},
            seeds=SEEDS,
            points=POINTS,
            **given,
            **arguments,
        )


def test_evaluate_uses_a_variants_points_and_policies():
    variant = Variant("v", Shop, points=POINTS, parameters={"days": 2}, policies={"keeper": much})
    frame = evaluate(variant, {"rule": {}}, seeds=SEEDS, metric=level).frame
    assert "error" not in frame, set(frame["error"])
    # for the keeper a policy decides, which is no contender's
    assert set(frame["agent"]) == {"helper", "team"}
    expected = [
        simulate(Shop(2), {"keeper": much}, points=POINTS, seed=seed).level for seed in SEEDS
    ]
    assert frame[frame.agent == "team"]["metric"].tolist() == expected


def test_evaluate_plot_shows_each_seed():
    def drawn(contenders, seeds, **given):
        return evaluate(Shop, contenders, seeds=seeds, points=POINTS, metric=level, **given)

    values, differences = drawn(CONTENDERS, SEEDS, baseline="rule").plot("metric").axes
    assert sum(len(line.get_xdata()) == 2 for line in values.lines) == len(SEEDS)
    assert len(differences.collections[0].get_offsets()) == len(SEEDS)
    assert values.get_axisbelow() is True  # the grid
    figure = drawn({f"the contender of number {number}": {} for number in range(20)}, [1]).plot()
    assert figure.get_figwidth() <= 14
    assert {label.get_rotation() for label in figure.axes[0].get_xticklabels()} == {30}
    assert figure.axes[0].get_title(loc="left") == "1 seed"
    assert drawn({"rule": {}}, SEEDS).plot().axes[0].get_title(loc="left") == "12 seeds, each a dot"
    axes = drawn(CONTENDERS, range(201)).plot("metric").axes[0]
    assert (axes.get_title(loc="left"), axes.get_ylabel()) == (
        "201 seeds, lines for 200 of them",
        "metric",
    )
    assert sum(len(line.get_xdata()) == 2 for line in axes.lines) == 200
    assert {label.get_rotation() for label in axes.get_xticklabels()} == {0}


def returning(what):
    return lambda observation: what


@pytest.mark.parametrize(
    ("match", "arguments"),
    [
        *((match, {"contenders": contenders}) for match, contenders in (
            ("there are none", {}),
            ("must be a dict", [much]),
            ("must be a string", {1: {}}),
            ("must be a dict from agents", {"a": much}),
            ("must be a callable", {"a": {"keeper": 3}}),
            ("stranger", {"rule": {}, "a": {"stranger": much}}),
        )),
        ("baseline 'x' is not one of the contenders: rule, much", {"baseline": "x"}),
        ("is not one of the contenders", {"baseline": ["rule"]}),
        ("there are none", {"seeds": []}),
        ("seed 3 occurs twice", {"seeds": [3, 4, 3]}),
        ("iterable of integers", {"seeds": 3}),
        *(("confidence", {"confidence": confidence}) for confidence in (1.0, "much")),
        ("width", {"width": 0}),
        ("team", {"team": "sum"}),
        ("metric", {"metric": "level"}),
        ("has the name of another column", {"metric": {"seed": level}}),
        ("workers", {"workers": -2}),
        ("policies of each contender", {"policies": {}}),
        ("pickle", {"contenders": {"a": {"keeper": returning(threading.Lock())}}, "workers": 1}),
        ("of 'keeper' in 'mixed', <Mixture.*batched=True", {"contenders": MIXED}),
    ],
)  # fmt: skip
def test_evaluate_refuses_invalid_arguments_before_it_runs(match, arguments):
    made = []
    given = {"contenders": CONTENDERS, "seeds": SEEDS, "points": POINTS, **arguments}
    with pytest.raises((OptionValueError, UnknownPointError, TypeError), match=match):
        evaluate(lambda: made.append(1) or Shop(), **given)
    assert len(made) <= len(POINTS)  # looked at, and not run


def test_evaluate_refuses_an_agent_called_team():
    points = {Shop.order: replace(POINTS[Shop.order], agent="team")}
    with pytest.raises(AgentError, match="team"):
        evaluate(Shop, {"rule": {}}, seeds=[1], points=points)


def test_evaluate_metrics_are_numbers_strings_or_none():
    metrics = {
        "float": lambda shop: np.float32(0.5),
        "array": lambda shop: np.array(3),
        "some": lambda shop: shop.seed or None,
        "text": lambda shop: "a" if shop.seed else None,
        "huge": lambda shop: 10**400,  # which no float can hold
    }
    found = evaluate(Shop, CONTENDERS, seeds=[0, 1], points=POINTS, metric=metrics, baseline="rule")
    expected = {"float": [0.5, 0.5], "array": [3, 3], "huge": [10**400] * 2}
    team = found.frame[(found.frame["agent"] == "team") & (found.frame["contender"] == "rule")]
    assert {name: team[name].tolist() for name in expected} == expected
    assert team["text"].isna().tolist() == [True, False]
    assert team["text"].tolist()[1] == "a"
    assert team["some"].dtype == np.float64
    assert np.isnan(found.summary("some")["mean"]).all()
    for look in (
        found.summary,
        found.improvement,
        found.plot,
        lambda metric: found.seeds_needed(1, metric=metric),
    ):
        for metric in ("text", "huge"):
            with pytest.raises(OptionValueError, match=f"'{metric}' is not a column of numbers"):
                look(metric=metric)
    with pytest.raises(OptionValueError, match="metric 'x' must be a number, a string or None"):
        evaluate(Shop, {"rule": {}}, seeds=[1], points=POINTS, metric={"x": lambda shop: [1]})


def test_evaluate_error_names_the_extra_of_a_missing_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingExtraError, match=r"simenv-marl\[experiments\]"):
        evaluate(Shop, {"rule": {}}, seeds=[1], points=POINTS)


def test_importing_the_library_does_not_import_optional_dependencies():
    names = {"pandas", "scipy.stats", "pydoe", "SALib", "simenv_marl.testing"}
    assert run_code(f"import sys, simenv_marl; print({names} & sys.modules.keys())") == "set()\n"


def test_evaluate_frame_has_one_row_for_an_agent_with_two_decision_points(monkeypatch):
    class Doubled(Shop):
        order, sell = map(NEAR[Shop.order], (Shop.order, Shop.sell))

    own = [name for name in decision_points() if name.startswith("tests.")]
    # without those of studies
    monkeypatch.setattr("simenv_marl.core.plans.points.decision_points", lambda: own)
    frame = evaluate(Doubled, {"rule": {}}, seeds=[1]).frame
    assert frame["agent"].tolist() == ["keeper", "team"]
    assert frame["length"].tolist() == [6, 6]
