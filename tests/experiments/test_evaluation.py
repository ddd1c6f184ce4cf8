"""Contenders on the same seeds."""

import subprocess
import sys
import threading
import warnings

import numpy as np
import pytest
from scipy import stats

from simenv_marl import RULE, aec_env, evaluate, make_step, simulate
from simenv_marl.data import Mixture
from simenv_marl.data.plots import interval
from simenv_marl.errors import AgentError, MissingExtraError, OptionValueError, UnknownPointError
from simenv_marl.experiments import Variant
from simenv_marl.experiments.evaluation import seeds_needed
from simenv_marl.planning import RolloutPolicy, TreeSearchPolicy
from simenv_marl.plugins import ChangedResult
from tests.conftest import DRIVERS
from tests.worlds.many_worlds import Colony, Design, colony_points
from tests.worlds.models import notes
from tests.worlds.shops import NEAR, OBSERVED, POINTS, Shop, level, much, much_of_many, some

SEEDS = range(12)
CONTENDERS = {"rule": {}, "much": {"keeper": much}}


def returns_by_hand(policies, seed, make=Shop, points=POINTS, **options):
    env = aec_env(make, points, **options)
    env.reset(seed=seed)
    found = {}
    while env.agents:
        name = env.agent_selection
        observation, reward, terminated, truncated, _ = env.last()
        found[name] = found.get(name, 0.0) + reward
        policy = policies.get(name, lambda observation: RULE)
        env.step(None if terminated or truncated else policy(observation))
    return found


def test_the_frame_has_a_row_for_each_agent_and_one_for_the_team():
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


COLONY = Design(initial=3, most=8, ticks=4, overseen="before", truncates=True)


def by_number(observation):
    return int(abs(observation.sum())) % 6


def by_number_of_many(observations):
    return list(map(by_number, observations))


@pytest.mark.filterwarnings("ignore:policies= or possible_agents= name agents that did not appear")
@pytest.mark.parametrize("_driver", DRIVERS, indirect=True)
@pytest.mark.parametrize("options", [{}, {"max_steps": 5}], ids=str)
@pytest.mark.parametrize("batched", [False, True])
def test_agents_that_are_born_and_die_have_the_returns_of_an_environment(batched, options):
    def make():
        return Colony(COLONY)

    points, seeds = colony_points(overseen=True), range(8)
    policies = dict.fromkeys(("creature_0", "creature_4", "overseer_0"), by_number)
    contenders = {"rule": {}, "some": dict.fromkeys(policies, by_number_of_many) if batched else policies}
    given = {"points": points, "possible_agents": ["creature_4"], "batched": batched, **options}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # not all are born in each episode
        found = evaluate(make, contenders, seeds=seeds, baseline="rule", **given)
    for (name, seed), rows in found.frame.groupby(["contender", "seed"]):
        returns = dict(zip(rows["agent"], rows["return"], strict=True))
        total = returns.pop("team")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            expected = returns_by_hand({} if name == "rule" else policies, seed, make, points, **options)
        assert returns == {agent: value for agent, value in expected.items() if agent in returns}
        assert not any(value for agent, value in expected.items() if agent not in returns)
        assert total == pytest.approx(sum(returns.values()))
    sizes = found.frame.groupby(["contender", "seed"]).size()
    assert len(sizes) == 16
    assert sizes.nunique() > 1
    assert np.isfinite(found.summary().to_numpy()).all()


@pytest.mark.parametrize("arguments", [{"workers": 2}, {"batched": True}, {"batched": True, "workers": 2}], ids=str)
def test_the_same_comes_of_all_ways_to_run_it(arguments):
    def policy(observations):
        asked.append(len(observations))
        return much_of_many(observations)

    asked, given = [], {"seeds": SEEDS, "points": POINTS, "metric": level}
    contenders = {"rule": {}, "much": {"keeper": policy if arguments.get("batched") else much}}
    alone = evaluate(Shop, CONTENDERS, **given)
    assert evaluate(Shop, contenders, **given, **arguments).frame.equals(alone.frame)
    assert "metric" in alone.frame.columns
    if arguments == {"batched": True}:
        assert max(asked) == len(SEEDS)


