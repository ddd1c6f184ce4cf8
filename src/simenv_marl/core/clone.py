"""Live branches: copies of an environment in mid-episode that go on from where it stands, and exact continuations.

A clone lives in a forked process, where the view, the episode and the simulation are as they were. In this process
there is a view of the same kind. Its session passes resets and steps on, and its episode mirrors the one there: the
agents, with what they observe, and what is pending. So the views know nothing of processes. Wrappers, spaces and the
generator of seeds live here; a function that is called in the clone takes them along, and brings them back.

Where a process cannot be forked, a clone is an environment of this process that repeats the episode.
"""

from __future__ import annotations

import copy
import io
import os
import pickle
import select
import socket
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from contextvars import ContextVar
from functools import partial
from math import inf
from typing import Any, Final, TypeVar

import numpy as np

from ..errors import (
    BranchError,
    OptionValueError,
    ViewError,
    WorkerError,
    annotate,
    close_after,
    describe_error,
    did_you_mean,
    short_repr,
    warn_user,
)
from .agent import Agent
from .context import ExclusiveLock, preserve_generators, reuse_resources
from .episode import Episode, Rounds
from .forks import CAN_FORK, Fork, flush, lives_above, loops_on, open_resources, pair, receive, send, separator, start
from .packing import Pickler, pack, pack_error, pack_outcome, pack_plainly, unpack, unpack_error, unpack_outcome
from .rng import PROCESS, is_seed, seed_globals
from .session import Session

Result = TypeVar("Result")

DEEPEST: Final = 4
"""The largest depth of nested branches. Each level can run as many branches as there are cores."""

_depth: ContextVar[int] = ContextVar("simenv_marl.core.clone", default=0)
"""The depth of this branch."""


def clone(env: Any, *, seed: int | None = None, method: str | None = None, time_limit: float = 600.0) -> Any:
    """Copy an environment in mid-episode. The copy stands where ``env`` stands, and goes on from there.

    Neither sees the other. What the copy does with the same actions is identical, bit for bit. It is an environment of
    the same view with the same wrappers, and can be stepped, reset, rendered, cloned and closed like any other. A clone
    that is never stepped is a checkpoint: clones of it rewind.

    ``clone(env).unwrapped.call(function, *args)`` calls ``function(environment, *args)`` where the clone lives, and
    returns a copy of the result. The function may do anything with the environment. ``unwrapped.simulation`` exists
    only there.

    A clone ends when it is closed or collected, and with the user's process. Then, and at a reset, the episode in which
    it was cloned is neither unwound nor closed.

    Args:
        env: An environment of a single simulation, in any view, with or without wrappers; also another clone.
        seed: A seed for the random numbers that lie ahead, as ``branch`` takes one for each branch. None: the clone has
            the exact future of ``env``.
        method: "fork": the clone lives in a forked process (Linux, and ``driver="greenlet"``). "replay": it is an
            environment of this process, whose simulation repeats the episode from its seed and the actions. None:
            "fork" if it is possible, else "replay", as in ``branch``.
        time_limit: The time that an operation of a forked clone may take, in seconds.

    Raises:
        ResetNeededError: No decision is pending.
        BranchError: It cannot be cloned by this method, or by any; there are no more processes or descriptors; or a
            ``seed`` is given without a ``reseed`` or ``global_rng=True``. Later: its process has died, or an operation
            took too long.
        OptionValueError: An argument has an invalid value.
        BaseException: Any exception of ``reseed``.
    """
    view = _checked_view(env, "clone", method, time_limit)
    if seed is not None:
        if not is_seed(seed):
            raise OptionValueError(f"seed must be a non-negative integer or None, not {short_repr(seed)}")
        view._session.check_reseed()
    session: Session | None = _forked(env, view, method, time_limit)
    try:
        if isinstance(session, ForkedSession):
            session.begin(view)
        else:
            with preserve_generators():  # the model may draw from the process's generators, then and now
                session = Session(view._session.plan)
                session.replay(view._session)
        twin = view._cloned(session)
        twin._begin_branch()
        if seed is not None:
            session.reseed(int(seed))
        made = copy.deepcopy(env, {id(view): twin})  # copies each wrapper with its state
        twin._set_outermost(made)
    except BaseException as error:
        if session is not None:
            close_after(error, session.close, "the clone")
        raise
    return made


