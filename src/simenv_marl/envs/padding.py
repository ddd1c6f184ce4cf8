"""Wrappers that pad agents to a fixed roster, for learners that need all agents at all times."""

from __future__ import annotations

from collections.abc import Mapping

from pettingzoo import AECEnv
from pettingzoo.utils import BaseParallelWrapper, BaseWrapper

from ..core import Action, Info, Model, Observation
from ..errors import ViewError, short_repr
from .agents import AgentsView
from .base import ResetOptions
from .parallel import Results


def pad_agents(env: Model) -> PaddedAECEnv | PaddedParallelEnv:
    """Pad the agents of an environment to its ``possible_agents``, from the reset to the end.

    ``infos[agent]["present"]`` tells whether an agent lives. Agents that are not born yet, or that
    the model has removed, do not decide. Their observations are zero with all actions legal, their
    rewards 0.0, and actions for them are ignored. All agents end together, with the episode. This
    is also known as black death.

    Args:
        env: An AEC or parallel environment of a simulation, with ``possible_agents``.

    Raises:
        ViewError: It is another environment, or not all of its agents are known beforehand.
    """
    view = getattr(env, "unwrapped", env)
    if not isinstance(view, AgentsView):
        raise ViewError(
            f"pad_agents needs the environment of aec_env or parallel_env, not {short_repr(env)}"
        )
    if not hasattr(view, "possible_agents"):
        raise ViewError("pad_agents needs to know all agents: declare them in possible_agents=")
    return PaddedAECEnv(env) if isinstance(env, AECEnv) else PaddedParallelEnv(env)


def _pad(
    view: AgentsView,
    observations: dict[str, Observation],
    rewards: dict[str, float],
    infos: dict[str, Info],
) -> Results:
    """Return the results of all possible agents, from the results of live and ended ones."""
    episode = view.episode
    acted = () if episode.round is None else episode.round.acted
    padded_observations = {}
    padded_infos = {}
    for agent in view.known_agents():
        name = agent.name
        present = agent.present and not agent.ended
        if present:
            info = infos[name]
            padded_observations[name] = observations.get(name)
        else:
            agent.clear_observation(forget=True)  # ``observe`` and ``state`` have blanks then
            info = agent.info
            if view.in_rounds:
                info = {**info, "deciding": False, "acted": name in acted}
            padded_observations[name] = agent.point.blank()
        padded_infos[name] = {**info, "present": present}
    return (
        padded_observations,
        dict.fromkeys(padded_infos, 0.0) | rewards,
        dict.fromkeys(padded_infos, episode.terminated),
        dict.fromkeys(padded_infos, episode.truncated),
        padded_infos,
    )


class PaddedParallelEnv(BaseParallelWrapper[str, Observation, Action]):
    """A parallel environment with all possible agents until its end: see ``pad_agents``."""

    @property
    def agents(self) -> list[str]:
        """All possible agents while there is an episode."""
        episode = self.unwrapped.session.episode
        return [] if episode is None or episode.over else list(self.possible_agents)

    def reset(
        self,
        seed: int | None = None,
        options: ResetOptions = None,
    ) -> tuple[dict[str, Observation], dict[str, Info]]:
        """Reset the environment; return the observations and infos of all possible agents."""
        observations, infos = super().reset(seed=seed, options=options)
        observations, *_, infos = _pad(self.unwrapped, observations, {}, infos)
        return observations, infos

    def step(self, actions: Mapping[str, Action]) -> Results:
        """Play a round; return the results of all possible agents."""
        if isinstance(actions, Mapping) and self.agents:
            absent = {
                agent.name
                for agent in self.unwrapped.known_agents()
                if agent.ended or not agent.present
            }
            actions = {name: action for name, action in actions.items() if name not in absent}
        observations, rewards, *_, infos = super().step(actions)
        if not observations:  # after the end of the episode
            return {}, {}, {}, {}, {}
        return _pad(self.unwrapped, observations, rewards, infos)


class PaddedAECEnv(BaseWrapper[str, Observation, Action]):
    """An AEC environment with all possible agents until the episode ends: see ``pad_agents``.

    Absent agents are not selected before the end of the episode. A step takes time for each
    possible agent.
    """

    @property
    def agents(self) -> list[str]:
        """All possible agents that have not taken their None step."""
        return self._left if self.unwrapped.agents else []

    def reset(self, seed: int | None = None, options: ResetOptions = None) -> None:
        """Reset the environment."""
        super().reset(seed=seed, options=options)
        self._left = list(self.possible_agents)
        self._cumulative_rewards = dict.fromkeys(self._left, 0.0)
        self._update()

    def step(self, action: Action) -> None:
        """Answer the decision of ``agent_selection``. None for an agent that has ended."""
        selected = self.agent_selection
        if self.agents and (self.terminations[selected] or self.truncations[selected]):
            self._was_dead_step(action)
            return
        super().step(action)
        self._cumulative_rewards[selected] = 0.0
        self._update()

    def _update(self) -> None:
        """Read the rewards, infos and ends of a reset or a step."""
        env = self.env
        episode = self.unwrapped.episode
        rewards = dict(env.rewards)
        infos = env.infos
        while not episode.over and env.terminations[env.agent_selection]:
            env.step(None)
        results = _pad(self.unwrapped, {}, rewards, infos)
        _, self.rewards, self.terminations, self.truncations, self.infos = results
        for name, reward in rewards.items():
            self._cumulative_rewards[name] += reward
        self.agent_selection = self.agents[0] if episode.over else env.agent_selection
