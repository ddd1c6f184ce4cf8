"""Finds and exposes the targets of handlers: functions and iterables."""

from collections.abc import Iterable
from sys import modules
from types import FunctionType, MethodType
from typing import Any, Final

from ..errors import PatchError, UnknownTargetError, name_of, short_repr
from .hook import Hook, hook_of
from .places import Purpose, find_hook, hook_at, permanent_hook, raw_attribute, resolve, split_binding
from .targets import Target


def exposed_functions() -> list[str]:
    """Return the names of all targets that are exposed to plugins or have handlers."""
    return sorted({target.name for target in Target.all.values() if target.exposed or target.slot})


TARGET: Final = Purpose(
    "target of handlers",
    UnknownTargetError,
    exposed_functions,
    "name a Python function that it calls, or that calls it, or use expose_to_plugins for an iterable",
)

_FUNCTIONS: Final = (staticmethod, classmethod, FunctionType, MethodType)


def expose(thing: Any) -> Any:
    """Expose a function or iterable, as ``expose_to_plugins`` does."""
    if _proxied(thing) is not None:
        return thing
    if isinstance(thing, _FUNCTIONS):
        function, binding = split_binding(thing)
        known = hook_of(function)
        again = known is not None and known.permanent  # decorated or exposed already
        hook, _ = permanent_hook(thing)
        hook.exposed = True
        if again and isinstance(thing, (staticmethod, classmethod)):
            return thing
        wrapper = function if again else hook.make_wrapper()
        return wrapper if binding is None else binding(wrapper)
    if isinstance(thing, type):
        raise PatchError(
            f"the class {name_of(thing)} cannot be exposed to plugins: expose one of its functions, such as __init__ or"
            " an __iter__ that is a generator function"
        )
    if isinstance(thing, Iterable) or (hasattr(type(thing), "__getitem__") and hasattr(type(thing), "__len__")):
        from .iterables import expose as expose_iterable  # its dependency imports asyncio, which slows down decisions

        return expose_iterable(thing)
    if callable(thing):
        hook = Hook(thing, f"{getattr(thing, '__module__', None) or '?'}.{name_of(thing)}")
        hook.exposed = True
        return hook.make_wrapper()
    raise PatchError(f"{short_repr(thing)} cannot be exposed to plugins: it is neither a function nor an iterable")


def _proxied(thing: Any) -> Target | None:
    """Return the target of an exposed iterable; None for anything else."""
    iterables: Any = modules.get(f"{__package__}.iterables")
    if iterables is None or not issubclass(type(thing), iterables.ExposedIterable):
        return None
    target: Target = thing._self_target
    return target


def find_target(target: Any) -> Target:
    """Find the target for handlers: a function, an exposed iterable, or the dotted name of one of these.

    Raises:
        UnknownTargetError: The name does not exist.
        PatchError: It is not exposed and cannot be patched.
    """
    if isinstance(target, str):
        try:
            owner, attribute = resolve(target, TARGET)
        except (UnknownTargetError, PatchError):
            named = [other for other in Target.all.values() if other.name == target and other.exposed]
            if not named:
                raise
            return named[-1]  # exposed inside a function, under the latest's name
        return _proxied(raw_attribute(owner, attribute)) or hook_at(target, owner, attribute, TARGET)
    found = _proxied(target)
    if found is None and not isinstance(target, _FUNCTIONS):
        raise PatchError(
            f"no handlers can be attached to {short_repr(target)}: pass what expose_to_plugins returns for it, or the"
            " dotted name of a function"
        )
    return found or find_hook(target, TARGET)
