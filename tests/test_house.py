"""The house keeps its size and its shape: budgets from ``pyproject.toml``, and imports in one direction."""

import ast
import importlib
import tomllib
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

import simenv_marl

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "simenv_marl"
BUDGETS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["simenv_marl"]["budgets"]
ABOVE_THE_HEART = ("planning", "experiments", "seats", "data", "remote", "testing", "__main__")


def files_of(folder, suffix=""):
    """All files of a folder, but for those that Python and other tools write."""
    files = (path for path in folder.rglob(f"*{suffix}") if path.is_file())
    return [path for path in files if "__pycache__" not in path.parts and "_build" not in path.parts]


def lines_of(path):
    return len(path.read_text(encoding="utf-8").splitlines())


@cache
def room_of(path):
    """The room that a file's lines count for: the one with the longest prefix of the file's path."""
    name = path.relative_to(PACKAGE).as_posix()
    prefixes = [(prefix, room) for room, given in BUDGETS["rooms"].items() for prefix in given["files"]]
    return max(((len(prefix), room) for prefix, room in prefixes if name.startswith(prefix)), default=(0, "heart"))[1]


@cache
def imports():
    """The modules of the package that each of its modules imports, also inside functions, but not for types alone."""
    names = {}
    for path in files_of(PACKAGE, ".py"):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        names[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return {name: set(_imported(name, path, names)) - {name} for name, path in names.items()}


def _imported(name, path, names):
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    pending = [ast.parse(path.read_text(encoding="utf-8"))]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            continue
        pending += ast.iter_child_nodes(node)
        if isinstance(node, ast.ImportFrom):
            base = package.rsplit(".", node.level - 1)[0] if node.level else ""
            module = ".".join(part for part in (base, node.module) if part)
            for alias in node.names:
                found = f"{module}.{alias.name}"
                if found in names or module in names:
                    yield found if found in names else module


def longest_chain():
    """The longest chain of modules in which each imports the next."""
    graph, chains = imports(), {}

    def chain(name, above=()):
        assert name not in above, f"modules import each other: {(*above, name)}"
        if name not in chains:
            below = [chain(other, (*above, name)) for other in sorted(graph[name])]
            chains[name] = [name, *max(below, key=len, default=[])]
        return chains[name]

    return max(map(chain, graph), key=len)


def test_each_room_and_all_together_keep_their_budgets_of_lines():
    budgets = {"heart": BUDGETS["heart"], **{room: given["lines"] for room, given in BUDGETS["rooms"].items()}}
    lines = Counter()
    for path in files_of(PACKAGE):
        lines[room_of(path)] += lines_of(path)
    assert {room: number for room, number in lines.items() if number > budgets[room]} == {}
    assert lines.total() <= BUDGETS["lines"]


def test_files_are_few_also_at_first_sight_and_none_is_long():
    files = files_of(PACKAGE)
    assert len(files) <= BUDGETS["files"]
    assert {path.name: lines_of(path) for path in files if lines_of(path) > BUDGETS["longest_file"]} == {}
    inside = [path for path in PACKAGE.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()]
    assert sum(path.is_file() for path in inside) <= BUDGETS["files_at_first_sight"]
    assert sum(path.is_dir() for path in inside) <= BUDGETS["folders_at_first_sight"]


def test_public_names_are_in_one_place_each():
    rooms = {room: importlib.import_module(f"simenv_marl.{room}").__all__ for room in simenv_marl.ROOMS}
    names = [*simenv_marl.__all__, *(name for room in rooms.values() for name in room)]
    assert {name for name in names if names.count(name) > 1} == {"SimEnvError", "evaluate"}
    assert len(simenv_marl.__all__) <= BUDGETS["names_at_first_sight"]
    assert len(set(names)) <= BUDGETS["names"]
    assert set(dir(simenv_marl)) == {*simenv_marl.__all__, *simenv_marl.ROOMS, "__version__"}


@pytest.mark.parametrize("name", ["ProcessSimulation", "RolloutPolicy", "NoDecisionError", "handlers"])
def test_a_name_that_is_in_a_room_says_in_which(name):
    with pytest.raises(AttributeError, match=rf"from simenv_marl\.\w+ import {name}"):
        getattr(simenv_marl, name)


def test_the_chain_of_imports_is_short():
    chain = longest_chain()
    assert len(chain) <= BUDGETS["chain_of_imports"], " -> ".join(chain)


def test_the_heart_imports_no_room_above_it():
    above = tuple(f"simenv_marl.{room}" for room in ABOVE_THE_HEART)
    heart = {name: found for name, found in imports().items() if not name.startswith(above)}
    assert {name: bad for name, found in heart.items() if (bad := [o for o in found if o.startswith(above)])} == {}


def test_tests_benchmarks_and_pages_do_not_grow():
    assert sum(map(lines_of, files_of(ROOT / "tests"))) <= BUDGETS["lines_of_tests"]
    assert sum(map(lines_of, files_of(ROOT / "benchmarks"))) <= BUDGETS["lines_of_benchmarks"]
    words = sum(len(path.read_text(encoding="utf-8").split()) for path in files_of(ROOT / "docs", ".md"))
    assert words <= BUDGETS["words_of_docs"]
