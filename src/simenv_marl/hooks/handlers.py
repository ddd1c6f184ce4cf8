"""Handlers, and the calls in which they take part.

A *target* is what handlers are attached to: a function of a model, an iterable, or a class whose instances
iterate. Its *slot* holds the handlers that its calls are to run, made ready by whose they are: ``None`` for
everybody, or the plugins of an environment, with everybody's before them. Empty, it costs one test.

A call runs the handlers that were there when it began. Items are looked at one by one.
"""

from __future__ import annotations

import inspect
import reprlib
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass, field
from functools import update_wrapper
from itertools import count
from threading import get_ident
from types import FunctionType
from typing import Any, Final
from weakref import WeakSet

from ..core.switch import PLUGGED
from ..decision import point_of
from ..errors import HandlerError, annotate
from ..simulation import takes
from .hook import EXPOSED, generate, is_alone, is_method, kind_of
from .places import Place, title

CALLS: Final = ("before", "after", "instead")
ITEMS: Final = ("before_next", "after_next", "instead_next")

Slot = dict[Any, "Handlers"]
"""By whose they are: the handlers of a target."""

Record = Callable[[str, tuple[Any, ...], dict[str, Any]], "Call"]
"""Makes the entry of a call that begins."""

_MOST: Final = 12
"""Arguments beyond these a handler of a function that takes any number need not be able to take."""

_NOTHING: Final = object()

_NUMBERS: Final = count()

