"""A pending decision, as policies get it that ask for ``_decision``, and as people and language models read it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from gymnasium import spaces

from .spaces import duplicate

if TYPE_CHECKING:
    from .agent import Agent
    from .episode import Episode

Texts = Mapping[Any, str] | Sequence[str] | None
"""Labels: for a ``Discrete`` or ``Dict`` a dict, for a space with one dimension a sequence, else None."""


@dataclass(frozen=True, eq=False)
class Decision:
    """A pending decision of an agent. Its values are copies: changing them changes nothing else.

    Attributes:
        agent: The name of the agent.
        point: The dotted name of the decision point.
        seed: The seed of the episode.
        number: The number of the decision among those of the agent in the episode, from 1.
        time: The simulation's time; None if it has none.
        observation: The agent's observation.
        action_space: The space of its actions.
        mask: The action mask; None if all actions are legal.
        choices: The answers that the actions stand for, where they arrive with the call; else None.
        action_labels: For a ``Discrete`` a dict from action to text, for a ``Dict`` a dict from key
            to text, for a space with one dimension a sequence of texts, for others None.
        observation_labels: The same for the parts of the observation.
        reward: The reward of the agent's previous action; 0.0 at its first decision.
        doc: The docstring of the model's function; None if it has none.
        in_clone: Whether the environment is a clone or a branch, in which policies count nothing.
        memory: A dict for what policies remember of this agent in this episode.
    """

    agent: str
    point: str
    seed: int
    number: int
    time: float | None
    observation: Any
    action_space: spaces.Space[Any]
    mask: Any
    choices: Sequence[Any] | None
    action_labels: Texts
    observation_labels: Texts
    reward: float
    doc: str | None
    in_clone: bool
    memory: dict[Any, Any] = field(repr=False)
    _agent: Agent = field(repr=False)

    def validate(self, action: Any) -> Any:
        """Return an action in the form that the model's mapping gets, or raise an ``InvalidActionError``."""
        return self._agent.point.validate(action, self.agent, self._agent.mask)

    def count_fallback(self) -> None:
        """Note that a fallback answers: evaluations count these for each agent and seed."""
        self._agent.fallbacks += 1


def decision_of(episode: Episode, agent: Agent) -> Decision:
    """Describe the decision of an agent that is pending, or is put to a policy."""
    point, choices = agent.point, agent.choices
    call = agent.arguments() or (), agent.kwargs
    return Decision(
        agent=agent.name,
        point=point.hook.name,
        seed=episode.seed,
        number=agent.answered + 1,
        time=agent.now,
        observation=duplicate(agent.observation),
        action_space=point.definition.action_space,
        mask=None if agent.mask is None else duplicate(agent.mask),
        choices=None if choices is None else list(choices),
        action_labels=point.action_labels(choices, *call),
        observation_labels=point.observation_labels(*call),
        reward=agent.reward,
        doc=point.hook.function.__doc__,
        in_clone=episode.where > 0,
        memory=agent.memory,
        _agent=agent,
    )
