"""Templates: the files of the command line run in place, and impossible ones are refused."""

import ast
import re
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from simenv_marl import aec_env, simulate
from simenv_marl.__main__ import main
from simenv_marl.seats import describe
from simenv_marl.testing.fingerprint import differences, fingerprint
from simenv_marl.testing.templates import KINDS
from tests.processes import python
from tests.worlds.models import begun, follow_the_rule, play

SOURCE = Path(__file__).parent.parent / "src"
PAGE = (SOURCE.parent / "docs/templates.md").read_text()


def run(folder, *arguments):
    """Another Python in a folder, with this library and nothing else of the repository."""
    return python(*arguments, cwd=folder, env={"PYTHONPATH": str(SOURCE)}, timeout=300)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
def test_new_command_writes_a_template_that_passes_its_own_tests(kind, tmp_path):
    done = run(tmp_path, "-m", "simenv_marl", "new", kind, "water_tank")
    assert done.stderr == ""
    written = {
        path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()
    }
    modules = {"water_tank/water_tank.py", "water_tank/test_water_tank.py"}
    assert written == {*modules, "water_tank/pytest.ini"}
    assert f"pytest {KINDS[kind]}\n" in done.stdout
    assert kind != "plain" or f"$ python -m simenv_marl new plain water_tank\n{done.stdout}" in PAGE
    for name in modules:
        text = (tmp_path / name).read_text()
        assert "simenv_marl.testing.templates" not in text
        assert "MyModel" not in text
        assert "MySimulation" not in text
        assert "WaterTankSimulation" in text
    run(tmp_path / "water_tank", "-m", "pytest", "-q", "-p", "no:cacheprovider", "-W", "error")


@pytest.mark.thorough
def test_check_command_accepts_a_written_template(tmp_path):
    assert main(["new", "plain", "water_tank", "--folder", str(tmp_path)]) == 0
    checked = run(tmp_path, "-m", "simenv_marl", "check", "water_tank:WaterTankSimulation")
    assert "nothing to complain of" in checked.stdout


# plain needs Stable-Baselines3: tests/clients/test_templates.py
@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["simpy", "mesa"])
def test_template_training_beats_the_rule(kind, tmp_path):
    run(tmp_path, "-m", "simenv_marl", "new", kind, "tank", "--folder", ".")
    done = run(tmp_path, "-W", "error::DeprecationWarning:tank", "-m", "tank", "--quick")
    table = done.stdout.splitlines()
    assert table[1].split()[:2] == ["mean", "95%"]
    assert f"{done.stdout.splitlines()[0]}\n" in PAGE
    trained = next(line for line in table if line.startswith("trained "))
    numbers = map(float, re.findall(r"-?\d[\d.]*", trained))
    mean, low, high, difference, difference_low, difference_high = numbers
    assert low <= mean <= high
    assert 0 < difference_low <= difference <= difference_high


@pytest.mark.parametrize("kind", KINDS)
def test_template_imports_only_packages_that_the_new_command_names(kind):
    told = {
        "simenv_marl",
        "numpy",
        "gymnasium",
        *re.findall(r"[\w-]+", KINDS[kind].partition("[")[0].replace("-", "_")),
    }
    tree = ast.parse((SOURCE / f"simenv_marl/testing/templates/{kind}.py").read_text())
    imported = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    imported |= {
        alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.Import)
        for alias in node.names
    }
    packages = {name.partition(".")[0] for name in imported} - set(sys.stdlib_module_names)
    dependencies = {"torch"} if "stable_baselines3" in told else set()
    assert packages <= told | dependencies
    assert packages >= told - {"gymnasium"}


@pytest.mark.parametrize("kind", ["simpy", "mesa"])
def test_template_policies_answer_one_observation_as_they_answer_many(kind):
    template = import_module(f"simenv_marl.testing.templates.{kind}")
    policy = template.train(1, 1)
    env = begun(template.env(), 3)
    seen = env.last()[0] if kind == "mesa" else env.step(0)[0]
    assert policy(seen) == policy(np.stack([seen, seen]))[1]
    env.close()


