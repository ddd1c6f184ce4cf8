"""Mappings take as many of a decision call's arguments as they want.

A call is bound to the signature of the decision function first: each argument by position if it can
be, with defaults. A mapping gets positional arguments from the first on, and keyword-only arguments
by the name of the function's parameter.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from inspect import Parameter
from typing import Final, TypeAlias

from ...errors import DefinitionError, name_of
from ...hooks.hook import Hook
from ...simulation import POSITIONAL, Model, signature_of

GIVEN: Final = ("_simulation", "_rule", "_answers")
"""The keyword-only parameters that the library itself gives."""

BOUND_LATER: Final = ("_simulation", "_rule")
"""Those of them that are bound when the simulation is there."""

Taken: TypeAlias = "frozenset[int | str] | None"
"""The numbers of positional arguments, and the names of keyword arguments. None: all."""


@dataclass(frozen=True, eq=False)
class Mapped:
    """A mapping that can be called with all arguments of a call.

    Attributes:
        call: Calls the mapping with the arguments that it takes.
        taken: The arguments that it takes.
    """

    call: Callable[..., Model]
    taken: Taken

    def takes_any(self, arguments: set[int | str]) -> bool:
        """Return whether the mapping takes one of some arguments."""
        return bool(arguments if self.taken is None else arguments & self.taken)


def taken_by(mappings: Iterable[Mapped]) -> Taken:
    """Return the arguments that at least one mapping takes."""
    all_taken: frozenset[int | str] = frozenset()
    for mapping in mappings:
        if mapping.taken is None:
            return None
        all_taken |= mapping.taken
    return all_taken


def adapt(
    function: Callable[..., Model],
    name: str,
    hook: Hook,
    leading: int = 0,
    given: Collection[str] = (),
) -> Mapped:
    """Make a mapping callable with all arguments of a hook's calls.

    Args:
        function: The mapping.
        name: The parameter of ``make_step`` that it was given for.
        hook: The decision function.
        leading: The number of the mapping's arguments that come before the call's.
        given: The keyword arguments that the library adds to each call.

    Raises:
        DefinitionError: The mapping requires an argument that no call has.
    """
    own = signature_of(function)
    if own is None or hook.signature is None:
        return Mapped(function, None)
    theirs = hook.signature.parameters.values()
    their_names = [""] * leading + [p.name for p in theirs if p.kind in POSITIONAL]
    their_keys = {p.name for p in theirs if p.kind is Parameter.KEYWORD_ONLY} | {*given}
    their_kinds = {p.kind for p in theirs}
    has_open_places = Parameter.VAR_POSITIONAL in their_kinds
    has_open_keys = Parameter.VAR_KEYWORD in their_kinds
    own_kinds = {p.kind for p in own.parameters.values()}
    takes_rest = Parameter.VAR_POSITIONAL in own_kinds
    takes_keys = Parameter.VAR_KEYWORD in own_kinds

    end = 0  # of the arguments that the mapping gets by position
    places: dict[str, int] = {}  # of the positional arguments that it gets by name
    keys: set[str] = set()
    reason = ""
    for place, parameter in enumerate(own.parameters.values()):
        key = parameter.name
        required = parameter.default is Parameter.empty
        if parameter.kind in POSITIONAL:
            if place >= len(their_names):
                is_taken = required and has_open_places
            else:
                is_named = place < leading or their_names[place] == key
                is_taken = is_named or required or parameter.kind is Parameter.POSITIONAL_ONLY
            if is_taken and place == end:
                end += 1
            elif is_taken:
                places[key] = place
            elif takes_rest and not required:
                reason = f"its *args would fill {key!r}, which has a default"
        elif parameter.kind is Parameter.KEYWORD_ONLY:
            if key in GIVEN and not required:
                continue  # it is bound already
            if key in their_names:
                places[key] = their_names.index(key)
            elif key in their_keys or (required and (has_open_keys or key in BOUND_LATER)):
                keys.add(key)
    try:
        own.bind(*range(max(end, leading)), **dict.fromkeys((*places, *keys)))
    except TypeError as error:
        reason = str(error)
    if reason:
        raise DefinitionError(
            f"{name} of {hook.name} cannot be called: {reason}. It is {name_of(function)}{own},"
            f" and the decision function takes {hook.signature}; let it take arguments that the"
            " function has"
        )

    taken: set[int | str] = {*range(end), *places.values(), *keys}
    if takes_rest:
        taken.update(range(len(their_names)))
    if takes_keys:
        taken |= their_keys
    takes_all = (takes_rest and has_open_places) or (takes_keys and has_open_keys)
    taken_or_all = None if takes_all else frozenset(taken)
    gets_places = takes_rest or (end == len(their_names) and not has_open_places)
    gets_keys = takes_keys or (keys == their_keys and not has_open_keys)
    if gets_places and gets_keys and not places:
        return Mapped(function, taken_or_all)
    last = None if takes_rest else end
    return Mapped(_caller(function, last, places, None if takes_keys else keys), taken_or_all)


def _caller(
    function: Callable[..., Model], end: int | None, places: dict[str, int], keys: set[str] | None
) -> Callable[..., Model]:
    """Make the function that passes on the arguments that a mapping takes."""
    if not places and keys == set():
        if end == 1:  # spares the most frequent mapping a slice
            return lambda first, *args, **kwargs: function(first)
        return lambda *args, **kwargs: function(*args[:end])

    def call(*args: Model, **kwargs: Model) -> Model:
        named = kwargs
        if keys is not None:
            named = {key: kwargs[key] for key in keys if key in kwargs}
        placed = {name: args[place] for name, place in places.items()}
        return function(*args[:end], **named, **placed)

    return call
