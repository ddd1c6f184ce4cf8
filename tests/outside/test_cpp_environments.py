"""Models in C++ as the user of their environment meets them: that of the page, and one in which much goes wrong."""

import contextlib
import io
import re
import subprocess

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import aec_env, make_step, parallel_env, simulate
from simenv_marl.errors import ProcessDiedError
from simenv_marl.remote import ProcessSimulation
from simenv_marl.remote.check import check_wire
from tests.outside.compiling import COMPILER, ROOT, compiled
from tests.outside.reservoirs import child

pytestmark = pytest.mark.skipif(COMPILER is None, reason="no C++ compiler: neither g++ nor clang++ is installed")

CLIENT = (ROOT / "clients" / "cpp" / "simenv.hpp").read_text(encoding="utf-8")
PAGE = (ROOT / "docs" / "clients-cpp.md").read_text(encoding="utf-8")
GIVEN = {"array": np.arange(3, dtype=np.float32), "nested": [None, {"x": np.nan}], "whole": np.int64(3)}

POINT = make_step(
    observation_space=spaces.Discrete(1),
    observation_space_mapping=lambda call: 0,
    action_space=spaces.Discrete(2),
    apply=lambda action, call: [1, GIVEN][action],
    reward_mapping=lambda call: 0.0,
    agent=lambda call: call.entity,
)


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)


@pytest.fixture
def program(folder, monkeypatch):
    """The page's model, in the folder of this process."""
    monkeypatch.chdir(folder)
    (folder / "ferries.cpp").write_text(blocks("cpp")[0], encoding="utf-8")
    if not (folder / "ferries").exists():
        compiled(folder / "ferries.cpp", folder)
    return str(folder / "ferries")


def code_of_the_page():
    """The names that the page's code leaves behind, and what it prints."""
    names, printed = {"__name__": "page"}, io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(blocks("python")[0], names)
    return names, printed.getvalue()


def test_the_pages_code_prints_what_the_model_prints_by_itself(program):
    plain = subprocess.run([program, "7"], check=True, capture_output=True, text=True, timeout=20).stdout
    assert code_of_the_page()[1] == plain
    assert int(plain) > 0


def test_its_ferries_are_agents_and_one_of_them_rests(program):
    env = parallel_env(code_of_the_page()[0]["ferries"])
    env.reset(seed=7)
    gone = set()
    while env.agents:
        _, _, terminated, truncated, _ = env.step(dict.fromkeys(env.agents, 1))
        gone |= {name for name, ended in terminated.items() if ended and not truncated[name]}
    env.close()
    assert gone == {"Aurora", "Borealis"}
    assert check_wire([program]).ok


def test_the_pages_own_loop(folder):
    whole, body = blocks("cpp")[:2]
    main = (
        'int main(int, char**) {\n    simenv::Client client({"ferry.departs"});\n    const std::uint64_t seed = 7;\n'
        f"{body}}}\n"
    )
    (folder / "own.cpp").write_text(whole[: whole.index("int main")] + main, encoding="utf-8")
    assert check_wire([str(compiled(folder / "own.cpp", folder))]).ok


def test_the_page_names_all_that_a_client_has():
    begin = CLIENT.index("class Client {")
    public = CLIENT[begin : CLIENT.index("  private:", begin)]
    names = set(re.findall(r"^    (?:[\w:<>]+ )+(\w+)\(", public, re.MULTILINE)) - {"Client"}
    assert {"run", "next_episode", "ask", "update", "error", "connected"} <= names
    assert {name for name in names if not re.search(rf"client\.{name}[(<]", PAGE)} == set()


@pytest.fixture
def env(make_env, probe):
    return make_env(aec_env, ProcessSimulation(probe, {"a": POINT}, timeout=10.0))


def begin(env, play, **options):
    env.reset(seed=1, options={"play": play} | options)


def test_an_exit_and_a_crash_surface_with_what_they_say(env):
    with pytest.raises(ProcessDiedError, match="exited with code 3"):
        begin(env, "leave", status=3)
    with pytest.raises(ProcessDiedError, match=r"(?s)SIGABRT.*terminate called"):
        begin(env, "crash")
    begin(env, "count")


@pytest.mark.parametrize("play", ["count", "deaf"])
def test_a_model_that_is_given_up_unwinds_and_its_process_plays_on(env, play):
    begin(env, play)
    number = child(env)
    env.step(0)
    begin(env, "count", times=1)
    env.step(0)
    assert (env.simulation.result, child(env)) == (1, number)


def test_arrays_and_nested_values_are_decisions(probe):
    done = simulate(ProcessSimulation(probe, {"a": POINT}), {"a": lambda observation: 1}, seed=1)
    assert repr(done.result) == repr({"array": [0.0, 1.0, 2.0], "nested": [None, {"x": float("nan")}], "whole": 3})
