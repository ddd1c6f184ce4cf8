"""The process of a clone: it answers the requests of the session that the user has instead."""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable
from contextlib import suppress
from contextvars import ContextVar
from multiprocessing.connection import Connection
from operator import attrgetter
from typing import Any, Final, NamedTuple, Protocol

from ...errors import BranchError
from ...simulation import Action, Model
from ..episodes.base import Recording, ResetOptions, Snapshot
from ..episodes.episode import Episode
from ..episodes.session import Session
from ..episodes.state import Outcome
from ..plans.policies import Where
from ..switching.generators import PROCESS, seed_globals
from .forks import CAN_FORK, Fork, flush, send_connection
from .packing import unpack
from .peer import serve
from .separation import obstacles_of, separator

DEEPEST: Final = 4
"""The largest depth of nested branches. Each level can run as many branches as there are cores."""

DEPTH: Final[ContextVar[int]] = ContextVar("simenv_marl.core.host", default=0)
"""The depth of this branch."""

FIELDS: Final = (
    "observation", "reward", "info", "mask", "decided", "ended", "present", "answered",
)  # fmt: skip
"""The fields of an agent that views read."""

_fields: Final = attrgetter(*FIELDS)


class HostedView(Protocol):
    """A view in the process of a clone."""

    driver: str

    @property
    def episode(self) -> Episode:
        """The episode."""

    @property
    def session(self) -> Session:
        """The session."""

    def begin_branch(self) -> None:
        """Prepare the view of a branch."""

    def set_up(self) -> None:
        """Complete what the view reads of an episode."""

    def export_state(self) -> dict[str, Any]:
        """Return the state of the view."""

    def import_state(self, state: dict[str, Any]) -> None:
        """Take over the state of its twin."""


class AgentReport(NamedTuple):
    """What views read of an agent: its name, the number of its point, and its ``FIELDS``."""

    name: str
    point: int
    fields: tuple[Any, ...]


class Report(NamedTuple):
    """What views read of an episode after a request.

    Attributes:
        acted: The agents whose action the latest round has used. None where it is played in turns.
        agents: The agents that have changed.
        others: The names of the agents for which policies answer, where all agents are sent.
        just_ended: The names of the agents whose end is not reported yet.
        time: The simulation's time. None if it has none.
        unpickled: The keys that infos have lost, because their values cannot be pickled.
    """

    acted: set[str] | None
    pending: str | None
    outcome: Outcome
    turns: int
    time: float | None
    others: list[str]
    agents: list[AgentReport]
    just_ended: list[str]
    unreported_end: bool
    unpickled: list[str]


def report_of(episode: Episode, *, whole: bool) -> Report:
    """Report an episode. ``whole``: with all agents, and not only those that have changed."""
    pending = episode.pending
    agents = [*episode.just_ended]
    if whole:
        agents = [*episode.ended.values(), *episode.agents.values()]
    elif episode.over or episode.in_rounds or episode.skips:  # forced moves update others, too
        agents += episode.agents.values()
    elif pending is not None:
        agents.append(pending)
    numbers = {point.hook: number for number, point in enumerate(episode.plan.points)}
    return Report(
        None if episode.round is None else episode.round.acted,
        None if pending is None else pending.name,
        episode.outcome,
        episode.turns,
        None if episode.clock is None else float(episode.clock.time()),
        list(episode.others) if whole else [],
        [AgentReport(agent.name, numbers[agent.point.hook], _fields(agent)) for agent in agents],
        [agent.name for agent in episode.just_ended],
        episode.unreported_end,
        [],
    )


def portable_report(report: Report) -> Report:
    """Return a report without the values in infos that cannot be pickled."""
    if _can_be_pickled(report):
        return report
    place = FIELDS.index("info")
    unpickled: dict[str, None] = {}
    agents: list[AgentReport] = []
    for agent in report.agents:
        info = agent.fields[place]
        portable = {key: value for key, value in info.items() if _can_be_pickled(value)}
        unpickled |= {repr(key): None for key in info.keys() - portable.keys()}
        fields = (*agent.fields[:place], portable, *agent.fields[place + 1 :])
        agents.append(agent._replace(fields=fields))
    return report._replace(agents=agents, unpickled=list(unpickled))


def _can_be_pickled(value: object) -> bool:
    try:
        pickle.dumps(value, 5)
    except Exception:
        return False
    return True


