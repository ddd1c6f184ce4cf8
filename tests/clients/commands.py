"""The commands that the Makefile calls, each in a process of its own: what one has saved another one has to load."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def run(module: str, *arguments: object, **environment: str) -> str:
    """Run a module of the examples from its command line.

    Args:
        module: Its name below ``examples``.
        *arguments: What follows on the command line.
        **environment: Variables of its process, beside those of this one.

    Returns:
        What it has printed.
    """
    done = subprocess.run(
        [sys.executable, "-m", f"examples.{module}", *map(str, arguments)],
        cwd=ROOT,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout
