"""The benchmark: its sections run, its page explains its rows, and its two sweeps of Mesa agree."""

import json
import multiprocessing
import re

import pytest

from tests.processes import ROOT, python


def names(page, column):
    """The names of rows in a column of a page's tables, without their numbers."""
    lines = [
        line.split(" | ")
        for line in page.read_text(encoding="utf-8").splitlines()
        if line.startswith("| ")
    ]
    return {
        re.sub(r"\d[\d,]*", "n", line[column].strip("| ")) for line in lines if len(line) > column
    }


def test_benchmark_quick_run_measures_rows_that_the_page_explains(tmp_path):
    options = f"--quick --json {tmp_path / 'json'} --write {tmp_path / 'table'}".split()
    python("-m", "benchmarks.core", *options, timeout=None)
    figures = json.loads((tmp_path / "json").read_text())
    assert {
        "decisions",
        "resets",
        "rounds",
        "vector",
        "suspended",
        "many",
        "branches",
        "plugins",
    } <= figures.keys()
    assert all(figure["candidate"] > 0 for rows in figures.values() for figure in rows.values())
    explained = names(ROOT / "docs/speed.md", 0) | {"row", "---"}
    assert names(tmp_path / "table", 1) | names(ROOT / "docs/figures/core.md", 1) <= explained


@pytest.fixture
def sweeps(monkeypatch):
    """The benchmark's sweeps, small ones.

    Mesa's batch_run says how all processes are to be started.
    """
    before = multiprocessing.get_start_method(allow_none=True)
    from benchmarks import batch_run

    monkeypatch.setattr(batch_run, "FACTORS", {"n": [5, 10], "width": [3, 4]})
    monkeypatch.setattr(batch_run, "SEEDS", range(3))
    monkeypatch.setattr(batch_run, "STEPS", 7)
    yield batch_run
    multiprocessing.set_start_method(before, force=True)


def test_benchmark_sweeps_give_the_same_results_with_the_same_seeds(sweeps, tmp_path):
    if not sweeps.ABLE:
        pytest.skip("this version of Mesa's batch_run cannot run Mesa's model")
    found = sweeps.by_run_experiment(tmp_path / "ours")
    assert found["mean"].nunique() == len(found) == 4
    assert found.equals(sweeps.by_batch_run())
    for _ in range(2):  # the second time, all is known
        assert found.equals(sweeps.by_batch_run_resumed(tmp_path / "theirs.jsonl"))
    assert sweeps.lines(sweeps.interval, sweeps.by_run_experiment) == 7
