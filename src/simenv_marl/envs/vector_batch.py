"""Simulations of one plan, suspended side by side in one process and stepped together."""

from __future__ import annotations

import faulthandler
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space, create_empty_array, iterate
from numpy.typing import NDArray

from ..core import (
    Action,
    Episode,
    Info,
    Model,
    Observation,
    Plan,
    Points,
    Session,
    Space,
    UnmatchedNames,
    close_all,
    stacker,
)
from ..errors import InvalidActionError, annotate
from ..hooks.limits import SECONDS_TO_UNWIND, StepAlarm
from ..many.batch import step_all
from .agents import OneAgentView
from .base import ResetOptions
from .single import plan_of

Infos = list[tuple[int, Info]]
"""Infos with the numbers of their sub-environments. They must be merged in this order."""


class SimulationBatch:
    """Sub-environments side by side: all of a vector environment, or a part in one of its workers.

    Lists and arrays among the arguments and results have an item for each sub-environment. Its
    *number* is the one in the vector environment, its *place* the one in this batch.

    Attributes:
        views: The Gymnasium environments of the sub-environments.
        failed: Whether an error has left them at different steps, so that all of them need a reset.
        restarts: 0, as there are no workers.
    """

    restarts = 0

    def __init__(
        self,
        plan: Plan,
        view: type[OneAgentView],
        space: Space,
        mode: AutoresetMode,
        part: range,
    ) -> None:
        """Make the simulations. ``part``: the numbers of the sub-environments.

        ``space``: the space of their observations.
        """
        plan = view.adapt(plan)
        self._mode = mode
        self._part = part
        self._shows = plan.options.shows
        self._step_all = step_all
        limit = plan.options.step_timeout
        if limit is not None and plan.options.driver == "greenlet":  # threads limit each episode
            self._step_all = partial(_step_in_time, limit)
        self.failed = False
        self._first: int | None = None  # the place that moves first in a reset or a step
        self._sessions: list[Session] = []
        unmatched = UnmatchedNames(plan.named_agents)
        for number in part:
            try:
                self._sessions.append(Session(plan, unmatched))
            except BaseException as error:
                annotate(error, f"simenv_marl: in sub-environment {number}")
                self.abandon()
                raise
        self._view = view
        self._space = space
        self.views = [view.of_session(session) for session in self._sessions]
        self._stack = stacker(space, cast=True)
        self._stacked = create_empty_array(space, len(part))
        self._observations: list[Observation] = [None] * len(part)

    def ask(self, method: str, *arguments: Any) -> list[Any]:
        """Call a method; return a list of its result, as ``WorkerPool.ask`` does."""
        return [getattr(self, method)(*arguments)]

    # -- episodes ---------------------------------------------------------------------------------

    def reset(
        self,
        seeds: Sequence[int | None],
        options: ResetOptions,
        chosen: NDArray[np.bool_],
    ) -> tuple[Observation, Infos]:
        """Begin new episodes of the chosen sub-environments.

        Return all observations, and the infos of these.
        """
        places = chosen.nonzero()[0].tolist()
        self._first = places[0] if places else None
        infos = []
        for place in places:
            info = self._begin(place, seeds[place], options)
            infos.append((self._part[place], info))
        self.failed = False
        return self._stack_observations(), infos

    def check(
        self,
        actions: list[Action],
        ended: list[bool],
    ) -> list[Action]:
        """Check the actions that will be used; return them in the form that mappings take."""
        for place, number in enumerate(self._part):
            if ended[place]:
                continue
            try:
                actions[place] = self.views[place].validate(actions[place])
            except InvalidActionError as error:
                raise InvalidActionError(f"sub-environment {number}: {error}") from None
        return actions

    def step(
        self,
        actions: Sequence[Action],
        ended: list[bool],
    ) -> tuple[Any, ...]:
        """Answer all pending decisions by checked actions, or begin the next episode after an end.

        Returns:
            Observations, rewards, terminations, truncations, and infos.
        """
        self._first = None if any(ended) else 0
        for place, is_over in enumerate(ended):
            if is_over:
                self._begin(place)
        episodes = self._move(actions, ended)
        self._observations, earned, news = self._view.read_all(self.views)
        rewards = np.array(earned, np.float64)
        if self._first is None:
            rewards[ended] = 0.0
        terminations = np.zeros(len(episodes), np.bool_)
        truncations = np.zeros(len(episodes), np.bool_)
        infos = []
        is_eventful = any(news) or None in [episode.pending for episode in episodes]
        for place, number in enumerate(self._part if is_eventful else ()):
            episode = episodes[place]
            info = news[place]
            if episode.over and not episode.unreported_end:  # a later step reports that end
                view = self.views[place]
                terminations[place], truncations[place] = view.read_end(episode)
                if self._mode == AutoresetMode.SAME_STEP:
                    observation = self._observations[place]
                    infos.append((number, {"final_obs": observation, "final_info": info}))
                    info = self._begin(place)
            if info:
                infos.append((number, info))
        if self._shows:
            for view in self.views:
                view.show_step()
        return (
            self._stack_observations(),
            rewards,
            terminations,
            truncations,
            infos,
        )

    def exit_after(self, seconds: float) -> None:
        """In a worker, end the process if the simulations take longer than some seconds to step.

        They are in C code then, which no error ends.
        """
        self._step_all = partial(_step_or_exit, seconds, self._step_all)

    def take_over(self, observations: Observation, seeds: list[Any]) -> None:
        """Take over from a worker that was lost.

        Args:
            observations: The last observations. None if there are none.
            seeds: The seed of each sub-environment's generator. None: the generator is random.
        """
        if observations is not None:
            space = batch_space(self._space, len(self._part))
            self._observations = list(iterate(space, observations))
        for view, seed in zip(self.views, seeds, strict=False):
            if seed is not None:
                view.session.set_generator(np.random.default_rng(seed))

    def report_lost(self, ended: list[bool], why: str) -> tuple[Any, ...]:
        """End the episodes of a worker that was lost, or begin the next ones after an end.

        Return the results in the form of ``step``.
        """
        infos = []
        for place, number in enumerate(self._part):
            info = {} if ended[place] else {"lost": True, "lost_why": why}
            if info and self._mode == AutoresetMode.SAME_STEP:
                infos.append((number, {"final_obs": self._observations[place], "final_info": info}))
                info = {}
            infos.append((number, info or self._begin(place)))
        truncations = np.logical_not(ended)
        rewards = np.zeros(len(ended), np.float64)
        no_terminations = np.zeros(len(ended), np.bool_)
        return self._stack_observations(), rewards, no_terminations, truncations, infos

    def _move(self, actions: Sequence[Action], ended: list[bool]) -> list[Episode]:
        """Step all episodes that have not just begun after an end; return all."""
        episodes = [session.episode for session in self._sessions if session.episode]
        if len(episodes) < len(self._sessions):  # a view was closed
            raise next(s.refusal() for s in self._sessions if s.episode is None)
        if self._first is not None:  # all of them move
            self._step_all(episodes, actions, self._fail)
            return episodes
        places = [place for place, is_over in enumerate(ended) if not is_over]
        self._step_all(
            [episodes[place] for place in places],
            [actions[place] for place in places],
            lambda index, error: self._fail(places[index], error),
        )
        return episodes

    def _begin(
        self,
        place: int,
        seed: int | None = None,
        options: ResetOptions = None,
    ) -> Info:
        """Begin an episode, note its first observation, and return its first info."""
        view = self.views[place]
        try:
            episode = view.session.start(seed, options, in_rounds=view.in_rounds)
            self._observations[place], info = view.begin(episode)
            if self._shows:
                view.show_reset()
        except BaseException as error:
            self._fail(place, error)
            raise
        return info

    def _stack_observations(self) -> Observation:
        """Stack the latest observations in arrays that the next call overwrites."""
        self._stacked = self._stack(self._observations, self._stacked)
        return self._stacked

    def _fail(self, place: int, error: BaseException) -> None:
        """Name the sub-environment that raised an error.

        The batch has not failed if it is the first that moves, and still waits.
        """
        annotate(error, f"simenv_marl: in sub-environment {self._part[place]}")
        episode = self._sessions[place].episode
        if place != self._first or episode is None or episode.pending is None:
            self.failed = True

    # -- views ------------------------------------------------------------------------------------

    def call(
        self,
        name: str,
        args: tuple[Model, ...],
        kwargs: dict[str, Model],
    ) -> list[Model]:
        """Call a method of each view, or get an attribute of each."""
        values = [getattr(view, name) for view in self.views]
        return [value(*args, **kwargs) if callable(value) else value for value in values]

    def set_attr(self, name: str, values: Sequence[Model]) -> None:
        """Set an attribute of each view."""
        for view, value in zip(self.views, values, strict=True):
            setattr(view, name, value)

    # -- ends -------------------------------------------------------------------------------------

    def close(self) -> None:
        """Unwind all simulations, also if one raises an error; raise the first of the errors."""
        names = [f"sub-environment {number}" for number in self._part]
        error = close_all(zip(names, self._sessions, strict=True))
        if error is not None:
            raise error

    @property
    def idle(self) -> bool:
        """Whether all episodes have been ended, and all patches removed."""
        return all(session.idle for session in self._sessions)

    def abandon(self) -> None:
        """Unwind all simulations, from a finalizer. Warn of errors instead of raising them."""
        for session in self._sessions:
            session.abandon()


def _step_in_time(limit: float, *arguments: Any) -> None:
    """Step many episodes, or raise a ``StepTimeoutError``."""
    with StepAlarm(limit):
        step_all(*arguments)


def _step_or_exit(seconds: float, step: Callable[..., None], *arguments: Any) -> None:
    """Step many episodes. After some seconds, print the stack and end the process."""
    faulthandler.dump_traceback_later(seconds, exit=True, file=2)
    try:
        step(*arguments)
    finally:
        faulthandler.cancel_dump_traceback_later()


def make_batch(
    simulation: Model,
    points: Points,
    options: Mapping[str, Any],
    *arguments: Any,
) -> SimulationBatch:
    """Make a batch in a worker. ``arguments``: the ones of ``SimulationBatch`` after the plan."""
    batch = SimulationBatch(plan_of(simulation, points, options), *arguments)
    limit = options.get("step_timeout")
    if limit is not None:
        batch.exit_after(limit + 1.2 * SECONDS_TO_UNWIND)
    return batch
