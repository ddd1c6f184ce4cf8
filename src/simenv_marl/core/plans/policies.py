"""Policies: who answers a decision, and the arguments of a policy.

A *planner* has a keyword-only parameter ``_environment``, and gets the environment in which it
decides. A policy with ``_decision`` gets the pending ``Decision``, one with ``_simulation`` the
simulation of its own environment, clone or branch, one with ``_state`` the state of the simulation.
A coroutine function is awaited. All other policies get an observation, or an observation and an
info.
"""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from enum import IntEnum
from functools import partial
from time import perf_counter
from typing import Any, Final, Protocol, TypeAlias, TypeVar

from gymnasium.spaces import Tuple

from ...errors import OptionValueError, short_repr
from ...simulation import EVERYONE, RULE, Action, Observation, asks_for, positional
from ..switching.awaiting import wait_for
from .point import Policy, Space

Info: TypeAlias = dict[str, Any]
Result = TypeVar("Result")


class Where(IntEnum):
    """Where an episode is played. Each place asks fewer policies than the places before it."""

    USER = 0
    """In the user's environment, all policies are asked."""

    CLONE = 1
    """In a clone or a branch, policies that wait or record are replaced by their fallback."""

    BRANCH = 2
    """In a branch that a policy has made of its environment, planners are replaced by their base.

    Otherwise two planners would ask each other without end.
    """

    PLAN = 3
    """A branch where a planner tries a candidate. A planner itself knows it, too."""


class AskedEpisode(Protocol):
    """An episode, as policies use it."""

    @property
    def where(self) -> Where:
        """Where the episode is played."""

    @property
    def seed(self) -> int:
        """The seed of the episode."""

    @property
    def simulation(self) -> object:
        """The simulation, for a policy that asks for it."""

    def planner_view(self) -> object:
        """Return the environment for a policy that asks for it."""

    def read_state(self) -> object:
        """Return the state of the simulation for a policy that asks for it."""


class AskedAgent(Protocol):
    """An agent, as policies use it."""

    @property
    def name(self) -> str:
        """The name of the agent."""

    def describe(self, seed: int, where: Where) -> object:
        """Return the decision of the agent, for a policy that asks for it."""

    def count(self, **numbers: float) -> None:
        """Add numbers to its counts."""


ASKED: Final = ("_environment", "_decision", "_simulation", "_state")
"""The keyword-only parameters of policies that ask for more. Batches have the last alone."""


def takes_info(policy: Callable[..., Action]) -> bool:
    """Return whether a policy takes the observation and the info, and not the observation alone."""
    parameters = positional(policy)
    if len(parameters) < 2:
        return False
    return parameters[1].default is parameters[1].empty or parameters[1].name == "info"


def is_planner(policy: Policy) -> bool:
    """Return whether a policy has a keyword-only parameter ``_environment``."""
    return asks_for(policy, "_environment")


def waits(policy: Policy) -> bool:
    """Return whether a policy is a coroutine function, or says so by an attribute ``waits``."""
    while isinstance(policy, partial):
        policy = policy.func
    call = getattr(type(policy), "__call__", None)  # noqa: B004 - the function itself is needed
    if inspect.iscoroutinefunction(policy) or inspect.iscoroutinefunction(call):
        return True
    return getattr(policy, "waits", False) is True


def records(policy: Policy) -> bool:
    """Return whether a policy says by an attribute ``records`` that it records its answers."""
    return getattr(policy, "records", False) is True


def is_asked_alone(policy: Policy) -> bool:
    """Return whether a policy answers one decision at a time: see this module."""
    return waits(policy) or any(asks_for(policy, name) for name in ASKED[:-1])


def takes_state(policy: Policy) -> bool:
    """Return whether a policy asks for ``_state``. An attribute ``takes_state`` may say so."""
    told = getattr(policy, "takes_state", None)
    return told if isinstance(told, bool) else asks_for(policy, ASKED[-1])


def two_arguments(policy: Policy) -> Policy:
    """Make a policy callable with observation and info, unless it is ``RULE``."""
    if policy is RULE or isinstance(policy, EpisodePolicy):
        return policy
    if is_asked_alone(policy) or takes_state(policy):
        return AskingPolicy(policy)
    return policy if takes_info(policy) else lambda observation, info: policy(observation)


