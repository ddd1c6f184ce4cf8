"""Exact continuations of an episode, for planning, counterfactuals and studies of variance."""

import copy
import ctypes
import os
import random
import select
import shutil
import signal
import socket
import stat
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Container, Iterable, Sequence
from contextlib import nullcontext, suppress
from contextvars import ContextVar
from functools import partial
from gc import get_objects
from subprocess import Popen
from threading import Thread
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
)
from .context import preserve_generators, reuse_resources
from .packing import pack_outcome, pack_plainly, unpack_outcome
from .rng import PROCESS, is_seed, seed_globals

if hasattr(os, "fork"):
    import fcntl

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
    can_fork = hasattr(os, "fork") and view.driver == "greenlet"
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

    forks = can_fork and method != "replay"
    obstacles: dict[Any, str] = _open_resources(view.episode.driver.opened) if forks else {}
    loops = loops_on(obstacles) if obstacles else []
    for loop in loops:  # the pair of sockets that wakes an event loop is made anew
        obstacles.pop(loop._ssock.fileno(), None)
        obstacles.pop(loop._csock.fileno(), None)
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
            twin._begin_branch()
            if seeds is not None:
                seed_globals(int(seeds[number]), PROCESS)
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
    if not hasattr(view, "_begin_branch"):
        raise ViewError(f"{user} needs an environment of one simulation, not {short_repr(env)}")
    view._check_pending()
    return view


# -- by replaying ---------------------------------------------------------------------------------


def _call_in_replay(env: Any, view: Any, function: Callable[[Any, int], Result], number: int) -> Result:
    """Call a function on a copy of an environment whose simulation repeats the episode."""
    with preserve_generators():  # the model may draw from the process's generators, then and now
        twin = view._replayed()
        try:
            result = function(copy.deepcopy(env, {id(view): twin}), number)  # copies each wrapper with its state
        except BaseException as error:
            annotate(error, f"simenv_marl: in branch {number}")
            close_after(error, twin.close, "the branch")
            raise
        twin.close()
        return result


# -- by forking -----------------------------------------------------------------------------------


def _call_in_forks(function: Callable[[int], Any], n: int, time_limit: float) -> list[Any]:
    """Call a function in forked processes, as many at a time as there are cores."""
    results: list[Any] = [None] * n
    children: dict[int, tuple[int, int, float]] = {}  # by their pipes: the number of the branch, the process, its end
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    started, waiting = 0, select.poll()
    try:
        while started < n or children:
            while started < n and len(children) < cores:
                process, pipe = _fork(function, started, children)
                children[pipe] = started, process, time.monotonic() + time_limit
                waiting.register(pipe, select.POLLIN)
                started += 1
            oldest, _, deadline = next(iter(children.values()))  # whose time limit comes first
            left = max(deadline - time.monotonic(), 0.0)
            ready = waiting.poll(min(left, 3600.0) * 1000)  # in parts, because the time limit may be infinite
            if not ready and left <= 3600.0:
                raise BranchError(f"branch {oldest} was stopped: it took longer than {time_limit} s")
            for pipe, _ in ready:
                waiting.unregister(pipe)
                number, process, _ = children.pop(pipe)
                results[number] = _result(number, process, pipe)
    finally:
        for pipe, (_, process, _) in children.items():
            os.close(pipe)
            os.kill(process, signal.SIGKILL)
            os.waitpid(process, 0)
    return results


def _fork(function: Callable[[int], Any], number: int, others: Iterable[int]) -> tuple[int, int]:
    """Fork a process that calls the function and sends the outcome. Return the process, and the pipe to read from."""
    _flush()  # else both processes would write what is buffered
    parent = os.getpid()
    reading, writing = os.pipe()
    # Python 3.12 warns because the child never releases locks that other threads hold.
    with warnings.catch_warnings(action="ignore") if sys.version_info >= (3, 12) else nullcontext():
        process = os.fork()
    if process == 0:
        try:
            if _prctl is not None:  # let this process end when its parent ends, for whatever reason
                _prctl(1, signal.SIGKILL, 0, 0, 0)  # PR_SET_PDEATHSIG
                if os.getppid() != parent:  # the parent has already ended
                    os._exit(1)
            for pipe in (reading, *others):
                os.close(pipe)
            message = pack_outcome(_pack_result, function, number)
            _flush()
            while message:
                message = message[os.write(writing, message) :]
        finally:
            os._exit(0)  # without any of the parent's exit handlers
    os.close(writing)
    return process, reading


