"""Pages: their code runs with the packages they name, and their quotations are the library's."""

import builtins
import random
import re
import shlex
import subprocess
import sys
import tomllib
from fnmatch import fnmatch
from functools import cache
from itertools import chain
from pathlib import Path

import pytest
from examples.greenhouse_coop import model

import simenv_marl
from tests.clients.page import blocks
from tests.worlds.models import play

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
CONFIG = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
BUDGETS = CONFIG["tool"]["simenv_marl"]["budgets"]
EXTRAS = set(CONFIG["project"]["optional-dependencies"])
ROOMS = {page.stem: page for page in (DOCS / "reference").glob("*.md")}
PAGES = sorted(page.stem for page in DOCS.glob("[!_]*.md")) + sorted(
    f"reference/{room}" for room in ROOMS
)
FRONT = [
    *("README.md", "CONTRIBUTING.md", "SECURITY.md", ".github/PULL_REQUEST_TEMPLATE.md"),
    *(f"docs/{page}.md" for page in PAGES),
]
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
    project = CONFIG["project"]
    required = chain(project["dependencies"], *project["optional-dependencies"].values())
    return {
        re.match(r"[\w-]+", requirement)[0].lower().replace("-", "_") for requirement in required
    }


def sources(text):
    """The files of the examples and studies whose modules a page imports, runs or names."""
    for name in re.findall(r"(?<![\w.])(?:examples|studies)(?:\.\w+)+", text):
        parts = name.split(".")
        paths = (
            ROOT.joinpath(*parts[:length]).with_suffix(".py") for length in range(len(parts), 1, -1)
        )
        yield from [path for path in paths if path.exists()][:1]


def linked(page, text):
    """The files that a page lets its reader save or read."""
    links = re.findall(r"\{download\}`(?:[^`<]*<)?([^`>]+)>?`|\{literalinclude\} (\S+)", text)
    return {(DOCS / page).parent.joinpath("".join(link)).resolve() for link in links}


