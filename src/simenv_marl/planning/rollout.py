"""One rollout: in a branch, candidates decide, and then the base, up to a horizon."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Final
from zlib import crc32

from ..core import Agent
from ..errors import annotate, short_repr
from .candidates import Course, Task
from .player import Environment, Player, number_of
from .players import player_of

Indices = tuple[int, ...]
"""The indices of the candidates of a rollout, in the order of their decisions."""

Try = tuple[Indices, int]
"""A rollout to make: its candidates, and the number of its future."""


@dataclass(frozen=True)
class Rollout:
    """A rollout at its end, or where it can be continued.

    Attributes:
        rewards: The discounted reward of each decision of the agent. With a metric, this at the
            last decision, and 0.0 before it.
        times: The simulation's times between the agent's decisions.
        start: The simulation's time at its begin. None before that.
        begins: The number of the first decision of each candidate.
        over: Whether it is at the horizon, or the agent's episode has ended.
        digest: A digest of the agent's last observation and info.
        seconds: The mean real time for a step, in seconds.
    """

    rewards: Sequence[float] = ()
    times: Sequence[float] = ()
    start: float | None = None
    begins: Sequence[int] = ()
    over: bool = False
    digest: int = 0
    seconds: float = 0.0


BEGIN: Final = Rollout()
"""A rollout before its first decision."""


def try_out(
    env: Environment,
    number: int,
    tries: Sequence[Try],
    courses: Sequence[Course],
    task: Task,
    begun: Rollout = BEGIN,
    stop: int | None = None,
) -> Rollout:
    """In a branch, make one of several rollouts.

    The candidates decide, one after the other, and then the base. If an action is illegal when its
    decision arises, the base decides.

    Args:
        env: The environment of the branch.
        number: The number of the rollout.
        tries: The rollouts to make.
        courses: The candidates.
        task: The planner.
        begun: The rollout to continue, at a decision where the next candidate begins.
        stop: The number of candidates to run. None: all, and then the base, to the end.
    """
    indices, future = tries[number]
    path = [courses[index] for index in indices]
    began = perf_counter()
    try:
        player = player_of(env, task.base)
        player.start()
        trial = Trial(player, task, path, begun)
        trial.run(stop)
    except BaseException as error:
        tried = ", ".join(short_repr(course.candidate) for course in path)
        annotate(error, f"simenv_marl: while {tried} was tried out in future {future}")
        raise
    seconds = (perf_counter() - began) / max(1, len(trial.rewards))
    digest = _digest(player.agent)
    return Rollout(
        trial.rewards, trial.times, trial.start, trial.begins, trial.over, digest, seconds
    )


def _digest(agent: Agent) -> int:
    last = (agent.observation, agent.info)
    try:
        return crc32(pickle.dumps(last, 5))  # much faster than a text
    except Exception:
        return crc32(repr(last).encode(errors="replace"))


class Trial:
    """A rollout that is being made.

    Attributes:
        rewards, times, start, begins, over: See ``Rollout``.
    """

    def __init__(
        self,
        player: Player,
        task: Task,
        path: Sequence[Course],
        begun: Rollout,
    ) -> None:
        self._player = player
        self._task = task
        self._path = path
        self.rewards = list(begun.rewards)
        self.times = list(begun.times)
        self.begins = list(begun.begins)
        self.over = False
        self._now = player.time()
        self.start = self._now if begun.start is None else begun.start
        self._begin = self._now  # of the candidate that decides
        if self.begins:
            self._begin = self.start + sum(self.times[: self.begins[-1]])
        self._cut: float | None = None  # the time of the horizon, if it cuts the last interval
        is_timed = task.horizon_by == "time"
        if task.horizon is not None and is_timed and task.terminal_value is None:
            self._cut = self.start + task.horizon
            player.watch(self._cut, task.metric)
        self._before = 0.0  # the metric before the latest step
        self._after: float | None = None  # and where another agent has decided after the cut
        self._share = 1.0  # of the latest interval, before the cut

    def run(self, stop: int | None) -> None:
        """Decide up to the horizon or the agent's end, or before one of the candidates begins."""
        player = self._player
        while not player.over and not self._is_at_horizon():
            course = self._deciding()
            if course is None and len(self.begins) == stop:
                return
            if course is None and len(self.begins) < len(self._path):
                self.begins.append(len(self.rewards))
                self._begin = self._now
                course = self._path[len(self.begins) - 1]
            if course is None and self._is_free():
                player.run_out()
                self.rewards.append(0.0)
            else:
                self._decide(course)
        self.over = True
        self._conclude()

    def _is_at_horizon(self) -> bool:
        decisions = len(self.rewards)
        if not decisions or self._task.horizon is None:
            return False
        reached = {"decision": decisions, "time": self._now - self.start}
        return reached[self._task.horizon_by] >= self._task.horizon

    def _weight(self) -> float:
        """Return the discount of the pending decision."""
        elapsed = {"decision": len(self.rewards), "time": self._now - self.start}
        return float(self._task.discount ** elapsed[self._task.discount_by])

    def _deciding(self) -> Course | None:
        """Return the candidate that goes on. None: the next one begins, or the base decides."""
        if not self.begins:
            return None
        course = self._path[len(self.begins) - 1]
        decisions = len(self.rewards) - self.begins[-1]
        goes_on = course.goes_on(self._task, decisions, self._now - self._begin)
        return course if goes_on else None

    def _is_free(self) -> bool:
        """Return whether nothing is measured before the simulation's end, and the rule decides."""
        task = self._task
        return task.metric is not None and task.horizon is None and self._player.can_run_out()

    def _decide(self, course: Course | None) -> None:
        """Answer the pending decision, by a candidate or the base, and run to the next one."""
        player, task = self._player, self._task
        if course is None:
            action = player.decide()
        else:
            action = player.answer(course.part(len(self.rewards) - self.begins[-1]))
        if self._cut is not None and task.metric is not None:
            self._before = player.read(task.metric)
        weight = self._weight()
        reward = player.step(action)
        begin = self._now
        if self._cut is not None or not player.over:
            self._now = player.time()
        if not player.over:
            self.times.append(self._now - begin)
        if self._cut is not None and self._now > self._cut:
            end = self._now
            if player.noted is not None:
                end, self._after = player.noted
                reward = self._after
            self._share = (self._cut - begin) / (end - begin)
        self.rewards.append(0.0 if task.metric is not None else weight * self._share * reward)

    def _conclude(self) -> None:
        """Add the metric and the terminal value to the last reward."""
        player, task = self._player, self._task
        if not self.rewards:
            return
        if task.metric is not None:
            after = player.read(task.metric) if self._after is None else self._after
            self.rewards[-1] = after
            if self._share != 1.0:
                self.rewards[-1] = self._before + self._share * (after - self._before)
        if task.terminal_value is not None and not player.over:
            value = number_of(task.terminal_value(player.env), "terminal_value")
            self.rewards[-1] += self._weight() * value