def branch(
    env: Any,
    function: Callable[[Any, int], Result],
    n: int = 1,
    *,
    method: str | None = None,
    seeds: Sequence[int] | None = None,
    time_limit: float = 600.0,
) -> list[Result]:
    """Call a function on exact continuations of an environment in mid-episode: on ``n`` clones, each for one call.

    Each continuation starts in exactly the state of ``env``: the model and its random numbers, the environment's
    generators, and its wrappers. Continuations that take the same actions are identical, bit for bit. ``env`` itself
    does not move. With ``seeds``, the continuations share the present state but draw different random numbers from then
    on.

    Args:
        env: An environment of a single simulation, in any view, with or without wrappers; also a clone.
        function: Called with the continuation and its number, from 0 to ``n - 1``. It may do anything with it.
        n: The number of continuations.
        method: "fork": each continuation runs in a forked process, with its own open files and global generators
            (Linux, and ``driver="greenlet"``), on all available cores. The results are pickled. "replay": the
            continuations run one after the other in this process. Each is a new simulation with the same seed, to which
            the same actions are given. The policies of the option ``policies`` repeat their answers, and are called
            from the present on. None: "fork" if it is possible, else "replay". Forking is not possible if the
            simulation has opened something that two processes cannot share: threads, sockets, child processes.
        seeds: A seed for each continuation. The same seed gives the same future, by either method. The simulation's
            ``reseed(seed)`` is called in each continuation, on the caller's side like ``state``. With
            ``global_rng=True`` the simulation's own global generators are seeded. While the function runs, the
            generators of the process are seeded, too: Python's, NumPy's and torch's. None: each continuation has the
            exact future of ``env``.
        time_limit: The time after which a forked continuation is ended, in seconds.

    Returns:
        The results of the function, in the order of the numbers.

    Raises:
        ResetNeededError: There is no episode to continue.
        BranchError: A forked continuation died, took too long, or returned something that cannot be pickled; it cannot
            go on with what the simulation has opened; a replay did not reach the same decision; or ``seeds`` are given
            without a ``reseed`` or ``global_rng=True``.
        OptionValueError: The method does not exist or is not available here, or ``seeds`` are not n non-negative
            integers.
        BaseException: Any exception of the function or ``reseed``, with a note that names the continuation.
    """
    view = _checked_view(env, "branch", method, time_limit)
    if isinstance(n, bool) or not isinstance(n, int) or n < 0:
        raise OptionValueError(f"n must be a non-negative integer, not {short_repr(n)}")
    if seeds is not None:
        listed = isinstance(seeds, (Sequence, np.ndarray))
        if not (listed and len(seeds) == n and all(map(is_seed, seeds))):
            raise OptionValueError(
                f"seeds must be n = {n} non-negative integers, one for each branch, not {short_repr(seeds)}"
            )
        view._session.check_reseed()
    depth = _depth.get() + 1
    if depth > DEEPEST:
        raise BranchError(
            f"branches are nested {DEEPEST} deep: a policy that branches its environment also decides in the branches,"
            " and branches them again; use action_values or RolloutPolicy, which let a base policy decide there"
        )
    if isinstance(view._session, ForkedSession):
        there = partial(branch, function=function, n=n, method=method, seeds=seeds, time_limit=time_limit)
        results: list[Result] = view._session.call(env, there, (), inf)
        return results

    def call(continuation: Any, number: int) -> Result:
        token = _depth.set(depth)
        try:
            twin = getattr(continuation, "unwrapped", continuation)
            twin._begin_branch()
            if seeds is not None:
                seed_globals(int(seeds[number]), PROCESS)
                twin._session.reseed(int(seeds[number]))
            return function(continuation, number)
        finally:
            _depth.reset(token)

    separate = _separator(view, method)
    if separate is not None:
        return _call_in_forks(partial(call, env), n, separate, time_limit)
    with reuse_resources():
        return [_call_in_replay(env, view, call, number) for number in range(n)]


def pending_view(env: Any, user: str) -> Any:
    """Return the unwrapped environment whose decision is pending, for a user named in errors."""
    view = getattr(env, "unwrapped", env)
    if not hasattr(view, "_begin_branch"):
        raise ViewError(f"{user} needs an environment of one simulation, not {short_repr(env)}")
    view._check_pending()
    return view


