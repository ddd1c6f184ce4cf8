"""The code of the page on clients, ready to be run."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parents[2] / "docs"


def steps(section: str, monkeypatch: Any) -> Iterator[dict[str, Any]]:
    """Run the python blocks of a section of ``docs/clients.md``, one after the other, as its reader would.

    Args:
        section: The heading of the section.
        monkeypatch: Pytest's, which takes back what the run has changed about imports.

    Yields:
        After each block, the names that the code has left behind.
    """
    text = (DOCS / "clients.md").read_text(encoding="utf-8")
    _, _, rest = text.partition(f"\n## {section}\n")
    body = rest.partition("\n## ")[0]
    blocks = re.findall(r"^```python\n(.*?)^```$", body, re.MULTILINE | re.DOTALL)
    assert blocks, f"docs/clients.md has no python under {section!r}"
    monkeypatch.syspath_prepend(DOCS)
    for model in ("bakery", "bakery_env", "lake"):
        monkeypatch.delitem(sys.modules, model, raising=False)
    names: dict[str, Any] = {"__name__": "__main__"}
    for number, block in enumerate(blocks):
        exec(compile(block, f"docs/clients.md: {section}, block {number}", "exec"), names)
        yield names
