"""The turns of many episodes taken together, which takes less time than one after the other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from operator import length_hint
from threading import get_ident
from typing import Any

from greenlet import getcurrent

from ..decision import DIFFERENCES
from .agent import not_finite, number
from .bindings import Binding
from .episode import Episode
from .switch import (
    EVALUATING,
    RUNNING,
)

Blame = Callable[[int, BaseException], None]
"""Called where one of many episodes raises something: with its number, and the error."""


def turn_together(binding: Binding, episodes: Sequence[Episode], actions: Sequence[Any], blame: Blame) -> Sequence[int]:
    """Answer the pending decisions of many episodes, each as ``Episode.turn`` does.

    All of them move before any is rewarded and observed, which takes less time than one after the other.

    Args:
        binding: Where all of them decide, for one agent each.
        episodes: Episodes of one plan.
        actions: An action for each, checked against its space.
        blame: Called where something raises. The other episodes have moved or not, and can be closed.

    Returns:
        The numbers of the episodes that may be over, or have infos with something in them.

    Raises:
        BaseException: As ``Episode.turn``.
    """
    if (
        RUNNING
        or EVALUATING
        or binding.agent is None
        or binding.legal is not None
        or not binding.point.alone
        or type(episodes[0]) is not Episode
    ):
        for index, (each, action) in enumerate(zip(episodes, actions, strict=True)):
            try:
                each.turn(action)
            except BaseException as error:
                blame(index, error)
                raise
        return range(len(episodes))
    events = _resume_together(binding, episodes, actions, blame)
    others: list[int] = []
    left: Any = iter(events)
    del events
    episode: Any
    record: Any
    reward: Any
    memories = EVALUATING if DIFFERENCES else None
    thread = get_ident()
    reward_mapping, observe, cast = binding.reward, binding.observe, binding.cast
    try:
        for episode, (bound, args, kwargs) in zip(episodes, left):  # noqa: B905 - it would look for one more
            record = episode.pending
            if bound is not binding or record.ended:
                others.append(len(episodes) - length_hint(left) - 1)
                if bound is not None:  # else its turn is over already
                    episode.pending = None
                    episode.go_on(bound, args, kwargs)
                bound = args = kwargs = None
                continue
            # As in ``turn``.
            episode._latest, episode.pending = record, None
            (first,) = args
            record._args, record._kwargs = args, kwargs
            if memories is not None:
                memories[thread] = record.memory
            try:
                reward = reward_mapping(first)
                if type(reward) is not float:
                    reward = number(reward)
                if reward - reward != 0.0:
                    raise not_finite(record, reward)
                record.reward = reward
                record.observation = cast(observe(first))
            except BaseException as error:
                args = kwargs = first = None
                episode._fail(error)
                raise
            if record.info:
                record.info = {}
            episode.pending = record
    except BaseException as error:
        index, left = len(episodes) - length_hint(left) - 1, None
        blame(index, error)
        raise
    finally:
        EVALUATING.pop(thread, None)
    return others


def _resume_together(binding: Binding, episodes: Any, actions: Any, blame: Blame) -> Any:
    """Answer the decisions of many episodes. Returns the events that come next; none for those that went on alone."""
    here: Any = getcurrent()
    convert = binding.convert
    events: Any = []
    add = events.append
    try:
        for episode, action in zip(episodes, actions, strict=True):
            record, driver, turns = episode.pending, episode._driver, episode.turns + 1
            if record is None or driver.caller is not here or record.followed_up or turns == episode._max_turns:
                episode.turn(action)
                add((None, None, None))
                continue
            try:
                reply = convert(action)
            except Exception as error:
                episode._annotate(error)
                raise
            # Still pending, so that it can be closed should another one fail.
            episode.turns = turns
            try:
                resume = driver.resume
                add(resume(reply))
            except BaseException as error:
                episode.pending = None
                episode._fail(error)
                raise
    except BaseException as error:
        index = len(events)
        events = add = resume = reply = None  # else the error would keep alive what they hold
        blame(index, error)
        raise
    return events
