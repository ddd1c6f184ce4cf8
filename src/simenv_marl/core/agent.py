"""One agent of an episode: how its decisions are handled, and how it is rewarded and observed."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from math import isfinite
from numbers import Real
from typing import TYPE_CHECKING, Any, Final
from weakref import ref

import numpy as np
from greenlet import getcurrent

from ..errors import MaskError, RewardError, short_repr
from ..hooks.stacks import DIFFERENCES, EVALUATING
from ..simulation import RULE, Sentinel
from .actions import MASK
from .bound import BoundPoint, DeferredPolicy
from .planner import PlannerPolicy
from .spaces import duplicate

if TYPE_CHECKING:
    from .episode import Episode

WAIT: Final = Sentinel("WAIT")
"""Returned instead of a reply to the simulation if the episode waits for an action, or is over."""

_NOTHING: Final[dict[str, Any]] = {}
"""The keyword arguments of calls without any. Nothing writes to this dict."""


class Agent:
    """One agent of an episode.

    Attributes:
        name: The name.
        point: The decision point at which the agent decides.
        policy: The policy that answers the agent's decisions. None: the environment's user answers them.
        deferred: Whether that policy answers many decisions at once, so that the episode waits for it.
        looks: Whether that policy gets the environment.
        consultations: How many of the agent's decisions were put to a policy that gets the environment.
        clock: Returns the simulation's time. None if the simulation has no time.
        settle: Rewards and observes the agent: see ``settling``.
        settle_again: Does the same for an agent that has decided before.
        decided: Whether the reward mapping was called in this episode. Its first value is dropped.
        acted: Whether the latest round used an action that the user gave for the agent.
        ended: Whether the agent's episode ended before the simulation's.
        led: Whether the environment's user no longer answers the agent's decisions.
        present: Whether the latest info comes from an observation. False if there was nothing to observe.
        reward: The reward of the agent's previous action, as of its latest decision or its end.
        asked: Whether the user was asked for an action in this episode. Used where forced moves are skipped.
        carried: The sum of the rewards of forced moves. It is added to the agent's next reward.
        observation: The latest observation, cast to its space. None before the first one.
        handed_out: The observation that a view has returned and must not return a second time.
        info: The info of the latest decision. The dict is the agent's own.
        mask, choices: The legal actions of the pending decision, if the decision point restricts them.
        offered: The choices of the latest decision, among which the rule's decision is looked up.
        rule_action: The action that corresponds to the rule's latest decision. None if it is not known.
        memory: The values that ``difference`` remembers for the agent.
        plugins: The plugins of the environment. None if it has none.
        now, answered_at: The times of the latest decision and of the one before.
        entity, rest, kwargs: The arguments of the latest decision: see ``keep``.
        tells: Whether the next info contains ``rule_action``.
        group, notes: Used by runners of many episodes.
    """

    __slots__ = (
        "acted", "answered_at", "asked", "carried", "choices", "clock", "consultations", "decided", "deferred", "ended",
        "entity", "group", "handed_out", "info", "kwargs", "led", "looks", "mask", "memory", "name", "notes", "now",
        "observation", "offered", "plugins", "point", "policy", "present", "rest", "reward", "rule_action", "settle",
        "settle_again", "tells",
    )  # fmt: skip

    def __init__(
        self, name: str, point: BoundPoint, policy: Any, clock: Callable[[], float] | None, plugins: Any
    ) -> None:
        self.name, self.point, self.clock = name, point, clock
        self.follow(policy)
        self.consultations = 0
        self.settle = self.settle_again = point.settle
        self.plugins = plugins
        self.asked = self.decided = self.acted = self.ended = self.led = self.present = self.tells = False
        self.reward = self.carried = 0.0
        self.observation: Any = None
        self.handed_out: Any = None
        self.info: dict[str, Any] = {}
        self.mask: Any = None
        self.choices: Any = None
        self.offered: Any = None
        self.rule_action: Any = None
        self.memory: dict[Any, Any] = {}
        self.group: Any = None
        self.notes: Any = None
        self.now: float | None = None
        self.answered_at: float | None = None
        self.entity: Any = None
        self.rest: tuple[Any, ...] | None = None
        self.kwargs: dict[str, Any] = _NOTHING

    def follow(self, policy: Any) -> None:
        """Let a policy answer the agent's decisions. None: the environment's user answers them."""
        self.policy = policy
        self.deferred, self.looks = isinstance(policy, DeferredPolicy), isinstance(policy, PlannerPolicy)

    # -- the arguments of its decision ------------------------------------------------------------

    def keep(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> bool:
        """Keep the arguments of a decision.

        At an entity-level point the first argument is the entity. It is held by a weak reference if it supports one,
        so that the model can free it. While the decision is pending, the simulation holds it.

        Returns:
            Whether the entity is a different one than before.
        """
        before, self.entity, self.rest, self.kwargs = self.entity, None, args, kwargs
        if not args or self.point.agent is not None:
            return False
        with suppress(TypeError):  # not every object supports weak references
            self.entity, self.rest = ref(args[0]), args[1:]
        return self.entity is None or self.entity is not before

    def arguments(self) -> tuple[Any, ...] | None:
        """The positional arguments of the latest decision; None if there was none, or if the entity is gone."""
        if self.entity is None:
            return self.rest
        first = self.entity()
        return None if first is None else (first, *self.rest)  # type: ignore[misc]

    def release(self) -> None:
        """Release the arguments. The agent has nothing more to observe."""
        self.entity = self.rest = self.answered_at = None
        self.kwargs = _NOTHING

    # -- decisions --------------------------------------------------------------------------------

    @property
    def deliver(self) -> Callable[..., Any] | None:
        """Turns a reply into the value that the decision function returns: see ``BoundPoint``."""
        return self.point.deliver

    @property
    def told(self) -> Any:
        """The event that reports what the rule decides: see ``BoundPoint``."""
        return self.point.told

    def arise(self, episode: Episode, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Handle a decision: settle the agent and wait for an action, or do what the episode does instead.

        If the decision point has no other agent, the agent itself is the event that the simulation sends.
        """
        point = self.point
        if point.agent is None:
            entity = self.entity
            if entity is not None and args and entity() is args[0]:
                self.rest, self.kwargs = args[1:], kwargs
            elif self.keep(args, kwargs):
                episode.remember(self, args[0])
        elif self.led:
            return episode.dispatch(point, self.name, args, kwargs)
        else:
            if point.one_entity and args and self.rest and self.rest[0] is not args[0]:
                point.warn_of_several(self.name)
            self.rest, self.kwargs = args, kwargs  # a strong reference: the first argument is no entity of the model
        episode.latest = self
        decide = episode.decide
        if decide is not None:  # in a round, after the last step, or where forced moves are skipped
            return decide(episode, self, args, kwargs)
        settle = self.settle_again  # a local variable: calling the attribute directly is slower
        settle(self, args, kwargs)
        episode.pending = self
        return WAIT

    def choose(self, action: Any) -> Any:
        """Return the choice that a checked action stands for, in a list of one; return ``RULE`` unchanged."""
        choices, self.choices = self.choices, None
        if self.point.recorded:
            self.offered = choices
        return action if action is RULE else [choices[action]]

    # -- infos ------------------------------------------------------------------------------------

    def inform(self) -> dict[str, Any]:
        """Make the info of an observation: the time, the action mask and the rule's action."""
        info: dict[str, Any] = {} if self.clock is None else self.tell_time()
        mask = self.mask
        if mask is not None:
            info[MASK] = mask.copy() if type(mask) is np.ndarray else duplicate(mask)
        if self.tells:
            action = self.rule_action
            info["rule_action"] = action if type(action) is int else duplicate(action)
            self.tells = False
        return info

    def unsee(self) -> None:
        """Set the reward to 0.0, and the info to that of an agent with nothing to observe and all actions legal."""
        self.reward, self.present = 0.0, False
        self.info = {} if self.clock is None else self.tell_time()
        if self.point.legal is not None:
            self.info[MASK] = self.point.open_mask()

    def tell_time(self) -> dict[str, Any]:
        """Note the time. Return it, and the time elapsed since the agent's previous decision, as an info."""
        clock: Any = self.clock
        time, before = clock(), self.answered_at
        self.now = now = time if type(time) is float else float(time)
        return {"time": now, "elapsed": 0.0 if before is None else now - before}


