"""What policies are worth: mean returns over seeds that no training has seen."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

HELD_OUT = range(10_000, 10_030)


def single_return(env: Any, act: Callable[[Any, dict[str, Any]], Any], seeds: Iterable[int] = HELD_OUT) -> float:
    """The mean return of a Gymnasium environment.

    Args:
        env: The environment, which is left open.
        act: The policy: a callable of the observation and the info.
        seeds: An episode for each.
    """
    returns = []
    for seed in seeds:
        observation, info = env.reset(seed=seed)
        gained, over = 0.0, False
        while not over:
            observation, reward, terminated, truncated, info = env.step(act(observation, info))
            gained, over = gained + reward, terminated or truncated
        returns.append(gained)
    return float(np.mean(returns))


def parallel_return(env: Any, act: Callable[[str, Any, dict[str, Any]], Any], seeds: Iterable[int] = HELD_OUT) -> float:
    """The mean over the episodes of a PettingZoo parallel environment of what all agents together have gained.

    Args:
        env: The environment, which is left open.
        act: The policy of all agents: a callable of the agent's name, its observation and its info.
        seeds: An episode for each.
    """
    returns = []
    for seed in seeds:
        observations, infos = env.reset(seed=seed)
        gained = 0.0
        while env.agents:
            actions = {agent: act(agent, observations[agent], infos[agent]) for agent in env.agents}
            observations, rewards, _, _, infos = env.step(actions)
            gained += sum(rewards.values())
        returns.append(gained)
    return float(np.mean(returns))


def aec_return(env: Any, act: Callable[[str, Any, dict[str, Any]], Any], seeds: Iterable[int] = HELD_OUT) -> float:
    """The same of a PettingZoo AEC environment."""
    returns = []
    for seed in seeds:
        env.reset(seed=seed)
        gained = 0.0
        for agent in env.agent_iter():
            observation, reward, terminated, truncated, info = env.last()
            gained += reward
            env.step(None if terminated or truncated else act(agent, observation, info))
        returns.append(gained)
    return float(np.mean(returns))
