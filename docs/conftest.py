"""Lets each page's examples import the models that lie beside it, as if no other page had."""

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
    gc.collect()  # what the collection after the page before has unwound
    if "joblib" in sys.modules:  # its workers were started by somebody else, and would look for models elsewhere
        sys.modules["joblib"].externals.loky.get_reusable_executor().shutdown(wait=True)
    with registries_put_back():
        yield
    # What a page has decorated would be found by the next page's names, as long as anything keeps it.
    request.node.dtest.globs.clear()
    for model in ("bakery", "bakery_env", "lake"):
        sys.modules.pop(model, None)
    gc.collect()
