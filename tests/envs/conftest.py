"""Fixtures for environments with worker processes."""

import gc
import multiprocessing

import pytest


@pytest.fixture
def no_workers_left():
    before = set(multiprocessing.active_children())  # joblib keeps its own for the next time
    yield
    gc.collect()
    assert set(multiprocessing.active_children()) <= before
