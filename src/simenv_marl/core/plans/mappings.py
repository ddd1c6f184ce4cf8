"""Mappings take as many of a decision call's arguments as they want.

A call is bound to the signature of the decision function first: each argument by position if it can
be, with defaults. A mapping gets positional arguments from the first on, and keyword-only arguments
by the name of the function's parameter.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final

from ...errors import DefinitionError, name_of
from ...hooks.hook import Hook
from ...simulation import Model

GIVEN: Final = ("_simulation", "_rule", "_answers")
"""The keyword-only parameters that the library itself gives."""

_Parameters = list[inspect.Parameter]


@dataclass(frozen=True, eq=False)
class Mapped:
    """A mapping that can be called with all arguments of a call.

    Attributes:
        call: Calls the mapping with the arguments that it takes.
        places: The numbers of the positional arguments of ``call`` that it takes. None: all.
        keys: The keyword arguments that it takes. None: all.
    """

    call: Callable[..., Model]
    places: frozenset[int] | None
    keys: frozenset[str] | None

    def takes_any(self, places: set[int], keys: set[str]) -> bool:
        """Return whether the mapping takes one of some arguments."""
        by_place = places if self.places is None else places & self.places
        by_key = keys if self.keys is None else keys & self.keys
        return bool(by_place or by_key)


def adapt(function: Callable[..., Model], name: str, hook: Hook, leading: int = 0) -> Mapped:
    """Make a mapping callable with all arguments of a hook's calls.

    Args:
        function: The mapping.
        name: The parameter of ``make_step`` that it was given for.
        hook: The decision function.
        leading: How many arguments of the mapping's own come before those of the call.

    Raises:
        DefinitionError: The mapping requires an argument that no call has.
    """
    try:
        own = inspect.signature(function)
    except (TypeError, ValueError):  # of a builtin
        own = None
    if own is None or hook.signature is None:
        return Mapped(function, None, None)
    return _Fit(function, name, hook, leading, own).mapped()


def number_of_places(mappings: Iterable[Mapped]) -> int | None:
    """Return the number of positional arguments up to the last one that a mapping takes.

    None: all.
    """
    number = 0
    for mapping in mappings:
        if mapping.places is None:
            return None
        number = max(number, *(place + 1 for place in mapping.places), 0)
    return number


def union_of_keys(mappings: Iterable[Mapped]) -> frozenset[str] | None:
    """Return the keyword arguments that mappings take. None: all."""
    keys: frozenset[str] = frozenset()
    for mapping in mappings:
        if mapping.keys is None:
            return None
        keys |= mapping.keys
    return keys


def _of_kind(parameters: _Parameters, *kinds: object) -> _Parameters:
    return [p for p in parameters if p.kind in kinds]


class _Fit:
    """How the parameters of a mapping fit those of a decision function."""

    def __init__(
        self,
        function: Callable[..., Model],
        name: str,
        hook: Hook,
        leading: int,
        own: inspect.Signature,
    ) -> None:
        self._function = function
        self._name = name
        self._hook = hook
        self._leading = leading
        self._own = list(own.parameters.values())
        self._theirs = list(hook.signature.parameters.values()) if hook.signature else []
        kind = inspect.Parameter
        positional = (kind.POSITIONAL_ONLY, kind.POSITIONAL_OR_KEYWORD)
        self._names = [p.name for p in _of_kind(self._theirs, *positional)]
        self._keys = [p.name for p in _of_kind(self._theirs, kind.KEYWORD_ONLY)]
        self._open_places = bool(_of_kind(self._theirs, kind.VAR_POSITIONAL))
        self._open_keys = bool(_of_kind(self._theirs, kind.VAR_KEYWORD))
        parameters = _of_kind(self._own, *positional)
        self._takes_rest = bool(_of_kind(self._own, kind.VAR_POSITIONAL))
        self._takes_keys = bool(_of_kind(self._own, kind.VAR_KEYWORD))
        if len(parameters) < leading and not self._takes_rest:
            self._refuse("it takes fewer arguments than its own")
        self._positional = parameters[leading:]
        self._keyword_only = [
            p
            for p in _of_kind(self._own, kind.KEYWORD_ONLY)
            if p.name not in GIVEN or p.default is p.empty  # else it is bound already
        ]

    def mapped(self) -> Mapped:
        """Return the mapping, callable with all arguments."""
        taken = self._places()
        if self._takes_rest and len(taken) < len(self._positional):
            self._refuse("its *args would fill parameters that have a default")
        by_name = self._named_places(taken)
        keys = self._named_keys()
        prefix = 0
        while prefix in taken:
            prefix += 1
        later = {taken[place]: place for place in taken if place >= prefix}
        by_place = {**later, **by_name}
        own = range(self._leading)
        others = (self._leading + place for place in (*taken, *by_name.values()))
        places: frozenset[int] | None = frozenset((*own, *others))
        takes_all = self._takes_rest and (self._open_places or len(self._names) > len(taken))
        if takes_all:
            places = None
        all_places = takes_all or (prefix == len(self._names) and not self._open_places)
        all_keys = set(self._keys) == set(keys) and not self._open_keys
        if self._takes_keys:
            all_keys = True
        found_keys = None if self._takes_keys else frozenset(keys)
        if all_places and all_keys and not by_place:
            return Mapped(self._function, places, found_keys)
        end = None if takes_all else self._leading + prefix
        call = self._caller(end, by_place, keys)
        return Mapped(call, places, found_keys)

    def _places(self) -> dict[int, str]:
        """Return the places of the call that positional parameters take, with their names."""
        taken: dict[int, str] = {}
        for place, parameter in enumerate(self._positional):
            there = place < len(self._names)
            optional = parameter.default is not parameter.empty
            if optional and parameter.kind is parameter.POSITIONAL_OR_KEYWORD:
                if there and self._names[place] == parameter.name:
                    taken[place] = parameter.name
                continue
            if there or (self._open_places and not optional):
                taken[place] = parameter.name
            elif not optional:
                self._refuse(f"it requires {parameter.name!r}")
        return taken

    def _named_places(self, taken: dict[int, str]) -> dict[str, int]:
        """Return the keyword-only parameters that take a positional argument, with its place."""
        return {
            parameter.name: self._names.index(parameter.name)
            for parameter in self._keyword_only
            if parameter.name in self._names
        }

    def _named_keys(self) -> list[str]:
        """Return the keyword-only arguments of the call that the mapping takes by name."""
        found: list[str] = []
        for parameter in self._keyword_only:
            if parameter.name in self._names:
                continue
            required = parameter.default is parameter.empty
            is_given = parameter.name in GIVEN
            if is_given or parameter.name in self._keys or (required and self._open_keys):
                found.append(parameter.name)
            elif required:
                self._refuse(f"it requires {parameter.name!r}")
        return found

    def _caller(
        self, end: int | None, by_place: dict[str, int], keys: list[str]
    ) -> Callable[..., Model]:
        """Make the function that passes on the arguments that the mapping takes."""
        function = self._function
        leading = self._leading
        takes_keys = self._takes_keys
        if not by_place and not keys and not takes_keys:
            if end == 1:  # spares the most frequent mapping a slice
                return lambda first, *args, **kwargs: function(first)
            return lambda *args, **kwargs: function(*args[:end])

        def call(*args: Model, **kwargs: Model) -> Model:
            named = kwargs if takes_keys else {key: kwargs[key] for key in keys if key in kwargs}
            placed = {name: args[leading + place] for name, place in by_place.items()}
            return function(*args[:end], **named, **placed)

        return call

    def _refuse(self, reason: str) -> None:
        function = name_of(self._function)
        raise DefinitionError(
            f"{self._name} of {self._hook.name} cannot be called: {reason}. It is"
            f" {function}{inspect.Signature(self._own)}, and the decision function takes"
            f" {self._hook.signature}; let it take arguments that the function has"
        )