Settle = Callable[..., None]
"""``settle(agent, args, kwargs, reward=True, observe=True, last=False)``: see ``settling``."""


def settling(point: BoundPoint) -> tuple[Settle, Settle]:
    """Make the functions that reward and observe the agents of a decision point.

    Returns:
        Two functions. Both take the agent, and the positional and keyword arguments of the call of the decision
        function. The first also takes three flags: whether to reward, whether to observe, and whether this is the
        agent's end. The second is for agents that have decided before, and skips what the point does not need.
        Both raise ``RewardError``, ``ObservationError`` and ``MaskError``.
    """
    reward_mapping, observation_mapping, cast = point.reward_mapping, point.observation_mapping, point.cast
    legal, masked = point.legal, bool(point.masked_parts)
    quiet = legal is None and not point.tells

    def settle(
        agent: Agent,
        args: tuple[Any, ...],
        kwargs: dict[str, Any],
        reward: bool = True,
        observe: bool = True,
        last: bool = False,
    ) -> None:
        here = getcurrent() if DIFFERENCES else None
        if here is not None:
            before, EVALUATING[here] = EVALUATING.get(here), agent
        try:
            if reward and agent.decided:
                value = reward_mapping(*args, **kwargs) if kwargs else reward_mapping(*args)
                agent.reward = checked_reward(agent, value)
            elif reward and not last:  # the agent has not acted yet, so this value rewards nothing
                reward_mapping(*args, **kwargs)
                agent.decided, agent.settle_again = True, again
            if observe:
                first, agent.present = not agent.present, True
                if legal is not None:
                    agent.mask, agent.choices = _legal_at_end(point, args, kwargs) if last else legal(args, kwargs)
                agent.info = {} if quiet and agent.clock is None else agent.inform()
                if masked:
                    agent.observation = point.observe(args, kwargs, agent.mask)
                else:
                    seen = observation_mapping(*args, **kwargs) if kwargs else observation_mapping(*args)
                    agent.observation = cast(seen)
                if first and point.finite is not None:
                    point.finite(agent.observation)
        finally:
            if here is not None:
                if before is None:  # without a function call, which could fail at the recursion limit
                    del EVALUATING[here]
                else:
                    EVALUATING[here] = before

    def settle_quietly(agent: Agent, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        here = getcurrent() if DIFFERENCES else None
        if here is not None:
            before, EVALUATING[here] = EVALUATING.get(here), agent
        try:
            reward = reward_mapping(*args, **kwargs) if kwargs else reward_mapping(*args)
            if type(reward) is not float or reward - reward != 0.0:  # spares nearly all rewards the call
                reward = checked_reward(agent, reward)
            agent.reward = reward
            agent.info = {} if agent.clock is None else agent.tell_time()
            agent.observation = cast(observation_mapping(*args, **kwargs) if kwargs else observation_mapping(*args))
        finally:
            if here is not None:
                if before is None:  # without a function call, which could fail at the recursion limit
                    del EVALUATING[here]
                else:
                    EVALUATING[here] = before

    again = settle_quietly if quiet and not masked else settle
    return settle, again


def _legal_at_end(point: BoundPoint, args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[Any, Any]:
    """Find the legal actions at the agent's end: it will not be asked again, so no action needs to be legal."""
    legal: Any = point.legal
    try:
        return legal(args, kwargs)  # type: ignore[no-any-return]
    except MaskError:
        return point.open_mask(), None


def checked_reward(agent: Agent, reward: Any) -> float:
    """Convert a reward to a Python float.

    Raises:
        RewardError: The reward is not one finite number.
    """
    value = reward.item() if isinstance(reward, np.ndarray) and reward.size == 1 else reward
    if not isinstance(value, (Real, np.bool_)):
        raise RewardError(f"the reward {short_repr(reward)} is not one number")
    try:
        value = float(value)
    except OverflowError:
        raise RewardError(f"the reward {short_repr(reward)} is too large for a float") from None
    if not isfinite(value):
        raise RewardError(f"the reward of {agent.name!r} is {value}, which is not finite")
    return value
