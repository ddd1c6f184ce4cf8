"""The house keeps its size and its shape: budgets from ``pyproject.toml``."""

import importlib
import tomllib
from collections import Counter
from pathlib import Path

import grimp
import pytest

import simenv_marl

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "simenv_marl"
BUDGETS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"][
    "simenv_marl"
]["budgets"]


def files_of(folder, suffix=""):
    """All files of a folder, but for those that Python and other tools write."""
    files = (path for path in folder.rglob(f"*{suffix}") if path.is_file())
    return [
        path for path in files if "__pycache__" not in path.parts and "_build" not in path.parts
    ]


def lines_of(path):
    return len(path.read_text(encoding="utf-8").splitlines())


def room_of(path):
    """The room of a file's lines: the one with the longest prefix of the file's path."""
    name = path.relative_to(PACKAGE).as_posix()
    prefixes = [
        (prefix, room) for room, given in BUDGETS["rooms"].items() for prefix in given["files"]
    ]
    return max(
        ((len(prefix), room) for prefix, room in prefixes if name.startswith(prefix)),
        default=(0, "heart"),
    )[1]


def test_each_room_and_all_together_keep_their_budgets_of_lines():
    budgets = {
        "heart": BUDGETS["heart"],
        **{room: given["lines"] for room, given in BUDGETS["rooms"].items()},
    }
    lines = Counter()
    for path in files_of(PACKAGE):
        lines[room_of(path)] += lines_of(path)
    assert {room: number for room, number in lines.items() if number > budgets[room]} == {}
    assert lines.total() <= BUDGETS["lines"]


def test_files_are_few_also_at_first_sight_and_none_is_long():
    files = files_of(PACKAGE)
    assert len(files) <= BUDGETS["files"]
    assert {
        path.name: lines_of(path) for path in files if lines_of(path) > BUDGETS["longest_file"]
    } == {}
    inside = [
        path
        for path in PACKAGE.iterdir()
        if path.suffix == ".py" or (path / "__init__.py").exists()
    ]
    assert sum(path.is_file() for path in inside) <= BUDGETS["files_at_first_sight"]
    assert sum(path.is_dir() for path in inside) <= BUDGETS["folders_at_first_sight"]


def test_public_names_are_in_one_place_each():
    rooms = {
        room: importlib.import_module(f"simenv_marl.{room}").__all__ for room in simenv_marl.ROOMS
    }
    names = [*simenv_marl.__all__, *(name for room in rooms.values() for name in room)]
    assert {name for name in names if names.count(name) > 1} == {"SimEnvError", "evaluate"}
    assert len(simenv_marl.__all__) <= BUDGETS["names_at_first_sight"]
    assert len(set(names)) <= BUDGETS["names"]
    assert set(dir(simenv_marl)) == {*simenv_marl.__all__, *simenv_marl.ROOMS, "__version__"}


@pytest.mark.parametrize(
    "name", ["ProcessSimulation", "RolloutPolicy", "NoDecisionError", "handlers"]
)
def test_a_name_that_is_in_a_room_says_in_which(name):
    with pytest.raises(AttributeError, match=rf"from simenv_marl\.\w+ import {name}"):
        getattr(simenv_marl, name)


def test_the_chain_of_imports_is_short():
    """Also counts imports inside functions, but none for types alone.

    ``make check`` looks at their direction.
    """
    graph, chains = (
        grimp.build_graph("simenv_marl", exclude_type_checking_imports=True, cache_dir=None),
        {},
    )

    def chain(name, above=()):
        assert name not in above, f"modules import each other: {(*above, name)}"
        if name not in chains:
            below = [
                chain(other, (*above, name))
                for other in graph.find_modules_directly_imported_by(name)
            ]
            chains[name] = [name, *max(below, key=len, default=[])]
        return chains[name]

    longest = max(map(chain, graph.modules), key=len)
    assert len(longest) <= BUDGETS["chain_of_imports"], " -> ".join(longest)


def test_tests_benchmarks_and_pages_do_not_grow():
    assert sum(map(lines_of, files_of(ROOT / "tests"))) <= BUDGETS["lines_of_tests"]
    assert sum(map(lines_of, files_of(ROOT / "benchmarks"))) <= BUDGETS["lines_of_benchmarks"]
    words = sum(
        len(path.read_text(encoding="utf-8").split()) for path in files_of(ROOT / "docs", ".md")
    )
    assert words <= BUDGETS["words_of_docs"]
