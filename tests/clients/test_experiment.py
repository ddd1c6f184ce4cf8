"""The experiment: every script from its command line to its files, with a tiny budget."""

import json
import shutil

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("pandas")

from studies.greenhouse_experiment import baselines, results

from . import commands

pytestmark = pytest.mark.filterwarnings("default")  # learners warn of much that is theirs

NEEDS = {"sb3": "stable_baselines3", "torchrl": "torchrl", "rllib": "ray"}
QUESTIONS = {"sb3": ["1", "2", "3", "5a", "5b", "5c"], "torchrl": ["4a", "4b"], "rllib": ["4a"]}


def carry_out(library, out, *, questions, seeds, hashes):
    """Run in a new process, as ``make experiment`` does; ``hashes`` orders its sets of strings."""
    options = [
        "--questions",
        *questions,
        "--seeds",
        *seeds,
        "--budget",
        1024,
        "--workers",
        len(seeds),
        "--out",
        out,
    ]
    commands.python(
        "-m", f"studies.greenhouse_experiment.{library}", *options, PYTHONHASHSEED=hashes
    )


def found(out, name):
    run = json.loads((out / f"{name}.json").read_text())
    del run["seconds"]
    return run


@pytest.fixture(scope="module", params=NEEDS)
def library(request):
    pytest.importorskip(NEEDS[request.param])
    return request.param


@pytest.fixture(scope="module")
def runs(library, tmp_path_factory):
    out = tmp_path_factory.mktemp(library)
    carry_out(library, out, questions=QUESTIONS[library], seeds=[3, 4], hashes="0")
    return out


def test_greenhouse_experiment_answers_each_of_its_questions(library, runs):
    for question in QUESTIONS[library]:
        run = found(runs, f"{library}-{question}-3")
        assert (run["library"], run["question"], run["seed"], run["budget"]) == (
            library,
            question,
            3,
            1024,
        )
        assert [point["days"] for point in run["curve"]] == [0, 1024]
        assert run["days"] == 1024
        assert run["curve"][0] != run["curve"][1]
        assert np.isfinite(run["final"]["value"])


def test_greenhouse_experiment_run_is_the_same_in_another_process(library, runs, tmp_path):
    question = QUESTIONS[library][0]
    carry_out(library, tmp_path, questions=[question], seeds=[3], hashes="2")
    name = f"{library}-{question}-3"
    assert found(tmp_path, name) == found(runs, name)
    assert found(runs, f"{library}-{question}-4")["final"] != found(runs, name)["final"]


def test_greenhouse_experiment_draws_results_of_existing_runs(library, runs, tmp_path):
    made = shutil.copytree(runs, tmp_path / "runs")
    baselines.main(["--episodes", "60", "--seeds", "0", "--out", str(made)])
    folders = {"data": tmp_path / "data", "figures": tmp_path / "figures"}
    options = [f"--{name}={folder}" for name, folder in folders.items()]
    results.main([f"--runs={made}", *options])
    drawn = {path.name: path.read_bytes() for path in folders["figures"].iterdir()}
    assert set(drawn) == {"experiment.md", "experiment-curves.png", "experiment-finals.png"}
    rows = drawn["experiment.md"].decode().splitlines()
    for question in QUESTIONS[library]:
        assert sum(row.startswith(f"| ({question}) ") for row in rows) == 1
    for team in (
        "rule",
        "random actions",
        "constant ventilation",
        "constant pair",
        "CMA-ES, both, 60 episodes",
    ):
        assert sum(row.startswith(f"| {team} |") for row in rows) == 1

    results.main(options)  # out of the CSV files alone
    assert {path.name: path.read_bytes() for path in folders["figures"].iterdir()} == drawn
