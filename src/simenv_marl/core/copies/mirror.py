"""A clone in a forked process, as its view sees it: a session that asks, and a mirrored episode."""

from __future__ import annotations

import copy
import os
from collections.abc import Callable
from contextlib import suppress
from errno import EMFILE
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

from ...errors import BranchError, ClosedError, SimEnvError, annotate, short_repr, warn_user
from ...simulation import Action, Model
from ..episodes.agent import Agent, Clock
from ..episodes.base import BaseSession, Recording, ResetOptions
from ..episodes.events import PointHandler
from ..episodes.state import EpisodeState, State
from ..plans.policies import Where
from .forks import Fork, exhausted, receive_connection
from .host import FIELDS, AgentReport, HostedView, Report, report_of
from .packing import pack
from .peer import Peer, PeerLostError, Response


class Mirror(EpisodeState):
    """The episode of a clone, as its view sees it: the agents, as of the latest report."""

    __slots__ = ("_session",)

    def __init__(self, session: RemoteSession, report: Report) -> None:
        """Mirror a report that lists all agents."""
        plan = session.plan
        clock: Clock | None = None
        if report.time is not None:
            clock = Clock(partial(getattr, session, "time"), plan.options.discount_rate)
        super().__init__(
            plan, session.seed or 0, clock, session.where, in_rounds=report.acted is not None
        )
        self._session = session
        self.unreported_end = report.unreported_end
        self.load(report)

    def load(self, report: Report) -> None:
        """Take over a report. What the view itself notes in an episode stays."""
        self.outcome = report.outcome
        self.turns = report.turns
        if self.round is not None and report.acted is not None:
            self.round.load(report.acted)
        for agent in report.agents:
            self._load_agent(agent)
        for name in report.others:
            self.others.setdefault(name, self._make_agent(name, 0))  # only their names matter
        self.just_ended = [self.ended[name] for name in report.just_ended]
        self.pending = None if report.pending is None else self.agents[report.pending]

    def _load_agent(self, report: AgentReport) -> None:
        name = report.name
        agent = self.agent(name) or self._make_agent(name, report.point)
        agent.load(dict(zip(FIELDS, report.fields, strict=True)))
        self.agents.pop(name, None) if agent.ended else self.ended.pop(name, None)
        (self.ended if agent.ended else self.agents)[name] = agent

    def _make_agent(self, name: str, point: int) -> Agent:
        handler = PointHandler(self.plan.points[point])
        return Agent(name, handler, None, False, self.clock, self.plan.plugins)

    def single_out(self, agent: Agent) -> None:
        """Do nothing, because the process of the clone has done it."""

    def step(self, action: Action) -> None:
        """Take a step in the clone's process."""
        if self.pending is None:
            self.report_end()
            return
        self.unreported_end = False
        self._session.step(action)


