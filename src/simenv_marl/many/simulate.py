"""Policies in the model: one simulation runs its own loop, and policies answer its decisions."""

from collections.abc import Mapping
from typing import Any, Unpack

from ..core.episode import When
from ..core.options import EpisodeOptions
from ..core.plan import Plan
from ..core.points import Points
from ..core.session import Session, checked_seed
from ..errors import close_after
from ..remote.kept import processes_kept


def simulate(
    simulation: Any,
    policies: Mapping[Any, Any] | None = None,
    *,
    points: Points = None,
    seed: int | None = None,
    **options: Unpack[EpisodeOptions],
) -> Any:
    """Run a simulation's own loop to its end. Policies answer decisions; all other decisions follow the model's rule.

    Args:
        simulation: A simulation (which is copied), its class, a zero-argument factory, or a ``Variant``.
        policies: The policies: a dict from an agent or a decision point to a callable. The callable gets the
            observation, or the observation and the info, and returns an action.
        points: The decision points, as ``generate_env`` takes them. With neither ``points`` nor ``policies``, there are
            no decision points and the plain model runs.
        seed: The seed for the simulation's ``reset``, where ``reset`` takes one. None: a seed is drawn.
        **options: The options of ``aec_env``.

    Returns:
        The simulation, after its ``run``.

    Raises:
        SimEnvError: Something cannot work. The subclass tells what.
        BaseException: Any exception of the model, a mapping or a policy.
    """
    plan = Plan.draw_up(simulation, points, {**options, "policies": policies or {}}, unanswered=True)
    with processes_kept():  # policies may branch
        session = Session(plan)
        try:
            session.start(checked_seed(seed), None, When.NEVER)
        except BaseException as error:
            close_after(error, session.close, "the simulation")
            raise
        session.close()
    return session.simulation
