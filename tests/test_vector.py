"""Many simulations at once tell what as many environments of their own tell."""

from __future__ import annotations

import gc
import threading
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import vector as wrappers
from hypothesis import given, settings
from hypothesis import strategies as st

from simenv_marl import (
    RULE,
    ClosedError,
    CopyError,
    EpisodeOverError,
    InvalidActionError,
    NotResetError,
    OptionValueError,
    ReentrancyError,
    UnknownOptionError,
    ViewError,
    WrongThreadError,
    joint_env,
    make_step,
    register_simulation,
    single_env,
    vector_env,
)

from .counters import MODES, POINT, VARIETY, Counter, Timed, agree, definition, made, same
from .models import notes, stacks
from .worlds import FuseError, designs, seeds

# -- what is told -----------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("kind", VARIETY)
def test_it_tells_what_gymnasium_tells_of_as_many_single_views(kind, mode):
    model, decision = VARIETY[kind]
    points = {POINT: decision}
    ours = vector_env(model, points, num_envs=5, autoreset_mode=mode)
    theirs = SyncVectorEnv([lambda: single_env(model, points)] * 5, autoreset_mode=mode)
    assert ours.single_observation_space == theirs.single_observation_space
    assert ours.single_action_space == theirs.single_action_space
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.metadata == theirs.metadata
    assert ours.render_mode == theirs.render_mode
    agree(ours, theirs, 40, np.random.default_rng(1))
    assert same(ours.np_random_seed, theirs.np_random_seed)
    assert [g.random() for g in ours.np_random] == [g.random() for g in theirs.np_random]
    samples = [[space.sample() for space in envs.get_attr("action_space")] for envs in (ours, theirs)]
    assert same(*samples)
    ours.close()
    theirs.close()


@given(designs(), seeds, st.sampled_from(MODES), st.integers(1, 4))
@settings(max_examples=150)
def test_it_tells_what_gymnasium_tells_of_random_worlds(design, seed, mode, number):
    ours = made(design, number, mode)
    if ours is None:
        return
    theirs = made(design, number, mode, sync=True)
    agree(ours, theirs, 15, np.random.default_rng(seed))
    assert [s.trace for s in ours.get_attr("simulation")] == [s.trace for s in theirs.get_attr("simulation")]
    ours.close()
    theirs.close()
