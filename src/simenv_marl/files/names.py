"""Dotted names of objects in modules, which files have in place of the objects."""

import sys
from collections.abc import Collection, Mapping
from functools import partial
from importlib import import_module
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import Any

from ..core import portable
from ..decision import Definition
from ..errors import EpisodeFileError, describe_error, name_of


def names_of(things: Collection[object]) -> dict[int, str]:
    """Return the dotted names of objects, by their ``id``, as far as they have one.

    A definition may be in a dict, whose name it has then.
    """
    found: dict[int, str] = {}
    wanted: dict[int, object] = {}
    for thing in things:
        name = f"{getattr(thing, '__module__', '')}.{getattr(thing, '__qualname__', '')}"
        (found if _leads_to(name, thing) else wanted)[id(thing)] = name
    if not wanted:
        return found
    for module in [each for each in sys.modules.values() if isinstance(each, ModuleType)]:
        if is_refused(module.__name__):
            continue
        for attribute, value in [*vars(module).items()]:
            values = [value]
            if type(value) is dict:
                values += [part for part in [*value.values()] if isinstance(part, Definition)]
            for each in values:
                name = f"{module.__name__}.{attribute}"
                if id(each) in wanted and (each is not value or _leads_to(name, each)):
                    found.setdefault(id(each), name)
    return found


def _leads_to(name: str, thing: object) -> bool:
    try:
        found = find(name)
    except EpisodeFileError:
        return False
    return bool(found == thing) if isinstance(thing, MethodType) else found is thing


def is_refused(name: str) -> bool:
    """Return whether a name is a builtin, of the standard library, or of a script."""
    first = name.partition(".")[0]
    return first in sys.stdlib_module_names or first == "__main__"


def find(name: str) -> Any:
    """Import the object with a dotted name: an attribute of a module, or of a class there.

    Raises:
        EpisodeFileError: There is none, or the name is a builtin, of the standard library or of a
            script, or leads through another module.
    """
    try:
        return _find(name)
    except LookupError as error:
        problem = error.args[0]
    except Exception as error:  # of the module
        problem = describe_error(error)
    raise EpisodeFileError(f"the name {name!r} cannot be used: {problem}")


def _find(name: str) -> Any:
    """Import the object with a dotted name, or raise a ``LookupError`` that says why not."""
    parts = name.split(".")
    if is_refused(name):
        raise LookupError("names of scripts, builtins and the standard library are refused")
    if len(parts) < 2 or not all(part.isidentifier() and part[:2] != "__" for part in parts):
        raise LookupError("it is no dotted name")
    owner: Any = import_module(parts[0])
    module: ModuleType = owner
    for number, part in enumerate(parts[1:], 2):
        path = f"{module.__name__}.{part}"
        if owner is module and not hasattr(module, part) and hasattr(module, "__path__"):
            import_module(path)
        if not (owner is module or isinstance(owner, type)) or not hasattr(owner, part):
            raise LookupError(f"{name_of(owner)} has no {part!r}")
        value: Any = getattr(owner, part)
        if owner is module and number < len(parts):
            value = sys.modules.get(path, value)  # a package may have a function of that name
        if isinstance(value, ModuleType) and value.__name__ == path:
            owner = module = value
        elif isinstance(value, ModuleType) or not _is_of(value, module):
            raise LookupError("it leads through another module")
        else:
            owner = value
    if owner is module:
        raise LookupError("it is a module")
    return owner


def _is_of(thing: object, module: ModuleType) -> bool:
    """Return whether an attribute of a module is its own, and no import from another one."""
    while isinstance(thing, partial):
        thing = thing.func
    if isinstance(thing, MethodType):
        owner = thing.__self__
        thing = owner if isinstance(owner, type) else type(owner)
    if isinstance(thing, (type, FunctionType, BuiltinFunctionType)):
        return thing.__module__ == module.__name__
    return True


def definition_at(name: str, point: str) -> Definition | None:
    """Return the definition with a dotted name, or that of a decision point in a dict."""
    thing = find(name) if name else None
    if isinstance(thing, Mapping):
        thing = next((part for key, part in thing.items() if point in (key, portable(key))), None)
    return thing if isinstance(thing, Definition) else None
