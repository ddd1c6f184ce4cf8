"""Views: thin readings of an episode as PettingZoo and Gymnasium environments."""

import sys
from typing import Any, Final, Unpack

from gymnasium.vector import AutoresetMode

from ..core.options import ViewOptions, explain_options
from ..core.plan import Plan
from ..core.points import Points
from ..errors import OptionValueError, meant, shown
from . import asked  # noqa: F401 - the environments that policies are given
from .aec import SimulationAECEnv
from .base import View
from .joint import SimulationJointEnv
from .parallel import SimulationParallelEnv
from .single import SimulationEnv, single_view
from .vector import SimulationVectorEnv
from .worker import Recipe

__all__ = [
    "VIEWS",
    "SimulationAECEnv",
    "SimulationEnv",
    "SimulationJointEnv",
    "SimulationParallelEnv",
    "SimulationVectorEnv",
    "View",
    "aec_env",
    "generate_env",
    "joint_env",
    "parallel_env",
    "single_env",
    "vector_env",
]

VIEWS: Final = ("aec", "parallel", "single", "joint")


def view_class(plan: Plan, view: str | None) -> Any:
    """The class of a view of a plan.

    Args:
        plan: The plan.
        view: One of ``VIEWS``. None: single where one point with one agent is active, AEC otherwise.

    Raises:
        OptionValueError: There is no such view.
        ViewError: The plan does not allow it.
    """
    if view is None:
        view = "aec" if plan.one_agent is None else "single"
    if view == "single":
        return single_view(plan)
    found: dict[Any, Any] = {"aec": SimulationAECEnv, "parallel": SimulationParallelEnv, "joint": SimulationJointEnv}
    if not isinstance(view, str) or view not in found:
        raise OptionValueError(
            f"view must be None or one of {', '.join(map(repr, VIEWS))}, not {shown(view)}{meant(view, VIEWS)}"
        )
    found[view].check(plan)
    return found[view]


@explain_options
def generate_env(
    simulation: Any, points: Points = None, *, view: str | None = None, **options: Unpack[ViewOptions]
) -> Any:
    """Make an environment class of a simulation (paper, section 3.3).

    Args:
        simulation: A simulation (which every environment copies), its class, a zero-argument factory, or a ``Variant``.
        points: The active decision points: a dotted name, a decision function, a list of these, or a dict
            from dotted name or function to its definition, which leaves the model undecorated. None: the
            simulation's attribute ``points``, else all decorated points of the one package that has any.
        view: "aec", "parallel", "single" or "joint". None: single where one point with one agent is active, or one
            agent is named with ``agent=``, AEC otherwise.
        **options: Any of these:

            {options}

    Returns:
        A class, whose instances take options as keywords to change those given here.

    Raises:
        SimEnvError: Something in it cannot work; the leaf says what.
    """
    plan = Plan.draw_up(simulation, points, options)
    base = view_class(plan, view)

    def initialise(self: Any, **changes: Any) -> None:
        current = Plan.draw_up(simulation, points, options) if plan.stale else plan
        base.__init__(self, current.amended(changes))

    return type(
        f"{plan.name}Env",
        (base,),
        {
            "__init__": initialise,
            "__doc__": f"A view of {plan.name}: {', '.join(b.point.name for b in plan.active)}.",
            "__module__": sys._getframe(1).f_globals.get("__name__", __name__),
            "metadata": base.metadata_of(plan),
        },
    )


@explain_options
def aec_env(simulation: Any, points: Points = None, **options: Unpack[ViewOptions]) -> SimulationAECEnv:
    """Make a PettingZoo AEC environment, in which decision points are agents.

    Args:
        simulation: A simulation (which is copied), its class, a zero-argument factory, or a ``Variant``.
        points: The active decision points, as ``generate_env`` takes them.
        **options: Any of these:

            {options}

    Raises:
        SimEnvError: Something in it cannot work; the leaf says what.
    """
    return SimulationAECEnv(Plan.draw_up(simulation, points, options))


@explain_options
def parallel_env(simulation: Any, points: Points = None, **options: Unpack[ViewOptions]) -> SimulationParallelEnv:
    """Make a PettingZoo parallel environment, in which decision points are agents.

    Args:
        simulation: A simulation (which is copied), its class, a zero-argument factory, or a ``Variant``.
        points: The active decision points, as ``generate_env`` takes them.
        **options: Any of these:

            {options}

    Raises:
        SimEnvError: Something in it cannot work; the leaf says what.
    """
    return SimulationParallelEnv(Plan.draw_up(simulation, points, options))


@explain_options
def single_env(simulation: Any, points: Points = None, **options: Unpack[ViewOptions]) -> SimulationEnv:
    """Make a Gymnasium environment of the one agent that is active.

    Where its decision point has a goal, the environment is goal-based: its observations are dicts of
    ``observation``, ``achieved_goal`` and ``desired_goal``, and it has ``compute_reward``.

    Args:
        simulation: A simulation (which is copied), its class, a zero-argument factory, or a ``Variant``.
        points: The active decision points, as ``generate_env`` takes them.
        **options: Any of these:

            {options}

    Raises:
        ViewError: Not just one agent is active.
        SimEnvError: Something else in it cannot work; the leaf says what.
    """
    plan = Plan.draw_up(simulation, points, options)
    return single_view(plan)(plan)


@explain_options
def joint_env(simulation: Any, points: Points = None, **options: Unpack[ViewOptions]) -> SimulationJointEnv:
    """Make a Gymnasium environment whose one agent takes all decisions.

    Args:
        simulation: A simulation (which is copied), its class, a zero-argument factory, or a ``Variant``.
        points: The active decision points, as ``generate_env`` takes them.
        **options: Any of these:

            {options}

    Raises:
        ViewError: Not all agents are known beforehand, or the spaces cannot be flattened.
        SimEnvError: Something else in it cannot work; the leaf says what.
    """
    return SimulationJointEnv(Plan.draw_up(simulation, points, options))


@explain_options
def vector_env(
    simulation: Any,
    points: Points = None,
    *,
    num_envs: int,
    workers: int = 0,
    view: str | None = None,
    copy: bool = True,
    autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    context: Any = None,
    **options: Unpack[ViewOptions],
) -> SimulationVectorEnv:
    """Make a Gymnasium vector environment: many simulations of a kind, stepped together.

    It tells, step by step, what ``gymnasium.vector.SyncVectorEnv`` tells of as many single (or joint) views.

    Args:
        simulation: A simulation (which is copied), its class, a zero-argument factory, or a ``Variant``.
        points: The active decision points, as ``generate_env`` takes them.
        num_envs: How many simulations.
        workers: Over how many processes they are spread; 0: all of them are suspended in this one.
        view: "single" or "joint". None: single where one point with one agent is active, joint otherwise.
        copy: Whether ``reset`` and ``step`` return observations of the caller's own; else they return the same
            arrays again, which the next call changes.
        autoreset_mode: When a simulation whose episode has ended begins the next one, as Gymnasium has it:
            ``AutoresetMode.NEXT_STEP``, ``SAME_STEP`` or ``DISABLED``.
        context: How workers are started: "spawn" (what None means), "forkserver", "fork", or a context of
            ``multiprocessing``.
        **options: Any of these:

            {options}

    Raises:
        SimEnvError: Something in it cannot work; the leaf says what.
    """
    return SimulationVectorEnv(
        Recipe(simulation, points, options, view),
        num_envs=num_envs,
        workers=workers,
        copy=copy,
        autoreset_mode=autoreset_mode,
        context=context,
    )
