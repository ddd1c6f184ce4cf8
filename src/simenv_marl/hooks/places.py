"""Places in a model: a function is found there by its dotted name, a stand-in is set, and the original is restored.

A *place* is an attribute of a class; or a function of a module, under all names that loaded modules have for it. If a
function was neither decorated nor exposed, a stand-in is at its place while its hook is held.
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
    """The purpose of looking up a name, for error messages.

    Attributes:
        noun: What is looked for.
        error: The exception class for a name that does not exist.
        known: A function that returns names for suggestions.
    """

    noun: str
    error: type[Exception]
    known: Callable[[], list[str]]

    def unknown(self, name: str, why: str) -> Exception:
        """Return the error for a name that does not exist."""
        return self.error(f"the {self.noun} {name!r} is not to be found: {why}{meant(name, self.known())}")


# -- names ----------------------------------------------------------------------------------------


def resolve(name: str, purpose: Purpose) -> tuple[Any, str]:
    """Find the class or module that holds a dotted name, and import modules on the way.

    Raises:
        PatchError: The holder is something else.
        Exception: The purpose's error, if the name does not exist.
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
            raise  # the module exists, but imports one that does not
        module = found
    return module, parts[-1:]


def unbind(function: Any) -> tuple[FunctionType, type | None]:
    """Find the plain function behind a binding.

    Args:
        function: A function, staticmethod or classmethod, or one of these as an attribute of its class.

    Returns:
        The function, and its binding: ``staticmethod``, ``classmethod`` or None.

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
        # A staticmethod, fetched from its class, is a plain function: check how the class holds it.
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
    """Return whether a dotted name certainly refers to the same object in another process."""
    return "<" not in name and not name.startswith("__main__.")


def owner_at_hand(function: FunctionType) -> type:
    """Find the class of a function that its dotted name does not lead to, such as one inside another function.

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
    """Yield all existing classes, or those that derive from one."""
    seen: set[type] = set()
    left = [base]
    while left:
        owner = left.pop()
        if owner not in seen:
            seen.add(owner)
            yield owner
            left += type.__subclasses__(owner)


def plain(held: Any) -> Any:
    """Return an attribute of a class or module without its binding."""
    return held.__func__ if isinstance(held, (staticmethod, classmethod)) else held


def held_at(owner: Any, attribute: str) -> Any:
    """Return an attribute as the class or module holds it (a staticmethod stays one)."""
    for place in owner.__mro__ if isinstance(owner, type) else (owner,):
        if attribute in vars(place):
            return vars(place)[attribute]
    return getattr(owner, attribute, None)


