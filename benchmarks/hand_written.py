"""Environments written by hand, with which the benchmarks compare the environments of this library.

The AEC environment has the bookkeeping of PettingZoo's documented template, the single one the
parts of Gymnasium's (``_get_obs``, ``_get_info``). All of them are no-op simulations without an
end, with an observation of four float32 and a reward of 1.0.
"""

from __future__ import annotations

import threading
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import AECEnv
from pettingzoo.utils.agent_selector import AgentSelector

OBSERVATION_SPACE = spaces.Box(-1.0, 1.0, (4,), np.float32)
ACTION_SPACE = spaces.Discrete(2)


class State:
    """The state of a no-op simulation."""

    def __init__(self) -> None:
        self.values = np.array([0.1, 0.2, 0.3, 0.4], np.float32)

    def observe(self) -> NDArray[np.float32]:
        return np.array(self.values)

    def act(self, action: int) -> None:
        """Apply an action, which does nothing."""


class TemplateAECEnv(AECEnv[str, Any, Any]):
    """A no-op environment with the bookkeeping of PettingZoo's template."""

    metadata = {  # noqa: RUF012 - as in the template
        "name": "template_v0",
        "render_modes": [],
        "is_parallelizable": True,
    }
    render_mode = None

    def __init__(self, agents: int = 2, rounds: int = 10**12) -> None:
        super().__init__()
        self.possible_agents = [f"agent_{number}" for number in range(agents)]
        self.rounds = rounds
        self.model = State()

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        return OBSERVATION_SPACE

    def action_space(self, agent: str) -> spaces.Space[Any]:
        return ACTION_SPACE

    def observe(self, agent: str) -> NDArray[np.float32]:
        return np.array(self.observations[agent])

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        self.agents = self.possible_agents[:]
        self.rewards = dict.fromkeys(self.agents, 0.0)
        self._cumulative_rewards = dict.fromkeys(self.agents, 0.0)
        self.terminations = dict.fromkeys(self.agents, False)
        self.truncations = dict.fromkeys(self.agents, False)
        self.infos = {agent: {} for agent in self.agents}
        self.state = dict.fromkeys(self.agents)  # type: ignore[assignment]
        self.observations = dict.fromkeys(self.agents, self.model.values)
        self.moves = 0
        self._selector = AgentSelector(self.agents)
        self.agent_selection = self._selector.next()

    def step(self, action: Any) -> None:
        agent = self.agent_selection
        if self.terminations[agent] or self.truncations[agent]:
            self._was_dead_step(action)
            return
        self._cumulative_rewards[agent] = 0.0
        self.state[agent] = action  # type: ignore[index]
        if self._selector.is_last():
            for name in self.agents:
                self.rewards[name] = 1.0
            self.moves += 1
            self.truncations = dict.fromkeys(self.agents, self.moves >= self.rounds)
            for name in self.agents:
                self.observations[name] = self.model.values
        else:
            self._clear_rewards()
        self.agent_selection = self._selector.next()
        self._accumulate_rewards()

    def render(self) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""


class TemplateEnv(gym.Env[Any, Any]):
    """A no-op environment with the parts of Gymnasium's template."""

    observation_space = OBSERVATION_SPACE
    action_space = ACTION_SPACE

    def __init__(self) -> None:
        self.model = State()

    def _get_obs(self) -> NDArray[np.float32]:
        return self.model.observe()

    def _get_info(self) -> dict[str, Any]:
        return {}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self._get_obs(), self._get_info()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.model.act(action)
        terminated = False
        reward = 0.0 if terminated else 1.0
        observation = self._get_obs()
        info = self._get_info()
        return observation, reward, terminated, False, info


# -- other ways to let a simulation keep its own loop ----------------------------------------------


class ThreadEnv(TemplateEnv):
    """The simulation runs in a thread and alternates with its user, by two locks."""

    def __init__(self) -> None:
        super().__init__()
        self.action_arrives, self.observation_arrives = threading.Lock(), threading.Lock()
        self.action_arrives.acquire()
        self.observation_arrives.acquire()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        self.over = False
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()
        self.observation_arrives.acquire()
        return self.observation, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.action = action
        self.action_arrives.release()
        self.observation_arrives.acquire()
        return self.observation, 1.0, False, False, {}

    def _run(self) -> None:
        while not self.over:
            self.observation = self.model.observe()
            self.observation_arrives.release()
            self.action_arrives.acquire()

    def close(self) -> None:
        self.over = True
        self.action_arrives.release()
        self.thread.join()
