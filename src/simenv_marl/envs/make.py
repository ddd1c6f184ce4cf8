"""The functions that make environments, and classes of environments."""

import sys
from typing import Any, Final, Unpack

from gymnasium.vector import AutoresetMode

from ..core.options import ViewOptions, explain_options
from ..core.plan import Plan
from ..core.points import Points
from ..errors import OptionValueError, did_you_mean, short_repr
from .aec import SimulationAECEnv
from .joint import SimulationJointEnv
from .parallel import SimulationParallelEnv
from .single import SimulationEnv, single_view
from .vector import SimulationVectorEnv

VIEWS: Final = ("aec", "parallel", "single", "joint")


def view_class(plan: Plan, view: str | None) -> Any:
    """Return the class of a view of a plan.

    Args:
        plan: The plan.
        view: One of ``VIEWS``. None: single if one point with one agent is active, else AEC.

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
            f"view must be None or one of {', '.join(map(repr, VIEWS))}, not"
            f" {short_repr(view)}{did_you_mean(view, VIEWS)}"
        )
    found[view].check(plan)
    return found[view]


@explain_options
def generate_env(
    simulation: Any, points: Points = None, *, view: str | None = None, **options: Unpack[ViewOptions]
) -> Any:
    """Make an environment class for a simulation (paper, section 3.3).

    Args:
        simulation: A simulation (which every environment copies), its class, a zero-argument factory, or a ``Variant``.
        points: The active decision points: a dotted name, a decision function, a list of these, or a dict from dotted
            name or function to its definition. With a dict, the model needs no decorators. None: the simulation's
            attribute ``points``, else all decorated points, which must then belong to one package.
        view: "aec", "parallel", "single" or "joint". None: single if one point with one agent is active, or if
            ``agent=`` names one agent; else AEC.
        **options: Any of these:

            {options}

    Returns:
        A class. Its constructor takes options as keyword arguments, which override those given here.

    Raises:
        SimEnvError: Something cannot work. The subclass tells what.
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
    """Make a PettingZoo AEC environment whose agents decide at the decision points.

    Args:
        simulation: A simulation (which is copied), its class, a zero-argument factory, or a ``Variant``.
        points: The active decision points, as ``generate_env`` takes them.
        **options: Any of these:

            {options}

    Raises:
        SimEnvError: Something cannot work. The subclass tells what.
    """
    return SimulationAECEnv(Plan.draw_up(simulation, points, options))


@explain_options
def parallel_env(simulation: Any, points: Points = None, **options: Unpack[ViewOptions]) -> SimulationParallelEnv:
    """Make a PettingZoo parallel environment whose agents decide at the decision points.

    Args:
        simulation: A simulation (which is copied), its class, a zero-argument factory, or a ``Variant``.
        points: The active decision points, as ``generate_env`` takes them.
        **options: Any of these:

            {options}

    Raises:
        SimEnvError: Something cannot work. The subclass tells what.
    """
    return SimulationParallelEnv(Plan.draw_up(simulation, points, options))


@explain_options
def single_env(simulation: Any, points: Points = None, **options: Unpack[ViewOptions]) -> SimulationEnv:
    """Make a Gymnasium environment for the one active agent.

    If its decision point has a goal, the environment is goal-based: its observations are dicts of ``observation``,
    ``achieved_goal`` and ``desired_goal``, and it has ``compute_reward``.

    Args:
        simulation: A simulation (which is copied), its class, a zero-argument factory, or a ``Variant``.
        points: The active decision points, as ``generate_env`` takes them.
        **options: Any of these:

            {options}

    Raises:
        ViewError: There is not exactly one active agent.
        SimEnvError: Something else cannot work. The subclass tells what.
    """
    plan = Plan.draw_up(simulation, points, options)
    return single_view(plan)(plan)


@explain_options
def joint_env(simulation: Any, points: Points = None, **options: Unpack[ViewOptions]) -> SimulationJointEnv:
    """Make a Gymnasium environment with one agent that takes all decisions.

    Args:
        simulation: A simulation (which is copied), its class, a zero-argument factory, or a ``Variant``.
        points: The active decision points, as ``generate_env`` takes them.
        **options: Any of these:

            {options}

    Raises:
        ViewError: Not all agents are known beforehand, or the spaces cannot be flattened.
        SimEnvError: Something else cannot work. The subclass tells what.
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
    """Make a Gymnasium vector environment: many copies of a simulation, stepped together.

    Each step returns what ``gymnasium.vector.SyncVectorEnv`` would return for as many single (or joint) views.

    Args:
        simulation: A simulation (which is copied), its class, a zero-argument factory, or a ``Variant``.
        points: The active decision points, as ``generate_env`` takes them.
        num_envs: The number of simulations.
        workers: The number of worker processes. 0: all simulations are suspended in this process.
        view: "single" or "joint". None: single if one point with one agent is active, else joint.
        copy: Whether ``reset`` and ``step`` return new arrays of observations. Otherwise they return the same arrays
            every time, and the next call overwrites them.
        autoreset_mode: When a simulation is reset after its episode has ended, as in Gymnasium:
            ``AutoresetMode.NEXT_STEP``, ``SAME_STEP`` or ``DISABLED``.
        context: The start method of workers: "spawn" (the default), "forkserver", "fork", or a context of
            ``multiprocessing``.
        **options: Any of these:

            {options}

    Raises:
        SimEnvError: Something cannot work. The subclass tells what.
    """
    return SimulationVectorEnv(
        simulation,
        points,
        options,
        view,
        num_envs=num_envs,
        workers=workers,
        copy=copy,
        autoreset_mode=autoreset_mode,
        context=context,
    )
