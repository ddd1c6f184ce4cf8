"""The decision points, agents and policies that ``points=``, ``possible_agents=`` and ``policies=`` name.

If an environment names an undecorated function, the hook of that function exists only as long as the environment needs
it. For all other callers the function does not change.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from sys import modules
from types import FunctionType, MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from ..decision import BY_NAME, DecisionPoint, Definition, decision_points, point_for, point_of, registered
from ..errors import (
    AgentError,
    DefinitionError,
    OptionValueError,
    PatchError,
    SimEnvError,
    UnknownPointError,
    name_of,
    short_repr,
)
from ..hooks.hook import unwrap
from ..hooks.places import PlacedHook, Purpose, all_classes, find_hook, is_importable, raw_attribute, resolve
from ..simulation import RULE
from .planner import two_arguments

if TYPE_CHECKING:
    from .point import Point

Points = str | Callable[..., Any] | Iterable[str | Callable[..., Any]] | Mapping[Any, Definition | None] | None
"""The ways to name decision points: see ``generate_env``."""

Own = Mapping[DecisionPoint, Definition]
"""The definitions in a simulation's attribute ``points``."""

_NONE: Final[Own] = MappingProxyType({})

POINT: Final = Purpose("decision point", UnknownPointError, decision_points)


@dataclass(frozen=True)
class NamedPoint:
    """A decision point together with the definition that an environment uses for it."""

    point: DecisionPoint
    definition: Definition

    @property
    def key(self) -> Any:
        """The key that names the point in another process."""
        return portable(self.point.rule, self.point.name)

    @property
    def own_definition(self) -> Definition | None:
        """The definition; None if it is the one of the point's decorator, which needs no separate pickling."""
        return None if self.definition is self.point.definition else self.definition


# -- points by name or function -------------------------------------------------------------------


def locate(key: Any, own: Own = _NONE) -> DecisionPoint:
    """Return the point of a dotted name or function, whether it has a definition or not.

    Raises:
        UnknownPointError: The name leads to nothing.
        PatchError: The name leads to something that cannot be patched.
    """
    if not isinstance(key, str):
        return point_for(find_hook(key, POINT))
    named = by_name(own).get(key)
    if named is not None:
        return named
    decorated = registered(key)
    try:
        hook = find_hook(key, POINT)
    except (UnknownPointError, PatchError):
        if decorated is None:
            raise
        return decorated  # decorated inside a function
    if decorated is not None and (hook.point is None or not hook.permanent):
        return decorated  # not yet assigned to its name
    return point_for(hook)


def by_name(own: Own) -> dict[str, DecisionPoint]:
    """Return the simulation's own points that do not exist in a module, by name."""
    return {point.name: point for point in own if hasattr(point.rule, BY_NAME)}


def own_points(simulation: Any) -> dict[DecisionPoint, Definition]:
    """Return the definitions in a simulation's attribute ``points``.

    Names that lead to nothing are left out. Code that looks such a name up raises an error for it.
    """
    given = getattr(simulation, "points", None)
    own: dict[DecisionPoint, Definition] = {}
    for key, definition in given.items() if isinstance(given, Mapping) else ():
        with suppress(UnknownPointError, PatchError):
            own[locate(key)] = definition
    return own


def owner_class(point: DecisionPoint) -> type | None:
    """Return the class of which a point is a method; None if it is not a method, or if its name leads to nothing."""
    try:
        owner, _ = resolve(point.name, POINT)
    except (UnknownPointError, PatchError):
        return None
    return owner if isinstance(owner, type) else None


def have_instances(one: type, other: type) -> bool:
    """Return whether any existing class is a subclass of both classes."""
    return any(issubclass(owner, other) for owner in all_classes(one))


# -- points with their definitions ----------------------------------------------------------------