def _checked_view(env: Any, user: str, method: str | None, time_limit: float) -> Any:
    """Return the unwrapped environment whose decision is pending; check the arguments of a ``user`` of it."""
    view = pending_view(env, user)
    if method not in (None, "fork", "replay"):
        suggestion = did_you_mean(method, ["fork", "replay"])
        raise OptionValueError(f"method must be None, 'fork' or 'replay', not {short_repr(method)}{suggestion}")
    if method == "fork" and not (CAN_FORK and view.driver == "greenlet"):
        raise OptionValueError(
            'method="fork" needs Linux, and driver="greenlet": a forked process does not have the other threads; use'
            ' "replay"'
        )
    if not isinstance(time_limit, (int, float)) or not time_limit > 0:
        raise OptionValueError(f"time_limit must be a number of seconds, not {short_repr(time_limit)}")
    return view


def _separator(view: Any, method: str | None) -> Callable[[], None] | None:
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
            f"a forked process cannot continue with {', '.join(obstacles.values())} that the simulation has opened; use"
            ' method="replay"'
        )
    return None if obstacles else separator(loops)


def _forked(env: Any, view: Any, method: str | None, time_limit: float) -> ForkedSession | None:
    """Fork a process for a clone, and return its session; None if the episode must be replayed."""
    original = view._session
    if isinstance(original, ForkedSession):
        return None if method == "replay" else original.fork(method, time_limit)
    separate = _separator(view, method)
    if separate is None:
        return None
    return ForkedSession(original, Fork.begin(_Host(env, view).serve, separate), time_limit)


# -- branches: clones for one call ----------------------------------------------------------------


def _call_in_replay(env: Any, view: Any, function: Callable[[Any, int], Result], number: int) -> Result:
    """Call a function on a copy of an environment whose simulation repeats the episode."""
    with preserve_generators():  # the model may draw from the process's generators, then and now
        session = Session(view._session.plan)
        try:
            session.replay(view._session)
            twin = view._cloned(session)
            result = function(copy.deepcopy(env, {id(view): twin}), number)
        except BaseException as error:
            annotate(error, f"simenv_marl: in branch {number}")
            close_after(error, session.close, "the branch")
            raise
        twin.close()
        return result


def _call_in_forks(
    function: Callable[[int], Any], n: int, separate: Callable[[], None], time_limit: float
) -> list[Any]:
    """Call a function in forked processes, as many at a time as there are cores."""
    results: list[Any] = [None] * n
    running: dict[int, tuple[int, Fork, float]] = {}  # by descriptor: the number of the branch, its process and end
    cores = len(os.sched_getaffinity(0))
    started, waiting = 0, select.poll()

    def main(connection: socket.socket) -> None:
        message = pack_outcome(_pack_result, function, started)
        flush()
        send(connection, message)

    try:
        while started < n or running:
            while started < n and len(running) < cores:
                fork = Fork.begin(main, separate)
                descriptor = fork.connection.fileno()
                running[descriptor] = started, fork, time.monotonic() + time_limit
                waiting.register(descriptor, select.POLLIN)
                started += 1
            oldest, _, deadline = next(iter(running.values()))  # whose time limit comes first
            left = max(deadline - time.monotonic(), 0.0)
            ready = waiting.poll(min(left, 3600.0) * 1000)  # in parts, because the time limit may be infinite
            if not ready and left <= 3600.0:
                raise BranchError(f"branch {oldest} was stopped: it took longer than {time_limit} s")
            for descriptor, _ in ready:
                waiting.unregister(descriptor)
                number, fork, _ = running[descriptor]
                message = fork.receive()
                del running[descriptor]
                how = fork.end()
                if not message:
                    raise BranchError(f"branch {number} has died without a result, {how}")
                results[number] = _result(number, message)
    finally:
        for _, fork, _ in running.values():
            fork.end()
    return results


