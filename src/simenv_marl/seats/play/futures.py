"""The futures of a pending decision: clones that try out its candidates."""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from ... import RULE, clone
from ...envs import SimulationAECEnv
from ...errors import describe_error
from ...simulation import Action, Observation
from .forms import (
    MOST_CANDIDATES,
    Message,
    action_of,
    candidates_of,
    entries_of,
    jsonable,
)

FUTURES: Final = 16
"""The number of futures that try out each candidate."""

MOST_MEASURES: Final = 12
"""The largest number of observed numbers that are shown."""

TIME_LIMIT: Final = 30.0
"""The time limit of each operation in a future, in seconds."""

Course = list[list[float]]
"""A row for each decision of the agent in a future: its return since now, and its measures."""


class Candidate(NamedTuple):
    """An action to try out, as JSON, and its courses."""

    action: Action
    courses: list[Course]


@dataclass
class Futures:
    """The candidates for a pending decision. All are tried out in the same futures.

    Attributes:
        env: The environment whose decision is pending.
        pending: The pending decision as JSON.
        turn: The number of the decision in the game.
        horizon: The number of the agent's decisions in each future.
        seed: The seed of the game.
        candidates: The candidates. The first one is the rule.
        measures: The names of the numbers in the observation, by their places in its entries.
        rule_action: The part of the message with the action of the rule, once it is known.
        note: A remark for the page.
    """

    env: SimulationAECEnv
    pending: Message
    turn: int
    horizon: int
    seed: int
    note: str = ""

    def __post_init__(self) -> None:
        """Find the candidates and the measures."""
        self.agent: str = self.pending["agent"]
        self.space = self.env.action_space(self.agent)
        actions = [None, *candidates_of(self.space, self.pending["mask"])]
        self.candidates = [Candidate(action, []) for action in actions]
        self.measures: dict[int, str] = {}
        for place, (name, value) in enumerate(self.pending["observation"]):
            is_number = type(value) in (int, float)  # not a bool
            if is_number and len(self.measures) < MOST_MEASURES:
                self.measures[place] = name
        self.rule_action: Message = {}

    def add(self, action: Action) -> None:
        """Add a candidate, as JSON.

        Raises:
            InvalidActionError: The action is not legal.
        """
        with closing(clone(self.env)) as twin:
            twin.step(action_of(self.space, action))
        actions = [candidate.action for candidate in self.candidates]
        if len(actions) < MOST_CANDIDATES and action not in actions:
            self.candidates.append(Candidate(action, []))

    def explore(self) -> Iterator[Message | None]:
        """Try out the candidates.

        Yields:
            None after each step of a simulation, and a message for the page after each future.
        """
        for place, seed in enumerate(self._seeds()):
            for candidate in self.candidates:
                if len(candidate.courses) == place:
                    yield from self._play(candidate, seed)
            yield self.message()

    def _seeds(self) -> list[int] | list[None]:
        """Return the seeds of the futures; None for the future of the episode itself."""
        first = self.seed * 1_000_003 + self.turn * 1009
        seeds = [(first + place) % 2**31 for place in range(FUTURES)]
        try:
            clone(self.env, seed=seeds[0]).close()
        except Exception as error:
            self.note = f"There is one future, with foresight: {error}"
            return [None]
        return seeds

    def _play(self, candidate: Candidate, seed: int | None) -> Iterator[None]:
        """Play a future, and add its course to the candidate. Yield after each step."""
        course: Course = []
        try:
            with closing(clone(self.env, seed=seed, time_limit=TIME_LIMIT)) as twin:
                action = candidate.action
                twin.step(action_of(self.space, action))
                while twin.agents:
                    is_agent = twin.agent_selection == self.agent
                    observation, reward, terminated, truncated, info = twin.last(observe=is_agent)
                    ended = terminated or truncated
                    if is_agent:
                        total = course[-1][0] if course else 0.0
                        course.append(self._row(total + reward, observation))
                        if action is None and "rule_action" in info:
                            self.rule_action.setdefault("rule", jsonable(info["rule_action"]))
                        if ended or len(course) == self.horizon:
                            break
                    yield
                    twin.step(None if ended else RULE)
        except Exception as error:
            self.note = f"A future has failed: {describe_error(error)[:300]}"
        if not course:
            observation = self.env.observe(self.agent)
            course = [self._row(0.0, observation)]
        candidate.courses.append(course)

    def _row(self, total: float, observation: Observation) -> list[float]:
        values = [value for _, value in entries_of(observation)]
        return [total, *(float(values[place]) for place in self.measures)]

    def message(self) -> Message:
        """Return the message for the page.

        Its ``bands`` have, for each measure, the lower end of the 80 % band, the median and the
        upper end after each decision.
        """
        candidates = []
        for action, courses in self.candidates:
            bands = []
            if courses:
                # An ended course stays where it is.
                rows = [course + course[-1:] * (self.horizon - len(course)) for course in courses]
                numbers = np.nan_to_num(rows)
                quantiles = np.quantile(numbers, (0.1, 0.5, 0.9), axis=0)
                bands = quantiles.transpose(2, 0, 1).round(6).tolist()
            candidates.append({"action": action, "n": len(courses), "bands": bands})
        return {
            "type": "fan",
            "turn": self.turn,
            "horizon": self.horizon,
            "measures": ["return", *self.measures.values()],
            "candidates": candidates,
            "note": self.note,
            **self.rule_action,
        }
