"""What there is to be decided in a simulation."""

from __future__ import annotations

from collections.abc import Iterator

from ..core.bindings import Binding
from ..core.plan import Plan
from ..envs import VIEWS, SimulationJointEnv, view_class
from ..errors import (
    SimEnvError,
)
from ..simulation import TRUNCATED
from .report import (
    PointDescription,
)
from .runs import (
    Run,
    TimeUp,
)
from .statistics import agents_in_words
from .words import at, first_lines


def described(binding: Binding) -> PointDescription:
    """What is to be known of a decision point."""
    definition = binding.definition
    details = []
    if definition.action_mask_mapping is not None:
        details.append("a mask says which actions are legal")
    if definition.choices is not None:
        details.append("the legal answers come with each call")
    if definition.apply is not None:
        details.append("actions are carried out in place of the rule")
    if definition.removed_by:
        details.append(f"agents end by {', '.join(definition.removed_by)}")
    if definition.goal_space is not None:
        details.append(f"has goals in {definition.goal_space}")
    return PointDescription(
        name=binding.point.name,
        agents=agents_in_words(binding),
        observation_space=str(definition.observation_space),
        action_space=str(definition.action_space),
        details=tuple(details),
    )


def ending(run: Run) -> str:
    """How a plain run ended, in words."""
    number = f"{len(run.decisions)} decisions"
    if run.cut:
        return f"cut after {number}"
    if isinstance(run.error, TimeUp):
        return f"stopped by the time limit after {number}"
    if run.error is not None:
        return f"{number}, then {type(run.error).__name__}: {first_lines(str(run.error))}{at(run.error)}"
    how = "truncated (a limit of time)" if run.result is TRUNCATED else "terminated (an end of the task)"
    return f"{number}, then {how}"


def fitting_views(plan: Plan) -> Iterator[str]:
    """The views that a plan allows."""
    for view in VIEWS:
        try:
            base = view_class(
                plan if view == "joint" or not plan.options.flatten else plan.amended({"flatten": False}), view
            )
            if base is SimulationJointEnv:
                base(plan).close()
        except SimEnvError:
            continue
        except Exception:
            continue
        yield view
