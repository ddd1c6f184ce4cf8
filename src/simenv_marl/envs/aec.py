"""The AEC view: it selects agents in the order of the simulation's decisions."""

from pettingzoo import AECEnv

from ..core import (
    Action,
    Agent,
    EpisodeState,
    Info,
    Observation,
)
from ..errors import InvalidActionError, short_repr
from ..simulation import RULE
from .agents import AgentsView
from .base import ResetOptions, StepResult


class SimulationAECEnv(AgentsView, AECEnv[str, Observation, Action]):
    """A simulation as a PettingZoo AEC environment. ``aec_env`` and ``generate_env`` make it.

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

    kind = "aec"

    @property
    def latest(self) -> StepResult:
        """The results of ``last()``; in the other views, of the latest ``reset`` or ``step``."""
        return self.last()

    def reset(self, seed: int | None = None, options: ResetOptions = None) -> None:
        """Reset the simulation and run it to its first decision.

        Args:
            seed: The seed for the environment's generator, the agents' spaces, and the simulation's
                ``reset``. None: the simulation gets a seed from the environment's generator.
            options: Options for the simulation's ``reset``, if it takes them.

        Raises:
            NoDecisionError: The simulation ended without a decision.
            BaseException: Any exception of the model, a mapping or a policy.
        """
        self._start(seed, options, self.begin)

    def step(self, action: Action) -> None:
        """Answer the decision of ``agent_selection`` and run to the next one.

        Args:
            action: An action in the agent's action space, or ``RULE``. None for an agent whose
                episode has ended.

        Raises:
            InvalidActionError: The action is not legal. The environment does not change.
            ResetNeededError: There is no running episode.
            BaseException: Any exception of the model, a mapping or a policy.
        """
        episode = self.session.episode
        if episode is None or (self._lock and not self._lock.held):
            self._step_in_lock(SimulationAECEnv.step, action)
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
        self.rewards[selected] = 0.0
        self._cumulative_rewards[selected] = 0.0
        if self._rewarded:
            self._clear_rewards()
        self._record(episode)
        if self._shows:
            self.show_step()

    def last(self, observe: bool = True) -> StepResult:
        """Return the latest results of ``agent_selection``.

        Args:
            observe: Whether to return the observation, or None instead.

        Returns:
            Its observation, the sum of its rewards since its last step, terminated, truncated,
            info.

        Raises:
            ResetNeededError: There is no episode, or all agents have taken their final step.
        """
        episode = self.session.episode
        observation: Observation = None
        if self._leaving:
            if observe:
                observation = self.observe(self.agent_selection)
        elif episode is None or episode.pending is None:
            raise self.session.refusal()
        elif observe:
            observation = episode.pending.hand_out()
        name = self.agent_selection
        return (
            observation,
            self._cumulative_rewards[name],
            self.terminations[name],
            self.truncations[name],
            self.infos[name],
        )

    def observe(self, agent: str) -> Observation:
        """Return the latest observation of an agent of this episode, as a new copy.

        Raises:
            UnknownAgentError: There is no such agent.
            ResetNeededError: There is no episode.
        """
        record = self.episode.agent(agent)
        return self._point_of(agent).blank() if record is None else record.hand_out()

    # -- attributes of PettingZoo -----------------------------------------------------------------

    def repeat(self, answer: Action) -> None:
        """Take a step with an answer of the tape, after the ``None`` steps before it."""
        while self._leaving:
            self.step(None)
        self.step(answer)

    def _clear(self) -> None:
        self.agents = []
        self._places: dict[str, int] = {}  # the index of each agent in ``agents``
        # Agents that have ended and must take their None step, the next one last.
        self._leaving: list[str] = []
        # Agents besides the selected one that the latest step has rewarded.
        self._rewarded: list[str] = []
        self.rewards: dict[str, float] = {}
        self._cumulative_rewards: dict[str, float] = {}
        self.terminations: dict[str, bool] = {}
        self.truncations: dict[str, bool] = {}
        self.infos: dict[str, Info] = {}

    def begin(self, episode: EpisodeState) -> None:
        """Record the agents of a new episode, and its first decision."""
        for agent in episode.agents.values():
            self._note(agent, 0.0)
        self._record(episode)
        episode.mark_reported()

    def _note(
        self,
        agent: Agent,
        reward: float,
        terminated: bool = False,
        truncated: bool = False,
    ) -> None:
        """Record an agent's reward, info and flags. Let a new agent join."""
        name = agent.name
        if name not in self.rewards:
            self._places[name] = len(self.agents)
            self.agents.append(name)
            self._cumulative_rewards[name] = 0.0
        self.rewards[name] = reward
        self._cumulative_rewards[name] += reward
        self.infos[name] = agent.info
        self.terminations[name] = terminated
        self.truncations[name] = truncated

    def _record(self, episode: EpisodeState) -> None:
        """Record the ends and the pending decision of a reset or a step."""
        pending = episode.pending
        if pending is None or episode.just_ended:
            self._record_ends(episode)
        if pending is not None:
            name = pending.name
            if name not in self.rewards:
                self._note(pending, 0.0)
            # It has had no other reward since its last step.
            self.rewards[name] = pending.reward
            self._cumulative_rewards[name] = pending.reward
            self.infos[name] = pending.info
            self.agent_selection = name
        if self._leaving:
            if pending is not None:
                self._rewarded.append(pending.name)
            self.agent_selection = self._leaving[-1]

    def _record_ends(self, episode: EpisodeState) -> None:
        """Record the agents that have ended, in the order of their None steps."""
        ended = episode.take_ended()
        if episode.over:
            # Those that have never decided come last.
            ended += sorted(episode.agents.values(), key=lambda agent: not agent.decided)
        for agent in ended:
            truncated = episode.truncated and not agent.ended
            self._note(agent, agent.reward, not truncated, truncated)
        self._rewarded = [agent.name for agent in ended]
        self._leaving = self._rewarded[::-1]

    def _clear_rewards(self) -> None:
        for name in self._rewarded:
            self.rewards[name] = 0.0
        self._rewarded = []

    def _dead_step(self, episode: EpisodeState, action: Action) -> None:
        """Remove an agent that has ended, and select the next one."""
        if action is not None and action is not RULE:
            raise InvalidActionError(
                f"the episode of {self.agent_selection!r} has ended: its only legal action is"
                f" None, not {short_repr(action)}"
            )
        self._clear_rewards()
        name = self._leaving.pop()
        self.session.note_exit(name)
        del self.rewards[name]
        del self._cumulative_rewards[name]
        del self.terminations[name]
        del self.truncations[name]
        del self.infos[name]
        # The last agent moves to its place in the list, so that this takes the same time for any
        # number of agents.
        place = self._places.pop(name)
        last = self.agents.pop()
        if last != name:
            self.agents[place] = last
            self._places[last] = place
        if self._leaving:
            self.agent_selection = self._leaving[-1]
        elif episode.pending is not None:
            self.agent_selection = episode.pending.name
