"""Policies for all agents, made of what was trained in a turn or a joint view."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from gymnasium import spaces

from ..core import MASK, Action, Agent, Episode, EpisodePolicy, Info, Observation, Plan, stacker
from ..envs.joint import Joint, SimulationJointEnv
from ..envs.turn import SimulationTurnEnv, Turn
from ..errors import OptionValueError, UnknownPointError, short_repr
from ..many.batch import ManyPolicy
from ..core import takes_info
from ..simulation import EVERYONE, RULE

Predict = Callable[..., Any]
"""Takes an observation, or an observation and an info; returns an action, or that and extras."""

ViewType = TypeVar("ViewType", SimulationTurnEnv, SimulationJointEnv)


def turn_policy(predict: Predict, *, like: Any, batched: bool = False) -> dict[Any, Any]:
    """Make a policy for all agents of what was trained in a turn view.

    Args:
        predict: A callable of the observation, or of the observation and the info, which has the
            agent's name and the mask of the actions. It returns the action, or a tuple of the
            action and extras: ``model.predict`` of Stable-Baselines3 works as it is.
        like: An environment of the view in which it was trained, with or without wrappers.
        batched: Whether ``simulate_many``, ``collect_episodes`` and ``evaluate(batched=True)`` ask
            for many decisions at once. Then ``predict`` gets stacks of observations, and one info:
            ``info["agent"]`` is a list of names, ``info["action_mask"]`` a stack of masks.

    Returns:
        Policies, as ``simulate``, ``evaluate``, ``run_experiment`` and ``policies=`` take them. In
        an environment, ``agent=`` names the agent that its user answers.

    Raises:
        OptionValueError: ``like`` is not an environment of a turn view.
    """
    view = _unwrapped(like, SimulationTurnEnv, "turn_policy")
    return {EVERYONE: TurnPolicy(predict, view.session.plan, batched)}
