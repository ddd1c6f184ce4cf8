"""What an environment was made of, in a form that can be written into a results file."""

import importlib.metadata
import platform
import sys
from collections.abc import Mapping
from dataclasses import fields
from functools import cache, partial
from typing import Any, Unpack

import numpy as np

from .options import Options, ViewOptions
from .plan import Plan
from .points import Points

DEPENDENCIES = ("greenlet", "gymnasium", "numpy", "pettingzoo", "simenv-marl")


def provenance(
    simulation: Any, points: Points = None, *, seed: int | None = None, **options: Unpack[ViewOptions]
) -> dict[str, Any]:
    """Say what an environment of these arguments is made of, as ``env.unwrapped.provenance()`` does.

    Args:
        simulation: A simulation, its class, a factory, or a ``Variant``.
        points: The decision points, as ``generate_env`` takes them.
        seed: What it is going to be reset with.
        **options: As ``aec_env`` takes them.

    Returns:
        Nothing but dicts, lists, strings, numbers, bools and None, ready for ``json.dump``:

        - ``simulation``: the dotted name of its class or factory;
        - ``packages``: by name, the version of each package that it and its decision points come from (None where
          it has none);
        - ``variant``, ``parameters``: those of the variant, if it was made of one;
        - ``points``: by dotted name, the agent of each decision point that is decided (None: named at each call);
        - ``plugins``: of each its ``handler``, ``target`` and ``position``;
        - ``policies``: by agent or point, the name of each policy;
        - ``options``: all others that differ from what they are without being given;
        - ``seed``: of the latest episode;
        - ``python`` and ``dependencies``: the versions of what it runs on.

        Functions and classes stand there by their dotted names, all else that is none of these by its ``repr``.

    Raises:
        SimEnvError: No environment can be made of these arguments; the leaf says why.
    """
    return describe(Plan.draw_up(simulation, points, options), seed)


def describe(plan: Plan, seed: int | None) -> dict[str, Any]:
    """Say what an environment of a plan is made of: the result of ``provenance``."""
    name = _dotted_name(plan.maker)
    options = {
        option.name: written_plainly(getattr(plan.options, option.name))
        for option in fields(Options)
        if option.name not in ("plugins", "policies") and getattr(plan.options, option.name) != option.default
    }
    policies = plan.options.policies or {}
    points = {point.point.name: point.agent for point in plan.active}
    packages = sorted({dotted.partition(".")[0] for dotted in (name, *points)})
    return {
        "simulation": name,
        "packages": {package: _version(package) for package in packages},
        "variant": None if plan.variant is None else plan.variant.name,
        "parameters": {} if plan.variant is None else written_plainly(plan.variant.parameters),
        "points": points,
        "plugins": [
            {"handler": written_plainly(handler), "target": target, "position": position}
            for handler, target, position in ([] if plan.plugins is None else plan.plugins.entries)
        ],
        "policies": {_key(key): written_plainly(policy) for key, policy in policies.items()},
        "options": options,
        "seed": seed,
        "python": platform.python_version(),
        "dependencies": {package: _version_of_distribution(package) for package in DEPENDENCIES},
    }


def _dotted_name(thing: Any) -> str:
    return f"{thing.__module__}.{thing.__qualname__}"


def _key(key: Any) -> str:
    return key if isinstance(key, str) else str(written_plainly(key))


def written_plainly(value: Any) -> Any:
    """A value in what JSON knows."""
    if value is None or isinstance(value, (str, bool, int, float)):
        return value
    if isinstance(value, np.generic):
        plain = value.item()
        return repr(plain) if isinstance(plain, np.generic) else written_plainly(plain)
    if isinstance(value, Mapping):
        return {_key(key): written_plainly(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [written_plainly(part) for part in value]
    if isinstance(value, (set, frozenset)):
        return sorted(map(repr, value))
    if isinstance(value, np.ndarray):
        return written_plainly(value.tolist())
    if isinstance(value, partial):
        return {
            "partial": written_plainly(value.func),
            "args": written_plainly(value.args),
            "keywords": written_plainly(value.keywords),
        }
    return _dotted_name(value) if hasattr(value, "__qualname__") else repr(value)


def _version(package: str) -> str | None:
    """The version of an importable package: of the distribution that it comes from, or its own."""
    for distribution in _distributions().get(package, ()):
        return _version_of_distribution(distribution)
    version = getattr(sys.modules.get(package), "__version__", None)
    return version if isinstance(version, str) else None


@cache
def _distributions() -> Mapping[str, list[str]]:
    return importlib.metadata.packages_distributions()


@cache
def _version_of_distribution(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
