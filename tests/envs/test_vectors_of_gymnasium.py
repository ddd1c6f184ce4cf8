"""Gymnasium's own vector environments over single views tell what ``vector_env`` tells, in whatever processes."""

from __future__ import annotations

import multiprocessing
from functools import partial

import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from simenv_marl import single_env, vector_env
from tests.conftest import DRIVERS
from tests.worlds.counters import FORK, FORKS, MODES, POINT, VARIETY, agree

pytestmark = FORKS

CONTEXTS = multiprocessing.get_all_start_methods()


def three(kind, context, mode=AutoresetMode.NEXT_STEP, **options):
    """Ours, and theirs in one process and in a process for each; the drivers take turns."""
    model, definition = VARIETY[kind]
    makers = [partial(single_env, model, {POINT: definition}, driver=driver) for driver in DRIVERS]
    return (
        vector_env(model, {POINT: definition}, num_envs=len(makers), autoreset_mode=mode),
        SyncVectorEnv(makers, autoreset_mode=mode),
        AsyncVectorEnv(makers, autoreset_mode=mode, context=context, **options),
    )


def tell_the_same(ours, sync, apart):
    try:
        for theirs in (sync, apart):
            agree(ours, theirs, 25, np.random.default_rng(1))
            assert ours.metadata == theirs.metadata
            assert ours.get_attr("np_random_seed") == theirs.get_attr("np_random_seed")
    finally:
        for envs in (ours, sync, apart):
            envs.close()


@pytest.mark.parametrize("context", CONTEXTS)
def test_however_processes_are_started(context):
    tell_the_same(*three("masked", context))


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("kind", ["box", "image", "goal", "timed"])
def test_whatever_is_told_and_however_they_are_reset(kind, mode):
    tell_the_same(*three(kind, FORK, mode))


def test_without_shared_memory():
    # With it, Gymnasium fills up words that are shorter than the longest.
    tell_the_same(*three("nested", FORK, shared_memory=False))
