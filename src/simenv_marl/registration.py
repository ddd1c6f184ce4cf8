"""Into the registries of Gymnasium and PettingZoo, with entry points that specs can be written down with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium
import pettingzoo

from ._plan import Plan
from .envs import aec_env, joint_env, parallel_env, single_env
from .errors import UnknownPointError


@dataclass(frozen=True)
class _Recipe:
    simulation: Any
    points: Any
    options: dict[str, Any]


_RECIPES: dict[str, _Recipe] = {}
"""By name and version: what the entry points below make environments of."""


def register_simulation(
    simulation: Any, points: Any = None, *, name: str, version: int = 0, **options: Any
) -> list[str]:
    """Register the environments of a simulation.

    With Gymnasium: ``name/<Point>-v0`` for the single view of each decision point whose agent has a name of its
    own (the function's name in CamelCase; all other points run their rule), and ``name/Joint-v0``. With
    PettingZoo: ``name/coop_v0``, AEC and parallel. To be called where the simulation's module is imported, so
    that ``gymnasium.make("module:name/Joint-v0")`` finds it.

    Args:
        simulation: A simulation (which is copied), its class, or a zero-argument factory.
        points: The decision points, as ``generate_env`` takes them.
        name: The namespace of the ids.
        version: Their version.
        **options: As ``aec_env`` takes them.

    Returns:
        The ids, Gymnasium's first.

    Raises:
        SimEnvError: Something in it cannot work; the leaf says what.
    """
    plan = Plan.draw_up(simulation, points, options)
    recipe = f"{name}-v{version}"
    _RECIPES[recipe] = _Recipe(simulation, points, options)
    made: list[str] = []
    for binding in plan.active:
        if binding.agent is None:
            continue
        camel = "".join(part.capitalize() for part in binding.point.name.rpartition(".")[2].split("_"))
        made.append(f"{name}/{camel}-v{version}")
        _register_gymnasium(made[-1], "make_single", recipe=recipe, point=binding.point.name)
    made.append(f"{name}/Joint-v{version}")
    _register_gymnasium(made[-1], "make_joint", recipe=recipe)
    coop = f"{name}/coop_v{version}"
    register: Any = getattr(pettingzoo, "register", None)
    if register is not None:  # PettingZoo has a registry since 1.26
        for kind in ("aec", "parallel"):
            known = getattr(pettingzoo, f"{kind}_registry", {})
            known.pop(f"{name}/coop-v{version}", None)
            register(kind, coop, f"{__name__}:make_{kind}", kwargs={"recipe": recipe})
        made.append(coop)
    return made


def _register_gymnasium(identity: str, maker: str, **kwargs: Any) -> None:
    gymnasium.registry.pop(identity, None)  # registered again, as when a notebook's cell runs again
    gymnasium.register(identity, f"{__name__}:{maker}", kwargs=kwargs)


def _recipe(recipe: str) -> _Recipe:
    try:
        return _RECIPES[recipe]
    except KeyError:
        raise UnknownPointError(
            f"no simulation is registered as {recipe!r} in this process; import the module that registers it, or"
            ' make the environment by "module:id"'
        ) from None


def make_single(recipe: str, point: str, **options: Any) -> Any:
    """The entry point of the single views."""
    known = _recipe(recipe)
    points = {point: known.points[point]} if isinstance(known.points, dict) and point in known.points else point
    return single_env(known.simulation, points, **{**known.options, **options})


def make_joint(recipe: str, **options: Any) -> Any:
    """The entry point of the joint view."""
    known = _recipe(recipe)
    return joint_env(known.simulation, known.points, **{**known.options, **options})


def make_aec(recipe: str, **options: Any) -> Any:
    """The entry point of the AEC view."""
    known = _recipe(recipe)
    return aec_env(known.simulation, known.points, **{**known.options, **options})


def make_parallel(recipe: str, **options: Any) -> Any:
    """The entry point of the parallel view."""
    known = _recipe(recipe)
    return parallel_env(known.simulation, known.points, **{**known.options, **options})
