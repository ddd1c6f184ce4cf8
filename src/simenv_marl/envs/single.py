"""The single view: a Gymnasium environment of one agent."""

import copy
from dataclasses import replace
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ..core.actions import open_mask
from ..core.agent import Agent
from ..core.episode import Episode
from ..core.plan import Plan
from ..core.point import asks_for
from ..core.session import Session
from ..errors import ViewError
from .one_agent import OneAgentView


class SimulationEnv(OneAgentView):
    """A simulation as a Gymnasium environment of one agent. Made by ``single_env`` and ``generate_env``.

    Attributes:
        observation_space, action_space: The agent's spaces, which this environment does not share.
    """

    takes = ("agent",)
    _own: Any = None  # its agent during an episode

    def __init__(self, plan: Plan, session: Session | None = None) -> None:
        """Make the environment of a plan: see ``View``."""
        super().__init__(plan, session)
        self._agent = str(plan.one_agent)
        if self._session.episode is not None:
            self._own = self._session.episode.agent(self._agent)

    @classmethod
    def check(cls, plan: Plan) -> None:
        """Check that a plan allows this view: see ``View``."""
        super().check(plan)
        if plan.one_agent is None:
            points = ", ".join(point.point.name for point in plan.active)
            raise ViewError(
                "the single view needs one active decision point whose agent= is not a callable, or the name of one"
                f" agent; active are {points}. Name the agent with agent=, name one point in points=, answer the"
                " others with policies=, or use aec_env"
            )

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Answer the pending decision with an action, or ``RULE``, and run to the next one.

        Returns:
            Observation, reward (a Python float), terminated, truncated, info.

        Raises:
            BaseException: Any error of ``SimulationAECEnv.step``.
        """
        session = self._session
        if session.lock is not None and not session.lock.held:  # the lock also covers reading the results
            with session.lock:
                return SimulationEnv.step(self, action)
        episode = session.episode
        if episode is None:
            raise session.refusal()
        episode.step(action)
        if self._shows:
            self.render()
        own: Agent = self._own
        if own.ended:
            return own.observation, own.reward, True, False, own.info
        return own.observation, own.reward, episode.terminated, episode.truncated, own.info

    def _make_spaces(self) -> tuple[spaces.Space[Any], spaces.Space[Any]]:
        definition = self._plan.active[0].definition
        return copy.deepcopy((definition.observation_space, definition.action_space))

    def _first_results(self, episode: Episode) -> tuple[Any, dict[str, Any]]:
        self._own = own = episode.agent(self._agent)
        assert own is not None
        return own.observation, own.info

    def _all_observations(self, episode: Episode) -> tuple[Any, ...]:
        return (self._own.observation,)

    def _masks(self, episode: Episode) -> list[Any]:
        mask = self._own.mask
        return [open_mask(self.action_space) if mask is None else mask]

    def _resume_from_replay(self) -> None:
        self._own = self._running().agents[self._agent]

    def _clear(self) -> None:
        self._own = None


class SimulationGoalEnv(SimulationEnv):
    """The single view of a point with a goal: a ``Dict`` of ``observation``, ``achieved_goal`` and ``desired_goal``."""

    def __init__(self, plan: Plan, session: Session | None = None) -> None:
        """Make the environment of a plan: see ``View``."""
        self.check(plan)
        self._definition = plan.active[0].definition
        super().__init__(with_goals(plan), session)
        self._made_of = plan

    def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any) -> float | NDArray[np.float64]:
        """Return the rewards for other goals.

        Args:
            achieved_goal: The achieved goals, of shape ``goal_space.shape``, or ``(n, *goal_space.shape)`` for n steps.
            desired_goal: The desired goals, of the same shape.
            info: The info of the step, or a sequence of n infos.

        Returns:
            The reward, or an array of n rewards.
        """
        compute = self._definition.compute_reward
        assert compute is not None
        reward = np.asarray(compute(achieved_goal, desired_goal, info), np.float64)
        return float(reward) if reward.ndim == 0 else reward


def with_goals(plan: Plan) -> Plan:
    """Return the same plan with goals in the observations of its one decision point."""
    definition = plan.active[0].definition
    parts: dict[str, Any] = {
        "observation": definition.observation_space_mapping,
        "achieved_goal": definition.achieved_goal_mapping,
        "desired_goal": definition.desired_goal_mapping,
    }
    asking = {key for key, part in parts.items() if asks_for(part, "_simulation")}

    def observe_with_goals(*args: Any, **kwargs: Any) -> dict[str, Any]:
        return {key: part(*args, **kwargs) for key, part in parts.items()}

    def observe_with_simulation(*args: Any, _simulation: Any, **kwargs: Any) -> dict[str, Any]:
        given = {"_simulation": _simulation}
        return {key: part(*args, **kwargs, **given if key in asking else {}) for key, part in parts.items()}

    goal: Any = definition.goal_space
    space = spaces.Dict({"observation": definition.observation_space, "achieved_goal": goal, "desired_goal": goal})
    mapping = observe_with_simulation if asking else observe_with_goals
    changed = replace(definition, observation_space=space, observation_space_mapping=mapping)
    return plan.redefined(plan.active[0].point, changed)


def single_view(plan: Plan) -> type[SimulationEnv]:
    """Return the class of the single view for a plan."""
    SimulationEnv.check(plan)
    return SimulationEnv if plan.active[0].definition.goal_space is None else SimulationGoalEnv