def _result(number: int, process: int, pipe: int) -> Any:
    """Receive the result of a branch, or raise its exception; wait for its process to end."""
    message = b"".join(iter(partial(os.read, pipe, 1 << 16), b""))
    os.close(pipe)
    code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    if not message:
        how = f"killed by signal {-code}" if code < 0 else f"with exit code {code}"
        raise BranchError(f"branch {number} has died without a result, {how}")
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


def _flush() -> None:
    """Write out what the standard streams have buffered."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(Exception):
            stream.flush()


_prctl: Final[Any] = getattr(ctypes.CDLL(None), "prctl", None) if sys.platform == "linux" else None


# -- what makes a forked process continue as its parent would -------------------------------------

_DESCRIPTORS: Final = "/proc/self/fd" if os.path.isdir("/proc/self/fd") else "/dev/fd"

_FLAGS: Final = os.O_WRONLY | os.O_RDWR | os.O_APPEND
"""The flags with which a file is opened again. The others say how it was made, or matter for other kinds of files."""

Files = dict[tuple[int, int], list[tuple[int, int, list[int]]]]
"""Open regular files by what identifies them. For each time that one was opened: the flags, the offset, and the
descriptors that share the offset."""


def separator(loops: Iterable[Any] = ()) -> Callable[[], None]:
    """Return a function that separates forked children, in which the event loops continue, from this process.

    ``fork`` copies the memory, but parent and child share the offsets and contents of open files, the events of epoll
    objects, and the sockets of event loops. And Python reseeds its global generator in the child.
    """
    python, (files, polls) = random.getstate(), _open_files()

    def separate() -> None:
        random.setstate(python)  # Python reseeds it after a fork
        for inode, openings in files.items():
            # A file may have been closed since: by the garbage collector, or in a thread that does not exist here.
            if all(_inode(number) == inode for _, _, numbers in openings for number in numbers):
                _reopen(openings)
        for loop in loops:
            _separate_loop(loop)
        for number in polls:
            _separate_poll(number)
        torch = sys.modules.get("torch")
        if torch is not None:
            torch.set_num_threads(1)  # its threads do not exist here, and torch would wait for them

    return separate


def _open_resources(opened: Iterable[Any] | None) -> dict[Any, str]:
    """Describe each thing that is still alive or open, in a few words; sockets by their descriptor."""
    found: dict[Any, str] = {}
    for thing in opened or ():
        if isinstance(thing, socket.socket):
            if thing.fileno() >= 0:
                found[thing.fileno()] = f"a socket (descriptor {thing.fileno()})"
        elif isinstance(thing, Thread):
            if thing.is_alive():
                found[thing] = "a thread"
        elif (thing.returncode if isinstance(thing, Popen) else thing.exitcode) is None:
            found[thing] = f"a child process ({thing.pid})"
    return found


def loops_on(descriptors: Container[int]) -> list[Any]:
    """Return the open asyncio event loops whose wake-up sockets are among the given descriptors."""
    events = sys.modules.get("asyncio.selector_events")
    if events is None:
        return []
    loops = [thing for thing in get_objects() if isinstance(thing, events.BaseSelectorEventLoop)]
    return [loop for loop in loops if not loop.is_closed() and loop._ssock.fileno() in descriptors]


def _separate_loop(loop: Any) -> None:
    """Give an event loop a selector, and sockets behind the same descriptors, that belong to this process only."""
    for old, new in zip((loop._ssock, loop._csock), socket.socketpair(), strict=True):
        with new:
            new.setblocking(False)
            os.dup2(new.fileno(), old.fileno(), inheritable=False)
    shared = loop._selector
    loop._selector = type(shared)()
    for key in shared.get_map().values():
        loop._selector.register(key.fileobj, key.events, key.data)
    shared.close()


def _separate_poll(number: int) -> None:
    """Put an epoll object of this process, which waits for the same events, behind a descriptor."""
    with suppress(OSError), select.epoll() as own, open(f"/proc/self/fdinfo/{number}", encoding="ascii") as entries:
        watched = [entry.split() for entry in entries if entry.startswith("tfd:")]
        # Only those of Python have the descriptors as data. C libraries find out themselves that they were forked.
        if all(int(entry[1]) == int(entry[5], 16) for entry in watched):
            for entry in watched:
                own.register(int(entry[1]), int(entry[3], 16))
            os.dup2(own.fileno(), number, inheritable=os.get_inheritable(number))


def _open_files() -> tuple[Files, list[int]]:
    """Return the open regular files of this process, except for standard streams, and its epoll objects."""
    files: Files = {}
    polls: list[int] = []
    standard = [_inode(number) for number in range(3)]  # which branches share with their parent
    for number in sorted(map(int, os.listdir(_DESCRIPTORS))):
        inode = _inode(number)
        if inode is None or inode in standard:
            continue
        if not stat.S_ISREG(os.fstat(number).st_mode):
            with suppress(OSError):
                if os.readlink(f"{_DESCRIPTORS}/{number}") == "anon_inode:[eventpoll]":
                    polls.append(number)
            continue
        with suppress(OSError):  # a descriptor that only stands for a path
            flags, offset = fcntl.fcntl(number, fcntl.F_GETFL) & _FLAGS, os.lseek(number, 0, os.SEEK_CUR)
            openings = files.setdefault(inode, [])
            for *opening, numbers in openings:
                if opening == [flags, offset] and _share_offset(numbers[0], number):
                    numbers.append(number)
                    break
            else:
                openings.append((flags, offset, [number]))
    return files, polls


def _inode(number: int) -> tuple[int, int] | None:
    """Return what identifies the file behind a descriptor; None if the descriptor is closed."""
    try:
        status = os.fstat(number)
    except OSError:
        return None
    return status.st_dev, status.st_ino


def _share_offset(one: int, other: int) -> bool:
    """Return whether two descriptors with the same offset share it, because one is a duplicate of the other."""
    offset = os.lseek(one, 1, os.SEEK_CUR)
    try:
        return os.lseek(other, 0, os.SEEK_CUR) == offset
    finally:
        os.lseek(one, -1, os.SEEK_CUR)


def _reopen(openings: list[tuple[int, int, list[int]]]) -> None:
    """Open a file again: the same one if it is only read, else a copy that is deleted when it is closed."""
    path = _path(openings[0][2][0])
    modes = {flags & os.O_ACCMODE for flags, _, _ in openings}
    copied: Any
    with nullcontext() if modes == {os.O_RDONLY} else tempfile.TemporaryFile() as copied:
        if modes == {os.O_WRONLY}:  # the contents are never read
            copied.truncate(os.stat(path).st_size)
        elif copied is not None:
            shutil.copyfile(path, _path(copied.fileno()))
        for flags, offset, numbers in openings:
            again = os.open(path if copied is None else _path(copied.fileno()), flags)
            os.lseek(again, offset, os.SEEK_SET)
            for number in numbers:
                os.dup2(again, number, inheritable=os.get_inheritable(number))
            os.close(again)


def _path(number: int) -> str:
    """Return a path by which an open file can be opened again, even if it was deleted."""
    if hasattr(fcntl, "F_GETPATH"):  # on macOS, where opening /dev/fd would share the offset
        return os.fsdecode(fcntl.fcntl(number, fcntl.F_GETPATH, bytes(1024)).partition(b"\0")[0])
    return f"{_DESCRIPTORS}/{number}"
