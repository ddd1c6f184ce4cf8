"""Finds and exposes the targets of handlers: functions, iterables, and classes whose instances are iterable."""

import inspect
from collections.abc import Callable, Iterable
from functools import partial
from sys import modules
from types import FunctionType, MethodType
from typing import Any, Final

from ..errors import PatchError, UnknownTargetError, name_of, short_repr
from .handlers import ITEMS
from .hook import Hook, hook_of
from .places import (
    Purpose,
    extend_to_importers,
    find_hook,
    hook_at,
    permanent_hook,
    raw_attribute,
    resolve,
    split_binding,
    unbind,
)
from .targets import Items, Slot, Target, next_item


def exposed_functions() -> list[str]:
    """Return the names of all targets that are exposed to plugins or have handlers."""
    return sorted({target.name for target in Target.all if target.exposed or target.slot})


TARGET: Final = Purpose("target of handlers", UnknownTargetError, exposed_functions)

_FUNCTIONS: Final = (staticmethod, classmethod, FunctionType, MethodType)

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
        self._proxy = proxy(iterable, self)

    def _apply(self) -> None:
        setattr(self._owner, self._attribute, self._proxy)

    def _revert(self) -> None:
        if vars(self._owner).get(self._attribute) is self._proxy:
            setattr(self._owner, self._attribute, self._iterable)


class ClassTarget(IterableTarget):
    """A class whose instances are iterable. While it has handlers, its ``__iter__`` and ``__next__`` are patched."""

    def __init__(self, owner: type) -> None:
        name = f"{owner.__module__}.{owner.__qualname__}"
        self._hooks = {
            attribute: hook_at(f"{name}.{attribute}", owner, attribute, TARGET)
            for attribute in _RULES
            if hasattr(owner, attribute)
        }
        if not self._hooks:
            raise PatchError(
                f"{name} is a class whose instances are not iterable; to extend its construction, name {name}.__init__"
            )
        self.owner = owner
        super().__init__(name, f"is a class: to extend its construction, name {name}.__init__")

    @property
    def stale(self) -> bool:
        """Whether another object has replaced it while nothing was set in its place."""
        return any(hook.stale for hook in self._hooks.values())

    def _apply(self) -> None:
        for hook in self._hooks.values():
            hook.install(self)

    def _revert(self) -> None:
        for hook in self._hooks.values():
            hook.uninstall(self)

    def _changed(self) -> None:
        for attribute, hook in self._hooks.items():
            with_handlers = partial(_RULES[attribute], self.slot, hook.function)
            hook.replace_rule(with_handlers if self.slot or self.exposed else None)


def _iter(slot: Slot, rule: Callable[[Any], Any], iterable: Any) -> Any:
    """Run an ``__iter__``, whose items pass through handlers."""
    iterator = rule(iterable)
    return iterator if iterator is iterable else Items(iterator, slot, iterable)


def _next(slot: Slot, rule: Callable[[Any], Any], iterable: Any) -> Any:
    """Run a ``__next__``, whose item passes through handlers."""
    return next_item(slot, partial(rule, iterable), iterable)


_RULES: Final = {"__iter__": _iter, "__next__": _next}


def _class_target(owner: type) -> ClassTarget:
    for target in list(Target.all):
        if isinstance(target, ClassTarget) and target.owner is owner and not target.stale:
            return target
    return ClassTarget(owner)


def _is_exposed_iterable(thing: Any) -> bool:
    iterables: Any = modules.get(f"{__package__}.iterables")
    return iterables is not None and type(thing) in iterables.PROXIES


def _is_iterable(thing: Any) -> bool:
    return isinstance(thing, Iterable) or (hasattr(type(thing), "__getitem__") and hasattr(type(thing), "__len__"))


# -- exposing -------------------------------------------------------------------------------------


def expose(thing: Any) -> Any:
    """Expose a function or iterable, as ``expose_to_plugins`` does."""
    if isinstance(thing, type):
        target = _class_target(thing)
        target.exposed = True
        target.install(target)  # which keeps the target alive as long as its class
        target._changed()
        return thing
    if _is_exposed_iterable(thing):
        return thing
    if isinstance(thing, _FUNCTIONS):
        return _expose_function(thing)
    if _is_iterable(thing):
        from .iterables import expose as expose_iterable  # its dependency imports asyncio, which slows down decisions

        return expose_iterable(thing)
    if callable(thing):
        hook = Hook(thing, f"{getattr(thing, '__module__', None) or '?'}.{name_of(thing)}")
        hook.exposed = True
        return hook.make_wrapper()
    raise PatchError(f"{short_repr(thing)} cannot be exposed to plugins: it is neither a function nor an iterable")


def _expose_function(thing: Any) -> Any:
    function, binding = split_binding(thing)
    wrapper = _permanent_wrapper(function)
    hook = hook_of(wrapper) or permanent_hook(thing)[0]
    if wrapper is None:
        wrapper = hook.make_wrapper()
    hook.exposed = True
    if isinstance(thing, (staticmethod, classmethod)) and thing.__func__ is wrapper:
        return thing
    return wrapper if binding is None else binding(wrapper)


def _permanent_wrapper(function: FunctionType) -> Any:
    """Return the wrapper of a function that is decorated or exposed already; None if there is none."""
    hook = hook_of(function)
    if hook is not None:
        return function if hook.permanent else None
    try:
        owner, attribute = resolve(f"{function.__module__}.{function.__qualname__}", TARGET)
    except (UnknownTargetError, PatchError, ImportError):
        return None
    present = unbind(vars(owner).get(attribute))
    hook = hook_of(present)
    return present if hook is not None and hook.exposed and hook.function is function else None


# -- finding --------------------------------------------------------------------------------------


def find_target(target: Any) -> Target:
    """Find the target for handlers: a function, an iterable or a class, or its dotted name.

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
        value = raw_attribute(owner, attribute)
        if isinstance(value, type) or _is_exposed_iterable(value):
            return find_target(value)
        if _is_iterable(value) and not isinstance(value, (str, bytes)):
            return NamedIterable(target, owner, attribute, value)
        return current_target(hook_at(target, owner, attribute, TARGET))
    if isinstance(target, type):
        return _class_target(target)
    if _is_exposed_iterable(target):
        found: Target = target._self_target
        return found
    if not isinstance(target, _FUNCTIONS):
        raise PatchError(
            f"no handlers can be attached to {short_repr(target)}: pass what expose_to_plugins returns for it, or give"
            " its dotted name"
        )
    return current_target(find_hook(target, TARGET))


def current_target(hook: Hook) -> Hook:
    """Return the hook of a function, prepared for handlers; it has a place only where that has the function."""
    if hook.stale:  # the function is permanent, and was exposed where it is no more
        hook.place = None
    if hook.exposed:
        extend_to_importers(hook, TARGET)
    return hook
