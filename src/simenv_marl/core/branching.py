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
from contextlib import AbstractContextManager, nullcontext, suppress
from contextvars import ContextVar
from typing import Any, Final, NoReturn, TypeVar

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
from .forking import Standing, end_with
from .packing import pack_error, pack_plainly, unpack, unpack_error
from .reuse import reuse_resources
from .rng import is_seed, process_kept, seed_process

Result = TypeVar("Result")

METHODS: Final = ("fork", "replay")

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
        method: "fork": each continuation runs in a process of its own, forked while the simulation is suspended (POSIX,
            and ``driver="greenlet"``). It has its own open files and global generators. Processes run on all available
            cores, and their results are pickled. "replay": the continuations run one after the other in this process.
            Each is a new simulation with the same seed, to which the same actions are given. The policies of the option
            ``policies`` repeat their answers, and are called from the present on. None: "fork" if it is possible, else
            "replay". Forking is not possible if the simulation has opened something that two processes cannot share:
            threads, sockets, child processes.
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
    view = _checked(env, n, method, time_limit)
    forks = _can_fork(view)
    if seeds is not None:
        view.check_reseed()
        function = _in_other_futures(function, _checked_seeds(seeds, n))
    obstacles, loops = view.opened() if forks and method != "replay" else ([], [])
    if obstacles and method == "fork":
        raise BranchError(
            f"a forked process cannot continue with {', '.join(obstacles)} that the simulation has opened; use"
            ' method="replay"'
        )
    if obstacles or not forks or method == "replay":
        with reuse_resources():
            return [_replayed(env, view, function, number) for number in range(n)]
    return _forked(env, _standing_alike(function, Standing(loops)), n, time_limit)


def _checked(env: Any, n: Any, method: Any, time_limit: Any) -> Any:
    """Return the unwrapped environment to continue.

    Raises:
        SimEnvError: As ``branch``.
    """
    view = getattr(env, "unwrapped", env)
    if not hasattr(view, "begin_branch"):
        raise ViewError(f"branch needs an environment of one simulation, not {short_repr(env)}")
    if isinstance(n, bool) or not isinstance(n, int) or n < 0:
        raise OptionValueError(f"n must be a non-negative integer, not {short_repr(n)}")
    if method not in (None, *METHODS):
        raise OptionValueError(
            f"method must be None or one of {', '.join(map(repr, METHODS))}, not {short_repr(method)}"
            f"{did_you_mean(method, METHODS)}"
        )
    if method == "fork" and not _can_fork(view):
        raise OptionValueError(
            'method="fork" needs a platform that can fork, and driver="greenlet": a forked process does not have the'
            ' other threads; use "replay"'
        )
    if not isinstance(time_limit, (int, float)) or not time_limit > 0:
        raise OptionValueError(f"time_limit must be a number of seconds, not {short_repr(time_limit)}")
    view.check_pending()
    if _depth.get() == DEEPEST:
        raise BranchError(
            f"branches are nested {DEEPEST} deep: a policy that branches its environment also decides in the branches,"
            " and branches them again; use action_values or RolloutPolicy, which let a base policy decide there"
        )
    return view


def _can_fork(view: Any) -> bool:
    return hasattr(os, "fork") and view.driver == "greenlet"


# -- other futures --------------------------------------------------------------------------------


def _checked_seeds(seeds: Any, n: int) -> list[int]:
    """Return the seeds as Python integers.

    Raises:
        OptionValueError: They are not n non-negative integers.
    """
    given: list[Any] = list(seeds) if isinstance(seeds, (Sequence, np.ndarray)) else [None]
    if len(given) != n or not all(map(is_seed, given)):
        raise OptionValueError(
            f"seeds must be n = {n} non-negative integers, one for each branch, not {short_repr(seeds)}"
        )
    return [int(seed) for seed in given]


def _in_other_futures(function: Callable[[Any, int], Result], seeds: list[int]) -> Callable[[Any, int], Result]:
    """Return a function that reseeds its continuation first."""

    def reseed_and_call(env: Any, number: int) -> Result:
        seed_process(seeds[number])
        getattr(env, "unwrapped", env).reseed(seeds[number])
        return function(env, number)

    return reseed_and_call


# -- by replaying ---------------------------------------------------------------------------------


def _replayed(env: Any, view: Any, function: Callable[[Any, int], Result], number: int) -> Result:
    deeper = _depth.set(_depth.get() + 1)
    try:
        with process_kept():  # the model may draw from the process's generators, then and now
            return _run_replayed(env, view, function, number)
    finally:
        _depth.reset(deeper)


def _run_replayed(env: Any, view: Any, function: Callable[[Any, int], Result], number: int) -> Result:
    twin = view.replayed()
    try:
        twin.begin_branch()
        # Each wrapper is copied with its state.
        result = function(copy.deepcopy(env, {id(view): twin}), number)
    except BaseException as error:
        annotate(error, f"simenv_marl: in branch {number}")
        close_after(error, twin.close, "the branch")
        raise
    twin.close()
    return result


# -- by forking -----------------------------------------------------------------------------------


