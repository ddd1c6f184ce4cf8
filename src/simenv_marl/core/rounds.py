"""Rounds: in parallel and joint views, a step has an action for each agent, and all agents are updated at its end."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

from ..errors import InvalidActionError, UnknownAgentError, listed, short_repr, warn_user
from ..simulation import RULE
from .actions import ILLEGAL
from .driver import WAIT
from .spaces import duplicate

if TYPE_CHECKING:
    from .agent import Agent
    from .episode import Episode, EpisodeState

MANY_ROUNDS: Final = 100
"""The number of rounds in a row without an action for the pending agent after which the user is warned."""


class Round:
    """The present round of an episode. It uses each action once, up to the first decision without one.

    Attributes:
        actions: The actions that no decision has used yet, by agent.
        given, unused: The numbers of actions in the episode, other than ``RULE``, and of those that
            were never used.
        stalled: The number of rounds without an action for the pending agent since the simulation
            last moved.
    """

    __slots__ = ("actions", "given", "stalled", "unused")

    def __init__(self) -> None:
        self.actions: dict[str, Any] = {}
        self.given = self.unused = self.stalled = 0

    def play(self, episode: Episode, actions: Mapping[str, Any]) -> None:
        """Play a round with an action, or ``RULE``, for each agent's name.

        An action that is legal now and illegal at its turn counts as missing.

        Raises:
            UnknownAgentError: An action is for an agent that is not live. Nothing has moved.
        """
        pending: Any = episode.pending
        self.actions = given = self.check(episode, actions)
        episode.pending = None
        try:
            if len(episode.tape) < episode.tape_size:
                answers = {
                    name: part if type(part) is int else duplicate(part)
                    for name, part in given.items()
                }
                episode.tape.append(answers)
            episode.turns += bool(actions)
            for agent in (*episode.agents.values(), *episode.just_ended):
                agent.acted = False
            if episode.unreported_end:
                episode.unreported_end = False
            else:
                episode.just_ended = []
            reply = self.use_action(episode, pending)
            self.stalled = self.stalled + 1 if reply is WAIT else 0
            if reply is not WAIT:
                episode.advance(reply)
            if not episode.skips:  # else forced moves are not asked for
                self.unused += sum(part is not RULE for part in given.values())
            if not episode.over and episode.consulted is None:  # it is set where a replay ends
                episode.update_all(truncated=bool(actions) and episode.turns == episode.most_steps)
        except BaseException as error:
            episode.fail(error)
            raise
        if self.stalled == MANY_ROUNDS:
            warn_user(
                f"the simulation stands still: {short_repr(pending.name)} must decide, but"
                f" {MANY_ROUNDS} rounds in a"
                ' row had no action for it; the info of the agent that must decide has "deciding":'
                " True"
            )

    def check(self, episode: EpisodeState, actions: Mapping[str, Any]) -> dict[str, Any]:
        """Check the actions of a round before the simulation moves.

        Return them in the form that mappings take.
        """
        pending, agents, checked = episode.pending, episode.agents, {}
        if type(actions) is not dict and not isinstance(actions, Mapping):
            raise InvalidActionError(
                f"a round takes a dict of actions by agent, not {short_repr(actions)}"
            )
        for name, action in actions.items():
            agent = agents.get(name)
            if agent is None:
                if episode.unreported_end and name in episode.ended:
                    continue
                raise UnknownAgentError(
                    f"there is an action for {short_repr(name)}, which is not a live agent; live"
                    f" agents: {listed(agents)}"
                )
            if action is not RULE:
                check = agent.point.check
                legal = check(action)
                mask = agent.mask if agent is pending else None
                if legal is ILLEGAL or mask is not None:
                    legal = agent.point.validate(action, name, mask)
                action = legal
                self.given += 1
            checked[name] = action
        return checked

    def decide(
        self, episode: Episode, agent: Agent, args: tuple[Any, ...], kwargs: dict[str, Any]
    ) -> Any:
        """Handle a decision: the agent was observed when the latest step returned."""
        if agent.point.legal is not None:
            agent.mask, agent.choices = agent.point.legal(args, kwargs)
        if agent.clock is not None:
            agent.read_clock(agent)
        return self.use_action(episode, agent)

    def use_action(self, episode: Episode, agent: Agent) -> Any:
        """Answer a decision with the agent's action of this round, or wait for the next round."""
        action = agent.only_action() if episode.skips else None
        if action is None:
            action = self.actions.pop(agent.name, WAIT)
            mask = agent.mask
            if action is WAIT or (
                mask is not None and action is not RULE and not agent.point.allows(mask, action)
            ):
                episode.pending = agent
                return WAIT
            agent.acted = True
        episode.latest = agent
        if not agent.decided:  # it acts before it was ever updated
            agent.update(agent, agent.arguments(), agent.kwargs, observe=False)
        return episode.answer(agent, action, False)
