"""Policies back in the model: a simulation runs its own loop, and policies answer its decisions."""

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
    """Run a simulation's own loop to its end, with policies answering and all else on its rule.

    Args:
        simulation: A simulation (which is copied), its class, a zero-argument factory, or a ``Variant``.
        policies: Who decides: from agent or decision point to a callable of the observation, or of the
            observation and the info, that returns an action.
        points: The decision points, as ``generate_env`` takes them. None and no policies: none.
        seed: What the simulation is reset with, where its ``reset`` takes a seed; None: one is drawn.
        **options: As ``aec_env`` takes them.

    Returns:
        The simulation, after its ``run``.

    Raises:
        SimEnvError: Something in it cannot work; the leaf says what.
        BaseException: Whatever the model, a mapping or a policy raises.
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
