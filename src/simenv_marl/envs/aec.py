"""The AEC view: agents are selected in the order in which the simulation calls their decision functions."""

from __future__ import annotations

from typing import Any

import numpy as np
from pettingzoo import AECEnv

from ..core.agent import Record
from ..core.episode import Episode
from ..core.plan import Plan
from ..errors import InvalidActionError
from ..simulation import RULE
from .base import AgentsView


class SimulationAECEnv(AgentsView, AECEnv[str, Any, Any]):
    """A simulation as a PettingZoo AEC environment. Made by ``aec_env`` and ``generate_env``.

    ``possible_agents`` exists only where all agents are known beforehand. Every step takes the same time,
    however many agents there are: PettingZoo's helpers for rewards and dead steps, which pass over all
    agents, are not used.

    With ``padded=True`` all of ``possible_agents`` are there until the episode ends, whether they are ``"present"``, as
    their infos then tell, or not; those who are not are never selected before.

    Attributes:
        agents: The agents that have not yet taken leave of the episode.
        agent_selection: The agent whose decision is pending; where agents have ended, the one that is to take
            its ``None`` step.
        rewards: The rewards that the latest step has brought, python floats.
        terminations, truncations: By agent, python bools.
        infos: By agent, the info of its latest decision. ``infos[agent]["action_mask"]``, np.int8, is there
            where the decision point restricts its actions; ``"time"`` and ``"elapsed"`` where the simulation
            has a clock. The keys are there from the reset on, and stay; of an agent that has not been seen
            yet, all actions are legal.
    """

    def __init__(self, plan: Plan) -> None:
        """Make the environment of a plan.

        Raises:
            SimEnvError: Something in the plan cannot work.
        """
        super().__init__(plan)
        self._clear()

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
        self._episode = episode = self._start(seed, options, Episode)
        self._enter(episode)
        if self._shows:
            self.render()

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
        if self._leaving or episode.over:
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
        if self._rewarded:
            self._rest()
        record = episode.pending
        if record is None or episode.parting:
            self._enter(episode)
        else:
            self._select(record)
        if self._shows:
            self.render()

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
            record = episode.agents.get(agent)
            observation = None if record is None else record.observation
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
        return self._observation(self._episode, agent)

    # -- PettingZoo's books -----------------------------------------------------------------------

    def _go_on(self, episode: Any) -> None:
        super()._go_on(episode)
        episode.parting = []  # who has ended is in the books already

    def _in_mid_episode(self) -> bool:
        return super()._in_mid_episode() or bool(self._leaving)  # who has ended is yet to take leave

    def _clear(self) -> None:
        super()._clear()
        self.agents = []
        self._places: dict[str, int] = {}  # of the agents, in the list of agents
        self._leaving: list[str] = []  # whose episode has ended, the next one last
        self._rewarded: list[str] = []  # whom the latest step has rewarded, if not just the selected one
        self.rewards: dict[str, float] = {}
        self._cumulative_rewards: dict[str, float] = {}
        self.terminations: dict[str, bool] = {}
        self.truncations: dict[str, bool] = {}
        self.infos: dict[str, dict[str, Any]] = {}

    def _join(self, agent: str) -> None:
        self._places[agent] = len(self.agents)
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

    def _enter(self, episode: Episode) -> None:
        """Enter what a reset or a turn has brought besides a decision: births and ends."""
        if not self.agents:
            for agent, record in episode.agents.items():
                self._join(agent)
                self.infos[agent] = record.info
        for record in episode.parting:
            if self._padded:
                self._pad(record)
            else:
                self._part(record, terminated=True, truncated=False)
        if episode.over:
            if self._padded:
                for agent in episode.gone:
                    self._dismiss(agent, terminated=episode.terminated, truncated=episode.truncated)
            # Those that have never decided come last.
            for record in sorted(episode.agents.values(), key=lambda record: not record.decided):
                self._part(record, terminated=episode.terminated, truncated=episode.truncated)
        self._leaving.reverse()
        if episode.pending is not None:
            self._select(episode.pending)
            self._rewarded.append(episode.pending.agent)
        if self._leaving:
            self.agent_selection = self._leaving[-1]
        episode.parting = []

    def _part(self, record: Record, *, terminated: bool, truncated: bool) -> None:
        """Enter the end of an agent: last reward, flags; its ``None`` step is to come."""
        if record.agent not in self.rewards:
            self._join(record.agent)
        self._reward(record)
        self.infos[record.agent] = record.info
        self._dismiss(record.agent, terminated=terminated, truncated=truncated)

    def _pad(self, record: Record) -> None:
        """Enter that an agent was removed, and stays among the others all the same."""
        self._reward(record)
        self.infos[record.agent] = record.unseen()

    def _reward(self, record: Record) -> None:
        self.rewards[record.agent] = record.reward
        self._cumulative_rewards[record.agent] += record.reward
        self._rewarded.append(record.agent)

    def _dismiss(self, agent: str, *, terminated: bool, truncated: bool) -> None:
        self.terminations[agent], self.truncations[agent] = terminated, truncated
        self._leaving.append(agent)

    def _rest(self) -> None:
        """Take back what is only to be seen of the step before: the rewards of others than the selected agent."""
        for agent in self._rewarded:
            self.rewards[agent] = 0.0
        self._rewarded = []

    def _take_leave(self, episode: Episode, action: Any) -> None:
        """The step of an agent whose episode has ended."""
        if not self._leaving:
            raise episode.nothing_pending()
        if action is not None and action is not RULE:
            raise InvalidActionError(
                f"the episode of {self.agent_selection!r} has ended: its only legal action is None, not {action!r}"
            )
        self._rest()
        agent = self._leaving.pop()
        for book in (self.rewards, self._cumulative_rewards, self.terminations, self.truncations, self.infos):
            del book[agent]
        # The last agent takes its place in the list, which so takes the same time for any number of agents.
        place, mover = self._places.pop(agent), self.agents.pop()
        if mover != agent:
            self.agents[place], self._places[mover] = mover, place
        if self._leaving:
            self.agent_selection = self._leaving[-1]
        elif episode.pending is not None:
            self.agent_selection = episode.pending.agent
