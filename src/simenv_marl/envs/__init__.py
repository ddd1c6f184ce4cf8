"""Views: thin readings of an episode as PettingZoo and Gymnasium environments."""

from __future__ import annotations

import sys
from typing import Any, Final

from .._plan import Plan
from ..errors import OptionValueError
from .aec import SimulationAECEnv
from .single import SimulationEnv

__all__ = ["VIEWS", "SimulationAECEnv", "SimulationEnv", "aec_env", "generate_env", "single_env"]

VIEWS: Final[dict[str, type[SimulationAECEnv] | type[SimulationEnv]]] = {
    "aec": SimulationAECEnv,
    "single": SimulationEnv,
}


def generate_env(
    simulation: Any, points: Any = None, *, view: str | None = None, **options: Any
) -> type[SimulationAECEnv] | type[SimulationEnv]:
    """Make an environment class of a simulation (paper, section 3.3).

    Args:
        simulation: A simulation (which every environment copies), its class, or a zero-argument factory.
        points: The active decision points: a dotted name, a decision function, a list of these, or a dict
            from dotted name or function to its definition, which leaves the model undecorated. None: the
            simulation's attribute ``points``, else all decorated points of the one package that has any.
        view: "aec" or "single". None: single where one point with one agent is active, AEC otherwise.
        **options: As ``aec_env`` takes them.

    Returns:
        A class, whose instances take options as keywords to change those given here.

    Raises:
        SimEnvError: Something in it cannot work; the leaf says what.
    """
    plan = Plan.draw_up(simulation, points, options)
    if view is None:
        view = "single" if len(plan.active) == 1 and plan.active[0].agent is not None else "aec"
    if not isinstance(view, str) or view not in VIEWS:
        raise OptionValueError(f"view must be None or one of {', '.join(map(repr, VIEWS))}, not {view!r}")
    base: Any = VIEWS[view]
    base.check(plan)

    def initialise(self: Any, **changes: Any) -> None:
        base.__init__(self, plan.amended(changes))

    return type(
        f"{plan.name}Env",
        (base,),
        {
            "__init__": initialise,
            "__doc__": f"The {view} view of {plan.name}: {', '.join(b.point.name for b in plan.active)}.",
            "__module__": sys._getframe(1).f_globals.get("__name__", __name__),
            "metadata": base.metadata_of(plan),
        },
    )


def aec_env(simulation: Any, points: Any = None, **options: Any) -> SimulationAECEnv:
    """Make a PettingZoo AEC environment, in which each active decision point is an agent.

    Args:
        simulation: A simulation (which is copied), its class, or a zero-argument factory.
        points: The active decision points, as ``generate_env`` takes them.
        **options: ``driver``, ``max_steps``, ``policies``, ``render_mode``: see ``Options``.

    Raises:
        SimEnvError: Something in it cannot work; the leaf says what.
    """
    return SimulationAECEnv(Plan.draw_up(simulation, points, options))


def single_env(simulation: Any, points: Any = None, **options: Any) -> SimulationEnv:
    """Make a Gymnasium environment of the one agent that is active.

    Args:
        simulation: A simulation (which is copied), its class, or a zero-argument factory.
        points: The active decision points, as ``generate_env`` takes them.
        **options: ``driver``, ``max_steps``, ``policies``, ``render_mode``: see ``Options``.

    Raises:
        ViewError: Not just one agent is active.
        SimEnvError: Something else in it cannot work; the leaf says what.
    """
    return SimulationEnv(Plan.draw_up(simulation, points, options))
