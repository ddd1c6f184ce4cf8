"""Rows: many simulations of one plan, suspended side by side in one process and stepped together.

A *row* holds the sessions of its sub-environments. It resets and steps their simulations, and writes the results into
arrays. It makes their Gymnasium views on demand.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from typing import Any

from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import concatenate

from ..core.episode import Episode
from ..core.plan import Plan
from ..core.session import Session
from ..core.stacking import stacker
from ..core.together import step_all
from ..errors import InvalidActionError, OptionValueError, annotate, short_repr
from .batches import IGNORED, Batch, of_one
from .joint import Joint, SimulationJointEnv
from .one_agent import OneAgentView
from .single import single_view, with_goals

Told = list[tuple[int, dict[str, Any]]]
"""Infos, each with the number of its sub-environment, in the order in which they must be merged."""


class SubEnvironments:
    """The properties that all sub-environments of a plan share.

    Attributes:
        plan: The plan from which they are made.
        joint: The common part of their joint views. None if they are single views.
        metadata: The ``metadata`` of their view.
        single_observation_space, single_action_space: The spaces of one sub-environment.
    """

    def __init__(self, plan: Plan, view: str | None) -> None:
        """Determine the view and its spaces. For a joint view this may take the reset of a simulation.

        Args:
            plan: The plan from which the sub-environments will be made.
            view: "single" or "joint". None: single if one point with one string agent is active, else joint.

        Raises:
            SimEnvError: The plan does not allow the view.
        """
        if view is None:
            view = "joint" if plan.one_agent is None else "single"
        if view not in ("single", "joint"):
            raise OptionValueError(f'view must be None, "single" or "joint", not {short_repr(view)}')
        self.joint: Joint | None = None
        self._view: type[OneAgentView]
        if view == "single":
            self._view = single_view(plan)
            self.metadata = self._view.metadata_of(plan)
            self._made_of = plan
            if plan.active[0].definition.goal_space is not None:
                plan = with_goals(plan)
            definition = plan.active[0].definition
            self.single_observation_space = deepcopy(definition.observation_space)
            self.single_action_space = deepcopy(definition.action_space)
        else:
            first = SimulationJointEnv(plan)
            first.close()
            self._view, self.joint, self.metadata = SimulationJointEnv, first.joint, first.metadata
            plan = self._made_of = first._plan
            self.single_observation_space, self.single_action_space = first.observation_space, first.action_space
        self.plan = plan

    @property
    def single(self) -> bool:
        """Whether the sub-environments are single views."""
        return self.joint is None

    def view(self, session: Session) -> OneAgentView:
        """Make the view of a sub-environment."""
        return self._view(self._made_of, session=session)


# -- rows -----------------------------------------------------------------------------------------


class Row:
    """Sub-environments side by side.

    Attributes:
        sessions: The sessions of the sub-environments.
        batch: The arrays into which their results are written.
        ended: The numbers of the sub-environments whose episode has ended, with no new one begun.
        failed: Whether an error has left the sub-environments out of step, so that all must be reset.
    """

    def __init__(
        self, common: SubEnvironments, batch: Batch, mode: AutoresetMode, number: int, offset: int = 0
    ) -> None:
        """Make the simulations.

        Args:
            common: The shared properties of the sub-environments.
            batch: The arrays for their results.
            mode: When a new episode follows one that has ended.
            number: The number of sub-environments in the row.
            offset: The number of sub-environments before the row, for error messages.

        Raises:
            BaseException: Any error of making a simulation.
        """
        self.batch, self._mode, self._offset, self._common = batch, mode, offset, common
        self._stack = stacker(common.single_observation_space, cast=True, other=concatenate)
        self._agent = common.plan.one_agent
        self._shows = common.plan.options.render_mode == "human"
        self._observed: list[Any] = [None] * number
        self._views: list[OneAgentView] = []
        self._episodes: list[Any] = []  # the episodes to which ``_agents`` belong, in the single view
        self._agents: list[Any] = []
        self.ended: set[int] = set()
        self.failed = False
        self.sessions: list[Session] = []
        try:
            for _ in range(number):
                self.sessions.append(Session(common.plan))
        except BaseException as error:
            annotate(error, f"simenv_marl: in sub-environment {offset + len(self.sessions)}")
            self.abandon()
            raise

    def reset(self, seeds: Sequence[int | None], options: dict[str, Any] | None, chosen: Sequence[int]) -> Told:
        """Begin new episodes of some sub-environments.

        Args:
            seeds: A seed for each sub-environment of the row.
            options: The options for all sub-environments that are reset.
            chosen: The numbers of the sub-environments to reset.

        Returns:
            The infos of the sub-environments that were reset.

        Raises:
            BaseException: Any error of a simulation or a mapping. The row has ``failed`` unless nothing has moved.
        """
        told: Told = []
        number = 0
        try:
            for number in chosen:
                self._observed[number], info = self._begin(number, seeds[number], options)
                told.append((number, info))
        except BaseException as error:
            self._fail(number, error, chosen[0])
            raise
        for number in chosen:
            self.batch.terminations[number] = self.batch.truncations[number] = False
        self.ended.difference_update(chosen)
        self.batch.observations = self._stack(self._observed, self.batch.observations)
        self.failed = False
        return told

    def check(self, actions: Sequence[Any]) -> None:
        """Check actions against the pending decisions. Nothing moves.

        Raises:
            InvalidActionError: An action is not legal. The message says which.
        """
        joint = self._common.joint
        for number, action in enumerate(actions):
            if action is IGNORED:
                continue
            episode: Any = self.sessions[number].episode
            try:
                if episode is None:
                    raise self.sessions[number].refusal()
                if joint is not None and not episode.unreported_end:
                    joint.check(episode, action)
                elif episode.pending is not None:
                    episode.pending.point.checked(action, self._agent, episode.pending.mask)
            except InvalidActionError as error:
                raise InvalidActionError(of_one(self._offset + number, error)) from None

    def step(self, actions: Sequence[Any]) -> Told:
        """Answer all pending decisions, and run each simulation to its next decision.

        Args:
            actions: A checked action for each sub-environment.

        Returns:
            The infos that are not empty.

        Raises:
            BaseException: Any error of a simulation or a mapping. The row has ``failed`` unless nothing has moved.
        """
        told: Told = []
        begun = {number: self._again(number) for number in sorted(self.ended)}
        moving: Sequence[int] = range(len(self.sessions))
        if begun:
            moving = [number for number in moving if number not in begun]
        episodes: list[Any] = [self.sessions[number].episode for number in moving]
        if None in episodes:  # the view of a sub-environment was closed
            raise self.sessions[moving[episodes.index(None)]].refusal()
        self._move(moving, episodes, actions, first=-1 if begun else 0)
        rewards: Any = [0.0] * len(self.sessions)
        observed = self._observed
        ends: list[tuple[int, bool, bool]] = []
        infos: dict[int, dict[str, Any]] = {}
        for number, (observed[number], info) in begun.items():
            if info:
                infos[number] = info
        joint, name = self._common.joint, self._agent
        if joint is not None:
            came = [(joint.observe(episode), joint.reward(episode), joint.inform(episode)) for episode in episodes]
            seen, earned = [parts[0] for parts in came], [parts[1] for parts in came]
            news = [parts[2] for parts in came]
        else:
            if episodes != self._episodes:
                self._episodes = episodes
                self._agents = [episode.agents.get(name) or episode.ended[name] for episode in episodes]
            agents = self._agents
            seen, earned = [agent.observation for agent in agents], [agent.reward for agent in agents]
            news = [agent.info for agent in agents]
        if begun:
            for place, number in enumerate(moving):
                observed[number], rewards[number] = seen[place], earned[place]
        else:
            observed[:], rewards = seen, earned
        eventful = any(news) or None in [episode.pending for episode in episodes]
        for number, episode, info in zip(moving, episodes, news, strict=True) if eventful else ():
            if episode.pending is None:
                ended = self._end_of(episode)
                if ended is not None:
                    ends.append((number, *ended))
                    if self._mode == AutoresetMode.SAME_STEP:
                        told.append((number, {"final_obs": observed[number], "final_info": info}))
                        observed[number], info = self._again(number)
            if info:
                infos[number] = info
        told += sorted(infos.items())
        batch = self.batch
        batch.rewards[:] = rewards
        batch.terminations.fill(False)
        batch.truncations.fill(False)
        for number, terminated, truncated in ends:
            batch.terminations[number], batch.truncations[number] = terminated, truncated
        self.ended = {number for number, *_ in ends} if self._mode != AutoresetMode.SAME_STEP else set()
        batch.observations = self._stack(observed, batch.observations)
        if self._shows:
            for session in self.sessions:
                session.render()
        return told

    def _end_of(self, episode: Episode) -> tuple[bool, bool] | None:
        """The flags terminated and truncated of an episode, as its view reports them; None if it continues."""
        if self._agent in episode.ended and self._common.single:
            return True, False
        return (episode.terminated, episode.truncated) if episode.over else None

    def _move(self, moving: Sequence[int], episodes: list[Episode], actions: Sequence[Any], first: int) -> None:
        joint = self._common.joint
        if joint is None:
            own = actions if len(moving) == len(actions) else [actions[number] for number in moving]
            step_all(episodes, own, lambda number, error: self._fail(moving[number], error, first))
            return
        for number, episode in zip(moving, episodes, strict=True):
            try:
                episode.play(joint.actions(episode, actions[number]))
            except BaseException as error:
                self._fail(number, error, first)
                raise

    def _begin(self, number: int, seed: int | None, options: dict[str, Any] | None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode. Return its first observation and info."""
        joint, session = self._common.joint, self.sessions[number]
        episode = session.start(seed, options, in_rounds=joint is not None)
        if self._shows:
            session.render()
        if joint is not None:
            return joint.observe(episode), joint.inform(episode)
        agent: Any = episode.agent(str(self._agent))
        return agent.observation, agent.info

    def _again(self, number: int) -> tuple[Any, dict[str, Any]]:
        """Begin the next episode of a sub-environment whose episode has ended."""
        try:
            return self._begin(number, None, None)
        except BaseException as error:
            self._fail(number, error)
            raise

    def _fail(self, number: int, error: BaseException, first: int = -1) -> None:
        """Add the number of the sub-environment to an error. Set ``failed`` if any simulation has moved.

        Args:
            number: The number of the sub-environment that has raised.
            error: The error.
            first: The number of the sub-environment that moves first.
        """
        annotate(error, f"simenv_marl: in sub-environment {self._offset + number}")
        if number != first or not self._waits(self.sessions[number]):  # otherwise nothing has moved
            self.failed = True

    # -- views ------------------------------------------------------------------------------------

    @property
    def views(self) -> list[OneAgentView]:
        """The Gymnasium views of the sub-environments."""
        if not self._views:
            self._views = [self._common.view(session) for session in self.sessions]
        return self._views

    def call(self, name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> list[Any]:
        """Call a method of each view, or get an attribute of each.

        Raises:
            BaseException: Any error of a view.
        """
        results = []
        for view in self.views:
            found = getattr(view, name)
            results.append(found(*args, **kwargs) if callable(found) else found)
        return results

    def set_attr(self, name: str, values: Sequence[Any]) -> None:
        """Set an attribute of each view."""
        for view, value in zip(self.views, values, strict=True):
            setattr(view, name, value)

    # -- ends -------------------------------------------------------------------------------------

    def close(self) -> None:
        """Unwind all simulations.

        Raises:
            ReentrancyError, WrongThreadError: The simulations cannot be ended from here, and continue.
            BaseException: The first error that a simulation raises. The others are unwound nevertheless.
        """
        raised: BaseException | None = None
        for number, session in enumerate(self.sessions):
            try:
                session.close()
            except BaseException as error:
                annotate(error, f"simenv_marl: in sub-environment {self._offset + number}")
                if raised is None:
                    raised = error
                else:
                    annotate(
                        raised,
                        f"simenv_marl: sub-environment {self._offset + number} raised {short_repr(error)} as well",
                    )
        if raised is not None:
            raise raised

    @property
    def observed(self) -> list[Any]:
        """The latest observation of each sub-environment."""
        return self._observed

    @property
    def suspended(self) -> bool:
        """Whether an episode has not been ended, or patches have not been removed."""
        return not all(session.idle for session in self.sessions)

    @staticmethod
    def _waits(session: Session) -> bool:
        return session.episode is not None and session.episode.pending is not None

    def abandon(self) -> None:
        """Unwind all simulations, from a finalizer. Warn of errors instead of raising them."""
        for session in self.sessions:
            session.abandon()
