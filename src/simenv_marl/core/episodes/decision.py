"""A pending decision, as people, language models and other policies read it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

from ...errors import NoDecisionError
from ...simulation import Action, Model, Observation
from ..plans.point import Labels, Space
from ..values.actions import Mask


class DecidingAgent(Protocol):
    """The agent of a decision."""

    answered: int
    """The number of its decisions that were answered."""

    def validate(self, action: Action) -> Action:
        """Validate an action."""

    def count(self, **numbers: float) -> None:
        """Add numbers to its counts."""


@dataclass(frozen=True, eq=False)
class Decision:
    """The ``Decision`` that a policy with a parameter ``_decision`` receives.

    Its values are copies: changing them changes nothing else.

    Attributes:
        agent: The name of the agent.
        point: The dotted name of the decision point.
        seed: The seed of the episode.
        number: The number of the agent's decision in the episode, from 1.
        time: The simulation's time. None if it has none.
        observation: The agent's observation.
        action_space: The space of its actions.
        mask: The action mask. None if all actions are legal.
        choices: The values that ``choices=`` returned for this call, indexed by action. None
            without ``choices=``.
        action_labels: For a ``Discrete`` a dict from action to text, for a ``Dict`` a dict from key
            to text, for a space with one dimension a sequence of texts, for others None.
        observation_labels: The same for the parts of the observation.
        reward: The reward of the agent's previous action; 0.0 at its first decision.
        doc: The docstring of the model's function. None if it has none.
        question: The question that the decision answers; "" without ``question=`` and docstring.
        in_clone: Whether the environment is a clone or a branch, where policies count nothing.
        memory: A dict where policies remember values of this agent in this episode.
    """

    agent: str
    point: str
    seed: int
    number: int
    time: float | None
    observation: Observation
    action_space: Space
    mask: Mask | None
    choices: Sequence[Model] | None
    action_labels: Labels
    observation_labels: Labels
    reward: float
    doc: str | None
    question: str
    in_clone: bool
    memory: dict[Any, Any] = field(repr=False)
    _agent: DecidingAgent = field(repr=False)
    _display: Callable[[], dict[str, float | str] | None] = field(repr=False)

    @cached_property
    def display(self) -> dict[str, float | str] | None:
        """The result of ``display_mapping=``, called at the first use. None without a mapping.

        Raises:
            NoDecisionError: The decision was answered before the first use.
        """
        if self._agent.answered >= self.number:
            raise NoDecisionError(
                f"decision {self.number} of {self.agent!r} was answered; read its display before"
            )
        return self._display()

    def validate(self, action: Action) -> Action:
        """Validate an action; return it as ``action_space_mapping`` receives it.

        Raises:
            InvalidActionError: The action is not legal.
        """
        return self._agent.validate(action)

    def count(self, **numbers: float) -> None:
        """Add numbers to the counts of its agent, which ``Evaluation.seats`` shows by name."""
        self._agent.count(**numbers)
