"""Exact continuations of an episode, for planning, counterfactuals and studies of variance."""

import copy
import os
import pickle
import select
import signal
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from contextvars import ContextVar
from functools import partial
from typing import Any, Final, NamedTuple, TypeVar

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
)
from .forking import end_with, loops_on, separator, sockets_of
from .packing import pack_error, pack_plainly, unpack, unpack_error
from .reuse import reuse_resources
from .rng import is_seed, process_kept, seed_process

Result = TypeVar("Result")

DEEPEST: Final = 4
"""The largest depth of nested branches. Each level can run as many branches as there are cores."""

_depth: ContextVar[int] = ContextVar("simenv_marl.core.branching", default=0)
"""The depth of this branch."""


def branch(
    env: Any,
    function: Callable[[Any, int], Result],
    n: int = 1,
    *,
    method: str | None = None,
    seeds: Sequence[int] | None = None,
    time_limit: float = 600.0,
) -> list[Result]:
    """Call a function on exact continuations of an environment in mid-episode.

    Each continuation starts in exactly the state of ``env``: the model and its random numbers, the environment's
    generators, and its wrappers. Continuations that take the same actions are identical, bit for bit. ``env`` itself
    does not move. With ``seeds``, the continuations share the present state but draw different random numbers from then
    on.

    Args:
        env: An environment of a single simulation, in any view, with or without wrappers.
        function: Called with the continuation and its number, from 0 to ``n - 1``. It may do anything with it.
        n: The number of continuations.
        method: "fork": each continuation runs in a forked process, with its own open files and global generators
            (POSIX, and ``driver="greenlet"``), on all available cores. The results are pickled. "replay": the
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
    view = pending_view(env, "branch")
    can_fork = hasattr(os, "fork") and view._session.plan.options.driver == "greenlet"
    _check(n, method, seeds, time_limit, can_fork=can_fork)
    if seeds is not None:
        view._session.check_reseed()
    depth = _depth.get() + 1
    if depth > DEEPEST:
        raise BranchError(
            f"branches are nested {DEEPEST} deep: a policy that branches its environment also decides in the branches,"
            " and branches them again; use action_values or RolloutPolicy, which let a base policy decide there"
        )

    forks = can_fork and method != "replay"
    obstacles: dict[Any, str] = view._session.open_resources() if forks else {}
    loops = loops_on(obstacles) if obstacles else []
    for number in [number for loop in loops for number in sockets_of(loop)]:
        obstacles.pop(number, None)
    if obstacles and method == "fork":
        raise BranchError(
            f"a forked process cannot continue with {', '.join(obstacles.values())} that the simulation has opened; use"
            ' method="replay"'
        )
    separate = separator(loops) if forks and not obstacles else None

    def call(continuation: Any, number: int) -> Result:
        token = _depth.set(depth)
        try:
            if separate is not None:
                separate()
            twin = getattr(continuation, "unwrapped", continuation)
            twin.begin_branch()
            if seeds is not None:
                seed_process(int(seeds[number]))
                twin._session.reseed(int(seeds[number]))
            return function(continuation, number)
        finally:
            _depth.reset(token)

    if separate is not None:
        return _call_in_forks(partial(call, env), n, time_limit)
    with reuse_resources():
        return [_call_in_replay(env, view, call, number) for number in range(n)]


def pending_view(env: Any, user: str) -> Any:
    """Return the unwrapped environment whose decision is pending, for a user named in errors."""
    view = getattr(env, "unwrapped", env)
    if not hasattr(view, "begin_branch"):
        raise ViewError(f"{user} needs an environment of one simulation, not {short_repr(env)}")
    view.check_pending()
    return view


def _check(n: Any, method: Any, seeds: Any, time_limit: Any, *, can_fork: bool) -> None:
    """Check the arguments of ``branch``."""
    if isinstance(n, bool) or not isinstance(n, int) or n < 0:
        raise OptionValueError(f"n must be a non-negative integer, not {short_repr(n)}")
    if method not in (None, "fork", "replay"):
        suggestion = did_you_mean(method, ["fork", "replay"])
        raise OptionValueError(f"method must be None, 'fork' or 'replay', not {short_repr(method)}{suggestion}")
    if method == "fork" and not can_fork:
        raise OptionValueError(
            'method="fork" needs a platform that can fork, and driver="greenlet": a forked process does not have the'
            ' other threads; use "replay"'
        )
    if not isinstance(time_limit, (int, float)) or not time_limit > 0:
        raise OptionValueError(f"time_limit must be a number of seconds, not {short_repr(time_limit)}")
    listed = isinstance(seeds, (Sequence, np.ndarray))
    if seeds is not None and not (listed and len(seeds) == n and all(map(is_seed, seeds))):
        raise OptionValueError(
            f"seeds must be n = {n} non-negative integers, one for each branch, not {short_repr(seeds)}"
        )


# -- by replaying ---------------------------------------------------------------------------------


def _call_in_replay(env: Any, view: Any, function: Callable[[Any, int], Result], number: int) -> Result:
    """Call a function on a copy of an environment whose simulation repeats the episode."""
    with process_kept():  # the model may draw from the process's generators, then and now
        twin = view.replayed()
        try:
            result = function(copy.deepcopy(env, {id(view): twin}), number)  # copies each wrapper with its state
        except BaseException as error:
            annotate(error, f"simenv_marl: in branch {number}")
            close_after(error, twin.close, "the branch")
            raise
        twin.close()
        return result


# -- by forking -----------------------------------------------------------------------------------


class _Child(NamedTuple):
    """A forked process with a continuation, as its parent sees it."""

    number: int
    process: int
    pipe: int
    deadline: float

    def result(self) -> Any:
        """Receive the result of the function, or raise its exception; wait for the process to end."""
        message = b"".join(iter(partial(os.read, self.pipe, 1 << 16), b""))
        os.close(self.pipe)
        code = os.waitstatus_to_exitcode(os.waitpid(self.process, 0)[1])
        if not message:
            how = f"killed by signal {-code}" if code < 0 else f"with exit code {code}"
            raise BranchError(f"branch {self.number} has died without a result, {how}")
        returned, parcel = pickle.loads(message)
        try:
            if returned:
                return unpack(parcel)
            error = unpack_error(parcel)
        except Exception as problem:  # not everything that can be pickled can be unpickled
            error = _unpicklable(problem)
            error.__cause__ = problem
        if not isinstance(error, Exception):  # an exit or an interrupt must not be raised here
            raise BranchError(f"branch {self.number} has raised {describe_error(error)}") from error
        if type(error) is WorkerError:
            raise BranchError(f"branch {self.number}: {error}") from error.__cause__ or error.__context__
        annotate(error, f"simenv_marl: in branch {self.number}")
        raise error


def _call_in_forks(function: Callable[[int], Any], n: int, time_limit: float) -> list[Any]:
    """Call a function in forked processes, as many at a time as there are cores."""
    results: list[Any] = [None] * n
    children: dict[int, _Child] = {}  # by their pipes
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    started, waiting = 0, select.poll()
    try:
        while started < n or children:
            while started < n and len(children) < cores:
                child = _fork(function, started, list(children), time.monotonic() + time_limit)
                children[child.pipe] = child
                waiting.register(child.pipe, select.POLLIN)
                started += 1
            oldest = next(iter(children.values()))  # whose time limit comes first
            left = max(oldest.deadline - time.monotonic(), 0.0)
            ready = waiting.poll(min(left, 3600.0) * 1000)  # in parts, because the time limit may be infinite
            if not ready and left <= 3600.0:
                raise BranchError(f"branch {oldest.number} was stopped: it took longer than {time_limit} s")
            for pipe, _ in ready:
                waiting.unregister(pipe)
                child = children.pop(pipe)
                results[child.number] = child.result()
    finally:
        for child in children.values():
            os.close(child.pipe)
            os.kill(child.process, signal.SIGKILL)
            os.waitpid(child.process, 0)
    return results


def _fork(function: Callable[[int], Any], number: int, others: list[int], deadline: float) -> _Child:
    """Fork a process that calls the function and sends the result."""
    _flush()  # else both processes would write what is buffered
    parent = os.getpid()
    reading, writing = os.pipe()
    # Python 3.12 warns because the child never releases locks that other threads hold.
    with warnings.catch_warnings(action="ignore") if sys.version_info >= (3, 12) else nullcontext():
        process = os.fork()
    if process == 0:
        try:
            end_with(parent)
            for pipe in (reading, *others):
                os.close(pipe)
            message = _message(function, number)
            while message:
                message = message[os.write(writing, message) :]
        finally:
            os._exit(0)  # without any of the parent's exit handlers
    os.close(writing)
    return _Child(number, process, reading, deadline)


def _message(function: Callable[[int], Any], number: int) -> bytes:
    """In the forked process, call the function; pickle its result or its error."""
    try:
        result = function(number)
        try:
            parcel = pack_plainly(result)
        except Exception as error:
            raise _unpicklable(error) from error
        return pickle.dumps((True, parcel))
    except BaseException as error:
        return pickle.dumps((False, pack_error(error)))
    finally:
        _flush()


def _unpicklable(error: Exception) -> BranchError:
    return BranchError(f"it returned a value that cannot be pickled ({describe_error(error)})")


def _flush() -> None:
    """Write out what the standard streams have buffered."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(Exception):
            stream.flush()
