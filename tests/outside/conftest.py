"""Processes are tested with every driver, and what goes on in them with one.

Programs in C++ are compiled for that.
"""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.contract.conftest import pytest_generate_tests

__all__ = ["pytest_generate_tests"]  # with every driver

HERE = Path(__file__).parent
COMPILER = shutil.which(os.environ.get("CXX", "g++")) or shutil.which("clang++")
WARNINGS = ("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Werror")


def compiled(source, folder):
    """Compile a program that includes the client; return where it lies."""
    program, client = folder / source.stem, HERE.parents[1] / "clients" / "cpp"
    command = [COMPILER, "-std=c++17", "-O1", *WARNINGS, f"-I{client}", source, "-o", program]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[:4000]
    return program


@pytest.fixture
def make_env():
    """Makes environments, and closes them."""
    made = []

    def make(kind, *arguments, **options):
        made.append(kind(*arguments, **options))
        return made[-1]

    yield make
    for env in made:
        env.close()
