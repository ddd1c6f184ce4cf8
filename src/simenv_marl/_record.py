"""What an episode knows of one agent, and how an agent is rewarded and observed."""

from __future__ import annotations

from numbers import Real
from threading import get_ident
from typing import Any
from weakref import ref

import numpy as np

from . import _spaces
from ._driver import EVALUATING
from ._plan import Binding
from .errors import MaskError, RewardError


class Record:
    """What an episode knows of one agent.

    Attributes:
        agent: Its name.
        binding: The decision point where it decides.
        policy: Who answers for it; None: the environment's user.
        decided: Whether it has decided in this episode.
        observation: Its latest observation, cast to its space; None before it was ever observed.
        reward: The reward of its action before, as of its latest decision or its end.
        info: The info of its latest decision, a dict of its own.
        mask, choices: The legal actions of its pending decision, where its point restricts them.
        memory: What differences remember for it.
    """

    __slots__ = (
        "_args", "_kwargs", "_weakly", "agent", "binding", "choices", "decided", "info", "mask", "memory",
        "observation", "policy", "reward",
    )  # fmt: skip

    def __init__(self, agent: str, binding: Binding, policy: Any) -> None:
        self.agent = agent
        self.binding = binding
        self.policy = policy
        self.decided = False
        self.observation: Any = None
        self.reward = 0.0
        self.info: dict[str, Any] = {}
        self.mask: Any = None
        self.choices: Any = None
        self.memory: dict[Any, Any] = {}
        self._args: tuple[Any, ...] | None = None
        self._kwargs: dict[str, Any] = {}
        self._weakly: Any = None

    def loosen(self) -> None:
        """Keep the first argument weakly from now on, so that the model can let go of an entity."""
        args = self._args
        if args:
            first = args[0]
            if self._weakly is None or self._weakly() is not first:
                try:
                    self._weakly = ref(first)
                except TypeError:  # cannot be held weakly
                    self._weakly = None
                    return
            self._args = (self._weakly, *args[1:])

    def arguments(self) -> tuple[tuple[Any, ...], dict[str, Any]] | None:
        """The arguments of the latest decision; None where there are none any more."""
        args = self._args
        if args and self._weakly is not None and args[0] is self._weakly:
            first = self._weakly()
            return None if first is None else ((first, *args[1:]), self._kwargs)
        return None if args is None else (args, self._kwargs)

    def forget(self) -> None:
        """Let go of the arguments; the agent has no more to observe."""
        self._args = self._weakly = None
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
        binding = self.binding
        reward_mapping, observe, cast = binding.reward, binding.observe, binding.cast
        EVALUATING[get_ident()] = self.memory
        if self.decided:
            reward = reward_mapping(*args, **kwargs) if kwargs else reward_mapping(*args)
            if type(reward) is not float:
                reward = number(reward)
            if reward - reward != 0.0:
                raise not_finite(self, reward)
            self.reward = reward
        elif not last:
            reward_mapping(*args, **kwargs)  # nothing was done yet that could be rewarded
            self.decided = True
        if binding.legal is None:
            self.observation = cast(observe(*args, **kwargs) if kwargs else observe(*args))
            del EVALUATING[get_ident()]
            self.info = {}
        else:
            self.observe(args, kwargs, last=last)

    def observe(self, args: tuple[Any, ...], kwargs: dict[str, Any], *, last: bool = False) -> None:
        """Find out the legal actions, and observe. The arguments are those of ``settle``."""
        binding = self.binding
        EVALUATING[get_ident()] = self.memory
        mask = choices = None
        info: dict[str, Any] = {}
        if binding.legal is not None:
            try:
                mask, choices = binding.legal(args, kwargs)
            except MaskError:
                if not last:
                    raise
                mask = _spaces.open_mask(binding.definition.action_space)  # nothing is asked any more
            info[_spaces.MASK] = _spaces.duplicate(mask)
        self.observation = binding.observation(args, kwargs, mask)
        del EVALUATING[get_ident()]
        self.mask, self.choices, self.info = mask, choices, info


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
