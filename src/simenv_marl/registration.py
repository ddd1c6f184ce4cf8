"""Registers simulations with Gymnasium and PettingZoo, with string entry points, so that specs can be serialised."""

import importlib
import re
import sys
from typing import Any, Unpack

import gymnasium
import pettingzoo
from gymnasium.wrappers import HumanRendering

from .core import Points, ViewOptions
from .envs import vector_env, view_class
from .envs.single import plan_of
from .errors import OptionValueError, UnknownPointError, short_repr

_RECIPES: dict[str, tuple[Any, Any, Any]] = {}
"""The simulation, the points and the options that ``register_simulation`` was given, by name and version."""


def register_simulation(
    simulation: Any,
    points: Points = None,
    *,
    name: str | None = None,
    version: int = 0,
    **options: Unpack[ViewOptions],
) -> list[str]:
    """Register the environments of a simulation with Gymnasium and PettingZoo.

    Gymnasium ids: ``name/<Point>-v0`` is the single view of a decision point whose agent has a
    fixed name (the function's name in CamelCase; all other points follow their rule), and
    ``name/Joint-v0`` is the joint view. PettingZoo id: ``name/coop_v0``, as AEC and parallel
    environment. Call this where the simulation's module is imported, so that
    ``gymnasium.make("module:name/Joint-v0")`` finds it.

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
        SimEnvError: Something cannot work. The subclass tells what.
    """
    if name is None:
        if not hasattr(simulation, "environment_arguments"):  # it is not a variant
            raise OptionValueError("register_simulation needs a name= for the ids")
        name = simulation.name
    if not isinstance(name, str) or not re.fullmatch(r"[\w-]+", name):
        raise OptionValueError(
            f"name must consist of letters, digits, _ and -, not {short_repr(name)}"
        )
    if isinstance(version, bool) or not isinstance(version, int) or version < 0:
        raise OptionValueError(f"version must be a non-negative integer, not {short_repr(version)}")
    plan = plan_of(simulation, points, options)
    recipe = f"{name}-v{version}"
    _RECIPES[recipe] = simulation, points, options
    named = [point for point in plan.active if point.agent or plan.one_agent]
    views: dict[str, dict[str, Any]] = {}
    for title, point in zip(_titles([point.hook.name for point in named]), named, strict=True):
        no_roster = {} if point.agent is None else {"possible_agents": None, "undeclared": "error"}
        views[title] = {"view": "single", "agent": point.agent or plan.one_agent, **no_roster}
    entry, vector_entry = f"{__name__}:make_view", f"{__name__}:make_vector_view"
    where = {"recipe": recipe, "module": sys._getframe(1).f_globals.get("__name__", "__main__")}
    made: list[str] = []
    for title, kwargs in {**views, "Joint": {"view": "joint"}}.items():
        made.append(f"{name}/{title}-v{version}")
        # it may be registered again, as when a notebook's cell is rerun
        gymnasium.registry.pop(made[-1], None)
        gymnasium.register(made[-1], entry, vector_entry_point=vector_entry, kwargs=where | kwargs)
    register: Any = getattr(pettingzoo, "register", None)
    if register is not None:  # PettingZoo has a registry since 1.26
        made.append(f"{name}/coop_v{version}")
        for view in ("aec", "parallel"):
            getattr(pettingzoo, f"{view}_registry", {}).pop(f"{name}/coop-v{version}", None)
            register(view, made[-1], entry, kwargs=where | {"view": view})
    return made


def _titles(points: list[str]) -> list[str]:
    """Return the names of decision points in ids: the function's name, with its class if the name alone is taken."""
    whole = [re.sub(r"[^\w.]", "", point) for point in points]  # no <locals>
    styles = [[_camel(point, 1) for point in whole], [_camel(point, 2) for point in whole], whole]
    return [
        next(style[number] for style in styles if [*style, "Joint"].count(style[number]) == 1)
        for number in range(len(points))
    ]


def _camel(point: str, parts: int) -> str:
    """The last parts of a dotted name in CamelCase."""
    words = [word for part in point.split(".")[-parts:] for word in part.split("_")]
    return "".join(word[:1].upper() + word[1:] for word in words)


# -- entry points ---------------------------------------------------------------------------------


def make_view(recipe: str, module: str, view: str, **options: Any) -> Any:
    """Make an environment of a registered simulation.

    Gymnasium reads render modes from the metadata of a class, which an entry point for many
    simulations lacks. Therefore this applies the wrapper by which Gymnasium shows the pictures of a
    simulation without the mode "human".
    """
    simulation, points, options = _recall(recipe, module, view, options)
    plan = plan_of(simulation, points, {**options, "render_mode": None})
    mode, modes = options.get("render_mode"), plan.subject.render_modes
    if (
        view in ("single", "joint")
        and mode == "human"
        and mode not in modes
        and "rgb_array" in modes
    ):
        return HumanRendering(view_class(plan, view)(plan.amended({"render_mode": "rgb_array"})))
    return view_class(plan, view)(plan.amended({"render_mode": mode}))


def make_vector_view(recipe: str, module: str, view: str, **options: Any) -> Any:
    """Make a vector environment.

    ``max_episode_steps``, which ``gymnasium.make_vec`` passes on, is ``max_steps``.
    """
    simulation, points, options = _recall(recipe, module, view, options)
    limits = [options.get("max_steps"), options.pop("max_episode_steps", None)]
    options["max_steps"] = min((limit for limit in limits if limit is not None), default=None)
    return vector_env(simulation, points, view=view, **options)


def _recall(recipe: str, module: str, view: str, options: Any) -> tuple[Any, Any, dict[str, Any]]:
    """Return the simulation and the points of a recipe, and its options for a view."""
    if recipe not in _RECIPES and module != "__main__":
        importlib.import_module(module)  # as in a process that has only the spec
    if recipe not in _RECIPES:
        raise UnknownPointError(
            f"no simulation is registered as {recipe!r} in this process; import the module that"
            " registers it, or"
            ' make the environment by "module:id"'
        )
    simulation, points, registered = _RECIPES[recipe]
    for_view = {} if view == "joint" else {"flatten": False}  # an option of the joint view alone
    return simulation, points, {**registered, **for_view, **options}
