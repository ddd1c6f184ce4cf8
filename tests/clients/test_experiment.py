"""The experiment: every script from its command line to its files, with a budget that teaches nobody anything."""

import importlib
import json
import shutil
import sys

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("pandas")

from examples.greenhouse_coop.env import joint_env, parallel_env, raw_env
from examples.greenhouse_coop.experiment import back_in_the_model, baselines, results
from examples.greenhouse_coop.experiment.questions import BOTH, FINAL, in_rounds, judge
from examples.greenhouse_coop.experiment.runs import Run
from examples.greenhouse_coop.train import VENTILATOR, WATERER, play

from simenv_marl import simulate

from . import commands

pytestmark = pytest.mark.filterwarnings("default")  # learners warn of much that is theirs

NEEDS = {"sb3": "stable_baselines3", "torchrl": "torchrl", "rllib": "ray"}
QUESTIONS = {"sb3": ["1", "2", "3", "5a", "5b", "5c"], "torchrl": ["4a", "4b"], "rllib": ["4a"]}


def script(library):
    pytest.importorskip(NEEDS[library])
    return importlib.import_module(f"examples.greenhouse_coop.experiment.{library}")


def line(out, *, questions, seeds=(3,), budget=1024, workers=1):
    """A command line."""
    return ["--questions", *questions, "--seeds", *map(str, seeds), *f"--budget {budget} --workers {workers}".split(),
            "--out", str(out)]  # fmt: skip


def carry_out(library, out, **options):
    script(library).main(line(out, **options))


def carry_out_elsewhere(library, out, *, hashes, **options):
    """In a process of its own, as ``make experiment`` does, where sets of strings are in another order than in others.

    Args:
        library: Whose script.
        out: The folder of all runs.
        hashes: Determines the order.
        **options: Of the command line.
    """
    commands.example(f"greenhouse_coop.experiment.{library}", *line(out, **options), PYTHONHASHSEED=hashes)


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
    carry_out_elsewhere(library, out, hashes="0", questions=QUESTIONS[library], seeds=(3, 4), workers=2)
    return out


@pytest.fixture
def made(runs, tmp_path):
    """All runs of a library, for a test to do with as it likes."""
    return shutil.copytree(runs, tmp_path / "runs")


def act(observation):
    """Two actions that depend on what is observed."""
    return np.clip([0.05 + 0.1 * observation[5], 0.4 + 0.5 * observation[1]], 0, 1).astype(np.float32)


# -- judging --------------------------------------------------------------------------------------


def test_two_who_decide_at_once_are_worth_in_turns_what_they_are_worth_in_rounds():
    environment = parallel_env()
    observations, _ = environment.reset(seed=7)
    value = 0.0
    while environment.agents:
        assert np.array_equal(observations[WATERER], observations[VENTILATOR])
        actions = act(observations[WATERER])
        observations, rewards, *_ = environment.step({WATERER: actions[:1], VENTILATOR: actions[1:]})
        value += rewards[VENTILATOR]
    assert play(raw_env(), in_rounds(act), 7).value == pytest.approx(value, abs=1e-12)


def test_the_joint_agents_parts_stand_in_the_order_that_policies_take_them_to_be_in():
    environment = joint_env(flatten=True)
    observation, _ = environment.reset(seed=7)
    over = False
    while not over:
        observation, _, terminated, truncated, _ = environment.step(act(observation[:6]))
        over = terminated or truncated
    played = play(raw_env(), in_rounds(act), 7)
    assert environment.unwrapped.simulation.greenhouse.water_use == pytest.approx(sum(played.poured))


# -- scripts --------------------------------------------------------------------------------------


def test_every_question_is_answered_and_judged_on_the_way(library, made):
    for question in QUESTIONS[library]:
        run = found(made, f"{library}-{question}-3")
        assert (run["library"], run["question"], run["seed"], run["budget"]) == (library, question, 3, 1024)
        assert [point["days"] for point in run["curve"]] == [0, 1024]
        assert run["days"] == 1024
        assert run["curve"][0] != run["curve"][1]
        assert np.isfinite(run["final"]["value"])


def test_what_is_loaded_is_what_was_judged(library, made):
    for question in QUESTIONS[library]:
        team = script(library).load(Run(library, question, 3, 1024, made))
        verdict = judge(raw_env(), team, FINAL)
        run = found(made, f"{library}-{question}-3")["final"]
        assert (verdict.value, verdict.alive, verdict.litres) == pytest.approx(tuple(run.values()), rel=1e-5)


