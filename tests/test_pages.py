"""A page's code needs only what can be installed or what the page links; the page says how to get anything else."""

import re
import sys
import tomllib
from itertools import chain
from pathlib import Path

import pytest

import simenv_marl

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
ROOMS = {page.stem: page for page in (DOCS / "reference").glob("*.md")}
PAGES = sorted(page.stem for page in DOCS.glob("[!_]*.md")) + sorted(f"reference/{room}" for room in ROOMS)
BESIDE = {"dask", "gym", "gym_fin", "tensordict"}
"""Packages that other packages bring, or that a reader who comes from them has."""


def code_of(page):
    text = (DOCS / f"{page}.md").read_text(encoding="utf-8")
    parts = re.compile(r"^```\{include\} (_\w+\.md)\n```$", re.MULTILINE)
    text = parts.sub(lambda part: (DOCS / part[1]).read_text(encoding="utf-8"), text)
    return text, "".join(re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL))


def imported(code):
    """The packages that code imports."""
    return set(re.findall(r"^(?:>>> |\.\.\. )? *(?:from|import) (\w+)", code, re.MULTILINE))


def can_be_installed():
    """The packages that the project requires, with any of its extras."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    required = chain(project["dependencies"], *project["optional-dependencies"].values())
    return {re.match(r"[\w-]+", requirement)[0].lower().replace("-", "_") for requirement in required}


def sources(text):
    """The files of the examples and studies whose modules a page imports, runs or names."""
    for name in re.findall(r"(?<![\w.])(?:examples|studies)(?:\.\w+)+", text):
        parts = name.split(".")
        paths = (ROOT.joinpath(*parts[:length]).with_suffix(".py") for length in range(len(parts), 1, -1))
        yield from [path for path in paths if path.exists()][:1]


def linked(page, text):
    """The files that a page lets its reader save or read."""
    links = re.findall(r"\{download\}`(?:[^`<]*<)?([^`>]+)>?`|\{literalinclude\} (\S+)", text)
    return {(DOCS / page).parent.joinpath("".join(link)).resolve() for link in links}


@pytest.mark.parametrize("page", PAGES)
def test_the_code_of_a_page_imports_what_can_be_installed_or_saved(page):
    text, code = code_of(page)
    saved = {path.stem for path in linked(page, text)}
    assert imported(code) - sys.stdlib_module_names - can_be_installed() - BESIDE - saved <= {"examples", "studies"}


@pytest.mark.parametrize("page", PAGES)
def test_a_page_links_each_example_that_it_imports_or_runs(page):
    text, _ = code_of(page)
    assert set(sources(text)) <= linked(page, text)


@pytest.mark.parametrize("page", PAGES)
def test_a_page_says_how_to_get_what_only_the_repository_has(page):
    text, _ = code_of(page)
    first = re.search(r"(?<![\w./])(?:benchmarks|examples|studies)[./]\w|^make \w|`make \w", text, re.MULTILINE)
    if first:
        up_to_there = " ".join(text[: text.find("\n\n", first.end())].split())
        assert re.search(r"[Cc]lone the repository\b.* from its root\b", up_to_there)


@pytest.mark.parametrize("page", PAGES)
def test_the_code_of_a_page_fits_on_it(page):
    text, _ = code_of(page)
    code = re.findall(r"^```(?:python|console|sh)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    assert [line for line in "".join(code).splitlines() if len(line) > 100] == []


@pytest.mark.parametrize("room", ["simenv_marl", *simenv_marl.ROOMS])
def test_the_page_of_a_room_lists_the_names_that_it_has(room):
    text = ROOMS[room].read_text(encoding="utf-8")
    names = set(getattr(simenv_marl, room, simenv_marl).__all__)
    described = re.findall(r"^\.\. (auto\w+|data):: (\w+)$|^\.\. \w+:: (\w+)\(\)$", text, re.MULTILINE)
    constants = {name for kind, name, _ in described if kind == "data"}
    table = re.search(r"autosummary::\n   :nosignatures:\n\n((?:   \S+\n)+)", text)[1].split()
    assert {name for name in table if "." not in name} | constants == names
    if f"automodule:: simenv_marl.{room}\n   :members:" not in text:
        elsewhere = {"evaluate", "SimEnvError"} if room == "simenv_marl" else set()
        assert {name or made for _, name, made in described} == names - elsewhere
