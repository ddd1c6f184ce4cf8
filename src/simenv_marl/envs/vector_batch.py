"""Simulations of one plan, suspended side by side in one process and stepped together."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import deepcopy
from enum import IntEnum
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import concatenate, create_empty_array
from numpy.typing import NDArray

from ..core.episode import Episode
from ..core.plan import Plan
from ..core.session import Session
from ..core.stacking import stacker
from ..core.together import step_all
from ..decision import decision_points
from ..errors import InvalidActionError, OptionValueError, annotate, short_repr
from .base import OneAgentView
from .joint import Joint, SimulationJointEnv
from .single import SimulationEnv

Infos = list[tuple[int, dict[str, Any]]]
"""Infos, each with the number of its sub-environment, in the order in which they must be merged."""

Results = tuple[Any, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], Infos]
"""Observations, rewards, terminations, truncations and infos of one step."""


class State(IntEnum):
    """What may happen to a sub-environment next. The largest state of all sub-environments decides for all of them."""

    RUNNING = 0  # a step
    ENDED = 1  # the next episode, which the next step or a reset begins
    FAILED = 2  # a reset of all sub-environments: an error has left them at different steps
    NEW = 3  # the first reset


class SubEnvironmentType:
    """The view and the spaces that all sub-environments share.

    Attributes:
        plan: The plan of their sessions.
        view_plan: The plan from which their views are made.
        view: The class of their views.
        joint: The shared part of their joint views. None if they are single views.
        observation_space, action_space: The spaces of one sub-environment.
    """

    def __init__(self, simulation: Any, points: Any, options: Mapping[str, Any], view: str | None) -> None:
        """Choose the view, by arguments of ``vector_env``. For a joint view this may take the reset of a simulation."""
        self._arguments = simulation, points, options
        plan = Plan.draw_up(simulation, points, options)
        if view is None:
            view = "joint" if plan.one_agent is None else "single"
        self.joint: Joint | None = None
        self.view: type[OneAgentView]
        if view == "single":
            self.view, self.view_plan, self.plan = SimulationEnv, plan, SimulationEnv.adapt(plan)
            definition = self.plan.active[0].definition
            self.observation_space = deepcopy(definition.observation_space)
            self.action_space = deepcopy(definition.action_space)
        elif view == "joint":
            first = SimulationJointEnv(plan)
            first.close()
            self.view, self.joint = SimulationJointEnv, first.joint
            self.plan = self.view_plan = first._plan
            self.observation_space, self.action_space = first.observation_space, first.action_space
        else:
            raise OptionValueError(f'view must be None, "single" or "joint", not {short_repr(view)}')

    @property
    def arguments(self) -> tuple[Any, ...]:
        """The arguments that make the same in another process, with what only this process can find out."""
        simulation, points, options = self._arguments
        registered = decision_points()
        if points is None and [named.point.name for named in self.plan._named] == registered:
            points = registered
        if self.joint is not None:
            options = {**options, "possible_agents": self.plan.options.possible_agents}
        return simulation, points, options, "single" if self.joint is None else "joint"


class SimulationBatch:
    """Sub-environments side by side.

    Attributes:
        states: The ``State`` of each sub-environment, an array of shape ``(number,)``.
        sessions: The sessions of the sub-environments.
    """

    def __init__(self, kind: SubEnvironmentType, number: int, mode: AutoresetMode, offset: int = 0) -> None:
        """Make the simulations. ``offset``: the number of sub-environments in the batches before, for messages."""
        self._kind, self._mode, self._offset = kind, mode, offset
        self._agent = str(kind.plan.one_agent)
        self._shows = kind.plan.options.render_mode == "human"
        self._stack = stacker(kind.observation_space, cast=True, other=concatenate)
        self._observations = create_empty_array(kind.observation_space, number)
        self._observed: list[Any] = [None] * number
        self._views: list[OneAgentView] = []
        self._episodes: list[Any] = []  # the episodes of ``_agents``, in the single view
        self._agents: list[Any] = []
        self.states = np.full(number, State.NEW)
        self.sessions: list[Session] = []
        try:
            for _ in range(number):
                self.sessions.append(Session(kind.plan))
        except BaseException as error:
            annotate(error, self._place(len(self.sessions)))
            self.abandon()
            raise

    # -- episodes ---------------------------------------------------------------------------------

    def reset(
        self, seeds: Sequence[int | None], options: dict[str, Any] | None, chosen: Sequence[int]
    ) -> tuple[Any, Infos]:
        """Begin new episodes of the chosen sub-environments. ``seeds`` has a seed for each, chosen or not.

        Returns:
            The observations of all sub-environments, and the infos of those that were reset.
        """
        infos = [(number, self._begin(number, seeds[number], options, first=chosen[0])) for number in chosen]
        return self._stacked(), infos

    def check(self, actions: Sequence[Any]) -> list[Any]:
        """Check actions against the pending decisions; return them in the form that mappings take."""
        return checked_actions(actions, self.states, self._checked, self._offset)

    def _checked(self, number: int, action: Any) -> Any:
        session, joint = self.sessions[number], self._kind.joint
        if session.episode is None:  # its view was closed
            raise session.refusal()
        pending = session.episode.pending
        if pending is None:  # the step says why
            return action
        if joint is None:
            return pending.point.checked(action, self._agent, pending.mask)
        joint.check(session.episode, action)
        return action

    def step(self, actions: Sequence[Any]) -> Results:
        """Answer all pending decisions by checked actions, and run each simulation to its next decision."""
        begun = np.flatnonzero(self.states == State.ENDED.value).tolist()  # the member itself is slow to compare
        for number in begun:
            self._begin(number)
        moving = np.delete(np.arange(len(self.sessions)), begun).tolist() if begun else range(len(self.sessions))
        self._move(moving, actions, first=-1 if begun else 0)
        episodes: list[Any] = [session.episode for session in self.sessions]
        self._observed, earned, news = self._read(episodes)
        rewards = np.array(earned, np.float64)
        rewards[begun] = 0.0
        terminations, truncations = np.zeros(len(episodes), np.bool_), np.zeros(len(episodes), np.bool_)
        infos: Infos = []
        eventful = any(news) or None in [episode.pending for episode in episodes]
        for number, (episode, info) in enumerate(zip(episodes, news, strict=True)) if eventful else ():
            ended = self._end_of(episode) if episode.pending is None else None
            if ended is not None:
                terminations[number], truncations[number] = ended
                if self._mode == AutoresetMode.SAME_STEP:
                    infos.append((number, {"final_obs": self._observed[number], "final_info": info}))
                    info = self._begin(number)
                else:
                    self.states[number] = State.ENDED
            if info:
                infos.append((number, info))
        for session in self.sessions if self._shows else ():
            session.render()
        return self._stacked(), rewards, terminations, truncations, infos

    def _begin(
        self, number: int, seed: int | None = None, options: dict[str, Any] | None = None, *, first: int = -1
    ) -> dict[str, Any]:
        """Begin an episode, note its first observation, and return its first info. ``first``: see ``_fail``."""
        session, joint = self.sessions[number], self._kind.joint
        try:
            episode = session.start(seed, options, in_rounds=joint is not None)
            if self._shows:
                session.render()
            (self._observed[number],), _, (info,) = self._read([episode])
        except BaseException as error:
            self._fail(number, error, first)
            raise
        self.states[number] = State.RUNNING
        return info

    def _move(self, moving: Sequence[int], actions: Sequence[Any], *, first: int) -> None:
        """Answer the decisions of some sub-environments. ``first``: see ``_fail``."""
        episodes: list[Any] = [self.sessions[number].episode for number in moving]
        if None in episodes:  # its view was closed
            raise self.sessions[moving[episodes.index(None)]].refusal()
        joint = self._kind.joint
        if joint is None:
            own = actions if len(moving) == len(actions) else [actions[number] for number in moving]
            step_all(episodes, own, lambda place, error: self._fail(moving[place], error, first))
            return
        for number, episode in zip(moving, episodes, strict=True):
            try:
                episode.play(joint.actions(episode, actions[number]))
            except BaseException as error:
                self._fail(number, error, first)
                raise

    def _read(self, episodes: list[Any]) -> tuple[list[Any], list[float], list[dict[str, Any]]]:
        """Read the observations, the rewards and the infos of episodes."""
        joint = self._kind.joint
        if joint is not None:
            results = [(joint.observe(each), joint.reward(each), joint.inform(each)) for each in episodes]
            observed, rewards, infos = zip(*results, strict=True)
            return list(observed), list(rewards), list(infos)
        if episodes != self._episodes:
            self._episodes, self._agents = episodes, [episode.agent(self._agent) for episode in episodes]
        agents = self._agents
        return (
            [agent.observation for agent in agents],
            [agent.reward for agent in agents],
            [agent.info for agent in agents],
        )

    def _end_of(self, episode: Episode) -> tuple[bool, bool] | None:
        """The flags terminated and truncated of an episode, as its view reports them; None if it continues."""
        if episode.unreported_end:  # the next step reports it
            return None
        if self._kind.joint is None and self._agent in episode.ended:
            return True, False
        return (episode.terminated, episode.truncated) if episode.over else None

    def _stacked(self) -> Any:
        """The latest observations, in an array (or a dict or tuple of arrays) that the next call overwrites."""
        self._observations = self._stack(self._observed, self._observations)
        return self._observations

    def _fail(self, number: int, error: BaseException, first: int) -> None:
        """Say in an error which sub-environment raised it. All have failed, unless the first to move has not moved."""
        annotate(error, self._place(number))
        episode = self.sessions[number].episode
        if number != first or episode is None or episode.pending is None:  # otherwise nothing has moved
            self.states[self.states != State.NEW] = State.FAILED

    def _place(self, number: int) -> str:
        return f"simenv_marl: in sub-environment {self._offset + number}"

    # -- views ------------------------------------------------------------------------------------

    @property
    def views(self) -> list[OneAgentView]:
        """The Gymnasium views of the sub-environments."""
        if not self._views:
            self._views = [self._kind.view(self._kind.view_plan, session=session) for session in self.sessions]
        return self._views

    def call(self, name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> list[Any]:
        """Call a method of each view, or get an attribute of each."""
        results = []
        for view in self.views:
            found = getattr(view, name)
            results.append(found(*args, **kwargs) if callable(found) else found)
        return results

    def set_attr(self, name: str, values: Iterable[Any]) -> None:
        """Set an attribute of each view."""
        for view, value in zip(self.views, values, strict=True):
            setattr(view, name, value)

    # -- ends -------------------------------------------------------------------------------------

    def close(self) -> None:
        """Unwind all simulations, also if one raises an error; raise the first of the errors."""
        raised: BaseException | None = None
        for number, session in enumerate(self.sessions):
            try:
                session.close()
            except BaseException as error:
                if raised is None:
                    raised = error
                    annotate(raised, self._place(number))
                else:
                    place = f"sub-environment {self._offset + number}"
                    annotate(raised, f"simenv_marl: {place} raised {short_repr(error)} as well")
        if raised is not None:
            raise raised

    @property
    def idle(self) -> bool:
        """Whether all episodes have been ended, and all patches removed."""
        return all(session.idle for session in self.sessions)

    def abandon(self) -> None:
        """Unwind all simulations, from a finalizer. Warn of errors instead of raising them."""
        for session in self.sessions:
            session.abandon()


def checked_actions(
    actions: Iterable[Any], states: NDArray[Any], check: Callable[[int, Any], Any], offset: int = 0
) -> list[Any]:
    """Check the actions of sub-environments, except of those whose next episode begins; return the checked actions.

    Raises:
        InvalidActionError: An action is not legal. The message names the sub-environment.
    """
    checked = list(actions)
    for number, action in enumerate(checked):
        if states[number] != State.ENDED:
            try:
                checked[number] = check(number, action)
            except InvalidActionError as error:
                raise InvalidActionError(f"sub-environment {offset + number}: {error}") from None
    return checked