def find_points(
    points: Any, simulation: Any, own: Own | None = None, *, required: bool = True, empty: bool = False
) -> list[NamedPoint]:
    """Find all decision points that ``points=`` names, in the order in which they are named.

    Args:
        points: The argument ``points=``; None: the simulation's attribute ``points``, or all decorated points if there
            is no such attribute.
        simulation: The simulation.
        own: The result of ``own_points``, if it is known.
        required: Whether all decorated points are used if none is named. If False, none is used.
        empty: Whether ``points`` may be empty.

    Raises:
        UnknownPointError: A name leads to nothing, or no point is named.
        DefinitionError: A function has no definition, or a value of the dict is not a definition.
        PatchError: A function that was named cannot become a decision point.
    """
    own = own_points(simulation) if own is None else own
    if points is None:
        points = getattr(simulation, "points", None)
    if points is None:
        points = _all_registered() if required else []
        empty = empty or not required
    if isinstance(points, str) or not hasattr(points, "__iter__"):
        points = [points]
    entries = points.items() if isinstance(points, Mapping) else [(key, None) for key in points]
    found: dict[DecisionPoint, NamedPoint] = {}
    for key, definition in entries:
        named = find_point(key, definition, own=own)
        if named.point in found:
            raise UnknownPointError(f"the decision point {named.point.name} was named twice")
        found[named.point] = named
    if not found and not empty:
        raise UnknownPointError("no decision point was named: points is empty")
    return list(found.values())


def find_point(key: Any, definition: Any = None, *, own: Own = _NONE) -> NamedPoint:
    """Find one decision point by a dotted name or function, and the definition to use for it, as ``find_points``."""
    if definition is not None and not isinstance(definition, Definition):
        raise DefinitionError(
            f"the definition of {name_of(key)} must come from make_step, not {short_repr(definition)}"
        )
    point = locate(key, own)
    decorated = None if isinstance(key, str) else point_of(getattr(key, "__func__", key))
    if decorated is not None:  # a name means the latest definition, a decision function its own
        definition = definition or decorated[1]
    definition = definition or own.get(point) or point.definition or _inherited(point)
    if definition is None:
        raise DefinitionError(
            f"{point.name} has no definition here: decorate it with make_step, or give its definition in points="
            f"{{{point.name!r}: make_step(...)}}"
        )
    return NamedPoint(point, definition)


def _inherited(point: DecisionPoint) -> Definition | None:
    """Return the definition that a class inherits, together with the decision function, from a base class."""
    hook = point.hook
    if not isinstance(hook, PlacedHook) or not hook.inherited:
        return None
    known = point_of(raw_attribute(hook.owner, hook.attribute))
    return known and (known[1] or known[0].definition)


def _all_registered() -> list[str]:
    names = decision_points()
    packages = sorted({name.partition(".")[0] for name in names})
    if not names:
        raise UnknownPointError("there is no decision point: decorate a function with make_step or name points=")
    if len(packages) > 1:
        raise UnknownPointError(
            f"decision points of more than one package are registered ({', '.join(packages)}); say which are"
            " meant with points=, or with an attribute points of the simulation"
        )
    return names


# -- agents and policies ---------------------------------------------------------------------------


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


# -- points in other processes --------------------------------------------------------------------


def portable(key: Any, name: str | None = None) -> Any:
    """Return a key that names a function in another process: its dotted name, if that surely leads to it there.

    Anything but a function is returned as it is.
    """
    function = unwrap(key)
    if not isinstance(function, FunctionType):
        return key
    if hasattr(function, BY_NAME):
        return getattr(function, BY_NAME)
    name = name or f"{function.__module__}.{function.__qualname__}"
    if is_importable(name):
        return name
    owner, _, attribute = name.removeprefix("__main__.").rpartition(".")
    found = getattr(modules.get("__main__"), owner, None) if owner.isidentifier() else None
    return Member(found, attribute) if isinstance(found, type) else function


@dataclass(frozen=True)
class Member:
    """A function of a class in the main module; unpickled, it is the function itself.

    The rule of a decision function cannot be pickled by name, because the name leads to the decision function.
    """

    owner: type
    name: str

    def __reduce__(self) -> Any:
        return getattr, (self.owner, self.name)
