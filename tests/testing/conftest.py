"""Checks in this process alone, because new processes take most of the time of a check."""

import pytest


@pytest.fixture(autouse=True)
def no_new_processes(request, monkeypatch):
    if not request.module.__name__.endswith("processes"):
        monkeypatch.setattr("simenv_marl.testing.checks.run_elsewhere", lambda *recipe: {})