@pytest.mark.parametrize("page", PAGES)
def test_docs_page_has_short_code_lines_and_names_required_packages(page):
    text, code = code_of(page)
    saved = {path.stem for path in linked(page, text)}
    assert imported(code) - sys.stdlib_module_names - can_be_installed() - BESIDE - saved <= {
        "examples",
        "studies",
    }
    assert set(sources(text)) <= linked(page, text)  # each example that it imports or runs
    first = re.search(
        r"(?<![\w./])(?:benchmarks|examples|studies)[./]\w|^make \w|`make \w", text, re.MULTILINE
    )
    if first:  # only the repository has it
        up_to_there = " ".join(text[: text.find("\n\n", first.end())].split())
        assert re.search(r"[Cc]lone the repository\b.* from its root\b", up_to_there)
    code = re.findall(r"^```(?:python|console|sh)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    assert [line for line in "".join(code).splitlines() if len(line) > 100] == []


def words_of(page):
    return len((DOCS / f"{page}.md").read_text(encoding="utf-8").split())


def test_docs_have_few_pages_and_few_words():
    captions = re.findall(
        r":caption: (.+)\n\n((?:[\w-]+\n)+)", (DOCS / "index.md").read_text(encoding="utf-8")
    )
    pages = {caption: names.split() for caption, names in captions}
    pages.pop("Studies")
    others = {
        page: words_of(page)
        for page in {"index", *chain(*pages.values())} - {"changelog", "reference"}
    }
    assert len(pages) <= 7
    assert len(others) <= BUDGETS["pages"]
    assert sum(others.values()) <= BUDGETS["words_of_pages"], others


@pytest.mark.parametrize("room", ["simenv_marl", *simenv_marl.ROOMS])
def test_docs_reference_page_lists_all_public_names_of_its_module(room):
    pages = [page for name, page in ROOMS.items() if name not in simenv_marl.ROOMS]
    pages = [ROOMS[room]] if room in simenv_marl.ROOMS else pages
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    names = set(getattr(simenv_marl, room, simenv_marl).__all__)
    elsewhere = {"evaluate", "SimEnvError"} if room == "simenv_marl" else set()
    described = re.findall(
        r"^\.\. (auto\w+|data):: (\w+)$|^\.\. \w+:: (\w+)\(\)$", text, re.MULTILINE
    )
    constants = {name for kind, name, _ in described if kind == "data"}
    tables = re.findall(r"autosummary::\n   :nosignatures:\n\n((?:   \S+\n)+)", text)
    table = " ".join(tables).split()
    assert {name for name in table if "." not in name} | constants == names - elsewhere
    if f"automodule:: simenv_marl.{room}\n   :members:" not in text:
        assert {name or made for _, name, made in described} == names - elsewhere


@cache
def texts():
    """The text of all tests, and of the examples and the script that they use."""
    paths = [*ROOT.glob("tests/**/*.py"), *ROOT.glob("examples/**/*.py"), ROOT / "tools/outside.sh"]
    return {path: path.read_text(encoding="utf-8") for path in paths}


@cache
def programs_of_tests():
    """The modules that tests run as programs, and our commands; a star is a placeholder."""
    found = set()
    for path in ROOT.glob("tests/**/*.py"):
        text = re.sub(r"\{.+?\}", "*", texts()[path])
        found.update(re.findall(r'"-m", f?"([^"]+)"', text))
        found.update(
            f"simenv_marl {name}"
            for name in re.findall(r'(?:main\(\[|"simenv_marl", )"([\w-]+)"', text)
        )
        for package, names in re.findall(
            r"^ *from ((?:examples|studies)\S*) import (.+)$", text, re.MULTILINE
        ):
            aliases = (name.partition(" as ") for name in names.split(", "))
            found.update(
                f"{package}.{name}"
                for name, _, alias in aliases
                if f" {alias or name}.main(" in text
            )
    return found


def commands_of(text):
    """The commands of a page, in its blocks and lines, without the blocks marked as not run."""
    yield from re.findall(r"`((?:make|python -m) [^`<]+)`", text)
    blocks = re.findall(
        r"^(<!-- not run: .+ -->\n\n?)?( *)```(sh|console)\n(.*?)^ *```$",
        text,
        re.DOTALL | re.MULTILINE,
    )
    for mark, _, language, block in blocks:
        lines = [line.partition(" #")[0].strip() for line in block.replace("\\\n", "").splitlines()]
        if not mark:
            yield from (
                line.removeprefix("$ ")
                for line in lines
                if language == "sh" or line.startswith("$ ")
            )


def untested(command, written):
    """The untested parts of a command; earlier commands write the modules ``written``."""
    if command.startswith("make "):
        dry_run = [*shlex.split(command), "--dry-run"]
        recipe = subprocess.run(
            dry_run, cwd=ROOT, capture_output=True, text=True, check=True
        ).stdout
        command = "; ".join(re.findall(r"-m (?:examples|studies)\S+", recipe)) or "-m pytest"
    extras = re.findall(r"pip install .*\[(.+)\]", command)
    programs = [
        name.replace("$script", "*")
        for name in re.findall(r"-m (simenv_marl \S+|[\w.$]+)", command)
    ]
    if programs or "pip install" in command:
        known = {"pytest", "venv", *written, *programs_of_tests()}
        unknown = {
            name for name in programs if not any(fnmatch(name, pattern) for pattern in known)
        }
        return unknown | set(chain(*(names.split(",") for names in extras))) - EXTRAS
    # a file, a class, a package
    name = [word for word in command.split() if not word.isdigit()][-1].rpartition("/")[2]
    named = re.compile(rf'["/ ]{re.escape(name)}\b')
    return set() if name in written or any(map(named.search, texts().values())) else {name}


@pytest.mark.parametrize("page", FRONT)
def test_docs_page_commands_are_run_by_tests_or_marked_as_not_run(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    written = re.findall(r"-m simenv_marl new \w+ (\w+)", text)
    found = {
        command: missing for command in commands_of(text) if (missing := untested(command, written))
    }
    assert found == {}


# -- the pages that a newcomer meets first ---------------------------------------------------------


def run(code):
    """Run code. Returns its names."""
    names = {}
    exec(code, names)
    return names


def test_readme_code_gives_the_rewards_that_it_shows():
    (code,) = blocks("index.md")
    env = run(code)["env"]
    assert env.reset(seed=1)[0] == [5.0]
    rewards = [env.step(action)[1] for action in (1, 1, 0, 1, 1)]
    assert rewards == [-1.0, -2.0, -1.0, -2.0, -3.0]
    env.close()


def test_readme_pictures_and_links_lead_to_files():
    """No badge stands for a service that does not exist."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    pictures = re.findall(r"!\[[^]]*\]\(([^)]*)\)|<img src=\"([^\"]*)\"", text)
    links = [link for link in re.findall(r"\]\(([^)]*)\)", text) if not link.startswith("https://")]
    assert len(pictures) == text.count("![") + text.count("<img") > 0
    assert [path for path in (*map("".join, pictures), *links) if not (ROOT / path).is_file()] == []


def told_in_an_episode(env, seed):
    """What is told in an episode of random actions, turn by turn."""
    actions = random.Random(seed)
    turns = play(env, lambda agent, env: actions.randrange(4), seed=seed)
    return [(turn.agent, turn.observation.tolist(), *turn[2:5]) for turn in turns]


def test_docs_migrated_pettingzoo_example_matches_the_hand_written_one():
    before, after = map(run, blocks("coming-from.md", "PettingZoo"))
    told = [told_in_an_episode(before["StallEnv"](), seed) for seed in range(20)]
    assert told == [told_in_an_episode(after["env"], seed) for seed in range(20)]
    assert len({len(episode) for episode in told}) > 3  # the seller is not asked every day


def test_docs_migrated_example_of_the_paper_runs(monkeypatch):
    monkeypatch.setitem(sys.modules, "model", model)
    (code,) = blocks("coming-from.md", "Sim-Env")
    names = run(code)
    assert names["terminated"]
    assert names["alive"](names["env"].simulation.greenhouse) == 0
    assert -1 <= names["reward"] <= 1
    names["env"].close()


def test_docs_problems_page_quotes_real_error_messages():
    text = (DOCS / "problems.md").read_text(encoding="utf-8")
    quoted = re.findall(r"^### (.+)$", text, re.MULTILINE)  # the headings
    assert len(quoted) >= 20
    sources = (path.read_text(encoding="utf-8") for path in (ROOT / "src").rglob("*.py"))
    said = "".join(re.sub(r'"\s+f?"', "", source) for source in sources)  # each text in one line
    for quote in quoted:
        parts = [re.escape(part.strip()) for part in quote.replace("`", "").split("...")]
        assert re.search(".*".join(parts), said), quote
    named = set(re.findall(r"`([A-Z]\w+Error)`", text))
    assert {name for name in named if not hasattr(builtins, name)} <= set(
        simenv_marl.errors.__all__
    )


TERMS = (
    "parameter sharing", "centralised training", "CTDE", "self-play", "black death",
    "discrete-event simulation", "agent-based model", "semi-MDP", "callback", "hook",
    "DAgger", "action mask", "PPO", "wrapper", "seed", "pickle", "AEC", "turn-based", "MARL",
    "behavior cloning",
)  # fmt: skip


def test_docs_glossary_explains_the_terms_that_users_search_for():
    assert set(TERMS) <= set((DOCS / "glossary.md").read_text(encoding="utf-8").splitlines())
