"""A clone in a forked process: the session that its view has here, and the host there.

The session asks the host, whose responses report the episode. The session mirrors it for the view.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from functools import partial
from operator import attrgetter
from typing import Any, Final, NamedTuple, TypeVar

from ...errors import (
    BranchError,
    ClosedError,
    InvalidActionError,
    SimEnvError,
    describe_error,
    short_repr,
    warn_user,
)
from ...simulation import Action, Model
from ..episodes.agent import Agent
from ..episodes.base import BaseSession, Recording, ResetOptions, Snapshot
from ..episodes.episode import Episode
from ..episodes.events import PointHandler
from ..episodes.session import Session
from ..episodes.state import EpisodeState, State
from ..plans.policies import Where
from ..switching.generators import PROCESS, seed_globals
from ..values.clock import Clock
from .forks import Fork, fork, pipe, receive_connection, result_of, send_connection
from .packing import pack_checked, pack_outcome, unpack
from .peer import pack_request
from .separation import separator_of

Result = TypeVar("Result")

# -- reports --------------------------------------------------------------------------------------

FIELDS: Final = (
    "observation", "reward", "info", "mask", "decided", "ended", "present", "answered", "delegated",
    "noted_action",
)  # fmt: skip
"""The fields of an agent that views read."""

_fields: Final = attrgetter(*FIELDS)

STATE: Final = ("outcome", "turns", "round", "earned", "unreported_end")
"""The fields of an episode that a mirror takes over as they are."""

_state: Final = attrgetter(*STATE)


class Report(NamedTuple):
    """The state of an episode after a request, as far as views read it.

    Attributes:
        is_whole: Whether it has all agents, or only the changed ones.
        state: The values of ``STATE``.
        time: The simulation's time. None if it has none.
        agents: For each agent its name, the number of its point, and its ``FIELDS``.
    """

    is_whole: bool
    state: tuple[Any, ...]
    time: float | None
    agents: list[tuple[str, int, tuple[Any, ...]]]
    pending: str | None


class Mirror(EpisodeState):
    """The episode of a clone, as its view sees it: the agents, as of the latest report."""

    __slots__ = ("_session", "_time")

    def __init__(self, session: RemoteSession, report: Report) -> None:
        """Mirror a report that lists all agents."""
        plan = session.plan
        self._time = time = [report.time]
        clock = None
        if report.time is not None:
            clock = Clock(lambda: time[0] or 0.0, plan.options.discount_rate)
        super().__init__(plan, session.seed or 0, clock, session.where, in_rounds=False)
        self._session = session
        self.load(report)

    def load(self, report: Report) -> None:
        """Take over a report."""
        for name, value in zip(STATE, report.state, strict=True):
            setattr(self, name, value)
        self._time[0] = report.time
        self.just_ended = []
        for name, point, fields in report.agents:
            agent = self.agent(name)
            if agent is None or agent.point is not self.plan.points[point]:
                handler = PointHandler(self.plan.points[point])
                agent = Agent(name, handler, None, False, self.clock, None)
            agent.load(dict(zip(FIELDS, fields, strict=True)))
            agents = self.others if agent.delegated else self.agents
            if agent.ended:
                self.agents.pop(name, None)
                self.just_ended.append(agent)
                agents = self.ended
            agents[name] = agent
        self.pending = None if report.pending is None else self.agents[report.pending]

    def single_out(self, agent: Agent) -> None:
        """Do nothing, because the process of the clone has done it."""

    def step(self, action: Action) -> None:
        """Take a step in the clone's process."""
        try:
            packed = pack_checked(action)
        except Exception as error:
            raise InvalidActionError(
                f"the action {short_repr(action)} cannot be sent to the process of the clone"
                f" ({describe_error(error)})"
            ) from error
        self._session.move(Host.step, packed)


# -- the clone's process ---------------------------------------------------------------------------


