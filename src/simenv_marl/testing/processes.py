"""Runs in new processes, whose strings hash differently: sets of strings have another order."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from subprocess import run
from tempfile import TemporaryDirectory

import numpy as np

from ..core import pack_plainly, unpack
from .runs import silence


def run_elsewhere(recipe: bytes, seconds: float, hash_seed: int) -> dict[str, str]:
    """Run a recipe for ``main`` in a new process with a hash seed; return the parts as texts.

    Raises:
        SubprocessError: The process has failed, or did not end in time.
    """
    code = f"import sys; sys.path[:] = {sys.path!r}; import {__name__} as m; m.main(sys.argv[1])"
    with TemporaryDirectory() as folder:
        file = Path(folder, "recipe")
        file.write_bytes(recipe)
        run(
            [sys.executable, "-c", code, str(file)],
            env={**os.environ, "PYTHONHASHSEED": str(hash_seed)},
            timeout=seconds,
            check=True,
            capture_output=True,
        )
        texts: dict[str, str] = unpack(file.read_bytes())
        return texts


def main(name: str) -> None:
    """Run the recipe in a file, a ``Runner`` and a seed, and write the parts of the runs into it.

    Raises:
        BaseException: An error of a run.
    """
    file = Path(name)
    runner, seed = unpack(file.read_bytes())
    with silence():
        env = runner.make_environment("aec", max_steps=runner.max_steps)
        plain = runner.run_plainly(seed)
        random = runner.run_randomly(env, seed)
    error = plain.error or random.error
    if error is not None:
        raise error
    parts = {**plain.parts, **random.parts}
    # Classes of a notebook are other ones in each process, their texts are the same.
    texts = {
        path: repr(value.tolist() if isinstance(value, np.ndarray) else value)
        for path, value in parts.items()
    }
    file.write_bytes(pack_plainly(texts))
