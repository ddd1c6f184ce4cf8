"""Rounds: in parallel and joint views, a step has an action for each agent."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ...errors import short_repr, warn_user
from ...simulation import RULE, Action
from ..switching.driver import WAIT
from ..values.actions import mask_allows

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

    @property
    def given(self) -> int:
        """The number of actions in the episode, other than ``RULE``."""
        return self.used + self.unused

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
        return action

    def count_unused(self) -> None:
        """Count the actions that the round has not used."""
        for action in self.actions.values():
            self.unused += action is not RULE

    def note_moved(self) -> None:
        """Note that the simulation has moved."""
        self.stalled = 0

    def note_stalled(self, pending: Agent) -> None:
        """Note that the simulation has not moved. Warn if that is so for many rounds."""
        self.stalled += 1
        if self.stalled == MANY_ROUNDS:
            warn_user(
                f"the simulation stands still: {short_repr(pending.name)} must decide, but"
                f" {MANY_ROUNDS} rounds in a row had no action for it; the info of the agent that"
                ' must decide has "deciding": True'
            )
