"""Live branches: copies of an environment in mid-episode, and exact continuations.

A clone lives in a forked process, where the view, the episode and the simulation are as they were.
In this process there is a view of the same kind, whose session passes resets and steps on, and
whose episode mirrors the one there. Wrappers, spaces and the generator of seeds live here.

Where a process cannot be forked, a clone is an environment of this process that repeats the
episode.
"""

from __future__ import annotations

import copy
import os
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from contextvars import ContextVar
from functools import partial
from itertools import islice
from multiprocessing.connection import Connection, wait
from typing import Any, Final, TypeVar

import numpy as np

from ...errors import (
    BranchError,
    OptionValueError,
    ViewError,
    annotate,
    close_after,
    describe_error,
    did_you_mean,
    short_repr,
)
from ..episodes.base import checked_seed
from ..episodes.session import Session
from ..plans.policies import Where
from ..switching.context import preserve_generators
from ..switching.generators import PROCESS, is_seed, seed_globals
from ..switching.resources import reuse_resources
from .forks import CAN_FORK, PATIENCE, STUCK, Fork
from .packing import pack_checked, unpack, unpack_outcome
from .peer import PeerLostError
from .remote import Host, RemoteSession
from .separation import separator_of

DEEPEST: Final = 4
"""The largest depth of nested branches. Each level can run as many branches as there are cores."""

DEPTH: Final[ContextVar[int]] = ContextVar("simenv_marl.branch", default=0)
"""The depth of this branch."""

Result = TypeVar("Result")
EnvType = TypeVar("EnvType")


