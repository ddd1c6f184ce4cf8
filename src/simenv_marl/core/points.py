"""The decision points, agents and policies that ``points=``, ``possible_agents=`` and ``policies=`` name.

If an environment names an undecorated function, the hook of that function exists only as long as
the environment needs it. For all other callers the function does not change.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from sys import modules
from types import FunctionType, MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from ..decision import (
    BY_NAME,
    DecisionPoint,
    Definition,
    decision_points,
    point_for,
    point_of,
    registered,
)
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
from ..hooks.places import PlacedHook, all_classes, find_hook, is_importable, raw_attribute, resolve
from ..simulation import RULE
from .policies import two_arguments

if TYPE_CHECKING:
    from .point import Point

Points = (
    str
    | Callable[..., Any]
    | Iterable[str | Callable[..., Any]]
    | Mapping[Any, Definition | None]
    | None
)
"""The ways to name decision points: see ``generate_env``."""

Definitions = Mapping[DecisionPoint, Definition]
"""Decision points with their definitions."""

_NONE: Final[Definitions] = MappingProxyType({})

# -- points by name or function -------------------------------------------------------------------


def locate(key: Any, own: Definitions = _NONE) -> DecisionPoint:
    """Return the point of a dotted name or function, whether it has a definition or not.

    Only the simulation's ``own`` points tell of those that do not exist in a module.
    """
    if not isinstance(key, str):
        return point_for(find_hook(key, UnknownPointError))
    for point in own:
        if point.name == key and hasattr(point.function, BY_NAME):
            return point
    decorated = registered().get(key)
    return point_for(find_hook(key, UnknownPointError)) if decorated is None else decorated


def own_points(simulation: Any) -> dict[DecisionPoint, Definition]:
    """Return the definitions in a simulation's attribute ``points``, but for names that lead to nothing."""
    given = getattr(simulation, "points", None)
    own: dict[DecisionPoint, Definition] = {}
    for key, definition in given.items() if isinstance(given, Mapping) else ():
        with suppress(UnknownPointError, PatchError):
            own[locate(key)] = definition
    return own


def owner_class(point: DecisionPoint) -> type | None:
    """Return the class of which a point is a method.

    None if it is not a method, or if its name leads to nothing.
    """
    try:
        owner, _ = resolve(point.name, UnknownPointError)
    except (UnknownPointError, PatchError):
        return None
    return owner if isinstance(owner, type) else None


def overrides(point: DecisionPoint) -> list[str]:
    """Return the dotted names of the functions by which derived classes override a point."""
    owner, attribute = owner_class(point), point.name.rpartition(".")[2]
    derived = [] if owner is None else [kind for kind in all_classes(owner) if kind is not owner]
    return [
        f"{kind.__module__}.{kind.__qualname__}.{attribute}"
        for kind in derived
        if attribute in vars(kind)
    ]


# -- points with their definitions ----------------------------------------------------------------


def find_points(
    points: Any, own: Definitions, *, empty: bool = False
) -> dict[DecisionPoint, Definition]:
    """Find the decision points that ``points=`` names, and the definition to use for each, in the order of the names.

    None names all decorated points. ``own`` are the points that the simulation itself defines.
    """
    if points is None:
        points = decision_points()
        packages = sorted({name.partition(".")[0] for name in points})
        if not points:
            raise UnknownPointError(
                "there is no decision point: decorate a function with make_step or name points="
            )
        if len(packages) > 1:
            raise UnknownPointError(
                f"decision points of more than one package are registered ({', '.join(packages)});"
                " say which are meant with points=, or with an attribute points of the simulation"
            )
    if isinstance(points, str) or not hasattr(points, "__iter__"):
        points = [points]
    found: dict[DecisionPoint, Definition] = {}
    for key, given in (
        points.items() if isinstance(points, Mapping) else [(key, None) for key in points]
    ):
        point, definition = find_point(key, given, own=own)
        if point in found:
            raise UnknownPointError(f"the decision point {point.name} was named twice")
        found[point] = definition
    if not found and not empty:
        raise UnknownPointError("no decision point was named: points is empty")
    return found


def find_point(
    key: Any, definition: Any = None, *, own: Definitions = _NONE
) -> tuple[DecisionPoint, Definition]:
    """Find one decision point by a dotted name or function, and the definition to use for it, as ``find_points``."""
    if definition is not None and not isinstance(definition, Definition):
        raise DefinitionError(
            f"the definition of {name_of(key)} must come from make_step, not"
            f" {short_repr(definition)}"
        )
    point = locate(key, own)
    decorated = None if isinstance(key, str) else point_of(getattr(key, "__func__", key))
    if decorated is not None:  # a name means the latest definition, a decision function its own
        definition = definition or decorated[1]
    definition = definition or own.get(point) or point.definition or _inherited(point)
    if definition is None:
        raise DefinitionError(
            f"{point.name} has no definition here: decorate it with make_step, or give its"
            f" definition in points={{{point.name!r}: make_step(...)}}"
        )
    return point, definition


