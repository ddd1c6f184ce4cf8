"""Stacks: observations, actions and masks of many decisions as arrays.

A *stack* of elements of a space is an array whose first axis counts the decisions. For a ``Dict``
or a ``Tuple`` it is a dict or a tuple of stacks. For a space without a shape (text, graphs, ...) it
is an array of objects.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final

import numpy as np
from gymnasium.spaces import Dict, Discrete, Tuple

from ...errors import ObservationError
from ...simulation import Action, Observation
from .spaces import Array, ArraySpace, Space, parts_of

Stacker = Callable[..., Any]
"""``stack(items, out=None)`` stacks elements of a space.

``out`` is an existing stack of that size to write into, as Gymnasium's ``create_empty_array`` makes
it.
"""

SMALL: Final = 1024
"""The size in bytes up to which another copy of an observation takes less time than it saves."""


def stacker(space: Space, *, cast: bool = False) -> Stacker:
    """Make the function that stacks elements of a space. The stack shares no memory with them.

    Args:
        space: The space of the elements.
        cast: Whether the elements already have the space's dtype and shape, as observations have.
    """
    if isinstance(space, (Dict, Tuple)):
        stackers = {key: stacker(part, cast=cast) for key, part in parts_of(space).items()}

        def stack_parts(items: Sequence[Observation], out: Any = None) -> Any:
            stacks = {
                key: stack([item[key] for item in items], None if out is None else out[key])
                for key, stack in stackers.items()
            }
            return stacks if isinstance(space, Dict) else tuple(stacks.values())

        return stack_parts
    if not isinstance(space, (Discrete, ArraySpace)):

        def stack_objects(items: Sequence[Observation], out: Any = None) -> Any:
            return np.fromiter(items, object) if out is None else tuple(items)

        return stack_objects
    dtype = space.dtype
    shape = space.shape or ()
    is_small = np.empty(shape, dtype).nbytes <= SMALL

    def stack(items: Sequence[Observation], out: Array | None = None) -> Array:
        if out is None:
            out = np.empty((len(items), *shape), dtype)
        if not out.size:
            return out
        if not shape:
            out[:] = items
            return out
        if not cast:
            out[:] = [np.reshape(item, shape) for item in items]
            return out
        if is_small:
            try:
                # Joining bytes takes a third of the time of ``concatenate``, which takes a third of
                # the time of ``np.stack``.
                out.reshape(-1).view(np.uint8).data[:] = b"".join(items)
                return out
            except TypeError:  # an item has another memory layout
                pass
        np.concatenate(items, out=out.reshape(-1, *shape[1:]))
        return out

    return stack


def stacked(items: Sequence[Any]) -> Any:
    """Stack masks of one action space, or states."""
    return _map(np.stack, items)


def taken(stack: Any, index: Array | int) -> Any:
    """Take the rows of a stack with the given indices, in that order."""
    return _map(lambda arrays: arrays[0][index], [stack])


def joined(stacks: Sequence[Any]) -> Any:
    """Concatenate stacks of the same space."""
    if len(stacks) == 1:
        return stacks[0]
    return _map(np.concatenate, stacks)


def _map(function: Callable[[Sequence[Array]], Any], stacks: Sequence[Any]) -> Any:
    """Call a function with the arrays at the same place of several stacks, for each place."""
    match stacks[0]:
        case Mapping() as first:
            return {key: _map(function, [stack[key] for stack in stacks]) for key in first}
        case tuple():
            return tuple(_map(function, parts) for parts in zip(*stacks, strict=True))
    try:
        return function(stacks)
    except ValueError as error:
        raise ObservationError(
            f"rows of arrays differ ({error}): state(), and each extra of a policy, must always"
            " have the same shape"
        ) from error


def split_batch(stack: Action, *, integers: bool) -> list[Action] | None:
    """Split the answer of a batched policy into one action for each decision.

    Args:
        stack: An array, an object that converts to one (a tensor), a sequence, or a dict of these.
        integers: Whether actions are Python integers, where the stack has one dimension.

    Returns:
        The actions; None if the answer cannot be split.
    """
    match stack:
        case Mapping():
            columns = [split_batch(part, integers=False) or [] for part in stack.values()]
            try:
                table = list(zip(*columns, strict=True))
            except ValueError:  # the parts have different lengths
                return None
            return [dict(zip(stack, row, strict=True)) for row in table] or None
        case _ if hasattr(stack, "__array__"):
            array = np.asarray(stack)
            if array.ndim == 0:
                return None
            if integers and array.ndim == 1 and array.dtype.kind in "iu":
                # Python integers, because their check is the fastest.
                return array.tolist()  # type: ignore[no-any-return]
            return list(array)
        case str() | bytes():
            return None
        case Iterable():
            return list(stack)
    return None
