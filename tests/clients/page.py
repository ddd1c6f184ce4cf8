"""The code of the page on clients, for a run in a reader's order: block after block."""

from __future__ import annotations

import re
from pathlib import Path

from tests.worlds.models import models_of_pages_forgotten

DOCS = Path(__file__).parents[2] / "docs"


def blocks(name, section=None):
    """Compile all python blocks of a file in ``docs``, or of its section or tab, in order."""
    text = (DOCS / name).read_text(encoding="utf-8")
    tab = f"{{tab-item}} {section}\n"
    if tab in text:
        text = text.partition(tab)[2].partition("{tab-item}")[0]
    elif section is not None:
        level, _, rest = text.partition(f"# {section}\n")
        level = level.rpartition("\n")[2] + "#"  # up to the next heading that is as high
        text = re.split(rf"^#{{2,{len(level)}}} ", rest, maxsplit=1, flags=re.MULTILINE)[0]
    found = re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    assert found, f"docs/{name} has no python under {section!r}"
    where = f"docs/{name}: {section}" if section else f"docs/{name}"
    return [
        compile(block, f"{where}, block {number}", "exec") for number, block in enumerate(found)
    ]


def steps(section, monkeypatch):
    """Run the python blocks of a section of ``docs/clients.md``, and yield the names after each."""
    monkeypatch.syspath_prepend(DOCS)
    names = {"__name__": "__main__"}
    with models_of_pages_forgotten():
        for code in blocks("clients.md", section):
            exec(code, names)
            yield names
