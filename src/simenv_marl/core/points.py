"""Finding decision points: what ``points=`` names.

Where an environment names an undecorated function, a decision function is set at its place for as long as an
environment needs it: a *site*. For everybody else it runs what it replaced.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from sys import modules
from types import FunctionType
from typing import Any, ClassVar, Final
from weakref import WeakValueDictionary

from ..decision import DecisionPoint, Definition, point_of, registered, registered_names, unbind, unwrapped
from ..errors import DefinitionError, PatchError, UnknownPointError
from ..hooks.hook import beneath, exposure
from ..hooks.places import (
    DECIDED,
    Place,
    Purpose,
    all_classes,
    found_at,
    held_at,
    leads_there,
    owner_at_hand,
    plain,
    resolve,
    title,
)

POINT: Final = Purpose("decision point", UnknownPointError, registered_names)


@dataclass(frozen=True)
class NamedPoint:
    """A decision point as an environment was told to use it.

    Attributes:
        point: What is asked.
        definition: How the environment decides it.
        site: Where it is to be patched in; None for a decorated function, which needs no patching.
    """

    point: DecisionPoint
    definition: Definition
    site: Site | None

    @property
    def key(self) -> Any:
        """What names it in another process."""
        return portable(self.point.rule, self.point.name)

    @property
    def own_definition(self) -> Definition | None:
        """Its definition; None where that is the one which it was decorated with, and which comes along with it."""
        return None if self.site is None and self.definition is self.point.definition else self.definition


def portable(key: Any, name: str | None = None) -> Any:
    """What names a function in another process: its dotted name, if that is sure to lead to it there.

    Args:
        key: A function, or whatever somebody has named.
        name: Its dotted name, if that is known.
    """
    function = unwrapped(key)
    if not isinstance(function, FunctionType):
        return key
    name = name or f"{function.__module__}.{function.__qualname__}"
    return name if leads_there(name) else function


def find_points(points: Any, simulation: Any, *, required: bool = True) -> list[NamedPoint]:
    """Find all that ``points=`` names.

    Args:
        points: A dotted name, a function, a list of these, or a dict from these to definitions. None: the
            attribute ``points`` of the simulation, else all decorated points.
        simulation: The simulation.
        required: Whether all decorated points are meant where nobody names any, and not none.

    Returns:
        The points, in the order in which they were named.

    Raises:
        UnknownPointError: A name leads to nothing, or nothing is named.
        DefinitionError: A function has no definition, or a dict's value is none.
        PatchError: A function was named that cannot be made a decision point.
    """
    if points is None:
        points = getattr(simulation, "points", None)
    if points is None:
        if not required:
            return []
        points = _all_registered()
    if isinstance(points, Mapping):
        found = [find_point(key, definition) for key, definition in points.items()]
    else:
        if isinstance(points, str) or not hasattr(points, "__iter__"):
            points = [points]
        found = [find_point(key) for key in points]
    if not found:
        raise UnknownPointError("no decision point was named: points is empty")
    for number, named in enumerate(found):
        if any(named.point is other.point for other in found[:number]):
            raise UnknownPointError(f"the decision point {named.point.name} was named twice")
    return found


def find_point(key: Any, definition: Any = None) -> NamedPoint:
    """Find one decision point.

    Args:
        key: A dotted name, or a function.
        definition: The definition to use it with. None: the one that it was decorated with.

    Returns:
        The point, with the definition.

    Raises:
        UnknownPointError, DefinitionError, PatchError: As ``find_points``.
    """
    if definition is not None and not isinstance(definition, Definition):
        raise DefinitionError(f"the definition of {title(key)} must come from make_step, not {definition!r}")
    point, own, site = locate(key)
    definition = definition or own or point.definition
    if definition is None:
        raise DefinitionError(
            f"{point.name} has no definition here: decorate it with make_step, or give its definition in points="
            f"{{{point.name!r}: make_step(...)}}"
        )
    return NamedPoint(point, definition, site)


def locate(key: Any) -> tuple[DecisionPoint, Definition | None, Site | None]:
    """Find the point of a function, whether it has a definition or not.

    Args:
        key: A dotted name, or a function.

    Returns:
        The point; the definition that the function itself was decorated with; its site, if it needs one.

    Raises:
        UnknownPointError: The name leads to nothing.
        PatchError: It leads to something that cannot be patched.
    """
    if isinstance(key, str):
        return _locate_name(key)
    given, _ = unbind(key)
    place = getattr(exposure(given), "place", None)
    if place is not None:  # fetched while handlers were set in front of it
        return _locate_name(place.name) if place.stale else _look_at(place.name, place.owner, place.attribute)
    function = beneath(given)
    known = point_of(function)
    if known is not None:
        site = Site.of(known[0])
        if site is None and known[0].definition is None:  # of a patch that is no longer there
            return _locate_name(known[0].name)
        return (*known, site)
    name = f"{function.__module__}.{function.__qualname__}"
    owner: Any
    try:
        owner, attribute = resolve(name, POINT)
        found = unwrapped(held_at(owner, attribute)) is function
    except (UnknownPointError, PatchError):
        found = False
    if not found:  # the function is at hand, though not by its name
        owner, attribute = owner_at_hand(function), function.__name__
    return _look_at(name, owner, attribute)


def _locate_name(name: str) -> tuple[DecisionPoint, Definition | None, Site | None]:
    point = registered(name)
    try:
        owner, attribute = resolve(name, POINT)
    except (UnknownPointError, PatchError):
        if point is None:
            raise
        return point, None, Site.of(point)  # decorated inside a function, or not yet where it will be found
    found = _look_at(name, owner, attribute) if point is None or _is_decided(owner, attribute) else None
    if found is None or found[0] is point:
        assert point is not None
        return point, None, Site.of(point)
    return found[0], found[0].definition or found[1], found[2]


def _is_decided(owner: Any, attribute: str) -> bool:
    held = held_at(owner, attribute)
    return point_of(plain(held)) is not None


def _look_at(name: str, owner: Any, attribute: str) -> tuple[DecisionPoint, Definition | None, Site | None]:
    held = held_at(owner, attribute)
    known = point_of(plain(held))
    if known is not None and attribute in vars(owner):
        return (*known, Site.of(known[0]))
    site = Site.at(name, owner, attribute)
    known = known or point_of(plain(found_at(owner, attribute)))
    return site.point, (known[1] or known[0].definition) if known else None, site  # decorated in a base class


def stand_ins(point: DecisionPoint) -> list[DecisionPoint]:
    """The points whose calls are this one's, too: other decorations of the same function in the same place.

    A function that is decorated twice is one decision point with two definitions, whichever of its decision
    functions the model calls. Inherited by two classes, and decorated for each, it is two.
    """
    family = point.family()
    places = _decorated_places(point) if family else set()
    return [
        other
        for other in family
        if not places or not (others := _decorated_places(other)) or not places.isdisjoint(others)
    ]


def _decorated_places(point: DecisionPoint) -> set[Any]:
    """The classes and modules that have a decision function of the point under the function's own name."""
    name, wrappers = point.rule.__name__, set(point.wrappers)
    owners: list[Any] = [*all_classes(), *(module for module in list(modules.values()) if hasattr(module, "__dict__"))]
    found = ((owner, beneath(plain(vars(owner).get(name)))) for owner in owners)
    return {owner for owner, function in found if isinstance(function, FunctionType) and function in wrappers}