@pytest.mark.parametrize(
    "planner", [RolloutPolicy([0, 1, 2], futures=2, horizon=1), TreeSearchPolicy([0, 1, 2], budget=8)]
)
@pytest.mark.parametrize("arguments", [{}, {"workers": 2}, {"batched": True}], ids=str)
def test_planners_decide_as_they_do_in_simulate(planner, arguments):
    contenders = {"one": {"helper": planner}, "both": {"keeper": planner, "helper": planner}}
    found = evaluate(Shop, contenders, seeds=range(2), points=NEAR, metric=level, **arguments).values("metric")
    for name, policies in contenders.items():
        assert found[name].tolist() == [simulate(Shop, policies, points=NEAR, seed=seed).level for seed in range(2)]


@pytest.mark.parametrize("workers", [0, 2])
def test_mixtures_decide_as_policies_of_many(workers):
    contenders = {"mixed": {"keeper": Mixture({RULE: 0.5, much_of_many: 0.5})}, "much": {"keeper": much_of_many}}
    values = evaluate(Shop, contenders, seeds=SEEDS, points=POINTS, batched=True, workers=workers).values()
    assert (values["mixed"] <= values["much"]).all()
    assert values["mixed"].mean() < values["much"].mean() - 2
    refused("of 'keeper' in 'mixed', <Mixture.*batched=True", contenders=contenders)


def test_points_and_options_that_can_be_asked_for_once_serve_all_contenders():
    plugins = [(lambda shop, _result: ChangedResult(2 * _result), "tests.worlds.shops.Shop.sell", "after")]
    expected, found = (
        evaluate(Shop, {"a": {}, "b": {}}, seeds=SEEDS, points=POINTS, plugins=own) for own in (plugins, iter(plugins))
    )
    assert found.frame.equals(expected.frame)


@pytest.mark.parametrize("confidence", [0.8, 0.95])
def test_the_summary_is_paired_by_seed(confidence):
    contenders = {"rule": {}, "some": {"keeper": some}}
    given = {"points": POINTS, "confidence": confidence}
    found = evaluate(Shop, contenders, seeds=range(32), baseline="rule", **given)
    summary, values = found.summary(), found.values()
    assert summary.index.name == "contender"
    assert list(summary.index) == ["rule", "some"]
    assert list(summary.columns) == ["mean", "low", "high", "difference", "difference_low", "difference_high"]
    assert summary.loc["rule", ["difference", "difference_low", "difference_high"]].tolist() == [0.0, 0.0, 0.0]
    assert summary.loc["some", "difference"] == pytest.approx((values["some"] - values["rule"]).mean())
    expected = stats.ttest_rel(values["some"], values["rule"]).confidence_interval(confidence)
    assert summary.loc["some", ["difference_low", "difference_high"]].tolist() == pytest.approx(list(expected))
    expected = stats.ttest_1samp(values["some"], 0).confidence_interval(confidence)
    assert summary.loc["some", ["low", "high"]].tolist() == pytest.approx(list(expected))
    assert list(evaluate(Shop, CONTENDERS, seeds=[1, 2], **given).summary().columns) == ["mean", "low", "high"]
    assert np.isnan(evaluate(Shop, CONTENDERS, seeds=[1], **given).summary()["low"]).all()


def test_intervals_are_those_of_scipy():
    values = np.random.default_rng(3).exponential(size=40)
    expected = stats.ttest_1samp(values, 0).confidence_interval(0.9)
    assert interval(values, 0.9) == (pytest.approx(expected.low), pytest.approx(expected.high), "")
    expected = stats.binomtest(1, 8).proportion_ci(0.9, method="wilson")
    assert interval(np.array([0.0] * 7 + [1.0]), 0.9, proportion=True) == (*expected, "")
    assert interval(np.zeros(8), 0.9, proportion=True)[1] > 0.1


