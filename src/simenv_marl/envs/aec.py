"""The AEC view: agents are selected in the order in which the simulation calls their decision functions."""

from typing import Any

from numpy import ndarray
from pettingzoo import AECEnv

from ..core import Agent, EpisodeState, duplicate
from ..errors import InvalidActionError, short_repr
from ..simulation import RULE
from .base import AgentsView


class SimulationAECEnv(AgentsView, AECEnv[str, Any, Any]):
    """A simulation as a PettingZoo AEC environment. Made by ``aec_env`` and ``generate_env``.

    ``possible_agents`` exists only if all agents are known beforehand. The time for a step does not
    depend on the number of agents: PettingZoo's helpers for rewards and dead steps, which loop over
    all agents, are not used.

    Attributes:
        agents: The agents that have not yet taken the final ``None`` step of their episode.
        agent_selection: The agent whose decision is pending; after agents have ended, the one that
            takes its ``None`` step next.
        rewards: The rewards of the latest step, as Python floats.
        terminations, truncations: The flags of each agent, as Python bools.
        infos: The info of each agent's latest decision. ``infos[agent]["action_mask"]``, np.int8,
            exists if the decision point restricts its actions; ``"time"`` and ``"elapsed"`` exist
            if the simulation has a clock. The keys exist from the reset on. Until an agent was
            observed, its mask has all actions legal.
    """

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """Reset the simulation and run it to its first decision.

        Args:
            seed: The seed for the environment's generator, the agents' spaces, and the simulation's
                ``reset``. None: the simulation gets a seed from the environment's generator.
            options: Options for the simulation's ``reset``, if it takes them.

        Raises:
            NoDecisionError: The simulation ended without a decision.
            BaseException: Any exception of the model, a mapping or a policy.
        """
        self._start(seed, options)

    def step(self, action: Any) -> None:
        """Answer the decision of ``agent_selection`` and run to the next one.

        Args:
            action: An action in the agent's action space, or ``RULE``. None for an agent whose
                episode has ended.

        Raises:
            InvalidActionError: The action is not legal. The environment does not change.
            ResetNeededError: There is no running episode.
            BaseException: Any exception of the model, a mapping or a policy.
        """
        session = self.session
        episode = session.episode
        if episode is None or (session.lock is not None and not session.lock.held):
            self._step_alone(SimulationAECEnv.step, action)
            return
        if self._leaving:
            self._dead_step(episode, action)
            return
        try:
            episode.step(action)
        except BaseException:
            if episode.over:  # an error has ended it
                self._clear()
            raise
        selected = self.agent_selection
        self.rewards[selected] = self._cumulative_rewards[selected] = 0.0
        if self._rewarded:
            self._clear_rewards()
        self._record(episode)
        if self._shows:
            self._show()

    def last(self, observe: bool = True) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Return what ``agent_selection`` needs to decide.

        Args:
            observe: Whether to return the observation, or None instead.

        Returns:
            Its observation, the sum of its rewards since its last step, terminated, truncated,
            info.

        Raises:
            ResetNeededError: There is no episode, or all agents have taken their final step.
        """
        episode, observation = self.session.episode, None
        if self._leaving:
            observation = self.observe(self.agent_selection) if observe else None
        elif episode is None or episode.pending is None:
            raise self.session.refusal()
        elif observe:
            observation = episode.pending.observation
            observation = (
                observation.copy() if type(observation) is ndarray else duplicate(observation)
            )
        name = self.agent_selection
        reward = self._cumulative_rewards[name]
        return (
            observation,
            reward,
            self.terminations[name],
            self.truncations[name],
            self.infos[name],
        )

    def observe(self, agent: str) -> Any:
        """Return the latest observation of an agent of this episode, as a new copy.

        Raises:
            UnknownAgentError: There is no such agent.
            ResetNeededError: There is no episode.
        """
        found = self.episode.agent(agent)
        if found is None or found.observation is None:
            return self._point(agent).blank()
        return duplicate(found.observation)

    # -- PettingZoo's books -----------------------------------------------------------------------

    def _clear(self) -> None:
        self.agents = []
        self._places: dict[str, int] = {}  # of the agents, in the list of agents
        # agents that have ended, and whose None step is to come, the next one last
        self._leaving: list[str] = []
        # agents besides the selected one that the latest step has rewarded
        self._rewarded: list[str] = []
        self.rewards: dict[str, float] = {}
        self._cumulative_rewards: dict[str, float] = {}
        self.terminations: dict[str, bool] = {}
        self.truncations: dict[str, bool] = {}
        self.infos: dict[str, dict[str, Any]] = {}

    def _begin(self, episode: EpisodeState) -> None:
        for agent in episode.agents.values():
            self._join(agent)
        self._record(episode)
        episode.mark_reported()

    def _join(self, agent: Agent) -> None:
        name = agent.name
        self._places[name] = len(self.agents)
        self.agents.append(name)
        self.rewards[name] = self._cumulative_rewards[name] = 0.0
        self.terminations[name] = self.truncations[name] = False
        self.infos[name] = agent.info

    def _record(self, episode: EpisodeState) -> None:
        """Record the ends and the pending decision of a reset or a step."""
        pending = episode.pending
        if pending is None or episode.just_ended:
            ended = [(agent, True, False) for agent in episode.take_ended()]
            if episode.over:
                # Those that have never decided come last.
                others = sorted(episode.agents.values(), key=lambda agent: not agent.decided)
                ended += [(agent, episode.terminated, episode.truncated) for agent in others]
            for agent, terminated, truncated in ended:
                name = agent.name
                if name not in self.rewards:
                    self._join(agent)
                self.rewards[name] = agent.reward
                self._cumulative_rewards[name] += agent.reward
                self.infos[name] = agent.info
                self.terminations[name], self.truncations[name] = terminated, truncated
                self._rewarded.append(name)
            self._leaving = self._rewarded[::-1]
        if pending is not None:
            name = pending.name
            if name not in self.rewards:
                self._join(pending)
            # It has had no other reward since its last step.
            self.rewards[name] = self._cumulative_rewards[name] = pending.reward
            self.infos[name] = pending.info
        if self._leaving:
            self._rewarded.append(name)
            name = self._leaving[-1]
        self.agent_selection = name

    def _clear_rewards(self) -> None:
        for name in self._rewarded:
            self.rewards[name] = 0.0
        self._rewarded = []

    def _dead_step(self, episode: EpisodeState, action: Any) -> None:
        if action is not None and action is not RULE:
            raise InvalidActionError(
                f"the episode of {self.agent_selection!r} has ended: its only legal action is"
                f" None, not {short_repr(action)}"
            )
        self._clear_rewards()
        name = self._leaving.pop()
        for book in (
            self.rewards,
            self._cumulative_rewards,
            self.terminations,
            self.truncations,
            self.infos,
        ):
            del book[name]
        # The last agent takes its place in the list, so that this takes the same time for any
        # number of agents.
        place, mover = self._places.pop(name), self.agents.pop()
        if mover != name:
            self.agents[place], self._places[mover] = mover, place
        if self._leaving:
            self.agent_selection = self._leaving[-1]
        elif episode.pending is not None:
            self.agent_selection = episode.pending.name
