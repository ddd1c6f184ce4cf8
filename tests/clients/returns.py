"""What policies are worth: mean returns over seeds that no training has seen."""

from __future__ import annotations

import numpy as np

from simenv_marl import parallel_env


def mean_return(
    simulation,
    points,
    act,
    *,
    seeds=range(10_000, 10_030),
    **options,
):
    """The mean sum of all agents' returns; ``act`` decides by agent, observation and info."""
    env = parallel_env(simulation, points, **options)
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
