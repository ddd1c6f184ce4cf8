"""The base class of sessions, and the records that their copies and replays exchange."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple, Protocol, TypeAlias

import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding

from ...errors import (
    AgentError,
    ObservationError,
    OptionValueError,
    SimEnvError,
    ViewError,
    annotate,
    short_repr,
)
from ...hooks.hook import Hook
from ...simulation import RULE, Action, Model, Observation, Sentinel
from ..plans.plan import Plan
from ..plans.point import Point, Policy, Space
from ..plans.points import resolve_roster
from ..plans.policies import Where
from ..switching.context import ExclusiveLock, environment_context
from ..switching.generators import is_seed
from ..switching.resources import reuse_resources
from ..values.actions import Mask
from ..values.clock import Clock
from ..values.common import Encode, common_observations
from ..values.spaces import observation_cast
from ..values.stacking import stacked, stacker
from .events import Handlers
from .state import EpisodeState, State, UnmatchedNames

ResetOptions = dict[str, Any] | None
"""The options of a ``reset``."""


class Snapshot(NamedTuple):
    """The record that a copy of a session takes over.

    Attributes:
        state: Its state.
        seed: The seed of the latest episode.
        np_random_seed: The seed of the generator.
        np_random: The generator.
        kind: The view.
    """

    state: State
    seed: int | None
    np_random_seed: int | None
    np_random: np.random.Generator | None
    kind: str


class PendingDecision(NamedTuple):
    """A pending decision, to compare a replay with its original."""

    agent: str
    agents: list[str]
    observation: Observation
    mask: Mask | None


class Recording(NamedTuple):
    """A record from which another session can repeat an episode."""

    seed: int
    options: ResetOptions
    in_rounds: bool
    tape: list[Action]
    decision: PendingDecision | None


LONGEST_TAPE: Final = 200_000
"""The number of answers that are kept for a replay. It limits the memory of endless simulations."""


Replay: TypeAlias = deque[Action]
"""The answers of another episode that are not repeated yet. They replace those of all policies."""

GO_ON: Final = Sentinel("GO_ON")
"""At the end of a replay: policies are asked again from here on."""


@dataclass(frozen=True)
class Reseeded:
    """On a tape: here the simulation was reseeded."""

    seed: int


@dataclass(frozen=True)
class Branched:
    """On a tape: here a planner's branch begins, which waits for one agent alone."""

    agent: str


class Tape(list[Action]):
    """The answers of the user and of policies. A file of an episode has a tape that writes them."""

    __slots__ = ()

    def note_exit(self, agent: str) -> None:
        """Note that an agent that has ended was taken out of the view."""

    def end(self, error: BaseException | None = None) -> str:
        """Note that the episode has ended, or failed. Return a hint for the note of its error."""
        is_short = error is None or not self
        return "" if is_short else "; save_episode(env, path) writes the episode to a file"


class EpisodeOwner(Protocol):
    """The session, as its episodes use it."""

    plan: Plan
    where: Where
    handlers: Handlers
    context: Callable[..., environment_context]
    unmatched_names: UnmatchedNames

    def new_tape(self) -> Tape:
        """Return the tape for another episode."""

    def new_clock(self) -> Clock | None:
        """Return the clock for another episode. None if the simulation has no time."""

    def read_state(self) -> Model:
        """Return the state of the simulation."""


