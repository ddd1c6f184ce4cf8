"""Explorations: clones that try out the candidates for a decision, or play on by the rule."""

import os
import signal
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import repeat
from math import floor, log10
from threading import Lock, Thread
from typing import Any, Final, NamedTuple

import numpy as np

from ... import clone
from ...core import Info
from ...envs import SimulationAECEnv
from ...errors import BranchError, InvalidActionError, describe_error
from ...simulation import Action
from ..descriptions import at_decision, labelled
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
from .game import Game

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

Course = list[list[Any]]
"""A row for each decision of the agent in a future: time, return since now, and measures.

A measure that is not there is None.
"""


class Exploration:
    """Work in clones of an environment. It can be abandoned while a clone computes, and go on."""

    def __init__(self, env: SimulationAECEnv, game: Game) -> None:
        """Explore from the pending decision of an environment on, at this moment of a game."""
        self.env = env
        self.moment = game.moment
        self.is_abandoned = False
        self._deciders = game.deciders
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
        """End the exploration at once, also if a clone computes. It goes on when it is started."""
        self.is_abandoned = True
        self._kill()
        self.wait()
        self._thread = None
        self.is_abandoned = False

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

    def _follow(
        self, twin: SimulationAECEnv, own: str = "", held: Iterable[Action] = ()
    ) -> Iterator[tuple[str, float, bool, Info]]:
        """Go on in a clone, by policies and the rule.

        Args:
            twin: The clone.
            own: An agent that first takes given actions.
            held: These actions, as JSON. Policies and the rule answer for illegal ones.

        Yields:
            Each agent that decides or has ended: its name, the reward of its previous decision,
            whether it has ended, and its info.
        """
        actions = iter(held)
        while twin.agents:
            agent = twin.agent_selection
            space = twin.action_space(agent)
            _, reward, terminated, truncated, info = twin.last(observe=False)
            ended = terminated or truncated
            yield agent, reward, ended, info
            if ended:
                twin.step(None)
                continue
            if agent == own and (action := next(actions, None)) is not None:
                with suppress(InvalidActionError):
                    twin.step(action_of(space, action))
                    continue
            twin.step(action_of(space, self._deciders.answer(twin, future=True)))


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
        length: The time or the number. None: the time of the first future's ``DECISIONS``
            decisions.
        hold: The number of the agent's decisions that a candidate answers, where it is legal. None:
            all of them.
    """

    by_time: bool = True
    length: float | None = None
    hold: int | None = 1

    def learn(self, span: float) -> None:
        """Take the time of a future, rounded down to one digit."""
        if self.by_time and self.length is None and span > 0:
            unit = 10.0 ** floor(log10(span))
            self.length = float(f"{floor(span / unit) * unit:.0e}")

    def is_reached(self, decisions: int, span: float) -> bool:
        """Return whether a future has gone as far."""
        if self.by_time and self.length is not None:
            return span >= self.length or decisions >= MOST_DECISIONS
        return decisions >= (self.length or DECISIONS)


class Futures(Exploration):
    """The candidates for a pending decision. All are tried out in the same futures.

    Attributes:
        pending: The pending decision as JSON.
        candidates: The candidates. The first one is the rule.
        measures: The places of the numbers in the situation.
        rule_action: The part of the message with the action of the rule, once it is known.
        note: A remark for the page.
    """

    def __init__(
        self,
        env: SimulationAECEnv,
        game: Game,
        pending: Message,
        horizon: Horizon,
    ) -> None:
        """Find the candidates and the measures.

        Args:
            env: The environment whose decision is pending.
            game: The game, with the policies of other agents.
            pending: The decision as JSON.
            horizon: How far the futures go, where the simulation has a time.
        """
        super().__init__(env, game)
        self.pending = pending
        self.note = ""
        has_time = pending["time"] is not None or not horizon.by_time
        self._horizon = horizon if has_time else Horizon(by_time=False, hold=horizon.hold)
        self._start: float = pending["time"] if self._horizon.by_time else 0.0
        self._seed = game.seed * 1_000_003 + pending["number"] * 1009
        self._space = env.action_space(pending["agent"])
        actions = [None, *candidates_of(self._space, pending["form"])]
        self.candidates = [Candidate(action, []) for action in actions]
        situation = pending["situation"]
        numbers = [place for place, entry in enumerate(situation) if entry["number"] is not None]
        self.measures = numbers[:MOST_MEASURES]
        self.rule_action: Message = {}

    def add(self, action: Action) -> None:
        """Add a legal candidate, as JSON, to futures that were abandoned."""
        actions = [candidate.action for candidate in self.candidates]
        if len(actions) < MOST_CANDIDATES and action not in actions:
            self.candidates.append(Candidate(action, []))

    def explore(self) -> Iterator[Message | None]:
        """Try out the candidates.

        Yields:
            None after each step of a simulation, and a message for the page after each round.
        """
        yield self.message(is_over=False)
        seeds = self._seeds()
        while not self.is_abandoned:
            behind = min(self.candidates, key=lambda candidate: len(candidate.courses))
            place = len(behind.courses)
            if place == len(seeds):
                yield self.message(is_over=True)
                return
            yield from self._play(behind, seeds[place])
            if behind is self.candidates[-1]:
                yield self.message(is_over=False)

    def _seeds(self) -> list[int] | list[None]:
        """Return the seeds of the futures; None for the future of the episode itself."""
        seeds = [(self._seed + place) % 2**31 for place in range(FUTURES)]
        try:
            clone(self.env, seed=seeds[0]).close()
        except Exception as error:
            self.note = f"There is one future, with foresight: {error}"
            return [None]
        return seeds

    def _play(self, candidate: Candidate, seed: int | None) -> Iterator[None]:
        """Play a future, and add its course to the candidate. Yield after each step."""
        own = self.pending["agent"]
        course: Course = [[self._start, 0.0, *self._numbers(self.pending["situation"])]]
        try:
            with self._twin(seed) as twin:
                twin.step(action_of(self._space, candidate.action))
                hold = self._horizon.hold or MOST_DECISIONS
                held = repeat(candidate.action, hold - 1)
                for agent, reward, ended, info in self._follow(twin, own, held):
                    time, total, *numbers = course[-1]
                    if agent == own:
                        time = info.get("time", time) if self._horizon.by_time else time + 1
                        if not (ended and self.pending["displayed"]):
                            numbers = self._numbers(self._situation(twin))
                        course.append([time, total + reward, *numbers])
                        if candidate.action is None and "rule_action" in info:
                            self._note_rule(info["rule_action"])
                    span = info.get("time", self._start) - self._start
                    # Up to an own decision, because the share of its interval counts by its time.
                    if agent == own and (ended or self._horizon.is_reached(len(course) - 1, span)):
                        break
                    yield
        except Exception as error:
            if not self.is_abandoned:
                self.note = f"A future has failed: {describe_error(error)[:300]}"
        if not self.is_abandoned:
            self._horizon.learn(course[-1][0] - self._start)
            candidate.courses.append(course)

    def _note_rule(self, action: Action) -> None:
        if not self.rule_action:
            rule = jsonable(action)
            self.rule_action = {"rule": rule, "rule_words": words_of(self.pending["form"], rule)}

    def _situation(self, twin: SimulationAECEnv) -> list[Message]:
        """Return the situation of the agent in a future, in which it may have ended."""
        if self.pending["displayed"]:
            entries: list[Message] = at_decision(twin, "play", situation_of)
            return entries
        return entries_of(labelled(twin.observe(self.pending["agent"])))

    def _numbers(self, situation: list[Message]) -> list[float | None]:
        numbers = {place: entry["number"] for place, entry in enumerate(situation)}
        return [numbers.get(place) for place in self.measures]

    def message(self, *, is_over: bool) -> Message:
        """Return the message for the page.

        Its ``bands`` have, for each measure, the lower end of the 80 % band, the median and the
        upper end, at points from now to the horizon.
        """
        by_time = self._horizon.by_time
        length = self._horizon.length or (None if by_time else DECISIONS)
        points = np.linspace(0, length or 0, POINTS + 1) + self._start
        candidates = []
        for action, courses in self.candidates:
            words = "" if action is None else words_of(self.pending["form"], action)
            sampled = [_sampled(course, points) for course in courses]
            bands: Any = []
            if sampled:
                quantiles = np.quantile(sampled, (0.1, 0.5, 0.9), axis=0)
                bands = quantiles.transpose(2, 0, 1).round(6)
            candidates.append({"action": action, "words": words, "n": len(courses), "bands": bands})
        labels = [self.pending["situation"][place]["label"] for place in self.measures]
        return {
            "type": "fan",
            "turn": self.pending["turn"],
            "moment": self.moment,
            "horizon": length,
            "by_time": by_time,
            "hold": self._horizon.hold,
            "measures": ["your points", *labels],
            "candidates": candidates,
            "done": is_over,
            "note": self.note,
            **self.rule_action,
        }


def _sampled(course: Course, points: Any) -> Any:
    """Return the returns and measures of a course at points. An ended course stays as it is."""
    rows = np.nan_to_num(np.array(course, float), nan=0.0, posinf=1e12, neginf=-1e12)
    return np.stack([np.interp(points, rows[:, 0], column) for column in rows.T[1:]], axis=1)


# -- the same episode by the rule -----------------------------------------------------------------


class Comparison(Exploration):
    """The game's episode as it goes if the rule decides for all people."""

    def __init__(
        self,
        env: SimulationAECEnv,
        game: Game,
        returns: dict[str, float],
    ) -> None:
        """Compare from the first decision of a person on.

        Args:
            env: The environment at that decision.
            game: The game, with the policies of other agents.
            returns: The returns until then.
        """
        super().__init__(env, game)
        self._returns = returns

    def explore(self) -> Iterator[Message | None]:
        """Play the episode to its end, and yield a message with the totals and their courses."""
        note = ""
        courses = {agent: [total] for agent, total in self._returns.items()}
        try:
            with self._twin(None) as twin:
                for place, (agent, reward, _, _) in enumerate(self._follow(twin)):
                    if place:
                        course = courses.setdefault(agent, [0.0])
                        course.append(course[-1] + reward)
                    yield None
        except Exception as error:
            note = f"The rule's game has failed: {describe_error(error)[:300]}"
        totals = {agent: course[-1] for agent, course in courses.items()}
        message = {"totals": totals, "courses": courses, "note": note}
        yield {"type": "rule", "moment": self.moment, **message}
