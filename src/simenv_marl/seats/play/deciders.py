"""Policies that decide in a game, for the seats without a person."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any, Final
from uuid import uuid4

from ...core import (
    Agent,
    AskingPolicy,
    EpisodeOptions,
    EpisodePolicy,
    Mode,
    Plan,
    Points,
    Policy,
    Where,
    portable,
    split_extras,
    two_arguments,
)
from ...envs import SimulationAECEnv
from ...envs.single import plan_of
from ...errors import name_of
from ...simulation import EVERYONE, RULE, Action, Model
from .forms import jsonable

PLANS: Final[dict[str, Plan]] = {}
"""Plans with policies, by a token. A clone inherits them, so that no policy is pickled."""


class Deciders:
    """The policies of a game."""

    def __init__(
        self,
        simulation: Model,
        policies: Mapping[Any, Policy],
        points: Points,
        options: EpisodeOptions,
    ) -> None:
        """Take the arguments of ``simulate``.

        Raises:
            SimEnvError: An argument is invalid.
        """
        self._token = uuid4().hex
        self._names = {
            portable(key): name_of(policy) for key, policy in policies.items() if policy is not RULE
        }
        if policies:
            settings = {**options, "policies": policies, "max_steps": None}
            PLANS[self._token] = plan_of(simulation, points, settings, mode=Mode.SIMULATE)

    def name_for(self, agent: str, point: str) -> str:
        """Return the name of the policy that decides for an agent of a point; "" for none."""
        keys = agent, point, EVERYONE
        return next((self._names[key] for key in keys if key in self._names), "")

    def answer(self, env: SimulationAECEnv, *, future: bool = False) -> Action:
        """Answer the pending decision, as JSON; None for the rule.

        Args:
            env: The environment, which may be a clone.
            future: Whether a future is tried out, in place of policies that wait by their
                fallbacks.
        """
        if not self._names:
            return None
        return env.call(_answer, self._token, future)


def _answer(
    view: SimulationAECEnv,
    token: str,
    future: bool,
) -> Action:
    episode: Any = view.episode
    agent: Agent = episode.deciding
    plan = PLANS[token]
    points = [point for point in plan.points if point.hook is agent.point.hook]
    policy: Any = plan.policy_of(agent.name, points[0]) if points else RULE
    if policy is RULE:
        return None
    policy = two_arguments(policy)
    if isinstance(policy, AskingPolicy) and not future:
        # It decides in the game itself, also where that goes on in a clone.
        episode = SimpleNamespace(
            where=Where.USER,
            seed=episode.seed,
            simulation=episode.simulation,
            planner_view=episode.planner_view,
            read_state=episode.read_state,
        )
    observation = agent.hand_out()
    if isinstance(policy, EpisodePolicy):
        action = policy.answer(episode, agent, observation, agent.info)
    else:
        action = policy(observation, agent.info)
    action, _ = split_extras(action, agent.point.definition.action_space)
    return None if action is RULE else jsonable(action)
