"""Policies that ask for the environment in which they decide: they have a keyword-only parameter ``_environment``.

A plan wraps such a policy when it binds it, so that other policies cost nothing extra. The views make the environment
that the policy gets. This module does not know the views; they set ``AskingPolicy.make``.

In a branch of such an environment, and in a branch in which a planner tries a candidate action, no policy gets an
environment: two policies that branch would ask each other for ever. There the policy's attribute ``base`` answers, or
the rule if the policy has none.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from contextvars import ContextVar
from importlib import import_module
from typing import Any, Final
from weakref import ref

from ..errors import OptionValueError, short_repr
from ..simulation import RULE, positional
from .point import asks_for

PLANNING: Final[ContextVar[bool]] = ContextVar("simenv_marl.planning", default=False)
"""Whether this code runs in a branch in which a planner tries a candidate action."""

ENVIRONMENT: Final = "_environment"
"""The parameter by which a policy asks for the environment."""


def takes_info(policy: Callable[..., Any]) -> bool:
    """Whether a policy takes the observation and the info, and not the observation alone."""
    parameters = positional(policy)
    return len(parameters) > 1 and (parameters[1].default is parameters[1].empty or parameters[1].name == "info")


def asks_for_environment(policy: Any) -> bool:
    """Whether a policy has a keyword-only parameter ``_environment``."""
    return asks_for(policy, ENVIRONMENT)


def base_of(base: Any, agent: str) -> Any:
    """Find the base policy of an agent. A dict is looked up by agent; a planner is replaced by its own base.

    Args:
        base: ``RULE``, a policy, or a dict of these by agent.
        agent: The agent's name.

    Returns:
        ``RULE`` or a policy. The policy asks for the environment only if it has no attribute ``base``.
    """
    while True:
        if isinstance(base, Mapping):
            base = base.get(agent, RULE)
        elif hasattr(base, "base") and asks_for_environment(base):
            base = base.base
        else:
            return base


class AskingPolicy:
    """The wrapper of a policy that gets the environment, with the decision pending.

    Attributes:
        policy: The wrapped policy.
    """

    make: Callable[[Any], Any]
    """Takes a session and makes the environment that the policy gets. The views set it."""

    def __init__(self, policy: Callable[..., Any]) -> None:
        self.policy = policy
        self._informed = takes_info(policy)
        self._session: Callable[[], Any] = _nothing

    def given(self, session: Any) -> AskingPolicy:
        """Copy the wrapper for the episodes of a session, which it holds by a weak reference."""
        made = copy.copy(self)
        made._session = ref(session)
        return made

    def __call__(self, observation: Any, info: Any) -> Any:
        """Ask the policy.

        Raises:
            OptionValueError: There is no session, and so no environment to give.
            BaseException: Any error that the policy raises.
        """
        session = self._session()
        if session is None:
            raise OptionValueError(
                f"the policy {short_repr(self.policy)} asks for {ENVIRONMENT}, but there is no"
                " environment to give it here;"
                " pass the policy in policies="
            )
        episode = session.episode
        if episode.plan.solo or PLANNING.get():
            return self._by_base(observation, info, (episode.consulted or episode.pending).name)
        import_module(f"{__name__.partition('.')[0]}.envs.asked")  # which sets ``make``
        return self.answer(observation, info, AskingPolicy.make(session))

    def _by_base(self, observation: Any, info: Any, agent: str) -> Any:
        """Ask the policy's base for the action of an agent."""
        base = base_of(getattr(self.policy, "base", RULE), agent)
        if base is RULE or not callable(base) or asks_for_environment(base):
            return RULE
        return base(observation, info) if takes_info(base) else base(observation)

    def answer(self, observation: Any, info: Any, environment: Any) -> Any:
        """Ask the policy for an action, and give it an environment."""
        given = (observation, info) if self._informed else (observation,)
        return self.policy(*given, **{ENVIRONMENT: environment})


def _nothing() -> None:
    """Stand for a session that is not known."""


def given_session(policy: Any, session: Any) -> Any:
    """Give a session to a policy that asks for the environment; return any other policy unchanged."""
    return policy.given(session) if isinstance(policy, AskingPolicy) else policy