class Host:
    """The environment in the process of a clone. Its methods answer requests."""

    def __init__(self, view: Model) -> None:
        """Serve an unwrapped view."""
        self._view = view
        self._reported: Episode | None = None  # all its agents were reported
        self._latest: Agent | None = None  # was pending at the latest report

    def begin(self, separate: Callable[[], None]) -> bytes:
        """In a fork, leave the parent. Let the view of a planner wait for its agent only."""
        separate()
        self._reported = None
        self._view.session.leave_parent()
        self._view.begin_branch()
        return pack_outcome(self._report)

    def _report(self) -> Report | None:
        """Report the episode. None if there is none."""
        episode = self._view.session.episode
        if episode is None:
            return None
        pending = episode.pending
        agents = [*episode.just_ended]
        is_whole = episode is not self._reported
        if is_whole:
            agents = [*episode.ended.values(), *episode.others.values(), *episode.agents.values()]
        elif episode.over or episode.in_rounds or episode.skips:  # forced moves update others, too
            agents += episode.agents.values()
        elif pending is not None:
            agents.append(pending)
            if self._latest is not None and self._latest.noted_action is not None:
                agents.append(self._latest)  # because the turn view reads the rule's action
        self._latest = pending
        self._reported = episode
        if not episode.in_rounds:
            episode.take_ended()  # because the view in the other process reports them
        hooks = [point.hook for point in episode.plan.points]
        return Report(
            is_whole,
            _state(episode),
            None if episode.clock is None else float(episode.clock.time()),
            [(agent.name, hooks.index(agent.point.hook), _fields(agent)) for agent in agents],
            None if pending is None else pending.name,
        )

    # -- requests that move the simulation: ``move`` calls them ------------------------------------

    def move(self, method: Callable[..., object], *args: object) -> tuple[bytes, bytes]:
        """Call another method. Return the outcomes of it and, also after an error, of a report."""
        return pack_outcome(method, self, *args), pack_outcome(self._report)

    def step(self, packed: bytes) -> None:
        """Take a step with an action."""
        self._view.episode.step(unpack(packed))

    def start(self, seed: int, options: ResetOptions, in_rounds: bool) -> None:
        """Begin another episode."""
        self._view.session.start(seed, options, in_rounds=in_rounds)

    def call(
        self,
        function: Callable[..., Model],
        args: tuple[Model, ...],
        state: dict[str, Any],
        snapshot: Snapshot,
    ) -> tuple[Model, dict[str, Any], Snapshot]:
        """Call a function with the view, in the state that its twin has.

        Return the result, and the states of the view and of the session.
        """
        self._reported = None  # the function may change any agent
        self._view.session.restore(snapshot)
        self._view.import_state(state)
        result = function(self._view, *args)
        return result, self._view.export_state(), self._view.session.snapshot()

    # -- other requests ---------------------------------------------------------------------------

    def ask(self, method: Callable[..., Result], *args: object) -> Result:
        """Call a method of the session."""
        return method(self._view.session, *args)

    def reseed(self, seed: int) -> None:
        """Draw the future chance of the simulation and of this process anew."""
        seed_globals(seed, PROCESS)
        self._view.session.reseed(seed)

    def fork(self, method: str | None) -> int | bytes | None:
        """Fork this process, with a connection that follows the request.

        Return the number of the new process. None if the episode is replayed. The new process
        continues here: it responds to the request by its first response.
        """
        with receive_connection() as connection:
            separate = separator_of(self._view.episode, method)
            if separate is None:
                return None
            return fork(connection, partial(self.begin, separate))


# -- the user's process ---------------------------------------------------------------------------