def found_at(owner: Any, attribute: str) -> Any:
    """Return what a class holds or inherits under a name, without temporary stand-ins of the inherited function."""
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
        held: The original attribute, as the owner held it.
        function: The function, without its binding; if it is inherited, that of the base class.
        binding: ``staticmethod``, ``classmethod`` or None.
        inherited: Whether the class only inherits it.
        passes_on: Whether the rule looks up the inherited function and so runs in front of the base class's stand-in.
    """

    def __init__(self, name: str, owner: Any, attribute: str, purpose: Purpose) -> None:
        """Inspect a place.

        Raises:
            PatchError: The attribute cannot be patched.
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
        self._before: dict[tuple[Any, str], Any] = {}  # the original attributes of modules

    @property
    def rule(self) -> Any:
        """Return the function to run: the function itself, or one that looks up the inherited one."""
        if not self.inherited:
            return self.function
        return _next_in_line(self.owner, self.attribute, self.function, self.binding)

    def is_free(self, hook: Hook) -> bool:
        """Return whether the place holds the original, or a stand-in of a hook."""
        there = vars(self.owner).get(self.attribute)
        return there is (None if self.inherited else self.held) or hook_of(plain(there)) is hook

    def put(self, hook: Hook, stand_in: FunctionType) -> None:
        """Set a stand-in of a hook, unless one is there already.

        Raises:
            PatchError: The place cannot be patched, or something else was set there meanwhile.
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
        """Restore the original, unless something else was set meanwhile."""
        if not isinstance(self.owner, type):
            self._put_back_in_modules(stand_in)
        elif plain(vars(self.owner).get(self.attribute)) is not stand_in:
            pass  # leave it alone
        elif self.inherited:
            delattr(self.owner, self.attribute)
        else:
            setattr(self.owner, self.attribute, self.held)

    def _put_in_modules(self, stand_in: FunctionType) -> None:
        # Other modules may have imported the function by name, maybe before it was exposed.
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
    """Return all attributes of loaded modules, with their names."""
    return [
        (module, name, value)
        for module in list(modules.values())
        if isinstance(module, ModuleType)
        for name, value in vars(module).copy().items()
    ]


def places_of(function: Any) -> list[tuple[Any, str]]:
    """Return all modules and names under which a function is found."""
    return [(module, name) for module, name, value in _names_in_modules() if value is function]


# -- hooks at places ------------------------------------------------------------------------------

_PLACED: Final[WeakValueDictionary[Any, Hook]] = WeakValueDictionary()
"""The temporary hooks, by class and attribute, or by function of a module. Weak: they live as long as their
holders."""


def hook_at(name: str, owner: Any, attribute: str, purpose: Purpose) -> Hook:
    """Return the hook of an attribute of a class or module: the existing one, or one that can be set there.

    Raises:
        PatchError: The attribute cannot be patched.
    """
    with LOCK:
        held = held_at(owner, attribute)
        hook = hook_of(plain(held))
        if hook is not None and attribute in vars(owner):
            return hook
        # A function of a module is one place, even if several modules have it.
        key = (owner, attribute) if isinstance(owner, type) or not isinstance(held, FunctionType) else (held,)
        hook = _PLACED.get(key)
        if hook is None or not hook.place.is_free(hook):
            place = Place(name, owner, attribute, purpose)
            hook = _PLACED[key] = Hook(
                place.rule, name, bound=place.binding is not staticmethod, like=plain(held), place=place
            )
        return hook


class Held:
    """Patches of a model, in force until ``let_go`` or until this object is garbage-collected.

    Attributes:
        whole: Whether nothing was restored yet.
    """

    __slots__ = ("_holder", "_patches", "whole")

    def __init__(self, patches: Iterable[Any]) -> None:
        """Set the patches.

        Args:
            patches: Objects with ``hold`` and ``let_go``.

        Raises:
            PatchError: A place cannot be patched; then no patch stays set.
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
        """Restore the originals. After an interrupt, call it again; else garbage collection does."""
        self.whole = False
        while self._patches:
            self._patches[-1].let_go(self._holder)
            self._patches.pop()

    def __del__(self) -> None:
        if getattr(self, "_patches", ()):  # missing if an interrupt came in the constructor
            self.let_go()


def stays(hook: Hook) -> None:
    """Note that a temporary stand-in of a hook becomes permanent somewhere."""
    with LOCK:
        hook.for_good = True
        for key in [key for key, other in _PLACED.items() if other is hook]:
            del _PLACED[key]


def imported_elsewhere(hook: Hook, purpose: Purpose) -> None:
    """Expose a function of a module also where other modules imported it earlier."""
    if hook.place is not None or hook.slot or not isinstance(hook.function, FunctionType):
        return
    owner: Any = None
    with suppress(Exception):  # if its name does not lead to it, others may not have it either
        owner, attribute = resolve(hook.name, purpose)
    if isinstance(owner, ModuleType) and hook_of(held_at(owner, attribute)) is hook:
        hook.place = Place(hook.name, owner, attribute, purpose)


def _next_in_line(owner: type, attribute: str, function: Any, binding: type | None) -> Any:
    """Make the rule of an inherited function: it calls what the class would find without the patch.

    The lookup happens at each call, so that a patch of the base class takes effect, too.
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
