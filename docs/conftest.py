"""Lets each page's examples import the model that lies beside it, as if no other page had."""

import sys
from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def _models_beside_the_page(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parent)
    monkeypatch.delitem(sys.modules, "bakery", raising=False)
