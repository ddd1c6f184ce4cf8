"""Explorations: clones that try out the candidates for a decision, or play on by the rule."""

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from math import floor, log10
from threading import Lock, Thread
from typing import Any, Final, NamedTuple

import numpy as np

from ... import clone
from ...envs import SimulationAECEnv
from ...errors import BranchError, describe_error
from ...simulation import Action
from ..descriptions import at_decision, labelled
from .deciders import Deciders
from .forms import (
    MOST_CANDIDATES,
    Message,
    action_of,
    candidates_of,
    entries_of,
    jsonable,
    situation_of,
    words_of,
)

FUTURES: Final = 16
"""The number of futures that try out each candidate."""

MOST_MEASURES: Final = 12
"""The largest number of numbers of a situation whose futures are shown."""

MOST_DECISIONS: Final = 200
"""The largest number of decisions of an agent in a future."""

POINTS: Final = 8
"""The number of points of a course that are shown after the first one."""

DECISIONS: Final = 8
"""The number of decisions that are looked ahead unless a person chooses otherwise."""

TIME_LIMIT: Final = 30.0
"""The time limit of each operation in a future, in seconds."""

Course = list[list[float]]
"""A row for each decision of the agent in a future: time, return since now, and measures."""


class Exploration:
    """Work in clones of an environment. It can be abandoned while a clone computes."""

    is_abandoned = False

    def __init__(
        self,
        env: SimulationAECEnv,
        deciders: Deciders,
    ) -> None:
        """Explore from the pending decision of an environment on."""
        self.env = env
        self._deciders = deciders
        self._lock = Lock()
        self._process: int | None = None
        self._thread: Thread | None = None

    def explore(self) -> Iterator[Message | None]:
        """Explore. Yield None after each step of a simulation, or a message for the page."""
        raise NotImplementedError

    def start(self, tell: Callable[[Message], None]) -> None:
        """Explore in the background. The clones must be in other processes.

        Args:
            tell: A function that receives each message.
        """

        def run() -> None:
            for message in self.explore():
                if self.is_abandoned:
                    return
                if message is not None:
                    tell(message)

        if self._thread is None:
            self._thread = Thread(target=run, daemon=True)
            self._thread.start()

    def abandon(self) -> None:
        """End the exploration at once, also if a clone computes."""
        self.is_abandoned = True
        self._kill()
        if self._thread is not None:
            self._thread.join()

    def wait(self) -> None:
        """Wait for the end of the exploration."""
        if self._thread is not None:
            self._thread.join()

    @contextmanager
    def _twin(self, seed: int | None) -> Iterator[SimulationAECEnv]:
        """Make a clone that ends in the end."""
        twin = clone(self.env, seed=seed, time_limit=TIME_LIMIT)
        try:
            with self._lock:
                self._process = getattr(twin.session, "process", None)  # None: in this process
            if self.is_abandoned:
                raise BranchError("the exploration was abandoned")
            yield twin
        finally:
            self._kill()  # so that it does not close the simulation, which is a copy
            with suppress(BranchError):
                twin.close()

    def _kill(self) -> None:
        """End the process of the clone, if there is one."""
        with self._lock:
            if self._process is not None:
                os.kill(self._process, signal.SIGKILL)
                self._process = None

    def _answer(self, twin: SimulationAECEnv) -> Action:
        """Return the action of an agent in a future: by its policy, or by the rule."""
        agent = twin.agent_selection
        answer = self._deciders.answer(twin, future=True)
        return action_of(twin.action_space(agent), answer)


# -- the candidates for a decision ----------------------------------------------------------------


class Candidate(NamedTuple):
    """An action to try out, as JSON, and its courses."""

    action: Action
    courses: list[Course]


@dataclass
class Horizon:
    """How far the futures go.

    Attributes:
        by_time: Whether it is a time, else a number of the agent's decisions.
        time: The time. None: that of the first future's ``DECISIONS`` decisions.
        decisions: The number of decisions.
    """

    by_time: bool = True
    time: float | None = None
    decisions: int = DECISIONS

    def set(self, by_time: bool, length: float) -> None:
        """Look so far ahead from now on."""
        self.by_time = by_time
        if by_time:
            self.time = length
        else:
            self.decisions = int(length)

    def learn(self, span: float) -> None:
        """Take the time of a future, rounded down to one digit."""
        if self.time is None and span > 0:
            unit = 10.0 ** floor(log10(span))
            self.time = float(f"{floor(span / unit) * unit:.0e}")


