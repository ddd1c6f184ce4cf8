"""The provenance of an environment, in a form that can be written to a results file."""

import importlib.metadata
import platform
import sys
from collections.abc import Mapping
from dataclasses import fields
from functools import cache, partial
from typing import Any, Unpack

import numpy as np

from .options import Options, ViewOptions
from .plan import Plan, make_plan, source_name
from .points import Points

DEPENDENCIES = ("greenlet", "gymnasium", "numpy", "pettingzoo", "simenv_marl")
_distributions = cache(importlib.metadata.packages_distributions)
_distribution_version = cache(importlib.metadata.version)


def provenance(
    simulation: Any,
    points: Points = None,
    *,
    seed: int | None = None,
    **options: Unpack[ViewOptions],
) -> dict[str, Any]:
    """Return the provenance of an environment with these arguments, as ``env.unwrapped.provenance()`` does.

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
        SimEnvError: No environment can be made of these arguments. The subclass tells why.
    """
    return describe(make_plan(simulation, points, options), seed)


def describe(plan: Plan, seed: int | None) -> dict[str, Any]:
    """Return the provenance of an environment of a plan, as ``provenance`` does."""
    name = source_name(plan.subject.source)
    variant = plan.subject.variant
    options = {
        option.name: as_json(getattr(plan.options, option.name))
        for option in fields(Options)
        if option.name not in ("plugins", "policies")
        and getattr(plan.options, option.name) != option.default
    }
    points = {point.hook.name: point.agent for point in plan.active}
    packages = sorted({dotted.partition(".")[0] for dotted in (name, *points)})
    return {
        "simulation": name,
        "packages": {package: _version(package) for package in packages},
        "variant": None if variant is None else variant.name,
        "parameters": {} if variant is None else as_json(variant.parameters),
        "points": points,
        "plugins": [
            {"handler": as_json(handler), "target": target, "position": position}
            for handler, target, position in ([] if plan.plugins is None else plan.plugins.entries)
        ],
        "policies": as_json(plan.options.policies or {}),
        "options": options,
        "seed": seed,
        "python": platform.python_version(),
        "dependencies": {package.replace("_", "-"): _version(package) for package in DEPENDENCIES},
    }


def as_json(value: Any) -> Any:
    """Return a value as JSON data."""
    if value is None or isinstance(value, (str, bool, int, float)):
        return value
    if isinstance(value, (np.generic, np.ndarray)):
        plain = value.tolist()
        return repr(plain) if isinstance(plain, np.generic) else as_json(plain)
    if isinstance(value, Mapping):
        return {
            key if isinstance(key, str) else str(as_json(key)): as_json(part)
            for key, part in value.items()
        }
    if isinstance(value, (list, tuple)):
        return [as_json(part) for part in value]
    if isinstance(value, (set, frozenset)):
        return sorted(map(repr, value))
    if isinstance(value, partial):
        return {
            "partial": as_json(value.func),
            "args": as_json(value.args),
            "keywords": as_json(value.keywords),
        }
    return (
        f"{value.__module__}.{value.__qualname__}"
        if hasattr(value, "__qualname__")
        else repr(value)
    )


def _version(package: str) -> str | None:
    """Return the version of an importable package: that of its distribution, or its own."""
    for distribution in _distributions().get(package, ()):
        return _distribution_version(distribution)
    version = getattr(sys.modules.get(package), "__version__", None)
    return version if isinstance(version, str) else None