@pytest.mark.parametrize(
    ("values", "note", "proportion"),
    [
        *((values, "a single", proportion) for values in ([], [1.0]) for proportion in (False, True)),
        *(([1.0, odd], "missing", proportion) for odd in (np.nan, np.inf) for proportion in (False, True)),
        *((equal, "equal", False) for equal in ([2.0] * 5, [0.1 + 0.2, 0.3, 0.3], [0.0, 0.0])),
    ],
)
def test_some_values_have_no_interval(values, note, proportion):
    low, high, why = interval(np.array(values), 0.95, proportion=proportion)
    assert np.isnan([low, high]).all()
    assert note in why


def test_the_summary_says_why_there_is_no_interval():
    contenders = {"a": {}, "same": {}, "some": {"keeper": some}}
    found = evaluate(Shop, contenders, seeds=SEEDS, points=POINTS, baseline="a", metric={"one": lambda shop: 1})
    summary = found.summary()
    assert summary.loc["a", ["difference", "difference_low", "difference_high"]].tolist() == [0, 0, 0]
    assert summary.loc["same", ["difference_low", "difference_high"]].isna().all()
    assert summary["note"].to_dict() == {"a": "", "same": "differences: all are equal", "some": ""}
    assert set(found.summary("one")["note"]) == {"all are equal"}
    assert np.isnan(found.seeds_needed(1.0)["same"])
    assert str(found) == f"{found!r}\n{summary.to_string(float_format='{:.6g}'.format)}"
    found = evaluate(Shop, contenders, seeds=[1], points=POINTS)
    assert set(found.summary()["note"]) == {"a single value"}
    found.plot()


def test_shares_have_intervals_by_wilsons_score():
    metric = {
        "never": lambda shop: False,
        "odd": lambda shop: shop.seed % 2 == 1,
        "more": lambda shop: int(shop.seed < 3),
        "count": lambda shop: 2 * (shop.seed < 3),
    }
    found = evaluate(Shop, {"rule": {}}, seeds=SEEDS, points=POINTS, metric=metric)
    expected = {
        name: stats.binomtest(number, 12).proportion_ci(0.95, method="wilson")
        for name, number in (("never", 0), ("odd", 6), ("more", 3))
    }
    expected["count"] = stats.ttest_1samp(2.0 * (np.arange(12) < 3), 0).confidence_interval(0.95)
    for name, bounds in expected.items():
        assert found.summary(name).loc["rule", ["low", "high"]].tolist() == pytest.approx(list(bounds))


def test_the_probability_of_improvement_counts_ties_half():
    found = evaluate(Shop, {"a": {}, "same": {}, "much": {"keeper": much}}, seeds=SEEDS, points=POINTS, baseline="a")
    improvement = found.improvement()
    assert improvement["probability"].to_dict() == {"same": 0.5, "much": 1.0}
    expected = stats.binomtest(12, 12).proportion_ci(0.95, method="wilson")
    assert improvement.loc["much", ["low", "high"]].tolist() == pytest.approx(list(expected))
    assert improvement.loc["same", ["low", "high"]].isna().all()


def test_how_many_seeds_would_tell_a_difference():
    contenders = {"rule": {}, "some": {"keeper": some}}
    found = evaluate(Shop, contenders, seeds=range(40), points=POINTS, baseline="rule")
    apart = (found.values()["some"] - found.values()["rule"]).std()
    assert found.seeds_needed(apart / 2)["some"] == pytest.approx(34, abs=1)  # as tables of power have it
    assert found.seeds_needed(apart / 2, power=0.99)["some"] > found.seeds_needed(apart / 2)["some"]
    for difference, power in ((0, 0.8), ("a", 0.8), (1, 1), (1, "a")):
        with pytest.raises(OptionValueError):
            found.seeds_needed(difference, power=power)
    with pytest.raises(OptionValueError, match="no baseline"):
        evaluate(Shop, contenders, seeds=[1, 2], points=POINTS).seeds_needed(1)
    assert np.isnan(seeds_needed(np.zeros(3), 0.5, 0.95, 0.8))
    assert seeds_needed(np.arange(9.0), 1e-9, 0.95, 0.8) == float("inf")