def test_runs_that_are_there_are_not_done_again(library, made, capsys):
    first, *others = QUESTIONS[library]
    before = {path: path.stat().st_mtime_ns for path in made.glob("*.json")}
    again = made / f"{library}-{first}-3.json"
    again.unlink()
    carry_out(library, made, questions=QUESTIONS[library])
    changed = {path for path in made.glob("*.json") if path.stat().st_mtime_ns != before[path]}
    assert changed == {again}
    assert capsys.readouterr().out.count("is there already") == len(others)


def test_the_same_seed_comes_to_the_same_in_whatever_process(library, made, tmp_path):
    question = QUESTIONS[library][0]
    carry_out_elsewhere(library, tmp_path, hashes="2", questions=[question])
    name = f"{library}-{question}-3"
    assert found(tmp_path, name) == found(made, name)
    assert found(made, f"{library}-{question}-4")["final"] != found(made, name)["final"]


def test_a_run_of_another_budget_is_not_taken_for_one_of_this(library, made):
    with pytest.raises(SystemExit, match="budget of 1024 days, not 2048"):
        carry_out(library, made, questions=QUESTIONS[library], budget=2048)


def test_whoever_needs_another_answer_says_so(tmp_path):
    with pytest.raises(SystemExit, match="question 1 of seed 3 has to be answered first"):
        carry_out("sb3", tmp_path, questions=["5c"])


def test_batches_of_torchrl_follow_the_greenhouses_and_explore():
    learner = script("torchrl")
    networks = learner.Networks.of("4b")
    batch = learner.Greenhouses("4b", 0).collect(networks.actor)
    assert batch.shape == (learner.GREENHOUSES, learner.SETTINGS["days"])
    noise = (batch["agents", "action"] - batch["agents", "loc"]).flatten()
    assert float(noise.std()) == pytest.approx(np.exp(learner.SETTINGS["log_std"]), rel=0.1)
    over = batch["next", "agents", "done"].any(dim=(2, 3))
    follows = (batch["next", "state"][:, :-1] == batch["state"][:, 1:]).all(dim=-1)
    assert over.any()
    assert (follows == ~over[:, :-1]).all()


# -- back in the model ----------------------------------------------------------------------------


def test_policies_do_in_the_models_own_loop_what_they_do_in_environments(library, made):
    question = QUESTIONS[library][-1]
    _, team = back_in_the_model.load(policy(made, library, question))
    greenhouse = simulate(back_in_the_model.GreenhouseSim, team, seed=11).greenhouse
    played = play(raw_env(), team, 11)
    assert greenhouse.water_use == pytest.approx(sum(played.poured))
    assert greenhouse.alive == played.alive[-1]


def test_it_is_told_beside_what_the_rules_do(library, made):
    policies = [policy(made, library, question) for question in QUESTIONS[library]]
    told = commands.example(
        "greenhouse_coop.experiment.back_in_the_model", *policies, "--greenhouses", 2, COLUMNS="160"
    )
    assert told.count("the rules") == 2
    for path in policies:
        assert told.count(path.stem) == 2


def test_policies_that_cannot_be_loaded_say_why(tmp_path, monkeypatch):
    with pytest.raises(SystemExit, match="LIBRARY-QUESTION-SEED"):
        back_in_the_model.load(tmp_path / "mine.zip")
    with pytest.raises(SystemExit, match=r"experiment\.sb3 trains it"):
        back_in_the_model.load(tmp_path / "sb3-1-0.zip")
    (tmp_path / "sb3-1-0.zip").touch()
    monkeypatch.setitem(sys.modules, "examples.greenhouse_coop.experiment.sb3", None)
    with pytest.raises(SystemExit, match="needs stable-baselines3, which is not installed here"):
        back_in_the_model.load(tmp_path / "sb3-1-0.zip")


# -- results --------------------------------------------------------------------------------------


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


def test_without_runs_there_are_no_results(tmp_path):
    with pytest.raises(SystemExit, match="there are no runs"):
        results.main(["--runs", str(tmp_path), "--data", str(tmp_path / "data")])


def test_searches_that_are_there_are_not_done_again(tmp_path, capsys):
    (tmp_path / "baselines-60-0.json").write_text("{}")
    baselines.main(["--episodes", "60", "--seeds", "0", "--out", str(tmp_path)])
    assert capsys.readouterr().out == "baselines-60-0.json is there already\n"


def test_both_means_the_waterer_first():
    assert BOTH == (WATERER, VENTILATOR)
