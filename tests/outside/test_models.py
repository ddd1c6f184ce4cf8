"""Models outside Python in environments: a town in Java, a network in ns-3, and what the pages on clients show."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from functools import cache
from typing import Any, NamedTuple

import pytest
from examples.jvm_market import build as building
from examples.jvm_market import compare as town_policies
from examples.jvm_market import env as town
from examples.ns3_senders import env as network

from simenv_marl import parallel_env
from simenv_marl.remote.check import check_wire
from tests.clients.page import DOCS, blocks
from tests.outside.conftest import COMPILER, compiled
from tests.outside.reservoirs import child
from tests.worlds.models import follow_the_rule, play

EMPTY = 2
"""The seed of a town in which there is no shop any more after some weeks."""

BRIEF = {"seconds": 5.0}


@cache
def plain_town(seed: int) -> Any:
    """What the town tells by itself."""
    return town.plain(seed)["result"]


def plain_network(seed: int, **options: Any) -> Any:
    """What the network tells by itself."""
    command = [network.program(), str(seed), json.dumps(options)]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout)


def no_java() -> str:
    """Why the town cannot be built."""
    try:
        building.java()
    except RuntimeError as error:
        return str(error)
    return ""


class Model(NamedTuple):
    """One of the two."""

    missing: Callable[[], str]
    raw_env: Callable[..., Any]
    plain: Callable[..., Any]
    episodes: list[tuple[int, dict[str, Any]]]


TOWN = Model(no_java, town.raw_env, plain_town, [(seed, {}) for seed in (3, 4, 5, EMPTY)])
NETWORK = Model(
    network.missing,
    network.raw_env,
    plain_network,
    [(7, {}), (8, {"hosts": 3}), (7, BRIEF), (2**40, BRIEF), (7, {})],
)

of_the_town = pytest.mark.parametrize("model", [TOWN], ids=["town"], indirect=True)
of_the_network = pytest.mark.parametrize("model", [NETWORK], ids=["network"], indirect=True)

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")  # what PettingZoo says where no roster is declared


@pytest.fixture(params=[TOWN, NETWORK], ids=["town", "network"])
def model(request):
    if missing := request.param.missing():
        pytest.skip(missing)
    return request.param


@pytest.fixture
def env(model):
    with closing(model.raw_env()) as env:
        yield env


def test_by_its_rule_each_episode_is_the_plain_model(model, env):
    for seed, options in model.episodes:  # in one process
        env.reset(seed=seed, options=options)
        play(env, reset=False)
        assert repr(env.simulation.result) == repr(model.plain(seed, **options))


def test_an_episode_that_is_given_up_leaves_nothing_to_the_next(model, env):
    for steps in (0, 1, 40):
        env.reset(seed=3)
        for _ in range(steps):
            agent = env.agent_selection
            env.step(None if env.terminations[agent] else env.action_space(agent).sample())
        number = child(env)
        assert repr(follow_the_rule(env, 4).result) == repr(model.plain(4))
        assert child(env) == number, "the model unwinds, and its process plays on"


@of_the_town
def test_lives_begin_and_end_in_mid_episode(model, env):
    ends = {turn.agent: (turn.terminated, turn.truncated) for turn in play(env, seed=3)}
    result = env.simulation.result
    assert {f"farm_{number}" for number in range(1, 9)} | {f"shop_{number}" for number in range(9, 15)} < set(ends)
    assert len(ends) == result["founded"]
    assert sum(terminated for terminated, _ in ends.values()) == result["closed"] < len(ends)
    assert all(terminated != truncated for terminated, truncated in ends.values())
    assert not any(turn.truncated for turn in play(env, seed=EMPTY))


@of_the_network
def test_the_code_of_the_page_runs(model, capsys):
    (code,) = blocks("ns3.md")
    exec(code, {"__name__": "page"})
    assert capsys.readouterr().out == f"{plain_network(7, seconds=10)}\n"


def shown(page: str, language: str) -> list[str]:
    """The page's blocks in another language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", (DOCS / page).read_text("utf-8"), re.MULTILINE | re.DOTALL)


@pytest.fixture
def here(tmp_path, monkeypatch):
    """The folder of this process."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


PAGE = "clients-outside.md"


def environment(command: list[str]) -> dict[str, Any]:
    """Runs the page's environment with a command, and returns its names."""
    names = {"__name__": "page"}
    shown_code = shown(PAGE, "python")[1]
    assert 'command = ["./ferries"]' in shown_code
    exec(shown_code.replace('["./ferries"]', json.dumps(command), 1), names)
    return names


def printed_by(command: list[str]) -> str:
    """What a model prints without an environment: the page says that it is the same with one."""
    plain = subprocess.run(command, check=True, capture_output=True, text=True, timeout=20).stdout
    assert int(plain) > 0
    return plain


@pytest.mark.greenlet("the page takes the driver as it is")
@pytest.mark.skipif(bool(no_java()), reason="no JDK")
def test_the_code_of_the_page_on_java(here, capsys):
    (here / "Ferries.java").write_text(shown(PAGE, "java")[0])
    shutil.copy(building.CLIENT, here)
    commands = shown(PAGE, "sh")[1]
    plain = subprocess.run(["sh", "-e"], input=commands, capture_output=True, text=True, timeout=120)
    assert plain.stderr == ""
    command = ["java", "-cp", "out", "Ferries"]
    assert f"Java: {json.dumps(command)}" in shown(PAGE, "python")[1]
    environment(command)
    assert capsys.readouterr().out == plain.stdout == printed_by([*command, "7"])
    assert check_wire(command).ok


@pytest.mark.greenlet("the page takes the driver as it is")
@of_the_town
def test_the_code_of_the_page_on_the_town(model, capsys):
    names = {"__name__": "__main__"}
    exec(blocks(PAGE, "Larger models")[0], names)
    earned = names["found"].values()
    assert (earned["by the granary"] > earned["rule"]).mean() > 0.8
    assert "by the granary" in capsys.readouterr().out
    town_policies.main(["--seeds", "2"])
    assert "by the granary" in capsys.readouterr().out


@pytest.mark.greenlet("the page takes the driver as it is")
def test_the_code_of_the_page_on_python(here, capsys):
    (here / "ferries.py").write_text(shown(PAGE, "python")[0], encoding="utf-8")
    shutil.copy(DOCS.parent / "clients" / "python" / "simenv_marl_client.py", here)
    command = [sys.executable, "ferries.py"]
    environment(command)
    assert capsys.readouterr().out == printed_by([*command, "7"])
    report = check_wire(command)
    assert {finding.verdict for finding in report.findings if finding.tried != "reseed"} == {"ok"}, str(report)


@pytest.mark.skipif(COMPILER is None, reason="no C++ compiler: neither g++ nor clang++ is installed")
def test_the_code_of_the_page_on_cpp(here, capsys):
    whole, own_loop, *_ = shown(PAGE, "cpp")
    (here / "ferries.cpp").write_text(whole, encoding="utf-8")
    program = str(compiled(here / "ferries.cpp", here))
    names = environment([program])
    assert capsys.readouterr().out == printed_by([program, "7"])
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
