"""The cost of files of episodes: of a step that is recorded, and of loading an episode.

A step and a decision of a no-op simulation take two microseconds, so differences say more than
ratios.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.measure import Contender, Group, Row, timer
from benchmarks.noop import Alone, Model, steps
from simenv_marl import load_episode, save_episode, single_env

DECISIONS = 1_000
"""The number of decisions of the loaded episode."""


def groups(number: int) -> Iterator[Group]:
    """Yield the rows. A smoke test loads fewer decisions."""
    decisions = min(DECISIONS, number)
    with tempfile.TemporaryDirectory() as folder:
        env: Any = single_env(Alone, Model.left)
        recorded: Any = single_env(Alone, Model.left, record=folder)
        plain, written = of_steps(env, number), of_steps(recorded, number)
        row = "a step with record= / without"
        yield Group([Row(row, written, plain), Row(f"{row}, less", less(written, plain), bar=8.0)])
        recorded.close()
        env.reset(seed=0)
        for _ in range(decisions):
            env.step(0)
        path = Path(folder, "episode.jsonl")
        save_episode(env, path)
        size = path.stat().st_size
        loading = timer(lambda _: load_episode(path).close(), decisions)
        run = timer(lambda _: run_to(decisions), decisions)
        row = "loading decision 1,000 / the plain run to it"
        yield Group([Row(row, loading, run), Row(f"{row}, less", less(loading, run), bar=8.0)])
        row = "bytes of a file for a decision"
        yield Group([Row(row, lambda: size / decisions, bar=200.0, unit="B")])


def of_steps(env: Any, number: int) -> Contender:
    """Return a contender of steps in a new episode, whose tape is not full."""
    timed = steps(env, 0, number)

    def run() -> float:
        env.reset(seed=0)
        return timed()

    return run


def less(one: Contender, other: Contender) -> Contender:
    """Return the difference of two contenders."""
    return lambda: one() - other()


def run_to(decisions: int) -> None:
    """Make an environment, and run its episode to a decision."""
    env: Any = single_env(Alone, Model.left)
    env.reset(seed=0)
    for _ in range(decisions):
        env.step(0)
    env.close()
