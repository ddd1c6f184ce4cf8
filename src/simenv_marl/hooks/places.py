"""Places in a model, and what is to stand there: patches for what no one has decorated or exposed.

A *place* is where a function is found: an attribute of a class, or of a module, and then under all names
that loaded modules have for it. Others hold it at one of its *levels* for as long as they need something in
front of the function, or in its stead; what stands there is composed of the levels that are held, and when
nobody holds it any more it is what stood there before.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from difflib import get_close_matches
from sys import modules
from types import FunctionType, ModuleType
from typing import Any, ClassVar, Final
from weakref import WeakValueDictionary

from ..decision import point_of, unwrapped
from ..errors import PatchError
from .hook import beneath, exposure

DECIDED: Final = 0
"""The level of decision functions, which are in the place of the function."""

ITERATED: Final = 1
"""The level of what hands out the items of a class's instances."""

HANDLED: Final = 2
"""The level of exposed functions: handlers lie outside everything else."""

Wrap = Callable[[Any], Any]
"""Makes what stands in front of a function."""


@dataclass(frozen=True)
class Purpose:
    """What somebody looks a name up for, so that errors can say so.

    Attributes:
        noun: What is looked for.
        error: What is raised where it is not to be found.
        known: Returns the names that may have been meant.
    """

    noun: str
    error: type[Exception]
    known: Callable[[], list[str]]

    def unknown(self, name: str, why: str) -> Exception:
        """The error that says that a name leads to nothing."""
        close = get_close_matches(name, self.known(), n=3, cutoff=0.6)
        hint = f"; did you mean {' or '.join(close)}?" if close else ""
        return self.error(f"the {self.noun} {name!r} is not to be found: {why}{hint}")


# -- names ----------------------------------------------------------------------------------------


def resolve(name: str, purpose: Purpose) -> tuple[Any, str]:
    """Find the class or module in which a dotted name ends, importing what must be imported.

    Raises:
        PatchError: It ends in something else.
        Exception: The purpose's own, where the name leads to nothing.
    """
    parts = name.split(".")
    if len(parts) < 2 or not all(parts):
        raise purpose.unknown(name, "a dotted name is needed, such as package.module.Class.function")
    module, rest = _longest_module(parts)
    if module is None:
        raise purpose.unknown(name, f"there is no module {parts[0]!r}")
    owner: Any = module
    for part in rest[:-1]:
        try:
            owner = getattr(owner, part)
        except AttributeError:
            raise purpose.unknown(name, f"{title(owner)} has no {part!r}") from None
    attribute = rest[-1]
    if isinstance(owner, type) and attribute.startswith("__") and not attribute.endswith("__"):
        attribute = f"_{owner.__name__.lstrip('_')}{attribute}"
    if not isinstance(owner, (type, ModuleType)):
        raise PatchError(f"{name} cannot be a {purpose.noun}: {'.'.join(parts[:-1])} is no class or module")
    if not hasattr(owner, attribute):
        raise purpose.unknown(name, f"{getattr(owner, '__name__', owner)} has no {attribute!r}")
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


def leads_there(name: str) -> bool:
    """Whether a dotted name is sure to lead to the same in another process."""
    return "<" not in name and not name.startswith("__main__.")


def title(key: Any) -> str:
    """What to call whatever somebody has named."""
    return key if isinstance(key, str) else getattr(key, "__qualname__", repr(key))


def owner_at_hand(function: FunctionType) -> type:
    """Find the class that holds a function which is not found by its name, as inside another function.

    Raises:
        PatchError: There is none.
    """
    for owner in all_classes():
        held = beneath(plain(vars(owner).get(function.__name__)))
        if held is function or unwrapped(held) is function:
            return owner
    raise PatchError(
        f"{function.__module__}.{function.__qualname__} is not what is found under that name, nor in any class;"
        " name it where it is found, or decorate it"
    )


def all_classes(base: type = object) -> Iterator[type]:
    """All classes that there are, or that derive from one."""
    seen: set[type] = set()
    left = [base]
    while left:
        owner = left.pop()
        if owner not in seen:
            seen.add(owner)
            yield owner
            left += type.__subclasses__(owner)


