"""The reward that all agents of an environment earn together: see the option ``team_reward``."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import TYPE_CHECKING, Any

from ...hooks.stacks import outside_simulation
from ...plugins import Plugins
from ...simulation import Model
from ..values.rewards import checked_reward

if TYPE_CHECKING:
    from .agent import Agent


class Team:
    """The team of an episode.

    Attributes:
        earned: What the team has earned in the latest step. 0.0 at the reset.
        total: What it has earned since the first decision.
        plugins: The handlers that take part in its callable.
        memory: The values of differences in its callable.
    """

    __slots__ = ("_earn", "_ended", "_has_begun", "_paid", "earned", "memory", "plugins", "total")

    def __init__(self, earn: Callable[[], Model], plugins: Plugins | None) -> None:
        """Begin without any reward. ``earn`` returns what was earned since it was last called."""
        self._earn = earn
        self._ended: list[Agent] = []  # in this step
        self._has_begun = False
        self._paid: dict[str, float] = {}  # the total at each agent's latest reward
        self.earned = 0.0
        self.total = 0.0
        self.plugins = plugins
        self.memory: dict[Any, Any] = {}

    def join(self, agent: Agent) -> None:
        """Pay an agent for all of this step, because it acts before it was ever paid."""
        self._paid.setdefault(agent.name, self.total)

    def note_end(self, agent: Agent) -> None:
        """Note an agent that has ended. It is paid for all of this step."""
        self._ended.append(agent)

    def settle(self, agents: Collection[Agent]) -> None:
        """Ask what was earned in this step, and pay agents that have decided, and ended ones.

        The first call is at the reset, before any action, so its value is dropped.
        """
        with outside_simulation(self):
            earned = checked_reward("the team", self._earn())
        if self._has_begun:
            self.earned = earned
            self.total += earned
        self._has_begun = True
        for agent in (*self._ended, *agents):
            if agent.decided:
                agent.pay(self.total - self._paid.get(agent.name, self.total))
                self._paid[agent.name] = self.total
        self._ended = []
