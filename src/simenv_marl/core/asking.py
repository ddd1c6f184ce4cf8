"""Policies that ask for the environment in which they decide: those with a keyword-only parameter ``_environment``.

Such a policy is wrapped when a plan binds it, so that nothing is paid for it where no policy asks. What it is given is
made by the views, of which this room knows nothing: they say how, in ``AskingPolicy.make``.

In a branch of such an environment, and in one in which a planner tries out a candidate, no policy is given another one:
two that branch would ask each other for ever. Its ``base`` answers there, if it has that attribute, else the rule.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from contextvars import ContextVar
from typing import Any, Final
from weakref import ref

from ..errors import OptionValueError, shown
from ..simulation import RULE, positional
from .bound import asks_for

PLANNING: Final[ContextVar[bool]] = ContextVar("simenv_marl.planning", default=False)
"""Whether this runs in a branch in which a planner tries out a candidate."""

ENVIRONMENT: Final = "_environment"
"""The parameter of policies that ask for the environment."""


def takes_info(policy: Callable[..., Any]) -> bool:
    """Whether a policy is to be called with the observation and the info, and not with the observation alone."""
    parameters = positional(policy)
    return len(parameters) > 1 and (parameters[1].default is parameters[1].empty or parameters[1].name == "info")


def asks_for_environment(policy: Any) -> bool:
    """Whether a policy has a keyword-only parameter ``_environment``."""
    return asks_for(policy, ENVIRONMENT)


def base_of(base: Any, agent: str) -> Any:
    """Who decides for an agent where a base does: one by agent is looked up, and a planner is its own base.

    Args:
        base: ``RULE``, a policy, or a dict of these by agent.
        agent: The agent.

    Returns:
        ``RULE`` or a policy; one that asks for the environment only where it has no attribute ``base``.
    """
    while True:
        if isinstance(base, Mapping):
            base = base.get(agent, RULE)
        elif hasattr(base, "base") and asks_for_environment(base):
            base = base.base
        else:
            return base


class AskingPolicy:
    """A policy that is given the environment, with its decision pending.

    Attributes:
        policy: The policy.
    """

    make: Callable[[Any], Any]
    """Makes the environment of a session, in which such a policy decides; set by the views."""

    def __init__(self, policy: Callable[..., Any]) -> None:
        self.policy = policy
        self._informed = takes_info(policy)
        self._session: Callable[[], Any] = _nothing

    def given(self, session: Any) -> AskingPolicy:
        """The same, for the episodes of a session, which is held weakly."""
        made = copy.copy(self)
        made._session = ref(session)
        return made

    def __call__(self, observation: Any, info: Any) -> Any:
        """Ask the policy.

        Raises:
            OptionValueError: It is asked where there is no one episode.
            BaseException: What the policy raises.
        """
        session = self._session()
        if session is None:
            raise OptionValueError(
                f"the policy {shown(self.policy)} asks for {ENVIRONMENT}, which there is not here: name it in policies="
            )
        episode = session.episode
        if episode.alone or PLANNING.get():
            return self._by_base(observation, info, (episode.consulted or episode.pending).name)
        return self.answer(observation, info, AskingPolicy.make(session))

    def _by_base(self, observation: Any, info: Any, agent: str) -> Any:
        """What the policy's base answers for an agent."""
        base = base_of(getattr(self.policy, "base", RULE), agent)
        if base is RULE or not callable(base) or asks_for_environment(base):
            return RULE
        return base(observation, info) if takes_info(base) else base(observation)

    def answer(self, observation: Any, info: Any, environment: Any) -> Any:
        """What the policy answers in an environment."""
        given = (observation, info) if self._informed else (observation,)
        return self.policy(*given, **{ENVIRONMENT: environment})


def _nothing() -> None:
    """Stands for a session that is not known."""


def given_session(policy: Any, session: Any) -> Any:
    """A policy of a plan, with the session given to it if it asks for the environment."""
    return policy.given(session) if isinstance(policy, AskingPolicy) else policy