def test_it_stops_as_soon_as_intervals_are_narrow_enough():
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


def of_those_that_have_decided(returns):
    assert "keeper" in returns
    assert "stranger" not in returns
    assert returns["keeper"] in returns
    assert dict(returns)["keeper"] == returns["keeper"] == max(returns.values())
    return returns.get("stranger", returns["keeper"])


@pytest.mark.parametrize("team", [max, of_those_that_have_decided])
def test_the_team_is_what_its_user_makes_of_the_returns(team):
    found = evaluate(Shop, {"much": {"keeper": much}}, seeds=[1], points=POINTS, team=team)
    rows = found.frame.set_index("agent")["return"]
    assert rows["team"] == rows["keeper"] > rows["helper"]


# As joblib closes, loky's thread may find that tasks which it has cancelled are gone.
@pytest.mark.filterwarnings("ignore:Exception in thread ExecutorManager:pytest.PytestUnhandledThreadExceptionWarning")
@pytest.mark.parametrize("arguments", [{}, {"workers": 2}, {"batched": True, "batch_size": 1}], ids=str)
@pytest.mark.parametrize(
    ("match", "contender", "keeper", "given"),
    [
        ("'stranger' did not decide .*: keeper, helper", "rule", much, {"team": lambda returns: returns["stranger"]}),
        ("stranger", "bad", lambda seen: {}["stranger"], {}),
    ],
    ids=["team", "policy"],
)
def test_what_fails_does_so_at_once_and_says_of_which_seed(match, contender, keeper, given, arguments):
    with pytest.raises(KeyError, match=match) as caught:
        evaluate(Shop, {"rule": {}, "bad": {"keeper": keeper}}, seeds=SEEDS, points=POINTS, **given, **arguments)
    assert "seed 0" in notes(caught.value)
    assert f"of the contender '{contender}'" in notes(caught.value)


def test_what_is_no_number_has_no_mean():
    given = {"day": lambda shop: "monday", "some": lambda shop: shop.level if shop.seed else None}
    found = evaluate(Shop, CONTENDERS, seeds=[0, 1], points=POINTS, metric=given, baseline="rule")
    assert set(found.values("day")["rule"]) == {"monday"}
    for look in (found.summary, found.improvement, found.plot, lambda metric: found.seeds_needed(1, metric=metric)):
        with pytest.raises(OptionValueError, match="'day' is not a column of numbers"):
            look(metric="day")
    assert np.isnan(found.summary("some")["mean"]).all()


def test_a_variant_brings_its_own_points_and_policies():
    variant = Variant("v", Shop, points=POINTS, parameters={"days": 2}, policies={"keeper": much})
    frame = evaluate(variant, {"rule": {}}, seeds=SEEDS, metric=level).frame
    assert set(frame["agent"]) == {"helper", "team"}  # for the keeper a policy decides, which is no contender's
    expected = [simulate(Shop(2), {"keeper": much}, points=POINTS, seed=seed).level for seed in SEEDS]
    assert frame[frame.agent == "team"]["metric"].tolist() == expected