def _result(number: int, message: bytes) -> Any:
    """Unpack the result of a branch, or raise its exception."""
    error: BaseException | None
    try:
        result, error = unpack_outcome(message)
    except Exception as problem:  # not everything that can be pickled can be unpickled
        error = _unpicklable(problem)
        error.__cause__ = problem
    if error is None:
        return result
    if not isinstance(error, Exception):  # an exit or an interrupt must not be raised here
        raise BranchError(f"branch {number} has raised {describe_error(error)}") from error
    if type(error) is WorkerError:
        raise BranchError(f"branch {number}: {error}") from error.__cause__ or error.__context__
    annotate(error, f"simenv_marl: in branch {number}")
    raise error


def _pack_result(result: Any) -> bytes:
    try:
        return pack_plainly(result)
    except Exception as error:
        raise _unpicklable(error) from error


def _unpicklable(error: Exception) -> BranchError:
    return BranchError(f"it returned a value that cannot be pickled ({describe_error(error)})")


# -- the clone as this process has it --------------------------------------------------------------

_FIELDS: Final = ("observation", "reward", "info", "mask", "acted", "decided", "ended", "present", "consultations")
"""What views read of an agent."""

State = tuple[Any, ...]
"""What views read of an episode: see ``_state_of``."""


class Mirror(Episode):
    """The episode of a clone, as its view sees it: the agents, and what is pending, as of the latest reply."""

    __slots__ = ("remote",)

    def __init__(self, remote: ForkedSession, state: State) -> None:
        """Mirror a state that lists all agents."""
        nothing: Any = None
        self.remote, self.plan, self.seed = remote, remote.plan, remote.seed or 0
        self.simulation = self.driver = self.latest = self.consulted = self.script = nothing
        self.clock = None if state[5] is None else partial(getattr, remote, "time")
        self.agents, self.others, self.ended, self.entities = {}, {}, {}, {}
        self.running, self.skips = True, False
        *_, self.unreported_end, self.last_time = state
        self.load(state)

    def load(self, state: State) -> None:
        """Take over a state. What the view itself notes in an episode stays."""
        pending, self.over, self.terminated, self.truncated, self.turns, time, others, agents, ended, *_ = state
        self.remote.time = time
        for name, point, values in agents:
            agent = self.agents.get(name) or self.ended.get(name)
            if agent is None:
                agent = Agent(name, self.plan.points[point], self.plan, self.clock)
                (self.ended if values[6] else self.agents)[name] = agent
            for field, value in zip(_FIELDS, values, strict=True):
                setattr(agent, field, value)
        self.others.update(dict.fromkeys(others))
        for name in ended:
            self.ended[name] = self.agents.pop(name) if name in self.agents else self.ended[name]
        self.just_ended = [self.ended[name] for name in ended]
        self.pending = None if pending is None else self.agents[pending]

    def single_out(self, agent: Agent) -> None:
        """Do nothing: the clone's process has done it."""

    def step(self, action: Any, entered: bool = False) -> None:
        """Take a step in the clone's process."""
        if self.pending is None:
            self.report_end()
            return
        self.unreported_end = False
        self.remote.request("step", action)


class MirrorOfRounds(Mirror, Rounds):
    """The same for an episode that is played in rounds."""

    __slots__ = ()


