"""Many simulations of one plan, suspended side by side in one process and moved together.

A *seat* is the Gymnasium view of one of them, without what all can share: it makes its spaces and its generator only
when somebody asks for them. A *row* of seats resets and moves its simulations, and leaves what comes of it in arrays.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space, concatenate, iterate
from numpy.typing import NDArray

from ..core.plan import Plan
from ..core.session import AnyEpisode, Session, checked_seed, seed_space
from ..core.together import turn_together
from ..errors import InvalidActionError, OptionValueError, annotate
from ..simulation import RULE
from .base import OneAgentView
from .joint import SimulationJointEnv
from .single import SimulationEnv, SimulationGoalEnv, single_view, with_goals

Told = list[tuple[int, dict[str, Any]]]
"""Infos, each with the number of its seat, in the order in which they are to be merged."""

End = tuple[int, bool, bool]
"""The number of a seat whose episode has ended; whether it has terminated; whether it was truncated."""

SMALL: Final = 1024
"""How many bytes an observation may have to be copied once more, which is less than what it spares."""

IGNORED: Final = None
"""Stands for an action that is not used; no space has it."""


# -- seats ----------------------------------------------------------------------------------------


class Seat(OneAgentView):
    """One of many simulations of a plan. Its episodes are ended by whoever has made it."""

    _own_spaces: tuple[spaces.Space[Any], spaces.Space[Any]] | None = None

    def _take_place(self, seating: Seating) -> None:
        self._seating = seating
        self._plan = plan = seating.plan
        self._session = Session(plan)
        self._episode = None
        self.metadata = seating.metadata
        self.render_mode = plan.options.render_mode
        self._shows = self.render_mode == "human"

    def _patterns(self) -> tuple[spaces.Space[Any], spaces.Space[Any]]:
        """The spaces of which its own are copies."""
        raise NotImplementedError

    @property
    def _spaces(self) -> tuple[spaces.Space[Any], spaces.Space[Any]]:
        if self._own_spaces is None:
            self._own_spaces = deepcopy(self._patterns())
            seed = self._np_random_seed
            if seed is not None and seed >= 0:
                self._seed_spaces(seed)
        return self._own_spaces

    @property
    def observation_space(self) -> spaces.Space[Any]:
        """The observation space, of this environment alone."""
        return self._spaces[0]

    @observation_space.setter
    def observation_space(self, space: spaces.Space[Any]) -> None:
        self._own_spaces = space, self._spaces[1]

    @property
    def action_space(self) -> spaces.Space[Any]:
        """The action space, of this environment alone."""
        return self._spaces[1]

    @action_space.setter
    def action_space(self, space: spaces.Space[Any]) -> None:
        self._own_spaces = self._spaces[0], space

    @property
    def np_random(self) -> np.random.Generator:
        """The generator that the last given seed has seeded, and from which other seeds are drawn."""
        if self._np_random is None:
            self._np_random, self._np_random_seed = seeding.np_random(self._np_random_seed)
        return self._np_random

    @np_random.setter
    def np_random(self, generator: np.random.Generator) -> None:
        self._np_random, self._np_random_seed = generator, -1

    def _begin(self, seed: int | None, options: dict[str, Any] | None, kind: type[AnyEpisode]) -> AnyEpisode:
        seed = checked_seed(seed)
        self._seating.changes += 1
        self._make_way()
        if seed is not None:
            self._np_random, self._np_random_seed = None, seed
            if self._own_spaces is not None:
                self._seed_spaces(seed)
        generator: Any = self.np_random if seed is None else None
        return self._session.start(seed, options, generator, kind)

    def _seed_spaces(self, seed: int) -> None:
        for space in self._spaces:
            seed_space(space, seed, self._agent)

    def _make_way(self) -> None:
        self._end(self._session.end)

    def _clear(self) -> None:
        self._seating.changes += 1
        super()._clear()

    def close(self) -> None:
        """End the episode and unwind the simulation."""
        self._end(self._session.close)

    def abandon(self) -> None:
        """The same, from a finalizer: raises nothing."""
        self._session.abandon()

    @property
    def pending(self) -> bool:
        """Whether it waits for an action."""
        return self._episode is not None and self._episode.pending is not None

    def check_action(self, action: Any) -> None:
        """Check an action against all that is known before anything moves.

        Raises:
            InvalidActionError: It is not legal.
        """
        raise NotImplementedError


class SingleSeat(Seat, SimulationEnv):
    """A seat of the single view."""

    def __init__(self, seating: Seating) -> None:
        """Make the view of a plan that has been checked."""
        self._take_place(seating)
        self._agent = str(self._plan.active[0].agent)

    def _patterns(self) -> tuple[spaces.Space[Any], spaces.Space[Any]]:
        definition = self._plan.active[0].definition
        return definition.observation_space, definition.action_space

    def check_action(self, action: Any) -> None:
        """Check an action, as ``Seat`` has it."""
        self._plan.active[0].checked(action, self._agent, self._record.mask)


class GoalSeat(SingleSeat, SimulationGoalEnv):
    """A seat of the goal-based view, of a plan that says so."""

    def __init__(self, seating: Seating) -> None:
        """Make the view of a plan that has been checked."""
        super().__init__(seating)
        self._definition = self._plan.active[0].definition


class JointSeat(Seat, SimulationJointEnv):
    """A seat of the joint view."""

    def __init__(self, seating: Seating) -> None:
        """Make the view of a plan whose agents are known, like another one."""
        self._take_place(seating)
        assert seating.first is not None
        self._like = first = seating.first
        self._agents, self._flatten, self._time = first._agents, first._flatten, None
        if self._flatten:
            self._places = first._places

    def _patterns(self) -> tuple[spaces.Space[Any], spaces.Space[Any]]:
        return self._like.observation_space, self._like.action_space

    def check_action(self, action: Any) -> None:
        """Check an action, as ``Seat`` has it."""
        episode = self._episode
        assert episode is not None
        actions = self._split(action)
        if any(part is RULE for part in actions.values()):
            raise InvalidActionError("RULE is no action in vector environments; use joint_env, or policies=")
        episode.check({agent: actions[agent] for agent in self._agents if agent in episode.agents})


class Seating:
    """What all seats of a plan have in common.

    Attributes:
        plan: What they are made of.
        single: Whether they are seats of the single view.
        metadata: What they say about themselves.
        single_observation_space, single_action_space: The spaces of one of them.
        changes: Grows whenever one of them begins an episode or lets go of one.
    """

    def __init__(self, plan: Plan, view: str | None) -> None:
        """Find out which seats a plan asks for; where agents are yet unknown, reset a simulation to ask.

        Args:
            plan: What they are to be made of.
            view: "single", "joint", or None: single where one point with one string agent is active.

        Raises:
            SimEnvError: The plan does not allow the view.
        """
        if view is None:
            view = "single" if len(plan.active) == 1 and plan.active[0].agent is not None else "joint"
        if view not in ("single", "joint"):
            raise OptionValueError(f'view must be None, "single" or "joint", not {view!r}')
        self.changes = 0
        self.single = view == "single"
        self.first: SimulationJointEnv | None = None
        self._kind: Callable[..., Seat]
        if self.single:
            base = single_view(plan)
            self._kind = SingleSeat
            if base is SimulationGoalEnv:
                self._kind, plan = GoalSeat, with_goals(plan)
            definition = plan.active[0].definition
            self.single_observation_space = deepcopy(definition.observation_space)
            self.single_action_space = deepcopy(definition.action_space)
            self.metadata = base.metadata_of(plan)
        else:
            self.first = first = SimulationJointEnv(plan)
            first.close()
            plan, self._kind = first._plan, JointSeat
            self.single_observation_space, self.single_action_space = first.observation_space, first.action_space
            self.metadata = first.metadata
        self.plan = plan

    def seat(self) -> Seat:
        """Make a seat."""
        return self._kind(self)


# -- arrays ---------------------------------------------------------------------------------------


class Batch:
    """What many simulations tell at once.

    Attributes:
        observations: Of the single space, batched.
        rewards: Shape ``(n,)``, float64.
        terminations, truncations: Shape ``(n,)``, bool.
    """

    def __init__(self, observations: Any, number: int, make: Callable[..., NDArray[Any]] = np.zeros) -> None:
        self.observations = observations
        self.rewards: NDArray[np.float64] = make((number,), dtype=np.float64)
        self.terminations: NDArray[np.bool_] = make((number,), dtype=np.bool_)
        self.truncations: NDArray[np.bool_] = make((number,), dtype=np.bool_)


Write = Callable[[Sequence[Any]], Any]


def writer(space: spaces.Space[Any], into: Any) -> Write:
    """Make what writes observations into a batch.

    Args:
        space: The space of one observation.
        into: The batch, as ``create_empty_array`` makes it.

    Returns:
        A function of all observations that writes them, and returns the batch: the same one, but for kinds of spaces
        whose batches are no arrays.
    """
    if isinstance(space, spaces.Dict):
        parts = {key: writer(part, into[key]) for key, part in space.spaces.items()}

        def write_dict(rows: Sequence[Any]) -> Any:
            return {key: write([row[key] for row in rows]) for key, write in parts.items()}

        return write_dict
    if isinstance(space, spaces.Tuple):
        writers = [writer(part, into[number]) for number, part in enumerate(space.spaces)]

        def write_tuple(rows: Sequence[Any]) -> Any:
            return tuple(write([row[number] for row in rows]) for number, write in enumerate(writers))

        return write_tuple
    if isinstance(space, (spaces.Box, spaces.MultiBinary, spaces.MultiDiscrete)) and space.shape and into.size:
        flat = into.reshape(-1, *space.shape[1:])
        whole = memoryview(into.reshape(-1).view(np.uint8)) if into[0].nbytes <= SMALL else None

        def write_rows(rows: Sequence[Any]) -> Any:
            if whole is not None:
                try:
                    whole[:] = b"".join(rows)  # a third of what concatenate costs, which costs a third of stack
                    return into
                except TypeError:  # one of them is laid out otherwise in memory
                    pass
            np.concatenate(rows, out=flat)
            return into

        return write_rows
    if isinstance(space, spaces.Discrete):

        def write_numbers(rows: Sequence[Any]) -> Any:
            into[:] = rows
            return into

        return write_numbers
    return lambda rows: concatenate(space, rows, into)


# -- actions --------------------------------------------------------------------------------------


class Actions:
    """Takes batches of actions apart, and checks them as far as that needs no simulation."""

    def __init__(self, seating: Seating, number: int) -> None:
        self._number = number
        self._space, self._batch = seating.single_action_space, batch_space(seating.single_action_space, number)
        binding = seating.plan.active[0]
        self._agent = str(binding.agent)
        self._checked = binding.checked
        self.complete = seating.single and binding.legal is None
        """Whether nothing is left to be checked with the simulations."""
        self._single = seating.single

    def split(self, actions: Any, unused: Any = ()) -> list[Any]:
        """Take a batch apart.

        Args:
            actions: A batch of the action space; for spaces whose batches are arrays, a sequence serves.
            unused: The numbers of the actions that are not used, and so not checked.

        Returns:
            An action for each simulation; ``IGNORED`` in place of those that are not used.

        Raises:
            InvalidActionError: There is not an action for each, or one is not legal. It says which.
        """
        space = self._space
        if actions is RULE:
            raise InvalidActionError("RULE is no action in vector environments; use single_env, or policies=")
        swift = self.complete and type(actions) is np.ndarray and actions.shape == (self._number, *(space.shape or ()))
        if swift and isinstance(space, spaces.Discrete) and actions.dtype.kind in "iu":
            if actions.min() >= space.start and actions.max() < space.start + space.n:
                return actions.tolist()  # type: ignore[no-any-return]
        elif (
            swift
            and isinstance(space, spaces.Box)
            and actions.dtype is space.dtype
            and ((actions >= space.low) & (actions <= space.high)).all()
        ):
            return list(actions.copy())  # which nobody else can change
        apart = self._apart(actions)
        for number in range(self._number):
            if number in unused:
                apart[number] = IGNORED
            elif self._single:
                try:
                    apart[number] = self._checked(apart[number], self._agent, None)
                except InvalidActionError as error:
                    raise InvalidActionError(of_one(number, error)) from None
        return apart

    def _apart(self, actions: Any) -> list[Any]:
        try:
            apart = list(iterate(self._batch, actions))
        except Exception as error:
            raise InvalidActionError(f"{actions!r} is no batch of {self._number} actions of {self._space}") from error
        if len(apart) != self._number:
            raise InvalidActionError(f"there are {len(apart)} actions for {self._number} simulations: {actions!r}")
        return apart


# -- rows -----------------------------------------------------------------------------------------


class Row:
    """Seats side by side.

    Attributes:
        seats: They.
        batch: What they write into.
        ended: The numbers of those whose episode has ended and has not begun anew.
        failed: Whether an error has left some of them where the others are not, and all are to be reset.
    """

    def __init__(self, seating: Seating, batch: Batch, mode: AutoresetMode, number: int, offset: int = 0) -> None:
        """Make the seats.

        Args:
            seating: What they have in common.
            batch: What they are to write into.
            mode: When episodes that have ended begin anew.
            number: How many there are to be.
            offset: How many there are before the row, for those who are told of an error.

        Raises:
            BaseException: What making a simulation raises.
        """
        self.batch, self._mode, self._offset = batch, mode, offset
        self._write = writer(seating.single_observation_space, batch.observations)
        self._binding = seating.plan.active[0]
        self._swift = seating.single and seating.plan.options.render_mode != "human"
        self._rows: list[Any] = [None] * number
        self._seating = seating
        # Of the seats, as they were at that number of changes: to ask each of them takes longer.
        self._episodes: list[Any] = []
        self._records: list[Any] = []
        self._known = -1
        self.ended: set[int] = set()
        self.failed = False
        self.seats: list[Any] = []
        try:
            for _ in range(number):
                self.seats.append(seating.seat())
        except BaseException as error:
            annotate(error, f"simenv_marl: in sub-environment {offset + len(self.seats)}")
            self.abandon()
            raise

    def reset(self, seeds: Sequence[int | None], options: dict[str, Any] | None, chosen: Sequence[int]) -> Told:
        """Begin the episodes of some seats anew.

        Args:
            seeds: For all seats.
            options: For all that are reset.
            chosen: The numbers of those.

        Returns:
            Their infos.

        Raises:
            BaseException: Whatever a simulation or a mapping raises. Unless nothing has moved, the row has ``failed``.
        """
        told: Told = []
        number = 0
        self._forget()
        try:
            for number in chosen:
                self._rows[number], info = self.seats[number].reset(seed=seeds[number], options=options)
                told.append((number, info))
        except BaseException as error:
            self._fail(number, error, chosen[0])
            raise
        for number in chosen:
            self.batch.terminations[number] = self.batch.truncations[number] = False
        self.ended.difference_update(chosen)
        self.batch.observations = self._write(self._rows)
        self.failed = False
        return told

    def check(self, actions: Sequence[Any]) -> None:
        """Check actions against what only the simulations know. Nothing moves.

        Raises:
            InvalidActionError: One is not legal. It says which.
        """
        for number, action in enumerate(actions):
            if action is not IGNORED:
                try:
                    self.seats[number].check_action(action)
                except InvalidActionError as error:
                    raise InvalidActionError(of_one(self._offset + number, error)) from None

    def step(self, actions: Sequence[Any]) -> Told:
        """Answer all pending decisions, each with its action, and run each simulation to its next one.

        Args:
            actions: An action for each seat, checked.

        Returns:
            Their infos, as far as there is something in them.

        Raises:
            BaseException: Whatever a simulation or a mapping raises. Unless nothing has moved, the row has ``failed``.
        """
        told: Told = []
        rewards, ends = (self._turns if self._swift else self._steps)(actions, told)
        batch = self.batch
        batch.rewards[:] = rewards
        batch.terminations.fill(False)
        batch.truncations.fill(False)
        for number, terminated, truncated in ends:
            batch.terminations[number], batch.truncations[number] = terminated, truncated
        self.ended = {number for number, *_ in ends} if self._mode != AutoresetMode.SAME_STEP else set()
        batch.observations = self._write(self._rows)
        return told

    def _turns(self, actions: Sequence[Any], told: Told) -> tuple[list[float], list[End]]:
        """What ``_steps`` does, for seats of the single view, without a call of ``SimulationEnv.step`` for each."""
        seats, mode = self.seats, self._mode
        waiting = self.ended
        if waiting:
            for number in sorted(waiting):
                self._again(number)
            moving = [number for number in range(len(seats)) if number not in waiting]
            others = moving and turn_together(
                self._binding,
                [seats[number]._episode for number in moving],
                [actions[number] for number in moving],
                lambda number, error: self._fail(moving[number], error, first=-1),
            )
            others = sorted((*waiting, *(moving[number] for number in others)))
        else:
            if self._known != self._seating.changes:
                self._episodes = [seat._episode for seat in seats]
                if None in self._episodes:  # somebody else has closed it
                    raise seats[self._episodes.index(None)]._session.not_running()
                self._known = self._seating.changes
                self._records = [seat._record for seat in seats]
            others = turn_together(self._binding, self._episodes, actions, self._fail)
        records = self._records if self._known == self._seating.changes else [seat._record for seat in seats]
        self._rows = rows = [record.observation for record in records]
        rewards = [record.reward for record in records]
        for number in waiting:
            rewards[number] = 0.0
        ends: list[End] = []
        for number in others:
            info, episode = records[number].info, seats[number]._episode
            if episode.over:
                removed = records[number].ended
                ends.append((number, episode.terminated or removed, episode.truncated and not removed))
                if mode == AutoresetMode.SAME_STEP:
                    told.append((number, {"final_obs": rows[number], "final_info": info}))
                    rows[number], info = self._again(number)
            if info:
                told.append((number, info))
        return rewards, ends

    def _steps(self, actions: Sequence[Any], told: Told) -> tuple[list[float], list[End]]:
        """Step each seat, or reset it. Returns the rewards, and whose episode has ended and how."""
        rewards: list[float] = []
        ends: list[End] = []
        number = 0
        for number, (seat, action) in enumerate(zip(self.seats, actions, strict=True)):
            if action is IGNORED:
                self._rows[number], info = self._again(number)
                rewards.append(0.0)
            else:
                try:
                    self._rows[number], reward, terminated, truncated, info = seat.step(action)
                except BaseException as error:
                    self._fail(number, error)
                    raise
                rewards.append(reward)
                if terminated or truncated:
                    ends.append((number, terminated, truncated))
                    if self._mode == AutoresetMode.SAME_STEP:
                        told.append((number, {"final_obs": self._rows[number], "final_info": info}))
                        self._rows[number], info = self._again(number)
            if info:
                told.append((number, info))
        return rewards, ends

    def _again(self, number: int) -> tuple[Any, dict[str, Any]]:
        """Begin the next episode of a seat whose episode has ended."""
        try:
            observation, info = self.seats[number].reset()
        except BaseException as error:
            self._fail(number, error)
            raise
        return observation, info

    def _fail(self, number: int, error: BaseException, first: int = 0) -> None:
        """Tell whose error it is; if anything has moved, all are to be reset. ``first`` is who was to move first."""
        annotate(error, f"simenv_marl: in sub-environment {self._offset + number}")
        if number != first or not self.seats[number].pending:  # else nothing has moved
            self.failed = True

    def _forget(self) -> None:
        """Keep nothing of episodes that are about to end."""
        self._episodes, self._records, self._known = [], [], -1

    def call(self, name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> list[Any]:
        """Call a method of each seat, or get its attribute.

        Raises:
            BaseException: What a seat raises.
        """
        results = []
        for seat in self.seats:
            found = getattr(seat, name)
            results.append(found(*args, **kwargs) if callable(found) else found)
        return results

    def set_attr(self, name: str, values: Sequence[Any]) -> None:
        """Set an attribute of each seat."""
        for seat, value in zip(self.seats, values, strict=True):
            setattr(seat, name, value)

    def close(self) -> None:
        """Unwind all simulations.

        Raises:
            ReentrancyError, WrongThreadError: They cannot be ended from here, and go on.
            BaseException: What the first simulation raises that raises anything; the others are unwound all the same.
        """
        raised: BaseException | None = None
        self._forget()
        for number, seat in enumerate(self.seats):
            try:
                seat.close()
            except BaseException as error:
                annotate(error, f"simenv_marl: in sub-environment {self._offset + number}")
                if raised is None:
                    raised = error
                else:
                    annotate(raised, f"simenv_marl: and in sub-environment {self._offset + number}: {error!r}")
        if raised is not None:
            raise raised

    @property
    def observed(self) -> list[Any]:
        """The latest observation of each seat."""
        return self._rows

    @property
    def suspended(self) -> bool:
        """Whether a simulation still waits for an action."""
        return any(seat.pending for seat in self.seats)

    def abandon(self) -> None:
        """The same, from a finalizer: raises nothing."""
        for seat in self.seats:
            seat.abandon()


def of_one(number: int, error: Any) -> str:
    """The message of an error about the action of one of many."""
    return f"sub-environment {number}: {error}"