def plain(held: Any) -> Any:
    """What a class or module holds, without its binding."""
    return held.__func__ if isinstance(held, (staticmethod, classmethod)) else held


def held_at(owner: Any, attribute: str) -> Any:
    """What a class or module holds under a name, as it holds it (a staticmethod stays one)."""
    for place in owner.__mro__ if isinstance(owner, type) else (owner,):
        if attribute in vars(place):
            return vars(place)[attribute]
    return getattr(owner, attribute, None)


def found_at(owner: Any, attribute: str) -> Any:
    """What a class holds or inherits under a name, apart from what is set there for a while."""
    place = Place.known(owner, attribute)
    return held_at(owner, attribute) if place is None else place.held


def lasting(function: Any) -> Any:
    """A function without its handlers, and without the decision function that is set there for a while."""
    function = beneath(function)
    known = point_of(function)
    return unwrapped(function) if known is not None and known[1] is None else function


# -- places ---------------------------------------------------------------------------------------


class Place:
    """A place at which a function is found. There is one for each, shared by all who need it.

    Attributes:
        owner: The class or module.
        attribute: The function's name there.
        name: Its dotted name.
        function: The function, without its binding and its handlers; where it is inherited, the base class's.
        held: What stood there, as it stood there.
        rule: What runs when nobody has set anything: the function, or what finds the inherited one.
        binding: ``staticmethod``, ``classmethod`` or None.
        exposure: The target of handlers that it has of its own, in front of it for good; None if it has none.
        target, items: The targets of handlers that come and go with them, of calls and of a class's items; None as
            long as nobody has asked for them.
    """

    _all: ClassVar[WeakValueDictionary[tuple[Any, str], Place]] = WeakValueDictionary()

    def __init__(self, name: str, owner: Any, attribute: str, purpose: Purpose) -> None:
        held = held_at(owner, attribute)
        function = plain(held)
        slot = inspect.ismethoddescriptor(held) and not isinstance(held, (staticmethod, classmethod))
        inherited_slot = slot and attribute in ("__iter__", "__next__") and attribute not in vars(owner)
        if not isinstance(function, FunctionType) and not inherited_slot:
            raise PatchError(
                f"{name} cannot be a {purpose.noun}: it is a {type(held).__name__} and no function written in"
                " Python; name a function that it calls, or that calls it"
            )
        self.owner, self.attribute, self.name = owner, attribute, name
        self.held, self.inherited = held, attribute not in vars(owner)
        self.binding = type(held) if held is not function else None
        self.function = beneath(function)
        self.exposure = None if self.inherited else exposure(function)
        self.target: Any = None
        self.items: Any = None
        self.rule = _next_in_line(owner, attribute, self.function, self.binding) if self.inherited else self.function
        self._purpose = purpose
        self._levels: dict[int, int] = {}  # how many hold each level
        self._wraps: dict[int, Wrap] = {}
        self._made: dict[tuple[int, ...], Any] = {}  # what stands there, by the levels that are held
        self._former: list[Any] = []  # what has stood there since
        self._before: dict[tuple[Any, str], Any] = {}  # what stood under a name of a module

    @classmethod
    def at(cls, name: str, owner: Any, attribute: str, purpose: Purpose) -> Place:
        """The place of an attribute of a class or module.

        Raises:
            PatchError: What stands there cannot be patched.
        """
        # A function of a module may have names in several modules, and is one place all the same.
        held = held_at(owner, attribute)
        key = (owner, attribute) if isinstance(owner, type) else (lasting(held), "")
        place = cls._all.get(key)
        if place is None or place.stale:
            place = cls._all[key] = cls(name, owner, attribute, purpose)
        return place

    @classmethod
    def known(cls, owner: Any, attribute: str) -> Place | None:
        """The place of an attribute of a class, if somebody holds it."""
        place = cls._all.get((owner, attribute)) if isinstance(owner, type) else None
        return place if place is not None and place._levels else None

    @property
    def stale(self) -> bool:
        """Whether something else has been set there, while nobody held it."""
        there = vars(self.owner).get(self.attribute)
        return not self._levels and there is not (None if self.inherited else self.held)

    def hold(self, level: int, wrap: Wrap) -> None:
        """Have something set there until as many calls of ``let_go``.

        Args:
            level: At which level.
            wrap: Makes it, of what stands at the levels below. The same for all who hold this level.

        Raises:
            PatchError: The place refuses, or something else has been set there meanwhile.
        """
        if self.stale:
            raise PatchError(f"{self.name} has been replaced since it was named as a {self._purpose.noun}")
        self._wraps[level] = wrap
        # Counted at once: the collector may come in between and close an environment that holds it, too.
        self._levels[level] = self._levels.get(level, 0) + 1
        if self._levels[level] == 1:
            try:
                self._set()
            except BaseException:
                del self._levels[level]
                with suppress(PatchError):
                    self._set()
                raise

    def let_go(self, level: int) -> None:
        """Undo one ``hold``; the last one puts back what stood there."""
        if self._levels[level] > 1:
            self._levels[level] -= 1
        else:
            del self._levels[level]
            try:
                self._set()
            except BaseException:  # an interrupt has come in between
                self._set()
                raise

    @classmethod
    def where(cls, function: Any) -> Place | None:
        """The place at which a function is set for a while, or was until lately."""
        for place in list(cls._all.values()):
            if not place.stale and any(
                plain(made) is function or beneath(plain(made)) is function for made in place._made.values()
            ):
                return place
        return None

    def expose(self, target: Any) -> Any:
        """Have an exposed function stand there for good, also when nobody holds the place any more.

        Args:
            target: The target that it is to belong to.

        Returns:
            What now stands there.
        """
        wrapped = target.wrap(self.rule)
        self._former += [self.held, *self._made.values()]
        self._made.clear()
        self._before.clear()
        self.held = wrapped if self.binding is None else self.binding(wrapped)
        self.exposure, self.inherited = target, False
        self._set()
        return self._compose()

    def _compose(self) -> Any:
        """What is to stand there."""
        levels = tuple(sorted(self._levels))
        if not levels:
            return self.held
        if levels not in self._made:
            made = self.rule
            for level in levels:
                if level != HANDLED or self.exposure is None:
                    made = self._wraps[level](made)
            if self.exposure is not None:
                # Its own handlers stay outside; where nothing lies beneath them, it is what stood there.
                made = plain(self.held) if made is self.rule else self.exposure.wrap(made)
            self._made[levels] = made if self.binding is None else self.binding(made)
        return self._made[levels]

    def _set(self) -> None:
        new = None
        try:
            while new is None or self._compose() is not new:  # which may have changed meanwhile
                new = self._compose()
                if isinstance(self.owner, type):
                    self._set_in_class(new)
                else:
                    self._set_in_modules(new)
        except (TypeError, AttributeError) as error:
            raise PatchError(f"{self.name} cannot be a {self._purpose.noun}: {error}") from error

    def _set_in_class(self, new: Any) -> None:
        there = vars(self.owner).get(self.attribute)
        ours = [self.held, *self._made.values(), *self._former]
        if there is not None and not any(there is own for own in ours):
            return  # somebody has set something else since: leave it alone
        if new is not self.held or not self.inherited:
            setattr(self.owner, self.attribute, new)
        elif there is not None:
            delattr(self.owner, self.attribute)

    def _set_in_modules(self, new: Any) -> None:
        # A function of a module is found also where other modules imported it by name, maybe before it was exposed.
        originals = [self.held, self.function]
        ours = {id(own) for own in (*originals, *self._made.values(), *self._former)}
        for module in list(modules.values()):
            if not isinstance(module, ModuleType):
                continue
            for name, value in list(vars(module).items()):
                if id(value) not in ours:
                    continue
                if any(value is original for original in originals):
                    self._before.setdefault((module, name), value)
                setattr(module, name, new if self._levels else self._before.get((module, name), self.held))
        if not self._levels:
            self._before.clear()


def places_of(function: Any) -> list[tuple[Any, str]]:
    """All names of loaded modules under which a function is found."""
    return [
        (module, name)
        for module in list(modules.values())
        if isinstance(module, ModuleType)
        for name, value in list(vars(module).items())
        if value is function
    ]


def _next_in_line(owner: type, attribute: str, function: Any, binding: type | None) -> Any:
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
