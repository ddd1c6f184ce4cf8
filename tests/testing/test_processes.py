"""The check repeats a run in new processes, where sets of strings have another order."""

import threading

import pytest

from simenv_marl.testing import check_simulation
from tests.processes import python
from tests.worlds.copied import (
    HashedWalk,
    NamedWalk,
    NotedWalk,
    OrderedWalk,
    UnorderedWalk,
    walk_points,
)


def checked(simulation, **changes):
    return check_simulation(simulation, walk_points(simulation, **changes), episodes=2, seeds=[4])


@pytest.mark.thorough
def test_check_simulation_reports_runs_that_depend_on_string_hashes():
    for model in (UnorderedWalk, NotedWalk, HashedWalk):
        (seen,) = checked(model).of("error")
        assert seen.title.endswith("not give the same run in another process")
        assert "Sort the set" in seen.explanation
        assert "seed 4" in seen.evidence


@pytest.mark.thorough
def test_check_simulation_accepts_sorted_sets():
    report = checked(OrderedWalk)
    assert not report.of("error")
    assert any("six hash seeds" in line for line in report.checked)


def test_check_simulation_tells_why_it_skips_an_unpicklable_model():
    lock = threading.Lock()
    report = checked(NamedWalk, reward_mapping=lambda walk: walk.place + lock.locked())
    assert report.ok
    assert "new processes with six hash seeds, because TypeError: cannot pickle" in str(
        report.checked
    )


def test_check_simulation_works_in_a_script_without_a_main_guard(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "from tests.testing.test_processes import checked\n"
        "from tests.worlds.copied import NAMES, NamedWalk\n"
        "class Unordered(NamedWalk):\n"
        "    names = {*NAMES}\n"
        "print(checked(Unordered))\n"
    )
    done = python(script)
    assert done.stdout.count("What was checked") == 1, done.stderr
    assert "another process" in done.stdout
