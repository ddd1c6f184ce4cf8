"""Each study that needs a learner runs from its command line to its figures, in a small way."""

import csv
import json

import pytest

from . import commands, page

pytestmark = pytest.mark.filterwarnings("default")  # learners warn of much that is theirs


def test_imitation_study_runs(capsys):
    pytest.importorskip("minari")
    pytest.importorskip("torchrl")
    from studies.imitation import rule

    results = rule.main(["--episodes", "10", "--steps", "1000", "--seeds", "4"])
    assert results["agreement"] > 0.5
    assert results["imitation"] == pytest.approx(results["rule"], abs=2)
    assert "in the model itself" in capsys.readouterr().out


@pytest.mark.parametrize("plainly", [[], ["--plainly"]])
def test_planned_imitation_study_runs(plainly):
    pytest.importorskip("minari")
    pytest.importorskip("torchrl")
    options = "--budget", 2800, "--learners", 1, "--steps", 5, "--seeds", 1, "--workers", 2
    assert "learner 1: " in commands.python("-m", "studies.imitation.plans", *options, *plainly)


def test_learner_sweep_study_resumes(tmp_path):
    pytest.importorskip("optuna")
    line = ["--days", 250, "--seeds", 1, "--trials", 1, "--out", tmp_path]
    told = commands.python("-m", "studies.learner_sweep.sweep", *line, OMP_NUM_THREADS="1")
    assert "found by Optuna: {'learning_rate': " in told
    assert told == commands.python("-m", "studies.learner_sweep.sweep", *line, OMP_NUM_THREADS="1")


def test_learner_sweep_study_table_equals_the_one_in_the_docs(tmp_path, monkeypatch):
    (
        pytest.importorskip("optuna"),
        pytest.importorskip("seaborn"),
        pytest.importorskip("statsmodels"),
    )
    from studies.learner_sweep import sweep

    monkeypatch.setattr(sweep, "LEVELS", {"learning_rate": [1e-3, 3e-3], "gamma": [0.8, 0.9]})
    names = {"table": sweep.sweep(tmp_path, 250, range(2))}
    (code,) = page.blocks("experiments.md", "The table elsewhere")
    exec(code, names)
    assert names["mean"].shape == (2, 2)
    assert names["shares"]["C(learning_rate)"] == names["shares"].max()
    assert names["axes"].get_ylabel() == "gain"


def test_wolf_sheep_study_trains_and_draws_its_pictures(tmp_path):
    pytest.importorskip("torchrl")
    pytest.importorskip("mesa")
    from studies.wolf_sheep import picture

    curves, path = tmp_path / "shared-policy-training.csv", tmp_path / "shared-policy.json"
    options = "--seeds", 2, "--decisions", 1, "--ticks", 5, "--out", tmp_path, "--curves", curves
    commands.python("-m", "examples.wolf_sheep.train", *options)
    with curves.open(newline="") as file:
        assert {(row["sight"], row["seed"]) for row in csv.DictReader(file)} == {
            (s, n) for s in "12" for n in "01"
        }
    commands.python(
        "-m", "studies.wolf_sheep.results", "--meadows", 2, "--out", tmp_path, "--results", path
    )
    compared = json.loads(path.read_text())
    assert list(compared["results"]) == list(picture.STYLES)
    told = commands.python("-m", "studies.wolf_sheep.picture", "--figures", tmp_path)
    assert (tmp_path / "shared-policy.png").stat().st_size > 10_000
    assert (tmp_path / "shared-policy-training.png").stat().st_size > 10_000
    assert told.count("\n") == 2 + len(picture.STYLES)


def test_bounds_study_plans_a_supply_chain(tmp_path, capsys):
    pytest.importorskip("stockpyl")
    from studies.bounds import serial_supply

    table = serial_supply.main(["--quick", "--out", str(tmp_path)])
    shown = capsys.readouterr().out
    assert all(row[0] in shown for row in table)
    assert (tmp_path / "bounds-serial-supply.png").stat().st_size > 1_000