class Futures(Exploration):
    """The candidates for a pending decision. All are tried out in the same futures.

    Attributes:
        pending: The pending decision as JSON.
        candidates: The candidates. The first one is the rule.
        measures: The labels of the numbers of the situation, by their places in it.
        rule_action: The part of the message with the action of the rule, once it is known.
        note: A remark for the page.
    """

    def __init__(
        self,
        env: SimulationAECEnv,
        deciders: Deciders,
        pending: Message,
        horizon: Horizon,
        seed: int,
    ) -> None:
        """Find the candidates and the measures.

        Args:
            env: The environment whose decision is pending.
            deciders: The policies of other agents.
            pending: The decision as JSON, with its ``moment``.
            horizon: How far the futures go.
            seed: The seed from which the futures draw theirs.
        """
        super().__init__(env, deciders)
        self.pending = pending
        self.note = ""
        self._horizon = horizon
        self._seed = seed
        self._agent: str = pending["agent"]
        self._space = env.action_space(self._agent)
        self._by_time = horizon.by_time and pending["time"] is not None
        self._start: float = pending["time"] if self._by_time else 0.0
        actions = [None, *candidates_of(self._space, pending["form"])]
        self.candidates = [Candidate(action, []) for action in actions]
        self.measures: dict[int, str] = {}
        for place, entry in enumerate(pending["situation"]):
            if entry["number"] is not None and len(self.measures) < MOST_MEASURES:
                self.measures[place] = entry["label"]
        self._first = [self._start, 0.0, *self._numbers(pending["situation"])]
        self.rule_action: Message = {}

    def add(self, action: Action) -> None:
        """Add a legal candidate, as JSON."""
        actions = [candidate.action for candidate in self.candidates]
        if len(actions) < MOST_CANDIDATES and action not in actions:
            self.candidates.append(Candidate(action, []))

    def resumed(self, env: SimulationAECEnv) -> "Futures":
        """Return an exploration with the same candidates and their courses."""
        other = Futures(env, self._deciders, self.pending, self._horizon, self._seed)
        other.candidates[:] = self.candidates
        other.rule_action |= self.rule_action
        return other

    def explore(self) -> Iterator[Message | None]:
        """Try out the candidates.

        Yields:
            None after each step of a simulation, and a message for the page after each future.
        """
        yield self.message(is_over=False)
        seeds = self._seeds()
        for place, seed in enumerate(seeds):
            for candidate in self.candidates:
                if len(candidate.courses) == place and not self.is_abandoned:
                    yield from self._play(candidate, seed)
            yield self.message(is_over=place == len(seeds) - 1)

    def _seeds(self) -> list[int] | list[None]:
        """Return the seeds of the futures; None for the future of the episode itself."""
        first = self._seed * 1_000_003 + self.pending["number"] * 1009
        seeds = [(first + place) % 2**31 for place in range(FUTURES)]
        try:
            clone(self.env, seed=seeds[0]).close()
        except Exception as error:
            self.note = f"There is one future, with foresight: {error}"
            return [None]
        return seeds

    def _play(self, candidate: Candidate, seed: int | None) -> Iterator[None]:
        """Play a future, and add its course to the candidate. Yield after each step."""
        course = [self._first]
        try:
            with self._twin(seed) as twin:
                twin.step(action_of(self._space, candidate.action))
                while twin.agents:
                    is_agent = twin.agent_selection == self._agent
                    _, reward, terminated, truncated, info = twin.last(observe=False)
                    ended = terminated or truncated
                    if is_agent:
                        course.append(self._row(twin, course[-1], reward, ended))
                        if candidate.action is None and "rule_action" in info:
                            self._note_rule(jsonable(info["rule_action"]))
                        if ended or self._is_far(len(course) - 1, course[-1][0]):
                            break
                    elif self._by_time and self._is_far(0, info.get("time", self._start)):
                        break
                    yield
                    twin.step(None if ended else self._answer(twin))
        except Exception as error:
            if not self.is_abandoned:
                self.note = f"A future has failed: {describe_error(error)[:300]}"
        if self.is_abandoned:
            return
        if self._by_time:
            self._horizon.learn(course[-1][0] - self._start)
        candidate.courses.append(course)

    def _is_far(self, decisions: int, time: float) -> bool:
        """Return whether a future has gone as far as the horizon."""
        horizon = self._horizon
        if self._by_time and horizon.time is not None:
            return time >= self._start + horizon.time or decisions >= MOST_DECISIONS
        return decisions >= horizon.decisions

    def _note_rule(self, action: Action) -> None:
        words = words_of(self.pending["form"], action)
        self.rule_action = self.rule_action or {"rule": action, "rule_words": words}

    def _row(
        self,
        twin: SimulationAECEnv,
        before: list[float],
        reward: float,
        ended: bool,
    ) -> list[float]:
        """Return the row of the agent's decision, or of its end."""
        info = twin.infos[self._agent]
        time = info.get("time", before[0]) if self._by_time else before[0] + 1
        if not self.pending["displayed"]:
            situation = entries_of(labelled(twin.observe(self._agent)))
        elif ended:
            return [time, before[1] + reward, *before[2:]]
        else:
            situation = at_decision(twin, "play", situation_of)
        return [time, before[1] + reward, *self._numbers(situation)]

    def _numbers(self, situation: list[Message]) -> list[float]:
        numbers = dict(enumerate(entry["number"] for entry in situation))
        found = [numbers.get(place) for place in self.measures]
        return [float("nan") if number is None else float(number) for number in found]

    def message(self, *, is_over: bool) -> Message:
        """Return the message for the page.

        Its ``bands`` have, for each measure, the lower end of the 80 % band, the median and the
        upper end, at points from now to the horizon.
        """
        horizon = self._horizon
        length = horizon.time if self._by_time else horizon.decisions
        points = np.linspace(0, length or 0, POINTS + 1) + self._start
        candidates = []
        for action, courses in self.candidates:
            words = "" if action is None else words_of(self.pending["form"], action)
            sampled = [_sampled(course, points) for course in courses]
            bands: Any = []
            if sampled:
                quantiles = np.quantile(sampled, (0.1, 0.5, 0.9), axis=0)
                bands = quantiles.transpose(2, 0, 1).round(6)
            candidates.append(
                {"action": action, "words": words, "n": len(courses), "bands": jsonable(bands)}
            )
        return {
            "type": "fan",
            "turn": self.pending["turn"],
            "moment": self.pending["moment"],
            "horizon": length,
            "by_time": self._by_time,
            "measures": ["your points", *self.measures.values()],
            "candidates": candidates,
            "done": is_over,
            "note": self.note,
            **self.rule_action,
        }


