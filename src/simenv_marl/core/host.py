"""The process of a clone: it answers the requests of the session that the user's process has instead."""

from __future__ import annotations

import io
import os
import pickle
import socket
from collections.abc import Callable
from contextlib import suppress
from contextvars import ContextVar
from operator import attrgetter
from typing import Any, Final, NamedTuple

from ..errors import BranchError
from .episode import Episode
from .forks import CAN_FORK, flush, lives_above, pair, receive, send, start
from .packing import Pickler, pack_error, pack_plainly, unpack
from .rng import PROCESS, seed_globals
from .separation import loops_on, open_resources, separator
from .session import Session

DEEPEST: Final = 4
"""The largest depth of nested branches. Each level can run as many branches as there are cores."""

DEPTH: Final[ContextVar[int]] = ContextVar("simenv_marl.core.host", default=0)
"""The depth of this branch."""

FIELDS: Final = (
    "observation",
    "reward",
    "info",
    "mask",
    "acted",
    "decided",
    "ended",
    "present",
    "answered",
)
"""What views read of an agent."""

_fields: Final = attrgetter(*FIELDS)

MOVES: Final = {"step": False, "begin": True, "start": True, "call": True}
"""The requests after which the state of the episode is sent, and whether all of it is."""


class Host:
    """The environment in the process of a clone.

    Its methods, and those of its session, answer requests.
    """

    def __init__(self, env: Any, view: Any) -> None:
        self._env, self._view = env, view
        self._session: Session = view._session

    def serve(self, connection: socket.socket) -> None:
        """Answer requests until the other end is closed."""
        self._session.inherit()
        while message := receive(connection):
            name, args = unpack(message)
            if name == "fork":
                connection = self._fork(connection, *args)
            else:
                send(connection, self._answer(name, *args))

    def _answer(self, name: str, *args: Any) -> bytes:
        """Do what a request asks for.

        Return the reply: a value, or an error, and the state of the episode.
        """
        value = error = state = None
        try:
            value = getattr(self if hasattr(self, name) else self._session, name)(*args)
            value = None if value is None else pack_plainly(value)
        except BaseException as problem:
            value, error = None, pack_error(problem)
        episode = self._session.episode
        whole = MOVES.get(name)
        if whole is not None and episode is not None:
            state = state_of(episode, whole=whole)
            if not episode.in_rounds:
                episode.just_ended = []  # the view in the other process reports them
        flush()
        return pack_reply(value, error, state)

    def _fork(self, connection: socket.socket, method: str | None) -> socket.socket:
        """Fork this process.

        Send the connection of the new one; return the connection to serve from now on.
        """
        here = there = None
        process: int | None = None
        try:
            separate = separator_of(self._view, method)
            if separate is not None:
                here, there = pair()
                process = start(here, there, lives_above(), separate, wait=True)
                if process == 0:
                    here.close()
                    return there
            reply = pack_reply(pack_plainly(process), None, None)
        except Exception as error:
            reply = pack_reply(None, pack_error(error), None)
        socket.send_fds(connection, [b"."], [here.fileno()] if here is not None and process else [])
        for end in (here, there):
            if end is not None:
                end.close()
        send(connection, reply)
        return connection

    def begin(self) -> None:
        """Let the environment of a planner wait for its agent only."""
        self._view._begin_branch()

    def step(self, action: Any) -> None:
        """Take a step."""
        if self._session.episode is None:
            raise self._session.refusal()
        self._session.episode.step(action)

    def start(self, seed: int, options: Any, in_rounds: bool) -> None:
        """Begin another episode."""
        self._session.start(seed, options, in_rounds=in_rounds)
        # branches of the clone have it, and it may hold agents of the episode before
        self._view._set_up()

    def reseed(self, seed: int) -> None:
        """Draw what lies ahead anew."""
        seed_globals(seed, PROCESS)
        self._session.reseed(seed)

    def call(self, function: bytes, parcel: bytes | None, noted: Any) -> Any:
        """Call a function with the environment, in the state that it has in the other process.

        Return both.
        """
        env, session = self._env, self._session
        if parcel is not None:
            env = unpack_env(parcel, [self._view], session)
        episode = session.episode
        if episode is not None and noted is not None:
            episode.unreported_end, episode.last_time = noted
        called, args = unpack(function)
        token = DEPTH.set(DEPTH.get() + 1)
        try:
            result = called(env, *args)
        finally:
            DEPTH.reset(token)
        if parcel is not None:
            layers = layers_of(env)
            parcel = pack_env([*map(vars, layers[:-1])], layers, session)
        return result, parcel

    def reap(self, process: int) -> None:
        """Wait for the end of a fork that was killed."""
        with suppress(ChildProcessError):
            os.waitpid(process, 0)