def clone(
    env: EnvType, *, seed: int | None = None, method: str | None = None, time_limit: float = 600.0
) -> EnvType:
    """Copy an environment in mid-episode. The copy stands at the same decision.

    Neither sees the other. What the copy does with the same actions is identical, bit for bit. It
    is an environment of the same view with the same wrappers, and can be stepped, reset, rendered,
    cloned and closed like any other. A clone that is never stepped is a checkpoint: clones of it
    rewind.

    ``clone(env).unwrapped.call(function, *args)`` calls ``function(environment, *args)`` where the
    clone lives, and returns a copy of the result. The function may do anything with the
    environment. ``unwrapped.simulation`` exists only there.

    A clone ends when it is closed or collected, and with the user's process. Then, and at a reset,
    a forked clone does not unwind or close the episode of its original; a replayed one has
    an episode for itself, and does.

    Args:
        env: An environment of a single simulation, in any view, with or without wrappers; also
            another clone.
        seed: A seed for the random numbers that lie ahead, as ``branch`` takes one for each branch.
            None: the clone has the exact future of ``env``.
        method: "fork": the clone lives in a forked process (Linux, and ``driver="greenlet"``).
            "replay": it is an environment of this process, whose simulation repeats the episode
            from its seed and the actions. None: "fork" if it is possible, else "replay", as in
            ``branch``.
        time_limit: The time that an operation of a forked clone may take, in seconds.

    Raises:
        ResetNeededError: No decision is pending.
        BranchError: It cannot be cloned by this method, or by any; there are no more processes or
            descriptors; or a ``seed`` is given without a ``reseed`` or ``global_rng=True``. Later:
            its process has died, or an operation took too long.
        OptionValueError: An argument has an invalid value.
        BaseException: Any exception of ``reseed``.
    """
    view = _checked_view(env, "clone", method, time_limit)
    original: Session | RemoteSession = view.session
    if seed is not None:
        seed = checked_seed(seed)
        original.check_reseed()
    fork: Fork | None = None
    if isinstance(original, RemoteSession):
        fork = original.fork(method, time_limit)
    else:
        separate = separator_of(original.episode, method)
        if separate is not None:
            host = Host(view)
            fork = Fork.begin(host, partial(host.begin, separate), time_limit)
    session = Session(original.plan) if fork is None else RemoteSession(original, fork)
    try:
        if isinstance(session, Session):
            with preserve_generators():  # because the model may draw from these
                session.replay(original)
        twin = view.cloned(session)
        twin.begin_branch()
        made = copy.deepcopy(env, {id(view): twin})  # copies each wrapper with its state
        if seed is not None:
            session.reseed(seed)
    except BaseException as error:
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
    """Call a function on ``n`` exact continuations of an environment in mid-episode.

    Each continuation starts in exactly the state of ``env``: the model and its random numbers, the
    environment's generators, and its wrappers. Continuations that take the same actions are
    identical, bit for bit. ``env`` itself does not move. With ``seeds``, the continuations share
    the present state but draw different random numbers from then on.

    Args:
        env: An environment of a single simulation, in any view, with or without wrappers; also a
            clone.
        function: Called with the continuation and its number, from 0 to ``n - 1``. It may do
            anything with it.
        n: The number of continuations.
        method: "fork": each continuation runs in a forked process, with its own open files and
            global generators (Linux, and ``driver="greenlet"``), on all available cores. The
            results are pickled. "replay": the continuations run one after the other in this
            process. Each is a new simulation with the same seed, to which the same actions are
            given. The policies of the option ``policies`` repeat their answers, and are called from
            the present on. None: "fork" if it is possible, else "replay". Forking is not possible
            if the simulation has opened something that two processes cannot share: threads,
            sockets, child processes.
        seeds: A seed for each continuation. The same seed gives the same future, by either method.
            The simulation's ``reseed(seed)`` is called in each continuation, on the caller's side
            like ``state``. With ``global_rng=True`` the simulation's own global generators are
            seeded. While the function runs, the generators of the process are seeded, too:
            Python's, NumPy's and torch's. None: each continuation has the exact future of ``env``.
        time_limit: The time after which a forked continuation is ended, in seconds.

    Returns:
        The results of the function, in the order of the numbers.

    Raises:
        ResetNeededError: There is no episode to continue.
        BranchError: A forked continuation died, took too long, or returned something that cannot be
            pickled; it cannot go on with what the simulation has opened; a replay did not reach the
            same decision; or ``seeds`` are given without a ``reseed`` or ``global_rng=True``.
        OptionValueError: The method does not exist or is not available here, or ``seeds`` are not n
            non-negative integers.
        BaseException: Any exception of the function or ``reseed``, with a note that names the
            continuation.
    """
    view = _checked_view(env, "branch", method, time_limit)
    if not is_seed(n):
        raise OptionValueError(f"n must be a non-negative integer, not {short_repr(n)}")
    if seeds is not None:
        _check_seeds(seeds, n)
        view.session.check_reseed()
    if DEPTH.get() == DEEPEST:
        raise BranchError(
            f"branches are nested {DEEPEST} deep: a policy that branches its environment also"
            " decides in the branches, and branches them again; use action_values or RolloutPolicy,"
            " which let a base policy decide there"
        )
    is_remote = isinstance(view.session, RemoteSession)
    if is_remote and env is view:
        branch_there = partial(
            branch, function=function, n=n, method=method, seeds=seeds, time_limit=time_limit
        )
        results: list[Result] = view.call(branch_there)
        return results
    call = partial(_call_deeper, function, seeds)
    if not is_remote:  # otherwise, the wrappers are in this process
        separate = separator_of(view.session.episode, method)
        if separate is not None:
            return _call_in_forks(partial(call, env), n, separate, time_limit)
        method = "replay"
    with reuse_resources():
        return [_call_on_clone(env, call, number, method) for number in range(n)]


def pending_view(env: Any, user: str) -> Any:
    """Return the unwrapped environment whose decision is pending, for a user named in errors."""
    view = getattr(env, "unwrapped", env)
    if not hasattr(view, "begin_branch"):
        raise ViewError(f"{user} needs an environment of one simulation, not {short_repr(env)}")
    view.check_pending()
    return view


def _checked_view(env: Any, user: str, method: str | None, time_limit: float) -> Any:
    """Check the arguments of a ``user`` of an environment; return the unwrapped environment."""
    view = pending_view(env, user)
    if method not in (None, "fork", "replay"):
        raise OptionValueError(
            f"method must be None, 'fork' or 'replay', not {short_repr(method)}"
            f"{did_you_mean(method, ('fork', 'replay'))}"
        )
    if method == "fork" and not (CAN_FORK and view.driver == "greenlet"):
        raise OptionValueError(
            'method="fork" needs Linux, and driver="greenlet": a forked process does not have the'
            ' other threads; use "replay"'
        )
    if not isinstance(time_limit, (int, float)) or not time_limit > 0:
        raise OptionValueError(
            f"time_limit must be a number of seconds, not {short_repr(time_limit)}"
        )
    return view


