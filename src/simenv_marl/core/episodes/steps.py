"""What the agents of a step share: the round that is played, and the team's reward."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import TYPE_CHECKING, Any, Final

from ...errors import short_repr, warn_user
from ...hooks.stacks import outside_simulation
from ...plugins import Plugins
from ...simulation import RULE, Action, Model
from ..switching.driver import WAIT
from ..values.actions import mask_allows
from ..values.rewards import checked_reward

if TYPE_CHECKING:
    from .agent import Agent

MANY_ROUNDS: Final = 100
"""After so many rounds in a row without an action for the pending agent, the user is warned."""


class Round:
    """The present round of an episode. It uses each action once, up to a decision without one.

    Attributes:
        actions: The actions that no decision has used yet, by agent.
        acted: The names of the agents whose action was used in this round.
        used: The number of actions in the episode, other than ``RULE``, that decisions have used.
        unused: The number of actions that no decision has used.
        early: The number of used actions that were chosen before their decision arose.
        stalled: The number of rounds in a row without an action for the pending agent.
    """

    __slots__ = ("_pending", "acted", "actions", "early", "stalled", "unused", "used")

    def __init__(self) -> None:
        self.actions: dict[str, Action] = {}
        self.acted: set[str] = set()
        self.used = 0
        self.unused = 0
        self.early = 0
        self.stalled = 0
        self._pending = ""  # the agent whose decision waited when the round began

    def begin(self, actions: dict[str, Action], pending: str) -> None:
        """Begin a round with checked actions. ``pending``: the agent whose decision waits."""
        self.actions = actions
        self._pending = pending
        self.acted = set()

    def take(self, agent: Agent) -> Action:
        """Return the action for a decision. ``WAIT`` if there is none, or if it is illegal now."""
        action = self.actions.pop(agent.name, WAIT)
        if action is WAIT:
            return WAIT
        if action is not RULE:
            if agent.mask is not None:
                space = agent.point.definition.action_space
                if not mask_allows(space, agent.mask, action):
                    return WAIT
            self.used += 1
            self.early += agent.name != self._pending
        self.acted.add(agent.name)
        self.stalled = 0
        return action

    def count_unused(self) -> None:
        """Count the actions that the round has not used."""
        for action in self.actions.values():
            self.unused += action is not RULE

    def explain_losses(self) -> str:
        """Explain how many actions were lost. Empty if at least nine in ten were used."""
        given = self.used + self.unused
        if 10 * self.used >= 9 * given:
            return ""
        return (
            f"of {given} actions in this episode, {self.used} were used: the agents do not"
            " decide in each round, and the other actions are lost;"
            f" {self.early} decisions were answered by an action that was chosen before they"
            " arose. aec_env loses none, nor does turn_env, for one learner"
        )

    def note_stalled(self, pending: Agent) -> None:
        """Note that the simulation has not moved. Warn if that is so for many rounds."""
        self.stalled += 1
        if self.stalled == MANY_ROUNDS:
            warn_user(
                f"the simulation stands still: {short_repr(pending.name)} must decide, but"
                f" {MANY_ROUNDS} rounds in a row had no action for it; the info of the agent that"
                ' must decide has "deciding": True'
            )


class Team:
    """The team of an episode.

    Attributes:
        total: What it has earned since the first decision.
        plugins: The handlers that take part in its callable.
        memory: The values of differences in its callable.
    """

    __slots__ = ("_earn", "_ended", "_has_begun", "_paid", "memory", "plugins", "total")

    def __init__(self, earn: Callable[[], Model], plugins: Plugins | None) -> None:
        """Begin without any reward. ``earn`` returns what was earned since it was last called."""
        self._earn = earn
        self._ended: list[Agent] = []  # in this step
        self._has_begun = False
        self._paid: dict[str, float] = {}  # the total at each agent's latest reward
        self.total = 0.0
        self.plugins = plugins
        self.memory: dict[Any, Any] = {}

    def join(self, agent: Agent) -> None:
        """Pay an agent for all of this step, because it acts before it was ever paid."""
        self._paid.setdefault(agent.name, self.total)

    def note_end(self, agent: Agent) -> None:
        """Note an agent that has ended. It is paid for all of this step."""
        self._ended.append(agent)

    def settle(self, agents: Collection[Agent]) -> float:
        """Ask what was earned in this step, and pay agents that have decided, and ended ones.

        The first call is at the reset, before any action, so its value is dropped. Return what was
        earned.
        """
        with outside_simulation(self):
            earned = checked_reward("the team", self._earn())
        if not self._has_begun:
            earned = 0.0
        self._has_begun = True
        self.total += earned
        for agent in (*self._ended, *agents):
            if agent.decided:
                agent.pay(self.total - self._paid.get(agent.name, self.total))
                self._paid[agent.name] = self.total
        self._ended = []
        return earned
