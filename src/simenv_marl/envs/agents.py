"""The base class of the views with several agents, which are PettingZoo environments."""

from __future__ import annotations

import copy
from typing import Any

from gymnasium import spaces

from ..core.episode import Episode
from ..core.plan import Plan
from ..core.point import Point
from ..core.session import seed_space
from ..core.spaces import duplicate
from ..errors import UnknownAgentError, ViewError, did_you_mean, short_repr
from .base import View


class AgentsView(View):
    """A view with several agents. ``possible_agents`` exists only if all agents are known beforehand.

    Attributes:
        agents: The names of the current agents.
    """

    agents: list[str]

    def __init__(self, plan: Plan) -> None:
        """Make the view of a plan: see ``View``."""
        super().__init__(plan)
        if plan.possible_agents is not None:
            self.possible_agents = plan.possible_agents
        self._spaces: dict[str, tuple[spaces.Space[Any], spaces.Space[Any]]] = {}

    @classmethod
    def check(cls, plan: Plan) -> None:
        """Check that a plan allows this view: see ``View``."""
        super().check(plan)
        if isinstance(plan.options.state_space, str) and plan.possible_agents is None:
            raise ViewError(
                'state_space="observations" needs to know all agents beforehand: declare them in possible_agents='
            )

    @classmethod
    def metadata_of(cls, plan: Plan) -> dict[str, Any]:
        """Return the metadata of a plan's environments. The order of agents is an order of rounds only in rounds."""
        return super().metadata_of(plan) | {"is_parallelizable": cls.in_rounds}

    def _start(self, seed: int | None, options: dict[str, Any] | None) -> Episode:
        """End the current episode, begin another, and seed the agents' spaces."""
        episode = super()._start(seed, options)
        if not self._plan.complete:  # the agents of the last episode may never appear again
            self._spaces = {}
        elif seed is not None:
            for agent in self._spaces:
                self._seed_spaces(agent)
        return episode

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """The observation space of an agent. It is always the same object, and no other environment shares it.

        Raises:
            UnknownAgentError: There is no such agent.
        """
        return (self._spaces.get(agent) or self._make_spaces(agent))[0]

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """The action space of an agent. It is always the same object, and no other environment shares it.

        Raises:
            UnknownAgentError: There is no such agent.
        """
        return (self._spaces.get(agent) or self._make_spaces(agent))[1]

    @property
    def observation_spaces(self) -> dict[str, spaces.Space[Any]]:
        """The observation spaces of all possible agents, by name, for learners that read all at once.

        Raises:
            AttributeError: Not all agents are known beforehand, and so there is no ``possible_agents`` either.
        """
        return {agent: self.observation_space(agent) for agent in self.possible_agents}

    @property
    def action_spaces(self) -> dict[str, spaces.Space[Any]]:
        """The action spaces of all possible agents, as ``observation_spaces`` has the observation spaces."""
        return {agent: self.action_space(agent) for agent in self.possible_agents}

    def _make_spaces(self, agent: str) -> tuple[spaces.Space[Any], spaces.Space[Any]]:
        definition = self._point(agent).definition
        made = self._spaces[agent] = copy.deepcopy((definition.observation_space, definition.action_space))
        if self._session.seed is not None:
            self._seed_spaces(agent)
        return made

    def _seed_spaces(self, agent: str) -> None:
        seed: Any = self._session.seed
        for space in self._spaces[agent]:
            seed_space(space, seed, agent)

    def _point(self, agent: str) -> Point:
        """The decision point of an agent; raise ``UnknownAgentError`` if there is no such agent."""
        point = self._plan.roster.get(agent)
        if point is not None:
            return point
        episode = self._session.episode
        found = None if episode is None else episode.agent(agent)
        if found is None:
            raise UnknownAgentError(
                f"there is no agent {short_repr(agent)}; the agents now are {self.agents[:10]}"
                f"{did_you_mean(agent, self.agents)}"
            )
        return found.point

    def _observation(self, episode: Episode, agent: str) -> Any:
        """A copy of the latest observation of an agent."""
        found = episode.agent(agent)
        if found is None or found.observation is None:
            return self._point(agent).blank()
        return duplicate(found.observation)

    def _all_observation_spaces(self) -> list[spaces.Space[Any]]:
        return list(self.observation_spaces.values())

    def _all_observations(self, episode: Episode) -> tuple[Any, ...]:
        return tuple(self._observation(episode, agent) for agent in self.possible_agents)
