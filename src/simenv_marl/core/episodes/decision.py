"""A pending decision, as people, language models and other policies read it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from ...simulation import Action, Model, Observation
from ..plans.point import Labels, Space
from ..values.actions import Mask


class DecidingAgent(Protocol):
    """The agent of a decision."""

    def validate(self, action: Action) -> Action:
        """Validate an action."""

    def count_fallback(self) -> None:
        """Count an answer of a fallback."""


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
    in_clone: bool
    memory: dict[Any, Any] = field(repr=False)
    _agent: DecidingAgent = field(repr=False)

    def validate(self, action: Action) -> Action:
        """Validate an action; return it as ``action_space_mapping`` receives it.

        Raises:
            InvalidActionError: The action is not legal.
        """
        return self._agent.validate(action)

    def count_fallback(self) -> None:
        """Count an answer of a fallback. Evaluations show the number for each agent and seed."""
        self._agent.count_fallback()
