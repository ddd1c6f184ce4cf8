"""The AEC view: agents are selected in the order in which the simulation calls their decision functions."""

from __future__ import annotations

import copy
import weakref
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from pettingzoo import AECEnv

from .._episode import Episode
from .._plan import Plan
from .._record import Record
from .._session import Session, checked_seed, seed_space
from .._spaces import blank, duplicate
from ..errors import InvalidActionError, UnknownAgentError
from ..simulation import RULE


class SimulationAECEnv(AECEnv[str, Any, Any]):
    """A simulation as a PettingZoo AEC environment. Made by ``aec_env`` and ``generate_env``.

    ``possible_agents`` exists only where all agents are known beforehand. Every step takes the same time,
    however many agents there are: PettingZoo's helpers for rewards and dead steps, which pass over all
    agents, are not used.

    Attributes:
        agents: The agents that have not yet taken leave of the episode.
        agent_selection: The agent whose decision is pending; once the episode has ended, the one that is
            to take its ``None`` step.
        rewards: The rewards that the latest step has brought, python floats.
        terminations, truncations: By agent, python bools.
        infos: By agent, the info of its latest decision. ``infos[agent]["action_mask"]``, np.int8, is there
            where the decision point restricts its actions.
    """

    render_mode: str | None

    def __init__(self, plan: Plan) -> None:
        """Make the environment of a plan.

        Raises:
            SimEnvError: Something in the plan cannot work.
        """
        super().__init__()
        self._plan = plan
        self._session = Session(plan)
        weakref.finalize(self, self._session.abandon)
        self.metadata = self.metadata_of(plan)
        self.render_mode = plan.options.render_mode
        if plan.possible_agents is not None:
            self.possible_agents = list(plan.possible_agents)
        self._episode: Episode | None
        self._by_agent = {binding.agent: binding for binding in plan.active}
        self._np_random: np.random.Generator | None = None
        self._observation_spaces: dict[str, spaces.Space[Any]] = {}
        self._action_spaces: dict[str, spaces.Space[Any]] = {}
        self._clear()

    @staticmethod
    def check(plan: Plan) -> None:
        """Make sure that a plan allows this view; every plan does."""

    @staticmethod
    def metadata_of(plan: Plan) -> dict[str, Any]:
        """What the environments of a plan say about themselves."""
        return {"name": f"{plan.name.lower()}_v0", "render_modes": plan.render_modes}

    @property
    def simulation(self) -> Any:
        """The simulation that this environment runs."""
        return self._session.simulation

    # -- episodes ---------------------------------------------------------------------------------

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """Reset the simulation and run it to its first decision.

        Args:
            seed: Seeds the environment's generator and the agents' spaces, and is what the simulation's
                ``reset`` gets. None: the simulation gets a seed drawn from the generator.
            options: Handed to the simulation's ``reset``, where that takes them.

        Raises:
            NoDecisionError: The simulation ended without a decision.
            BaseException: Whatever the model, a mapping or a policy raises.
        """
        seed = checked_seed(seed)
        if seed is not None or self._np_random is None:
            self._np_random, _ = seeding.np_random(seed)
        self._clear()
        self._episode = episode = self._session.start(seed, options, self._np_random)
        if self._plan.possible_agents is None:  # names that may never come again
            self._observation_spaces, self._action_spaces = {}, {}
        elif seed is not None:
            for agent in self._action_spaces:
                self._seed_spaces(agent, seed)
        for agent in episode.agents:
            self._join(agent)
        assert episode.pending is not None
        self._select(episode.pending)

    def step(self, action: Any) -> None:
        """Answer the decision of ``agent_selection`` and run to the next one.

        Args:
            action: In the agent's action space, or ``RULE``; None for an agent whose episode has ended.

        Raises:
            InvalidActionError: The action is not legal. The environment stands where it stood.
            ResetNeededError: There is no episode to go on with.
            BaseException: Whatever the model, a mapping or a policy raises.
        """
        episode = self._episode
        if episode is None:
            raise self._session.not_running()
        if episode.over:
            self._take_leave(episode, action)
            return
        agent = self.agent_selection
        try:
            episode.turn(action)
        except BaseException:
            if episode.over:  # an error has ended it
                self._clear()
                self._episode = episode
            raise
        # The selected agent is the only one that the latest step has rewarded.
        self.rewards[agent] = self._cumulative_rewards[agent] = 0.0
        record = episode.pending
        if record is None:
            self._end(episode)
        else:
            self._select(record)

    def last(self, observe: bool = True) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """What ``agent_selection`` needs to decide.

        Args:
            observe: Whether to return the observation, or None in its place.

        Returns:
            Its observation, its rewards since its last step, terminated, truncated, info.

        Raises:
            ResetNeededError: There is no episode, or all agents have taken leave of it.
        """
        episode = self._episode
        if episode is None:
            raise self._session.not_running()
        agent = self.agent_selection
        if agent not in self.rewards:
            raise episode.nothing_pending()
        observation = None
        if observe:
            observation = episode.agents[agent].observation
            observation = observation.copy() if type(observation) is np.ndarray else self.observe(agent)
        return (
            observation,
            self._cumulative_rewards[agent],
            self.terminations[agent],
            self.truncations[agent],
            self.infos[agent],
        )

    def observe(self, agent: str) -> Any:
        """The latest observation of an agent, as a copy of the caller's own.

        Args:
            agent: An agent of this episode.

        Raises:
            UnknownAgentError: There is no such agent.
            ResetNeededError: There is no episode.
        """
        if self._episode is None:
            raise self._session.not_running()
        record = self._episode.agents.get(agent)
        if record is None:
            raise self._unknown(agent)
        if record.observation is None:
            return blank(record.binding.definition.observation_space)
        return duplicate(record.observation)

    def render(self) -> Any:
        """Render the simulation in ``render_mode``."""
        return self._session.render()

    def close(self) -> None:
        """End the episode and unwind the simulation; a later ``reset`` begins anew.

        Raises:
            BaseException: What the simulation raises while it unwinds.
        """
        self._clear()
        self._session.close()

    # -- spaces -----------------------------------------------------------------------------------

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """The observation space of an agent: of this environment alone, and always the same object.

        Raises:
            UnknownAgentError: There is no such agent.
        """
        space = self._observation_spaces.get(agent)
        return space if space is not None else self._make_spaces(agent)[0]

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """The action space of an agent: of this environment alone, and always the same object.

        Raises:
            UnknownAgentError: There is no such agent.
        """
        space = self._action_spaces.get(agent)
        return space if space is not None else self._make_spaces(agent)[1]

    def _make_spaces(self, agent: str) -> tuple[spaces.Space[Any], spaces.Space[Any]]:
        binding = self._by_agent.get(agent)
        if binding is None:
            if self._episode is None or agent not in self._episode.agents:
                raise self._unknown(agent)
            binding = self._episode.agents[agent].binding
        made = copy.deepcopy((binding.definition.observation_space, binding.definition.action_space))
        self._observation_spaces[agent], self._action_spaces[agent] = made
        if self._session.seed is not None:
            self._seed_spaces(agent, self._session.seed)
        return made

    def _seed_spaces(self, agent: str, seed: int) -> None:
        seed_space(self._observation_spaces[agent], seed, agent)
        seed_space(self._action_spaces[agent], seed, agent)

    def _unknown(self, agent: Any) -> UnknownAgentError:
        return UnknownAgentError(f"there is no agent {agent!r}; the agents now are {self.agents}")

    # -- PettingZoo's books -----------------------------------------------------------------------

    def _clear(self) -> None:
        self._episode = None
        self.agents: list[str] = []
        self.rewards: dict[str, float] = {}
        self._cumulative_rewards: dict[str, float] = {}
        self.terminations: dict[str, bool] = {}
        self.truncations: dict[str, bool] = {}
        self.infos: dict[str, dict[str, Any]] = {}
        self._rewards_are_old = False

    def _join(self, agent: str) -> None:
        self.agents.append(agent)
        self.rewards[agent] = self._cumulative_rewards[agent] = 0.0
        self.terminations[agent] = self.truncations[agent] = False
        self.infos[agent] = {}

    def _select(self, record: Record) -> None:
        """Enter a decision that has arisen."""
        agent, reward = record.agent, record.reward
        try:
            self._cumulative_rewards[agent] += reward
        except KeyError:
            self._join(agent)
        self.rewards[agent] = reward
        self.infos[agent] = record.info
        self.agent_selection = agent

    def _end(self, episode: Episode) -> None:
        """Enter the end of the episode: last rewards, flags, and the agents' leave."""
        for agent, record in episode.agents.items():
            if agent not in self.rewards:
                self._join(agent)
            self.rewards[agent] = record.reward
            self._cumulative_rewards[agent] += record.reward
            self.terminations[agent], self.truncations[agent] = episode.terminated, episode.truncated
            self.infos[agent] = record.info
        # Leave is taken from the list's end, where that costs the same for any number of agents; those
        # that have never decided come last.
        self.agents.sort(key=lambda agent: episode.agents[agent].decided)
        self.agent_selection = self.agents[-1]
        self._rewards_are_old = False

    def _take_leave(self, episode: Episode, action: Any) -> None:
        """The step of an agent whose episode has ended."""
        if not self.agents:
            raise episode.nothing_pending()
        if action is not None and action is not RULE:
            raise InvalidActionError(
                f"the episode of {self.agent_selection!r} has ended: its only legal action is None, not {action!r}"
            )
        agent = self.agents.pop()
        for book in (self.rewards, self._cumulative_rewards, self.terminations, self.truncations, self.infos):
            del book[agent]
        if not self._rewards_are_old:
            self.rewards = dict.fromkeys(self.agents, 0.0)
            self._rewards_are_old = True
        if self.agents:
            self.agent_selection = self.agents[-1]
