"""A file is data: names that it must not use are refused, and malformed ones are errors."""

import json
import subprocess
from functools import partial
from os import system

import pytest

from simenv_marl import load_episode, save_episode
from simenv_marl.errors import EpisodeFileError, SimEnvError
from simenv_marl.files.names import find, names_of
from tests.files.test_episodes import changed, lines_of
from tests.worlds import saved

HERE = __name__
touched = []


class Holder:
    """A class whose attributes are names."""

    run = staticmethod(lambda: touched.append("static"))
    shell = system

    def method(self):
        """Do nothing."""

    @classmethod
    def made(cls):
        """Make one."""


shell = system
shelled = partial(subprocess.run, ["true"])
named = partial(Holder)
holder = Holder()
method = holder.method
unnamed = lambda observation: 1  # noqa: E731
folder = subprocess


@pytest.mark.parametrize(
    "thing",
    [Holder, Holder.method, Holder.made, holder, named, method, unnamed, touched, saved.yard],
)
def test_episode_file_saves_module_level_objects_by_name(thing):
    name = names_of([thing])[id(thing)]
    assert find(name) == thing


@pytest.mark.parametrize("thing", [Holder().method, lambda: 1, Holder(), partial(Holder)])
def test_save_episode_finds_no_name_for_objects_that_no_module_contains(thing):
    assert names_of([thing]) == {}


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("builtins.exec", "standard library"),
        ("os.system", "standard library"),
        ("antigravity.fly", "standard library"),
        ("__main__.main", "scripts"),
        (f"{HERE}.shell", "another module"),
        (f"{HERE}.shelled", "another module"),
        (f"{HERE}.system", "another module"),
        (f"{HERE}.subprocess.run", "another module"),
        (f"{HERE}.folder.run", "another module"),
        (f"{HERE}.load_episode", "another module"),
        (f"{HERE}.Holder.shell", "another module"),
        (f"{HERE}.Holder.__init__", "no dotted name"),
        (f"{HERE}.holder.method", "has no 'method'"),
        (f"{HERE}.nothing", "has no 'nothing'"),
        (HERE, "it is a module"),
        ("tests", "no dotted name"),
        ("", "no dotted name"),
        ("tests.no_such_module.thing", "no_such_module"),
        ("no_such_package.thing", "no_such_package"),
        ("simenv_marl.core.copies.packing.unpack", "another module"),
    ],
)
def test_episode_file_with_a_name_of_another_object_is_refused(name, problem):
    with pytest.raises(EpisodeFileError, match=problem):
        find(name)


@pytest.fixture
def path(tmp_path):
    save_episode(saved.mid_episode(), tmp_path / "a")
    return tmp_path / "a"


@pytest.mark.parametrize("name", ["os.system", "builtins.print", f"{HERE}.shell"])
@pytest.mark.parametrize(
    "change",
    [
        lambda name: {"simulation": {"name": name}},
        lambda name: {"simulation": {"call": {"name": name}, "args": ["x"], "keywords": {}}},
        lambda name: {"options": {"policies": {"planner": {"name": name}}}},
        lambda name: {"options": {"team_reward": {"name": name}}},
        lambda name: {
            "options": {"plugins": [[{"name": name}, "tests.worlds.saved.yard", "after"]]}
        },
        lambda name: {"points": [{"point": "a.b", "definition": name, "spaces": ""}]},
    ],
)
def test_episode_file_names_are_checked_in_every_field(change, name, path):
    changed(path, 0, lambda line: line.update(change(name)))
    with pytest.raises(EpisodeFileError, match="cannot be used"):
        load_episode(path)


@pytest.mark.parametrize(
    "change",
    [
        {"points": [{"point": "os.system", "definition": None, "spaces": ""}]},
        {"options": {"plugins": [[{"name": f"{saved.__name__}.yard"}, "os.system", "after"]]}},
        {"options": {"record": "/tmp/elsewhere"}},
        {"view": "vector"},
        {"view": []},
        {"episode": 2},
        {"seed": "seven"},
        {"seed": -1},
        {"simulation": {"name": 7}},
        {"simulation": {"pickle": "gASV"}},
        {"simulation": None},
        {"points": 7},
        {"options": []},
        {"options": {"no_such_option": 1}},
        {"reset": {"array": [1], "dtype": "O"}},
        {"versions": 3, "seed": 99},
    ],
)
def test_episode_file_with_a_malformed_first_line_is_refused(change, path):
    changed(path, 0, lambda line: line.update(change))
    with pytest.raises(SimEnvError):
        load_episode(path)


@pytest.mark.parametrize(
    "line",
    [
        b"[1, 2]",
        b"7",
        b"{}",
        b'"text"',
        b"torn {",
        b"\xff\xfe",
        b"[" * 100_000,
        b'{"agent": [], "seen": {}, "action": 1}',
        b'{"agent": "planner", "action": {"array": [1], "dtype": "O"}}',
        b'{"agent": "planner", "action": {"array": [[1], [1, 2]], "dtype": "<f4"}}',
        b'{"agent": "planner", "action": {"scalar": 1e99, "dtype": "<i4"}}',
        b'{"agent": "planner", "action": {"name": "os.system"}}',
        b'{"reseed": "now"}',
        b'{"exit": "planner"}',
        b'{"end": "terminated"}',
        b'{"error": []}',
    ],
)
def test_episode_file_with_a_malformed_line_is_refused(line, path):
    lines = path.read_bytes().splitlines()
    lines[3] = line
    path.write_bytes(b"\n".join(lines))
    with pytest.raises(SimEnvError):
        load_episode(path)


@pytest.mark.parametrize("content", [b"", b"\n\n", b"{}\n", b'{"episode": 1}\n', b"\x00" * 99])
def test_episode_file_without_an_episode_is_refused(content, tmp_path):
    (tmp_path / "a").write_bytes(content)
    with pytest.raises(EpisodeFileError):
        load_episode(tmp_path / "a")


def test_episode_file_that_is_refused_calls_no_named_function(path):
    lines = lines_of(path)
    assert json.dumps(lines).count("pickle") == 0
    assert touched == []