def policy_for(policy: Policy, agent: str, where: Where) -> Policy:
    """Return the policy that answers for an agent. This alone decides who is asked where.

    Args:
        policy: A policy, policies by agent, or ``RULE``.
        agent: The name of the agent that decides.
        where: Where the episode is played.

    Returns:
        The policy itself, its base or its fallback, or ``RULE``.
    """
    while policy is not RULE:
        if isinstance(policy, Mapping):
            policy = policy.get(agent, policy.get(EVERYONE, RULE))
        elif where >= Where.BRANCH and is_planner(policy):
            policy = getattr(policy, "base", RULE)
        elif where >= Where.CLONE and (waits(policy) or records(policy)):
            policy = getattr(policy, "fallback", RULE)
        else:
            return policy
    return RULE


COUNTS: Final[dict[str, dict[str, float]]] = {}
"""The counts of policies in this process, by a token that copies of a policy share."""


def count(token: str, **numbers: float) -> None:
    """Add numbers to the counts of the policies with a token."""
    counts = COUNTS.setdefault(token, {})
    for name, number in numbers.items():
        counts[name] = counts.get(name, 0) + number


def has_fallback(policy: Policy) -> bool:
    """Return whether a policy counts fallbacks, or wraps one that does."""
    while isinstance(policy, PolicyWrapper) and not policy.counts_fallbacks:
        policy = policy.policy
    return isinstance(policy, PolicyWrapper)


class Caller:
    """Calls a policy with the arguments that it takes, which are found out once.

    Attributes:
        policy: The policy.
        names: The names of ``ASKED`` that it asks for.
    """

    def __init__(self, policy: Callable[..., Action]) -> None:
        self.policy = policy
        self.names = tuple(name for name in ASKED if asks_for(policy, name))
        self._takes_info = takes_info(policy)

    def __call__(
        self, observation: Observation, info: Info | None, asked: Mapping[str, object]
    ) -> Action:
        """Call the policy. Return its answer, or an awaitable."""
        seen = (observation, info) if self._takes_info else (observation,)
        return self.policy(*seen, **{name: asked[name] for name in self.names})


def when_answered(
    answer: Action | Awaitable[Action], conclude: Callable[[Action], Result]
) -> Result | Awaitable[Result]:
    """Apply a function to an answer. Return an awaitable if the answer is one."""
    if not inspect.isawaitable(answer):
        return conclude(answer)

    async def wait() -> Result:
        return conclude(await answer)

    return wait()


def split_extras(answer: Action, space: Space | None = None) -> tuple[Action, Mapping[str, Any]]:
    """Split the result of a policy into the action, or the actions, and the extras.

    ``space``: the space of one action, because an action of a ``Tuple`` may look like both.
    """
    is_pair = type(answer) is tuple and len(answer) == 2 and isinstance(answer[1], Mapping)
    if is_pair and not (isinstance(space, Tuple) and space.contains(answer)):
        action, extras = answer
        return action, extras
    return answer, {}


class PolicyWrapper:
    """A policy that asks another policy, and so asks for the same arguments.

    Attributes:
        policy: The other policy.
        ask: Calls it.
        waits: Whether it must be awaited.
        records: Whether it records its answers.
        counts_fallbacks: Whether evaluations show how many of its answers come from a fallback.
    """

    counts_fallbacks = False

    def __init__(self, policy: Callable[..., Action], *, asks: Iterable[str] = ()) -> None:
        """Wrap a policy. ``asks``: the names of ``ASKED`` that the wrapper itself needs."""
        if not callable(policy):
            raise OptionValueError(f"the policy must be a callable, not {short_repr(policy)}")
        self.policy = policy
        self.ask = Caller(policy)
        self.waits = waits(policy)
        self.records = records(policy)
        names = {*self.ask.names, *asks}
        kind = inspect.Parameter
        parameters = [
            kind(name, kind.POSITIONAL_OR_KEYWORD) for name in ("observation", "info")
        ] + [kind(name, kind.KEYWORD_ONLY) for name in ASKED if name in names]
        self.__signature__ = inspect.Signature(parameters)


