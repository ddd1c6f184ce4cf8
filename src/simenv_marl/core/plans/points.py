"""The decision points, agents and policies that options name.

If an environment names an undecorated function, the hook of that function exists only as long as
the environment needs it. For all other callers the function does not change.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import suppress
from itertools import count
from sys import modules
from types import FunctionType, MappingProxyType
from typing import Any, Final, TypeAlias

from ...decision import (
    BY_NAME,
    DecisionPoint,
    Definition,
    decision_points,
    point_for,
    registered,
)
from ...errors import (
    AgentError,
    DefinitionError,
    OptionValueError,
    PatchError,
    SimEnvError,
    UnknownPointError,
    name_of,
    short_repr,
)
from ...hooks.hook import hook_of, made_with, unwrap
from ...hooks.places import (
    PlacedHook,
    all_classes,
    find_hook,
    hook_at,
    is_elsewhere,
    raw_attribute,
    resolve,
)
from ...simulation import EVERYONE, RULE, Model
from .point import Point, Policy
from .policies import two_arguments

Key: TypeAlias = "str | Callable[..., Any]"
"""A dotted name, or a function."""

Points: TypeAlias = "Key | Iterable[Key] | Mapping[Any, Definition | None] | None"
"""The ways to name decision points: see ``generate_env``."""

Definitions = Mapping[DecisionPoint, Definition]
"""Decision points with their definitions."""

_NONE: Final[Definitions] = MappingProxyType({})

# -- points by name or function -------------------------------------------------------------------


def locate(key: Key, own: Definitions = _NONE, *, defined: bool = False) -> DecisionPoint:
    """Return the point of a dotted name or function, whether it has a definition or not.

    Args:
        key: The name or the function.
        own: The points of the simulation itself, some of which are in no module.
        defined: Whether a definition comes with the name. Then it means the function at this place,
            and not one that was decorated from there and is elsewhere, as in a derived class.
    """
    if isinstance(key, str):
        for points in ({point.name: point for point in own}, registered()):
            if key in points and not (defined and is_elsewhere(points[key])):
                return points[key]
    return point_for(find_hook(key))


def own_points(simulation: Model) -> dict[DecisionPoint, Definition]:
    """Return the definitions in the attribute ``points``, without names that lead to nothing."""
    points = getattr(simulation, "points", None)
    own: dict[DecisionPoint, Definition] = {}
    if isinstance(points, Mapping):
        for key, definition in points.items():
            with suppress(UnknownPointError, PatchError):
                own[locate(key, defined=definition is not None)] = definition
    return own


def owner_class(point: DecisionPoint) -> type | None:
    """Return the class of a method. None for other points, or if the class is gone."""
    owner: object = None
    if isinstance(point, PlacedHook):
        owner = point.owner
    else:
        with suppress(UnknownPointError, PatchError):
            owner, _ = resolve(point.name)
    return owner if isinstance(owner, type) else None


def overrides(point: DecisionPoint) -> list[DecisionPoint]:
    """Return the functions of derived classes that override a point, and do not call it.

    These are no points: they have no definition.
    """
    owner = owner_class(point)
    if owner is None:
        return []
    attribute = point.name.rpartition(".")[2]
    found: list[DecisionPoint] = []
    for kind in all_classes(owner):
        function = unwrap(vars(kind).get(attribute))
        if kind is owner or not isinstance(function, FunctionType):
            continue
        if attribute in function.__code__.co_names:
            continue  # it calls the point, by super() or by the name of a class
        with suppress(PatchError):
            hook = hook_at(f"{kind.__module__}.{kind.__qualname__}.{attribute}", kind, attribute)
            if hook.definition is None and not getattr(hook, "inherited", False):
                found.append(hook)
    return found


# -- points with their definitions ----------------------------------------------------------------


def find_points(
    points: Points, own: Definitions, *, empty: bool = False
) -> dict[DecisionPoint, Definition]:
    """Find the decision points that ``points=`` names, with their definitions, in that order.

    Args:
        points: The names. None: all decorated points.
        own: The points of the simulation itself.
        empty: Whether there may be none.
    """
    if points is None:
        points = _all_points()
    if isinstance(points, str) or not isinstance(points, Iterable):
        points = [points]
    pairs = points.items() if isinstance(points, Mapping) else [(key, None) for key in points]
    found: dict[DecisionPoint, Definition] = {}
    keys: dict[DecisionPoint, Key] = {}
    for key, given in pairs:
        point, definition = find_point(key, given, own=own)
        earlier = keys.setdefault(point, key)
        # While an environment lives, the class has a wrapper of a function that is a key already.
        if point in found and (earlier is key or str in (type(key), type(earlier))):
            raise UnknownPointError(f"the decision point {point.name} was named twice")
        found[point] = definition
    if not found and not empty:
        raise UnknownPointError("no decision point was named: points is empty")
    return found


def _all_points() -> list[str]:
    """Return the names of all decorated points, which must belong to one package."""
    points = decision_points()
    if not points:
        raise UnknownPointError(
            "there is no decision point: decorate a function with make_step or name points="
        )
    packages = sorted({name.partition(".")[0] for name in points})
    if len(packages) > 1:
        raise UnknownPointError(
            f"decision points of more than one package are registered ({', '.join(packages)});"
            " say which are meant with points=, or with an attribute points of the simulation"
        )
    return points


def find_point(
    key: Key, definition: Definition | None = None, *, own: Definitions = _NONE
) -> tuple[DecisionPoint, Definition]:
    """Find one decision point, and its definition, as ``find_points`` does."""
    if definition is not None and not isinstance(definition, Definition):
        raise DefinitionError(
            f"the definition of {name_of(key)} must come from make_step, not"
            f" {short_repr(definition)}"
        )
    point = locate(key, own, defined=definition is not None)
    if not isinstance(key, str):  # a name means the latest definition, a decision function its own
        definition = definition or made_with(key)
    definition = definition or own.get(point) or point.definition or _inherited(point)
    if definition is None:
        raise DefinitionError(
            f"{point.name} has no definition here: decorate it with make_step, or give its"
            f" definition in points={{{point.name!r}: make_step(...)}}"
        )
    return point, definition


def _inherited(point: DecisionPoint) -> Definition | None:
    """Return the definition that a class inherits together with the decision function."""
    if not isinstance(point, PlacedHook) or not point.inherited:
        return None
    inherited = raw_attribute(point.owner, point.attribute)
    hook = hook_of(inherited)
    if hook is None:
        return None
    definition: Definition | None = made_with(inherited) or hook.definition
    return definition


def _named(key: object, points: Iterable[DecisionPoint]) -> DecisionPoint | None:
    """Return the one of some points that a key names."""
    for point in points:
        if unwrap(key) is point.function or portable(key) == point.name:
            return point
    return None


# -- agents and policies --------------------------------------------------------------------------


def agent_names(definitions: Definitions) -> dict[DecisionPoint, str | None]:
    """Name the agent of each point. None if a callable names it."""
    taken = {definition.agent for definition in definitions.values()}
    names: dict[DecisionPoint, str | None] = {}
    for point, definition in definitions.items():
        agent = definition.agent
        if agent is None:
            defaults = (f"{point.letters}_{number}" for number in count())
            agent = next(name for name in defaults if name not in taken)
            taken.add(agent)
        names[point] = agent if isinstance(agent, str) else None
    return names


def resolve_roster(
    active: list[Point],
    declared: Mapping[Any, Iterable[str]] | list[str] | None,
    known: Collection[str | None],
) -> tuple[dict[str, list[Point]], bool]:
    """Find out where known agents decide, by agent, and whether there can be no others."""
    naming = [point.hook for point in active if point.agent is None]
    names: dict[DecisionPoint, Iterable[str | None]] = {}
    if isinstance(declared, Mapping):
        for key, agents in declared.items():
            hook = _named(key, naming)
            if hook is None:
                raise OptionValueError(
                    f"possible_agents names {short_repr(key)}, which is not an active decision"
                    " point with a callable as agent=; these are:"
                    f" {[point.name for point in naming]}"
                )
            names[hook] = agents
    elif declared is not None:
        others = [name for name in declared if name not in known]
        if len(naming) > 1 or (others and not naming):
            raise OptionValueError(
                "possible_agents must be a dict from decision points to names, unless exactly one"
                f" point names its agents by a callable; here {len(naming)} do"
            )
        names = dict.fromkeys(naming, others)
    roster: dict[str, list[Point]] = {}
    for point in active:
        for name in names.get(point.hook, ()) if point.agent is None else [point.agent]:
            if not isinstance(name, str) or point in roster.get(name, ()):
                raise AgentError(
                    f"possible_agents must be different strings, not {short_repr(name)}"
                )
            roster.setdefault(name, []).append(point)
    return roster, not naming or declared is not None


def resolve_policies(
    policies: Mapping[Any, Policy], named: Definitions, own: Definitions
) -> tuple[dict[DecisionPoint, Policy], dict[str, Policy], dict[DecisionPoint, Definition]]:
    """Return the policies by point and by agent, and all points that are named.

    ``policies`` may name points that ``named`` lacks.
    """
    by_point: dict[DecisionPoint, Policy] = {}
    by_agent: dict[str, Policy] = {}
    definitions = dict(named)
    agents = agent_names(named).values()
    for key, value in policies.items():
        if key is EVERYONE:
            continue
        policy = value if value is RULE else two_arguments(value)
        if isinstance(key, str) and key in agents:
            by_agent[key] = policy
            continue
        point = _named(key, named)
        if point is None:
            try:
                point, definition = find_point(key, own=own)
            except SimEnvError as error:
                if policy is RULE and isinstance(error, DefinitionError):
                    continue  # the rule decides there anyway
                # A callable may name an agent so later. Names in loaded modules are points.
                is_name = isinstance(key, str) and (
                    "." not in key or key.partition(".")[0] not in modules
                )
                if isinstance(error, UnknownPointError) and None in agents and is_name:
                    by_agent[key] = policy
                    continue
                known = sorted([*filter(None, agents), *(point.name for point in named)])
                raise UnknownPointError(
                    f"policies names {short_repr(key)}, which is neither an agent nor a decision"
                    f" point ({error}); known are {', '.join(known)}"
                ) from error
            definitions.setdefault(point, definition)
        by_point[point] = policy
    return by_point, by_agent, definitions


# -- points in other processes --------------------------------------------------------------------


def portable(key: Model, name: str | None = None) -> Model:
    """Return a key for other processes: the dotted name of a function, if it leads there."""
    function = unwrap(key)
    if not isinstance(function, FunctionType):
        return key
    if hasattr(function, BY_NAME):
        return getattr(function, BY_NAME)
    name = name or f"{function.__module__}.{function.__qualname__}"
    return function if "<" in name else name
