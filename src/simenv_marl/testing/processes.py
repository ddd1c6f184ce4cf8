"""Runs in new processes, whose strings hash differently: sets of strings have another order."""

from __future__ import annotations

import os
import sys
from subprocess import run

from ..core import pack_outcome, unpack, unpack_outcome
from .fingerprint import Fingerprint
from .runs import silence


def run_elsewhere(recipe: bytes, seconds: float, hash_seed: int) -> Fingerprint:
    """Run a packed runner and a seed in a new process with a hash seed.

    Returns:
        The parts of a plain run and of an episode of random actions.

    Raises:
        Exception: The process has failed, or did not end in time.
    """
    code = f"import sys; sys.path[:] = {sys.path!r}; import {__name__} as m; m.main()"
    done = run(
        [sys.executable, "-c", code],
        input=recipe,
        env={**os.environ, "PYTHONHASHSEED": str(hash_seed)},
        timeout=seconds,
        check=True,
        capture_output=True,
    )
    parts: Fingerprint
    parts, error = unpack_outcome(done.stdout)
    if error is not None:
        raise error
    return parts


def main() -> None:
    """Run the recipe from the standard input, and write the outcome to the standard output."""
    with silence():
        outcome = pack_outcome(_run, sys.stdin.buffer.read())
    sys.stdout.buffer.write(outcome)


def _run(recipe: bytes) -> Fingerprint:
    runner, seed = unpack(recipe)
    plain = runner.run_plainly(seed)
    random = runner.run_randomly(runner.make_environment("aec", max_steps=runner.max_steps), seed)
    parts: Fingerprint = plain.parts | random.parts
    return parts
