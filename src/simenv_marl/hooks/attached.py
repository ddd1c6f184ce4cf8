"""One handler at one position, made ready to be called, and what it may return."""

import inspect
from dataclasses import dataclass, field
from typing import Any, Final

from ..errors import HandlerError, annotate, meant, notes_of, shown
from ..simulation import takes

CALLS: Final = ("before", "after", "instead")
ITEMS: Final = ("before_next", "after_next", "instead_next")

_MOST: Final = 12
"""Arguments beyond these a handler of a function that takes any number need not be able to take."""

_NOTHING: Final = object()


def title(key: Any) -> str:
    """What to call what a user has named."""
    return key if isinstance(key, str) else getattr(key, "__qualname__", None) or shown(key)


class ChangedArgs:
    """What a ``before`` handler returns to replace all arguments of the call.

    Later handlers, the function itself and the ``after`` handlers receive these.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.args, self.kwargs = args, kwargs

    def __repr__(self) -> str:
        given = [repr(value) for value in self.args] + [f"{name}={value!r}" for name, value in self.kwargs.items()]
        return f"ChangedArgs({', '.join(given)})"


class ChangedResult:
    """What an ``after`` handler returns to replace the result of the call."""

    def __init__(self, value: Any) -> None:
        self.value = value

    def __repr__(self) -> str:
        return f"ChangedResult({self.value!r})"


@dataclass
class Call:
    """One call, as ``trace`` has recorded it.

    Attributes:
        target: The dotted name of the function.
        arguments: What it was called with, in short.
        result: What it has returned, in short; "raised ..." with an error; None while it runs.
    """

    target: str
    arguments: str
    result: str | None = field(default=None)

    @classmethod
    def of(cls, target: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> "Call":
        """The entry of a call that begins."""
        given = [shown(value, 60) for value in args] + [f"{name}={shown(value, 60)}" for name, value in kwargs.items()]
        return cls(target, ", ".join(given))


class Attached:
    """A handler at a position of a target, made ready to be called.

    Attributes:
        handler: The handler.
        target: What it is attached to.
        position: Where.
    """

    __slots__ = ("_moved", "_wants_result", "handler", "position", "target")

    def __init__(self, handler: Any, target: Any, position: str) -> None:
        """Make sure that a handler fits.

        Raises:
            HandlerError: It does not, or there is no such position here.
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
        """Make sure that the handler can be called whenever the target can.

        Returns:
            What may be passed to the target by keyword, and to the handler only by position.
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
        """Say in an error's notes which handler it came from."""
        if isinstance(error, StopIteration) and self.position == "instead_next":
            return  # that is how items end
        note = f"simenv_marl: in the handler {title(self.handler)}, attached {self.position} {self.target.name}"
        if note not in notes_of(error):
            annotate(error, note)


def _binds(signature: inspect.Signature, number: int, keywords: list[str]) -> bool:
    """Whether so many arguments and these keywords can be passed."""
    try:
        signature.bind(*[None] * number, **dict.fromkeys(keywords))
    except TypeError:
        return False
    return True
