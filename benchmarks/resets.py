"""The cost outside decisions: a reset, a three-decision episode, an environment for one reset."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

from greenlet import getcurrent, greenlet
from pettingzoo.utils.conversions import aec_to_parallel

from benchmarks.hand_written import TemplateAECEnv, TemplateEnv
from benchmarks.measure import Group, Row, both, calls
from benchmarks.noop import Alone, Model, Turns
from simenv_marl import aec_env, parallel_env, single_env

DECISIONS = 3


class Short(Turns):
    """One agent, for three decisions."""

    def run(self) -> None:
        for _ in range(DECISIONS):
            self.model.left()


def groups(number: int) -> Iterator[Group]:
    """Yield the rows, with a tenth of the number of resets of each contender."""
    number = max(number // 10, 1)
    template = TemplateAECEnv(1, DECISIONS)
    views: dict[str, Any] = {
        "single": (single_env(Short, Model.left), TemplateEnv(), partial(play, 1)),
        "AEC": (aec_env(Short, Model.left), template, play_aec),
        "parallel": (
            parallel_env(Short, Model.left),
            aec_to_parallel(template),
            partial(play, {"agent_0": 1}),
        ),
    }
    start, whole = (calls(play_greenlet, number, decisions) for decisions in (0, DECISIONS))
    rows = []
    for view, (env, hand, plays) in views.items():
        reset, reset_by_hand = calls(env.reset, number), both(calls(hand.reset, number), start)
        episode, episode_by_hand = (
            calls(plays, number, env),
            both(calls(plays, number, hand), whole),
        )
        rows += [
            Row(f"{view}: a reset / template + a greenlet", reset, reset_by_hand),
            Row(f"{view}: three decisions / template + a greenlet", episode, episode_by_hand),
        ]
    once = calls(use, number, partial(single_env, Alone, Model.left))
    once_by_hand = both(calls(use, number, TemplateEnv), start)
    rows.append(Row("single: made, reset and closed / template + a greenlet", once, once_by_hand))
    yield Group(rows)


def play(action: Any, env: Any) -> None:
    """Play an episode of a Gymnasium or a parallel environment."""
    env.reset()
    for _ in range(DECISIONS):
        env.step(action)


def play_aec(env: Any) -> None:
    """Play an episode of an AEC environment, with the agent's last step."""
    env.reset()
    for _ in range(DECISIONS):
        env.last()
        env.step(1)
    env.last()
    env.step(None)


def play_greenlet(decisions: int) -> None:
    """Start a greenlet, resume it for some decisions, and end it."""

    def run() -> None:
        back = getcurrent().parent.switch
        for _ in range(DECISIONS):
            back()

    stack = greenlet(run)
    stack.switch()
    for _ in range(decisions):
        stack.switch()
    if decisions < DECISIONS:
        stack.throw()


def use(make: Any) -> None:
    """Make an environment, reset it once, and close it."""
    env = make()
    env.reset()
    env.close()
