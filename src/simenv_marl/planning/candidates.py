"""Candidates for a pending decision: actions, policies and ``RULE``, and how long they decide."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, TypeAlias

from ..core import Policy
from ..errors import OptionValueError, short_repr
from ..simulation import EVERYONE, RULE, Action


@dataclass(frozen=True, eq=False)
class First:
    """A candidate of ``first``.

    Attributes:
        action: The action at its first decision.
        then: The policy that decides from then on.
    """

    action: Action
    then: Policy


Candidate: TypeAlias = Action
"""An action, a policy, ``RULE``, or one of ``first``."""


def first(action: Action, then: Policy) -> First:
    """Make a candidate that takes an action, and then goes on by a policy to the horizon.

    Args:
        action: The action, or ``RULE``.
        then: The policy from the next decision on, or ``RULE``.

    Raises:
        OptionValueError: ``then`` is no policy.
    """
    if not is_policy(then):
        raise OptionValueError(f"then must be a policy or RULE, not {short_repr(then)}")
    return First(action, then)


def is_policy(candidate: object) -> bool:
    """Return whether a candidate is a policy, those of ``turn_policy``, or ``RULE``."""
    is_deployed = isinstance(candidate, Mapping) and EVERYONE in candidate
    return candidate is RULE or callable(candidate) or is_deployed


Metric: TypeAlias = Callable[[Any], float]
"""Returns how well a simulation stands. Larger is better."""


@dataclass(kw_only=True, eq=False, repr=False)
class Task:
    """How long candidates decide, and what their rollouts measure: see ``RolloutPolicy``."""

    base: Policy = RULE
    hold: float | None = 1
    hold_by: str = "decision"
    every: int = 1
    horizon: float | None = None
    horizon_by: str = "decision"
    terminal_value: Callable[[Any], float] | None = None
    metric: Metric | None = None
    discount: float = 1.0
    discount_by: str = "decision"

    def __repr__(self) -> str:
        """Name the class, and the arguments that are not the defaults."""
        given = [
            f"{each.name}={short_repr(getattr(self, each.name))}"
            for each in fields(self)
            if getattr(self, each.name) is not each.default
        ]
        return f"{type(self).__name__}({', '.join(given)})"


@dataclass(frozen=True, eq=False)
class Course:
    """A candidate, and for how long it has decided before.

    Attributes:
        candidate: The candidate.
        decisions: The number of decisions that it has answered.
        time: The simulation's time since the first of them.
    """

    candidate: Candidate
    decisions: int = 0
    time: float = 0.0

    def goes_on(self, task: Task, decisions: int, time: float) -> bool:
        """Return whether it still decides, some more decisions and some time later."""
        if task.hold is None or isinstance(self.candidate, First):
            return True
        held: dict[str, float] = {
            "decision": self.decisions + decisions,
            "time": self.time + time,
        }
        # A new one is held as ``hold`` says. ``every`` counts the decisions of the user's episode.
        is_due = self.decisions > 0 and held["decision"] < task.every
        return is_due or held[task.hold_by] < task.hold

    def part(self, decisions: int) -> Candidate:
        """Return its part for a later decision: an action, a policy or ``RULE``."""
        candidate = self.candidate
        if not isinstance(candidate, First):
            return candidate
        return candidate.then if self.decisions + decisions else candidate.action


@dataclass(frozen=True, eq=False)
class Choice:
    """The latest choice of a planner for an agent of an episode.

    Attributes:
        candidate: The candidate.
        start: The simulation's time at its first decision.
        number: The number of the agent's decisions before the latest one.
        decisions: The number of decisions that it has answered.
        age: The number of decisions since the planner has chosen it, perhaps anew.
    """

    candidate: Candidate
    start: float
    number: int
    decisions: int = 0
    age: int = 0

    def at(self, number: int) -> Choice:
        """Return the choice at a decision, which is the same one or the next one."""
        if number == self.number:
            return self
        decisions, age = self.decisions + 1, self.age + 1
        return replace(self, number=number, decisions=decisions, age=age)

    @property
    def part(self) -> Candidate:
        """Its part for the latest decision."""
        return Course(self.candidate, self.decisions).part(0)

    def resume(self, task: Task, time: float) -> Course:
        """Return the candidate as it goes on at a time, or anew where nothing of it is left."""
        course = Course(self.candidate, self.decisions, time - self.start)
        is_endless = task.hold is None and not isinstance(self.candidate, First)
        if self.candidate is RULE or is_endless or not course.goes_on(task, 0, 0.0):
            return Course(self.candidate)
        return course


Propose = Callable[..., Any]
"""Returns candidates for an observation, and perhaps an info."""
