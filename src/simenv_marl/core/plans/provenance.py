"""The provenance of an environment, in a form that can be written to a results file."""

import platform
import sys
from collections.abc import Mapping, Set
from functools import cache, partial
from importlib.metadata import packages_distributions, version
from typing import Any, TypeAlias, Unpack

import numpy as np

from ...simulation import Model
from .options import Options, ViewOptions
from .plan import Plan, make_plan, source_name
from .points import Points

Json: TypeAlias = "bool | int | float | str | list[Json] | dict[str, Json] | None"
"""JSON data."""

DEPENDENCIES = ("greenlet", "gymnasium", "numpy", "pettingzoo", "simenv_marl")
_distributions = cache(packages_distributions)
_distribution_version = cache(version)


def provenance(
    simulation: Model,
    points: Points = None,
    *,
    seed: int | None = None,
    **options: Unpack[ViewOptions],
) -> dict[str, Any]:
    """Return the provenance of an environment with these arguments.

    It equals ``env.unwrapped.provenance()`` of that environment.

    Args:
        simulation: A simulation, its class, a factory, or a ``Variant``.
        points: The decision points, as ``generate_env`` takes them.
        seed: The seed of the episode.
        **options: The options of ``aec_env``.

    Returns:
        A dict of dicts, lists, strings, numbers, bools and None, ready for ``json.dump``:

        - ``simulation``: the dotted name of its class or factory;
        - ``packages``: the versions (or None) of the packages of the simulation and its decision
          points, by name;
        - ``variant``, ``parameters``: the variant's name and parameters, if there is one;
        - ``points``: the agent of each active decision point, by dotted name (None: named at each
          call);
        - ``plugins``: the ``handler``, ``target`` and ``position`` of each;
        - ``policies``: the name of each policy, by agent or point;
        - ``options``: all other options that differ from their defaults;
        - ``seed``: the seed of the latest episode;
        - ``python`` and ``dependencies``: the versions of Python and of the libraries.

        Functions and classes are given by their dotted names, other objects by their ``repr``.

    Raises:
        SimEnvError: An argument is invalid. The message says which.
    """
    return describe(make_plan(simulation, points, options), seed)


def describe(plan: Plan, seed: int | None) -> dict[str, Any]:
    """Return the provenance of an environment of a plan, as ``provenance`` does."""
    name = source_name(plan.subject.source)
    variant = plan.subject.variant
    points = {point.hook.name: point.agent for point in plan.active}
    packages = sorted({dotted.partition(".")[0] for dotted in (name, *points)})
    plugins = [] if plan.plugins is None else plan.plugins.entries
    options = dict(vars(plan.options))
    del options["plugins"], options["policies"]  # they have entries of their own
    defaults = vars(Options())
    return {
        "simulation": name,
        "packages": {package: _version(package) for package in packages},
        "variant": getattr(variant, "name", None),
        "parameters": {} if variant is None else as_json(variant.parameters),
        "points": points,
        "plugins": [
            {"handler": as_json(handler), "target": target, "position": position}
            for handler, target, position in plugins
        ],
        "policies": as_json(plan.options.policies or {}),
        "options": {
            name: as_json(value) for name, value in options.items() if value != defaults[name]
        },
        "seed": seed,
        "python": platform.python_version(),
        "dependencies": {package.replace("_", "-"): _version(package) for package in DEPENDENCIES},
    }


def as_json(value: object) -> Json:
    """Return a value as JSON data.

    Functions and classes become their dotted names, other objects their ``repr``.
    """
    if isinstance(value, (np.generic, np.ndarray)):
        value = value.tolist()
    match value:
        case str() | int() | float() | None:
            return value
        case Mapping():
            return {str(as_json(key)): as_json(part) for key, part in value.items()}
        case list() | tuple():
            return [as_json(part) for part in value]
        case Set():
            return as_json(sorted(map(repr, value)))
        case partial():
            return as_json({"partial": value.func, "args": value.args, "keywords": value.keywords})
    name = getattr(value, "__qualname__", None)
    if name is None:
        return repr(value)
    return f"{value.__module__}.{name}"


def _version(package: str) -> str | None:
    """Return the version of an importable package, of its distribution if it has one."""
    for distribution in _distributions().get(package, ()):
        return _distribution_version(distribution)
    number = getattr(sys.modules.get(package), "__version__", None)
    if isinstance(number, str):
        return number
    return None
