"""Views: an episode as a PettingZoo or Gymnasium environment, and the functions that make them."""

import sys
from typing import Any, Final, Unpack

from gymnasium.vector import AutoresetMode

from ..core import (
    Model,
    Plan,
    Points,
    ViewOptions,
    explain_arguments,
)
from ..errors import OptionValueError, did_you_mean, short_repr
from .aec import SimulationAECEnv
from .joint import SimulationJointEnv
from .padding import pad_agents
from .parallel import SimulationParallelEnv
from .single import SimulationEnv, plan_of
from .turn import SimulationTurnEnv
from .vector import SimulationVectorEnv

__all__ = [
    "SimulationAECEnv", "SimulationEnv", "SimulationJointEnv", "SimulationParallelEnv",
    "SimulationTurnEnv", "SimulationVectorEnv", "pad_agents",
]  # fmt: skip

VIEWS: Final[dict[str, type[Any]]] = {
    kind.kind: kind
    for kind in (
        SimulationAECEnv,
        SimulationParallelEnv,
        SimulationEnv,
        SimulationJointEnv,
        SimulationTurnEnv,
    )
}
"""The classes of the views of one simulation."""


def view_class(plan: Plan, view: str | None) -> type[Any]:
    """Return the class of a view. None: single if one point with one agent is active, else AEC."""
    if view is None:
        view = "aec" if plan.one_agent is None else "single"
    if not isinstance(view, str) or view not in VIEWS:
        raise OptionValueError(
            f"view must be None or one of {', '.join(map(repr, VIEWS))}, not"
            f" {short_repr(view)}{did_you_mean(view, VIEWS)}"
        )
    return VIEWS[view]


@explain_arguments
def generate_env(
    simulation: Model,
    points: Points = None,
    *,
    view: str | None = None,
    **options: Unpack[ViewOptions],
) -> type[Any]:
    """Make an environment class for a simulation (paper, section 3.3).

    The constructor of the class takes options as keyword arguments, which override the options
    here.

    {arguments}
        view: "aec", "parallel", "single", "joint" or "turn". None: single if one point with one
            agent is active, or if ``agent=`` names one agent; else AEC.
        {options}
    """
    plan = plan_of(simulation, points, options)
    base = view_class(plan, view)
    base.adapt(plan)  # raises errors at once

    def initialise(self: object, **changes: Any) -> None:
        base.__init__(self, plan.amended(changes))

    names = ", ".join(point.hook.name for point in plan.active)
    return type(
        f"{plan.name}Env",
        (base,),
        {
            "__init__": initialise,
            "__doc__": f"A view of {plan.name}: {names}.",
            "__module__": sys._getframe(1).f_globals.get("__name__", __name__),
            "metadata": base.metadata_of(plan),
        },
    )


@explain_arguments
def aec_env(
    simulation: Model,
    points: Points = None,
    **options: Unpack[ViewOptions],
) -> SimulationAECEnv:
    """Make a PettingZoo AEC environment whose agents decide at the decision points.

    {arguments}
        {options}
    """
    return SimulationAECEnv(plan_of(simulation, points, options))


@explain_arguments
def parallel_env(
    simulation: Model,
    points: Points = None,
    **options: Unpack[ViewOptions],
) -> SimulationParallelEnv:
    """Make a PettingZoo parallel environment whose agents decide at the decision points.

    {arguments}
        {options}
    """
    return SimulationParallelEnv(plan_of(simulation, points, options))


@explain_arguments
def single_env(
    simulation: Model,
    points: Points = None,
    **options: Unpack[ViewOptions],
) -> SimulationEnv:
    """Make a Gymnasium environment for the one active agent.

    If there are several agents, ``agent=`` names it. If its decision point has a goal, the
    environment is goal-based: its observations are dicts of ``observation``, ``achieved_goal`` and
    ``desired_goal``, and it has ``compute_reward``.

    {arguments}
        {options}
    """
    return SimulationEnv(plan_of(simulation, points, options))


@explain_arguments
def joint_env(
    simulation: Model,
    points: Points = None,
    **options: Unpack[ViewOptions],
) -> SimulationJointEnv:
    """Make a Gymnasium environment with one agent that takes all decisions.

    All agents must be known beforehand. With ``flatten=True``, it must be possible to concatenate
    their spaces.

    {arguments}
        {options}
    """
    return SimulationJointEnv(plan_of(simulation, points, options))


@explain_arguments
def turn_env(
    simulation: Model,
    points: Points = None,
    **options: Unpack[ViewOptions],
) -> SimulationTurnEnv:
    """Make a Gymnasium environment of one learner that takes each decision as it arises.

    A step answers the pending decision, whichever agent's it is, and runs to the next one of any
    agent. Agents may be born and die.

    {arguments}
        {options}
    """
    return SimulationTurnEnv(plan_of(simulation, points, options))


@explain_arguments
def vector_env(
    simulation: Model,
    points: Points = None,
    *,
    num_envs: int,
    workers: int = 0,
    view: str | None = None,
    copy: bool = True,
    autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    context: Any = None,
    restart: bool = False,
    most_restarts: int = 10,
    **options: Unpack[ViewOptions],
) -> SimulationVectorEnv:
    """Make a Gymnasium vector environment: many copies of a simulation, stepped together.

    Each step returns the same results as a ``gymnasium.vector.SyncVectorEnv`` of as many single (or
    joint, or turn) views.

    {arguments}
        num_envs: The number of simulations.
        workers: The number of worker processes. 0: all simulations are suspended in this process.
        view: "single", "joint" or "turn". None: single if one point with one agent is active, else
            joint.
        copy: Whether ``reset`` and ``step`` return new arrays of observations. Otherwise they
            return the same arrays every time, and the next call overwrites them.
        autoreset_mode: When a simulation is reset after its episode has ended, as in Gymnasium:
            ``AutoresetMode.NEXT_STEP``, ``SAME_STEP`` or ``DISABLED``.
        context: The start method of workers: "spawn" (the default), "forkserver", "fork", or a
            context of ``multiprocessing``.
        restart: Whether a worker that dies, or exceeds ``step_timeout``, is replaced. The episodes
            of its simulations end truncated: with the last observation, reward 0 and, in the info,
            ``lost`` and ``lost_why`` (in ``final_info`` with ``SAME_STEP``). A warning tells of it.
            Others do not notice. Otherwise, ``step`` raises a ``WorkerError``.
        most_restarts: How many workers may be replaced within an hour. One more is an error.
        {options}
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
        restart=restart,
        most_restarts=most_restarts,
    )
