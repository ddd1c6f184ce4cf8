"""The code of the parts of the page on clients, ready to be run block by block."""

from __future__ import annotations

import re
from pathlib import Path
from types import CodeType

DOCS = Path(__file__).parents[2] / "docs"


def blocks(name: str) -> list[CodeType]:
    """Compile all python blocks of a file in ``docs``, in their order.

    A reader runs them one after the other; a test may look at what they leave behind in between.

    Args:
        name: The file's name.
    """
    text = (DOCS / name).read_text(encoding="utf-8")
    found = re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    return [compile(block, f"docs/{name}, block {number}", "exec") for number, block in enumerate(found)]
