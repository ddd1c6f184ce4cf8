"""Policies that are asked one decision at a time, because they ask for more than an observation and an info, or wait.

A *planner* has a keyword-only parameter ``_environment``, and gets the environment in which it
decides. A policy with ``_decision`` gets the pending ``Decision``. A policy that is a coroutine
function is awaited.

In copies of an environment, some policies are not asked themselves: see ``Where`` and
``policy_for``.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping
from enum import IntEnum
from functools import partial
from importlib import import_module
from typing import Any, Final

from ..errors import OptionValueError, short_repr
from ..simulation import RULE, asks_for, positional
from .awaiting import wait_for
from .pending import decision_of


class Where(IntEnum):
    """Where an episode is played.

    Each place asks fewer policies themselves than those before it.
    """

    USER = 0
    """In the user's environment: all policies."""

    CLONE = 1
    """In a clone or a branch: none that waits or records."""

    BRANCH = 2
    """In a branch that a policy has made of the environment that it gets: nor any that gets an environment, because two
    planners would ask each other without end."""

    PLAN = 3
    """In a branch in which a planner tries a candidate: as before, and planners answer by their base."""


ASKED: Final = ("_environment", "_decision")
"""The keyword-only parameters by which policies ask for more."""


def takes_info(policy: Callable[..., Any]) -> bool:
    """Return whether a policy takes the observation and the info, and not the observation alone."""
    parameters = positional(policy)
    return len(parameters) > 1 and (
        parameters[1].default is parameters[1].empty or parameters[1].name == "info"
    )


def is_planner(policy: Any) -> bool:
    """Return whether a policy has a keyword-only parameter ``_environment``."""
    return asks_for(policy, "_environment")


def waits(policy: Any) -> bool:
    """Return whether a policy is a coroutine function, or returns coroutines and says so by an attribute ``waits``."""
    while isinstance(policy, partial):
        policy = policy.func
    call = getattr(type(policy), "__call__", None)  # noqa: B004 - the function itself is needed
    is_coroutine = inspect.iscoroutinefunction(policy) or inspect.iscoroutinefunction(call)
    return is_coroutine or getattr(policy, "waits", False) is True


def is_asked_alone(policy: Any) -> bool:
    """Return whether a policy answers one decision at a time: see this module."""
    return is_planner(policy) or asks_for(policy, "_decision") or waits(policy)


def two_arguments(policy: Callable[..., Any]) -> Callable[[Any, Any], Any]:
    """Make a policy callable with observation and info, even if it takes no info, or asks for more."""
    if isinstance(policy, AskingPolicy):
        return policy
    if is_asked_alone(policy):
        return AskingPolicy(policy)
    return policy if takes_info(policy) else lambda observation, info: policy(observation)


def policy_for(policy: Any, agent: str, where: Where) -> Any:
    """Return what answers for a policy (or policies by agent): itself, the one that stands for it, or ``RULE``."""
    while policy is not RULE:
        if isinstance(policy, Mapping):
            policy = policy.get(agent, RULE)
        elif where >= Where.BRANCH and is_planner(policy):
            policy = getattr(policy, "base", RULE)
        elif where >= Where.CLONE and (waits(policy) or getattr(policy, "records", False) is True):
            policy = getattr(policy, "fallback", RULE)
        else:
            return policy
    return RULE


COUNTS: Final[dict[str, dict[str, float]]] = {}
"""What policies have counted in this process, by a token that their copies share.

Workers send it back.
"""


def count(token: str, **numbers: float) -> None:
    """Add numbers to what the policies with a token have counted."""
    counts = COUNTS.setdefault(token, {})
    for name, number in numbers.items():
        counts[name] = counts.get(name, 0) + number


def has_fallback(policy: Any) -> bool:
    """Return whether a policy counts fallbacks, or asks one that does."""
    while isinstance(policy, PolicyWrapper) and not policy.counts_fallbacks:
        policy = policy.policy
    return isinstance(policy, PolicyWrapper)


