"""The experiment: every script from its command line to its files, with a budget that teaches nobody anything."""

import importlib
import json
import shutil

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("pandas")

from examples.greenhouse_coop.train import play
from studies.greenhouse_experiment import back_in_the_model, baselines, results

from simenv_marl import simulate

from . import commands

pytestmark = pytest.mark.filterwarnings("default")  # learners warn of much that is theirs

NEEDS = {"sb3": "stable_baselines3", "torchrl": "torchrl", "rllib": "ray"}
QUESTIONS = {"sb3": ["1", "2", "3", "5a", "5b", "5c"], "torchrl": ["4a", "4b"], "rllib": ["4a"]}


def script(library):
    pytest.importorskip(NEEDS[library])
    return importlib.import_module(f"studies.greenhouse_experiment.{library}")


def line(out, *, questions, seeds=(3,), budget=1024, workers=1):
    """A command line."""
    return ["--questions", *questions, "--seeds", *map(str, seeds), *f"--budget {budget} --workers {workers}".split(),
            "--out", str(out)]  # fmt: skip


def carry_out(library, out, *, hashes, **options):
    """In a process of its own, as ``make experiment`` does; by ``hashes`` its sets of strings are in another order."""
    commands.module(f"studies.greenhouse_experiment.{library}", *line(out, **options), PYTHONHASHSEED=hashes)


def policy(out, library, question):
    """The path of what can be loaded."""
    return next(path for path in out.glob(f"{library}-{question}-3*") if path.suffix != ".json")


def found(out, name):
    run = json.loads((out / f"{name}.json").read_text())
    del run["seconds"]
    return run


@pytest.fixture(scope="module", params=NEEDS)
def library(request):
    script(request.param)
    return request.param


@pytest.fixture(scope="module")
def runs(library, tmp_path_factory):
    out = tmp_path_factory.mktemp(library)
    carry_out(library, out, hashes="0", questions=QUESTIONS[library], seeds=(3, 4), workers=2)
    return out


@pytest.fixture
def made(runs, tmp_path):
    """All runs of a library, for a test to do with as it likes."""
    return shutil.copytree(runs, tmp_path / "runs")


def test_every_question_is_answered_and_judged_on_the_way(library, made):
    for question in QUESTIONS[library]:
        run = found(made, f"{library}-{question}-3")
        assert (run["library"], run["question"], run["seed"], run["budget"]) == (library, question, 3, 1024)
        assert [point["days"] for point in run["curve"]] == [0, 1024]
        assert run["days"] == 1024
        assert run["curve"][0] != run["curve"][1]
        assert np.isfinite(run["final"]["value"])


def test_the_same_seed_comes_to_the_same_in_whatever_process(library, made, tmp_path):
    question = QUESTIONS[library][0]
    carry_out(library, tmp_path, hashes="2", questions=[question])
    name = f"{library}-{question}-3"
    assert found(tmp_path, name) == found(made, name)
    assert found(made, f"{library}-{question}-4")["final"] != found(made, name)["final"]


def test_policies_do_in_the_models_own_loop_what_they_do_in_environments(library, made):
    question = QUESTIONS[library][-1]
    _, team = back_in_the_model.load(policy(made, library, question))
    greenhouse = simulate(back_in_the_model.GreenhouseSim, team, seed=11).greenhouse
    played = play(team, 11)
    assert greenhouse.water_use == pytest.approx(sum(played.poured))
    assert greenhouse.alive == played.alive[-1]


def test_figures_and_table_are_made_of_whatever_runs_there_are(library, made, tmp_path, capsys):
    baselines.main(["--episodes", "60", "--seeds", "0", "--out", str(made)])
    folders = {"data": tmp_path / "data", "figures": tmp_path / "figures"}
    options = [f"--{name}={folder}" for name, folder in folders.items()]
    results.main([f"--runs={made}", *options])
    drawn = {path.name: path.read_bytes() for path in folders["figures"].iterdir()}
    assert set(drawn) == {"experiment.md", "experiment-curves.png", "experiment-finals.png"}
    rows = drawn["experiment.md"].decode().splitlines()
    for question in QUESTIONS[library]:
        assert sum(row.startswith(f"| ({question}) ") for row in rows) == 1
    for team in ("rule", "random actions", "constant ventilation", "constant pair", "CMA-ES, both, 60 episodes"):
        assert sum(row.startswith(f"| {team} |") for row in rows) == 1

    results.main(options)  # out of the CSV files alone
    assert {path.name: path.read_bytes() for path in folders["figures"].iterdir()} == drawn
