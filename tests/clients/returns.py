"""What policies are worth: mean returns over seeds that no training has seen."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

HELD_OUT = range(10_000, 10_030)


def single_return(env: Any, act: Callable[[Any, dict[str, Any]], Any], seeds: Iterable[int] = HELD_OUT) -> float:
    """The mean return of a Gymnasium environment, over an episode for each seed."""
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
    """The mean of what all agents of a PettingZoo parallel environment together have gained."""
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
