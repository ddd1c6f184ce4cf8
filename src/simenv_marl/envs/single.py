"""The single view: a Gymnasium environment of one agent.

A planner gets the view of the agent that it decides for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NoReturn, Self

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ..core import (
    Action,
    EpisodeState,
    Info,
    Model,
    Observation,
    Plan,
    Points,
    Replay,
    Session,
    Space,
    make_plan,
)
from ..errors import CopyError, ReentrancyError, ViewError
from ..simulation import asks_for
from .agents import OneAgentView
from .base import ResetOptions, StepResult

_REFUSAL = (
    "a policy cannot move the environment that it is given: it must return an action; branch tries"
    " actions out"
)


def plan_of(
    simulation: Model,
    points: Points,
    options: Mapping[str, Any],
    **settings: Any,
) -> Plan:
    """Make a plan, as ``make_plan`` does. Its planners get the view of their agent."""
    return make_plan(
        simulation,
        points,
        options,
        planner_view=PlannerEnv.of_session,
        **settings,
    )


class SimulationEnv(OneAgentView):
    """A simulation as a Gymnasium environment of one agent.

    ``single_env`` and ``generate_env`` make it.

    Attributes:
        own_agent: The agent, during an episode.
    """

    kind = "single"
    _own_options = ("agent",)

    def set_up(self) -> None:
        """Find the agent."""
        self._agent_name = str(self.session.plan.one_agent)
        episode = self.session.episode
        if episode is not None:
            self.begin(episode)

    @classmethod
    def adapt(cls, plan: Plan) -> Plan:
        """Check that a plan allows this view. Put goals, if it has any, into the observations."""
        if plan.one_agent is None:
            points = ", ".join(point.hook.name for point in plan.active)
            raise ViewError(
                "the single view needs one active decision point whose agent= is not a callable,"
                f" or the name of one agent; active are {points}. Name the agent with agent=, name"
                " one point in points=, answer the others with policies=, or use aec_env"
            )
        point = plan.active[0]
        definition = point.definition
        goal = definition.goal_space
        if goal is not None:
            mappings: dict[str, Any] = {
                "observation": definition.observation_space_mapping,
                "achieved_goal": definition.achieved_goal_mapping,
                "desired_goal": definition.desired_goal_mapping,
            }
            asking = {key for key, part in mappings.items() if asks_for(part, "_simulation")}
            fitted = {
                key: point.fit(part, f"the mapping of {key}").call for key, part in mappings.items()
            }
            parts = {
                "observation": definition.observation_space,
                "achieved_goal": goal,
                "desired_goal": goal,
            }
            changed = replace(
                definition,
                observation_space=spaces.Dict(parts),
                observation_space_mapping=partial(_observe_with_goals, fitted, asking),
            )
            plan = plan.redefined(point.hook, changed)
        return super().adapt(plan)

    @classmethod
    def spaces_of(cls, plan: Plan) -> tuple[Space, Space]:
        """Return the spaces of the agent of an adapted plan."""
        definition = plan.active[0].definition
        return definition.observation_space, definition.action_space

    def begin(self, episode: EpisodeState) -> tuple[Observation, Info]:
        """Note the agent of a new episode; return its observation and info."""
        name = self._agent_name
        agent = episode.agents.get(name) or episode.ended[name]
        self.own_agent = agent
        return agent.hand_out(), agent.info

    def step(self, action: Action) -> StepResult:
        """Answer the pending decision with an action, or ``RULE``, and run to the next one.

        Returns:
            Observation, reward (a Python float), terminated, truncated, info.

        Raises:
            BaseException: Any error of ``SimulationAECEnv.step``.
        """
        episode = self.session.episode
        if episode is None or (self._lock and not self._lock.held):
            return self._step_in_lock(SimulationEnv.step, action)
        episode.step(action)
        if self._shows:
            self.show_step()
        agent = self.own_agent
        terminated = truncated = False
        if episode.pending is None:
            terminated, truncated = self.read_end(episode)
        self._latest = results = (
            agent.hand_out(),
            agent.reward,
            terminated,
            truncated,
            agent.info,
        )
        return results

    @classmethod
    def read_all(cls, views: Sequence[Self]) -> tuple[list[Observation], list[float], list[Info]]:
        """Return the observations, rewards and infos of the latest step of several views."""
        agents = [view.own_agent for view in views]
        return (
            [agent.raw_observation for agent in agents],
            [agent.reward for agent in agents],
            [agent.info for agent in agents],
        )

    def read_end(self, episode: EpisodeState) -> tuple[bool, bool]:
        """Return how an episode has ended for the agent: whether terminated, whether truncated."""
        if self.own_agent.ended:
            return True, False
        return super().read_end(episode)

    def validate(self, action: Action) -> Action:
        """Validate an action for the pending decision, before the simulation moves."""
        pending = self.episode.pending
        return action if pending is None else pending.validate(action)

    @property
    def compute_reward(self) -> Callable[..., float | NDArray[np.float64]]:
        """A function that returns the rewards for other goals, if the decision point has a goal.

        Its arguments are the achieved goals, of shape ``goal_space.shape``, or
        ``(n, *goal_space.shape)`` for n steps; the desired goals, of the same shape; and the info
        of the step, or a sequence of n infos. It returns the reward, or an array of n rewards.

        Raises:
            AttributeError: The decision point has no goal.
        """
        compute = self._point_of(self._agent_name).definition.compute_reward
        if compute is None:
            raise AttributeError(
                f"{type(self).__name__} has no compute_reward: its decision point has no"
                " goal_space="
            )

        def compute_reward(
            achieved_goal: Observation,
            desired_goal: Observation,
            info: Model,
        ) -> float | NDArray[np.float64]:
            reward = np.asarray(compute(achieved_goal, desired_goal, info), np.float64)
            return float(reward) if reward.ndim == 0 else reward

        return compute_reward


def _observe_with_goals(
    mappings: Mapping[str, Callable[..., Observation]],
    asking: set[str],
    *args: Model,
    _simulation: Model,
    **kwargs: Model,
) -> dict[str, Observation]:
    """Observe a call. ``asking``: the keys of the mappings that ask for the simulation."""
    observation = {}
    for key, mapping in mappings.items():
        named = {**kwargs, "_simulation": _simulation} if key in asking else kwargs
        observation[key] = mapping(*args, **named)
    return observation


class PlannerEnv(SimulationEnv):
    """The single view of an agent whose planner is being asked, for ``branch`` and its users.

    The decision is pending until the planner returns an action. A branch is an ordinary environment
    of the agent, which can be stepped; policies or rules answer for all other agents.
    """

    kind = ""  # files name the view in which the planner decides
    session: Session
    is_branch = False  # or a clone

    def set_up(self) -> None:
        """Find the agent whose planner is being asked."""
        self._shows = False
        episode = self.session.episode
        deciding = None if episode is None else episode.deciding
        if deciding is not None:  # otherwise the session is going to replay an episode
            self.own_agent = deciding
            self._agent_name = deciding.name
            self._roster = {deciding.name: deciding.point}

    @classmethod
    def adapt(cls, plan: Plan) -> Plan:
        """Allow every plan: the agent is the one whose planner is being asked."""
        return plan

    def begin_branch(self) -> None:
        """Turn this environment into a branch that waits for the agent only."""
        if not self.is_branch:
            self.is_branch = True
            self.session.leave_caller()
            self.episode.single_out(self.own_agent)

    def repeat_branch(self, seed: int, options: ResetOptions, replay: Replay, rounds: bool) -> None:
        """Repeat the episode of the environment, and begin the branch at the same decision.

        ``rounds``: whether all agents are updated when a step of the environment returns.
        """
        self.is_branch = True
        session = self.session
        episode = session.start(seed, options, in_rounds=rounds)
        session.repeat(replay, episode.step)
        self.set_up()
        self._latest = self.own_agent.hand_out(), self.own_agent.info

    def check_pending(self) -> None:
        """Refuse a branch after the planner has returned its action."""
        episode = self.episode
        if episode.deciding is not self.own_agent:
            raise episode.refusal()

    def step(self, action: Action) -> StepResult:
        """In a branch, answer the pending decision and run to the agent's next one."""
        self._check_branched()
        return super().step(action)

    def reset(self, *, seed: int | None = None, options: ResetOptions = None) -> NoReturn:
        """Refuse the reset: this is the environment of one decision."""
        raise ReentrancyError(_REFUSAL)

    def close(self) -> None:
        """End a branch."""
        self._check_branched()
        super().close()

    def _check_branched(self) -> None:
        if not self.is_branch:
            raise ReentrancyError(_REFUSAL)

    def __reduce_ex__(self, protocol: object) -> NoReturn:
        raise CopyError(
            "the environment that a policy is given cannot be copied; use branch or clone to"
            " continue it"
        )

    __deepcopy__ = __reduce_ex__  # type: ignore[assignment]