_repr = reprlib.Repr()
_repr.maxother = _repr.maxstring = 60


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
    def of(cls, target: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Call:
        """The entry of a call that begins."""
        given = [_repr.repr(value) for value in args] + [
            f"{name}={_repr.repr(value)}" for name, value in kwargs.items()
        ]
        return cls(target, ", ".join(given))


# -- handlers -------------------------------------------------------------------------------------


class Attached:
    """A handler at a position of a target, made ready to be called.

    Attributes:
        handler: The handler.
        target: What it is attached to.
        position: Where.
    """

    __slots__ = ("_moved", "_wants_result", "handler", "position", "target")

    def __init__(self, handler: Any, target: Target, position: str) -> None:
        """Make sure that a handler fits.

        Raises:
            HandlerError: It does not, or there is no such position here.
        """
        if position not in target.positions:
            known = position in CALLS + ITEMS
            why = f"{target.name} {target.nature}" if known else "there is no such position"
            raise HandlerError(
                f"no handler can be attached {position!r} {target.name}: {why}; its positions are"
                f" {', '.join(target.positions)}"
            )
        if not callable(handler):
            raise HandlerError(f"the handler of {target.name} must be callable, not {handler!r}")
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
        if note not in getattr(error, "__notes__", ()):
            annotate(error, note)


def _binds(signature: inspect.Signature, number: int, keywords: list[str]) -> bool:
    """Whether so many arguments and these keywords can be passed."""
    try:
        signature.bind(*[None] * number, **dict.fromkeys(keywords))
    except TypeError:
        return False
    return True


class Handlers:
    """The handlers of one target's calls, by position."""

    __slots__ = ("_positions", "after", "before", "instead", "recorders", "target")

    def __init__(self, target: str, attached: list[Attached], recorders: list[Record]) -> None:
        self.target, self.recorders = target, recorders
        self._positions = {position: [a for a in attached if a.position == position] for position in CALLS + ITEMS}
        self.before, self.after = self._positions["before"], self._positions["after"]
        self.instead = self._positions["instead"][-1] if self._positions["instead"] else None

    def call(self, rule: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Run a call of a plain function."""
        if self.instead is not None:
            return self.instead(args, kwargs)
        for attached in self.before:
            changed = attached(args, kwargs)
            if isinstance(changed, ChangedArgs):
                args, kwargs = changed.args, changed.kwargs
        result = rule(*args, **kwargs)
        for attached in self.after:
            changed = attached(args, kwargs, result)
            if isinstance(changed, ChangedResult):
                result = changed.value
        return result

    def iterate(
        self, slot: Slot, rule: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]
    ) -> Generator[Any, Any, Any]:
        """Run a call of a generator function."""
        if self.instead is not None:
            value = self.instead(args, kwargs)
            if isinstance(value, (str, bytes)) or not isinstance(value, Iterable):
                return value
            try:
                return (yield from value)
            except Exception as error:
                self.instead.annotate(error)
                raise
        for attached in self.before:
            changed = attached(args, kwargs)
            if isinstance(changed, ChangedArgs):
                args, kwargs = changed.args, changed.kwargs
        if any(self._positions[position] for position in ITEMS):
            result = yield from _each(slot, rule(*args, **kwargs), args, kwargs)
        else:
            result = yield from rule(*args, **kwargs)
        for attached in self.after:
            changed = attached(args, kwargs, result)
            if isinstance(changed, ChangedResult):
                result = changed.value
        return result

    async def wait(self, rule: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Run a call of a coroutine function, whose handlers may be coroutine functions, too."""
        if self.instead is not None:
            return await _awaited(self.instead, self.instead(args, kwargs))
        for attached in self.before:
            changed = await _awaited(attached, attached(args, kwargs))
            if isinstance(changed, ChangedArgs):
                args, kwargs = changed.args, changed.kwargs
        result = await rule(*args, **kwargs)
        for attached in self.after:
            changed = await _awaited(attached, attached(args, kwargs, result))
            if isinstance(changed, ChangedResult):
                result = changed.value
        return result

    def next(self, fetch: Callable[[], Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Hand out the next item; raise ``StopIteration`` where there is none."""
        instead = self._positions["instead_next"]
        if instead:
            return instead[-1](args, kwargs)
        for attached in self._positions["before_next"]:
            changed = attached(args, kwargs)
            if isinstance(changed, ChangedArgs):
                args, kwargs = changed.args, changed.kwargs
        item = fetch()
        for attached in self._positions["after_next"]:
            changed = attached(args, kwargs, item)
            if isinstance(changed, ChangedResult):
                item = changed.value
        return item

    def recording(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> _Recording:
        """Have a call recorded; its result is to be put into the list."""
        return _Recording([record(self.target, args, kwargs) for record in self.recorders])


class _Recording:
    """The records of one call that is going on."""

    def __init__(self, calls: list[Any]) -> None:
        self._calls, self._results = calls, list[Any]()

    def __enter__(self) -> list[Any]:
        return self._results

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        result = _repr.repr(self._results[0]) if error is None else f"raised {_repr.repr(error)}"
        for call in self._calls:
            call.result = result


async def _awaited(attached: Attached, value: Any) -> Any:
    if not inspect.isawaitable(value):
        return value
    try:
        return await value
    except Exception as error:
        attached.annotate(error)
        raise


def _each(
    slot: Slot, generator: Generator[Any, Any, Any], args: tuple[Any, ...], kwargs: dict[str, Any]
) -> Generator[Any, Any, Any]:
    """Hand out a generator's items one by one. What is sent and thrown reaches it, unless it is not asked."""
    sent: Any = None
    thrown: BaseException | None = None
    begun = False

    def fetch() -> Any:
        nonlocal begun, thrown
        error, thrown = thrown, None
        if error is not None:
            return generator.throw(error)
        value = sent if begun else None
        begun = True
        return generator.send(value)

    try:
        while True:
            found = _find(slot)
            try:
                item = fetch() if found is None or thrown is not None else found.next(fetch, args, kwargs)
            except StopIteration as stop:
                return stop.value
            try:
                sent = yield item
            except GeneratorExit:
                raise
            except BaseException as error:
                sent, thrown = None, error
    finally:
        generator.close()


class Items:
    """An iterator whose items are handed out with handlers. All else is the iterator's own."""

    def __init__(self, iterator: Iterator[Any], slot: Slot, iterable: Any) -> None:
        self._iterator, self._slot, self._iterable = iterator, slot, iterable

    def __iter__(self) -> Items:
        return self

    def __next__(self) -> Any:
        return next_item(self._slot, self._iterator.__next__, self._iterable)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._iterator, name)


def next_item(slot: Slot, fetch: Callable[[], Any], iterable: Any) -> Any:
    """Hand out the next item of an iterable, of which ``fetch`` is its own way."""
    found = _find(slot) if slot else None
    return fetch() if found is None else found.next(fetch, (iterable,), {})


# -- calls ----------------------------------------------------------------------------------------


def _find(slot: Slot) -> Handlers | None:
    """The handlers for what is at work in this thread."""
    return slot.get(PLUGGED.get(get_ident())) or slot.get(None)


_NONE_HERE: Final = "(found := SLOT.get(PLUGGED.get(get_ident())) or SLOT.get(None)) is None"
"""What ``_find`` finds out, without the call."""


def _call(found: Handlers, slot: Slot, rule: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    if not found.recorders:
        return found.call(rule, args, kwargs)
    with found.recording(args, kwargs) as results:
        results.append(found.call(rule, args, kwargs))
    return results[0]


def _iterate(
    found: Handlers, slot: Slot, rule: Any, args: tuple[Any, ...], kwargs: dict[str, Any]
) -> Generator[Any, Any, Any]:
    with found.recording(args, kwargs) as results:
        results.append((yield from found.iterate(slot, rule, args, kwargs)))
    return results[0]


async def _wait(found: Handlers, slot: Slot, rule: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    with found.recording(args, kwargs) as results:
        results.append(await found.wait(rule, args, kwargs))
    return results[0]


_HANDLED: Final = {"function": _call, "generator": _iterate, "coroutine": _wait}


# -- targets --------------------------------------------------------------------------------------


class Target:
    """What handlers are attached to.

    Attributes:
        name: What it is called: a dotted name, where it has one.
        positions: Where handlers can be attached.
        nature: Why not elsewhere.
        signature: What it can be called with, and so what handlers are; None where that is not known.
        slot: Its handlers, by whose they are. Empty while it has none.
        number: How many targets there were before it.
        place: Where it has to be set as long as it has handlers; None where it is there for good.
        attached: The handlers for everybody, in the order in which they were attached.
    """

    all: Final[WeakSet[Target]] = WeakSet()

    def __init__(self, name: str, positions: tuple[str, ...], nature: str, signature: inspect.Signature | None) -> None:
        self.name, self.positions, self.nature, self.signature = name, positions, nature, signature
        self.number = next(_NUMBERS)
        self.slot: Slot = {}
        self.place: Place | None = None
        self.patches: list[tuple[Place, int, Callable[[Any], Any]]] = []
        self.attached: list[Attached] = []
        self._of_environments: dict[Any, list[Attached]] = {}
        self._recorders: list[Record] = []
        self._changes = 0
        Target.all.add(self)

    def __repr__(self) -> str:
        return f"<Target {self.name}>"

    def hold(self) -> None:
        """Be set where it has to be, until as many calls of ``let_go``.

        Raises:
            PatchError: A place refuses.
        """
        done = []
        try:
            for place, level, wrap in self.patches:
                place.hold(level, wrap)
                done.append((place, level))
        except BaseException:
            for place, level in done:
                place.let_go(level)
            raise

    def let_go(self) -> None:
        """Undo one ``hold``."""
        for place, level, _ in self.patches:
            place.let_go(level)

    def add(self, attached: Attached | Record, plugins: Any = None) -> None:
        """Attach a handler, for everybody or for an environment's plugins; or have all calls recorded.

        Raises:
            PatchError: What it has to be set in front of cannot be patched.
        """
        self.hold()
        if not isinstance(attached, Attached):
            self._recorders.append(attached)
        elif plugins is None:
            self.attached.append(attached)
        else:
            self._of_environments.setdefault(plugins, []).append(attached)
        self._make_ready()

    def remove(self, attached: Attached | Record, plugins: Any = None) -> None:
        """Undo one ``add``."""
        if not isinstance(attached, Attached):
            self._recorders.remove(attached)
        elif plugins is None:
            self.attached = [other for other in self.attached if other is not attached]
        else:
            left = [other for other in self._of_environments.pop(plugins) if other is not attached]
            if left:
                self._of_environments[plugins] = left
        self._make_ready()
        self.let_go()

    def _make_ready(self) -> None:
        self._changes += 1
        changes = 0
        # The collector may come in between and close an environment, whose handlers go then.
        while changes != self._changes:
            changes = self._changes
            slot: Slot = {}
            if self.attached or self._recorders:
                slot[None] = Handlers(self.name, self.attached, self._recorders)
            for plugins, own in list(self._of_environments.items()):
                slot[plugins] = Handlers(self.name, [*self.attached, *own], self._recorders)
            self.slot.update(slot)  # never empty in between: a call may be looking in another thread
            for plugins in list(self.slot):
                if plugins not in slot:
                    self.slot.pop(plugins, None)


class FunctionTarget(Target):
    """A function, whatever its calls return, with an exposed function in front of it."""

    def __init__(self, function: Any, name: str, *, like: Any = None, bound: bool = True) -> None:
        """Make the target of a function.

        Args:
            function: The function.
            name: Its dotted name.
            like: A function that tells what calls return, where the function only passes them on to it.
            bound: Whether, in a class, its first argument is what it is called on.

        Raises:
            PatchError: An async generator function, to which no position applies.
        """
        like = function if like is None else like
        self._kind = kind_of(like, name)
        known = point_of(like)
        self._own: inspect.Signature | None = None
        signature: inspect.Signature | None = None
        try:
            # A decision function's own parameters are made such that all calls can be told apart.
            self._own = inspect.signature(known[0].rule if known else function, follow_wrapped=False)
            signature = inspect.signature(function)
        except (TypeError, ValueError):
            self._own = None  # nothing is known of it
        self._alone = self._own is not None and is_alone(self._own, bound=bound and is_method(function, name))
        iterates = self._kind == "generator"
        super().__init__(name, CALLS + ITEMS if iterates else CALLS, "is no generator function", signature)

    def wrap(self, rule: Any) -> FunctionType:
        """Make an exposed function of this target.

        Args:
            rule: What stands behind it: the function, or what is set in its place for a while.
        """
        return generate(
            rule,
            self._own,
            what=EXPOSED,
            name=self.name,
            kind=self._kind,
            alone=self._alone,
            guard="SLOT",
            ask="handled(found, SLOT, rule, {}, {})",
            unless=_NONE_HERE,
            namespace={
                "SLOT": self.slot,
                "PLUGGED": PLUGGED,
                "get_ident": get_ident,
                "target": self,
                "handled": _HANDLED[self._kind],
            },
        )


_ONE = inspect.Signature([inspect.Parameter("iterable", inspect.Parameter.POSITIONAL_ONLY)])


class IterableTarget(Target):
    """An iterable, or a class whose instances are."""

    def __init__(self, name: str, nature: str = "is not called: it is iterated over") -> None:
        super().__init__(name, ITEMS, nature, _ONE)

    def wrap_iter(self, rule: Any) -> Any:
        """Make the ``__iter__`` of a class whose instances' items have handlers."""
        slot = self.slot

        def __iter__(iterable: Any) -> Any:  # noqa: N807
            iterator = rule(iterable)
            return iterator if iterator is iterable else Items(iterator, slot, iterable)

        return update_wrapper(__iter__, rule)

    def wrap_next(self, rule: Any) -> Any:
        """Make its ``__next__``."""
        slot = self.slot

        def __next__(iterable: Any) -> Any:  # noqa: N807
            return next_item(slot, lambda: rule(iterable), iterable)

        return update_wrapper(__next__, rule)
