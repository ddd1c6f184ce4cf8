"""The code of the page on clients, ready to be run."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parents[2] / "docs"


def run(section: str, monkeypatch: Any) -> dict[str, Any]:
    """Run all python blocks of a section of ``docs/clients.md``, one after the other, as its reader would.

    Args:
        section: The heading of the section.
        monkeypatch: Pytest's, which takes back what the run has changed about imports.

    Returns:
        The names that the code leaves behind.
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
    return names