class RemoteSession(BaseSession):
    """The session of a clone in a forked process.

    Attributes:
        time: The simulation's time as of the latest report. None if it has none.
    """

    __slots__ = (
        "_fork", "_gone", "_is_renewed", "_limit", "_parent", "_peer", "_warned", "episode",
        "time",
    )  # fmt: skip

    episode: Mirror | None

    def __init__(self, original: BaseSession, fork: Fork, time_limit: float) -> None:
        """Take over a process in which the episode of a session goes on."""
        super().__init__(original.plan, Where.CLONE)
        self.restore(copy.deepcopy(original.snapshot())._replace(state=State.OVER))
        self.options = original.options
        self.lock = self.exclusive
        self.episode = None
        self.time: float | None = None
        self._fork = fork
        self._limit = time_limit
        self._peer = Peer(fork.connection)
        # The session whose process forked this one's, if that is a clone, too.
        self._parent = original if isinstance(original, RemoteSession) else None
        self._gone: str | None = None  # why the process is gone
        self._is_renewed = False  # whether there may be another episode than at first
        self._warned = False
        fork.limit(time_limit)

    def begin(self, view: HostedView, waits_for_one: bool) -> None:
        """Mirror the episode of the view that was cloned.

        ``waits_for_one``: from now on the clone waits for one agent only.
        """
        if waits_for_one:
            self._mirror(self.request("begin"), whole=True)
        else:
            self._mirror(report_of(view.episode, whole=True), whole=True)

    @property
    def simulation(self) -> Model:
        """Refuse it: it is in another process."""
        raise BranchError(
            "the simulation of a clone is in the clone's process; reach it with"
            " env.unwrapped.call(lambda env: env.unwrapped.simulation...), which returns a copy of"
            " the result"
        )

    # -- requests ----------------------------------------------------------------------------------

    def request(self, name: str, *args: Any, limit: float | None = None) -> Any:
        """Call a method of the clone's ``Host``; return its result.

        Raises:
            BranchError: The process has ended, or takes too long and is ended.
            BaseException: Any exception there, with its traceback as a note.
        """
        with self.exclusive:
            self._check_alive()
            outcome = self._exchange(name, args, limit)
        error = outcome.error
        if error is None:
            return outcome.result
        annotate(error, f"simenv_marl: in a clone, where it was raised by{error.__cause__}")
        BaseException.__setattr__(error, "__cause__", None)  # its class may be frozen
        raise error

    def _check_alive(self) -> None:
        if self._gone is not None or not self._fork.usable:
            raise self.refusal()

    def _exchange(self, name: str, args: tuple[Any, ...], limit: float | None) -> Response:
        """Send a request and receive its outcome."""
        seconds = self._limit if limit is None else limit
        try:
            if limit is not None:
                self._fork.limit(limit)
            self._peer.send(name, args)
            outcome = self._peer.receive()
            if limit is not None:
                self._fork.limit(self._limit)
        except TimeoutError:
            self._end(f"it was ended, because it took longer than {seconds} s; ")
        except PeerLostError:
            self._end("its process has died, ")
        except BaseException:  # an interrupt: the reply would be taken for the next one
            self._end("it was ended by an interrupt; ")
            raise
        else:
            if outcome is not None:
                return outcome
        raise self.refusal()

    def fork(self, method: str | None) -> Fork | None:
        """Fork the clone's process. None if the episode is replayed."""
        with self.exclusive:
            process = self.request("fork", method)
            if process is None:
                return None
            connection = self._receive_connection()
            if connection is None:  # the fork ends, because its connection was lost
                self.request("reap", process)
                raise exhausted(OSError(EMFILE, os.strerror(EMFILE)))
            return Fork(process, connection, self._fork.life, is_child=False)

    def _receive_connection(self) -> Connection | None:
        """Receive the connection of a fork. None if there are no more descriptors."""
        self._peer.send("hand_over", ())
        connection = receive_connection(self._fork.connection)
        self._peer.receive()
        return connection

    def refusal(self) -> SimEnvError:
        """Make the error that says why no action can be taken now."""
        if self._state is State.CLOSED:
            return ClosedError(
                "the clone is closed, and its process has ended; clone the environment again"
            )
        if self._gone is not None or not self._fork.usable:
            return BranchError(
                f"the clone is gone: {self._gone or 'it belongs to another process'}"
            )
        return super().refusal()

    def _move(self, name: str, *args: Any, whole: bool) -> None:
        """Send a request that moves the simulation, and mirror the episode afterwards."""
        try:
            report = self.request(name, *args)
        except BaseException:
            if self._gone is None:
                self._mirror(self.request("report", whole), whole)
            raise
        self._mirror(report, whole)

    def _mirror(self, report: Report | None, whole: bool) -> None:
        if report is None:
            self.episode = None
            return
        if report.unpickled and not self._warned:
            self._warned = True
            names = ", ".join(report.unpickled)
            warn_user(f"infos of clones lack values that cannot be pickled: {names}")
        self.time = report.time
        if self.episode is None or whole:
            self.episode = Mirror(self, report)
        else:
            self.episode.load(report)

    def move_to(self, where: Where) -> None:
        """Note that its episodes are played in a clone or a branch from now on."""
        super().move_to(where)
        self.request("move_to", where)

    # -- the simulation ----------------------------------------------------------------------------

    def ask(self, name: str, *args: Any) -> Model:
        """Call a method of the simulation."""
        return self.request("ask", name, *args)

    def check_reseed(self) -> None:
        """Check that the simulation's future chance can be drawn anew."""
        self.request("check_reseed")

    def reseed(self, seed: int) -> None:
        """Draw the simulation's future chance anew, and that of the clone's process."""
        self.request("reseed", seed)

    def recording(self) -> Recording:
        """Return what a replay of the episode needs."""
        recording: Recording = self.request("recording")
        return recording

    def leave_caller(self) -> None:
        """Do nothing, because the clone's process has done it."""

    def call(
        self,
        view: Model,
        function: Callable[..., Model],
        args: tuple[Any, ...],
        limit: float | None = None,
    ) -> Model:
        """Call a function with the view in the clone's process."""
        unreported_end = self.episode is not None and self.episode.unreported_end
        self._is_renewed = True  # the function may reset the environment
        message = pack((function, args))
        try:
            result, state, snapshot, report = self.request(
                "call", message, view.export_state(), self.snapshot(), unreported_end, limit=limit
            )
        except BaseException:
            if self._gone is None:
                self._mirror(self.request("report", True), whole=True)
                view.set_up()
            raise
        self.restore(snapshot)
        self._mirror(report, whole=True)
        view.import_state(state)
        return result

    # -- episodes ----------------------------------------------------------------------------------

    def step(self, action: Action) -> None:
        """Take a step."""
        self._move("step", action, whole=False)

    def start(self, seed: int | None, options: ResetOptions, *, in_rounds: bool = False) -> Mirror:
        """Reset the simulation in the clone's process."""
        self.options = options
        self.seed = self.seed_for(seed)
        self.episode = None
        self._state = State.OVER
        self._is_renewed = True
        self._move("start", self.seed, options, in_rounds, whole=True)
        episode: Mirror | None = self.episode
        if episode is None:
            raise self.refusal()
        return episode

    def end(self) -> None:
        """Forget the episode. It ends when another begins, or with the process."""
        self.episode = None

    @property
    def idle(self) -> bool:
        """Whether the process has ended."""
        return self._gone is not None

    def close(self) -> None:
        """End the process. Unwind and close the simulation there if it was reset there."""
        try:
            if self._is_renewed and self._gone is None and self._fork.usable:
                self.request("close")
        finally:
            self._state = State.CLOSED
            self._end("it is closed; ")

    def abandon(self) -> None:
        """Close it from a finalizer. Warn of errors instead of raising them."""
        try:
            self.close()
        except Exception as error:
            warn_user(f"a clone that was abandoned raised {short_repr(error)}", ResourceWarning)

    def _end(self, why: str) -> None:
        """End the process, for a reason."""
        self.episode = None
        if self._gone is not None:
            return
        self._gone = why + self._fork.end()
        if self._parent is not None:
            with suppress(Exception):  # the parent may be gone, or busy; then it waits later
                self._parent.request("reap", self._fork.process)
