"""Registers simulations with Gymnasium and PettingZoo.

Entry points are strings, so that specs can be serialised.
"""

import importlib
import re
import sys
from collections.abc import Iterable
from typing import Any, Final, Unpack

import gymnasium
import pettingzoo
from gymnasium.wrappers import HumanRendering

from .core import Points, ViewOptions
from .envs import SimulationVectorEnv, vector_env, view_class
from .envs.single import plan_of
from .errors import OptionValueError, UnknownPointError, short_repr
from .simulation import Model, check_count

_RECIPES: Final[dict[str, tuple[Model, Points, ViewOptions]]] = {}
"""The registered simulations with their points and options, by name and version."""

_UNITED: Final = ("Joint", "Turn")
"""The views of one learner for all agents, as titles in ids."""


def register_simulation(
    simulation: Model,
    points: Points = None,
    *,
    name: str | None = None,
    version: int = 0,
    **options: Unpack[ViewOptions],
) -> list[str]:
    """Register the environments of a simulation with Gymnasium and PettingZoo.

    Gymnasium ids: ``name/<Point>-v0`` is the single view of a decision point whose agent has a
    fixed name (the function's name in CamelCase; all other points follow their rule),
    ``name/Joint-v0`` the joint view, and ``name/Turn-v0`` the turn view. PettingZoo id:
    ``name/coop_v0``, as AEC and parallel environment. Call this where the simulation's module is
    imported, so that ``gymnasium.make("module:name/Joint-v0")`` finds it.

    Args:
        simulation: A simulation (which is copied), its class, a zero-argument factory, or a
            ``Variant``.
        points: The decision points, as ``generate_env`` takes them.
        name: The namespace of the ids, made of letters, digits, ``_`` and ``-``. None: the name of
            the variant, if the simulation is one.
        version: The version in the ids.
        **options: The options of ``aec_env``.

    Returns:
        The ids, Gymnasium's first.

    Raises:
        SimEnvError: An argument is invalid. The subclass says which.
    """
    if name is None and hasattr(simulation, "environment_arguments"):  # a variant
        name = simulation.name
    if not isinstance(name, str) or not re.fullmatch(r"[\w-]+", name):
        raise OptionValueError(
            f"name= must consist of letters, digits, _ and -, not {short_repr(name)}"
        )
    check_count(version, "version")
    plan = plan_of(simulation, points, options)
    recipe = f"{name}-v{version}"
    _RECIPES[recipe] = simulation, points, options
    origin = {"recipe": recipe, "module": sys._getframe(1).f_globals.get("__name__", "__main__")}
    entry_point = f"{__name__}:make_view"
    single = {point.hook.name: point for point in plan.active if point.agent or plan.one_agent}
    views: dict[str, dict[str, str | None]] = {}
    for title, point in zip(_titles(single), single.values(), strict=True):
        views[title] = {"view": "single", "agent": point.agent or plan.one_agent}
        if point.agent is not None:  # the view has no other agents, and so no roster
            views[title] |= {"possible_agents": None, "undeclared": "error"}
    views |= {title: {"view": title.lower()} for title in _UNITED}
    ids: list[str] = []
    for title, view in views.items():
        identity = f"{name}/{title}-v{version}"
        # A notebook's cell, for example, registers the same simulation again.
        gymnasium.registry.pop(identity, None)
        gymnasium.register(
            identity,
            entry_point,
            vector_entry_point=f"{__name__}:make_vector_view",
            kwargs=origin | view,
        )
        ids.append(identity)
    register = getattr(pettingzoo, "register", None)
    if register is not None:  # PettingZoo has a registry since 1.26
        identity = f"{name}/coop_v{version}"
        for kind in ("aec", "parallel"):
            registry = getattr(pettingzoo, f"{kind}_registry", {})
            registry.pop(f"{name}/coop-v{version}", None)
            register(kind, identity, entry_point, kwargs=origin | {"view": kind})
        ids.append(identity)
    return ids


def _titles(points: Iterable[str]) -> list[str]:
    """Return the titles of decision points in ids.

    A title is the function's name in CamelCase; with its class, or all of the dotted name, if
    another point has the same title.
    """
    names = [re.sub(r"[^\w.]", "", point) for point in points]  # no <locals>
    styles = [*([_camel(name, parts) for name in names] for parts in (1, 2)), names]
    return [
        next(style[place] for style in styles if [*style, *_UNITED].count(style[place]) == 1)
        for place in range(len(names))
    ]


def _camel(name: str, parts: int) -> str:
    """Return the last parts of a dotted name in CamelCase."""
    words = "_".join(name.split(".")[-parts:]).split("_")
    return "".join(word[:1].upper() + word[1:] for word in words)


# -- entry points ---------------------------------------------------------------------------------


def make_view(
    recipe: str,
    module: str,
    view: str,
    **options: Any,
) -> Any:
    """Make an environment of a registered simulation.

    For a simulation with images but without the mode "human", Gymnasium would show the images
    itself, if the class of the environment had metadata. An entry point for many simulations has
    no such class, and therefore applies Gymnasium's wrapper itself.
    """
    simulation, points, options = _recall(recipe, module, view, options)
    mode = options.pop("render_mode", None)
    plan = plan_of(simulation, points, options)
    modes = plan.subject.render_modes
    is_shown = mode == "human" and mode not in modes and "rgb_array" in modes
    in_window = is_shown and view not in ("aec", "parallel")
    env = view_class(plan, view)(plan.amended({"render_mode": "rgb_array" if in_window else mode}))
    return HumanRendering(env) if in_window else env


def make_vector_view(
    recipe: str,
    module: str,
    view: str,
    **options: Any,
) -> SimulationVectorEnv:
    """Make a vector environment.

    ``max_episode_steps``, which ``gymnasium.make_vec`` passes on, limits ``max_steps``.
    """
    simulation, points, options = _recall(recipe, module, view, options)
    limits = [options.get("max_steps"), options.pop("max_episode_steps", None)]
    options["max_steps"] = min((limit for limit in limits if limit is not None), default=None)
    return vector_env(simulation, points, view=view, **options)


def _recall(
    recipe: str,
    module: str,
    view: str,
    options: dict[str, Any],
) -> tuple[Model, Points, dict[str, Any]]:
    """Return the simulation and the points of a recipe, and its options for a view."""
    if recipe not in _RECIPES and module != "__main__":
        importlib.import_module(module)  # this process may have only the spec
    if recipe not in _RECIPES:
        raise UnknownPointError(
            f"no simulation is registered as {recipe!r} in this process; import the module that"
            ' registers it, or make the environment by "module:id"'
        )
    simulation, points, defaults = _RECIPES[recipe]
    unused: dict[str, Any] = {}  # options of other views
    if view.title() not in _UNITED:
        unused = {"flatten": False, "state_in_info": False}
    return simulation, points, {**defaults, **unused, **options}
