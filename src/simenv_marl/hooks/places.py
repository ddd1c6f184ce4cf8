"""Places in a model: where a function is found by its dotted name, set, and put back.

A *place* is an attribute of a class; or a function of a module, under all names that loaded modules have for it.
While a hook is held whose function was neither decorated nor exposed, a stand-in is set at its place.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from sys import modules
from types import FunctionType, MethodType, ModuleType
from typing import Any, Final
from weakref import WeakValueDictionary

from ..errors import PatchError, meant, shown
from .attached import title
from .hook import Hook, beneath, hook_of
from .stacks import LOCK


@dataclass(frozen=True)
class Purpose:
    """What a name is looked up for, so that errors can say so.

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
        return self.error(f"the {self.noun} {name!r} is not to be found: {why}{meant(name, self.known())}")


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


def unbind(function: Any) -> tuple[FunctionType, type | None]:
    """Find the plain function under a binding.

    Args:
        function: A function, staticmethod or classmethod, or one of these as an attribute of its class.

    Returns:
        The function, and ``staticmethod`` or ``classmethod`` where it was bound so.

    Raises:
        PatchError: It is something else.
    """
    if isinstance(function, (staticmethod, classmethod)):
        inner, binding = function.__func__, type(function)
        if isinstance(inner, FunctionType):
            return inner, binding
    elif isinstance(function, MethodType):
        if isinstance(function.__self__, type) and isinstance(function.__func__, FunctionType):
            return function.__func__, classmethod
        raise PatchError(
            f"{shown(function)} is bound to one object; name the function of its class,"
            f" {type(function.__self__).__name__}.{function.__name__}"
        )
    elif isinstance(function, FunctionType):
        # A staticmethod that was fetched from its class is a plain function: see how the class holds it.
        owner: Any = modules.get(function.__module__)
        path = function.__qualname__.split(".")
        for name in path[:-1]:
            owner = getattr(owner, name, None)
        held = vars(owner).get(path[-1]) if isinstance(owner, type) else None
        if isinstance(held, staticmethod) and held.__func__ is function:
            return function, staticmethod
        return function, None
    raise PatchError(f"{shown(function)} is no function written in Python")


def leads_there(name: str) -> bool:
    """Whether a dotted name is sure to lead to the same in another process."""
    return "<" not in name and not name.startswith("__main__.")


def owner_at_hand(function: FunctionType) -> type:
    """Find the class that holds a function which is not found by its name, as inside another function.

    Raises:
        PatchError: There is none.
    """
    for owner in all_classes():
        if beneath(plain(vars(owner).get(function.__name__))) is function:
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
    """What a class holds or inherits under a name, apart from what is set for a while in front of the inherited."""
    for place in owner.__mro__ if isinstance(owner, type) else (owner,):
        held = vars(place).get(attribute)
        hook = hook_of(plain(held))
        if held is not None and not (hook is not None and hook.place is not None and hook.place.passes_on):
            return held
    return getattr(owner, attribute, None)


# -- places ---------------------------------------------------------------------------------------


class Place:
    """A place at which a function is found.

    Attributes:
        owner: The class or module.
        attribute: The function's name there.
        held: What stood there, as it stood there.
        function: The function, without its binding; where it is inherited, the base class's.
        binding: ``staticmethod``, ``classmethod`` or None.
        inherited: Whether the class only inherits it.
        passes_on: Whether the rule finds the inherited function, and so stands in front of the base class's.
    """

    def __init__(self, name: str, owner: Any, attribute: str, purpose: Purpose) -> None:
        """Look at a place.

        Raises:
            PatchError: What stands there cannot be patched.
        """
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
        self.held, self.function = held, beneath(function)
        self.inherited = self.passes_on = attribute not in vars(owner)
        self.binding: Any = type(held) if held is not function else None
        self._noun = purpose.noun
        self._before: dict[tuple[Any, str], Any] = {}  # what stood under names of modules

    @property
    def rule(self) -> Any:
        """What runs there: the function, or what finds the inherited one."""
        if not self.inherited:
            return self.function
        return _next_in_line(self.owner, self.attribute, self.function, self.binding)

    def is_free(self, hook: Hook) -> bool:
        """Whether what stands there is what stood there at first, or a stand-in of a hook."""
        there = vars(self.owner).get(self.attribute)
        return there is (None if self.inherited else self.held) or hook_of(plain(there)) is hook

    def put(self, hook: Hook, stand_in: FunctionType) -> None:
        """Set a stand-in of a hook, unless one stands there already.

        Raises:
            PatchError: The place refuses, or something else has been set there meanwhile.
        """
        if not self.is_free(hook):
            raise PatchError(f"{self.name} has been replaced since it was named as a {self._noun}")
        try:
            if not isinstance(self.owner, type):
                self._put_in_modules(stand_in)
            elif hook_of(plain(vars(self.owner).get(self.attribute))) is not hook:
                setattr(self.owner, self.attribute, stand_in if self.binding is None else self.binding(stand_in))
        except (TypeError, AttributeError) as error:
            raise PatchError(f"{self.name} cannot be a {self._noun}: {error}") from error

    def put_back(self, stand_in: FunctionType) -> None:
        """Put back what stood there, unless something else has been set meanwhile."""
        if not isinstance(self.owner, type):
            self._put_back_in_modules(stand_in)
        elif plain(vars(self.owner).get(self.attribute)) is not stand_in:
            pass  # which is left alone
        elif self.inherited:
            delattr(self.owner, self.attribute)
        else:
            setattr(self.owner, self.attribute, self.held)

    def _put_in_modules(self, stand_in: FunctionType) -> None:
        # A function is found also where other modules imported it by name, maybe before it was exposed.
        for module, name, value in _names_in_modules():
            if value is self.function or (value is self.held and hook_of(value) is None):
                self._before[module, name] = value
                setattr(module, name, stand_in)

    def _put_back_in_modules(self, stand_in: FunctionType) -> None:
        for module, name, value in _names_in_modules():
            if value is stand_in:
                setattr(module, name, self._before.get((module, name), self.held))
        self._before.clear()


