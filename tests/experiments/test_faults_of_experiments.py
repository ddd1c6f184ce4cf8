"""Faults of designs, stores, contenders and workers that were found by use, each as a row of a table."""

import json
import os
import sys
from contextlib import closing
from dataclasses import replace
from fractions import Fraction
from functools import partial

import joblib
import numpy as np
import pydoe
import pytest

from simenv_marl import evaluate, make_step, vector_env
from simenv_marl.errors import AgentError, MissingExtraError, OptionValueError, StoreError
from simenv_marl.experiments import design, run_experiment, sobol_indices
from simenv_marl.remote import ProcessSimulation
from tests.experiments.test_effects import results
from tests.experiments.test_runs import lines
from tests.worlds.shops import OBSERVED, POINTS, Shop, level, much, much_of_many

# -- designs --------------------------------------------------------------------------------------


@pytest.mark.parametrize("bounds", [(0, 2**53 + 1), (-(2**63), 2**63 - 1), (0, 10**30), (-7, 7)], ids=str)
def test_whole_ranges_stay_whole_and_reach_their_bounds(bounds):
    low, high = bounds
    for method, number in (("full_factorial", 3), ("one_at_a_time", 3), ("latin_hypercube", 64), ("sobol", 64)):
        values = design({"x": bounds}, method, number)["x"].tolist()
        assert {type(value) for value in values} == {int}
        assert low <= min(values) < max(values) <= high
        assert "full" not in method or values == [low, round(Fraction(low + high, 2)), high]


def test_levels_are_compared_once():
    class Level(int):
        compared = 0
        __hash__ = int.__hash__

        def __eq__(self, other):
            Level.compared += 1
            return int(self) == int(other)

    design({"x": [Level(number) for number in range(1000)]})
    assert Level.compared < 1000
    for twice in ([Level(1), Level(1)], [[1], [1]], [1, 2, 1]):
        with pytest.raises(OptionValueError, match="twice"):
            design({"x": twice})
    assert design({"x": [1, True, 1.0, [1], (1,)]})["x"].tolist() == [1, True, 1.0, [1], (1,)]


def test_designs_that_cannot_be_are_refused_with_reasons():
    for bounds in ((0, 10**5000), (0.5, 10**400)):
        with pytest.raises(OptionValueError, match="that a float can hold"):
            design({"x": bounds})
    with pytest.raises(OptionValueError, match="rows"):
        design({"x": (0.0, 1.0)}, "full_factorial", 10**12)


def test_one_sample_has_no_shares(tmp_path):
    frame = results(design({"a": (0.0, 1.0), "b": (0.0, 1.0)}, "saltelli", 1), tmp_path)
    with pytest.raises(OptionValueError, match="one sample tells nothing"):
        sobol_indices(frame, "y")


def test_design_alone_needs_a_package_for_designs(monkeypatch):
    expected = design({"x": (0.0, 1.0)}, "halton", 4)
    monkeypatch.setitem(sys.modules, "pyDOE", pydoe)  # its name in releases for older NumPy
    monkeypatch.setitem(sys.modules, "pydoe", None)
    assert design({"x": (0.0, 1.0)}, "halton", 4).equals(expected)
    monkeypatch.setitem(sys.modules, "pyDOE", None)
    with pytest.raises(MissingExtraError, match=r"simenv-marl\[design\]"):
        design({"x": (0.0, 1.0)}, "halton", 4)
    evaluate(Shop, {"rule": {}}, seeds=[1, 2], points=POINTS).summary()


# -- contenders -----------------------------------------------------------------------------------


class Harbour:
    """Ships that decide under their own names; the last of them comes on the last day alone."""

    def __init__(self, days=2):
        self.days = days

    def reset(self, seed):
        self.seed = seed

    def run(self):
        for day in range(self.days):
            for name in ("dispatcher", "tug", *(("late",) if day == 4 else ())):
                self.sail(name)

    def sail(self, name):
        return 0


SHIPS = {
    Harbour.sail: make_step(
        **OBSERVED | {"observation_space_mapping": lambda harbour, name: [0.0]},
        action_space_mapping=lambda action: action,
        reward_mapping=lambda harbour, name: 1.0,
        agent=lambda harbour, name: name,
    )
}


