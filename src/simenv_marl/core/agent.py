"""What an episode knows of one agent: what becomes of its decisions, how it is rewarded and observed."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from math import isfinite
from numbers import Real
from typing import TYPE_CHECKING, Any, Final
from weakref import ref

import numpy as np
from greenlet import getcurrent

from ..errors import MaskError, RewardError, shown
from ..hooks.stacks import DIFFERENCES, EVALUATING
from ..simulation import RULE, Sentinel
from .actions import MASK
from .asking import AskingPolicy
from .bound import BoundPoint, DeferredPolicy
from .spaces import duplicate

if TYPE_CHECKING:
    from .episode import Episode

WAIT: Final = Sentinel("WAIT")
"""Returned in place of a reply to the simulation: the episode waits for an action, or is over."""

_NOTHING: Final[dict[str, Any]] = {}
"""The keyword arguments of calls that have none. It is only ever unpacked."""


class Agent:
    """What an episode knows of one agent.

    Attributes:
        name: Its name.
        point: The decision point at which it decides.
        policy: The policy that answers for it; None: the environment's user.
        deferred: Whether that policy answers many decisions at once, and so an episode waits for it.
        looks: Whether that policy is given the environment.
        consultations: How often such a policy was asked at once.
        clock: Returns the simulation's time; None where it has none.
        settle: Rewards and observes the agent: see ``settling``.
        settle_again: The same once it has decided before.
        decided: Whether its reward mapping was asked in this episode; the first value is dropped.
        acted: Whether an action of its user was used in the latest round.
        ended: Whether its episode has ended before the simulation's.
        led: Whether its decisions are none of its user's any more.
        present: Whether its latest info comes from an observation; False where there was nothing to observe.
        reward: The reward of its action before, as of its latest decision or its end.
        asked: Whether its user was asked for an action in this episode, where forced moves are skipped.
        carried: The rewards of its forced moves that its next reward is to tell.
        observation: Its latest observation, cast to its space; None before its first observation.
        handed_out: The observation that a view has given away, and which is not to be given away again.
        info: The info of its latest decision, a dict of its own.
        mask, choices: The legal actions of its pending decision, where its point restricts them.
        offered: The choices of its latest decision, where the rule's decision is to be found among them.
        rule_action: The action that its latest decision by the rule corresponds to; None if that is not known.
        memory: What differences remember for it.
        plugins: The plugins of its environment; None if it has none.
        now, answered_at: The time of its latest decision, and of the decision before.
        entity, rest, kwargs: The arguments of its latest decision: see ``keep``.
        tells: Whether its next info tells of ``rule_action``.
        group, notes: What a runner of many episodes keeps of it.
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
        """Have a policy answer for it; None: the environment's user."""
        self.policy = policy
        self.deferred, self.looks = isinstance(policy, DeferredPolicy), isinstance(policy, AskingPolicy)

    # -- the arguments of its decision ------------------------------------------------------------

    def keep(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> bool:
        """Keep the arguments of a decision.

        The first one of an entity-level point is kept weakly where it can be, so that the model can let go of the
        entity. While its decision is pending, the simulation holds it.

        Returns:
            Whether the entity is another one than before.
        """
        before, self.entity, self.rest, self.kwargs = self.entity, None, args, kwargs
        if not args or self.point.agent is not None:
            return False
        with suppress(TypeError):  # what cannot be referred to weakly
            self.entity, self.rest = ref(args[0]), args[1:]
        return self.entity is None or self.entity is not before

    def arguments(self) -> tuple[Any, ...] | None:
        """The positional arguments of the latest decision; None where there was none, or the entity is gone."""
        if self.entity is None:
            return self.rest
        first = self.entity()
        return None if first is None else (first, *self.rest)  # type: ignore[misc]

    def release(self) -> None:
        """Let go of the arguments; the agent has no more to observe."""
        self.entity = self.rest = self.answered_at = None
        self.kwargs = _NOTHING

    # -- what becomes of a decision ---------------------------------------------------------------

    @property
    def deliver(self) -> Callable[..., Any] | None:
        """Turns a reply into what a call of its decision function returns: see ``BoundPoint``."""
        return self.point.deliver

    @property
    def told(self) -> Any:
        """The event that tells what its rule decides: see ``BoundPoint``."""
        return self.point.told

    def arise(self, episode: Episode, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Decide: be settled, and wait for an action; or do what is to be done in its stead.

        Where its point has no other agent, the agent itself is the event that crosses from the simulation.
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
            self.rest, self.kwargs = args, kwargs  # what it is called on is no entity that a model would let go
        episode.latest = self
        decide = episode.decide
        if decide is not None:  # in a round, or when the last step has been taken
            return decide(episode, self, args, kwargs)
        settle = self.settle_again  # fetched before it is called: calling it at its attribute is slower
        settle(self, args, kwargs)
        episode.pending = self
        return WAIT

    def choose(self, action: Any) -> Any:
        """Turn a checked action into the choice that it stands for, in a box, or leave it to ``RULE``."""
        choices, self.choices = self.choices, None
        if self.point.recorded:
            self.offered = choices
        return action if action is RULE else [choices[action]]

    # -- infos ------------------------------------------------------------------------------------

    def inform(self) -> dict[str, Any]:
        """Make the info of an observation: the time, the mask, the rule's action."""
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
        """Have nothing to observe: no reward, and the info of any other agent of its point with all actions legal."""
        self.reward, self.present = 0.0, False
        self.info = {} if self.clock is None else self.tell_time()
        if self.point.legal is not None:
            self.info[MASK] = self.point.open_mask()

    def tell_time(self) -> dict[str, Any]:
        """The simulation's time, and how much of it has gone by since the agent's decision before."""
        clock: Any = self.clock
        time, before = clock(), self.answered_at
        self.now = now = time if type(time) is float else float(time)
        return {"time": now, "elapsed": 0.0 if before is None else now - before}


Settle = Callable[..., None]
"""``settle(agent, args, kwargs, reward=True, observe=True, last=False)``: see ``settling``."""


def settling(point: BoundPoint) -> tuple[Settle, Settle]:
    """Make what rewards and observes the agents of a decision point.

    Returns:
        Two functions of the agent, and of the arguments of the call that is decided on: positional, and by keyword. The
        first takes three flags besides: whether it rewards, whether it observes, and whether this is the agent's end.
        The second is for agents that have decided before; it leaves out what the point does not need. Both raise
        ``RewardError``, ``ObservationError`` and ``MaskError``.
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
                if type(value) is not float or value - value != 0.0:
                    value = checked_reward(agent, value)
                agent.reward = value
            elif reward and not last:  # nothing was done yet that could be rewarded
                reward_mapping(*args, **kwargs)
                agent.decided, agent.settle_again = True, again
            if observe:
                first, agent.present = not agent.present, True
                if legal is not None:
                    try:
                        agent.mask, agent.choices = legal(args, kwargs)
                    except MaskError:
                        if not last:
                            raise
                        # At its end an agent is asked nothing more, and so nothing needs to be legal.
                        agent.mask, agent.choices = point.open_mask(), None
                agent.info = {} if quiet and agent.clock is None else agent.inform()
                if masked:
                    agent.observation = point.observe(args, kwargs, agent.mask)
                else:
                    agent.observation = cast(
                        observation_mapping(*args, **kwargs) if kwargs else observation_mapping(*args)
                    )
                if first and point.finite is not None:
                    point.finite(agent.observation)
        finally:
            if here is not None:
                if before is None:  # no function is called: at the end of the stack none might run
                    del EVALUATING[here]
                else:
                    EVALUATING[here] = before

    def settle_quietly(agent: Agent, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        here = getcurrent() if DIFFERENCES else None
        if here is not None:
            before, EVALUATING[here] = EVALUATING.get(here), agent
        try:
            reward = reward_mapping(*args, **kwargs) if kwargs else reward_mapping(*args)
            if type(reward) is not float or reward - reward != 0.0:
                reward = checked_reward(agent, reward)
            agent.reward = reward
            agent.info = {} if agent.clock is None else agent.tell_time()
            agent.observation = cast(observation_mapping(*args, **kwargs) if kwargs else observation_mapping(*args))
        finally:
            if here is not None:
                if before is None:  # no function is called: at the end of the stack none might run
                    del EVALUATING[here]
                else:
                    EVALUATING[here] = before

    again = settle_quietly if quiet and not masked else settle
    return settle, again


def checked_reward(agent: Agent, reward: Any) -> float:
    """A reward as a python float.

    Raises:
        RewardError: It is not one finite number.
    """
    value = reward.item() if isinstance(reward, np.ndarray) and reward.size == 1 else reward
    if not isinstance(value, (Real, np.bool_)):
        raise RewardError(f"the reward {shown(reward)} is not one number")
    try:
        value = float(value)
    except OverflowError:
        raise RewardError(f"the reward {shown(reward)} is too large for a float") from None
    if not isfinite(value):
        raise RewardError(f"the reward of {agent.name!r} is {value}, which is not finite")
    return value
