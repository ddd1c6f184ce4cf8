"""Calls that decide for many entities at once: each item is a decision."""

from __future__ import annotations

from collections.abc import Callable, Generator
from types import coroutine
from typing import Final, Protocol

from ...errors import SimulationError
from ...simulation import RULE, Model, Sentinel
from ..plans.point import Args, Kwargs
from ..switching.driver import AnyHandler, Event
from .agent import DecisionHandler

BEGIN: Final = Sentinel("BEGIN")
"""The reply to a call that is split. It does not reach the simulation."""


class SplittingEpisode(Protocol):
    """The episode, as the handlers of calls that are split use it."""

    def begin_split(self, call: SplitCall) -> None:
        """Decide the items of a call, before the simulation moves."""


class SplitHandler:
    """Handles the calls at a decision point whose definition splits them."""

    def __init__(self, items: DecisionHandler) -> None:
        """Handle calls of a point. ``items`` handles the decision of each item."""
        self._items = items
        self._point = items.point

    @property
    def report(self) -> AnyHandler | None:
        """Handles the decisions of the rule."""
        return self._items.report

    def handle(self, episode: SplittingEpisode, args: Args, kwargs: Kwargs) -> Model:
        """Split a call. Its items are handled one after the other, as decisions."""
        split = self._point.split
        items = list(() if split is None else split(*args, **kwargs))
        if not items:
            return RULE
        episode.begin_split(SplitCall(self._items, items, args, kwargs))
        return BEGIN

    def deliver(self, reply: Model, *args: Model, **kwargs: Model) -> Model:
        """On the simulation's side, turn the replies to the items into the value of the call."""
        replies = reply.pop()  # the user's side keeps no reference to the items
        items = reply.pop()
        value: Model = self._gather(items, replies, args, kwargs)
        kind = self._point.hook.kind
        if kind == "generator":
            return value
        if kind == "coroutine":
            return _awaited(value)
        try:
            next(value)
        except StopIteration as end:
            return end.value
        raise AssertionError("a function does not wait")

    def _gather(
        self, items: list[Model], replies: list[Model], args: Args, kwargs: Kwargs
    ) -> Generator[Model, Model, Model]:
        """Return the value of the call. Run the rule once, when an item first needs it."""
        point = self._point
        hook = point.hook
        decisions: list[Model] = []
        result: Model = RULE
        for place, (item, reply) in enumerate(zip(items, replies, strict=True)):
            if reply is not RULE:
                decisions.append((yield from self._decide(item, reply, args, kwargs)))
                continue
            if result is RULE:
                result = yield from _value(hook.rule(*args, **kwargs), hook.kind)
            if result is RULE:
                raise SimulationError(
                    f"the rule of {hook.name}, in another process, decides for all items of a call"
                    " or for none; answer all of them by RULE, or none"
                )
            decisions.append(part_of(point.part, result, item, place, args, kwargs))
        if point.gather is None:
            return decisions
        return point.gather(items, decisions, *args, **kwargs)

    def _decide(
        self, item: Model, reply: Model, args: Args, kwargs: Kwargs
    ) -> Generator[Model, Model, Model]:
        deliver = self._point.deliver
        if deliver is None:
            return reply
        return (yield from _value(deliver(reply, item, *args, **kwargs), self._point.hook.kind))


class SplitCall:
    """A call whose items are being decided.

    Attributes:
        handler: Handles the decision of each item.
        items: The items.
    """

    def __init__(
        self, handler: DecisionHandler, items: list[Model], args: Args, kwargs: Kwargs
    ) -> None:
        self.handler = handler
        self.items = items
        self._args = args
        self._kwargs = kwargs
        self._replies: list[Model] = []

    def next_event(self, reply: Model) -> Event | None:
        """Note the reply to an item. Return the event of the next one, or None at the end."""
        if reply is not BEGIN:
            self._replies.append(reply)
        place = len(self._replies)
        if place == len(self.items):
            return None
        return self.handler, (self.items[place], *self._args), self._kwargs

    def reply(self) -> Model:
        """Return the reply to the call."""
        if all(reply is RULE for reply in self._replies):
            return RULE
        return [self.items, self._replies]


def part_of(
    part: Callable[..., Model] | None,
    result: Model,
    item: Model,
    place: int,
    args: Args,
    kwargs: Kwargs,
) -> Model:
    """Return the part of the rule's result that is for an item."""
    return result[place] if part is None else part(result, item, *args, **kwargs)


@coroutine
def _awaited(value: Generator[Model, Model, Model]) -> Generator[Model, Model, Model]:
    return (yield from value)


def _value(value: Model, kind: str) -> Generator[Model, Model, Model]:
    """Return the decision of a function of a kind, after it has waited for it."""
    if kind == "generator":
        value = yield from value
    elif kind == "coroutine":
        value = yield from value.__await__()
    return value
