"""The notebooks of pages show what the pages show.

Those of the documentation are executed whenever it is built.
"""

from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat")
notebooks = pytest.importorskip("tools.notebooks")

DOCS = Path(__file__).parents[1] / "docs"
PAGE = """# A page

See [](concepts.md), and {download}`model.py`.

```python
>>> from model import VALUE
>>> VALUE + 1
2
>>> print("a line")
a line
>>> 1 / 0
Traceback (most recent call last):
    ...
ZeroDivisionError: division by zero

```
"""


@pytest.mark.parametrize("page", notebooks.PAGES)
def test_docs_notebook_text_has_no_markup_that_only_pages_understand(page):
    made = notebooks.notebook(DOCS, page)
    text = "\n".join(cell["source"] for cell in made["cells"] if cell["cell_type"] == "markdown")
    for mark in (".md)", ".md#", "{download}", "```", ".ipynb"):
        assert mark not in text
    assert len({cell["id"] for cell in made["cells"]}) == len(made["cells"])


@pytest.fixture
def page(tmp_path):
    for name, text in {
        "page.md": PAGE,
        "concepts.md": "# Concepts\n",
        "model.py": "VALUE = 1\n",
    }.items():
        (tmp_path / name).write_text(text)
    return tmp_path / "page.md"


def test_docs_notebook_is_executed_and_written_beside_its_page(page):
    notebooks.write_notebooks(page.parent, ("page",))
    text, model, *cells = nbformat.read(
        page.parent / "_notebooks" / "page.ipynb", as_version=4
    ).cells
    assert text.source == "# A page\n\nSee *Concepts*, and `model.py`."
    assert model.source == "%%writefile model.py\nVALUE = 1"
    assert [cell.source for cell in cells] == [
        "from model import VALUE\nVALUE + 1",
        'print("a line")',
        "1 / 0",
    ]
    value, printed, error = (cell.outputs[0] for cell in cells)
    assert (value.data["text/plain"], printed.text, error.ename) == (
        "2",
        "a line\n",
        "ZeroDivisionError",
    )
    assert [cell.execution_count for cell in cells] == [2, 3, 4]


@pytest.mark.parametrize(
    ("shown", "wrong"), [("\n2\n", "\n3\n"), ("\na line", "\nno line"), ("ZeroDiv", "Zero")]
)
def test_docs_notebook_is_refused_if_its_page_shows_other_output(page, shown, wrong):
    page.write_text(PAGE.replace(shown, wrong))
    with pytest.raises(ValueError, match="and its page has"):
        notebooks.write_notebooks(page.parent, ("page",))
