"""The recipe of an environment: names and data from which another process makes it again."""

import platform
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

from ..core import Model, Plan, Points, describe, find_point, portable
from ..decision import Definition
from ..errors import EpisodeFileError, SimEnvError, listed, short_repr
from ..simulation import EVERYONE
from .names import definition_at, find, is_refused, names_of
from .values import decode_value, digest_of, encode_value

Json = dict[str, Any]
"""A JSON object."""

FORMAT: Final = 1
"""The version of the files."""

_LEFT_OUT: Final = ("plugins", "policies", "record", "record_all", "step_timeout")
"""Options that are no part of a recipe, or have an entry in another form."""


@dataclass
class _Writer:
    """Replaces objects by their names.

    Attributes:
        unnamed: The objects without a name, by the part of the recipe.
    """

    unnamed: dict[str, object]

    def write(self, place: str, value: object) -> Any:
        """Return a part of the recipe as JSON."""

        def other(thing: Any) -> Any:
            name = None if isinstance(thing, Definition) else names_of([thing]).get(id(thing))
            if name is not None:
                return {"name": name}
            if isinstance(thing, partial):
                call, parts = write(thing.func), [write([*thing.args]), write(thing.keywords)]
                return {"call": call, "args": parts[0], "keywords": parts[1]}
            self.unnamed[place] = thing
            return {"open": short_repr(thing, 60)}

        write: Callable[[Any], Any] = partial(encode_value, other=other)
        return write(value)


def recipe_of(plan: Plan, unnamed: bool = False) -> Json:
    """Return the recipe of a plan.

    Args:
        plan: The plan.
        unnamed: Whether whatever has no name is left open. Else it is an error.

    Raises:
        EpisodeFileError: Something has no name.
    """
    subject = plan.subject
    given = subject.given
    is_own = [*given.items()] == [*subject.own.items()]  # the simulation names them
    writer = _Writer({})
    names = names_of([*given.values()])
    points: list[Json] = []
    for hook, definition in given.items():
        name = None
        if not is_own and (is_refused(hook.name) or not _is_at(hook.name, definition, plan)):
            name = names.get(id(definition), "")
            if is_refused(hook.name) or definition_at(name, hook.name) is not definition:
                writer.unnamed[f"the definition of {hook.name}"], name = definition, ""
        spaces = f"{definition.observation_space} {definition.action_space}"
        points.append({"point": hook.name, "definition": name, "spaces": digest_of(spaces)})
    defaults = type(plan.options)()
    options = {
        name: writer.write(f"{name}=", _portable(value))
        for name, value in vars(plan.options).items()
        if name not in _LEFT_OUT and value != getattr(defaults, name)
    }
    if plan.options.policies:
        options["policies"] = {
            str(key): writer.write(f"policies= of {short_repr(key)}", policy)
            for key, policy in _portable({**plan.options.policies}).items()
        }
    if plan.plugins is not None:
        options["plugins"] = [
            [writer.write("plugins=", handler), _checked(target), position]
            for handler, target, position in plan.plugins.entries
        ]
    recipe = {
        "simulation": writer.write("the simulation", subject.source),
        "own": is_own,
        "points": points,
        "options": options,
    }
    if writer.unnamed and not unnamed:
        places = [f"{place}: {short_repr(thing)}" for place, thing in writer.unnamed.items()]
        raise EpisodeFileError(
            f"these have no dotted name for another process to find them: {listed(places)}. A"
            " name is that of a function or class of a module, or of a module's attribute that"
            " holds the object. Put them in a module, or use save_episode(..., unnamed=True), and"
            " give them to load_episode"
        )
    about = describe(plan, None)
    versions = {"python": about["python"], "machine": platform.machine()}
    return recipe | {"versions": versions | about["packages"] | about["dependencies"]}


def _is_at(point: str, definition: Definition, plan: Plan) -> bool:
    """Return whether a function has a definition itself."""
    try:
        return find_point(point, own=plan.subject.own)[1] is definition
    except SimEnvError:
        return False


def _portable(value: Any) -> Any:
    """Return the value of an option with names in place of keys that are functions."""
    if not isinstance(value, dict):
        return value
    return {"*" if key is EVERYONE else portable(key): part for key, part in value.items()}


def _checked(name: str) -> str:
    """Return a name of a function of the model, or raise the error for one that is refused."""
    if is_refused(name):
        raise EpisodeFileError(f"names of scripts and the standard library are refused: {name!r}")
    return name


# -- arguments of environments ---------------------------------------------------------------------


def arguments_of(
    recipe: Json, simulation: Model, points: Points, options: Mapping[str, Any]
) -> tuple[Model, Points, dict[str, Any]]:
    """Return the simulation, the points and the options of a recipe.

    Args:
        recipe: The recipe.
        simulation: Replaces the simulation of the recipe. None: the recipe names it.
        points: Replaces its points.
        options: Replace its options.

    Raises:
        EpisodeFileError: A name cannot be used, or something is open that is not given.
    """

    def other(value: Json) -> Any:
        match value:
            case {"name": str(name)}:
                return find(name)
            case {"call": call, "args": args, "keywords": keywords}:
                return partial(read(call), *read(args), **read(keywords))
        raise EpisodeFileError(
            f"the file leaves {value.get('open')} open, because it has no name: give it to"
            " load_episode(..., simulation=, points=) or as the option"
        )

    read: Callable[[Any], Any] = partial(decode_value, other=other)
    if simulation is None:
        simulation = read(recipe["simulation"])
    if points is None and not recipe["own"]:
        points = {entry["point"]: _definition_of(**entry) for entry in recipe["points"]}
    given = dict(options)
    for name, value in recipe["options"].items():
        if name in given:
            continue
        if name.startswith("record"):
            raise KeyError(name)
        given[name] = read(value)
        if name == "plugins":
            given[name] = [(handler, _checked(target), at) for handler, target, at in given[name]]
        elif name == "policies":
            given[name] = {
                EVERYONE if key == "*" else key: part for key, part in given[name].items()
            }
    return simulation, points, given


def _definition_of(point: str, definition: str | None, **_: str) -> Definition | None:
    """Return the definition of an entry of a point. None: the function has it itself."""
    _checked(point)
    if definition is None:
        return None
    found = definition_at(definition, point)
    if found is None:
        where = f"is no longer at {definition}" if definition else "has no name"
        raise EpisodeFileError(
            f"the definition of {point} {where}; give it to load_episode(..., points=)"
        )
    return found


def changes_since(recipe: Json, plan: Plan) -> list[str]:
    """Return how this process differs from the one that has written a recipe of a plan."""
    now = recipe_of(plan, unnamed=True)
    changes = [
        f"the spaces of {entry['point']} differ"
        for entry, other in zip(recipe["points"], now["points"], strict=False)
        if entry["spaces"] != other["spaces"]
    ]
    here = now["versions"]
    return changes + [
        f"{name} was {version}, and is {here.get(name)}"
        for name, version in recipe["versions"].items()
        if here.get(name) != version
    ]