@pytest.mark.filterwarnings("ignore:policies= or possible_agents= name agents")
@pytest.mark.parametrize("arguments", [{}, {"workers": 2}, {"batched": True}], ids=str)
def test_a_name_that_no_agent_has_is_an_error_of_its_contender(arguments, tmp_path):
    policy = much_of_many if arguments.get("batched") else much
    given = {"seeds": range(3), "points": SHIPS, **arguments}
    told = "'wrong' has a policy for 'dispatchr', but no agent .*decided: dispatcher, tug; did you mean dispatcher"
    contenders = {"right": {"tug": policy}, "wrong": {"tug": policy, "dispatchr": policy}}
    with pytest.raises(AgentError, match=told):
        evaluate(Harbour, contenders, **given)
    design = {"days": [2, 5]}
    with pytest.raises(AgentError, match=told):
        run_experiment(Harbour, design, contenders=contenders, store=tmp_path, **given)
    assert "wrong" not in {line["contender"] for line in lines(tmp_path)}
    contenders = {"right": {"tug": policy}, "late": {"late": policy}}
    named = {"contenders": contenders, "possible_agents": ["late"], **given}  # it may come later, or not at all
    evaluate(Harbour, **named)
    assert set(run_experiment(Harbour, design, store=tmp_path / "named", **named)["status"]) == {"ok"}
    alone = {"points": SHIPS, "seeds": range(3), "contenders": {"right": {"tug": much}, "late": {"late": much}}}
    frames = [
        run_experiment(Harbour, {"days": [5]}, store=tmp_path / str(place), **own)
        for place, own in enumerate([alone, given | {"contenders": contenders}])
    ]
    assert frames[0].equals(frames[1])


# -- what rows share ------------------------------------------------------------------------------

SHARED = dict(POINTS)
ONE = Shop()


def make_by_shared_points(scale):
    for point in POINTS:
        SHARED[point] = replace(POINTS[point], reward_mapping=lambda shop: float(scale))
    shop = Shop()
    shop.points = SHARED
    return shop


@pytest.mark.parametrize("arguments", [{}, {"workers": 2}, {"batched": True}], ids=str)
def test_rows_have_definitions_and_simulations_of_their_own(arguments, tmp_path):
    frame = run_experiment(make_by_shared_points, {"scale": [1, 10]}, seeds=[1, 2], store=tmp_path / "a", **arguments)
    assert frame["return"].tolist() == [3, 3, 6] * 2 + [30, 30, 60] * 2
    given = {"seeds": range(4), "points": POINTS}
    frame = run_experiment(lambda day: ONE, {"day": [1, 2]}, store=tmp_path / "b", **given, **arguments)
    expected = evaluate(Shop, {"rule": {}}, **given).frame["return"].tolist()
    assert frame["return"].tolist() == 2 * expected


CHILD = """
import json, os
reading, writing = map(int, os.environ["SIMENV_MARL_FDS"].split(","))
lines, out = os.fdopen(reading), os.fdopen(writing, "w")
def send(frame):
    print(json.dumps(frame), file=out, flush=True)
send({"hello": 1, "points": ["say"]})
for line in lines:
    if "start" in json.loads(line):
        send({"decide": 1, "point": "say", "args": {}})
    elif "act" in json.loads(line):
        send({"end": {"result": [os.environ["HARBOUR"], os.getcwd(), os.getpid()]}})
"""


def test_a_process_is_kept_only_while_it_would_be_started_alike(tmp_path, monkeypatch):
    say = make_step(
        **OBSERVED | {"observation_space_mapping": lambda call: [0.0]}, action_space_mapping=lambda action: action,
        reward_mapping=lambda call: 0.0, agent="speaker",
    )  # fmt: skip

    def make(name):
        (tmp_path / name).mkdir(exist_ok=True)
        monkeypatch.setenv("HARBOUR", name)
        monkeypatch.chdir(tmp_path / name)
        return ProcessSimulation([sys.executable, "-c", CHILD], {"say": say})

    metric = {"seen": lambda s: "|".join(s.result[:2]), "pid": lambda s: s.result[2]}
    frame = run_experiment(make, {"name": ["a", "b"]}, seeds=[1, 2], metric=metric, store=tmp_path / "store")
    team = frame[frame["agent"] == "team"]
    assert team["seen"].tolist() == [f"{name}|{tmp_path / name}" for name in "aabb"]
    assert team["pid"].nunique() == 2


def test_vectors_workers_and_experiments_keep_nothing_of_each_other(tmp_path):
    class Twice(Shop):
        def order(self):
            return 4

    given = {"points": POINTS, "seeds": range(3)}
    alone = {make: evaluate(make, {"rule": {}}, **given).frame["return"].tolist() for make in (Shop, Twice)}
    by_ten = {point: replace(own, reward_mapping=lambda shop: 10.0) for point, own in POINTS.items()}
    points = {Shop.order: POINTS[Shop.order]}
    with closing(vector_env(Shop, points, num_envs=2)) as env:
        env.reset(seed=3)
        steps = [env.step(np.array([5, 5]))[1].tolist()]
        for workers in (0, 2):
            tens = run_experiment(Shop, {"days": [3]}, points=by_ten, seeds=range(3), store=tmp_path / str(workers),
                                  workers=workers)  # fmt: skip
            assert tens["return"].tolist() == [30, 30, 60] * 3
            for make in (Twice, Shop):
                assert evaluate(make, {"rule": {}}, workers=workers, **given).frame["return"].tolist() == alone[make]
        steps.append(env.step(np.array([5, 5]))[1].tolist())
    with closing(vector_env(Shop, points, num_envs=2)) as env:
        env.reset(seed=3)
        assert steps == [env.step(np.array([5, 5]))[1].tolist() for _ in range(2)]


