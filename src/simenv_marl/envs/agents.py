"""The parts that the views of several agents share, with several learners or with one."""

from collections.abc import Callable
from functools import cached_property
from typing import Any

from ..core import EpisodeState, Info, Plan, Space
from ..errors import ViewError
from .base import OneAgentView, View


def refuse_unknown_agents(plan: Plan) -> None:
    """Raise a ``ViewError`` if observations are the state, and not all agents are known."""
    if isinstance(plan.options.state_space, str) and not plan.complete:
        raise ViewError(
            'state_space="observations" needs to know all agents beforehand: declare them in'
            " possible_agents="
        )


class AgentsView(View):
    """A view with several agents: a PettingZoo environment.

    Attributes:
        agents: The names of the current agents.
    """

    agents: list[str]

    @classmethod
    def adapt(cls, plan: Plan) -> Plan:
        """Check that a plan allows this view."""
        refuse_unknown_agents(plan)
        return super().adapt(plan)

    @classmethod
    def metadata_of(cls, plan: Plan) -> dict[str, Any]:
        """Return the metadata of a plan's environments.

        The order of agents is an order of rounds only in rounds.
        """
        return super().metadata_of(plan) | {"is_parallelizable": cls.in_rounds}

    @cached_property
    def possible_agents(self) -> list[str]:
        """The names of all agents. It exists only if they are known beforehand."""
        names = self.session.plan.possible_agents
        if names is None:
            raise AttributeError(
                "there is no possible_agents, because not all agents are known beforehand; declare"
                " them with the option possible_agents=, or name them by strings"
            )
        return names

    def observation_space(self, agent: str) -> Space:
        """Return the observation space of an agent.

        It is always the same object, and no other environment shares it.

        Raises:
            UnknownAgentError: There is no such agent.
        """
        return self._spaces_of(agent)[0]

    def action_space(self, agent: str) -> Space:
        """Return the action space of an agent, as ``observation_space`` returns the other one."""
        return self._spaces_of(agent)[1]

    @property
    def observation_spaces(self) -> dict[str, Space]:
        """The observation spaces of all possible agents, for learners that read all at once.

        Raises:
            AttributeError: Not all agents are known beforehand, so that there is no
                ``possible_agents`` either.
        """
        return {agent: self.observation_space(agent) for agent in self.possible_agents}

    @property
    def action_spaces(self) -> dict[str, Space]:
        """The action spaces of all possible agents. For errors, see ``observation_spaces``."""
        return {agent: self.action_space(agent) for agent in self.possible_agents}


class UnitedView(OneAgentView):
    """A view with one learner for all agents, which have united spaces."""

    _own_options = ("flatten", "state_in_info")
    _last_time: float | None = None  # the time of the previous reset or step
    _unite: Callable[[Plan], Any]  # returns an object with both spaces

    @classmethod
    def spaces_of(cls, plan: Plan) -> tuple[Space, Space]:
        """Return the united spaces of a plan's agents."""
        united = plan.derive(cls._unite)
        return united.observation_space, united.action_space

    def _original_spaces(self, agent: str) -> tuple[Space, Space]:
        return self.spaces_of(self.session.plan)

    def _add_to(self, info: Info, episode: EpisodeState) -> None:
        """Add the time since the last step, and the state, to an info."""
        if episode.clock is not None:
            info |= episode.clock.read(self._last_time)
            self._last_time = info["time"]
        if episode.plan.options.state_in_info:
            info["state"] = self.state()