class ForkedSession(Session):
    """The session of a clone in a forked process.

    Attributes:
        time: The simulation's time as of the latest reply; None if it has none.
    """

    __slots__ = ("_fork", "_gone", "_limit", "_made_from", "_renewed", "_stepped", "_warned", "time")

    def __init__(self, original: Session, fork: Fork, time_limit: float, made_from: Any = None) -> None:
        """Take over a process in which the episode of a session goes on; ``made_from``: its parent, a clone itself."""
        self.plan, self.bound_plan = original.plan, None
        self.state, self.options, self.seed = original.state, original.options, original.seed
        self.np_random_seed, self._np_random = original.np_random_seed, copy.deepcopy(original._np_random)
        self.exclusive = self.lock = ExclusiveLock()
        self._fork, self._limit, self._made_from = fork, time_limit, made_from
        self._gone: str | None = None  # why the process is gone
        self._renewed = self._stepped = self._warned = False
        self.episode = self.time = None

    def begin(self, view: Any) -> None:
        """Mirror the episode of the view that was cloned."""
        if view._solo:  # from now on, it waits for one agent only
            self.request("begin")
        else:
            self._mirror(*pickle.loads(_pack_state(view.episode, whole=True)[0]))

    def _mirror(self, in_rounds: bool, state: State) -> None:
        self.episode = (MirrorOfRounds if in_rounds else Mirror)(self, state)

    @property
    def simulation(self) -> Any:
        """Refuse it: it is in another process."""
        raise BranchError(
            "the simulation of a clone is in the clone's process; reach it with"
            " env.unwrapped.call(lambda env: env.unwrapped.simulation...), which returns a copy of the result"
        )

    # -- requests -----------------------------------------------------------------------------------

    def request(self, name: str, *args: Any, limit: float | None = None) -> Any:
        """Call a method of the clone's ``_Host`` in its process; mirror the episode afterwards; return the result.

        Raises:
            BranchError: The process has ended, or takes too long and is ended.
            BaseException: Any exception there, with its traceback as a note.
        """
        limit = self._limit if limit is None else limit
        with self.exclusive:
            if self._gone is not None or not self._fork.usable:
                raise BranchError(f"the clone is gone: {self._gone or 'it belongs to another process'}")
            message, reply = pack_plainly((name, args)), b""
            try:
                with suppress(ConnectionError):
                    self._fork.send(message)
                    if name == "fork":
                        return self._receive_fork(limit)
                    reply = self._fork.receive(time.monotonic() + limit)
                if not reply:
                    self._end("its process has died, ")
            except TimeoutError:
                self._end(f"it was ended, because it took longer than {limit} s; ")
            except BaseException:  # an interrupt: the reply would be taken for the next one
                self._end("it was ended by an interrupt; ")
                raise
            if not reply:
                raise BranchError(f"the clone is gone: {self._gone}")
            return self._unpack(name, reply)

    def _unpack(self, name: str, reply: bytes) -> Any:
        """Mirror the state in a reply; return its value, or raise its error."""
        value, error, state, left_out = pickle.loads(reply)
        if left_out and not self._warned:
            self._warned = True
            warn_user(f"infos of clones lack what cannot be pickled: {', '.join(left_out)}")
        whole = _MOVES.get(name)
        if state is not None:
            in_rounds, state = pickle.loads(state)
            if isinstance(self.episode, Mirror) and not whole:
                self.episode.load(state)
            else:
                self._mirror(in_rounds, state)
        elif whole is not None:
            self.episode = None
        if error is None:
            return None if value is None else unpack(value)
        raised = unpack_error(error)
        cause, raised.__cause__ = raised.__cause__, None
        annotate(raised, f"simenv_marl: in a clone, where it was raised by{cause}")
        raise raised

    def ask(self, name: str, *args: Any) -> Any:
        """Call a method of the simulation."""
        return self.request("ask", name, *args)

    def check_reseed(self) -> None:
        """Raise a ``BranchError`` unless the simulation's future random numbers can be drawn anew."""
        self.request("check_reseed")

    def reseed(self, seed: int) -> None:
        """Draw the simulation's future random numbers anew, and those of the clone's process."""
        self.request("reseed", seed)

    def step_out(self) -> None:
        """Do nothing: the clone's process has done it."""

    def recording(self) -> Any:
        """Return what a replay of the episode needs."""
        return self.request("recording")

    def call(self, env: Any, function: Callable[..., Any], args: tuple[Any, ...], limit: float | None = None) -> Any:
        """Call a function in the clone's process, with the environment there in the state that it has here."""
        view, episode, parcel = env.unwrapped, self.episode, None
        noted = None if episode is None else (episode.unreported_end, episode.last_time)
        try:
            parcel = _pack_env(env, [view], self)
        except Exception as error:
            if self._stepped or env is not view._outermost():
                raise BranchError(
                    f"the wrappers of the clone cannot be sent to its process ({describe_error(error)}); call functions"
                    " before its first step"
                ) from error
        self._renewed = True  # the function may reset the environment
        result, parcel = self.request("call", pack((function, args)), parcel, noted, limit=limit)
        if parcel is not None:
            layers = _layers(env)
            for layer, state in zip(layers, _unpack_env(parcel, layers, self), strict=False):
                vars(layer).clear()
                vars(layer).update(state)
        view._set_up()  # there may be another episode
        return result

    # -- episodes -----------------------------------------------------------------------------------

    def start(
        self, seed: int | None, options: dict[str, Any] | None, *, in_rounds: bool = False, script: Any = None
    ) -> Episode:
        """Reset the simulation in the clone's process."""
        self.options, self.seed = options, self.seed_for(seed)
        self.episode, self.state = None, "over"
        self._renewed = self._stepped = True
        self.request("start", self.seed, options, in_rounds)
        episode: Any = self.episode
        return episode  # type: ignore[no-any-return]

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
            if self._renewed and self._gone is None and self._fork.usable:
                self.request("close")
        finally:
            self.episode, self.state = None, "closed"
            self._end("it is closed; ")

    def abandon(self) -> None:
        """Close it, from a finalizer."""
        try:
            self.close()
        except Exception as error:
            warn_user(f"a clone that was abandoned raised {short_repr(error)}", ResourceWarning)

    def _end(self, why: str) -> None:
        """End the process, for a reason."""
        self.episode = None
        if self._gone is None:
            self._gone = why + self._fork.end()
            if self._made_from is not None:
                with suppress(Exception):  # the parent may be gone, or busy; then it waits later
                    self._made_from.request("reap", self._fork.process)

    # -- clones of clones ---------------------------------------------------------------------------

    def fork(self, method: str | None, time_limit: float) -> ForkedSession | None:
        """Fork the clone's process; return the session of the new one, or None if the episode must be replayed."""
        fork = self.request("fork", method)
        if fork is None:
            return None
        made = ForkedSession(self, fork, time_limit, self)
        made._stepped = self._stepped
        return made

    def _receive_fork(self, limit: float) -> Fork | None:
        """Receive the connection of a fork of the clone's process, before the reply."""
        connection = self._fork.connection
        connection.settimeout(limit)
        _, descriptors, _, _ = socket.recv_fds(connection, 1, 1)
        try:
            process = self._unpack("fork", self._fork.receive(time.monotonic() + limit))
        except BaseException:
            for descriptor in descriptors:
                os.close(descriptor)
            raise
        return Fork(process, socket.socket(fileno=descriptors[0])) if descriptors else None


