"""Models outside Python: a Java town, an ns-3 network, Enki robots, and the pages on clients."""

import json
import re
import shutil
import subprocess
import sys
from contextlib import closing
from itertools import islice

import pytest
from examples.enki_robots import env as robots
from examples.jvm_market import build as building
from examples.jvm_market import compare as town_policies
from examples.jvm_market import env as town
from examples.ns3_senders import env as network

from simenv_marl import parallel_env
from simenv_marl.remote.check import check_wire
from tests.clients.page import DOCS, blocks
from tests.outside.conftest import COMPILER, compiled
from tests.outside.reservoirs import child
from tests.worlds.models import play

BRIEF = {"seconds": 5.0}


def printed(*command):
    """What a program prints without an environment."""
    output = subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout
    assert output, "no result"
    return output


def plain(example, seed, **options):
    """What a model tells by itself."""
    if example is town:
        return town.plain(seed)["result"]
    return json.loads(printed(example.program(), str(seed), json.dumps(options)))


def no_java():
    """Why the town cannot be built."""
    try:
        building.java()
    except RuntimeError as error:
        return str(error)
    return ""


MODELS = {
    # in the last, no shop stays open
    "town": (no_java(), town, [(seed, {}) for seed in (3, 4, 5, 2)]),
    "network": (network.missing(), network, [(7, {}), (8, {"hosts": 3}), (2**40, BRIEF), (7, {})]),
    "robots": (robots.missing(), robots, [(8, BRIEF), (2**30, BRIEF), (4, {}), (8, BRIEF)]),
}
"""What a model needs and is not there, its example, and episodes."""


def needs(name):
    """Skips a test without what a model needs."""
    missing, *_ = MODELS[name]
    return pytest.mark.skipif(bool(missing), reason=missing)


pytestmark = [
    # what PettingZoo says where no roster is declared
    pytest.mark.filterwarnings("ignore::UserWarning"),
    pytest.mark.greenlet("the other process is the same with every driver: test_process.py"),
]


@pytest.mark.parametrize("name", [pytest.param(name, marks=needs(name)) for name in MODELS])
def test_outside_model_envs_with_rule_actions_run_like_without_env(make_env, name):
    _, example, episodes = MODELS[name]
    env, processes = make_env(example.raw_env), set()
    for steps, (seed, options) in zip((0, 1, 40, 300), episodes, strict=True):
        env.reset(seed=3)
        for agent in islice(env.agent_iter(), steps):
            over = env.terminations[agent] or env.truncations[agent]
            env.step(None if over else env.action_space(agent).sample())
        env.reset(seed=seed, options=options)
        processes.add(child(env))
        play(env, reset=False)
        assert repr(env.simulation.result) == repr(plain(example, seed, **options))
    assert len(processes) == 1, "the model unwinds, and its process plays on"


@needs("network")
def test_code_of_the_ns3_page_runs_as_printed(capsys):
    (code,) = blocks("ns3.md")
    exec(code, {"__name__": "page"})
    assert capsys.readouterr().out == f"{plain(network, 7, seconds=10)}\n"


PAGE = "clients-outside.md"


def shown(language):
    """The page's blocks in another language."""
    return re.findall(
        rf"^```{language}\n(.*?)^```$", (DOCS / PAGE).read_text("utf-8"), re.MULTILINE | re.DOTALL
    )


@pytest.fixture
def here(tmp_path, monkeypatch):
    """The folder of this process."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def environment(command):
    """Runs the page's environment with a command, and returns its names."""
    names = {"__name__": "page"}
    shown_code = shown("python")[1]
    assert 'command = ["./ferries"]' in shown_code
    exec(shown_code.replace('["./ferries"]', json.dumps(command), 1), names)
    return names


@pytest.mark.thorough
@needs("town")
def test_code_of_the_java_page_runs_as_printed(here, capsys):
    (here / "Ferries.java").write_text(shown("java")[0])
    shutil.copy(building.CLIENT, here)
    commands = shown("sh")[1]
    plain = subprocess.run(
        ["sh", "-e"], input=commands, capture_output=True, text=True, timeout=120
    )
    assert plain.stderr == ""
    command = ["java", "-cp", "out", "Ferries"]
    assert f"Java: {json.dumps(command)}" in shown("python")[1]
    environment(command)
    assert capsys.readouterr().out == plain.stdout == printed(*command, "7")
    assert check_wire(command).ok


@pytest.mark.thorough
@needs("town")
def test_code_of_the_town_page_runs_as_printed(capsys):
    names = {"__name__": "__main__"}
    exec(blocks(PAGE, "Larger models")[0], names)
    earned = names["found"].values()
    assert (earned["by the granary"] > earned["rule"]).mean() > 0.8
    assert "by the granary" in capsys.readouterr().out
    town_policies.main(["--seeds", "2"])
    assert "by the granary" in capsys.readouterr().out


def test_code_of_the_page_on_python_simulators_runs_as_printed(here, capsys):
    (here / "ferries.py").write_text(shown("python")[0], encoding="utf-8")
    shutil.copy(DOCS.parent / "clients" / "python" / "simenv_marl_client.py", here)
    command = [sys.executable, "ferries.py"]
    environment(command)
    assert capsys.readouterr().out == printed(*command, "7")
    report = check_wire(command)
    assert {finding.verdict for finding in report.findings if finding.tried != "reseed"} == {
        "ok"
    }, str(report)


@pytest.mark.thorough
@pytest.mark.skipif(
    COMPILER is None, reason="no C++ compiler: neither g++ nor clang++ is installed"
)
def test_code_of_the_cpp_page_runs_as_printed(here, capsys):
    whole, own_loop, *_ = shown("cpp")
    (here / "ferries.cpp").write_text(whole, encoding="utf-8")
    program = str(compiled(here / "ferries.cpp", here))
    names = environment([program])
    assert capsys.readouterr().out == printed(program, "7")
    gone = set()
    with closing(parallel_env(names["ferries"])) as env:
        env.reset(seed=7)
        while env.agents:
            _, _, terminated, truncated, _ = env.step(dict.fromkeys(env.agents, 1))
            gone |= {name for name, ended in terminated.items() if ended and not truncated[name]}
    assert gone == {"Aurora", "Borealis"}
    assert check_wire([program]).ok
    client = 'simenv::Client client({"ferry.departs"});\nconst std::uint64_t seed = 7;\n'
    main = f"int main() {{\n{client}{own_loop}}}\n"
    (here / "own.cpp").write_text(whole[: whole.index("int main")] + main, encoding="utf-8")
    assert check_wire([str(compiled(here / "own.cpp", here))]).ok