def have_instances(one: type, other: type) -> bool:
    """Whether some object can be an instance of both classes, of all classes that there are now."""
    return any(issubclass(owner, other) for owner in all_classes(one))


def owner_class(point: DecisionPoint) -> type | None:
    """The class that a point is a method of; None where it is none, or is not to be found by its name."""
    try:
        owner, _ = resolve(point.name, POINT)
    except (UnknownPointError, PatchError):
        return None
    return owner if isinstance(owner, type) else None


def _all_registered() -> list[str]:
    names = registered_names()
    packages = sorted({name.partition(".")[0] for name in names})
    if not names:
        raise UnknownPointError("there is no decision point: decorate a function with make_step or name points=")
    if len(packages) > 1:
        raise UnknownPointError(
            f"decision points of more than one package are registered ({', '.join(packages)}); say which are"
            " meant with points=, or with an attribute points of the simulation"
        )
    return names


class Site:
    """A place at which a decision function is set while an environment needs it.

    There is one for each place, shared by all environments, however long any of them needs it.
    """

    _all: ClassVar[WeakValueDictionary[Place, Site]] = WeakValueDictionary()

    def __init__(self, place: Place) -> None:
        if not isinstance(place.function, FunctionType):
            raise PatchError(
                f"{place.name} cannot be a decision point: what it exposes is no function written in Python"
            )
        self._place = place
        self.point = DecisionPoint(place.rule, place.name, bound=place.binding is not staticmethod, like=place.function)
        self._wrapper = self.point.wrap(None)

    @classmethod
    def at(cls, name: str, owner: Any, attribute: str) -> Site:
        """The site of an attribute of a class or module.

        Raises:
            PatchError: What stands there cannot be patched.
        """
        place = Place.at(name, owner, attribute, POINT)
        site = cls._all.get(place)
        if site is None:
            site = cls._all[place] = cls(place)
        return site

    @classmethod
    def of(cls, point: DecisionPoint) -> Site | None:
        """The site at which a point is patched in; None for a decorated point."""
        return next((site for site in cls._all.values() if site.point is point), None)

    @property
    def stale(self) -> bool:
        """Whether something else has been set there, while nothing of ours was."""
        return self._place.stale

    def hold(self) -> None:
        """Have the decision function set until as many calls of ``let_go``.

        Raises:
            PatchError: The place refuses, or something else has been set there meanwhile.
        """
        self._place.hold(DECIDED, lambda _: self._wrapper)

    def let_go(self) -> None:
        """Undo one ``hold``; the last one takes the decision function away."""
        self._place.let_go(DECIDED)