# -- the clone's process ---------------------------------------------------------------------------

_MOVES: Final = {"step": False, "begin": True, "start": True, "call": True}
"""The requests after which the state of the episode is sent, and whether all of it is."""


class _Host:
    """The environment in the process of a clone. Its methods answer the requests of ``ForkedSession``."""

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
        """Do what a request asks for; return the reply: a value, or an error, and the state of the episode."""
        value = error = state = None
        left_out: list[str] = []
        try:
            value = getattr(self, name)(*args)
            value = None if value is None else pack_plainly(value)
        except BaseException as problem:
            value, error = None, pack_error(problem)
        episode = self._session.episode
        whole = _MOVES.get(name)
        if whole is not None and episode is not None:
            state, left_out = _pack_state(episode, whole=whole)
            if not episode.in_rounds:
                episode.just_ended = []  # the view in the other process reports them
        flush()
        return pickle.dumps((value, error, state, left_out), 5)

    def _fork(self, connection: socket.socket, method: str | None) -> socket.socket:
        """Fork this process. Send the connection of the new one; return the connection to serve from now on."""
        here = there = None
        process: int | None = None
        try:
            separate = _separator(self._view, method)
            if separate is not None:
                here, there = pair()
                process = start(there, lives_above(), separate)
                if process == 0:
                    here.close()
                    return there
            reply = pickle.dumps((pack_plainly(process), None, None, []))
        except Exception as error:
            reply = pickle.dumps((None, pack_error(error), None, []))
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

    def ask(self, name: str, *args: Any) -> Any:
        """Call a method of the simulation."""
        return self._session.ask(name, *args)

    def check_reseed(self) -> None:
        """Check that there is a way to reseed."""
        self._session.check_reseed()

    def reseed(self, seed: int) -> None:
        """Draw what lies ahead anew."""
        seed_globals(seed, PROCESS)
        self._session.reseed(seed)

    def recording(self) -> Any:
        """Return what a replay needs."""
        return self._session.recording()

    def call(self, function: bytes, parcel: bytes | None, noted: Any) -> Any:
        """Call a function with the environment, in the state that it has in the other process; return both."""
        env, session = self._env, self._session
        if parcel is not None:
            env = _unpack_env(parcel, [self._view], session)
        episode = session.episode
        if episode is not None and noted is not None:
            episode.unreported_end, episode.last_time = noted
        called, args = unpack(function)
        token = _depth.set(_depth.get() + 1)
        try:
            result = called(env, *args)
        finally:
            _depth.reset(token)
        if parcel is not None:
            layers = _layers(env)
            parcel = _pack_env([*map(vars, layers[:-1])], layers, session)
        return result, parcel

    def close(self) -> None:
        """Unwind and close the simulation."""
        self._session.close()

    def reap(self, process: int) -> None:
        """Wait for the end of a fork that was killed."""
        with suppress(ChildProcessError):
            os.waitpid(process, 0)