class Host:
    """The environment in the process of a clone. Its methods answer requests."""

    def __init__(self, view: HostedView) -> None:
        self._view = view
        self._session = view.session
        self._connection: Connection | None = None
        self._forked: Fork | None = None  # the latest fork, until its connection is handed over

    def serve(self, connection: Connection) -> None:
        """Answer requests until the other end is closed."""
        self._session.leave_parent()
        self._connection = connection
        self._forked = None
        serve(connection, self, flush)

    # -- episodes ---------------------------------------------------------------------------------

    def begin(self) -> Report | None:
        """Let the view of a planner wait for its agent only."""
        self._view.begin_branch()
        return self.report(True)

    def report(self, whole: bool) -> Report | None:
        """Report the episode. None without one."""
        episode = self._session.episode
        if episode is None:
            return None
        report = portable_report(report_of(episode, whole=whole))
        if not episode.in_rounds:
            episode.take_ended()  # because the view in the other process reports them
        return report

    def step(self, action: Action) -> Report | None:
        """Take a step."""
        episode = self._session.episode
        if episode is None:
            raise self._session.refusal()
        episode.step(action)
        return self.report(False)

    def start(self, seed: int, options: ResetOptions, in_rounds: bool) -> Report | None:
        """Begin another episode."""
        self._session.start(seed, options, in_rounds=in_rounds)
        self._view.set_up()  # branches of the clone have the view, too
        return self.report(True)

    def close(self) -> None:
        """Unwind and close the simulation."""
        self._session.close()

    def call(
        self, function: bytes, state: dict[str, Any], snapshot: Snapshot, unreported_end: bool
    ) -> tuple[Any, dict[str, Any], Snapshot, Report | None]:
        """Call a function with the view, in the state that its twin has.

        Return the result, and the states of the view, the session and the episode.
        """
        called, args = unpack(function)
        session = self._session
        session.restore(snapshot)
        if session.episode is not None and not unreported_end:
            session.episode.mark_reported()
        self._view.import_state(state)
        token = DEPTH.set(DEPTH.get() + 1)
        try:
            result = called(self._view, *args)
        finally:
            DEPTH.reset(token)
        return result, self._view.export_state(), session.snapshot(), self.report(True)

    def move_to(self, where: Where) -> None:
        """Note where the episodes are played from now on."""
        self._session.move_to(where)

    # -- the simulation ---------------------------------------------------------------------------

    def ask(self, name: str, *args: Any) -> Model:
        """Call a method of the simulation."""
        return self._session.ask(name, *args)

    def check_reseed(self) -> None:
        """Check that the simulation's future chance can be drawn anew."""
        self._session.check_reseed()

    def reseed(self, seed: int) -> None:
        """Draw the simulation's future chance anew."""
        seed_globals(seed, PROCESS)
        self._session.reseed(seed)

    def recording(self) -> Recording:
        """Return what a replay of the episode needs."""
        return self._session.recording()

    # -- clones of the clone ----------------------------------------------------------------------

    def fork(self, method: str | None) -> int | None:
        """Fork this process; return the number of the new one. None if the episode is replayed."""
        separate = separator_of(self._view, method)
        if separate is None:
            return None
        self._forked = Fork.begin(self.serve, separate, wait=True, outlives=True)
        return self._forked.process

    def hand_over(self) -> None:
        """Send the connection of the latest fork to the user."""
        forked, self._forked = self._forked, None
        if forked is not None and self._connection is not None:
            with forked.connection as connection:
                send_connection(self._connection, connection)

    def reap(self, process: int) -> None:
        """Wait for the end of a fork that was killed."""
        with suppress(ChildProcessError):
            os.waitpid(process, 0)


def separator_of(view: HostedView, method: str | None) -> Callable[[], None] | None:
    """Return what separates forks of this process from it. None if the episode is replayed."""
    if method == "replay" or not CAN_FORK or view.driver != "greenlet":
        return None
    driver = view.episode.driver
    if not driver.reachable:
        driver.enter()  # raises the error that names the thread
    obstacles, loops = obstacles_of(driver.opened)
    if obstacles and method == "fork":
        raise BranchError(
            f"a forked process cannot continue with {', '.join(obstacles)} that the simulation has"
            ' opened; use method="replay"'
        )
    return None if obstacles else separator(loops)
