"""The parallel view: each step is a round with at most one action of every agent."""

from collections.abc import Mapping
from typing import TypeAlias

from pettingzoo import ParallelEnv

from ..core import (
    Action,
    EpisodeState,
    Info,
    Observation,
)
from ..simulation import Sentinel
from .agents import AgentsView
from .base import ResetOptions

Results: TypeAlias = tuple[
    dict[str, Observation],
    dict[str, float],
    dict[str, bool],
    dict[str, bool],
    dict[str, Info],
]
"""The results of a step: observations, rewards, terminations, truncations and infos, by agent."""


class SimulationParallelEnv(AgentsView, ParallelEnv[str, Observation, Action]):
    """A simulation as a PettingZoo parallel environment.

    ``parallel_env`` and ``generate_env`` make it.

    A step answers each decision as it arises with the action of its agent. Each action is used
    once. The step returns at the first decision whose action is missing or already used. So, giving
    all actions at once makes simultaneous moves, and giving one action at a time makes turns. When
    the step returns, all live agents are observed and rewarded.

    Attributes:
        agents: The live agents.
    """

    kind = "parallel"
    in_rounds = True

    def reset(
        self,
        seed: int | None = None,
        options: ResetOptions = None,
    ) -> tuple[dict[str, Observation], dict[str, Info]]:
        """Reset the simulation and run it to its first decision.

        For the arguments and errors, see ``SimulationAECEnv.reset``.

        Returns:
            The observations and the infos, by agent.
        """
        observations, *_, infos = self._start(seed, options, self.begin)
        self.agents = list(observations)
        self._latest = results = observations, infos
        return results

    def step(self, actions: Mapping[str, Action] | Sentinel) -> Results:
        """Play a round.

        Args:
            actions: A dict from live agent to an action in its action space, or ``RULE``. ``RULE``
                instead of the dict means ``RULE`` for every agent. After the end of the episode, an
                empty dict is accepted and has no effect.

        Returns:
            Observations, rewards (Python floats), terminations, truncations (Python bools) and
            infos, by agent. ``infos[agent]["deciding"]`` tells whether the agent's decision is
            pending, ``["acted"]`` whether its action was used. Agents that have ended are in the
            dicts one last time.

        Raises:
            UnknownAgentError: An action is for an agent that does not live. The environment does
                not change.
            BaseException: Any error of ``SimulationAECEnv.step``.
        """
        episode = self.session.episode
        if episode is None or (self._lock and not self._lock.held):
            return self._step_in_lock(SimulationParallelEnv.step, actions)
        if not self.agents and not actions and (episode.terminated or episode.truncated):
            nothing: Results = {}, {}, {}, {}, {}  # as PettingZoo's own environments do
            self._latest = nothing
            return nothing
        if isinstance(actions, Sentinel):
            actions = dict.fromkeys(episode.agents, actions)
        try:
            episode.step(actions)
        except BaseException:
            if episode.over:  # an error has ended it
                self.agents = []
            raise
        is_over = episode.pending is None and episode.over
        self.agents = [] if is_over else list(episode.agents)
        self._latest = results = self.begin(episode)
        if is_over:
            self.warn_of_losses(episode)
        if self._shows:
            self.show_step()
        return results

    def begin(self, episode: EpisodeState) -> Results:
        """Return the results of a reset or a step, by agent."""
        agents = episode.agents
        ended = episode.just_ended
        pending = episode.pending
        acted = () if episode.round is None else episode.round.acted
        if ended:
            agents = {agent.name: agent for agent in ended} | agents
        terminations = dict.fromkeys(agents, pending is None and episode.terminated)
        truncations = dict.fromkeys(agents, pending is None and episode.truncated)
        observations = {}
        rewards = {}
        infos = {}
        for name, agent in agents.items():
            observations[name] = agent.hand_out()
            rewards[name] = agent.reward
            info = agent.info
            infos[name] = info
            info["deciding"] = agent is pending
            info["acted"] = name in acted
        for agent in ended:
            terminations[agent.name] = True
            truncations[agent.name] = False
        return (
            observations,
            rewards,
            terminations,
            truncations,
            infos,
        )

    def _clear(self) -> None:
        super()._clear()
        self.agents = []
