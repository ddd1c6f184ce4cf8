"""The notebooks of pages: their cells run one after the other, and show what the page shows."""

import ast
import doctest
import io
import json
from contextlib import redirect_stdout
from pathlib import Path

import pytest
from tools.notebooks import PAGES, notebook, write_notebooks

from tests.worlds.undone import models_of_pages_forgotten, registries_put_back

DOCS = Path(__file__).parents[1] / "docs"
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def run(source, names):
    """What a cell shows: what it prints, and the value of its last line."""
    *lines, last = ast.parse(source).body
    with redirect_stdout(io.StringIO()) as printed:
        exec(compile(ast.Module(lines, []), "cell", "exec"), names)
        exec(compile(ast.Interactive([last]), "cell", "single"), names)
    return printed.getvalue()


@pytest.mark.parametrize("page", ["tutorial", "many-agents"])
def test_a_notebook_runs_in_an_empty_folder(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    names = {"__name__": "__main__"}
    with registries_put_back(), models_of_pages_forgotten():
        for cell in notebook(DOCS, page)["cells"]:
            if cell["cell_type"] == "markdown":
                continue
            source, outputs = cell["source"], cell["outputs"]
            if source.startswith("%%writefile "):
                name, text = source.removeprefix("%%writefile ").split("\n", 1)
                Path(name).write_text(text, encoding="utf-8")
            elif outputs and outputs[0]["output_type"] == "error":
                with pytest.raises(Exception, match=r".") as raised:
                    run(source, names)
                assert raised.typename == outputs[0]["ename"].rpartition(".")[2]
                del raised
            else:
                want = outputs[0]["text"] if outputs else ""
                got = run(source, names)
                assert doctest.OutputChecker().check_output(want, got, FLAGS), source
        names.clear()


@pytest.mark.parametrize("page", PAGES)
def test_the_text_of_a_notebook_has_nothing_that_only_pages_know(page):
    made = notebook(DOCS, page)
    text = "\n".join(cell["source"] for cell in made["cells"] if cell["cell_type"] == "markdown")
    for mark in (".md)", ".md#", "{download}", "```", ".ipynb"):
        assert mark not in text
    assert len({cell["id"] for cell in made["cells"]}) == len(made["cells"])


def test_notebooks_are_written_beside_the_pages(tmp_path):
    for name in [*PAGES, "concepts"]:
        (tmp_path / f"{name}.md").write_text("# A page\n\nSee [](concepts.md).\n\n```python\n>>> 1 + 1\n2\n\n```\n")
    write_notebooks(tmp_path)
    for page in PAGES:
        made = json.loads((tmp_path / "_notebooks" / f"{page}.ipynb").read_text())
        assert [cell["source"] for cell in made["cells"]] == ["# A page\n\nSee *A page*.", "1 + 1"]
        assert made["cells"][1]["outputs"][0]["text"] == "2\n"
