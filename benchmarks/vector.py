"""The cost of a step of many simulations, suspended side by side in one process, beside Gymnasium's vector views.

Run it with ``make benchmark``, or alone with ``python -m benchmarks.core --only vector``.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium.vector import SyncVectorEnv

from benchmarks.hand_written import TemplateEnv
from benchmarks.measure import Contender, Section, now, ratio, side_by_side
from benchmarks.noop import Alone, AloneBy, Model
from simenv_marl import single_env, vector_env

SIZES = (1, 64, 1_000, 10_000)


def ours(number: int, **options: Any) -> Any:
    return vector_env(Alone, Model.left, num_envs=number, **options)


def with_argument(number: int) -> Any:
    return vector_env(AloneBy, Model.left_by, num_envs=number)


def over_views(number: int) -> Any:
    return SyncVectorEnv([lambda: single_env(Alone, Model.left)] * number)


def by_hand(number: int) -> Any:
    return SyncVectorEnv([TemplateEnv] * number)


KINDS = {
    "vector_env": ours,
    "vector_env, with another argument": with_argument,
    "SyncVectorEnv, our single view": over_views,
    "SyncVectorEnv, by hand": by_hand,
}


def measure(rounds: int, number: int) -> Section:
    """Measure in a number of rounds, with a number of decisions of each contender."""
    section = Section("Vector environments", "microseconds per simulation and step")
    for size in SIZES:
        _compare(section, size, max(3, rounds if size == 64 else rounds // 3), number)
    return section


def _compare(section: Section, size: int, rounds: int, number: int) -> None:
    """Compare our vector environment with Gymnasium's, over our views and over hand-written environments."""
    envs = {name: make(size) for name, make in KINDS.items()}
    times = side_by_side({name: steps(env, size, number) for name, env in envs.items()}, rounds)
    what, hand = f"{size:,} simulations: ours", "SyncVectorEnv, by hand"
    for name, suffix, limits in (
        ("vector_env", "", (1.3, 1.15)),
        ("vector_env, with another argument", ", another argument", (1.4, 1.25)),
    ):
        section.ratio(
            f"{what} / SyncVectorEnv over hand-written ones{suffix}",
            ratio(times, name, hand),
            *(limits if size == 64 else ()),
        )
    section.ratio(
        f"{what} / SyncVectorEnv over our single view", ratio(times, "vector_env", "SyncVectorEnv, our single view")
    )
    section.times({f"{name}, {size:,}": values for name, values in times.items()})
    for env in envs.values():
        env.close()
    del envs, env
    gc.collect()


def steps(env: Any, size: int, number: int, clock: Callable[[], float] = now) -> Contender:
    """Make a contender of steps of a vector environment that does not end."""
    env.reset(seed=0)
    actions, times = np.ones(size, np.int64), max(number // size, 1)

    def run() -> float:
        step, start = env.step, clock()
        for _ in range(times):
            step(actions)
        return (clock() - start) / (times * size) * 1e6

    return run