@dataclass(eq=False, repr=False, slots=True, weakref_slot=True)
class BaseSession(ABC):
    """The base class of sessions. The simulation may be in another process.

    Attributes:
        plan: The plan.
        where: Whether it belongs to the user, a clone or a branch.
        seed: The seed of the latest episode.
        options: The options of the latest reset.
        kind: The view that its user has. Empty without one, and in vector environments.
        np_random_seed: The seed of ``np_random``. -1 if the user has set a generator.
        exclusive: The lock that lets one thread at a time begin and end the episodes of a view.
        lock: The same lock, if steps need it, too. None if only the thread that began an episode
            can step it.
    """

    plan: Plan
    where: Where
    _state: State = State.NEW
    seed: int | None = None
    options: ResetOptions = None
    kind: str = ""
    np_random_seed: int | None = None
    _np_random: np.random.Generator | None = None
    exclusive: ExclusiveLock = field(default_factory=ExclusiveLock)
    lock: ExclusiveLock | None = None

    @property
    def np_random(self) -> np.random.Generator:
        """The generator that was seeded with the last given seed. It draws all other seeds."""
        if self._np_random is None:
            self._np_random, self.np_random_seed = seeding.np_random(self.np_random_seed)
        return self._np_random

    def set_generator(self, generator: np.random.Generator) -> None:
        """Draw all seeds from a generator."""
        self._np_random = generator
        self.np_random_seed = -1

    def seed_for(self, seed: int | None) -> int:
        """Return the seed of an episode, and seed the generator with it. None: draw one."""
        if seed is None:
            return int(self.np_random.integers(2**31))
        self._np_random = None  # made when a seed must be drawn
        self.np_random_seed = seed
        return seed

    def snapshot(self) -> Snapshot:
        """Return the record for a copy."""
        has_decision = self.episode is not None and self.episode.pending is not None
        state = State.COPIED if has_decision else State.NEW
        return Snapshot(state, self.seed, self.np_random_seed, self._np_random, self.kind)

    def restore(self, snapshot: Snapshot) -> None:
        """Take over the record of another session."""
        self._state, self.seed, self.np_random_seed, self._np_random, self.kind = snapshot

    def refusal(self) -> SimEnvError:
        """Make the error that says why no action can be taken now."""
        episode = self.episode
        return self._state.refusal() if episode is None else episode.refusal()

    def move_to(self, where: Where) -> None:
        """Note that its episodes are played in a clone or a branch from now on."""
        self.where = max(self.where, where)
        if self.episode is not None:
            self.episode.move_to(where)

    @property
    @abstractmethod
    def episode(self) -> EpisodeState | None:
        """The current or latest episode."""

    @property
    @abstractmethod
    def simulation(self) -> Model:
        """The simulation."""

    @property
    @abstractmethod
    def idle(self) -> bool:
        """Whether there is nothing to end."""

    @abstractmethod
    def start(
        self, seed: int | None, options: ResetOptions, *, in_rounds: bool = False
    ) -> EpisodeState:
        """End the current episode, reset the simulation, and run it to its first decision.

        Args:
            seed: The seed. None: one is drawn.
            options: The options of the reset.
            in_rounds: Whether all agents are updated when a step returns.

        Returns:
            The episode.
        """

    @abstractmethod
    def close(self) -> None:
        """End the current episode, and close the simulation."""

    @abstractmethod
    def abandon(self) -> None:
        """Close it from a finalizer. Warn of errors instead of raising them."""

    @abstractmethod
    def ask(self, name: str, *args: Any) -> Model:
        """Call a method of the simulation, or raise ``NotImplementedError`` if it has none."""

    def read_state(self) -> Model:
        """Return the state of the simulation: see ``StateReader``."""
        return self.plan.derive(StateReader).read(self)

    def declare(self, plan: Plan) -> None:
        """Forget the episode that has shown the agents, and take over a plan that declares them."""
        raise NotImplementedError

    @abstractmethod
    def call(self, view: Model, function: Callable[..., Model], args: tuple[Any, ...]) -> Model:
        """Call a function with the view, where the simulation is."""

    @abstractmethod
    def check_reseed(self) -> None:
        """Raise a ``BranchError`` unless the simulation's future chance can be drawn anew."""

    @abstractmethod
    def reseed(self, seed: int) -> None:
        """Draw the simulation's future chance anew."""

    @abstractmethod
    def note_exit(self, agent: str) -> None:
        """Note that an agent that has ended was taken out of the view."""

    @abstractmethod
    def recording(self) -> Recording:
        """Return the record for a replay of the episode."""

    @abstractmethod
    def leave_caller(self) -> None:
        """In a branch that was forked from inside a policy, leave the step that has asked it."""


