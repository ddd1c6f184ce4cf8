"""Wrappers that pad agents to a fixed roster, for learners that need all agents from the reset to the end."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pettingzoo import AECEnv
from pettingzoo.utils import BaseParallelWrapper, BaseWrapper

from ..errors import ViewError, short_repr
from .base import AgentsView
from .parallel import Results


def pad_agents(env: Any) -> PaddedAECEnv | PaddedParallelEnv:
    """Pad the agents of an environment to its ``possible_agents``, from the reset to the end of the episode.

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


def _pad(view: AgentsView, rewards: dict[str, float], infos: dict[str, Any]) -> tuple[Any, ...]:
    """Return the rewards, terminations, truncations and infos of all possible agents, from those of the live ones."""
    episode, roster, padded = view.episode, view.possible_agents, {}
    acted = () if episode.round is None else episode.round.acted
    for name in roster:
        agent: Any = episode.agent(name)
        present = agent.present and not agent.ended
        if present:
            info = infos[name]
        else:
            agent.clear_observation()
            agent.take_observation()  # so that ``observe`` and ``state`` have blanks
            info = agent.info | (
                {"deciding": False, "acted": name in acted} if view._in_rounds else {}
            )
        padded[name] = {**info, "present": present}
    terminations, truncations = (
        dict.fromkeys(roster, episode.terminated),
        dict.fromkeys(roster, episode.truncated),
    )
    return {name: rewards.get(name, 0.0) for name in roster}, terminations, truncations, padded


class PaddedParallelEnv(BaseParallelWrapper[str, Any, Any]):
    """A parallel environment whose ``agents`` are all possible agents until the episode ends: see ``pad_agents``."""

    @property
    def agents(self) -> list[str]:
        """All possible agents while there is an episode."""
        episode = self.unwrapped.session.episode
        return [] if episode is None or episode.over else list(self.possible_agents)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Reset the environment; return the observations and infos of all possible agents."""
        observations, infos = super().reset(seed=seed, options=options)
        observations, *_, infos = self._padded((observations, {}, {}, {}, infos))
        return observations, infos

    def step(self, actions: Any) -> Results:
        """Play a round; return the results of all possible agents."""
        if isinstance(actions, Mapping) and self.agents:
            agents = self.unwrapped.episode.agents
            absent = {
                name
                for name in self.possible_agents
                if name not in agents or not agents[name].present
            }
            actions = {name: action for name, action in actions.items() if name not in absent}
        results: Results = super().step(actions)
        # they are empty after the end of the episode
        return self._padded(results) if results[0] else results

    def _padded(self, results: Results) -> Results:
        """Add the agents that are not present to the results of a round, and let all agents end together."""
        view, (observations, rewards, _, _, infos) = self.unwrapped, results
        *padded, infos = _pad(view, rewards, infos)
        seen = {
            name: observations[name] if i["present"] else view._point(name).blank()
            for name, i in infos.items()
        }
        return seen, *padded, infos


class PaddedAECEnv(BaseWrapper[str, Any, Any]):
    """An AEC environment whose ``agents`` are all possible agents until the episode ends: see ``pad_agents``.

    Absent agents are not selected before the end of the episode. A step takes time for each
    possible agent.
    """

    @property
    def agents(self) -> list[str]:
        """All possible agents, but for those that have been stepped over at the end of the episode."""
        return self._left if self.unwrapped.agents else []

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """Reset the environment."""
        super().reset(seed=seed, options=options)
        self._left = list(self.possible_agents)
        self._cumulative_rewards = dict.fromkeys(self.agents, 0.0)
        self._update()

    def step(self, action: Any) -> None:
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
        env, episode = self.env, self.unwrapped.episode
        rewards, infos = dict(env.rewards), env.infos
        while not episode.over and env.terminations[env.agent_selection]:
            env.step(None)
        self.rewards, self.terminations, self.truncations, self.infos = _pad(
            self.unwrapped, rewards, infos
        )
        for name, reward in self.rewards.items():
            self._cumulative_rewards[name] += reward
        self.agent_selection = self.agents[0] if episode.over else env.agent_selection