def _sampled(course: Course, points: Any) -> Any:
    """Return the returns and measures of a course at points. An ended course stays as it is."""
    rows = np.nan_to_num(np.array(course), nan=0.0, posinf=1e12, neginf=-1e12)
    return np.stack([np.interp(points, rows[:, 0], column) for column in rows.T[1:]], axis=1)


# -- the same episode by the rule -----------------------------------------------------------------


class Comparison(Exploration):
    """The game's episode as it goes if the rule decides for all people."""

    def __init__(
        self,
        env: SimulationAECEnv,
        deciders: Deciders,
        returns: dict[str, float],
        moment: int,
    ) -> None:
        """Compare from the first decision of a person on.

        Args:
            env: The environment at that decision.
            deciders: The policies of other agents.
            returns: The returns until then.
            moment: The moment of the game, for the page.
        """
        super().__init__(env, deciders)
        self._totals = {**returns}
        self._courses = {agent: [total] for agent, total in returns.items()}
        self._moment = moment

    def explore(self) -> Iterator[Message | None]:
        """Play the episode to its end, and yield a message with the totals and their courses."""
        note = ""
        try:
            with self._twin(None) as twin:
                first = True
                while twin.agents:
                    agent = twin.agent_selection
                    _, reward, terminated, truncated, _ = twin.last(observe=False)
                    if not first:
                        self._totals[agent] = self._totals.get(agent, 0.0) + reward
                        self._courses.setdefault(agent, [0.0]).append(self._totals[agent])
                    first = False
                    yield None
                    twin.step(None if terminated or truncated else self._answer(twin))
        except Exception as error:
            note = f"The rule's game has failed: {describe_error(error)[:300]}"
        yield {
            "type": "rule",
            "moment": self._moment,
            "totals": self._totals,
            "courses": self._courses,
            "note": note,
        }
