"""``padded=True``: all ``possible_agents`` are in ``agents`` from the reset to the end of an episode.

Agents that are not born yet, or that the model has removed, do not decide. Their observations are blank, the entry
``"present"`` of their infos is False, and actions for them are ignored.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from ..core.agent import Agent
from ..core.bound import BoundPoint
from ..core.episode import Episode

Results = tuple[dict[str, Any], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]
"""The results of a parallel step: observations, rewards, terminations, truncations and infos, by agent."""


def is_present(agent: Agent) -> bool:
    """Whether an agent is live and was observed."""
    return agent.present and not agent.ended


def presence(agent: Agent) -> dict[str, Any]:
    """The info of an agent, with the entry ``"present"``."""
    if agent.ended:
        agent.unsee()
    info = agent.info
    info["present"] = is_present(agent)
    return info


def of_present_agents(episode: Episode, roster: Mapping[str, BoundPoint], actions: Mapping[str, Any]) -> dict[str, Any]:
    """Remove the actions of possible agents that are not present."""
    agents = episode.agents
    return {
        name: action
        for name, action in actions.items()
        if name not in roster or (name in agents and is_present(agents[name]))
    }


def pad(episode: Episode, possible_agents: Iterable[str], results: Results) -> None:
    """Add the agents that are not present to the results of a round, and let all agents end together."""
    observations, rewards, terminations, truncations, infos = results
    for name in possible_agents:
        agent = episode.agent(name)
        assert agent is not None
        if not is_present(agent):
            told = infos.get(name, {})
            acted = told.get("acted", False)
            observations[name] = agent.point.blank()
            if name in rewards:
                rewards[name] = agent.reward
            else:
                rewards[name] = 0.0
            reward = rewards[name]
            agent.unsee()
            agent.reward = reward
            infos[name] = {**agent.info, "deciding": False, "acted": acted}
        infos[name]["present"] = is_present(agent)
        terminations[name], truncations[name] = episode.terminated, episode.truncated
        part: Any
        for part in results:
            if name in part:  # moved to the end, so that the dict has the order of ``possible_agents``
                part[name] = part.pop(name)