@pytest.mark.parametrize(
    ("names", "told"),
    [
        (["water tank", "2nd", "class", "_"], "cannot be the name of a module"),
        (["\ufb01sh"], "use lower-case letters"),
        (["json", "pytest", "simenv_marl"], "is the name of another module"),
        (["Mesa"], "cannot be the name of a module"),  # of the same file as mesa, on some systems
    ],
)
def test_new_command_refuses_invalid_names(names, told, tmp_path, capsys):
    for name in names:
        assert main(["new", "mesa", name, "--folder", str(tmp_path / "new")]) == 2
        error = capsys.readouterr().err
        assert told in error
        assert "choose one like water_tank" in error
        assert len(error.splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_template_classes_do_not_clash_with_existing_names(tmp_path):
    names = ["none", "rabbit", "box", "exception"]
    for name in names:
        assert main(["new", "mesa", name, "--folder", str(tmp_path)]) == 0
    code = "; ".join(f"from {name} import {name.title()}Simulation" for name in names)
    run(tmp_path, "-c", code)


@pytest.mark.parametrize("kind", KINDS)
def test_template_env_with_rule_actions_runs_like_the_model_without_env(kind):
    template = import_module(f"simenv_marl.testing.templates.{kind}")
    plain = begun(template.MySimulation(), 7)
    plain.run()
    for other in (
        follow_the_rule(template.env(), seed=7),
        simulate(template.MySimulation, {}, seed=7),
    ):
        found = differences(fingerprint("simulation", other), fingerprint("simulation", plain))
        # From 3.5 on, Mesa numbers all scenarios and events of a process.
        numbers = ("._scenario_id", "._current_event.unique_id")
        assert [each for each in found if not each.path.endswith(numbers)] == []


@pytest.mark.parametrize("kind", KINDS)
def test_template_has_labels_of_observations_and_actions(kind):
    template = import_module(f"simenv_marl.testing.templates.{kind}")
    points = {
        point: replace(step, display_mapping=None)
        for point, step in template.MySimulation.points.items()
    }
    env = begun(aec_env(template.MySimulation, points), 7)
    found = describe(env, as_json=True)
    names = [*found["observation"], *found["actions"]["enum"]]
    assert len(found["observation"]) == env.last()[0].size
    assert [name for name in names if not re.search("[a-z]{3}", name)] == []
    env.close()


def test_mesa_template_agents_are_born_and_die():
    """Those that starve are terminated, those that see the last day truncated."""
    env = begun(import_module("simenv_marl.testing.templates.mesa").env(), 7)
    first = set(env.agents)
    ends = {
        turn.agent: turn.terminated
        for turn in play(env, reset=False)
        if turn.terminated or turn.truncated
    }
    assert set(ends) > first
    assert set(ends.values()) == {True, False}


def test_simpy_template_infos_have_masks_and_elapsed_times():
    env = import_module("simenv_marl.testing.templates.simpy").env()
    _, info = env.reset(seed=7)
    assert info["action_mask"].sum() > 1  # a forced choice is not asked for
    told = env.step(0)[4]
    assert 0 < told["elapsed"] == told["time"] - info["time"]


def test_new_command_overwrites_nothing_and_reports_bad_folders(tmp_path, capsys):
    for existing in ("tank.py", "test_tank.py"):
        folder = tmp_path / existing.removesuffix(".py")
        folder.mkdir()
        (folder / existing).write_text("mine")
        assert main(["new", "plain", "tank", "--folder", str(folder)]) == 2
        assert f"{existing} exists already" in capsys.readouterr().err
        assert [path.name for path in folder.iterdir()] == [existing]
        assert main(["new", "plain", "tank", "--folder", str(folder / existing / "new")]) == 2
        error = capsys.readouterr().err
        assert "cannot be written" in error
        assert len(error.splitlines()) == 1
