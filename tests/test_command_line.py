"""The command line, as it is called from a shell."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from simenv_marl import save_episode
from simenv_marl.__main__ import main
from tests.worlds.saved import mid_episode

MODELS = '''
"""Two walks, one of which limps."""

from tests.worlds import copied


class Walk(copied.Walk):
    points = [copied.Walk.choose]

    def __init__(self):
        super().__init__(10)


def shaken(walk):
    return [walk.place + walk.random.random()]


class Limping(Walk):
    points = {copied.Walk.choose: copied.define_walk(observation_space_mapping=shaken)}


number = 3
'''


@pytest.fixture(autouse=True)
def beside_the_models(tmp_path, monkeypatch):
    (tmp_path / "walking.py").write_text(MODELS)
    (tmp_path / "broken_walk.py").write_text("import no_such_package_at_all\n")
    (tmp_path / "quitting_walk.py").write_text("raise SystemExit('usage')\n")
    (tmp_path / "failing_walk.py").write_text("1 / 0\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield
    for name in ("walking", "broken_walk", "failing_walk"):
        sys.modules.pop(name, None)


@pytest.mark.thorough
def test_check_command_finds_nothing_in_a_sound_simulation():
    root = Path(__file__).parent.parent
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(root / "src"), str(root)])}
    command = [sys.executable, "-m", "simenv_marl", "check", "walking:Walk", "--episodes", "2"]
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, env=environment, timeout=300
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("Walk: nothing to complain of")


def test_check_command_ends_with_status_1_if_it_finds_an_error(capsys):
    limits = ["--episodes", "2", "--seed", "4", "--max-steps", "5", "--time-limit", "59.5"]
    assert main(["check", "walking:Limping", *limits]) == 1
    text = capsys.readouterr().out
    assert all(
        part in text
        for part in ("behaves differently when it is observed", "seed 4", "5 decisions")
    )
    assert main(["check", "walking:Limping", *limits, "--json"]) == 1
    told = json.loads(capsys.readouterr().out)
    assert told["ok"] is False
    assert told["findings"][0]["severity"] == "error"


def test_inspect_command_prints_text_or_json(capsys):
    assert main(["inspect", "walking:Walk", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["calls"] == "choose{10}"
    assert main(["inspect", "walking:Walk"]) == 0
    text = capsys.readouterr().out
    assert all(part in text for part in ("walker_0", "choose{10}", "aec, parallel, single, joint"))


def test_check_and_inspect_commands_take_points_by_name(capsys):
    greenhouse = "examples.greenhouse_coop.model.Greenhouse."
    assert main(["check", "walking:Walk", "--points", "walking.Walk.chose"]) == 2
    assert "chose" in capsys.readouterr().err
    inspect = ["inspect", "examples.greenhouse_coop.env:GreenhouseSim", "--points"]
    assert main([*inspect, f"{greenhouse}choose_water_amount"]) == 0
    assert "choose_water_amount" in capsys.readouterr().out
    assert main([*inspect, f"{greenhouse}__init__"]) == 2
    assert "has no definition" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("target", "told"),
    [
        ("walking", "not of the form module:Simulation"),
        ("walkin:Walk", "did you mean walking?"),
        ("walking:Wlak", "did you mean Walk?"),
        ("walking:Walk.nothing", "Walk has no 'nothing'"),
        ("simenv_marl.registraton:x", "did you mean simenv_marl.registration"),
        ("broken_walk:Walk", "needs 'no_such_package_at_all'"),
        ("failing_walk:Walk", "cannot be imported: ZeroDivisionError"),
        ("quitting_walk:Walk", "cannot be imported: SystemExit: usage"),
        ("walking:number", "is not a simulation"),
    ],
)
@pytest.mark.parametrize("command", ["check", "inspect"])
def test_check_and_inspect_commands_refuse_objects_that_are_no_simulation(
    command, target, told, capsys
):
    assert main([command, target]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert told in err
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize(
    "arguments",
    [
        *(
            "",
            "chek walking:Walk",
            "check",
            "check walking:Walk --time-limit never",
            "wire-check --options [1] s",
        ),
        *("new", "new plain", "new netlogo tank"),
    ],
)
def test_commands_end_with_status_2_for_wrong_arguments(arguments, capsys):
    with pytest.raises(SystemExit) as caught:
        main(arguments.split())
    assert caught.value.code == 2
    assert "usage" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "options"),
    [
        (
            "check walking:Walk",
            ["seed -1", "episodes 0", "max-steps 0", "time-limit 0", "time-limit inf"],
        ),
        ("inspect walking:Walk", ["seed -1"]),
        (
            "wire-check true",
            ["seed -1", f"seed {2**31}", "decisions 0", "timeout nan", "timeout inf"],
        ),
    ],
)
def test_commands_refuse_invalid_numbers(command, options, capsys):
    command, target = command.split()
    for each in options:
        option, value = each.split()
        assert main([command, f"--{option}", value, target]) == 2
        assert option.replace("-", "_") in capsys.readouterr().err


def test_replay_command_shows_an_episode_file_up_to_a_decision(capsys):
    env = mid_episode(taken=5)
    save_episode(env, "episode")
    assert main(["replay", "episode"]) == 0
    head, *decisions, now = capsys.readouterr().out.splitlines()
    assert head == "yard, view aec, seed 7"
    assert [line.split()[0] for line in decisions] == ["1", "2", "3", "4", "5"]
    assert decisions[0].startswith("     1  at 0  planner: ")
    assert now == f"now: a decision of {env.agent_selection!r}"
    assert main(["replay", "episode", "--until", "2"]) == 0
    assert capsys.readouterr().out.splitlines()[:3] == [head, *decisions[:2]]
    assert main(["replay", "nowhere"]) == 2
    assert "nowhere cannot be read" in capsys.readouterr().err
