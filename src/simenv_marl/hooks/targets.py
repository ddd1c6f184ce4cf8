"""Finds the targets of handlers: functions, iterables, and classes whose instances are iterable."""

import inspect
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import update_wrapper
from sys import modules
from types import FunctionType, MethodType
from typing import Any, Final
from weakref import WeakValueDictionary

from ..errors import PatchError, SimEnvError, UnknownTargetError, shown
from .attached import ITEMS, title
from .handlers import Items, Target, next_item
from .hook import Hook, beneath, hook_of
from .places import (
    Purpose,
    held_at,
    hook_at,
    imported_elsewhere,
    owner_at_hand,
    places_of,
    plain,
    resolve,
    stays,
    unbind,
)


def exposed_functions() -> list[str]:
    """Return the names of all targets that are exposed to plugins or have handlers."""
    return sorted({target.name for target in Target.all if target.exposed or target.slot})


TARGET: Final = Purpose("target of handlers", UnknownTargetError, exposed_functions)

# -- iterables ------------------------------------------------------------------------------------

_ONE = inspect.Signature([inspect.Parameter("iterable", inspect.Parameter.POSITIONAL_ONLY)])


class IterableTarget(Target):
    """An iterable, or a class whose instances are iterable."""

    def __init__(self, name: str, nature: str = "is not called: it is iterated over") -> None:
        super().__init__(name, ITEMS, nature, _ONE)


class NamedIterable(IterableTarget):
    """An iterable that is an attribute of a module or class. A proxy replaces it while it has handlers."""

    def __init__(self, name: str, owner: Any, attribute: str, iterable: Any) -> None:
        from .iterables import proxy

        super().__init__(name)
        self._owner, self._attribute, self._iterable = owner, attribute, iterable
        self._proxy, self._holders = proxy(iterable, self), set[object]()

    def hold(self, holder: object) -> None:
        """Set the proxy until every holder has called ``let_go``."""
        self._holders.add(holder)
        if len(self._holders) == 1:
            setattr(self._owner, self._attribute, self._proxy)

    def let_go(self, holder: object) -> None:
        """Undo ``hold``. After an interrupt, call it again."""
        self._holders.discard(holder)
        if not self._holders and vars(self._owner).get(self._attribute) is self._proxy:
            setattr(self._owner, self._attribute, self._iterable)


class ClassTarget(IterableTarget):
    """A class whose instances are iterable. While it has handlers, its ``__iter__`` and ``__next__`` are patched."""

    def __init__(self, owner: type) -> None:
        name = f"{owner.__module__}.{owner.__qualname__}"
        super().__init__(name, f"is a class: for its construction name {name}.__init__")
        self._hooks: list[tuple[Hook, Callable[[Any], Any]]] = []
        for attribute, wrap in (("__iter__", self._wrapped_iter), ("__next__", self._wrapped_next)):
            if hasattr(owner, attribute):
                self._hooks.append((hook_at(f"{name}.{attribute}", owner, attribute, TARGET), wrap))
        if not self._hooks:
            raise PatchError(
                f"{name} is a class whose instances do not iterate; to extend its construction name {name}.__init__"
            )

    @property
    def stale(self) -> bool:
        """Whether another object has replaced it while nothing was set in its place."""
        return any(hook.stale for hook, _ in self._hooks)

    def hold(self, holder: object) -> None:
        """Patch the class until every holder has called ``let_go``."""
        try:
            for hook, _ in self._hooks:
                hook.hold(holder)
        except BaseException:
            self.let_go(holder)
            raise

    def let_go(self, holder: object) -> None:
        """Undo ``hold``. After an interrupt, call it again."""
        for hook, _ in self._hooks:
            hook.let_go(holder)

    def _changed(self) -> None:
        for hook, wrap in self._hooks:
            hook.replace_rule(wrap(hook.function) if self.slot or self.exposed else None)

    def _wrapped_iter(self, rule: Any) -> Any:
        slot = self.slot

        def __iter__(iterable: Any) -> Any:  # noqa: N807
            iterator = rule(iterable)
            return iterator if iterator is iterable else Items(iterator, slot, iterable)

        return update_wrapper(__iter__, rule)

    def _wrapped_next(self, rule: Any) -> Any:
        slot = self.slot

        def __next__(iterable: Any) -> Any:  # noqa: N807
            return next_item(slot, lambda: rule(iterable), iterable)

        return update_wrapper(__next__, rule)


_CLASSES: Final[WeakValueDictionary[type, ClassTarget]] = WeakValueDictionary()


def _class_target(owner: type) -> ClassTarget:
    own = vars(owner).get("__simenv_marl_items__")
    if isinstance(own, ClassTarget):
        return own
    target = _CLASSES.get(owner)
    if target is None or target.stale:
        target = _CLASSES[owner] = ClassTarget(owner)
    return target


def exposed_iterable(thing: Any) -> Any:
    """Return the object if it is the proxy of an exposed iterable; else None."""
    iterables: Any = modules.get(f"{__package__}.iterables")
    return thing if iterables is not None and type(thing) in iterables.KINDS else None


