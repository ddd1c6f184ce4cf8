"""The model on the page about C++, compiled and run, alone and in its environment."""

import contextlib
import io
import re
import subprocess

import pytest

from simenv_marl import parallel_env
from simenv_marl.remote.check import check_wire
from tests.outside.compiling import COMPILER, ROOT, compiled

pytestmark = pytest.mark.skipif(COMPILER is None, reason="no C++ compiler: neither g++ nor clang++ is installed")

CLIENT = (ROOT / "clients" / "cpp" / "simenv.hpp").read_text(encoding="utf-8")
PAGE = (ROOT / "docs" / "clients-cpp.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    (folder / "ferries.cpp").write_text(blocks("cpp")[0], encoding="utf-8")
    compiled(folder / "ferries.cpp", folder)
    return folder


@pytest.fixture
def plain(folder):
    """What the model prints by itself."""
    return subprocess.run([folder / "ferries", "7"], check=True, capture_output=True, text=True, timeout=20).stdout


def test_the_pages_code_prints_what_the_model_prints_by_itself(folder, plain, monkeypatch):
    monkeypatch.chdir(folder)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(blocks("python")[0], {"__name__": "page"})
    assert printed.getvalue() == plain
    assert int(plain) > 0


def test_the_page_names_all_that_a_client_has():
    begin = CLIENT.index("class Client {")
    public = CLIENT[begin : CLIENT.index("  private:", begin)]
    names = set(re.findall(r"^    (?:[\w:<>]+ )+(\w+)\(", public, re.MULTILINE)) - {"Client"}
    assert {"run", "next_episode", "ask", "update", "error", "connected"} <= names
    assert {name for name in names if not re.search(rf"client\.{name}[(<]", PAGE)} == set()


def test_its_ferries_are_agents_and_one_of_them_rests(folder, monkeypatch):
    monkeypatch.chdir(folder)
    variables = {"__name__": "page"}
    with contextlib.redirect_stdout(io.StringIO()):
        exec(blocks("python")[0], variables)
    env = parallel_env(variables["ferries"])
    env.reset(seed=7)
    gone = set()
    while env.agents:
        _, _, terminated, truncated, _ = env.step(dict.fromkeys(env.agents, 1))
        gone |= {name for name, ended in terminated.items() if ended and not truncated[name]}
    env.close()
    assert gone == {"Aurora", "Borealis"}
    assert check_wire([str(folder / "ferries")]).ok


def test_the_pages_own_loop(folder):
    whole = blocks("cpp")[0]
    loop = whole[: whole.index("int main")] + (
        'int main(int, char**) {\n    simenv::Client client({"ferry.departs"});\n    const std::uint64_t seed = 7;\n'
        + blocks("cpp")[1]
        + "}\n"
    )
    (folder / "loop.cpp").write_text(loop, encoding="utf-8")
    assert check_wire([str(compiled(folder / "loop.cpp", folder))]).ok
