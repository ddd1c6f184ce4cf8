"""The parts that views share: those with one agent, with several, and with one learner for all."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from typing import Any, Self

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ..core import Action, Agent, EpisodeState, Info, Mask, Observation, Plan, Space
from ..errors import ViewError
from .base import ResetOptions, StepResult, View


def refuse_unknown_agents(plan: Plan) -> None:
    """Raise a ``ViewError`` if observations are the state, and not all agents are known."""
    if isinstance(plan.options.state_space, str) and not plan.complete:
        raise ViewError(
            'state_space="observations" needs to know all agents beforehand: declare them in'
            " possible_agents="
        )


def add_costs(info: Info, agents: Iterable[Agent]) -> None:
    """Add the sum of the costs of agents to an info, if they have any."""
    costs = [agent.cost for agent in agents if agent.cost is not None]
    if costs:
        info["cost"] = sum(costs)


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


class OneAgentView(View, gym.Env[Any, Any]):
    """A view with one agent: a Gymnasium environment.

    Attributes:
        own_agent: The agent that decides, during an episode. The joint view has none.
    """

    own_agent: Agent
    _agent_name: str
    # Gymnasium's checks look here.
    _np_random = View.np_random
    _np_random_seed = View.np_random_seed

    @cached_property
    def observation_space(self) -> Space:  # type: ignore[override]
        """The observation space. No other environment shares it."""
        return self._spaces_of(self._agent_name)[0]

    @cached_property
    def action_space(self) -> Space:  # type: ignore[override]
        """The action space. No other environment shares it."""
        return self._spaces_of(self._agent_name)[1]

    @classmethod
    def spaces_of(cls, plan: Plan) -> tuple[Space, Space]:
        """Return the observation space and the action space of an adapted plan."""
        raise NotImplementedError

    def begin(self, episode: EpisodeState) -> tuple[Observation, Info]:
        """Prepare for a new episode; return the results of its reset."""
        raise NotImplementedError

    def read(self, episode: EpisodeState) -> StepResult:
        """Return the results of a step."""
        raise NotImplementedError

    @classmethod
    def read_all(cls, views: Sequence[Self]) -> tuple[list[Observation], list[float], list[Info]]:
        """Return the observations, rewards and infos of the latest step of several views."""
        results = [view.read(view.episode) for view in views]
        observations, rewards, _, _, infos = map(list, zip(*results, strict=True))
        return observations, rewards, infos

    def validate(self, action: Action) -> Action:
        """Validate an action for the pending decision, before the simulation moves."""
        raise NotImplementedError

    def read_end(self, episode: EpisodeState) -> tuple[bool, bool]:
        """Return how an episode has ended: whether terminated, whether truncated."""
        return episode.terminated, episode.truncated

    def _clear(self) -> None:
        super()._clear()
        if hasattr(self, "own_agent"):
            del self.own_agent  # because it holds arguments of the model

    def reset(
        self,
        *,
        seed: int | None = None,
        options: ResetOptions = None,
    ) -> tuple[Observation, Info]:
        """Reset the simulation and run it to its first decision.

        For the arguments and errors, see ``SimulationAECEnv.reset``.

        Returns:
            The observation and the info.
        """
        return self._start(seed, options, self.begin)

    def masks(self) -> list[Mask]:
        """Return the masks of the actions that are legal now, one for each agent."""
        return [
            agent.point.open_mask() if agent.mask is None else agent.mask
            for agent in self.known_agents()
        ]

    def action_masks(self) -> NDArray[np.bool_]:
        """Return the mask of the legal actions, as ``MaskablePPO`` of sb3-contrib expects it.

        Returns:
            A bool array. For a ``Discrete`` it has shape ``(n,)``. For a ``MultiDiscrete`` it is
            the concatenation of the masks of the parts. If the decision point does not restrict its
            actions, all entries are True.

        Raises:
            ViewError: The action space is neither ``Discrete`` nor ``MultiDiscrete``, and so has no
                masks.
            ResetNeededError: There is no episode.
        """
        if not isinstance(self.action_space, (spaces.Discrete, spaces.MultiDiscrete)):
            raise ViewError(
                "action masks need a Discrete or MultiDiscrete action space, not"
                f" {self.action_space}; a joint environment of discrete actions has a"
                " MultiDiscrete with flatten=True"
            )
        parts: list[Any] = []
        for mask in self.masks():
            parts += mask if isinstance(mask, tuple) else (mask,)
        return np.concatenate(parts).astype(np.bool_)


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

    def _move(self, episode: EpisodeState, answer: Action) -> StepResult:
        """Take a step with the agents' own actions; return its results."""
        episode.step(answer)
        if self._shows:
            self.show_step()
        self._latest = results = self.read(episode)
        return results

    def repeat(self, answer: Action) -> None:
        """Take a step with an answer of the tape."""
        with self.session.exclusive:
            self._move(self.episode, answer)

    def _add_to(self, info: Info, episode: EpisodeState) -> None:
        """Add the time since the last step, and the state, to an info."""
        if episode.clock is not None:
            info |= episode.clock.read(self._last_time)
            self._last_time = info["time"]
        if episode.plan.options.state_in_info:
            info["state"] = self.state()
