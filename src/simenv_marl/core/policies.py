"""Policies that are asked one decision at a time, because they ask for more than an observation and an info, or wait.

A *planner* has a keyword-only parameter ``_environment``, and gets the environment in which it decides. A policy with
``_decision`` gets the pending ``Decision``. A policy that is a coroutine function is awaited.

In branches of an environment, and where a planner tries a candidate, no policy gets an environment, because two
planners would ask each other without end. There the planner's attribute ``base`` answers, or the rule if it has none.
In clones, no policy that waits or records is asked: its attribute ``fallback`` answers, or the rule.
"""

from __future__ import annotations

import copy
import inspect
from collections.abc import Callable, Iterable, Mapping
from contextvars import ContextVar
from functools import partial
from importlib import import_module
from typing import Any, Final
from weakref import ref

from ..errors import OptionValueError, short_repr
from ..simulation import RULE, asks_for, positional
from .awaiting import wait_for
from .pending import decision_of

PLANNING: Final[ContextVar[bool]] = ContextVar("simenv_marl.planning", default=False)
"""Whether this code runs in a branch in which a planner tries a candidate action."""

ASKED: Final = ("_environment", "_decision")
"""The keyword-only parameters by which policies ask for more."""


def takes_info(policy: Callable[..., Any]) -> bool:
    """Return whether a policy takes the observation and the info, and not the observation alone."""
    parameters = positional(policy)
    return len(parameters) > 1 and (parameters[1].default is parameters[1].empty or parameters[1].name == "info")


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


def base_of(base: Any, agent: str) -> Any:
    """Find the base of an agent, which is ``RULE`` or a policy, in a base, a dict of these by agent, or a planner."""
    while True:
        if isinstance(base, Mapping):
            base = base.get(agent, RULE)
        elif hasattr(base, "base") and is_planner(base):
            base = base.base
        else:
            return base


def stand_in(policy: Any) -> Any:
    """Return what answers for a policy in clones: ``RULE`` or another policy for those that wait or record."""
    while waits(policy) or getattr(policy, "records", False) is True:
        policy = getattr(policy, "fallback", RULE)
    return policy


COUNTS: Final[dict[str, dict[str, float]]] = {}
"""What policies have counted in this process, by a token that their copies share. Workers send it back."""


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


def policy_in_branch(policy: Any, agent: str, episode: Any) -> Callable[[Any, Any], Any]:
    """Return what answers for a policy in the episode of a branch, as a callable of observation and info."""
    base = stand_in(base_of(policy, agent))
    if is_planner(base) or not callable(base):
        return lambda observation, info: RULE
    asked = two_arguments(base)
    if not isinstance(asked, AskingPolicy):
        return asked
    return lambda observation, info: asked.ask(observation, info, episode, episode.deciding, None, in_clone=True)


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
        seen = [inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD) for name in ("observation", "info")]
        asked = [inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY) for name in names]
        self.__signature__ = inspect.Signature(seen + asked)


class DeferredPolicy:
    """A policy that answers many decisions in one call. An episode waits for it as it waits for the user."""

    waits = False  # whether it has to be awaited

    alone: Any  # a method of episode and agent: answers at once, in a branch that waits for one agent only


class AskingPolicy:
    """The wrapper, in a plan, of a policy that is asked alone. Other policies have none, and so cost nothing extra.

    Attributes:
        plans, asks, waits: Whether it gets the environment, gets the decision, and has to be awaited.
    """

    def __init__(self, policy: Callable[..., Any]) -> None:
        self.policy, self._call = policy, Caller(policy)
        self.plans, self.asks = (name in self._call.names for name in ASKED)
        self.waits = waits(policy)
        self._session: ref[Any] | None = None
        if self.plans and self.waits:
            raise OptionValueError(
                f"the policy {short_repr(policy)} waits, and asks for _environment, which only the simulation's own"
                " thread can use; let it ask for _decision, or let it answer at once"
            )

    def __call__(self, observation: Any, info: Any) -> Any:
        """Ask the policy, and wait for its answer."""
        return wait_for(self.begin(observation, info))

    def begin(self, observation: Any, info: Any) -> Any:
        """Ask the policy; in a branch or a clone, what stands for it there. Return its answer, or an awaitable."""
        session = None if self._session is None else self._session()
        if session is None:
            raise OptionValueError(
                f"the policy {short_repr(self.policy)} is asked for one decision of an environment at a time, and here"
                " there is no environment; pass the policy in policies="
            )
        episode = session.episode
        agent = episode.deciding
        in_branch = episode.plan.solo or PLANNING.get()
        policy: Any = self.policy
        if self.plans and in_branch:
            policy = base_of(getattr(policy, "base", RULE), agent.name)
            policy = RULE if is_planner(policy) else policy
        if in_branch or session.is_copy:
            policy = stand_in(policy)
        if policy is not self.policy:
            return self._by(policy, observation, info)
        environment = None
        if self.plans:
            views = import_module("..envs.single", __package__)  # by name, because views import the core
            environment = views.PlannerEnv(session.plan, session)
        return self.ask(observation, info, episode, agent, environment, in_clone=session.is_copy)

    def _by(self, policy: Any, observation: Any, info: Any) -> Any:
        """Return the answer of the policy that stands for this one."""
        if not callable(policy) or policy is RULE:
            return RULE
        asked = two_arguments(policy)
        if isinstance(asked, AskingPolicy):
            asked._session = self._session
            return asked.begin(observation, info)
        return asked(observation, info)

    def ask(
        self, observation: Any, info: Any, episode: Any, agent: Any, environment: Any, *, in_clone: bool = False
    ) -> Any:
        """Ask the policy itself about the pending decision of an agent. Return its answer, or an awaitable."""
        asked: dict[str, Any] = {"_environment": environment}
        if self.asks:
            asked["_decision"] = decision_of(episode, agent, in_clone=in_clone)
        return self._call(observation, info, asked)


def bind_session(policy: Any, session: Any) -> Any:
    """Copy a wrapped policy for the episodes of a session, held weakly; return any other policy unchanged."""
    if not isinstance(policy, AskingPolicy):
        return policy
    bound = copy.copy(policy)
    bound._session = ref(session)
    return bound
