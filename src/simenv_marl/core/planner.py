"""Planners: policies with a keyword-only parameter ``_environment``, which get the environment in which they decide.

In branches of that environment, and where a planner tries a candidate, no policy gets an environment, because two
planners would ask each other without end. There the planner's attribute ``base`` answers, or the rule if it has none.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from contextvars import ContextVar
from importlib import import_module
from typing import Any, Final
from weakref import ref

from ..errors import OptionValueError, short_repr
from ..simulation import RULE, asks_for, positional

PLANNING: Final[ContextVar[bool]] = ContextVar("simenv_marl.planning", default=False)
"""Whether this code runs in a branch in which a planner tries a candidate action."""


def takes_info(policy: Callable[..., Any]) -> bool:
    """Return whether a policy takes the observation and the info, and not the observation alone."""
    parameters = positional(policy)
    return len(parameters) > 1 and (parameters[1].default is parameters[1].empty or parameters[1].name == "info")


def is_planner(policy: Any) -> bool:
    """Return whether a policy has a keyword-only parameter ``_environment``."""
    return asks_for(policy, "_environment")


def two_arguments(policy: Callable[..., Any]) -> Callable[[Any, Any], Any]:
    """Make a policy callable with observation and info, even if it takes no info or asks for the environment."""
    if is_planner(policy):
        return PlannerPolicy(policy)
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


class DeferredPolicy:
    """A policy that answers many decisions in one call. An episode waits for it as it waits for the user."""

    alone: Any  # a method of episode and agent: answers at once, in a branch that waits for one agent only


class PlannerPolicy:
    """The wrapper of a planner in a plan. Other policies have none, and so cost nothing extra."""

    def __init__(self, policy: Callable[..., Any]) -> None:
        self.policy = policy
        self._takes_info = takes_info(policy)
        self._session: ref[Any] | None = None

    def __call__(self, observation: Any, info: Any) -> Any:
        """Ask the planner; in a branch, ask its base."""
        session = None if self._session is None else self._session()
        if session is None:
            raise OptionValueError(
                f"the policy {short_repr(self.policy)} asks for _environment, but there is no environment to give it"
                " here; pass the policy in policies="
            )
        episode = session.episode
        if not (episode.plan.solo or PLANNING.get()):
            views = import_module("..envs.single", __package__)  # by name, because views import the core
            return self.answer(observation, info, views.PlannerEnv(session.plan, session))
        base = base_of(getattr(self.policy, "base", RULE), (episode.consulted or episode.pending).name)
        if base is RULE or not callable(base) or is_planner(base):
            return RULE
        return two_arguments(base)(observation, info)

    def answer(self, observation: Any, info: Any, environment: Any) -> Any:
        """Ask the planner for an action, and give it an environment."""
        seen = (observation, info) if self._takes_info else (observation,)
        return self.policy(*seen, _environment=environment)


def bind_session(policy: Any, session: Any) -> Any:
    """Copy a wrapped planner for the episodes of a session, held weakly; return any other policy unchanged."""
    if not isinstance(policy, PlannerPolicy):
        return policy
    bound = copy.copy(policy)
    bound._session = ref(session)
    return bound
