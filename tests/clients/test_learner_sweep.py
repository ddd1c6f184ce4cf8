"""Sweeps of learners: the example, with a budget that teaches little, and the code of its page."""

from types import SimpleNamespace

import pytest

pytest.importorskip("optuna")

from examples import learner_sweep
from simenv_marl import simulate

from . import commands, page

DAYS = 250
ONE = {"learning_rate": [1e-3], "gamma": [0.8, 0.9]}


@pytest.fixture(autouse=True)
def _few_settings(monkeypatch):
    monkeypatch.setattr(learner_sweep, "LEVELS", ONE)


@pytest.fixture
def counted(monkeypatch):
    """How many trainings there were."""
    made = []
    learn = learner_sweep.PPO.learn
    monkeypatch.setattr(
        learner_sweep.PPO, "learn", lambda *given, **options: made.append(1) or learn(*given, **options)
    )
    return made


def train(days, seed=0):
    settings = {"learning_rate": 3e-3, "gamma": 0.9}
    return simulate(learner_sweep.Training(days, **settings), seed=seed, global_rng=True).found


def test_a_training_is_a_simulation_that_brings_something():
    """Judged on the same seeds: more than after few days, and more than the rule is worth, the interval included."""
    short, long = train(DAYS), train(3000)
    assert short["difference"] < 0
    assert long["difference_low"] > max(0, short["difference_high"])


def test_its_seed_is_that_of_the_training():
    assert train(DAYS).equals(train(DAYS))
    assert not train(DAYS).equals(train(DAYS, seed=1))


def test_a_sweep_is_the_same_for_every_number_of_workers_and_resumes(tmp_path, counted):
    table = learner_sweep.sweep(tmp_path / "alone", DAYS, range(2))
    assert len(table) == len(counted) == 4
    assert (table["status"] == "ok").all()
    assert (table["gain_low"] < table["gain"]).all()
    assert (table["gain"] < table["gain_high"]).all()
    assert table["gain"].nunique() > 1
    assert table.equals(learner_sweep.sweep(tmp_path / "shared", DAYS, range(2), workers=2))
    more = learner_sweep.sweep(tmp_path / "alone", DAYS, range(3))
    assert len(counted) == 6
    assert more[more["seed"] < 2].reset_index(drop=True).equals(table)


def test_a_training_that_diverges_is_a_row(tmp_path, monkeypatch):
    monkeypatch.setattr(learner_sweep, "LEVELS", {"learning_rate": [1e30, 1e-3], "gamma": [0.9]})
    table = learner_sweep.sweep(tmp_path, DAYS, [0])
    assert table["status"].tolist() == ["error", "ok"]
    assert "nan" in table["error"][0]


def test_a_search_that_was_stopped_goes_on(tmp_path, counted, monkeypatch):
    def stopped(training, **options):
        if len(counted) == 3:
            raise KeyboardInterrupt
        return simulate(training, **options)

    with monkeypatch.context() as patched:
        patched.setattr(learner_sweep, "simulate", stopped)
        with pytest.raises(KeyboardInterrupt):
            learner_sweep.search(tmp_path, DAYS, 2, range(2))
    counted.clear()
    study = learner_sweep.search(tmp_path, DAYS, 2, range(2))
    assert len(counted) == 2
    assert [trial.state.name for trial in study.trials] == ["COMPLETE", "FAIL", "COMPLETE"]
    assert len({trial.params["gamma"] for trial in study.trials}) == 3
    learner_sweep.search(tmp_path, DAYS, 2, range(2))
    assert len(counted) == 2


def test_what_a_trial_is_worth_is_known_with_its_intervals(tmp_path):
    (trial,) = learner_sweep.search(tmp_path, DAYS, 1, range(2)).trials
    found = [
        simulate(learner_sweep.Training(DAYS, **trial.params), seed=seed, global_rng=True).found for seed in range(2)
    ]
    assert trial.value == pytest.approx(sum(own["difference"] for own in found) / 2)
    assert trial.user_attrs["intervals"] == [own[["difference_low", "difference_high"]].tolist() for own in found]


def test_settings_that_do_worse_than_most_are_not_trained_again(tmp_path, counted, monkeypatch):
    """After some trials, one training that is worse than the median of theirs is enough."""
    worth = iter([*[2.0] * 10, 1.0])
    parts = "difference", "difference_low", "difference_high"
    monkeypatch.setattr(
        learner_sweep, "simulate", lambda *given, **options: SimpleNamespace(found=dict.fromkeys(parts, next(worth)))
    )
    study = learner_sweep.search(tmp_path, DAYS, 6, range(2))
    assert [trial.state.name for trial in study.trials] == ["COMPLETE"] * 5 + ["PRUNED"]


def test_what_was_found_is_confirmed_with_other_seeds_on_other_seeds(tmp_path):
    table = learner_sweep.confirm(tmp_path, DAYS, {"learning_rate": 3e-3, "gamma": 0.9}, [0])
    assert table["gamma"].tolist() == [0.99, 0.9]
    assert table["gain"][1] != pytest.approx(train(DAYS)["difference"])
    fresh = learner_sweep.Training(DAYS, 2 * learner_sweep.HELD_OUT, learning_rate=3e-3, gamma=0.9)
    assert simulate(fresh, seed=0, global_rng=True).found["difference"] == table["gain"][1]


def test_from_the_command_line(tmp_path):
    line = f"--days {DAYS} --seeds 1 --trials 1 --out".split()
    told = commands.example("learner_sweep", *line, tmp_path, OMP_NUM_THREADS="1")
    assert "found by Optuna: {'learning_rate': " in told
    assert told == commands.example("learner_sweep", *line, tmp_path, OMP_NUM_THREADS="1")


def test_the_page(tmp_path, monkeypatch):
    pytest.importorskip("seaborn"), pytest.importorskip("statsmodels")
    monkeypatch.setattr(learner_sweep, "LEVELS", {"learning_rate": [1e-3, 3e-3], "gamma": [0.8, 0.9]})
    names = {"table": learner_sweep.sweep(tmp_path, DAYS, range(2))}
    (code,) = page.blocks("sweeps.md", "The table elsewhere")
    exec(code, names)
    assert names["mean"].shape == (2, 2)
    assert names["shares"].index.tolist() == [
        "C(learning_rate)",
        "C(gamma)",
        "C(learning_rate):C(gamma)",
        "Residual",
    ]
    assert names["shares"]["C(learning_rate)"] == names["shares"].max()
    assert names["axes"].get_ylabel() == "gain"
