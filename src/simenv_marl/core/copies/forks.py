"""Forked processes: each continues as this process would, and ends with the first process."""

from __future__ import annotations

import _signal  # type: ignore[import-not-found]  # without the enums of signal, which forks copy
import gc
import os
import select
import socket
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from errno import EMFILE
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Final, TypeVar

from ...errors import BranchError, annotate
from ...simulation import Model
from ..switching.context import ExclusiveLock
from .packing import unpack_outcome
from .peer import Peer, PeerLostError, flush, pack_request, receive

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
        connection: The connection to the process that uses this one.
        life: The read end and the write end of this process's own life, once it has forked.
    """

    lives: tuple[int, ...] = ()
    connection: Connection | None = None
    life: tuple[int, int] | None = None

    def own_life(self) -> int:
        """Return the read end of the life of this process."""
        if self.life is None:
            self.life = os.pipe()
        return self.life[0]

    def leave(self) -> None:
        """In a fork, close the descriptors that keep the other end from being closed."""
        if self.life is not None:
            os.close(self.life[1])
        if self.connection is not None:
            self.connection.close()


_this = _Process()


def _begin_process() -> None:
    """In a forked process, also in a fork of the user: leave the parent's descriptors."""
    global _this
    _this.leave()
    _this = _Process()


if CAN_FORK:
    os.register_at_fork(after_in_child=_begin_process)


def _begin_fork(lives: tuple[int, ...], connection: Connection) -> None:
    """In a fork of this module, end with the lives, and leave interrupts to the user."""
    global _this
    gc.freeze()  # the collector would write to the memory that is shared, and so copy it
    _this = _Process(lives, connection)
    for life in lives:
        _end_with(life)
    _signal.signal(_signal.SIGINT, _signal.SIG_IGN)
    _signal.set_wakeup_fd(-1)


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
        reap: Callable[[], object] | None = None,
    ) -> None:
        """Take over a process.

        Args:
            process: Its number.
            connection: The connection to it.
            limit: The time that an answer may take, in seconds.
            reap: Lets its parent wait for its end. None: this process is its parent.
        """
        super().__init__(connection)
        self.lock = ExclusiveLock()
        self.process = process
        self._limit = limit
        self._reap = reap
        self._owner = os.getpid()
        self._gone: str | None = None

    @classmethod
    def begin(cls, main: Callable[[Connection], None], limit: float) -> Fork:
        """Fork this process: see ``fork``. The new process ends with this one.

        Raises:
            BranchError: There are no more descriptors or processes. Nothing is left behind.
        """
        here, there = pipe()
        with there:
            process = fork(main, there, here)
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
        """End the process, for a reason. In a fork of this process, only forget it."""
        if self._gone is not None:
            return
        self._gone = why  # an interrupt may come before the rest
        if self._owner == os.getpid():
            self._gone += self._kill()
        self.connection.close()

    def _kill(self) -> str:
        """Kill the process; return how it has ended."""
        # If it has closed its connection, its number may be another process's.
        if self._reap is None or receive(self.connection, 0) != b"":
            with suppress(ProcessLookupError):
                os.kill(self.process, _signal.SIGKILL)
        if self._reap is not None:
            with suppress(Exception):  # the parent may be gone, or busy; then it waits later
                self._reap()
            return "its process has ended"
        code = 0
        with suppress(ChildProcessError):  # the user has waited for it
            code = os.waitstatus_to_exitcode(os.waitpid(self.process, 0)[1])
        return f"killed by signal {-code}" if code < 0 else f"with exit code {code}"


def fork(
    main: Callable[[Connection], None], connection: Connection, other: Connection | None
) -> int:
    """Fork a process that runs a function with a connection, and then ends. Return its number.

    Args:
        main: The function, which must ``serve`` something.
        connection: The connection.
        other: The other end, if this process uses the new one. Then the new process ends with this
            one, otherwise with the processes above this one.
    """
    flush()  # else both processes would write the buffered output
    lives = _this.lives
    try:
        if other is not None:
            lives = *lives, _this.own_life()
        with warnings.catch_warnings(action="ignore"):  # of locks that other threads hold
            process = os.fork()
    except OSError as error:
        raise exhausted(error) from error
    if process == 0:
        try:
            if other is not None:
                other.close()
            _begin_fork(lives, connection)
            main(connection)
        finally:
            os._exit(0)  # without any of the parent's exit handlers
    return process


# -- connections ----------------------------------------------------------------------------------


def pipe() -> tuple[Connection, Connection]:
    """Return two connected ends. Raise a ``BranchError`` if there are no more descriptors."""
    try:
        return Pipe()
    except OSError as error:
        raise exhausted(error) from error


def _as_socket(connection: Connection) -> socket.socket:
    """Return the socket that a connection is."""
    same = socket.socket(fileno=os.dup(connection.fileno()))
    same.setblocking(True)  # because users may set a default time limit of sockets
    return same


def send_connection(through: Connection, connection: Connection) -> None:
    """Send a connection through another one."""
    with _as_socket(through) as same:
        socket.send_fds(same, [b"."], [connection.fileno()])


def receive_connection(through: Connection) -> Connection:
    """Receive a connection. Raise a ``BranchError`` if there are no more descriptors."""
    with _as_socket(through) as same:
        descriptors = socket.recv_fds(same, 1, 1)[1]
    if not descriptors:
        raise exhausted(OSError(EMFILE, os.strerror(EMFILE)))
    return Connection(descriptors[0])


def result_of(response: bytes) -> Model:
    """Return the result in a response of a fork, or raise its error."""
    result, error = unpack_outcome(response)
    if error is None:
        return result
    annotate(error, f"simenv_marl: in a clone, where it was raised by{error.__cause__}")
    BaseException.__setattr__(error, "__cause__", None)  # its class may be frozen
    raise error


def exhausted(error: OSError) -> BranchError:
    """Make the error that says that there are no more descriptors or processes."""
    return BranchError(f"no process can be forked: {error}; close some clones")
