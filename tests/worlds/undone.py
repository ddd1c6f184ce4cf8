"""What tests put back, or make sure of, when they are over."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium
import pettingzoo


@contextmanager
def registries_put_back() -> Iterator[None]:
    """Put back what Gymnasium's and PettingZoo's registries held."""
    registries = (gymnasium.registry, pettingzoo.aec_registry, pettingzoo.parallel_registry)
    before = [dict(registry) for registry in registries]
    try:
        yield
    finally:
        for registry, entries in zip(registries, before, strict=True):
            registry.clear()
            registry.update(entries)


@contextmanager
def left_as_they_were(*places: Any) -> Iterator[None]:
    """Make sure that classes and modules hold at the end just what they held."""
    before = [held(place) for place in places]
    yield
    for place, then in zip(places, before, strict=True):
        now = held(place)
        assert now.keys() == then.keys()
        assert all(now[name] is then[name] for name in now)


def held(place: Any) -> dict[str, Any]:
    """What a class or module holds, but for what Python adds."""
    return {name: value for name, value in vars(place).items() if not name.startswith("__") or name == "__init__"}
