"""Programs in C++ for tests, compiled once for each session."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

ROOT = Path(__file__).parents[2]
HERE = Path(__file__).parent

WARNINGS = ("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Werror")

COMPILER = shutil.which(os.environ.get("CXX", "g++")) or shutil.which("clang++")


def compiled(source: Path, folder: Path, *flags: str) -> Path:
    """Compile a program that includes the client; return where it lies."""
    assert COMPILER is not None
    program = folder / f"{source.stem}{''.join(flags)}"
    client = f"-I{ROOT / 'clients' / 'cpp'}"
    command = [COMPILER, "-std=c++17", "-O1", *WARNINGS, client, str(source), "-o", str(program), *flags]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[:4000]
    return program
