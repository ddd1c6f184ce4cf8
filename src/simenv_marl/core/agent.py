"""What an episode knows of one agent, and how an agent is rewarded and observed."""

from __future__ import annotations

from collections.abc import Callable
from numbers import Real
from threading import get_ident
from typing import Any
from weakref import ref

import numpy as np

from ..decision import DIFFERENCES
from ..errors import MaskError, RewardError
from . import spaces as _spaces
from .bindings import Binding
from .switch import EVALUATING


class Record:
    """What an episode knows of one agent.

    Attributes:
        clock: Returns the simulation's time; None where it has none.
        agent: Its name.
        binding: The decision point where it decides.
        policy: Who answers for it; None: the environment's user.
        decided: Whether a reward has been asked for it in this episode: the first one is dropped.
        acted: Whether an action of its user was used in the latest round.
        ended: Whether its episode has ended before the simulation's.
        news: Whether the next info is to tell of ``rule_action``.
        handed_out: The observation that a view has given away, and which is not to be given away again.
        followed_up: Whether something is to be done when its decision is answered.
        observation: Its latest observation, cast to its space; None before it was ever observed.
        reward: The reward of its action before, as of its latest decision or its end.
        info: The info of its latest decision, a dict of its own.
        mask, choices: The legal actions of its pending decision, where its point restricts them.
        offered: The choices of its latest decision, where somebody wants to know which of them the rule has taken.
        rule_action: The action that its latest decision by the rule corresponds to; None if that is not known.
        memory: What differences remember for it.
    """

    __slots__ = (
        "_args", "_kwargs", "_now", "_time", "_weakly", "acted", "agent", "binding", "choices", "clock", "decided",
        "ended", "followed_up", "handed_out", "info", "mask", "memory", "news", "observation", "offered", "policy",
        "reward", "rule_action",
    )  # fmt: skip

    def __init__(self, agent: str, binding: Binding, policy: Any, clock: Callable[[], float] | None) -> None:
        self.agent = agent
        self.binding = binding
        self.policy = policy
        self.clock = clock
        self.decided = self.acted = self.ended = False
        self._time: float | None = None
        self._now: float | None = None
        self.followed_up = clock is not None or binding.definition.choices is not None
        self.observation: Any = None
        self.reward = 0.0
        self.handed_out: Any = None
        self.info: dict[str, Any] = {}
        self.mask: Any = None
        self.choices: Any = None
        self.offered: Any = None
        self.rule_action: Any = None
        self.news = False
        self.memory: dict[Any, Any] = {}
        self._args: tuple[Any, ...] | None = None
        self._kwargs: dict[str, Any] = {}
        self._weakly: Any = None

    def follow_up(self) -> None:
        """See to what is to be done when its decision is answered, if ``followed_up``."""
        self._time = self._now
        if self.binding.ruled is not None:
            self.offered = self.choices
        self.choices = None

    def decided_by_rule(self, decision: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        """Find out which action a decision of the rule corresponds to. The arguments are those of the call.

        Raises:
            InvalidActionError: That is no action.
        """
        offered, self.offered = self.offered, None
        assert self.binding.ruled is not None
        self.rule_action = self.binding.ruled.action(decision, args, kwargs, offered)
        self.news = self.binding.definition.rule_action_mapping is not None and self.rule_action is not None

    def arguments(self) -> tuple[tuple[Any, ...], dict[str, Any]] | None:
        """The arguments of the latest decision; None where there are none any more."""
        args = self._args
        if args and self._weakly is not None and args[0] is self._weakly:
            first = self._weakly()
            return None if first is None else ((first, *args[1:]), self._kwargs)
        return None if args is None else (args, self._kwargs)

    def hold(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        """Keep the arguments of a decision.

        The first one of an entity-level point is kept weakly where it can be, so that the model can let go of
        the entity. While its decision is pending, the simulation holds it.
        """
        self._args, self._kwargs = args, kwargs
        if args and self.binding.agent is None:
            first, weakly = args[0], self._weakly
            if weakly is None or weakly() is not first:
                try:
                    self._weakly = weakly = ref(first)
                except TypeError:
                    self._weakly = None
                    return
            self._args = (weakly,) if len(args) == 1 else (weakly, *args[1:])

    def forget(self) -> None:
        """Let go of the arguments; the agent has no more to observe."""
        self._args = self._weakly = self._time = None
        self._kwargs = {}

    def settle(self, args: tuple[Any, ...], kwargs: dict[str, Any], *, last: bool = False) -> None:
        """Reward the agent's action before, then observe what it decides on now, or what it ended with.

        Args:
            args: The arguments of the call that is decided on.
            kwargs: Those passed by keyword.
            last: Whether this is the agent's end, and nothing is decided any more.

        Raises:
            RewardError: The reward is not one finite number.
            ObservationError: The observation does not fit its space.
            MaskError: The mask does not fit the action space.
        """
        if self.decided:
            if DIFFERENCES:
                EVALUATING[get_ident()] = self.memory
            reward_mapping = self.binding.reward
            reward = reward_mapping(*args, **kwargs) if kwargs else reward_mapping(*args)
            if type(reward) is not float:
                reward = number(reward)
            if reward - reward != 0.0:
                raise not_finite(self, reward)
            self.reward = reward
        elif not last:
            self.join(args, kwargs)
        self.observe(args, kwargs, last=last)

    def join(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        """Ask for the first reward, which is dropped: nothing was done yet that could be rewarded."""
        if DIFFERENCES:
            EVALUATING[get_ident()] = self.memory
        reward_mapping = self.binding.reward
        reward_mapping(*args, **kwargs)
        if DIFFERENCES:
            EVALUATING.pop(get_ident(), None)
        self.decided = True

    def observe(self, args: tuple[Any, ...], kwargs: dict[str, Any], *, last: bool = False) -> None:
        """Find out the legal actions and the time, and observe. The arguments are those of ``settle``."""
        binding = self.binding
        if DIFFERENCES:
            EVALUATING[get_ident()] = self.memory
        if binding.legal is None and self.clock is None and not binding.tells:
            cast, observe = binding.cast, binding.observe
            self.observation = cast(observe(*args, **kwargs) if kwargs else observe(*args))
            self.info = {}
        else:
            self.info = info = {}
            self.restrict(args, kwargs, last=last)
            if self.mask is not None:
                info[_spaces.MASK] = _spaces.duplicate(self.mask)
            if self.clock is not None:
                info |= self._passed(self.clock())
            if binding.padded:
                info["present"] = True
            if self.news:
                info["rule_action"], self.news = _spaces.duplicate(self.rule_action), False
            self.observation = binding.observation(args, kwargs, self.mask)
        if DIFFERENCES:
            EVALUATING.pop(get_ident(), None)

    def unseen(self) -> dict[str, Any]:
        """Make the info of an agent that cannot be observed: that of any other of its point, with all actions legal."""
        info: dict[str, Any] = {"present": False} if self.binding.padded else {}
        if self.binding.legal is not None:
            info[_spaces.MASK] = _spaces.open_mask(self.binding.definition.action_space)
        return info if self.clock is None else info | self._passed(self.clock())

    def arise(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        """Find out what must be known of a decision in mid-round. The arguments are those of ``settle``."""
        self.restrict(args, kwargs)
        if self.clock is not None:
            self._now = float(self.clock())

    def restrict(self, args: tuple[Any, ...], kwargs: dict[str, Any], *, last: bool = False) -> None:
        """Find out the legal actions. The arguments are those of ``settle``."""
        if self.binding.legal is None:
            return
        try:
            self.mask, self.choices = self.binding.legal(args, kwargs)
        except MaskError:
            if not last:
                raise
            # Nothing is asked any more, and so nothing needs to be legal.
            self.mask, self.choices = _spaces.open_mask(self.binding.definition.action_space), None

    def _passed(self, time: Any) -> dict[str, float]:
        """The simulation's time, and how much of it has gone by since the agent's decision before."""
        self._now = now = float(time)
        return {"time": now, "elapsed": 0.0 if self._time is None else now - self._time}


def number(reward: Any) -> float:
    """A reward as a python float.

    Raises:
        RewardError: It is not one number.
    """
    value = reward.item() if isinstance(reward, np.ndarray) and reward.size == 1 else reward
    if not isinstance(value, (Real, np.bool_)):
        raise RewardError(f"the reward {reward!r} is not one number")
    try:
        return float(value)
    except OverflowError:
        raise RewardError(f"the reward {reward!r} is too large for a float") from None


def not_finite(record: Record, reward: float) -> RewardError:
    """The error that says whose reward is infinite or no number."""
    return RewardError(f"the reward of {record.agent!r} is {reward}, which is not finite")