def _inherited(point: DecisionPoint) -> Definition | None:
    """Return the definition that a class inherits, together with the decision function, from a base class."""
    if not isinstance(point, PlacedHook) or not point.inherited:
        return None
    known = point_of(raw_attribute(point.owner, point.attribute))
    return known and (known[1] or known[0].definition)


def _named(key: Any, points: Iterable[DecisionPoint]) -> DecisionPoint | None:
    """Return the one of some points that a key names."""
    return next(
        (point for point in points if key == point.name or unwrap(key) is point.function), None
    )


# -- agents and policies ---------------------------------------------------------------------------


def agent_names(definitions: Definitions) -> dict[DecisionPoint, str | None]:
    """Name the agent of each point; None if a callable names it."""
    owners: dict[str, DecisionPoint] = {}
    for point, definition in definitions.items():
        agent = definition.agent
        if isinstance(agent, str) and owners.setdefault(agent, point) is not point:
            raise AgentError(f"{owners[agent].name} and {point.name} have the same agent {agent!r}")
    names: dict[DecisionPoint, str | None] = {}
    for point, definition in definitions.items():
        agent, number = definition.agent, 0
        while agent is None:
            name, number = f"{point.letters}_{number}", number + 1
            agent = name if owners.setdefault(name, point) is point else None
        names[point] = agent if isinstance(agent, str) else None
    return names


def declared_agents(declared: Any) -> list[str]:
    """The names in ``possible_agents``."""
    if isinstance(declared, Mapping):
        return [name for names in declared.values() for name in names]
    return declared or []


def resolve_roster(
    active: list[Point], declared: Any, known: Collection[str | None]
) -> tuple[dict[str, Point], bool]:
    """Find out which agents are known beforehand, and whether there can be no others."""
    naming = [point.hook for point in active if point.agent is None]
    if declared is not None and not isinstance(declared, Mapping):
        others = [name for name in declared if name not in known]
        if len(naming) > 1 or (others and not naming):
            raise OptionValueError(
                "possible_agents must be a dict from decision points to names, unless exactly one"
                f" point names its agents by a callable; here {len(naming)} do"
            )
        declared = {point.name: others for point in naming}
    names: dict[DecisionPoint, list[Any]] = {}
    for key, value in (declared or {}).items():
        named = _named(key, naming)
        if named is None:
            raise OptionValueError(
                f"possible_agents names {short_repr(key)}, which is not an active decision point"
                f" with a callable as agent=; these are: {[point.name for point in naming]}"
            )
        names[named] = value
    roster: dict[str, Point] = {}
    for point in active:
        for name in names.get(point.hook, []) if point.agent is None else [point.agent]:
            if not isinstance(name, str) or name in roster:
                raise AgentError(
                    f"possible_agents must be different strings, not {short_repr(name)}"
                )
            roster[name] = point
    return roster, not naming or declared is not None


def resolve_policies(
    policies: Mapping[Any, Any], named: Definitions, own: Definitions
) -> tuple[dict[DecisionPoint, Any], dict[str, Any], dict[DecisionPoint, Definition]]:
    """Return the policies by point and by agent, and the named points with those that only ``policies`` names."""
    by_point: dict[DecisionPoint, Any] = {}
    by_agent: dict[str, Any] = {}
    definitions, agents = dict(named), agent_names(named).values()
    for key, value in policies.items():
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
                if isinstance(error, UnknownPointError) and None in agents and not _is_path(key):
                    by_agent[key] = policy  # a callable may name this agent later
                    continue
                names = sorted(
                    [agent for agent in agents if agent] + [point.name for point in named]
                )
                raise UnknownPointError(
                    f"policies names {short_repr(key)}, which is neither an agent nor a decision"
                    f" point ({error}); known are {', '.join(names)}"
                ) from error
            definitions.setdefault(point, definition)
        by_point[point] = policy
    return by_point, by_agent, definitions


def _is_path(key: Any) -> bool:
    """Whether a key can only be the dotted name of something in a module, and not the name of an agent."""
    if not isinstance(key, str):
        return True
    first, second = (*key.split("."), "")[:2]
    return bool(second) and (f"{first}.{second}" in modules or hasattr(modules.get(first), second))


# -- points in other processes --------------------------------------------------------------------


def portable(key: Any, name: str | None = None) -> Any:
    """Return a key for other processes: for a function its dotted name, if that surely leads to it.

    Else as it is.
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
    """A function of a class in the main module.

    Unpickled, it is the function, to which no name leads elsewhere.
    """

    owner: type
    name: str

    def __reduce__(self) -> Any:
        return getattr, (self.owner, self.name)
