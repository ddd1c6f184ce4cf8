"""The benchmark's sweeps of Mesa's model: they answer the same question, and so have the same answer."""

import multiprocessing

import pytest


@pytest.fixture
def sweeps(monkeypatch):
    """The benchmark's module, with a small sweep. Mesa's batch_run says how all processes are to be started."""
    before = multiprocessing.get_start_method(allow_none=True)
    from benchmarks import batch_run

    monkeypatch.setattr(batch_run, "FACTORS", {"n": [5, 10], "width": [3, 4]})
    monkeypatch.setattr(batch_run, "SEEDS", range(3))
    monkeypatch.setattr(batch_run, "STEPS", 7)
    yield batch_run
    multiprocessing.set_start_method(before, force=True)


def test_the_same_seeds_bring_the_same(sweeps, tmp_path):
    if not sweeps.ABLE:
        pytest.skip("this version of Mesa's batch_run cannot run Mesa's model")
    found = sweeps.by_run_experiment(tmp_path / "ours")
    assert len(found) == 4
    assert found["mean"].nunique() == 4
    assert found.equals(sweeps.by_batch_run())
    for _ in range(2):  # the second time, all is known
        assert found.equals(sweeps.by_batch_run_resumed(tmp_path / "theirs.jsonl"))


def test_lines_are_those_that_are_written(sweeps):
    assert sweeps.lines(sweeps.interval) == 3
    assert sweeps.lines(sweeps.interval, sweeps.by_run_experiment) == 7
