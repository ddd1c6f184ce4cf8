"""Checks that the actions which correspond to the rule's decisions are known."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from ..errors import DefinitionError
from .collect import learners_plan
from .mixture import defers
from .trajectories import Trajectories, answers


def check_knowable(
    simulation: Any, policies: Mapping[Any, Any], keys: Iterable[Any], points: Any, options: Mapping[str, Any]
) -> None:
    """Check, before anything runs, that the actions of the rule can be known where the rule is going to decide."""
    plan, places = learners_plan(simulation, policies, points, options)
    for key in keys:
        if not defers(policies[key]):
            continue
        for point in plan.points:
            if not point.report is not None and answers(plan, point, places[key]):
                raise DefinitionError(
                    f"the actions of the rule of {point.point.name} are not known; give its make_step a"
                    " rule_action_mapping, which maps the rule's decision to an action"
                )


def check_known(found: Trajectories) -> None:
    """Check afterwards that the action of each decision that was left to the rule is known."""
    unknown = np.flatnonzero(~found.known)
    if len(unknown):
        agent, seed = found.names[found.agents[unknown[0]]], found.seeds[found.episodes[unknown[0]]]
        raise DefinitionError(
            f"in {len(unknown)} of {len(found)} decisions the action of the rule is not known, first for {agent!r} at"
            f" turn {found.turns[unknown[0]]} of the episode of seed {seed}; its decision point needs a"
            " rule_action_mapping that returns an action for every decision of the rule"
        )