_A_WHILE: Final = 3600.0
"""The longest wait at once, in seconds: ``poll`` takes no more than some weeks, and a time limit may be infinite."""


class _Child:
    """A forked process with a continuation, as its parent sees it."""

    def __init__(self, number: int, process: int, pipe: int, time_limit: float) -> None:
        self.number, self.process, self.pipe = number, process, pipe
        self.deadline = time.monotonic() + time_limit
        self.received = bytearray()

    def end(self) -> None:
        """End the process."""
        os.close(self.pipe)
        os.kill(self.process, signal.SIGKILL)
        os.waitpid(self.process, 0)


def _standing_alike(function: Callable[[Any, int], Result], standing: Standing) -> Callable[[Any, int], Result]:
    """Return a function for forked processes that first restores what the process shares with its parent."""

    def resume_and_call(env: Any, number: int) -> Result:
        standing.resume()
        getattr(env, "unwrapped", env).begin_branch()
        _depth.set(_depth.get() + 1)
        return function(env, number)

    return resume_and_call


def _forked(env: Any, function: Callable[[Any, int], Any], n: int, time_limit: float) -> list[Any]:
    results: list[Any] = [None] * n
    children: dict[int, _Child] = {}
    at_once = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    started, waiting = 0, select.poll()
    try:
        while started < n or children:
            while started < n and len(children) < at_once:
                child = _fork(env, function, started, list(children), time_limit)
                children[child.pipe] = child
                waiting.register(child.pipe, select.POLLIN)
                started += 1
            first = next(iter(children.values()))  # the oldest, whose time limit comes first
            left = first.deadline - time.monotonic()
            ready = waiting.poll(min(max(left, 0.0), _A_WHILE) * 1000)
            if not ready and left <= _A_WHILE:
                raise BranchError(f"branch {first.number} was stopped: it took longer than {time_limit} s")
            for pipe, _ in ready:
                child = children[pipe]
                chunk = os.read(pipe, 1 << 16)
                child.received += chunk
                if not chunk:
                    waiting.unregister(pipe)
                    del children[pipe]
                    results[child.number] = _result(child)
    finally:
        for child in children.values():
            child.end()
    return results


def _fork(env: Any, function: Callable[[Any, int], Any], number: int, pipes: list[int], time_limit: float) -> _Child:
    for stream in (sys.stdout, sys.stderr):
        with suppress(Exception):  # else both processes would write what is buffered
            stream.flush()
    parent = os.getpid()
    reading, writing = os.pipe()
    with _unwarned():
        process = os.fork()
    if process == 0:
        end_with(parent)
        _be_child(env, function, number, [reading, *pipes], writing)
    os.close(writing)
    return _Child(number, process, reading, time_limit)


def _unwarned() -> AbstractContextManager[Any]:
    """Suppress the warning about a fork beside threads.

    Python 3.12 and later warns because the child never releases locks that threads hold. The child only runs the
    function, and has a time limit.
    """
    if sys.version_info < (3, 12):
        return nullcontext()
    return warnings.catch_warnings(action="ignore", category=DeprecationWarning)


def _be_child(env: Any, function: Callable[[Any, int], Any], number: int, others: list[int], pipe: int) -> NoReturn:
    """Send the answer, and end without any of the parent's exit handlers."""
    try:
        for other in others:
            os.close(other)
        torch = sys.modules.get("torch")
        if torch is not None:
            torch.set_num_threads(1)  # its threads do not exist in the child, and torch would wait for them
        try:
            message = pickle.dumps((True, _answer(function(env, number))))
        except BaseException as error:
            message = pickle.dumps((False, pack_error(error)))
        for stream in (sys.stdout, sys.stderr):
            with suppress(Exception):
                stream.flush()
        while message:
            message = message[os.write(pipe, message) :]
    finally:
        os._exit(0)


def _answer(value: Any) -> bytes:
    try:
        return pack_plainly(value)
    except Exception as error:
        raise _unpicklable(error) from error


def _unpicklable(error: Exception) -> BranchError:
    return BranchError(f"it returned a value that cannot be pickled ({describe_error(error)})")


def _result(child: _Child) -> Any:
    """Return the answer of a child that has ended."""
    number = child.number
    os.close(child.pipe)
    status = os.waitpid(child.process, 0)[1]
    if not child.received:
        code = os.waitstatus_to_exitcode(status)
        how = f"killed by signal {-code}" if code < 0 else f"with exit code {code}"
        raise BranchError(f"branch {number} has died without a result, {how}")
    answered, parcel = pickle.loads(child.received)
    if answered:
        try:
            return unpack(parcel)
        except Exception as problem:  # not everything that can be pickled can be unpickled
            error: BaseException = _unpicklable(problem)
            error.__cause__ = problem
    else:
        error = unpack_error(parcel)
    if not isinstance(error, Exception):  # an exit or an interrupt must not be raised here
        raise BranchError(f"branch {number} has raised {describe_error(error)}") from error
    if type(error) is WorkerError:
        raise BranchError(f"branch {number}: {error}") from error.__cause__ or error.__context__
    annotate(error, f"simenv_marl: in branch {number}")
    raise error