def _check_seeds(seeds: Sequence[int], n: int) -> None:
    is_listed = isinstance(seeds, (Sequence, np.ndarray))
    if not (is_listed and len(seeds) == n and all(map(is_seed, seeds))):
        raise OptionValueError(
            f"seeds must be n = {n} non-negative integers, one for each branch, not"
            f" {short_repr(seeds)}"
        )


# -- branches: clones for one call ----------------------------------------------------------------


def _call_deeper(
    function: Callable[[Any, int], Result],
    seeds: Sequence[int] | None,
    continuation: Any,
    number: int,
) -> Result:
    """In a branch, draw the future chance anew if there are seeds, and call a function."""
    token = DEPTH.set(DEPTH.get() + 1)
    try:
        twin = getattr(continuation, "unwrapped", continuation)
        twin.begin_branch()
        twin.session.move_to(Where.CLONE)
        if seeds is not None:
            seed = int(seeds[number])
            seed_globals(seed, PROCESS)
            twin.session.reseed(seed)
        return function(continuation, number)
    finally:
        DEPTH.reset(token)


def _call_on_clone(
    env: Any, function: Callable[[Any, int], Result], number: int, method: str | None
) -> Result:
    """Call a function in this process on a clone."""
    with preserve_generators():  # because the function and the model may draw from these
        try:
            twin = clone(env, method=method)
            try:
                result = function(twin, number)
            except BaseException as error:
                close_after(error, twin.unwrapped.close, "the branch")
                raise
            twin.unwrapped.close()
        except BaseException as error:
            annotate(error, f"simenv_marl: in branch {number}")
            raise
    return result


def _call_in_forks(
    function: Callable[[int], Result], n: int, separate: Callable[[], None], time_limit: float
) -> list[Result]:
    """Call a function in forked processes, as many at a time as there are cores."""
    results: dict[int, Result] = {}
    running: dict[Connection, tuple[int, Fork, float]] = {}  # with the number and the deadline
    cores = len(os.sched_getaffinity(0))
    numbers = iter(range(n))
    with ExitStack() as forks:  # an interrupt may end the end of one of them
        while len(results) < n:
            for number in islice(numbers, cores - len(running)):
                first = partial(_call_and_pack, separate, function, number)
                fork = Fork.begin(None, first, time_limit)
                forks.callback(fork.end, "")
                running[fork.connection] = number, fork, time.monotonic() + time_limit
            oldest, _, deadline = next(iter(running.values()))
            ready = wait(running, min(max(deadline - time.monotonic(), 0.0), PATIENCE))
            if not ready:
                for number, fork, _ in running.values():
                    if fork.is_stuck():
                        raise BranchError(f"branch {number} is gone: {STUCK}")
                if time.monotonic() >= deadline:
                    raise BranchError(
                        f"branch {oldest} was stopped: it took longer than {time_limit} s"
                    )
            for connection in [connection for connection in running if connection in ready]:
                number, fork, _ = running.pop(connection)
                results[number] = _result_of(number, fork)
    return [results[number] for number in range(n)]


def _call_and_pack(
    separate: Callable[[], None], function: Callable[[int], object], number: int
) -> bytes:
    """In a branch, call a function; return its result as bytes."""
    separate()
    result = function(number)
    try:
        return pack_checked(result)
    except Exception as error:
        raise BranchError(
            f"it returned a value that cannot be pickled ({describe_error(error)})"
        ) from error


def _result_of(number: int, fork: Fork) -> Any:
    """Return the result of a branch, or raise its exception."""
    try:
        response = fork.receive()
    except PeerLostError:
        fork.end(f"branch {number} has died without a result, ")
        raise BranchError(fork.gone) from None
    fork.end("")
    result, error = unpack_outcome(response)
    if error is None:
        return unpack(result)
    if not isinstance(error, Exception):  # an exit or an interrupt must not be raised here
        raise BranchError(f"branch {number} has raised {describe_error(error)}") from error
    annotate(error, f"simenv_marl: in branch {number}")
    raise error
