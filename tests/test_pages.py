"""Pages can be read by themselves: their code needs nothing that they do not link."""

import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"
PAGES = (
    "tutorial", "concepts", "how-to", "options", "rounds", "vector", "many-agents", "extensions", "variants",
    "checking", "branches", "planning", "clients", "looking", "demonstrations", "experiments", "sweeps", "outside",
    "clients-cpp", "c-callbacks", "energyplus", "contributing", "wolf-sheep", "many-simulations", "speed", "wire",
    "shared-policy", "planning-experiments",
)  # fmt: skip


def code_of(page):
    text = (DOCS / f"{page}.md").read_text(encoding="utf-8")
    parts = re.compile(r"^```\{include\} (_\w+\.md)\n```$", re.MULTILINE)
    text = parts.sub(lambda part: (DOCS / part[1]).read_text(encoding="utf-8"), text)
    return text, "".join(re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL))


@pytest.mark.parametrize("page", PAGES)
def test_a_page_links_each_file_that_its_code_imports(page):
    text, code = code_of(page)
    linked = set(re.findall(r"\{download\}`([\w.]+)`|\{literalinclude\} ([\w.]+)", text))
    files = {file for pair in linked for file in pair}
    for model in set(re.findall(r"(?:from|import) (\w+)", code)):
        assert not (DOCS / f"{model}.py").exists() or f"{model}.py" in files, model


@pytest.mark.parametrize("page", PAGES)
def test_the_code_of_a_page_imports_nothing_that_only_the_repository_has(page):
    _, code = code_of(page)
    assert not re.search(r"(from|import) (benchmarks|clients|examples|tests|tools)\b", code)


@pytest.mark.parametrize("page", PAGES)
def test_the_code_of_a_page_fits_on_it(page):
    text, _ = code_of(page)
    code = re.findall(r"^```(?:python|console|sh)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    assert [line for line in "".join(code).splitlines() if len(line) > 100] == []
