"""Simulations of one plan, suspended side by side in one process and stepped together."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import deepcopy
from functools import cached_property
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import concatenate, create_empty_array
from numpy.typing import NDArray

from ..core.plan import Plan
from ..core.session import Session
from ..core.stacking import stacker
from ..decision import decision_points
from ..errors import InvalidActionError, OptionValueError, annotate, short_repr
from ..many.batch import close_all, step_all
from .base import OneAgentView
from .joint import Joint, SimulationJointEnv
from .single import SimulationEnv

Infos = list[tuple[int, dict[str, Any]]]
"""Infos, each with the number of its sub-environment, in the order in which they must be merged."""


class SimulationBatch:
    """Sub-environments side by side: all those of a vector environment, or those of one of its workers.

    Lists and arrays among the arguments and results have an item for each of them.

    Attributes:
        arguments: The arguments that make the same in another process, with what only this process can find out.
        plan: The plan of the sessions.
        view_plan: The plan from which views of the sub-environments are made.
        view: The class of these views.
        joint: What joint views share. None if the views are single ones.
        observation_space, action_space: The spaces of one sub-environment.
        sessions: The sessions of the sub-environments.
        untouched: Whether the latest ``reset`` or ``step`` raised an error before any simulation had moved.
        broken: False: there is no worker that could die.
    """

    broken = False

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
        plan = Plan(simulation, points, options)
        if points is None and [named.point.name for named in plan._named] == decision_points():
            points = decision_points()
        if view is None:
            view = "joint" if plan.one_agent is None else "single"
        self.joint: Joint | None = None
        self.view: type[OneAgentView] = SimulationJointEnv
        if view == "single":
            self.view, self.view_plan, self.plan = SimulationEnv, plan, SimulationEnv.adapt(plan)
            definition = self.plan.active[0].definition
            self.observation_space = deepcopy(definition.observation_space)
            self.action_space = deepcopy(definition.action_space)
        elif view == "joint":
            first = SimulationJointEnv(plan)
            first.close()
            self.joint, self.plan = first.joint, first._plan
            self.view_plan = self.plan
            options = {**options, "possible_agents": self.plan.options.possible_agents}
            self.observation_space, self.action_space = first.observation_space, first.action_space
        else:
            raise OptionValueError(f'view must be None, "single" or "joint", not {short_repr(view)}')
        self.arguments = simulation, points, options, view, mode
        self._mode, self._part = mode, part
        self._agent = str(self.plan.one_agent)
        self._shows = self.plan.options.render_mode == "human"
        self._stack = stacker(self.observation_space, cast=True, other=concatenate)
        self._observations = create_empty_array(self.observation_space, len(part))
        self._observed: list[Any] = [None] * len(part)
        self._episodes: list[Any] = []  # the episodes of ``_agents``, in the single view
        self._agents: list[Any] = []
        self._first = -1
        self.untouched = False
        self.sessions: list[Session] = []
        try:
            while len(self.sessions) < len(part):
                self.sessions.append(Session(self.plan))
        except BaseException as error:
            annotate(error, f"simenv_marl: in sub-environment {part[len(self.sessions)]}")
            self.abandon()
            raise

    def ask(self, method: str, *arguments: Any) -> list[Any]:
        """Call a method. The list has its result, as that of ``WorkerPool.ask`` has one of each worker."""
        return [getattr(self, method)(*arguments)]

    # -- episodes ---------------------------------------------------------------------------------

    def reset(
        self, seeds: Sequence[int | None], options: dict[str, Any] | None, chosen: NDArray[np.bool_]
    ) -> tuple[Any, Infos]:
        """Begin new episodes of the chosen sub-environments.

        Returns:
            The observations of all sub-environments, and the infos of those that were reset.
        """
        numbers = chosen.nonzero()[0].tolist()
        self._first, self.untouched = numbers[0] if numbers else -1, False
        infos = [(self._part[number], self._begin(number, seeds[number], options)) for number in numbers]
        return self._stacked(), infos

    def check(self, actions: Sequence[Any], ended: NDArray[np.bool_]) -> list[Any]:
        """Check actions against the pending decisions; return them in the form that mappings take."""
        return checked_actions(actions, ended, self._checked, self._part.start)

    def _checked(self, number: int, action: Any) -> Any:
        session = self.sessions[number]
        if session.episode is None:  # its view was closed
            raise session.refusal()
        pending = session.episode.pending
        if pending is None:  # the step says why
            return action
        if self.joint is None:
            return pending.point.checked(action, self._agent, pending.mask)
        self.joint.check(session.episode, action)
        return action

    def step(self, actions: Sequence[Any], ended: NDArray[np.bool_]) -> tuple[Any, ...]:
        """Answer all pending decisions by checked actions, and run each simulation to its next decision.

        Where an episode has ended, the next one begins instead.

        Returns:
            Observations, rewards, terminations, truncations and infos.
        """
        begun = ended.nonzero()[0].tolist()
        self._first, self.untouched = -1 if begun else 0, False
        for number in begun:
            self._begin(number)
        self._move((~ended).nonzero()[0].tolist() if begun else range(len(actions)), actions)
        episodes: list[Any] = [session.episode for session in self.sessions]
        self._observed, earned, news = self._read(episodes)
        rewards = np.array(earned, np.float64)
        if begun:
            rewards[begun] = 0.0
        terminations, truncations = np.zeros(len(episodes), np.bool_), np.zeros(len(episodes), np.bool_)
        infos: Infos = []
        eventful = any(news) or None in [episode.pending for episode in episodes]
        for number, (episode, info) in enumerate(zip(episodes, news, strict=True)) if eventful else ():
            if episode.over and not episode.unreported_end:  # which the next step reports
                removed = self.joint is None and self._agent in episode.ended
                terminations[number] = removed or episode.terminated
                truncations[number] = episode.truncated and not removed
                if self._mode == AutoresetMode.SAME_STEP:
                    final = {"final_obs": self._observed[number], "final_info": info}
                    infos.append((self._part[number], final))
                    info = self._begin(number)
            if info:
                infos.append((self._part[number], info))
        for session in self.sessions if self._shows else ():
            session.render()
        return self._stacked(), rewards, terminations, truncations, infos

    def _begin(self, number: int, seed: int | None = None, options: dict[str, Any] | None = None) -> dict[str, Any]:
        """Begin an episode, note its first observation, and return its first info."""
        session = self.sessions[number]
        try:
            episode = session.start(seed, options, in_rounds=self.joint is not None)
            if self._shows:
                session.render()
            (self._observed[number],), _, (info,) = self._read([episode])
        except BaseException as error:
            self._fail(number, error)
            raise
        return info

    def _move(self, moving: Sequence[int], actions: Sequence[Any]) -> None:
        """Answer the decisions of some sub-environments."""
        episodes: list[Any] = [self.sessions[number].episode for number in moving]
        if None in episodes:  # its view was closed
            raise self.sessions[moving[episodes.index(None)]].refusal()
        own = actions if len(moving) == len(actions) else [actions[number] for number in moving]
        if self.joint is not None:
            own = list(map(self.joint.actions, episodes, own))
        step_all(episodes, own, lambda place, error: self._fail(moving[place], error))

    def _read(self, episodes: list[Any]) -> tuple[list[Any], list[float], list[dict[str, Any]]]:
        """Read the observations, the rewards and the infos of episodes."""
        joint = self.joint
        if joint is not None:
            return (
                [joint.observe(episode) for episode in episodes],
                [joint.reward(episode) for episode in episodes],
                [joint.inform(episode) for episode in episodes],
            )
        if episodes != self._episodes:
            self._episodes, self._agents = episodes, [episode.agent(self._agent) for episode in episodes]
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
        """Say in an error which sub-environment raised it. Nothing has moved if it is the first and still waits."""
        annotate(error, f"simenv_marl: in sub-environment {self._part[number]}")
        episode = self.sessions[number].episode
        self.untouched = number == self._first and episode is not None and episode.pending is not None

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


def checked_actions(
    actions: Iterable[Any], ended: NDArray[np.bool_], check: Callable[[int, Any], Any], first: int = 0
) -> list[Any]:
    """Check the actions of sub-environments, except of those whose next episode begins; return the checked actions.

    Raises:
        InvalidActionError: An action is not legal. The message names the sub-environment.
    """
    checked = list(actions)
    for number, action in enumerate(checked):
        if not ended[number]:
            try:
                checked[number] = check(number, action)
            except InvalidActionError as error:
                raise InvalidActionError(f"sub-environment {first + number}: {error}") from None
    return checked
