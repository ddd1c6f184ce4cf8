"""Before a long run, a planner says what its decisions cost; bars show the remaining time."""

import re
import time

import joblib
import pytest

from simenv_marl import evaluate, reseed_generators, simulate, simulate_many
from simenv_marl.data import collect_episodes
from simenv_marl.experiments import run_experiment
from simenv_marl.planning import RolloutPolicy, TreeSearchPolicy, costs
from tests.worlds.saved import Pumps

SAID = re.compile(
    r"simenv_marl: (\d+) candidates x (\d+) futures? x ([\d.]+ m?s) on \d+ cores?: about"
    r" ([\d.]+ m?s) a decision, ([\d.]+ m?s) an episode"
)


class Slow(Pumps):
    """Pumps that take a millisecond, whose future is one."""

    deterministic = True

    def pull(self):
        time.sleep(0.001)
        return super().pull()


class Chance(Slow):
    """Pumps whose future can be drawn anew."""

    deterministic = False

    def reseed(self, seed):
        reseed_generators(self, seed)


PLANNER = RolloutPolicy([[0, 1], [1, 0]], futures=2, horizon=3, every=4)
POLICIES = {"push": PLANNER}
NAMED = {"planner": POLICIES}

RUNS = {
    "evaluate": lambda store, **options: evaluate(Slow, NAMED, seeds=range(3), **options),
    "stored": lambda store, **options: evaluate(
        Slow, NAMED, seeds=range(3), store=store, **options
    ),
    "experiment": lambda store, **options: run_experiment(
        Slow, [{}], contenders=NAMED, seeds=range(3), store=store, **options
    ),
    "many": lambda store, **options: simulate_many(Slow, POLICIES, seeds=range(3), **options),
    "collected": lambda store, **options: collect_episodes(
        Slow, POLICIES, seeds=range(3), **options
    ),
}


@pytest.mark.parametrize("run", RUNS)
def test_simulate_many_reports_once_how_long_a_planning_decision_takes(
    run, tmp_path, monkeypatch, capfd
):
    monkeypatch.setattr(costs, "LONG", 0.01)
    RUNS[run](tmp_path)
    said = SAID.findall(capfd.readouterr().err)
    assert len(said) == 1
    assert said[0][:2] == ("3", "1")  # with the rule; and one future, because there is no other


class VerySlow(Slow):
    """Pumps of a run that takes longer than a minute."""

    def pull(self):
        time.sleep(0.02)
        return super().pull()


def stop(simulation):
    """End the run after its first episode."""
    raise TimeoutError


@pytest.mark.thorough
def test_simulate_many_with_workers_reports_planning_time_once(capfd):
    planner = RolloutPolicy([[0, 1], [1, 0]], futures=1, budget=5, every=12)
    # Workers of other tests would print elsewhere.
    joblib.externals.loky.get_reusable_executor().shutdown(wait=True)
    with pytest.raises(TimeoutError):
        simulate_many(
            VerySlow, {"push": planner}, seeds=range(200), workers=2, batch_size=1, collect=stop
        )
    assert len(re.findall("an episode", capfd.readouterr().err)) == 1


@pytest.mark.thorough
@pytest.mark.parametrize("kind", [RolloutPolicy, TreeSearchPolicy])
def test_every_planning_policy_reports_how_long_a_decision_takes(kind, monkeypatch, capfd):
    monkeypatch.setattr(costs, "LONG", 0.01)
    planner = kind([[0, 1], [1, 0]], futures=4, horizon=2, every=6)
    simulate_many(Chance, {"push": planner}, seeds=[1, 2])
    [(candidates, futures, *_)] = SAID.findall(capfd.readouterr().err)
    assert (candidates, futures) == ("3", "4")


def test_short_runs_and_simulate_report_no_planning_time(monkeypatch, capfd):
    simulate_many(Slow, POLICIES, seeds=[1])
    monkeypatch.setattr(costs, "LONG", 0.0)
    simulate(Slow, POLICIES, seed=1)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(("method", "seconds"), [("fork", "3 s"), ("replay", "8 s")])
def test_reported_planning_time_of_replays_includes_the_past(method, seconds, monkeypatch, capfd):
    monkeypatch.setattr(costs, "LONG", 0.0)
    future = costs.Future(decisions=10, seconds=10.0, time=10.0, is_over=True)
    monkeypatch.setattr(costs, "_time_future", lambda env, number, base: future)
    planner = RolloutPolicy([[0, 1], [1, 0]], futures=2, horizon=3, every=4, method=method)
    simulate_many(Slow, {"push": planner}, seeds=[1, 2])
    assert f"3 candidates x 1 future x {seconds} on " in capfd.readouterr().err


def test_measuring_planning_time_does_not_change_results(monkeypatch, capfd):
    before = [simulation.level.tolist() for simulation in simulate_many(Slow, POLICIES, seeds=[4])]
    monkeypatch.setattr(costs, "LONG", 0.0)
    after = [simulation.level.tolist() for simulation in simulate_many(Slow, POLICIES, seeds=[4])]
    assert before == after
    assert SAID.search(capfd.readouterr().err)


@pytest.mark.thorough
@pytest.mark.parametrize("run", RUNS)
def test_progress_bar_shows_the_remaining_time(run, tmp_path, capfd):
    RUNS[run](tmp_path, progress=True)
    bars = re.findall(r"(\d+)/\d+ \[\d+:\d+<(\d+:\d+|\?)", capfd.readouterr().err)
    assert bars[-1][1] != "?"
    assert any(left != "?" for done, left in bars if 0 < int(done) < int(bars[-1][0]))