class State(NamedTuple):
    """What views read of an episode.

    Attributes:
        agents: The name, the number of the point and the ``FIELDS`` of each agent that is sent.
        just_ended: The names of the agents whose end is not reported yet. The other attributes are
            those of ``Run``.
    """

    in_rounds: bool
    pending: str | None
    over: bool
    terminated: bool
    truncated: bool
    turns: int
    time: float | None
    others: list[str]
    agents: list[tuple[str, int, tuple[Any, ...]]]
    just_ended: list[str]
    unreported_end: bool
    last_time: float | None


def state_of(episode: Episode, *, whole: bool) -> State:
    """Return the state of an episode.

    Without the agents that have not changed, unless it is the ``whole``.
    """
    agents, points, pending = [*episode.just_ended], episode.plan.points, episode.pending
    if whole:
        agents = [*episode.ended.values(), *episode.agents.values()]
    elif episode.over or episode.in_rounds or episode.skips:  # forced moves update others, too
        agents += episode.agents.values()
    elif pending is not None:
        agents.append(pending)
    return State(
        episode.in_rounds,
        None if pending is None else pending.name,
        episode.over,
        episode.terminated,
        episode.truncated,
        episode.turns,
        None if episode.clock is None else float(episode.clock()),
        list(episode.others) if whole else [],
        [(agent.name, points.index(agent.point), _fields(agent)) for agent in agents],
        [agent.name for agent in episode.just_ended],
        episode.unreported_end,
        episode.last_time,
    )


def pack_reply(value: bytes | None, error: bytes | None, state: State | None) -> bytes:
    """Pickle a reply, with the keys that infos had to lose because their values cannot be pickled."""
    try:
        return pickle.dumps((value, error, state, []), 5)
    except Exception:
        if state is None:
            raise
    left_out: dict[str, None] = {}
    agents = []
    for name, point, values in state.agents:
        fields = dict(zip(FIELDS, values, strict=True))
        kept = {key: part for key, part in fields["info"].items() if _can_be_pickled(part)}
        left_out |= {repr(key): None for key in fields["info"].keys() - kept.keys()}
        agents.append((name, point, (*(fields | {"info": kept}).values(),)))
    return pickle.dumps((value, error, state._replace(agents=agents), left_out), 5)


def _can_be_pickled(value: Any) -> bool:
    try:
        pickle.dumps(value, 5)
    except Exception:
        return False
    return True


def separator_of(view: Any, method: str | None) -> Callable[[], None] | None:
    """Return what separates forks of this process from it; None if the episode must be replayed."""
    if method == "replay" or not CAN_FORK or view.driver != "greenlet":
        return None
    driver = view.episode.driver
    if not driver.reachable:
        driver.enter()  # raises the error that names the thread
    obstacles = open_resources(driver.opened)
    loops = loops_on(obstacles) if obstacles else []
    for loop in loops:  # the pair of sockets that wakes an event loop is made anew
        obstacles.pop(loop._ssock.fileno(), None)
        obstacles.pop(loop._csock.fileno(), None)
    if obstacles and method == "fork":
        raise BranchError(
            f"a forked process cannot continue with {', '.join(obstacles.values())} that the"
            " simulation has opened; use"
            ' method="replay"'
        )
    return None if obstacles else separator(loops)


# -- environments that are sent --------------------------------------------------------------------


class _EnvPickler(Pickler):
    """A pickler for the wrappers of an environment, which the other process has as well."""

    def __init__(self, buffer: io.BytesIO, shared: dict[int, int]) -> None:
        super().__init__(buffer, 5)
        self._shared = shared

    def persistent_id(self, thing: Any) -> int | None:
        """Return the place of what the other process has."""
        return self._shared.get(id(thing))


def layers_of(env: Any) -> list[Any]:
    """List an environment and all that it wraps, with the view as the last."""
    layers, view = [env], env.unwrapped
    while layers[-1] is not view:
        parts = vars(layers[-1]).values()
        layers.append(
            next(part for part in parts if part is view or getattr(part, "unwrapped", None) is view)
        )
    return layers


def pack_env(part: Any, layers: list[Any], session: Session) -> bytes:
    """Pickle a part of an environment, with the state of its view, the last of the layers, and of the session."""
    buffer = io.BytesIO()
    shared = {id(layer): place for place, layer in enumerate(layers)}
    _EnvPickler(buffer, shared).dump((part, layers[-1]._state(), session.snapshot()))
    return buffer.getvalue()


def unpack_env(parcel: bytes, layers: list[Any], session: Session) -> Any:
    """Give the view and the session their states in a parcel; return the part."""
    unpickler: Any = pickle.Unpickler(io.BytesIO(parcel))
    unpickler.persistent_load = layers.__getitem__
    part, state, snapshot = unpickler.load()
    vars(layers[-1]).update(state)
    session.restore(snapshot)
    return part
