"""Rounds: an action for each agent at once, as in the parallel and joint views."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

from greenlet import getcurrent

from ..errors import InvalidActionError, UnknownAgentError, short_repr, warn_user
from ..hooks.stacks import EVALUATING
from ..simulation import RULE, Sentinel
from .actions import ILLEGAL
from .driver import WAIT
from .spaces import duplicate

if TYPE_CHECKING:
    from .agent import Agent
    from .episode import Episode

MANY_ROUNDS: Final = 100
"""The number of rounds in a row without an action for the pending agent after which the user is warned."""

MISSING: Final = Sentinel("MISSING")


class Rounds:
    """The state of an episode that is played in rounds.

    A round uses each action once, up to the first decision without one. Then all live agents are updated.

    Attributes:
        actions: The unused actions of the current round, by agent.
        stalled: The number of rounds without an action for the pending agent since the simulation last moved.
        ended_at_reset: Agents whose episode ended at a forced move during the reset. The first round reports their
            rewards and ends.
    """

    __slots__ = ("actions", "ended_at_reset", "stalled")

    def __init__(self) -> None:
        self.actions: dict[str, Any] = {}
        self.stalled = 0
        self.ended_at_reset: list[Agent] = []

    def play(self, episode: Episode, actions: Mapping[str, Any], entered: bool = False) -> None:
        """Play a round.

        Args:
            episode: The episode.
            actions: An action, or ``RULE``, for each agent's name.
            entered: Whether the environment's context is already entered.

        Raises:
            UnknownAgentError: An action is for an agent that is not live. Nothing has moved.
            InvalidActionError: An action is not legal. Nothing has moved. An action that is legal now and illegal at
                its turn counts as missing.
            EpisodeOverError, ReentrancyError: No decision is pending.
        """
        pending = episode.pending
        if pending is None:
            episode.report_end()
            return
        if not entered and (getcurrent() is not episode.driver.caller or EVALUATING or episode.plugins is not None):
            with episode.context():
                self.play(episode, actions, True)
            return
        checked = self.check(episode, actions)
        episode.pending = None
        try:
            episode.record({name: part if type(part) is int else duplicate(part) for name, part in checked.items()})
            episode.turns += bool(actions)
            for agent in (*episode.agents.values(), *episode.just_ended):
                agent.acted = False
            episode.just_ended, self.ended_at_reset = self.ended_at_reset, []
            self.actions = checked
            reply = self._use_action(episode, pending)
            if reply is WAIT:
                self.stalled += 1
            else:
                self.stalled = 0
                episode.advance(reply)
            if not episode.over and episode.consulted is None:  # it is set where a replay ends
                self.update_all(episode, truncated=bool(actions) and episode.turns == episode.most_steps)
        except BaseException as error:
            episode.fail(error)
            raise
        if self.stalled == MANY_ROUNDS:
            warn_user(
                f"the simulation stands still: {short_repr(pending.name)} must decide, but {MANY_ROUNDS} rounds in a"
                ' row had no action for it; the info of the agent that must decide has "deciding": True'
            )

    def check(self, episode: Episode, actions: Mapping[str, Any]) -> dict[str, Any]:
        """Check the actions of a round before the simulation moves; return them in the form that mappings take."""
        pending, agents, checked = episode.pending, episode.agents, {}
        if pending is None:
            raise episode.refusal()
        if type(actions) is not dict and not isinstance(actions, Mapping):
            raise InvalidActionError(f"a round takes a dict of actions by agent, not {short_repr(actions)}")
        for name, action in actions.items():
            agent = agents.get(name)
            if agent is None:
                if any(name == ended.name for ended in self.ended_at_reset):
                    continue
                raise UnknownAgentError(
                    f"there is an action for {short_repr(name)}, which is not a live agent; live agents:"
                    f" {episode.agent_names()}"
                )
            if action is not RULE:
                check = agent.point.check
                legal = check(action)
                mask = agent.mask if agent is pending else None
                if legal is ILLEGAL or mask is not None:
                    legal = agent.point.checked(action, name, mask)
                action = legal
            checked[name] = action
        return checked

    def decide(self, agent: Agent, episode: Episode, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Answer a decision with the agent's action of this round, or wait for the next round."""
        if agent.point.legal is not None:
            agent.mask, agent.choices = agent.point.legal(args, kwargs)
        if agent.clock is not None:
            agent.read_clock()
        return self._use_action(episode, agent)

    def _use_action(self, episode: Episode, agent: Agent) -> Any:
        action = agent.only_action() if episode.skips else None
        if action is None:
            action = self.actions.pop(agent.name, MISSING)
            mask = agent.mask
            if action is MISSING or (mask is not None and action is not RULE and not agent.point.allows(mask, action)):
                episode.pending = agent
                return WAIT
            agent.acted = True
        episode.latest = agent
        if not agent.decided:  # it acts before it was ever updated
            agent.update(agent, agent.arguments(), agent.kwargs, observe=False)
        return episode.answer(agent, action, False)

    def update_all(self, episode: Episode, *, truncated: bool = False) -> None:
        """Reward and observe all live agents when a step or a reset returns. ``truncated``: The episode ends here."""
        following, episode.pending = episode.pending, None  # so that an action from inside a mapping is refused
        for agent, call in episode.announced().items():
            if agent is not following:
                agent.keep(episode, call, {})
        if truncated:
            episode.finish(truncated=True)
            return
        for agent in episode.agents.values():
            args = agent.arguments()
            if args is None:
                agent.clear_observation()
                continue
            episode.latest = agent
            update = agent.update  # a local variable: calling the attribute directly is slower
            update(agent, args, agent.kwargs)
            if episode.skips:
                agent.reward, agent.carried = agent.reward + agent.carried, 0.0
            if agent.choices is not None and agent is not following:
                agent.choices = None  # ``legal`` returns them again when the agent decides
        episode.pending = following
