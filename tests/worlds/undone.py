"""What tests put back, or make sure of, when they are over."""

import gc
import sys
from contextlib import contextmanager

import gymnasium
import pettingzoo
import pytest

from tests.worlds.models import notes

MODELS_OF_PAGES = ("bakery", "bakery_env", "lake")
"""The modules that pages of the documentation import from the folder they are in."""


@contextmanager
def registries_put_back():
    """Put back what Gymnasium's and PettingZoo's registries held."""
    names = ("aec_registry", "parallel_registry")  # older releases have none
    registries = (
        gymnasium.registry,
        *(getattr(pettingzoo, name) for name in names if hasattr(pettingzoo, name)),
    )
    before = [dict(registry) for registry in registries]
    try:
        yield
    finally:
        for registry, entries in zip(registries, before, strict=True):
            registry.clear()
            registry.update(entries)


@contextmanager
def models_of_pages_forgotten():
    """Have the models of pages imported anew, and forget them afterwards.

    Names of decision points would find the decorated functions of an earlier import as long as
    these exist.
    """
    _forget_models_of_pages()
    try:
        yield
    finally:
        _forget_models_of_pages()


def _forget_models_of_pages():
    for model in MODELS_OF_PAGES:
        sys.modules.pop(model, None)
    gc.collect()


@contextmanager
def left_as_they_were(*places):
    """Make sure that classes and modules hold at the end just what they held."""
    before = [held(place) for place in places]
    yield
    for place, then in zip(places, before, strict=True):
        now = held(place)
        assert now.keys() == then.keys()
        assert all(now[name] is then[name] for name in now)


def held(place):
    """What a class or module holds, but for what Python adds."""
    return {
        name: value
        for name, value in vars(place).items()
        if not name.startswith("__") or name == "__init__"
    }


@contextmanager
def fails(error, *words, match=None):
    """Expect an error whose notes have all of these words."""
    with pytest.raises(error, match=match) as caught:
        yield caught
    for word in words:
        assert word in notes(caught.value)
