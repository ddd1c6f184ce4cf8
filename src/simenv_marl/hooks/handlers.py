"""Handlers, and the calls in which they take part.

A *target* is what handlers are attached to: a function of a model (a ``Hook``), an iterable, or a class whose
instances iterate. Its *slot* holds the handlers that its calls are to run, made ready by whose they are: ``None``
for the whole process, or the plugins of an environment, with those of the whole process before them.

A call runs the handlers that were there when it began. Items are looked at one by one.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Generator, Iterable, Iterator
from itertools import count
from typing import Any, Final
from weakref import WeakSet

from ..errors import shown
from .attached import CALLS, ITEMS, Attached, Call, ChangedArgs, ChangedResult
from .stacks import Taker, plugins_at_work

Slot = dict[Any, "Handlers"]
"""By whose they are: the handlers of a target."""

Record = Callable[[str, tuple[Any, ...], dict[str, Any]], Call]
"""Makes the entry of a call that begins."""

_NUMBERS: Final = count()


class Handlers:
    """The handlers of one target's calls, by position."""

    __slots__ = ("_positions", "after", "before", "instead", "recorders", "target")

    def __init__(self, target: str, attached: list[Attached], recorders: list[Record]) -> None:
        self.target, self.recorders = target, recorders
        self._positions = {position: [a for a in attached if a.position == position] for position in CALLS + ITEMS}
        self.before, self.after = self._positions["before"], self._positions["after"]
        self.instead = self._positions["instead"][-1] if self._positions["instead"] else None

    def call(self, inner: Taker, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Run a call of a plain function, of which ``inner`` is what lies inside all handlers."""
        if self.instead is not None:
            return self.instead(args, kwargs)
        for attached in self.before:
            changed = attached(args, kwargs)
            if isinstance(changed, ChangedArgs):
                args, kwargs = changed.args, changed.kwargs
        result = inner(args, kwargs)
        for attached in self.after:
            changed = attached(args, kwargs, result)
            if isinstance(changed, ChangedResult):
                result = changed.value
        return result

    def iterate(
        self, slot: Slot, inner: Taker, args: tuple[Any, ...], kwargs: dict[str, Any]
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
            result = yield from _each(slot, inner(args, kwargs), args, kwargs)
        else:
            result = yield from inner(args, kwargs)
        for attached in self.after:
            changed = attached(args, kwargs, result)
            if isinstance(changed, ChangedResult):
                result = changed.value
        return result

    async def wait(self, inner: Taker, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Run a call of a coroutine function, whose handlers may be coroutine functions, too."""
        if self.instead is not None:
            return await _awaited(self.instead, self.instead(args, kwargs))
        for attached in self.before:
            changed = await _awaited(attached, attached(args, kwargs))
            if isinstance(changed, ChangedArgs):
                args, kwargs = changed.args, changed.kwargs
        result = await inner(args, kwargs)
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
        result = shown(self._results[0], 60) if error is None else f"raised {shown(error, 60)}"
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


def _find(slot: Slot) -> Handlers | None:
    """The handlers for what is at work here."""
    return slot.get(plugins_at_work()) or slot.get(None)


# -- calls ----------------------------------------------------------------------------------------


def _call(found: Handlers, slot: Slot, inner: Taker, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    if not found.recorders:
        return found.call(inner, args, kwargs)
    with found.recording(args, kwargs) as results:
        results.append(found.call(inner, args, kwargs))
    return results[0]


def _iterate(
    found: Handlers, slot: Slot, inner: Taker, args: tuple[Any, ...], kwargs: dict[str, Any]
) -> Generator[Any, Any, Any]:
    with found.recording(args, kwargs) as results:
        results.append((yield from found.iterate(slot, inner, args, kwargs)))
    return results[0]


async def _wait(found: Handlers, slot: Slot, inner: Taker, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    with found.recording(args, kwargs) as results:
        results.append(await found.wait(inner, args, kwargs))
    return results[0]


AROUND: Final = {"function": _call, "generator": _iterate, "coroutine": _wait}
"""By what a call returns: how handlers lie around what is inside them."""


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
        exposed: Whether it was exposed to plugins, and is there for good.
        attached: The handlers for the whole process, in the order in which they were attached.
    """

    all: Final[WeakSet[Target]] = WeakSet()

    def __init__(self, name: str, positions: tuple[str, ...], nature: str, signature: inspect.Signature | None) -> None:
        self.name, self.positions, self.nature, self.signature = name, positions, nature, signature
        self.number = next(_NUMBERS)
        self.slot: Slot = {}
        self.exposed = False
        self.attached: list[Attached] = []
        self._of_environments: dict[Any, list[Attached]] = {}
        self._recorders: list[Record] = []
        self._changes = 0
        Target.all.add(self)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.name}>"

    @property
    def stale(self) -> bool:
        """Whether something else has been set in its place, while nothing was set there for it."""
        return False

    def hold(self, holder: object) -> None:
        """Be set where it has to be until ``let_go``, by all who hold it.

        Raises:
            PatchError: A place refuses.
        """

    def let_go(self, holder: object) -> None:
        """Undo ``hold``. After an interrupt it is to be called again."""

    def add(self, attached: Attached | Record, plugins: Any = None) -> None:
        """Attach a handler, for the whole process or for an environment's plugins; or have all calls recorded.

        Raises:
            PatchError: What it has to be set in front of cannot be patched.
        """
        try:
            self.hold(attached)
            if not isinstance(attached, Attached):
                self._recorders.append(attached)
            elif plugins is None:
                self.attached.append(attached)
            else:
                self._of_environments.setdefault(plugins, []).append(attached)
            self._make_ready()
        except BaseException:
            self.remove(attached, plugins)
            raise

    def remove(self, attached: Attached | Record, plugins: Any = None) -> None:
        """Undo ``add``. After an interrupt it is to be called again."""
        self._recorders = [other for other in self._recorders if other is not attached]
        self.attached = [other for other in self.attached if other is not attached]
        left = [other for other in self._of_environments.get(plugins, ()) if other is not attached]
        if left:
            self._of_environments[plugins] = left
        else:
            self._of_environments.pop(plugins, None)
        self._make_ready()
        self.let_go(attached)

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
            self._changed()

    def _changed(self) -> None:
        """Its handlers are others than before."""
