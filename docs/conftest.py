"""Lets each page's examples import the models that lie beside it, as if no other page had."""

import sys
from pathlib import Path

import pytest

collect_ignore = ["bakery_env.py"]  # it imports a model that is only found from a page


@pytest.fixture(autouse=True)
def _models_beside_the_page(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parent)
    for model in ("bakery", "bakery_env", "lake"):
        monkeypatch.delitem(sys.modules, model, raising=False)
    if "joblib" in sys.modules:  # its workers were started by somebody else, and would look for models elsewhere
        sys.modules["joblib"].externals.loky.get_reusable_executor().shutdown(wait=True)