def test_pairs_are_drawn_and_pictures_of_many_contenders_can_be_read():
    def drawn(contenders, seeds, metric="return", **given):
        return evaluate(Shop, contenders, seeds=seeds, points=POINTS, metric=level, **given).plot(metric)

    def slants(axes):
        return {label.get_rotation() for label in axes.get_xticklabels()}

    values, differences = drawn(CONTENDERS, SEEDS, "metric", baseline="rule").axes
    assert sum(len(line.get_xdata()) == 2 for line in values.lines) == len(SEEDS)
    assert len(differences.collections[0].get_offsets()) == len(SEEDS)
    figure = drawn({f"the contender of number {number}": {} for number in range(20)}, [1])
    (axes,) = figure.axes
    assert figure.get_figwidth() <= 14
    assert (slants(axes), axes.get_title(loc="left")) == ({30}, "1 seed")
    (axes,) = drawn({"rule": {}}, SEEDS).axes
    assert axes.get_title(loc="left") == "12 seeds, each a dot"
    axes = drawn(CONTENDERS, range(201), "metric").axes[0]
    assert (axes.get_title(loc="left"), axes.get_ylabel()) == ("201 seeds, lines for 200 of them", "metric")
    assert slants(axes) == {0}


def refused(match, error=OptionValueError, **arguments):
    made = []
    given = {"contenders": CONTENDERS, "seeds": SEEDS, "points": POINTS, **arguments}
    with pytest.raises(error, match=match) as caught:
        evaluate(lambda: made.append(1) or Shop(), given.pop("contenders"), **given)
    assert len(made) <= len(given["points"])  # looked at, and not run
    return caught.value


@pytest.mark.parametrize(
    ("match", "arguments"),
    [
        *((match, {"contenders": contenders}) for match, contenders in (
            ("there are none", {}),
            ("must be a dict", [much]),
            ("must be a string", {1: {}}),
            ("must be a dict from agents", {"a": much}),
            ("must be a callable", {"a": {"keeper": 3}}),
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
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_before_anything_runs(match, arguments):
    refused(match, **arguments)


def test_who_is_unknown_is_refused_before_anything_runs():
    caught = refused("stranger", UnknownPointError, contenders={"rule": {}, "a": {"stranger": much}})
    assert "of the contender 'a'" in notes(caught)


def test_an_agent_must_not_be_called_team():
    points = {Shop.order: make_step(**OBSERVED, action_space_mapping=int, reward_mapping=level, agent="team")}
    with pytest.raises(AgentError, match="team"):
        evaluate(Shop, {"rule": {}}, seeds=[1], points=points)


def test_metrics_are_numbers_strings_or_none():
    values = {
        "f": lambda shop: np.float32(0.5),
        "s": lambda shop: "a" if shop.seed else None,
        "n": lambda shop: shop.seed or None,
        "a": lambda shop: np.array(3),
    }
    frame = evaluate(Shop, {"rule": {}}, seeds=[0, 1], points=POINTS, metric=values).frame
    assert [frame[name].tolist() for name in "fsa"] == [[0.5] * 6, [None] * 3 + ["a"] * 3, [3] * 6]
    assert frame["n"].dtype == np.float64
    with pytest.raises(OptionValueError, match="metric 'x' must be a number"):
        evaluate(Shop, {"rule": {}}, seeds=[1], points=POINTS, metric={"x": lambda s: [1]})


def test_what_no_worker_can_be_given_is_found_out_before_anything_runs(tmp_path):
    class Writing(Shop):
        def reset(self, seed):
            (tmp_path / str(seed)).touch()
            super().reset(seed)

    lock = threading.Lock()
    with pytest.raises(TypeError, match="pickle"):
        evaluate(Writing, {"rule": {}, "a": {"keeper": lambda o: lock}}, seeds=[1], points=POINTS, workers=1)
    assert not list(tmp_path.iterdir())


def test_progress_is_shown(capsys):
    evaluate(Shop, CONTENDERS, seeds=SEEDS, points=POINTS, progress=True)
    assert "24/24" in capsys.readouterr().err


def test_a_missing_package_is_told_with_its_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingExtraError, match=r"simenv-marl\[experiments\]"):
        evaluate(Shop, {"rule": {}}, seeds=[1], points=POINTS)


def test_importing_the_package_imports_none_of_what_experiments_need():
    code = "import sys, simenv_marl; print({'pandas', 'scipy.stats', 'pydoe', 'SALib'} & sys.modules.keys())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