class EpisodePolicy(ABC):
    """A policy of a plan that is asked with the episode and the agent.

    Attributes:
        waits: Whether it must be awaited.
        batched: Whether it answers many decisions in one call, where many wait.
        deferred: Whether the episode waits for it as for its user.
        looks_back: Whether it needs the arguments of decisions that were answered before.
        sees_all: Whether it sees all agents, so that those that end are observed for the last time.
        takes_state: Whether it needs the state of the simulation.
        plans: Whether it gets the environment.
        asks: Whether it gets the decision.
        policy: The user's policy, for errors.
    """

    waits = False
    batched = False
    deferred = False
    looks_back = False
    sees_all = False
    takes_state = False
    plans = False
    asks = False
    policy: Policy

    @abstractmethod
    def answer(
        self, episode: AskedEpisode, agent: AskedAgent, observation: Observation, info: Info
    ) -> Action:
        """Answer one decision at once."""

    def respond(
        self, episode: AskedEpisode, agent: AskedAgent, observation: Observation, info: Info
    ) -> Action:
        """Answer one decision, perhaps with a tuple of the action and a dict of extras."""
        return self.answer(episode, agent, observation, info)

    def respond_to_many(
        self, agents: Sequence[Any], infos: Sequence[Info], states: object
    ) -> tuple[list[Action], Mapping[str, Any]]:
        """Answer the decisions of some agents. Return the actions, and the extras.

        ``states``: the stacked states, if it takes them.
        """
        raise NotImplementedError

    def __call__(self, observation: Observation, info: Info) -> Action:
        """Refuse a call without an episode."""
        raise OptionValueError(
            f"the policy {short_repr(self.policy)} is asked for one decision of an environment at a"
            " time, and here there is no environment; pass the policy in policies="
        )


class DeferredPolicy(EpisodePolicy):
    """A policy that answers many decisions in one call. An episode waits for it as for its user."""

    deferred = True


class AskingPolicy(EpisodePolicy):
    """A policy that is asked for one decision at a time."""

    looks_back = True

    def __init__(self, policy: Callable[..., Action]) -> None:
        self.policy = policy
        self._call = Caller(policy)
        self.plans = ASKED[0] in self._call.names
        self.asks = ASKED[1] in self._call.names
        self.waits = waits(policy)
        self._is_asked_everywhere = not (self.plans or self.waits or records(policy))
        if self.plans and self.waits:
            raise OptionValueError(
                f"the policy {short_repr(policy)} waits, and asks for _environment, which only the"
                " simulation's own thread can use; let it ask for _decision, or let it answer at"
                " once"
            )

    def answer(
        self, episode: AskedEpisode, agent: AskedAgent, observation: Observation, info: Info
    ) -> Action:
        """Answer one decision. Wait for the answer if it must be awaited."""
        return wait_for(self.begin(episode, agent, observation, info))

    def begin(self, *arguments: Any) -> Action | Awaitable[Action]:
        """Ask the policy, with the arguments of ``answer``. Return its answer, or an awaitable."""
        return self.prepare(*arguments)()

    def prepare(
        self,
        episode: AskedEpisode,
        agent: AskedAgent,
        observation: Observation,
        info: Info,
        *,
        later: bool = False,
    ) -> Callable[[], Action | Awaitable[Action]]:
        """Collect the arguments of the policy, or its substitute where the episode is played.

        Return a function that asks. ``later``: it is called when the model has gone on.
        """
        policy = self.policy
        if not self._is_asked_everywhere:
            policy = policy_for(policy, agent.name, episode.where)
        if policy is RULE:
            return lambda: RULE
        call = self._call if policy is self.policy else Caller(policy)
        asked = {name: _look_up(name, episode, agent) for name in call.names}
        if later:
            getattr(asked.get("_decision"), "display", None)  # it shows the model as it is now
        ask = partial(call, observation, info, asked)
        return partial(self._time, agent, ask) if asked else ask  # else it is quick, as a rule

    def _time(self, agent: AskedAgent, ask: Callable[[], Action]) -> Action | Awaitable[Action]:
        """Ask, and count the seconds."""
        start = perf_counter()

        def conclude(answer: Action) -> Action:
            agent.count(seconds=perf_counter() - start)
            return answer

        answer = ask()
        return when_answered(answer, conclude) if self.waits else conclude(answer)


def _look_up(name: str, episode: AskedEpisode, agent: AskedAgent) -> object:
    """Return what a policy asks for by a parameter of ``ASKED``."""
    match name:
        case "_environment":
            return episode.planner_view()
        case "_decision":
            return agent.describe(episode.seed, episode.where)
        case "_simulation":
            return episode.simulation
    return episode.read_state()
