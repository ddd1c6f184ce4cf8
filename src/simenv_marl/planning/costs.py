"""What the decisions of a planner cost, which it says before a long run."""

from __future__ import annotations

import os
import sys
from functools import partial
from time import perf_counter
from typing import Final, NamedTuple

from ..core import Policy, branch
from ..many.loads import take_load
from .candidates import Task
from .player import Environment, Player
from .players import player_of

LONG: Final = 60.0
"""The seconds of a run before which a planner says what a decision costs."""

PATIENCE: Final = 2.0
"""The seconds after which the timed future is given up."""


class Future(NamedTuple):
    """A timed future: its decisions, its real time, the time of its last decision, its end."""

    decisions: int
    seconds: float
    time: float
    is_over: bool


def say_costs(
    player: Player, task: Task, candidates: int, branches: int, method: str | None, limit: float
) -> None:
    """Say what a decision costs, once in a run, if the run takes longer than a minute.

    Args:
        player: The player of the agent, in its first decision of the run.
        task: The planner.
        candidates: The number of candidates.
        branches: The number of branches of a decision.
        method: The method of branching.
        limit: The time limit of a branch.
    """
    load = take_load()
    if load is None:
        return
    try:
        call = partial(_time_future, base=task.base)
        [future] = branch(player.env, call, method=method, time_limit=limit)
    except Exception:  # the search raises it, too, or does not look so far ahead
        return
    share = 1.0
    if task.horizon is not None:
        length = future.time if task.horizon_by == "time" else future.decisions
        share = min(1.0, task.horizon / length) if length else 1.0
    can_fork = method != "replay" and player.view.driver == "greenlet"
    cores = len(os.sched_getaffinity(0)) if can_fork else 1
    seconds = share * future.seconds
    if not can_fork:
        seconds += future.seconds / 2  # a replay repeats the past: half an episode on average
    decision = branches * seconds / max(1, cores // load.processes)
    episode = decision * future.decisions / task.every
    if episode * load.episodes / load.processes < LONG:
        return
    each = branches / candidates
    futures = f"{candidates} candidates x {each:.3g} future{'s' * (each != 1)}"
    at_least = "" if future.is_over else "more than "
    print(
        f"simenv_marl: {futures} x {_shown(seconds)} on {cores} core{'s' * (cores > 1)}: about"
        f" {_shown(decision)} a decision, {at_least}{_shown(episode)} an episode",
        file=sys.stderr,
        flush=True,
    )


def _time_future(env: Environment, number: int, base: Policy) -> Future:
    """In a branch, let the base decide to the end, and measure that."""
    player = player_of(env, base)
    player.start()
    begin = perf_counter()
    start = now = player.time()
    decisions = 0
    while not player.over and perf_counter() - begin < PATIENCE:
        now = player.time()
        player.step(player.decide())
        decisions += 1
    return Future(decisions, perf_counter() - begin, now - start, player.over)


def _shown(seconds: float) -> str:
    """Return a duration as text."""
    for unit, size in (("h", 3600.0), ("min", 60.0), ("s", 1.0)):
        if seconds >= size:
            return f"{seconds / size:.0f} {unit}"
    return f"{1000 * seconds:.0f} ms"
