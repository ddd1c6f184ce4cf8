"""A pytest plugin for ``tools.mutants``, which times tests and runs chosen tests in a given order.

Three environment variables with the name of a file each control it. To ``MUTANTS_NOTE`` it writes
each test's name, outcome and seconds. ``MUTANTS_TESTS`` is a JSON object that maps the names of the
tests to run, in their order, to the time limit of each in seconds. A test that takes longer ends
the whole process. ``MUTANTS_COVERAGE`` has the settings with which Coverage.py measures the Python
processes that a test starts.
"""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from typing import Any

import pytest

_NOTE = os.environ.get("MUTANTS_NOTE")
_TESTS = os.environ.get("MUTANTS_TESTS")
_ROOT = os.environ["MUTANTS_ROOT"]
_limits: dict[str, float] = json.loads(Path(_TESTS).read_text(encoding="utf-8")) if _TESTS else {}
_seconds: dict[str, float] = {}


def pytest_configure(config: Any) -> None:
    """Check that the tests import the copy of the library, and no other."""
    import simenv_marl

    if not Path(simenv_marl.__file__).is_relative_to(_ROOT):
        raise pytest.UsageError(f"{simenv_marl.__file__} is not below {_ROOT}")


def pytest_collection_finish() -> None:
    """Have Coverage.py measure the processes that are started from now on."""
    if settings := os.environ.get("MUTANTS_COVERAGE"):
        os.environ["COVERAGE_PROCESS_START"] = settings
        os.environ.pop("COVERAGE_FILE", None)  # it goes before the file that the settings name


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: Any, items: list[Any]) -> None:
    """Keep the chosen tests, in their order."""
    if _TESTS:
        place = {name: number for number, name in enumerate(_limits)}
        chosen = sorted(
            (item for item in items if item.nodeid in place), key=lambda item: place[item.nodeid]
        )
        config.hook.pytest_deselected(items=[item for item in items if item.nodeid not in place])
        items[:] = chosen


def pytest_runtest_logstart(nodeid: str) -> None:
    """Start the timer of a test."""
    if nodeid in _limits:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, _limits[nodeid])


def pytest_runtest_logfinish(nodeid: str) -> None:
    """Stop the timer of a test that has ended in time."""
    if nodeid in _limits:
        signal.setitimer(signal.ITIMER_REAL, 0)


def pytest_runtest_logreport(report: Any) -> None:
    """Record the outcome of a test.

    With several processes, the one that collects the reports does it.
    """
    if _NOTE is None or "PYTEST_XDIST_WORKER" in os.environ:
        return
    _seconds[report.nodeid] = _seconds.get(report.nodeid, 0.0) + report.duration
    if report.failed or report.when == "teardown":
        note = [
            report.nodeid,
            "failed" if report.failed else "passed",
            round(_seconds[report.nodeid], 4),
        ]
        with Path(_NOTE).open("a", encoding="utf-8") as file:
            file.write(json.dumps(note) + "\n")
