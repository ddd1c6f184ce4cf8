"""Forked processes: each continues as this process would, and ends with the first process."""

from __future__ import annotations

import _signal  # type: ignore[import-not-found]  # without the enums of signal, which forks copy
import os
import re
import select
import socket
import sys
import traceback
import warnings
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from errno import EMFILE
from functools import partial
from math import inf
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final, TypeVar

from ...errors import BranchError, annotate
from ...hooks.locks import watch_no_locks
from ...simulation import Model
from ..switching.context import ExclusiveLock
from .packing import unpack_outcome
from .peer import Peer, PeerLostError, flush, pack_request, receive, serve

CAN_FORK: Final = sys.platform == "linux"
"""Whether processes can be forked: elsewhere, nothing ends a busy one with its user's process."""

if CAN_FORK:
    import fcntl

Result = TypeVar("Result")

# -- this process ---------------------------------------------------------------------------------


@dataclass
class _Process:
    """The descriptors of this process that concern its forks and its user.

    The end of a life, a pipe whose write end only one process has, ends all forks of that process.
    A signal of the kernel ends them, because a process that is busy would not notice the end of a
    pipe. The kernel's other signal, at the end of a parent, is of no use: it comes at the end of
    the thread that has forked.

    Attributes:
        lives: The read ends of the lives of the processes above this one.
        user: The connection to the process that uses this one. -1 if this is the first process.
        life: The read end and the write end of this process's own life, once it has forked.
    """

    lives: tuple[int, ...] = ()
    user: int = -1
    life: tuple[int, int] | None = None

    def own_life(self) -> int:
        """Return the read end of the life of this process."""
        if self.life is None:
            self.life = os.pipe()
        return self.life[0]

    def leave(self) -> None:
        """In a fork, close what keeps the other end from being closed."""
        if self.life is not None:
            os.close(self.life[1])
        if self.user >= 0:  # its object remains open, because a clone's fork connects it anew
            os.dup2(self.lives[0], self.user, inheritable=False)


_this = _Process()


def _begin_process() -> None:
    """In a forked process, also in a fork of the user: leave the parent's descriptors."""
    global _this
    _this.leave()
    _this = _Process()


if CAN_FORK:
    os.register_at_fork(after_in_child=_begin_process)


def _begin_fork(lives: tuple[int, ...], user: int, first: Callable[[], Result]) -> Result:
    """In a fork of this module, end with the lives, and call a function."""
    global _this
    _this = _Process(lives, user)
    watch_no_locks()  # because ``is_stuck`` finds all deadlocks of a process without other threads
    for life in lives:
        _end_with(life)
    return first()


