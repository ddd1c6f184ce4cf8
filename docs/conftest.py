"""Fixtures that let each page's examples import the models beside it, independently of other pages."""

import gc
import sys
from pathlib import Path

import pytest
from tests.worlds.undone import registries_put_back

# A model that is only found from a page, one that is a process, and one that needs a learner.
collect_ignore = ["bakery_env.py", "dam.py", "quickstart.py"]


@pytest.fixture(autouse=True)
def _models_beside_the_page(request, monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parent)
    monkeypatch.chdir(Path(__file__).parent)
    for model in ("bakery", "bakery_env", "lake"):
        monkeypatch.delitem(sys.modules, model, raising=False)
    gc.collect()  # collects what remains of the previous page
    if "joblib" in sys.modules:  # workers of earlier tests would look for models elsewhere
        sys.modules["joblib"].externals.loky.get_reusable_executor().shutdown(wait=True)
    with registries_put_back():
        yield
    # the next page's names would find this page's decorated functions as long as there is a reference to them
    request.node.dtest.globs.clear()
    for model in ("bakery", "bakery_env", "lake"):
        sys.modules.pop(model, None)
    gc.collect()