class Caller:
    """A policy with what it takes, which is found out once: that takes longer than most decisions.

    Attributes:
        policy: The policy.
        names: Which of ``ASKED`` it asks for.
    """

    def __init__(self, policy: Callable[..., Any]) -> None:
        self.policy, self._takes_info = policy, takes_info(policy)
        self.names = tuple(name for name in ASKED if asks_for(policy, name))

    def __call__(self, observation: Any, info: Any, asked: Mapping[str, Any]) -> Any:
        """Ask the policy, with what it asks for. Return its answer, or an awaitable."""
        seen = (observation, info) if self._takes_info else (observation,)
        return self.policy(*seen, **{name: asked[name] for name in self.names})


def when_answered(answer: Any, conclude: Callable[[Any], Any]) -> Any:
    """Return what a function makes of an answer; if that has to be awaited, an awaitable."""
    if not inspect.isawaitable(answer):
        return conclude(answer)

    async def wait() -> Any:
        return conclude(await answer)

    return wait()


class PolicyWrapper:
    """A policy that asks another policy, and itself asks for what that one asks for.

    Attributes:
        policy: The other policy, a callable.
        ask: Asks it: takes the observation, the info, and a dict of what may be asked for.
        waits: Whether that one has to be awaited.
        records: Whether that one records its answers.
        counts_fallbacks: Whether evaluations show how many of its answers come from a fallback.
    """

    counts_fallbacks = False

    def __init__(self, policy: Callable[..., Any], *, asks: Iterable[str] = ()) -> None:
        """Wrap a policy. ``asks``: what this one asks for besides."""
        if not callable(policy):
            raise OptionValueError(f"the policy must be a callable, not {short_repr(policy)}")
        self.policy, self.waits, self.ask = policy, waits(policy), Caller(policy)
        self.records: bool = getattr(policy, "records", False) is True
        names = [name for name in ASKED if name in (*self.ask.names, *asks)]
        seen = [
            inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD)
            for name in ("observation", "info")
        ]
        asked = [inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY) for name in names]
        self.__signature__ = inspect.Signature(seen + asked)


class EpisodePolicy:
    """The wrapper, in a plan, of a policy that is not just called with an observation and an info.

    Attributes:
        policy: The user's policy.
        waits: Whether it has to be awaited.
    """

    policy: Any
    waits = False
    answer: Any  # takes the episode, the agent, the observation and the info

    def __call__(self, observation: Any, info: Any) -> Any:
        """Refuse a call without an episode."""
        raise OptionValueError(
            f"the policy {short_repr(self.policy)} is asked for one decision of an environment at"
            " a time, and here there is no environment; pass the policy in policies="
        )


class DeferredPolicy(EpisodePolicy):
    """One that answers many decisions in one call.

    An episode waits for it as it waits for the user.
    """


class AskingPolicy(EpisodePolicy):
    """One that is asked alone.

    Attributes:
        plans, asks, waits: Whether it gets the environment, gets the decision, and has to be
            awaited.
    """

    def __init__(self, policy: Callable[..., Any]) -> None:
        self.policy, self._call = policy, Caller(policy)
        self.plans, self.asks = (name in self._call.names for name in ASKED)
        self.waits = waits(policy)
        if self.plans and self.waits:
            raise OptionValueError(
                f"the policy {short_repr(policy)} waits, and asks for _environment, which only the"
                " simulation's own thread can use; let it ask for _decision, or let it answer at"
                " once"
            )

    def answer(self, episode: Any, agent: Any, observation: Any, info: Any) -> Any:
        """Ask about the decision of an agent, and wait for the answer."""
        return wait_for(self.begin(episode, agent, observation, info))

    def begin(self, episode: Any, agent: Any, observation: Any, info: Any) -> Any:
        """Ask the policy, or what answers for it where the episode is played.

        Return the answer, or an awaitable.
        """
        policy = policy_for(self.policy, agent.name, episode.where)
        if policy is RULE:
            return RULE
        asked = self if policy is self.policy else two_arguments(policy)
        if not isinstance(asked, AskingPolicy):
            return asked(observation, info)
        return asked.ask(episode, agent, observation, info)

    def ask(self, episode: Any, agent: Any, observation: Any, info: Any) -> Any:
        """Ask the policy itself. Return its answer, or an awaitable."""
        asked: dict[str, Any] = {}
        if self.plans:
            session = episode.session()
            # by name, because views import the core
            views = import_module("..envs.single", __package__)
            asked["_environment"] = views.PlannerEnv(session.plan, session)
        if self.asks:
            asked["_decision"] = decision_of(episode, agent)
        return self._call(observation, info, asked)
