"""Simulations of one plan, suspended side by side in one process and stepped together."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence, Set
from copy import deepcopy
from functools import cached_property
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import create_empty_array
from numpy.typing import NDArray

from ..core import Episode, Session, UnmatchedNames, close_all, stacker
from ..decision import decision_points
from ..errors import InvalidActionError, OptionValueError, annotate, short_repr
from ..many.batch import step_all
from .base import OneAgentView
from .joint import Joint, SimulationJointEnv
from .single import SimulationEnv, plan_of

Infos = list[tuple[int, dict[str, Any]]]
"""Infos, each with the number of its sub-environment, in the order in which they must be merged."""


class SimulationBatch:
    """Sub-environments side by side: all those of a vector environment, or those of one of its workers.

    Lists and arrays among the arguments and results have an item for each of them.

    Attributes:
        arguments: The arguments that make the same in another process, with what only this process
            can find out.
        plan, view_plan: The plans of the sessions and of views of them, whose class is ``view``.
        joint: What joint views share. None if the views are single ones.
        failed: Whether an error has left them at different steps, so that all of them need a reset.
    """

    def __init__(
        self,
        simulation: Any,
        points: Any,
        options: Mapping[str, Any],
        view: str | None,
        mode: AutoresetMode,
        part: range,
    ) -> None:
        """Make the simulations, by arguments of ``vector_env``. For a joint view this may take the reset of another.

        ``part`` has the numbers of the sub-environments in the vector environment.
        """
        plan = plan_of(simulation, points, options)
        names = [point.name for point in plan.subject.named]
        if points is None and names == decision_points():
            points = decision_points()
        if view is None:
            view = "joint" if plan.one_agent is None else "single"
        self.joint: Joint | None = None
        self.view: type[OneAgentView] = SimulationJointEnv
        if view == "single":
            self.view, self.view_plan, self.plan = SimulationEnv, plan, SimulationEnv._adapt(plan)
            own = self.plan.active[0].definition
            self.observation_space, self.action_space = deepcopy(
                (own.observation_space, own.action_space)
            )
        elif view == "joint":
            first = SimulationJointEnv(plan)
            first.close()
            self.joint, self.plan = first.joint, first._plan
            self.view_plan = self.plan
            options = {**options, "possible_agents": self.plan.options.possible_agents}
            self.observation_space, self.action_space = first.observation_space, first.action_space
        else:
            raise OptionValueError(
                f'view must be None, "single" or "joint", not {short_repr(view)}'
            )
        self.arguments = simulation, points, options, view, mode
        self._mode, self._part = mode, part
        self._agent = str(self.plan.one_agent)
        self._shows = self.plan.options.shows
        self._stack = stacker(self.observation_space, cast=True)
        self._observations = create_empty_array(self.observation_space, len(part))
        self._observed: list[Any] = [None] * len(part)
        self._episodes: list[Any] = []  # the episodes of ``_agents``, in the single view
        self._agents: list[Any] = []
        self._first: int | None = None  # the sub-environment that moves first in a reset or a step
        self.failed = False
        self.sessions: list[Session] = []
        unmatched = UnmatchedNames(self.plan.named_agents)
        self._times: list[float | None] = [None] * len(
            part
        )  # of the previous steps, in joint views
        try:
            while len(self.sessions) < len(part):
                self.sessions.append(Session(self.plan, unmatched))
        except BaseException as error:
            annotate(error, f"simenv_marl: in sub-environment {part.start + len(self.sessions)}")
            self.abandon()
            raise

    def ask(self, method: str, *arguments: Any) -> list[Any]:
        """Call a method.

        The list has its result, as that of ``WorkerPool.ask`` has one of each worker.
        """
        return [getattr(self, method)(*arguments)]

    # -- episodes ---------------------------------------------------------------------------------

    def reset(
        self, seeds: Sequence[int | None], options: dict[str, Any] | None, chosen: NDArray[np.bool_]
    ) -> tuple[Any, Infos]:
        """Begin new episodes of the chosen sub-environments.

        Return all observations, and the infos of these.
        """
        numbers = chosen.nonzero()[0].tolist()
        self._first = next(iter(numbers), None)
        infos = [
            (self._part[number], self._begin(number, seeds[number], options)) for number in numbers
        ]
        self.failed = False
        return self._stacked(), infos

    def check(self, actions: list[Any], ended: Set[int]) -> list[Any]:
        """Check the actions that will be used; return them in the form that mappings take."""
        for number, own in enumerate(self._part):
            try:
                if own not in ended:
                    actions[number] = self._checked(self.sessions[number], actions[number])
            except InvalidActionError as error:
                raise InvalidActionError(f"sub-environment {own}: {error}") from None
        return actions

    def _checked(self, session: Session, action: Any) -> Any:
        if session.episode is None:  # its view was closed
            raise session.refusal()
        pending = session.episode.pending
        if pending is None:  # the step says why
            return action
        if self.joint is None:
            return pending.point.validate(action, self._agent, pending.mask)
        self.joint.check(session.episode, action)
        return action

    def step(self, actions: Sequence[Any], ended: Set[int]) -> tuple[Any, ...]:
        """Answer all pending decisions by checked actions, or begin the next episode where one has ended.

        Returns:
            Observations, rewards, terminations, truncations, the numbers of those that have ended
            now, and infos.
        """
        begun = [number for number, own in enumerate(self._part) if own in ended] if ended else []
        self._first = None if begun else 0
        for number in begun:
            self._begin(number)
        episodes: list[Any] = [session.episode for session in self.sessions]
        if None in episodes:  # its view was closed
            raise self.sessions[episodes.index(None)].refusal()
        moving: Sequence[int] = range(len(episodes))
        waiting, own = episodes, actions
        if begun:
            moving = [number for number, own in enumerate(self._part) if own not in ended]
            waiting, own = (
                [episodes[number] for number in moving],
                [actions[number] for number in moving],
            )
        if self.joint is not None:
            own = list(map(self.joint.actions, waiting, own))
        step_all(waiting, own, lambda place, error: self._fail(moving[place], error))
        self._observed, earned, news = self._read(episodes, range(len(episodes)))
        rewards = np.array(earned, np.float64)
        if begun:
            rewards[begun] = 0.0
        terminations, truncations = (
            np.zeros(len(episodes), np.bool_),
            np.zeros(len(episodes), np.bool_),
        )
        ends: list[int] = []
        infos: Infos = []
        eventful = any(news) or None in [episode.pending for episode in episodes]
        for number, (episode, info) in (
            enumerate(zip(episodes, news, strict=True)) if eventful else ()
        ):
            if episode.over and not episode.unreported_end:  # which the next step reports
                removed = self.joint is None and self._agent in episode.ended
                terminations[number] = removed or episode.terminated
                truncations[number] = episode.truncated and not removed
                if self._mode != AutoresetMode.SAME_STEP:
                    ends.append(self._part[number])
                else:
                    final = {"final_obs": self._observed[number], "final_info": info}
                    infos.append((self._part[number], final))
                    info = self._begin(number)
            if info:
                infos.append((self._part[number], info))
        for view in self.views if self._shows else ():
            view._show()
        return self._stacked(), rewards, terminations, truncations, ends, infos

    def _begin(
        self, number: int, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> dict[str, Any]:
        """Begin an episode, note its first observation, and return its first info."""
        session = self.sessions[number]
        try:
            episode = session.start(seed, options, in_rounds=self.joint is not None)
            if self._shows:
                self.views[number]._show(begins=True)
            self._times[number] = None
            (self._observed[number],), _, (info,) = self._read([episode], [number])
        except BaseException as error:
            self._fail(number, error)
            raise
        return info

    def _inform(self, joint: Joint, number: int, episode: Episode) -> dict[str, Any]:
        info = joint.inform(episode, self._times[number])
        self._times[number] = info.get("time")
        return info

    def _read(
        self, episodes: list[Any], numbers: Sequence[int]
    ) -> tuple[list[Any], list[float], list[dict[str, Any]]]:
        """Read the observations, the rewards and the infos of episodes."""
        joint = self.joint
        if joint is not None:
            return (
                [joint.observe(episode) for episode in episodes],
                [joint.reward(episode) for episode in episodes],
                [self._inform(joint, *pair) for pair in zip(numbers, episodes, strict=True)],
            )
        if episodes != self._episodes:
            self._episodes, self._agents = (
                episodes,
                [episode.agent(self._agent) for episode in episodes],
            )
        agents = self._agents
        return (
            [agent.observation for agent in agents],
            [agent.reward for agent in agents],
            [agent.info for agent in agents],
        )

    def _stacked(self) -> Any:
        """The latest observations, in an array (or a dict or tuple of arrays) that the next call overwrites."""
        self._observations = self._stack(self._observed, self._observations)
        return self._observations

    def _fail(self, number: int, error: BaseException) -> None:
        """Say in an error which sub-environment raised it.

        Nothing has moved if it is the first and still waits.
        """
        annotate(error, f"simenv_marl: in sub-environment {self._part[number]}")
        episode = self.sessions[number].episode
        self.failed = (
            self.failed or number != self._first or episode is None or episode.pending is None
        )

    # -- views ------------------------------------------------------------------------------------

    @cached_property
    def views(self) -> list[OneAgentView]:
        """The Gymnasium views of the sub-environments."""
        return [self.view(self.view_plan, session=session) for session in self.sessions]

    def call(self, name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> list[Any]:
        """Call a method of each view, or get an attribute of each."""
        found = [getattr(view, name) for view in self.views]
        return [value(*args, **kwargs) if callable(value) else value for value in found]

    def set_attr(self, name: str, values: Iterable[Any]) -> None:
        """Set an attribute of each view."""
        for view, value in zip(self.views, values, strict=True):
            setattr(view, name, value)

    # -- ends -------------------------------------------------------------------------------------

    def close(self) -> None:
        """Unwind all simulations, also if one raises an error; raise the first of the errors."""
        numbered = zip(self._part, self.sessions, strict=True)
        error = close_all((f"sub-environment {number}", session) for number, session in numbered)
        if error is not None:
            raise error

    @property
    def idle(self) -> bool:
        """Whether all episodes have been ended, and all patches removed."""
        return all(session.idle for session in self.sessions)

    def abandon(self) -> None:
        """Unwind all simulations, from a finalizer. Warn of errors instead of raising them."""
        for session in self.sessions:
            session.abandon()