def _iterates(thing: Any) -> bool:
    return isinstance(thing, Iterable) or (hasattr(type(thing), "__getitem__") and hasattr(type(thing), "__len__"))


# -- exposing -------------------------------------------------------------------------------------


def expose(thing: Any) -> Any:
    """Expose a function or iterable, as ``expose_to_plugins`` does."""
    if isinstance(thing, type):
        target = _class_target(thing)
        if not target.exposed:
            target.exposed = True
            target.hold(target)
            target._changed()
            thing.__simenv_marl_items__ = target  # type: ignore[attr-defined]
        return thing
    if exposed_iterable(thing) is not None:
        return thing
    if isinstance(thing, (staticmethod, classmethod, FunctionType, MethodType)):
        return _expose_function(thing)
    if _iterates(thing):
        from .iterables import expose as expose_iterable  # its dependency imports asyncio, which slows down decisions

        return expose_iterable(thing)
    if callable(thing):
        hook = Hook(thing, f"{getattr(thing, '__module__', None) or '?'}.{title(thing)}")
        hook.exposed = True
        return hook.stand_in()
    raise PatchError(f"{shown(thing)} cannot be exposed to plugins: it is neither a function nor an iterable")


def _expose_function(thing: Any) -> Any:
    given, binding = unbind(thing)
    hook = hook_of(given)
    if hook is None:
        there = _at_own_name(given)
        hook = hook_of(there)
        if hook is not None and hook.exposed and hook.function is given:
            given = there  # already exposed
        else:
            name = f"{given.__module__}.{given.__qualname__}"
            hook = Hook(given, name, bound=binding is not staticmethod)
            given = hook.stand_in()
    elif not hook.for_good:  # fetched while its hook was set temporarily
        stays(hook)
        given = hook.stand_in()
    hook.exposed = True
    if isinstance(thing, (staticmethod, classmethod)) and thing.__func__ is given:
        return thing
    return given if binding is None else binding(given)


def _at_own_name(function: FunctionType) -> Any:
    try:
        owner, attribute = resolve(f"{function.__module__}.{function.__qualname__}", TARGET)
    except (SimEnvError, ImportError):
        return None
    return plain(vars(owner).get(attribute))


# -- finding --------------------------------------------------------------------------------------


def find_target(target: Any) -> Target:
    """Find the target for handlers.

    Args:
        target: A function, an iterable or a class, or its dotted name.

    Raises:
        UnknownTargetError: The name does not exist.
        PatchError: It is not exposed and cannot be patched.
    """
    if isinstance(target, str):
        try:
            owner, attribute = resolve(target, TARGET)
        except (UnknownTargetError, PatchError):
            named = [other for other in Target.all if other.name == target and other.exposed]
            if not named:
                raise
            return max(named, key=lambda other: other.number)  # exposed inside a function, under the latest's name
        return _look_at(target, owner, attribute)
    if isinstance(target, type):
        return _class_target(target)
    if exposed_iterable(target) is not None:
        found: Target = target._self_target
        return found
    if not isinstance(target, (staticmethod, classmethod, FunctionType, MethodType)):
        raise PatchError(
            f"no handlers can be attached to {shown(target)}: expose it to plugins, and name what that returns; or give"
            " its dotted name"
        )
    function, _ = unbind(target)
    hook = hook_of(function)
    return at_hand(hook) if hook is not None else _of_function(function)


def at_hand(hook: Hook) -> Target:
    """Return the hook of a function; if that was a temporary one, the hook that is at its place now."""
    if hook.stale:
        if not hook.for_good:
            return find_target(hook.name)
        hook.place = None
    if hook.exposed:
        imported_elsewhere(hook, TARGET)
    return hook


def _of_function(function: FunctionType) -> Target:
    """Return the target of a function that is not exposed, found by its name or in a class."""
    name = f"{function.__module__}.{function.__qualname__}"
    owner: Any = None
    attribute = function.__name__
    with suppress(SimEnvError, ImportError):
        owner, attribute = resolve(name, TARGET)
    if owner is None or beneath(plain(held_at(owner, attribute))) is not function:
        names = places_of(function)
        owner, attribute = names[0] if names else (owner_at_hand(function), function.__name__)
        name = f"{getattr(owner, '__qualname__', owner.__name__)}.{attribute}"
        name = f"{owner.__module__}.{name}" if isinstance(owner, type) else name
    return _look_at(name, owner, attribute)


def _look_at(name: str, owner: Any, attribute: str) -> Target:
    held = held_at(owner, attribute)
    if isinstance(held, type):
        return _class_target(held)
    if exposed_iterable(held) is not None:
        return find_target(held)
    if not isinstance(plain(held), FunctionType) and _iterates(held) and not isinstance(held, (str, bytes)):
        return NamedIterable(name, owner, attribute, held)
    return at_hand(hook_at(name, owner, attribute, TARGET))
