"""Check a release: changelog, citation and built files name its version, and builds are the same.

The version stands in one place. ``make release`` builds and tests the wheel and the source
distribution, builds both again in ``build/again``, and then runs this. It prints the command that
uploads them.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def problems() -> list[str]:
    """Return what is wrong, each with what to do."""
    text = (ROOT / "src/simenv_marl/__init__.py").read_text(encoding="utf-8")
    found = re.search(r'^__version__ = "(\S+)"$', text, re.MULTILINE)
    assert found, "src/simenv_marl/__init__.py has no __version__"
    version = found[1]
    wrong = []
    heading = re.search(
        r"^## (.*)$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    if heading is None or not re.fullmatch(
        rf"{re.escape(version)} \(\d{{4}}-\d\d-\d\d\)", heading[1]
    ):
        wrong.append(f"CHANGELOG.md must begin with the heading '## {version} (YYYY-MM-DD)'")
    if f"\nversion: {version}\n" not in (ROOT / "CITATION.cff").read_text(encoding="utf-8"):
        wrong.append(f"CITATION.cff must have the line 'version: {version}'")
    for name in (f"simenv_marl-{version}-py3-none-any.whl", f"simenv_marl-{version}.tar.gz"):
        built, again = ROOT / "dist" / name, ROOT / "build" / "again" / name
        if not (built.exists() and again.exists()):
            wrong.append(f"dist/{name} or build/again/{name} is missing; run make release")
        elif built.read_bytes() != again.read_bytes():
            wrong.append(f"dist/{name} and build/again/{name} differ; builds must be the same")
    return wrong


if __name__ == "__main__":
    found = problems()
    if not found:
        print("\nReady. This uploads it:\n\n    .venv-wheel/bin/twine upload dist/*\n")
    sys.exit("\n".join(found) or 0)
