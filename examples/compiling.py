"""Compiles the models of examples that are written in C++."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path


def compiled(
    target: Path,
    sources: Sequence[Path],
    missing: Callable[[], str],
    command: Callable[[], Sequence[str]],
) -> Path:
    """Compile a program, unless it is up to date.

    Args:
        target: The path of the program.
        sources: The files that it is made of.
        missing: A function that names what is missing for compiling it; its result is empty if
            nothing is missing.
        command: A function that returns the command of the compiler, to which ``-o`` and a path are
            added.

    Returns:
        The path of the program.

    Raises:
        RuntimeError: A tool or library is missing, or the program does not compile.
    """
    if target.exists() and all(
        source.stat().st_mtime < target.stat().st_mtime for source in sources
    ):
        return target
    if lacking := missing():
        raise RuntimeError(f"the model of the {target.name} cannot be compiled without {lacking}")
    target.parent.mkdir(parents=True, exist_ok=True)
    made = target.with_name(f"{target.name}.{os.getpid()}")  # takes its place once it is complete
    done = subprocess.run(
        [*command(), "-o", str(made)], check=False, capture_output=True, text=True, timeout=600
    )
    if done.returncode:
        raise RuntimeError(
            f"the model of the {target.name} does not compile:\n{done.stderr[:4000]}"
        )
    return made.replace(target)