class RemoteSession(BaseSession):
    """The session of a clone in a forked process."""

    __slots__ = ("_fork", "_is_renewed", "episode")

    episode: Mirror | None

    def __init__(self, original: BaseSession, fork: Fork) -> None:
        """Take over a process that continues the episode of a session."""
        super().__init__(original.plan, Where.CLONE)
        self.restore(copy.deepcopy(original.snapshot()))
        self.exclusive = fork.lock
        self.lock = fork.lock
        self.episode = None
        self._fork = fork
        self._is_renewed = False  # whether there may be another episode than at first
        with fork.watch():  # an error ends the process
            self._mirror(fork.start())
        if self.episode is not None and original.episode is not None:
            self.episode.remember(original.episode)

    @property
    def simulation(self) -> Model:
        """Refuse it: it is in another process."""
        raise BranchError(
            "the simulation of a clone is in the clone's process; reach it with"
            " env.unwrapped.call(lambda env: env.unwrapped.simulation...), which returns a copy of"
            " the result"
        )

    @property
    def process(self) -> int:
        """The number of its process, which may be killed while it computes."""
        return self._fork.process

    # -- requests ----------------------------------------------------------------------------------

    def move(self, method: Callable[..., Result], *args: object) -> Result:
        """Call a method that moves the simulation, and mirror the episode afterwards."""
        outcome, reported = self._fork.request(Host.move, method, *args)
        try:
            self._mirror(reported)
        except BranchError:
            result_of(outcome)  # the model's error comes first
            raise
        result: Result = result_of(outcome)
        return result

    def _mirror(self, reported: bytes) -> None:
        """Mirror the outcome of a report."""
        try:
            report: Report | None = result_of(reported)
        except Exception as error:
            self.episode = None
            self._state = State.OVER
            raise BranchError(
                "an observation, info or mask cannot be sent from the process of the clone"
                f' ({describe_error(error)}); use method="replay"'
            ) from error
        if report is None:
            self.episode = None
        elif self.episode is None or report.is_whole:
            self.episode = Mirror(self, report)
        else:
            self.episode.load(report)

    def fork(self, method: str | None, time_limit: float) -> Fork | None:
        """Fork the clone's process. None if the episode is replayed."""
        here, there = pipe()
        request = pack_request(Host.fork, method)
        with self._fork.watch():
            with there:
                self._fork.send(request)
                send_connection(self._fork.connection, there)
            response = self._fork.receive()
        process: int | None = result_of(response)
        if process is None:
            return None
        return Fork(process, here, time_limit, self._fork)

    def refusal(self) -> SimEnvError:
        """Make the error that says why no action can be taken now."""
        if self._fork.gone is None:
            return super().refusal()
        kind = ClosedError if self._state is State.CLOSED else BranchError
        return kind(f"the clone is gone: {self._fork.gone}")

    def move_to(self, where: Where) -> None:
        """Note that its episodes are played in a clone or a branch from now on."""
        super().move_to(where)
        self._fork.request(Host.ask, Session.move_to, where)

    # -- the simulation ----------------------------------------------------------------------------

    def ask(self, name: str, *args: Any) -> Model:
        """Call a method of the simulation."""
        return self._fork.request(Host.ask, Session.ask, name, *args)

    def check_reseed(self) -> None:
        """Check that the simulation's future chance can be drawn anew."""
        self._fork.request(Host.ask, Session.check_reseed)

    def reseed(self, seed: int) -> None:
        """Draw the future chance of the simulation and of the clone's process anew."""
        self._fork.request(Host.reseed, seed)

    def recording(self) -> Recording:
        """Return the recording for a replay of the episode."""
        recording: Recording = self._fork.request(Host.ask, Session.recording)
        return recording

    def note_exit(self, agent: str) -> None:
        """Do nothing, because nothing is recorded in clones."""

    def leave_caller(self) -> None:
        """Do nothing, because the clone's process has done it."""

    def call(self, view: Model, function: Callable[..., Model], args: tuple[Any, ...]) -> Model:
        """Call a function with the view in the clone's process."""
        self._is_renewed = True  # the function may reset the environment
        try:
            result, state, snapshot = self.move(
                Host.call, function, args, view.export_state(), self.snapshot()
            )
        except BaseException:
            view.set_up()
            raise
        self.restore(snapshot)
        view.import_state(state)
        return result

    # -- episodes ----------------------------------------------------------------------------------

    def start(self, seed: int | None, options: ResetOptions, *, in_rounds: bool = False) -> Mirror:
        """Reset the simulation in the clone's process."""
        self.end()
        self.seed = self.seed_for(seed)
        self._is_renewed = True
        self.move(Host.start, self.seed, options, in_rounds)
        if self.episode is None:
            raise self.refusal()
        return self.episode

    def end(self) -> None:
        """Forget the episode. It ends when another begins, or with the process."""
        self.episode = None

    @property
    def idle(self) -> bool:
        """Whether the process has ended."""
        return self._fork.connection.closed

    def close(self) -> None:
        """End the process. Unwind and close the simulation there if it was reset there."""
        try:
            if self._is_renewed and self._fork.gone is None:
                self._fork.request(Host.ask, Session.close)
        finally:
            self._state = State.CLOSED
            self.episode = None
            self._fork.end("it is closed; ")

    def abandon(self) -> None:
        """Close it from a finalizer. Warn of errors instead of raising them."""
        try:
            self.close()
        except Exception as error:
            warn_user(f"a clone that was abandoned raised {short_repr(error)}", ResourceWarning)
