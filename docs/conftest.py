"""Fixtures: each page's examples import the models beside it, independently of other pages."""

import sys
from pathlib import Path

import pytest
from tests.worlds.models import models_of_pages_forgotten, registries_put_back

# A model that is only found from a page, one that is a process, and five that need other packages.
collect_ignore = [
    *("bakery_env.py", "dam.py", "hive_torchrl.py", "one_file.py", "quickstart.py"),
    *("battery_trl.py", "negotiation.py"),
]

THOROUGH = ("branches", "event-driven", "experiments", "ledger", "seats")
"""The pages whose examples plan, or run many episodes, for seconds."""


@pytest.hookimpl(tryfirst=True)  # before tests are selected by their marks
def pytest_collection_modifyitems(items):
    """Mark the examples of pages that take long."""
    for item in items:
        if item.path.parent.name in ("docs", "reference") and item.path.stem in THOROUGH:
            item.add_marker(pytest.mark.thorough)


@pytest.fixture(autouse=True)
def _models_beside_the_page(request, monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parent)
    monkeypatch.chdir(Path(__file__).parent)
    if "joblib" in sys.modules:  # workers of earlier tests would look for models elsewhere
        sys.modules["joblib"].externals.loky.get_reusable_executor().shutdown(wait=True)
    with registries_put_back(), models_of_pages_forgotten():
        yield
        request.node.dtest.globs.clear()
