"""What is of many: observations, actions and masks of many decisions, stacked to arrays.

A *stack* of what lies in a space is an array whose first axis counts the decisions; of what lies in a ``Dict`` or a
``Tuple``, a dict or a tuple of stacks. Of what lies in a space without a shape (text, graphs, ...) it is an array of
objects.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from math import prod
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

Stacker = Callable[..., Any]
"""``stack(items, out=None)`` stacks what lies in a space, into a stack of that size where one is given."""

SMALL: Final = 1024
"""How many bytes an observation may have to be copied once more, which takes less time than it saves."""


def stacker(space: spaces.Space[Any], *, cast: bool = False, other: Stacker | None = None) -> Stacker:
    """Make the function that stacks what lies in a space.

    Args:
        space: The space.
        cast: Whether all that is stacked has the space's dtype and shape, as observations have; else it is cast.
        other: Stacks what lies in spaces without a shape; None: arrays of objects.

    Returns:
        A function of the items, and of the stack to write them into. The stack shares nothing with the items.
    """
    if isinstance(space, spaces.Dict):
        parts = {key: stacker(part, cast=cast, other=other) for key, part in space.spaces.items()}

        def stack_dicts(items: Sequence[Any], out: Any = None) -> Any:
            return {
                key: part([item[key] for item in items], None if out is None else out[key])
                for key, part in parts.items()
            }

        return stack_dicts
    if isinstance(space, spaces.Tuple):
        places = tuple(stacker(part, cast=cast, other=other) for part in space.spaces)

        def stack_tuples(items: Sequence[Any], out: Any = None) -> Any:
            return tuple(
                part([item[place] for item in items], None if out is None else out[place])
                for place, part in enumerate(places)
            )

        return stack_tuples
    if isinstance(space, (spaces.Box, spaces.Discrete, spaces.MultiBinary, spaces.MultiDiscrete)):
        return _array_stacker(space.dtype, space.shape or (), cast=cast)
    if other is None:
        return _stack_objects
    return lambda items, out=None: other(space, items, out)


def _array_stacker(dtype: Any, shape: tuple[int, ...], *, cast: bool) -> Stacker:
    small = bool(shape) and np.dtype(dtype).itemsize * prod(shape) <= SMALL

    def stack(items: Sequence[Any], out: Any = None) -> Any:
        if out is None:
            out = np.empty((len(items), *shape), dtype)
        if not items or not out.size:
            return out
        if not shape:
            out[:] = items
        elif not cast:
            out[:] = [np.reshape(item, shape) for item in items]
        else:
            if small:
                try:
                    # A third of what concatenate costs, which costs a third of stack.
                    memoryview(out.reshape(-1).view(np.uint8))[:] = b"".join(items)
                    return out
                except TypeError:  # one of them is laid out otherwise in memory
                    pass
            np.concatenate(items, out=out.reshape(-1, *shape[1:]))
        return out

    return stack


def _stack_objects(items: Sequence[Any], out: Any = None) -> NDArray[Any]:
    stacked = np.empty(len(items), object)
    for place, item in enumerate(items):
        stacked[place] = item
    return stacked


def empty(space: spaces.Space[Any]) -> Any:
    """A stack of nothing that lies in a space, or in its masks."""
    return stacker(space)([])


def stack_masks(masks: Sequence[Any]) -> Any:
    """Stack masks of one action space."""
    if masks and isinstance(masks[0], tuple):
        return tuple(np.stack(part) for part in zip(*masks, strict=True))
    return np.stack(masks)


def taken(stack: Any, index: NDArray[Any]) -> Any:
    """The rows of a stack that an index names, in its order."""
    return _each(lambda array: array[index], stack)


def joined(stacks: Sequence[Any]) -> Any:
    """Stacks of the same space, one behind the other."""
    if len(stacks) == 1:
        return stacks[0]
    first = stacks[0]
    if isinstance(first, Mapping):
        return {key: joined([stack[key] for stack in stacks]) for key in first}
    if isinstance(first, tuple):
        return tuple(joined(parts) for parts in zip(*stacks, strict=True))
    return np.concatenate(stacks)


def _each(function: Callable[[NDArray[Any]], NDArray[Any]], stack: Any) -> Any:
    if isinstance(stack, Mapping):
        return {key: _each(function, part) for key, part in stack.items()}
    if isinstance(stack, tuple):
        return tuple(_each(function, part) for part in stack)
    return function(stack)


def rows(stack: Any, *, integers: bool) -> list[Any] | None:
    """Take what a policy has returned apart, into what it has returned for each decision.

    Args:
        stack: An array or anything that becomes one (a tensor), a sequence of any kind, or a dict of these.
        integers: Whether integers are to come as python's own.

    Returns:
        The rows; None where there are none to be told apart.
    """
    if isinstance(stack, Mapping):
        parts = [rows(part, integers=False) for part in stack.values()]
        columns = [part for part in parts if part is not None]
        if not columns or len(columns) < len(parts) or len({len(column) for column in columns}) > 1:
            return None
        return [dict(zip(stack, row, strict=True)) for row in zip(*columns, strict=True)]
    if not isinstance(stack, (np.ndarray, list, tuple)):
        if hasattr(stack, "__array__"):
            stack = np.asarray(stack)
        elif isinstance(stack, Iterable) and not isinstance(stack, (str, bytes)):
            return list(stack)
        else:
            return None
    if isinstance(stack, np.ndarray):
        if stack.ndim == 0:
            return None
        if integers and stack.ndim == 1 and stack.dtype.kind in "iu":
            integral: list[int] = stack.tolist()  # which are checked fastest
            return integral
    return list(stack)
