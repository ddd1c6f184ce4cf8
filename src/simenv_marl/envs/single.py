"""The single view: a Gymnasium environment of one agent.

A planner gets it for the agent for which it decides.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NoReturn

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ..core import EpisodeState, Outcome, Plan, Points, Session, Source, make_plan
from ..errors import CopyError, ReentrancyError, ViewError
from ..simulation import asks_for
from .base import OneAgentView

_REFUSAL = "a policy cannot move the environment that it is given: it must return an action; branch tries actions out"


def plan_of(
    simulation: Source, points: Points, options: Mapping[str, Any], **settings: Any
) -> Plan:
    """Make a plan, as ``make_plan`` does. Its planners get the view of their agent."""
    return make_plan(simulation, points, options, planner_view=PlannerEnv.of_session, **settings)


class SimulationEnv(OneAgentView):
    """A simulation as a Gymnasium environment of one agent.

    Made by ``single_env`` and ``generate_env``.
    """

    _option = "agent"
    _own: Any = None  # its agent during an episode

    def set_up(self) -> None:
        self._agent = str(self._plan.one_agent)
        self._definition = self.session.plan.active[0].definition
        if self.session.episode is not None:
            self._begin(self.session.episode)

    @classmethod
    def _adapt(cls, plan: Plan) -> Plan:
        """Check that a plan allows this view, and put the goals of its point, if it has any, into the observations."""
        if plan.one_agent is None:
            points = ", ".join(point.hook.name for point in plan.active)
            raise ViewError(
                "the single view needs one active decision point whose agent= is not a callable,"
                f" or the name of one agent; active are {points}. Name the agent with agent=, name"
                " one point in points=, answer the others with policies=, or use aec_env"
            )
        definition = plan.active[0].definition
        if definition.goal_space is None:
            return super()._adapt(plan)
        parts: dict[str, Any] = {
            "observation": definition.observation_space_mapping,
            "achieved_goal": definition.achieved_goal_mapping,
            "desired_goal": definition.desired_goal_mapping,
        }
        asking = {key: asks_for(part, "_simulation") for key, part in parts.items()}

        def observe(*args: Any, _simulation: Any, **kwargs: Any) -> dict[str, Any]:
            given = {"_simulation": _simulation}
            return {
                key: part(*args, **kwargs, **given if asking[key] else {})
                for key, part in parts.items()
            }

        goal: Any = definition.goal_space
        space = spaces.Dict(
            {
                "observation": definition.observation_space,
                "achieved_goal": goal,
                "desired_goal": goal,
            }
        )
        changed = replace(definition, observation_space=space, observation_space_mapping=observe)
        return super()._adapt(plan).redefined(plan.active[0].hook, changed)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Answer the pending decision with an action, or ``RULE``, and run to the next one.

        Returns:
            Observation, reward (a Python float), terminated, truncated, info.

        Raises:
            BaseException: Any error of ``SimulationAECEnv.step``.
        """
        session = self.session
        episode = session.episode
        if episode is None or (session.lock is not None and not session.lock.held):
            return self._step_alone(SimulationEnv.step, action)  # type: ignore[no-any-return]
        episode.step(action)
        if self._shows:
            self._show()
        own = self._own
        if own.ended:
            return own.observation, own.reward, True, False, own.info
        outcome = episode.outcome  # its properties would each take as long as a comparison
        terminated = outcome is Outcome.TERMINATED
        return own.observation, own.reward, terminated, outcome is Outcome.TRUNCATED, own.info

    @property
    def compute_reward(self) -> Callable[[Any, Any, Any], float | NDArray[np.float64]]:
        """A function that returns the rewards for other goals, if the decision point has a goal.

        Its arguments are the achieved goals, of shape ``goal_space.shape``, or
        ``(n, *goal_space.shape)`` for n steps; the desired goals, of the same shape; and the info
        of the step, or a sequence of n infos. It returns the reward, or an array of n rewards.

        Raises:
            AttributeError: The decision point has no goal.
        """
        compute = self._definition.compute_reward
        if compute is None:
            raise AttributeError(
                f"{type(self).__name__} has no compute_reward: its decision point has no"
                " goal_space="
            )

        def compute_reward(
            achieved_goal: Any, desired_goal: Any, info: Any
        ) -> float | NDArray[np.float64]:
            reward = np.asarray(compute(achieved_goal, desired_goal, info), np.float64)
            return float(reward) if reward.ndim == 0 else reward

        return compute_reward

    def _begin(self, episode: EpisodeState) -> tuple[Any, dict[str, Any]]:
        self._own = episode.agent(self._agent)
        return self._own.observation, self._own.info

    def _clear(self) -> None:
        self._own = None


class PlannerEnv(SimulationEnv):
    """The single view of an agent whose planner is being asked, for ``branch`` and the functions built on it.

    The decision is pending until the planner returns an action. A branch is an ordinary environment
    of the agent, which can be stepped; policies or rules answer for all other agents.
    """

    waits_for_one = True
    _branched = False  # whether it is a branch, or a clone

    @classmethod
    def of_session(cls, session: Session) -> PlannerEnv:
        """Make the view of the agent whose planner a session is asking."""
        return cls(session.plan, session)

    def set_up(self) -> None:
        episode: Any = self.session.episode
        if episode is not None:  # otherwise the session is going to replay one
            self._own = episode.deciding
            self._agent, self._definition = self._own.name, self._own.point.definition
            self._roster = {self._agent: self._own.point}
        self._shows = False

    @classmethod
    def _adapt(cls, plan: Plan) -> Plan:
        """Allow every plan: the agent is the one whose planner is being asked."""
        return plan

    def begin_branch(self) -> None:
        """Turn this environment into a branch that waits for the agent only."""
        if not self._branched:
            self._branched = True
            self.session.leave_caller()
            self.episode.single_out(self._own)

    def check_pending(self) -> None:
        """Refuse a branch after the planner has returned its action."""
        episode = self.episode
        if episode.deciding is not self._own:
            raise episode.refusal()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """In a branch, answer the pending decision and run to the agent's next one."""
        if not self._branched:
            raise ReentrancyError(_REFUSAL)
        return super().step(action)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> NoReturn:
        """Refuse the reset: this is the environment of one decision."""
        raise ReentrancyError(_REFUSAL)

    def close(self) -> None:
        """End a branch."""
        if not self._branched:
            raise ReentrancyError(_REFUSAL)
        super().close()

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        raise CopyError(
            "the environment that a policy is given cannot be copied; use branch or clone to"
            " continue it"
        )

    __deepcopy__ = __reduce_ex__  # type: ignore[assignment]