def _state_of(episode: Episode, *, whole: bool) -> State:
    """Return what views read of an episode; without the agents that have not changed, unless it is the ``whole``."""
    agents, plan, pending = [*episode.just_ended], episode.plan, episode.pending
    if whole:
        agents = [*episode.ended.values(), *episode.agents.values()]
    elif episode.over or episode.in_rounds:
        agents += episode.agents.values()
    elif pending is not None:
        agents.append(pending)
    return (
        None if pending is None else pending.name,
        episode.over,
        episode.terminated,
        episode.truncated,
        episode.turns,
        None if episode.clock is None else float(episode.clock()),
        list(episode.others) if whole else (),
        [(a.name, plan.points.index(a.point), _fields(a)) for a in agents],
        [agent.name for agent in episode.just_ended],
        episode.unreported_end,
        episode.last_time,
    )


def _fields(agent: Agent) -> tuple[Any, ...]:
    seen = agent.observation, agent.reward, dict(agent.info), agent.mask
    return *seen, agent.acted, agent.decided, agent.ended, agent.present, agent.consultations


def _pack_state(episode: Episode, *, whole: bool) -> tuple[bytes, list[str]]:
    """Pickle whether an episode is played in rounds, and its state; return also the keys that infos had to lose."""
    state = episode.in_rounds, _state_of(episode, whole=whole)
    left_out: dict[str, None] = {}
    try:
        return pickle.dumps(state, 5), []
    except Exception:
        for _, _, (_, _, info, *_) in state[1][7]:
            for key in [key for key, value in info.items() if not _can_be_pickled(value)]:
                del info[key]
                left_out[repr(key)] = None
        return pickle.dumps(state, 5), list(left_out)


def _can_be_pickled(value: Any) -> bool:
    try:
        pickle.dumps(value, 5)
    except Exception:
        return False
    return True


# -- environments that are sent --------------------------------------------------------------------


class _EnvPickler(Pickler):
    """A pickler for the wrappers of an environment, which the other process has as well."""

    def __init__(self, buffer: io.BytesIO, shared: dict[int, int]) -> None:
        super().__init__(buffer, 5)
        self._shared = shared

    def persistent_id(self, thing: Any) -> int | None:
        """Return the place of what the other process has."""
        return self._shared.get(id(thing))


def _layers(env: Any) -> list[Any]:
    """List an environment and all that it wraps, with the view as the last."""
    layers, view = [env], env.unwrapped
    while layers[-1] is not view:
        parts = vars(layers[-1]).values()
        layers.append(next(part for part in parts if part is view or getattr(part, "unwrapped", None) is view))
    return layers


def _pack_env(part: Any, layers: list[Any], session: Session) -> bytes:
    """Pickle a part of an environment, with the state of its view, the last of the layers, and of the session."""
    buffer = io.BytesIO()
    shared = {id(layer): place for place, layer in enumerate(layers)}
    _EnvPickler(buffer, shared).dump((part, layers[-1]._state(), session.snapshot()))
    return buffer.getvalue()


def _unpack_env(parcel: bytes, layers: list[Any], session: Session) -> Any:
    """Give the view and the session their states in a parcel; return the part."""
    unpickler: Any = pickle.Unpickler(io.BytesIO(parcel))
    unpickler.persistent_load = layers.__getitem__
    part, state, snapshot = unpickler.load()
    vars(layers[-1]).update(state)
    session.restore(snapshot)
    return part
