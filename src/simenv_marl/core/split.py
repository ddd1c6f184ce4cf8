"""Calls that decide for many entities at once: each item is a decision, and the call returns what comes of all."""

from __future__ import annotations

from collections.abc import Generator
from types import coroutine
from typing import TYPE_CHECKING, Any, Final

from ..errors import SimulationError
from ..simulation import RULE, Sentinel

if TYPE_CHECKING:
    from .episode import Episode
    from .point import Point

_BEGIN: Final = Sentinel("BEGIN")
"""The reply to a call that is split. It does not reach the simulation."""


class Split:
    """The event of a call at a decision point whose definition splits it."""

    def __init__(self, point: Point) -> None:
        self.point, self.report = point, point.report

    def handle(self, episode: Episode, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Split a call.

        From now on the items arise, one after the other, as decisions of the simulation do.
        """
        items = list(self.point.definition.split(*args, **kwargs))  # type: ignore[misc]
        if not items:
            return RULE
        if self.report is not None:
            episode.items = items
        in_place: Any = _Items(episode, self.point, items, args, kwargs)
        episode.driver = in_place
        return _BEGIN

    def deliver(self, reply: Any, *args: Any, **kwargs: Any) -> Any:
        """On the simulation's side, turn the replies to the items into the value of the call."""
        items, replies = reply
        value: Any = self._gather(items, replies, args, kwargs)
        if self.point.hook.kind == "generator":
            return value
        if self.point.hook.kind == "coroutine":
            return _awaited(value)
        try:
            next(value)
        except StopIteration as end:
            return end.value
        raise AssertionError("a function does not wait")

    def _gather(
        self, items: list[Any], replies: list[Any], args: Any, kwargs: Any
    ) -> Generator[Any, Any, Any]:
        """Return the value of the call.

        The rule runs once, when it is first needed; waits as its function does.
        """
        definition, hook, deliver = self.point.definition, self.point.hook, self.point.deliver
        decisions: list[Any] = []
        results: list[Any] = []
        for place, (item, reply) in enumerate(zip(items, replies, strict=True)):
            if reply is RULE and not results:
                results.append((yield from _value(hook.rule(*args, **kwargs), hook.kind)))
                if results[0] is RULE:
                    raise SimulationError(
                        f"the rule of {hook.name}, in another process, decides for all items of a"
                        " call or for none; answer all of them by RULE, or none"
                    )
            if reply is not RULE:
                value = reply if deliver is None else deliver(reply, item, *args, **kwargs)
                decisions.append(
                    value if deliver is None else (yield from _value(value, hook.kind))
                )
            elif definition.part is None:
                decisions.append(results[0][place])
            else:
                decisions.append(definition.part(results[0], item, *args, **kwargs))
        return (
            decisions
            if definition.gather is None
            else definition.gather(items, decisions, *args, **kwargs)
        )


@coroutine
def _awaited(value: Any) -> Generator[Any, Any, Any]:
    return (yield from value)


def _value(value: Any, kind: str) -> Generator[Any, Any, Any]:
    """Return what a function of a kind decides, after it has waited for it."""
    if kind == "generator":
        value = yield from value
    elif kind == "coroutine":
        value = yield from value.__await__()
    return value


class _Items:
    """In place of an episode's driver during a call: it sends the items as events, and then the replies to the call."""

    def __init__(
        self, episode: Episode, point: Point, items: list[Any], args: Any, kwargs: Any
    ) -> None:
        self._episode, self._driver, self._point = episode, episode.driver, point
        self._items, self._args, self._kwargs = items, args, kwargs
        self._replies: list[Any] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._driver, name)

    @property
    def caller(self) -> Any:
        """The greenlet from which the simulation can be resumed."""
        return self._driver.caller

    @caller.setter
    def caller(self, caller: Any) -> None:
        self._driver.caller = caller

    def resume(self, reply: Any) -> Any:
        """Note the reply to an item; return the next item as an event, or resume the simulation."""
        if reply is not _BEGIN:
            self._replies.append(reply)
        place = len(self._replies)
        if place < len(self._items):
            return self._point, (self._items[place], *self._args), self._kwargs
        self._episode.driver = self._driver
        ruled = all(reply is RULE for reply in self._replies)
        return self._driver.resume(RULE if ruled else (self._items, self._replies))