# -- workers --------------------------------------------------------------------------------------


class Deadly(Shop):
    def run(self):
        if self.days == 2 and self.seed == 1:
            os._exit(3)
        super().run()


@pytest.mark.parametrize("batched", [False, True])
def test_a_run_that_kills_its_worker_is_a_row_and_the_others_go_on(batched, tmp_path):
    design = {"days": [1, 2, 3]}
    given = {"seeds": range(4), "points": POINTS, "batched": batched}
    frame = run_experiment(Deadly, design, store=tmp_path / "a", workers=2, **given)
    whole = run_experiment(Shop, design, store=tmp_path / "b", **given)
    failed = frame["status"] == "error"
    assert frame.loc[failed, ["days", "seed"]].to_numpy().tolist() == [[2, 1]]
    assert "worker died in this run, twice" in frame.loc[failed, "error"].item()
    at = (whole["days"] == 2) & (whole["seed"] == 1)
    assert frame.loc[~failed, "return"].tolist() == whole.loc[~at, "return"].tolist()
    assert run_experiment(Deadly, design, store=tmp_path / "a", workers=2, **given).equals(frame)


@pytest.mark.parametrize("lacks", ["joblib", "death"])
def test_workers_that_cannot_be_are_refused_before_anything_runs(lacks, tmp_path, monkeypatch):
    def make(**row):
        raise AssertionError("nothing may run")

    if lacks == "joblib":
        monkeypatch.setitem(sys.modules, "joblib", None)
        monkeypatch.setitem(sys.modules, "joblib.parallel", None)
    with joblib.parallel_config(backend="multiprocessing" if lacks == "death" else "loky"):
        with pytest.raises((MissingExtraError, OptionValueError), match="joblib"):
            evaluate(make, {"rule": {}}, seeds=[1], workers=2)
        with pytest.raises((MissingExtraError, OptionValueError), match="joblib"):
            run_experiment(make, {"days": [1]}, seeds=[1], workers=2, store=tmp_path / "store")
    assert not (tmp_path / "store").exists()


# -- stores ---------------------------------------------------------------------------------------

HUGE = 10**5000


def test_integers_that_no_line_can_hold_are_told(tmp_path):
    given = {"seeds": [1], "points": POINTS, "metric": lambda shop: HUGE}
    with pytest.raises(OptionValueError, match="'metric' must be a number of no more than 4,200 digits"):
        evaluate(Shop, {"rule": {}}, **given)
    frame = run_experiment(Shop, {"days": [1]}, store=tmp_path, **given)
    assert frame["error"].str.contains("4,200 digits").all()
    policy = partial(lambda observation, number: 5, number=HUGE)
    for days, contenders in ((HUGE, {}), (1, {"huge": {"keeper": policy}})):
        with pytest.raises(OptionValueError, match=r"4,200 digits|cannot be stored as JSON"):
            run_experiment(
                Shop, {"days": [days]}, seeds=[1], points=POINTS, store=tmp_path / "b", contenders=contenders
            )
    found = evaluate(Shop, {"rule": {}}, seeds=[1, 2], points=POINTS, metric=lambda shop: 10**400)
    with pytest.raises(OptionValueError, match="not a column of numbers"):
        found.summary("metric")


def damaged(line, **changes):
    return json.dumps(json.loads(line) | changes).encode()


@pytest.mark.parametrize(
    "damage",
    [
        lambda line: b"[" * 100_000,
        lambda line: b'{"a":' * 100_000,
        lambda line: b"\xff\xfe{}",
        lambda line: b"[]",
        lambda line: b"1" * 5000,
        lambda line: damaged(line, provenance={"options": "none"}),
        lambda line: damaged(line, provenance=[1]),
        lambda line: damaged(line, returns={"keeper": "much"}),
        lambda line: damaged(line, returns={"keeper": HUGE // 10**1000}),
        lambda line: damaged(line, lengths={}),
        lambda line: damaged(line, metrics={"level": [1]}),
        lambda line: damaged(line, seed="one"),
    ],
)
def test_a_line_that_is_no_run_is_a_run_that_is_missing(damage, tmp_path):
    given = {"points": POINTS, "metric": {"level": level}, "store": tmp_path}
    expected = run_experiment(Shop, {"days": [1]}, seeds=[1], **given)
    (path,) = tmp_path.glob("runs-*")
    path.write_bytes(damage(path.read_bytes()) + b"\n")
    with pytest.warns(UserWarning, match="cannot be read, so its run counts as missing"):
        assert run_experiment(Shop, {"days": [1]}, seeds=[1], **given).equals(expected)


@pytest.mark.parametrize("text", [b"[" * 100_000, b"\xff\xfe[", b"{"])
def test_a_damaged_head_of_a_store_is_told(text, tmp_path):
    (tmp_path / "experiment.json").write_bytes(text)
    with pytest.raises(StoreError, match=r"experiment\.json cannot be read"):
        run_experiment(Shop, {"days": [1]}, seeds=[1], points=POINTS, store=tmp_path)
