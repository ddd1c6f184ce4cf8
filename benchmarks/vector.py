"""The cost of a step of many suspended simulations in one process, beside Gymnasium's vectors."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

from gymnasium.vector import SyncVectorEnv

from benchmarks.hand_written import TemplateEnv
from benchmarks.measure import Group, Row
from benchmarks.noop import Alone, AloneBy, Model, vector
from simenv_marl import single_env, vector_env

SIZES = (1, 64, 1_000, 10_000)


def groups(number: int) -> Iterator[Group]:
    """Yield the rows, with a number of decisions of each contender."""
    for size in SIZES:
        if size <= number:
            yield from beside_gymnasium(size, number)


def beside_gymnasium(size: int, number: int) -> Iterator[Group]:
    """Yield the rows for a number of simulations."""
    envs: list[Any] = [
        vector_env(Alone, Model.left, num_envs=size),
        vector_env(AloneBy, Model.left_by, num_envs=size),
        SyncVectorEnv([partial(single_env, Alone, Model.left)] * size),
        SyncVectorEnv([TemplateEnv] * size),
    ]
    ours, ours_by, views, hand = (vector(env, size, number) for env in envs)
    what, beside, held = f"{size:,} simulations", "/ SyncVectorEnv of", size == 64
    yield Group(
        [
            Row(f"{what} {beside} template", ours, hand, *((1.3, 1.15) if held else ())),
            Row(
                f"{what}, another argument {beside} template",
                ours_by,
                hand,
                *((1.4, 1.25) if held else ()),
            ),
            Row(f"{what} {beside} single_env", ours, views),
        ],
        most=1_000 if held else 10,
    )
    for env in envs:
        env.close()
