"""Iterables that are themselves in all respects but one: their items are handed out with handlers."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any, Final

import wrapt

from .handlers import Items, Slot, next_item
from .targets import IterableTarget


class ExposedIterable(wrapt.ObjectProxy):  # type: ignore[type-arg]
    """An iterable whose items are handed out with handlers. In all else it is the iterable."""

    def __init__(self, iterable: Any, target: IterableTarget) -> None:
        super().__init__(iterable)
        self._self_target = target
        self._self_slot: Slot = target.slot

    def __iter__(self) -> Iterator[Any]:
        return Items(iter(self.__wrapped__), self._self_slot, self)

    def __copy__(self) -> Any:
        return proxy(copy.copy(self.__wrapped__), self._self_target)

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        """Copy the iterable; the copy has the same handlers, as in an environment of its own."""
        return proxy(copy.deepcopy(self.__wrapped__, memo), self._self_target)

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Pickle the iterable, which is exposed anew where it is unpickled."""
        return expose, (self.__wrapped__,)

    def __reduce__(self) -> Any:
        return self.__reduce_ex__(None)


class ExposedIterator(ExposedIterable):
    """An iterator whose items are handed out with handlers. In all else it is the iterator."""

    def __iter__(self) -> Iterator[Any]:
        return self

    def __next__(self) -> Any:
        return next_item(self._self_slot, self.__wrapped__.__next__, self)


def proxy(iterable: Any, target: IterableTarget) -> Any:
    """Make what hands out the items of an iterable with the handlers of a target."""
    return (ExposedIterator if hasattr(iterable, "__next__") else ExposedIterable)(iterable, target)


KINDS: Final = (ExposedIterable, ExposedIterator)


def expose(iterable: Any) -> Any:
    """Make an iterable to which handlers can be attached."""
    target = IterableTarget(f"an iterable {type(iterable).__name__}")
    target.exposed = True
    return proxy(iterable, target)
