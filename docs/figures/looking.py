"""Draw the figures of the page ``looking.md`` with the page's own code: ``python docs/figures/looking.py``."""

from __future__ import annotations

import sys
from doctest import DocTestParser
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent


def main() -> None:
    """Run the examples of the page, and save their figures."""
    sys.path.insert(0, str(HERE.parent))  # for the models beside the page
    names: dict[str, Any] = {"__name__": "__main__"}
    for example in DocTestParser().get_examples((HERE.parent / "looking.md").read_text(encoding="utf-8")):
        if not example.options:  # leaves out the examples that doctest skips
            exec(compile(example.source, "looking.md", "exec"), names)
    for name in ("shop", "lake", "returns"):
        names[name].savefig(HERE / f"looking-{name}.png", dpi=100)


if __name__ == "__main__":
    main()