class StateReader:
    """Reads the states of the simulations of a plan, for centralised critics.

    With ``state_space="observations"``, these are the latest observations of all agents that the
    user answers or, without a user, of all whom policies answer.

    Attributes:
        space: The space of the states. None: arrays of any shape.
    """

    def __init__(self, plan: Plan) -> None:
        """Find out the space.

        Raises:
            OptionValueError: Observations are the state, and not all agents are known.
            ViewError: These observations cannot be flattened.
        """
        space = plan.options.state_space
        self._places: Mapping[str, Sequence[Point]] | None = None
        self._codes: dict[str, dict[Hook, Encode | None]] = {}  # by agent and point
        self._unanswered: tuple[Policy, ...] = ()  # policies of agents that the roster omits
        if isinstance(space, str):
            self._places = places = plan.places if plan.has_user else self._answered(plan)
            parts = []
            for name, points in places.items():
                seen = [point.definition.observation_space for point in points]
                part, encoders = common_observations(seen)
                parts.append(part)
                hooks = [point.hook for point in points]
                self._codes[name] = dict(zip(hooks, encoders, strict=True))
            self._whole = spaces.Tuple(parts)
            space = spaces.flatten_space(self._whole)
            if not isinstance(space, spaces.Box):
                raise ViewError(
                    'state_space="observations" needs spaces that can be flattened, not'
                    f" {self._whole}"
                )
        self.space: Space | None = space
        self._cast = np.array if space is None else observation_cast(space)

    def read(self, session: BaseSession) -> Model:
        """Return the present state as a new array, or as an element of the space.

        Raises:
            NotImplementedError: The simulation has no ``state`` (PettingZoo's convention).
            ResetNeededError: There is no episode to observe.
            ObservationError: The state is no array, or does not fit its space.
            AgentError: An agent that policies answer was not declared.
        """
        if self._places is None:
            state = session.ask("state")
            try:
                return self._cast(state)
            except ValueError as error:
                problem = str(error).replace("the observation", "the state")
                raise ObservationError(
                    f"state() has returned an illegal value: {problem}"
                ) from None
        episode = session.episode
        if episode is None:
            raise session.refusal()
        found = {**episode.others, **episode.ended, **episode.agents}
        observations = []
        for name, codes in self._codes.items():
            agent = found.pop(name, None)
            point = self._places[name][0] if agent is None else agent.point
            observation = None if agent is None else agent.observation
            seen = point.blank() if observation is None else observation
            encode = codes.get(point.hook)
            observations.append(seen if encode is None else encode(seen))
        for name, agent in found.items():
            if self._unanswered and agent.policy not in self._unanswered:
                raise AgentError(
                    'state_space="observations" needs to know all agents beforehand;'
                    f" possible_agents= lacks {name!r}"
                )
        return self._cast(spaces.flatten(self._whole, tuple(observations)))

    def stack(self, states: Sequence[Model]) -> Any:
        """Stack states. Without any, return a stack without rows."""
        if self.space is None:
            return stacked(states) if states else np.zeros(0)
        return stacker(self.space)(states)

    def _answered(self, plan: Plan) -> Mapping[str, Sequence[Point]]:
        """Return the decision points of the agents that policies answer, by agent."""
        self._unanswered = None, RULE, plan.subject.default_policy
        points = list(plan.points)
        known = [point.agent for point in points]
        roster, complete = resolve_roster(points, plan.options.possible_agents, known)
        if not complete:
            raise OptionValueError(
                'state_space="observations" needs to know all agents beforehand: declare them in'
                " possible_agents="
            )
        return {
            name: places
            for name, places in roster.items()
            if plan.policy_of(name, places[0]) not in self._unanswered
        }


def checked_seed(seed: Any) -> int | None:
    """Return the seed of a ``reset`` as a Python integer, or None. Refuse all other values."""
    if seed is None:
        return None
    if not is_seed(seed):
        raise OptionValueError(
            f"seed must be a non-negative integer or None, not {short_repr(seed)}"
        )
    return int(seed)


def close_all(
    sessions: Iterable[tuple[str, BaseSession]], error: BaseException | None = None
) -> BaseException | None:
    """Close sessions, given with their names.

    Args:
        sessions: The sessions.
        error: An error that was raised before.

    Returns:
        The first error, with notes of all others. None without any.
    """
    with reuse_resources():  # it waits for all processes of simulations together
        for name, session in sessions:
            try:
                session.close()
            except BaseException as problem:
                if error is None:
                    error = problem
                    annotate(error, f"simenv_marl: in {name}")
                else:
                    annotate(
                        error, f"simenv_marl: closing {name} raised {short_repr(problem)} as well"
                    )
    return error