def _end_with(descriptor: int) -> None:
    """Let the kernel kill this process when the write end of a pipe is closed."""
    own = os.open(f"/proc/self/fd/{descriptor}", os.O_RDONLY | os.O_NONBLOCK)
    os.dup2(own, descriptor, inheritable=False)  # because each opening has one owner
    os.close(own)
    fcntl.fcntl(descriptor, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(descriptor, fcntl.F_SETSIG, _signal.SIGKILL)
    fcntl.fcntl(descriptor, fcntl.F_SETFL, os.O_NONBLOCK | os.O_ASYNC)
    end = select.poll()
    end.register(descriptor, select.POLLHUP)
    if end.poll(0):  # it was closed before
        os._exit(1)


# -- forks ----------------------------------------------------------------------------------------

_FOREVER: Final = re.compile(r"futex\w+ \w+ 0x\w*[89a-f]\w \w+ 0x0 ")
"""A wait without a time limit for private memory (a futex), which only its process can end."""

PATIENCE: Final = 2.0
"""After so many seconds without a response, look whether the process can still respond."""

STUCK: Final = (
    "it was ended, because all its threads waited for locks that no thread releases: a thread that"
    " is not in the fork held one, or a library cannot be used in forks, such as OpenMP in"
    ' scikit-learn, LightGBM and faiss; use method="replay", or have the library use one thread'
    " (OMP_NUM_THREADS=1)"
)


class Fork(Peer):
    """A forked process. It serves an object.

    Attributes:
        lock: Lets one thread at a time wait for the process.
        process: The number of the process.
    """

    def __init__(
        self,
        process: int,
        connection: Connection,
        limit: float,
        parent: Fork | None = None,
    ) -> None:
        """Take over a process.

        Args:
            process: Its number.
            connection: The connection to it.
            limit: The time that an answer may take, in seconds.
            parent: Its parent, which must wait for its end. None: this process.
        """
        super().__init__(connection)
        self.lock = ExclusiveLock()
        self.process = process
        self._limit = limit
        # Weak, because a clone may be the last of a long chain.
        self._parent = None if parent is None else weakref.ref(parent)
        self._owner = os.getpid()
        self._gone: str | None = None
        self._waits: list[str] = []

    @classmethod
    def begin(cls, served: object, first: Callable[[], object], limit: float) -> Fork:
        """Fork a process that serves an object, and ends with this one.

        Args:
            served: The object.
            first: Called in the new process. Its result, or its error, is the first response.
            limit: The time that an answer may take, in seconds.

        Raises:
            BranchError: There are no more descriptors or processes. Nothing is left behind.
        """
        here, there = pipe()
        with there:
            with limited():
                lives = *_this.lives, _this.own_life()
            process = _fork()
            if process == 0:
                code = 1
                try:
                    here.close()
                    serve(there, served, partial(_begin_fork, lives, there.fileno(), first))
                    code = 0
                except BaseException:
                    traceback.print_exc()
                finally:
                    os._exit(code)  # without any of the parent's exit handlers
        return cls(process, here, limit)

    @property
    def gone(self) -> str | None:
        """Why it can answer no requests. None if it can."""
        if self._owner != os.getpid():
            return "it belongs to another process"
        return self._gone

    def start(self) -> Model:
        """Wait for the first response; return its result. After an error, the process ends."""
        with self.watch():
            return result_of(self.receive(self._limit))

    def request(self, method: Callable[..., Result], *args: object) -> Result:
        """Call a method of the served object; return its result.

        Raises:
            BranchError: The process has ended, or takes longer than the limit and is ended.
            ReentrancyError: Another thread waits for the process.
            BaseException: Any exception there, with its traceback as a note.
        """
        request = pack_request(method, *args)
        with self.watch():
            self.send(request)
            response = self.receive(self._limit)
        result: Result = result_of(response)
        return result

    def receive(self, seconds: float = inf) -> bytes:
        """Wait for a response: see ``Peer.receive``. End the process if none can come."""
        while seconds > PATIENCE:
            with suppress(TimeoutError):
                return super().receive(PATIENCE)
            if self.is_stuck():
                self.end(f"{STUCK}; ")
                raise self.lost()
            seconds -= PATIENCE
        return super().receive(seconds)

    def is_stuck(self) -> bool:
        """Return whether all threads wait for locks, and did so at the previous call."""
        before = self._waits
        self._waits = _waits_of(self.process)
        return before == self._waits != []

    @contextmanager
    def watch(self) -> Iterator[None]:
        """Send a request and wait for the response inside.

        The process ends if the response does not come, or if an interrupt ends the wait.
        """
        with self.lock:
            self._check()
            try:
                yield
            except TimeoutError:
                self.end(f"it was ended, because it took longer than {self._limit} s; ")
            except PeerLostError:
                self.end("its process has died, ")
            except BaseException:  # an interrupt: the response would be taken for the next one
                self.end("it was ended by an interrupt; ")
                raise
            if self._gone is not None:
                self._check()

    def _check(self) -> None:
        if self.gone is not None:
            raise BranchError(f"the clone is gone: {self.gone}")

    def end(self, why: str) -> None:
        """End the process, for a reason. In a fork of this process, only forget it.

        After an interrupt, call this again.
        """
        if self._gone is None:
            self._gone = why  # an interrupt may come before the rest
        if self.connection.closed:
            return
        if self._owner == os.getpid():
            self._gone += self._kill()
        self.connection.close()

    def _kill(self) -> str:
        """Kill the process; return how it has ended."""
        if self._parent is not None:
            self._kill_foreign(self._parent())
            return "its process has ended"
        try:
            status = os.waitpid(self.process, os.WNOHANG)
            if status[0] == 0:
                os.kill(self.process, _signal.SIGKILL)
                status = os.waitpid(self.process, 0)
        except ChildProcessError:  # the user has waited for it
            return "its process has ended"
        code = os.waitstatus_to_exitcode(status[1])
        if code == 0:
            return "because code in it has called os._exit(0), or closed all descriptors"
        return f"killed by signal {-code}" if code < 0 else f"with exit code {code}"

    def _kill_foreign(self, parent: Fork | None) -> None:
        """Kill a process that another fork has forked, and have that wait for it."""
        options = os.WNOHANG
        # If it has closed its connection, its number may be another process's.
        if receive(self.connection, 0) != b"":
            options = 0
            with suppress(ProcessLookupError):
                os.kill(self.process, _signal.SIGKILL)
        if parent is not None and not parent.lock.held:
            with suppress(Exception):  # it may be busy, or gone
                parent.request(_wait_for, self.process)
                return
        _wait_for(None, self.process, options)


def _wait_for(served: object, process: int, options: int = 0) -> None:
    """Wait for the end of a process that was killed, if it is a child of this one.

    A process whose parent has ended gets another one: the first process of a container.
    """
    with suppress(ChildProcessError):
        os.waitpid(process, options)


def _waits_of(process: int) -> list[str]:
    """Return where the threads of a process wait. An empty list if one of them may go on."""
    with suppress(OSError):  # it has ended, or the system hides it
        waits = [
            "".join((task / name).read_text() for name in ("wchan", "syscall", "status"))
            for task in Path(f"/proc/{process}/task").iterdir()
        ]
        if all(map(_FOREVER.match, waits)):
            return waits  # with the status, which counts how often they have run
    return []


def fork(connection: Connection, first: Callable[[], Result]) -> int | Result:
    """Fork this fork. Return the number of the new process; there, the result of a function.

    Args:
        connection: The connection to the new process, in place of the one to this process.
        first: The function.
    """
    this = _this
    process = _fork()
    if process != 0:
        return process
    os.dup2(connection.fileno(), this.user, inheritable=False)
    return _begin_fork(this.lives, this.user, first)


def _fork() -> int:
    flush()  # else both processes would write the buffered output
    with limited(), warnings.catch_warnings(action="ignore"):  # of locks that other threads hold
        return os.fork()


# -- connections ----------------------------------------------------------------------------------


def pipe() -> tuple[Connection, Connection]:
    """Return two connected ends. Raise a ``BranchError`` if there are no more descriptors."""
    with limited():
        return Pipe()


def _as_socket(descriptor: int) -> socket.socket:
    """Return the socket of a connection."""
    same = socket.socket(fileno=os.dup(descriptor))
    same.setblocking(True)  # because users may set a default time limit of sockets
    return same


def send_connection(through: Connection, connection: Connection) -> None:
    """Send a connection through another one."""
    with _as_socket(through.fileno()) as same:
        socket.send_fds(same, [b"."], [connection.fileno()])


def receive_connection() -> Connection:
    """In a fork, receive a connection. Raise a ``BranchError`` if there are no more descriptors."""
    with _as_socket(_this.user) as same:
        descriptors = socket.recv_fds(same, 1, 1)[1]
    with limited():
        if not descriptors:
            raise OSError(EMFILE, os.strerror(EMFILE))
    return Connection(descriptors[0])


def result_of(response: bytes) -> Model:
    """Return the result in a response of a fork, or raise its error."""
    result, error = unpack_outcome(response)
    if error is None:
        return result
    annotate(error, f"simenv_marl: in a clone, where it was raised by{error.__cause__}")
    BaseException.__setattr__(error, "__cause__", None)  # its class may be frozen
    raise error


@contextmanager
def limited() -> Iterator[None]:
    """Explain the error that there are no more descriptors or processes."""
    try:
        yield
    except OSError as error:
        raise BranchError(f"no process can be forked: {error}; close some clones") from error
