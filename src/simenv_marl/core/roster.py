"""The agents of each decision point, as far as they are known beforehand, and the policies that answer for them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from sys import modules
from typing import Any

from ..decision import DecisionPoint, Definition
from ..errors import AgentError, DefinitionError, OptionValueError, SimEnvError, UnknownPointError, short_repr
from ..hooks.hook import unwrap
from ..simulation import RULE
from .planner import PlannerPolicy, is_planner, takes_info
from .point import Point
from .points import NamedPoint, find_point


def mentions_agents(policies: Mapping[Any, Any] | None) -> bool:
    """Whether a key of ``policies`` may name an agent, so that the agents of all points must be known."""
    return any(isinstance(key, str) and "." not in key for key in policies or {})


def agent_names(named: list[NamedPoint]) -> list[str | None]:
    """Name the agent of each point; None if a callable names it."""
    given = [point.definition.agent for point in named]
    owners: dict[str, str] = {}
    for point, agent in zip(named, given, strict=True):
        if isinstance(agent, str):
            if agent in owners:
                raise AgentError(f"{owners[agent]} and {point.point.name} have the same agent {agent!r}")
            owners[agent] = point.point.name
    names: list[str | None] = []
    for point, agent in zip(named, given, strict=True):
        number = 0
        while agent is None and (name := f"{point.point.letters}_{number}") in owners:
            number += 1
        if agent is None:
            agent, owners[name] = name, point.point.name
        names.append(agent if isinstance(agent, str) else None)
    return names


def declared_agents(declared: Any) -> list[str]:
    """The names in ``possible_agents``."""
    if isinstance(declared, Mapping):
        return [name for names in declared.values() for name in names]
    return declared or []


def resolve_roster(active: list[Point], declared: Any, known: Collection[str | None]) -> tuple[dict[str, Point], bool]:
    """Find out which agents are known beforehand, and whether there can be no others."""
    named = [binding for binding in active if binding.agent is None]
    names: dict[Point, list[Any]] = {}
    if isinstance(declared, Mapping):
        for key, value in declared.items():
            point = next((b for b in named if key == b.point.name or unwrap(key) is b.point.rule), None)
            if point is None:
                raise OptionValueError(
                    f"possible_agents names {short_repr(key)}, which is not an active decision point with a callable as"
                    f" agent=; these are: {[b.point.name for b in named]}"
                )
            names[point] = value
    elif declared is not None:
        others = [name for name in declared if name not in known]
        if len(named) > 1 or (others and not named):
            raise OptionValueError(
                "possible_agents must be a dict from decision points to names, unless exactly one point names its"
                f" agents by a callable; here {len(named)} do"
            )
        names = dict.fromkeys(named, others)
    roster: dict[str, Point] = {}
    for binding in active:
        for name in names.get(binding, []) if binding.agent is None else [binding.agent]:
            if not isinstance(name, str) or name in roster:
                raise AgentError(f"possible_agents must be different strings, not {short_repr(name)}")
            roster[name] = binding
    return roster, not named or declared is not None


def resolve_policies(
    policies: Mapping[Any, Any],
    named: list[NamedPoint],
    agents: list[str | None],
    own: Mapping[DecisionPoint, Definition],
) -> tuple[dict[DecisionPoint, Any], dict[str, Any], list[NamedPoint]]:
    """Find out for which point or agent each policy answers.

    Args:
        policies: The policies, by agent or point. A point need not be among the named ones.
        named: The named points.
        agents: The agent of each named point. None if a callable names it.
        own: The simulation's own points.

    Returns:
        The policies by point, the policies by agent, and the points that only ``policies`` names.
    """
    by_point: dict[DecisionPoint, Any] = {}
    by_agent: dict[str, Any] = {}
    extra: list[NamedPoint] = []
    for key, value in policies.items():
        policy = value if value is RULE else two_arguments(value)
        if isinstance(key, str) and key in agents:
            by_agent[key] = policy
            continue
        point = next((p for p in named if key == p.point.name or unwrap(key) is p.point.rule), None)
        if point is None:
            try:
                point = find_point(key, own=own)
            except SimEnvError as error:
                if policy is RULE and isinstance(error, DefinitionError):
                    continue  # the rule decides there anyway
                if isinstance(error, UnknownPointError) and None in agents and not _is_path(key):
                    by_agent[key] = policy  # a callable may name this agent later
                    continue
                names = sorted([a for a in agents if a] + [p.point.name for p in named])
                raise UnknownPointError(
                    f"policies names {short_repr(key)}, which is neither an agent nor a decision point ({error});"
                    f" known are {', '.join(names)}"
                ) from error
            if not any(point.point is other.point for other in (*named, *extra)):
                extra.append(point)
        by_point[point.point] = policy
    return by_point, by_agent, extra


def _is_path(key: Any) -> bool:
    """Whether a key can only be the dotted name of something in a module, and not the name of an agent."""
    if not isinstance(key, str):
        return True
    first, second = (*key.split("."), "")[:2]
    return bool(second) and (f"{first}.{second}" in modules or hasattr(modules.get(first), second))


def two_arguments(policy: Callable[..., Any]) -> Callable[[Any, Any], Any]:
    """Make a policy callable with observation and info, even if it takes no info or asks for the environment."""
    if is_planner(policy):
        return PlannerPolicy(policy)
    return policy if takes_info(policy) else lambda observation, info: policy(observation)
