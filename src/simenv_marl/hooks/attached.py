"""A handler at a position of a target, and the objects that it may return."""

import inspect
from dataclasses import dataclass, field
from typing import Any, Final

from ..errors import HandlerError, annotate, meant, notes_of, shown
from ..simulation import takes

CALLS: Final = ("before", "after", "instead")
ITEMS: Final = ("before_next", "after_next", "instead_next")

_MOST: Final = 12
"""The number of arguments that a handler must accept if its target accepts any number."""

_NOTHING: Final = object()


def title(key: Any) -> str:
    """Return the name of what a user has named."""
    return key if isinstance(key, str) else getattr(key, "__qualname__", None) or shown(key)


class ChangedArgs:
    """A ``before`` handler returns this to replace all arguments of the call.

    Later handlers, the function itself and the ``after`` handlers get the new arguments.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.args, self.kwargs = args, kwargs

    def __repr__(self) -> str:
        given = [repr(value) for value in self.args] + [f"{name}={value!r}" for name, value in self.kwargs.items()]
        return f"ChangedArgs({', '.join(given)})"


class ChangedResult:
    """An ``after`` handler returns this to replace the result of the call."""

    def __init__(self, value: Any) -> None:
        self.value = value

    def __repr__(self) -> str:
        return f"ChangedResult({self.value!r})"


@dataclass
class Call:
    """A call that ``trace`` recorded.

    Attributes:
        target: The dotted name of the function.
        arguments: The arguments, as a short text.
        result: The result, as a short text; "raised ..." after an error; None while the call runs.
    """

    target: str
    arguments: str
    result: str | None = field(default=None)

    @classmethod
    def of(cls, target: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> "Call":
        """Make the record of a call that begins."""
        given = [shown(value, 60) for value in args] + [f"{name}={shown(value, 60)}" for name, value in kwargs.items()]
        return cls(target, ", ".join(given))


class Attached:
    """A handler at a position of a target, ready to be called.

    Attributes:
        handler: The handler.
        target: The target.
        position: The position.
    """

    __slots__ = ("_moved", "_wants_result", "handler", "position", "target")

    def __init__(self, handler: Any, target: Any, position: str) -> None:
        """Check that a handler fits its target.

        Raises:
            HandlerError: It does not, or the target has no such position.
        """
        if position not in target.positions:
            known = position in CALLS + ITEMS
            why = f"{target.name} {target.nature}" if known else "there is no such position"
            raise HandlerError(
                f"no handler can be attached {shown(position)} {target.name}: {why}; its positions are"
                f" {', '.join(target.positions)}{meant(position, target.positions)}"
            )
        if not callable(handler):
            raise HandlerError(f"the handler of {target.name} must be callable, not {shown(handler)}")
        self.handler, self.target, self.position = handler, target, position
        self._wants_result = position.startswith("after") and takes(handler, "_result")
        self._moved = self._fit(target.signature)

    def _fit(self, signature: inspect.Signature | None) -> frozenset[str]:
        """Check that the handler can be called whenever the target can.

        Returns:
            The names of arguments that the target accepts by keyword, but the handler only by position.
        """
        try:
            own = inspect.signature(self.handler)
        except (TypeError, ValueError):
            return frozenset()  # nothing is known of it
        if signature is None:
            return frozenset()
        parameters = list(signature.parameters.values())
        positional = [p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
        keywords = [p for p in parameters if p.kind is p.KEYWORD_ONLY]
        least = sum(p.default is p.empty for p in positional)
        shapes = [
            (number, [p for p in keywords if p.default is p.empty]) for number in range(least, len(positional) + 1)
        ]
        shapes.append((len(positional), keywords))
        if any(p.kind is p.VAR_POSITIONAL for p in parameters):
            shapes.append((len(positional) + _MOST, keywords))
        extra = ["any_other_keyword"] if any(p.kind is p.VAR_KEYWORD for p in parameters) else []
        result = ["_result"] if self._wants_result else []
        try:
            for number, named in shapes:
                own.bind(*[None] * number, **dict.fromkeys([*(p.name for p in named), *extra, *result]))
        except TypeError as error:
            raise HandlerError(
                f"the handler {title(self.handler)}{own} cannot be attached {self.position} {self.target.name}: it"
                f" cannot be called with all arguments that {signature} takes ({error})"
            ) from None
        return frozenset(
            p.name
            for number, p in enumerate(positional)
            if not _binds(own, number, [q.name for q in positional[number:] if q is p or q.default is q.empty] + result)
        )

    def __call__(self, args: tuple[Any, ...], kwargs: dict[str, Any], result: Any = _NOTHING) -> Any:
        """Call the handler as the target was called."""
        if kwargs and not self._moved.isdisjoint(kwargs):
            args, kwargs = self._by_position(args, kwargs)
        if self._wants_result:
            kwargs = {**kwargs, "_result": result}
        try:
            return self.handler(*args, **kwargs)
        except Exception as error:
            self.annotate(error)
            raise

    def _by_position(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[tuple[Any, ...], dict[str, Any]]:
        signature = self.target.signature
        assert signature is not None
        left, names = dict(kwargs), list(signature.parameters)
        last = max(names.index(name) for name in self._moved if name in kwargs)
        filled = list(args)
        for name in names[len(args) : last + 1]:
            filled.append(left.pop(name, signature.parameters[name].default))
        return tuple(filled), left

    def annotate(self, error: Exception) -> None:
        """Add a note to an error that names the handler."""
        if isinstance(error, StopIteration) and self.position == "instead_next":
            return  # that is how items end
        note = f"simenv_marl: in the handler {title(self.handler)}, attached {self.position} {self.target.name}"
        if note not in notes_of(error):
            annotate(error, note)


def _binds(signature: inspect.Signature, number: int, keywords: list[str]) -> bool:
    """Return whether a signature accepts this number of positional arguments and these keywords."""
    try:
        signature.bind(*[None] * number, **dict.fromkeys(keywords))
    except TypeError:
        return False
    return True