def _names_in_modules() -> list[tuple[ModuleType, str, Any]]:
    """All that loaded modules have, with the names under which they have it."""
    return [
        (module, name, value)
        for module in list(modules.values())
        if isinstance(module, ModuleType)
        for name, value in vars(module).copy().items()
    ]


def places_of(function: Any) -> list[tuple[Any, str]]:
    """All names of loaded modules under which a function is found."""
    return [(module, name) for module, name, value in _names_in_modules() if value is function]


# -- hooks at places ------------------------------------------------------------------------------

_PLACED: Final[WeakValueDictionary[Any, Hook]] = WeakValueDictionary()
"""The hooks that are set for a while: by class and attribute, or by function of a module. Weak: they go with those who
hold them."""


def hook_at(name: str, owner: Any, attribute: str, purpose: Purpose) -> Hook:
    """The hook of an attribute of a class or module: the one that stands there, or one that can be set there.

    Raises:
        PatchError: What stands there cannot be patched.
    """
    with LOCK:
        held = held_at(owner, attribute)
        hook = hook_of(plain(held))
        if hook is not None and attribute in vars(owner):
            return hook
        # A function of a module may have names in several modules, and is one place all the same.
        key = (owner, attribute) if isinstance(owner, type) or not isinstance(held, FunctionType) else (held,)
        hook = _PLACED.get(key)
        if hook is None or not hook.place.is_free(hook):
            place = Place(name, owner, attribute, purpose)
            hook = _PLACED[key] = Hook(
                place.rule, name, bound=place.binding is not staticmethod, like=plain(held), place=place
            )
        return hook


class Held:
    """What is set in a model: until ``let_go``, and no longer than this object lives.

    Attributes:
        whole: Whether nothing of it was put back.
    """

    __slots__ = ("_holder", "_patches", "whole")

    def __init__(self, patches: Iterable[Any]) -> None:
        """Set it.

        Args:
            patches: Each with ``hold`` and ``let_go``.

        Raises:
            PatchError: A place refuses, and nothing is set.
        """
        self._holder, self.whole = object(), True
        self._patches = list(patches)
        try:
            for patch in self._patches:
                patch.hold(self._holder)
        except BaseException:
            self.let_go()
            raise

    def let_go(self) -> None:
        """Put back what stood there. After an interrupt it is to be called again, or does so itself when it is gone."""
        self.whole = False
        while self._patches:
            self._patches[-1].let_go(self._holder)
            self._patches.pop()

    def __del__(self) -> None:
        if getattr(self, "_patches", ()):  # else an interrupt came before it was made
            self.let_go()


def stays(hook: Hook) -> None:
    """A stand-in of a hook that was set for a while is going to stand somewhere for good."""
    with LOCK:
        hook.for_good = True
        for key in [key for key, other in _PLACED.items() if other is hook]:
            del _PLACED[key]


def imported_elsewhere(hook: Hook, purpose: Purpose) -> None:
    """See to it that an exposed function of a module is found where others had imported it before."""
    if hook.place is not None or hook.slot or not isinstance(hook.function, FunctionType):
        return
    owner: Any = None
    with suppress(Exception):  # where it is not found by its name, others may not find it either
        owner, attribute = resolve(hook.name, purpose)
    if isinstance(owner, ModuleType) and hook_of(held_at(owner, attribute)) is hook:
        hook.place = Place(hook.name, owner, attribute, purpose)


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
