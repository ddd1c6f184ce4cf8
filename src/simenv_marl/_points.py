"""Finding decision points: what ``points=`` names, and patches for what no one has decorated.

A *site* is the one place in a class or module at which a function is found. Where an environment names
an undecorated function, a decision function is set there for as long as an environment needs it; for
everybody else it runs what it replaced.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from sys import modules
from types import FunctionType, ModuleType
from typing import Any, ClassVar
from weakref import WeakValueDictionary

from .decision import DecisionPoint, Definition, point_of, registered, registered_names, unbind, unwrapped
from .errors import DefinitionError, PatchError, UnknownPointError


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
        raise DefinitionError(f"the definition of {_title(key)} must come from make_step, not {definition!r}")
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
    function, _ = unbind(key)
    known = point_of(function)
    if known is not None:
        site = Site.of(known[0])
        if site is None and known[0].definition is None:  # of a patch that is no longer there
            return _locate_name(known[0].name)
        return (*known, site)
    name = f"{function.__module__}.{function.__qualname__}"
    owner: Any
    try:
        owner, attribute = _resolve(name)
        found = unwrapped(_held(owner, attribute)) is function
    except (UnknownPointError, PatchError):
        found = False
    if not found:  # the function is at hand, though not by its name
        owner, attribute = _owner_at_hand(function), function.__name__
    return _look_at(name, owner, attribute)


def _locate_name(name: str) -> tuple[DecisionPoint, Definition | None, Site | None]:
    point = registered(name)
    try:
        owner, attribute = _resolve(name)
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
    held = _held(owner, attribute)
    return point_of(_plain(held)) is not None


def _look_at(name: str, owner: Any, attribute: str) -> tuple[DecisionPoint, Definition | None, Site | None]:
    held = _held(owner, attribute)
    known = point_of(_plain(held))
    if known is not None and attribute in vars(owner):
        return (*known, Site.of(known[0]))
    site = Site.at(name, owner, attribute)
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
    owners: list[Any] = [*_all_classes(), *(module for module in list(modules.values()) if hasattr(module, "__dict__"))]
    found = ((owner, vars(owner).get(name)) for owner in owners)
    return {owner for owner, held in found if isinstance(_plain(held), FunctionType) and _plain(held) in wrappers}


def _all_classes(base: type = object) -> Iterator[type]:
    """All classes that there are, or that derive from one."""
    seen: set[type] = set()
    left = [base]
    while left:
        owner = left.pop()
        if owner not in seen:
            seen.add(owner)
            yield owner
            left += type.__subclasses__(owner)


def _plain(held: Any) -> Any:
    """What a class or module holds, without its binding."""
    return held.__func__ if isinstance(held, (staticmethod, classmethod)) else held


def have_instances(one: type, other: type) -> bool:
    """Whether some object can be an instance of both classes, of all classes that there are now."""
    return any(issubclass(owner, other) for owner in _all_classes(one))


def owner_class(point: DecisionPoint) -> type | None:
    """The class that a point is a method of; None where it is none, or is not to be found by its name."""
    try:
        owner, _ = _resolve(point.name)
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


def _title(key: Any) -> str:
    return key if isinstance(key, str) else getattr(key, "__qualname__", repr(key))


# -- names ----------------------------------------------------------------------------------------


def _resolve(name: str) -> tuple[Any, str]:
    """Find the class or module in which a dotted name ends, importing what must be imported."""
    parts = name.split(".")
    if len(parts) < 2 or not all(parts):
        raise _unknown(name, "a dotted name is needed, such as package.module.Class.function")
    module, rest = _longest_module(parts)
    if module is None:
        raise _unknown(name, f"there is no module {parts[0]!r}")
    owner: Any = module
    for part in rest[:-1]:
        try:
            owner = getattr(owner, part)
        except AttributeError:
            raise _unknown(name, f"{_title(owner)} has no {part!r}") from None
    attribute = rest[-1]
    if isinstance(owner, type) and attribute.startswith("__") and not attribute.endswith("__"):
        attribute = f"_{owner.__name__.lstrip('_')}{attribute}"
    if not isinstance(owner, (type, ModuleType)):
        raise PatchError(f"{name} cannot be a decision point: {'.'.join(parts[:-1])} is no class or module")
    if not hasattr(owner, attribute):
        raise _unknown(name, f"{getattr(owner, '__name__', owner)} has no {attribute!r}")
    return owner, attribute


def _longest_module(parts: list[str]) -> tuple[ModuleType | None, list[str]]:
    module: ModuleType | None = None
    for length in range(1, len(parts)):
        path = ".".join(parts[:length])
        try:
            found = importlib.import_module(path)
        except ModuleNotFoundError as error:
            if error.name is not None and (path == error.name or path.startswith(f"{error.name}.")):
                return module, parts[length - 1 :]
            raise  # the module is there, and imports one that is not
        module = found
    return module, parts[-1:]


def _unknown(name: str, why: str) -> UnknownPointError:
    close = get_close_matches(name, registered_names(), n=3, cutoff=0.6)
    hint = f"; did you mean {' or '.join(close)}?" if close else ""
    return UnknownPointError(f"the decision point {name!r} is not to be found: {why}{hint}")


def _owner_at_hand(function: FunctionType) -> type:
    """Find the class that holds a function which is not found by its name, as inside another function."""
    for owner in _all_classes():
        if _plain(vars(owner).get(function.__name__)) is function:
            return owner
    raise PatchError(
        f"{function.__module__}.{function.__qualname__} is not what is found under that name, nor in any class;"
        " name it where it is found, or decorate it with make_step"
    )


# -- sites ----------------------------------------------------------------------------------------


def _held(owner: Any, attribute: str) -> Any:
    """What a class or module holds under a name, as it holds it (a staticmethod stays one)."""
    for place in owner.__mro__ if isinstance(owner, type) else (owner,):
        if attribute in vars(place):
            return vars(place)[attribute]
    return getattr(owner, attribute, None)


class Site:
    """A place at which a decision function is set while an environment needs it.

    There is one for each place, shared by all environments, however long any of them needs it.
    """

    _all: ClassVar[WeakValueDictionary[tuple[Any, str], Site]] = WeakValueDictionary()

    def __init__(self, name: str, owner: Any, attribute: str) -> None:
        held = _held(owner, attribute)
        function = _plain(held)
        if not isinstance(function, FunctionType):
            raise PatchError(
                f"{name} cannot be a decision point: it is a {type(held).__name__} and no function written in"
                " Python; name a function that it calls, or that calls it"
            )
        self._name, self._owner, self._attribute = name, owner, attribute
        self._held, self._inherited = held, attribute not in vars(owner)
        self._binding = type(held) if held is not function else None
        self._users = 0
        rule = _next_in_line(owner, attribute, function, self._binding) if self._inherited else function
        self.point = DecisionPoint(rule, name, bound=self._binding is not staticmethod, like=function)
        wrapper = self.point.wrap(None)
        self._wrapper: Any = wrapper if self._binding is None else self._binding(wrapper)

    @classmethod
    def at(cls, name: str, owner: Any, attribute: str) -> Site:
        """The site of an attribute of a class or module.

        Raises:
            PatchError: What stands there cannot be patched.
        """
        # A function of a module may have names in several modules, and is one site all the same.
        place = (owner, attribute) if isinstance(owner, type) else (_held(owner, attribute), "")
        site = cls._all.get(place)
        if site is None or site.stale:
            site = cls._all[place] = cls(name, owner, attribute)
        return site

    @classmethod
    def of(cls, point: DecisionPoint) -> Site | None:
        """The site at which a point is patched in; None for a decorated point."""
        return next((site for site in cls._all.values() if site.point is point), None)

    @property
    def stale(self) -> bool:
        """Whether something else has been set there, while no decision function was."""
        there = vars(self._owner).get(self._attribute)
        return self._users == 0 and there is not (None if self._inherited else self._held)

    def hold(self) -> None:
        """Have the decision function set until as many calls of ``let_go``.

        Raises:
            PatchError: The place refuses, or something else has been set there meanwhile.
        """
        if self.stale:
            raise PatchError(f"{self._name} has been replaced since it was named as a decision point")
        if self._users == 0:
            self._set(self._held, self._wrapper)
        self._users += 1

    def let_go(self) -> None:
        """Undo one ``hold``; the last one puts back what stood there."""
        self._users -= 1
        if self._users == 0:
            self._set(self._wrapper, self._held)

    def _set(self, old: Any, new: Any) -> None:
        if not isinstance(self._owner, type):
            # A function of a module is found also where other modules imported it by name.
            for module, name in _places_of(old):
                setattr(module, name, new)
            return
        try:
            if new is self._wrapper:
                setattr(self._owner, self._attribute, new)
            elif vars(self._owner).get(self._attribute) is not old:
                return  # somebody has set something else since: leave it alone
            elif self._inherited:
                delattr(self._owner, self._attribute)
            else:
                setattr(self._owner, self._attribute, new)
        except (TypeError, AttributeError) as error:
            raise PatchError(f"{self._name} cannot be a decision point: {error}") from error


def _places_of(function: Any) -> list[tuple[Any, str]]:
    """All names of loaded modules under which a function is found."""
    return [
        (module, name)
        for module in list(modules.values())
        if isinstance(module, ModuleType)
        for name, value in list(vars(module).items())
        if value is function
    ]


def _next_in_line(owner: type, attribute: str, function: FunctionType, binding: type | None) -> Any:
    """Make the rule of an inherited function: what the class would find without the patch, whenever it is called.

    What is found is looked up at each call, so that a patch of the base class is not passed over.
    """
    if binding is None:

        def rule(self: Any, /, *args: Any, **kwargs: Any) -> Any:
            return getattr(super(owner, self), attribute)(*args, **kwargs)

    elif issubclass(binding, classmethod):

        def rule(cls: Any, /, *args: Any, **kwargs: Any) -> Any:
            return getattr(super(owner, cls), attribute)(*args, **kwargs)

    else:

        def rule(*args: Any, **kwargs: Any) -> Any:  # type: ignore[misc]
            return getattr(super(owner, owner), attribute)(*args, **kwargs)

    rule.__name__, rule.__qualname__ = function.__name__, f"{owner.__qualname__}.{attribute}"
    rule.__module__, rule.__doc__ = owner.__module__, function.__doc__
    rule.__signature__ = inspect.signature(function)  # type: ignore[attr-defined]
    return rule
