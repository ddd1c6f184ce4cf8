"""Forked processes: each continues as this process would, and ends with the first process."""

from __future__ import annotations

import _signal  # type: ignore[import-not-found]  # without the enums of signal, which forks copy
import gc
import os
import select
import signal
import socket
import struct
import sys
import warnings
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Final

from ...errors import BranchError

CAN_FORK: Final = sys.platform == "linux"
"""Whether processes can be forked: elsewhere, nothing ends a busy one with its user's process."""

if CAN_FORK:
    import fcntl

_KILL: Final = int(signal.SIGKILL)

_TIME: Final = struct.Struct("ll")
"""A time limit of a socket: seconds and microseconds."""

_LONGEST: Final = 1e9
"""The number of seconds from which on there is no limit."""


# -- the first process ----------------------------------------------------------------------------


class _Life:
    """A pipe whose write end only this process has. Its end ends the forks of this process.

    A signal of the kernel ends them, because a process that is busy would not notice the end of a
    pipe. The kernel's other signal, at the end of a parent, is of no use: it comes at the end of
    the thread that has forked.
    """

    def __init__(self) -> None:
        self.reading, self.writing = os.pipe()

    def leave(self) -> None:
        """In a fork: close the write end. The read end stays open where the fork watches it."""
        os.close(self.writing)
        self.reading = -1
        self.writing = -1

    def __del__(self) -> None:
        for descriptor in (self.reading, self.writing):
            with suppress(OSError):
                os.close(descriptor)


class _Process:
    """The lives and connections of this process.

    Attributes:
        life: A weak reference to the life on which all forks of this process depend.
        lives: The read ends of the lives of the processes above this one.
        connection: The connection to the process that uses this one.
    """

    def __init__(self, lives: tuple[int, ...] = (), connection: Connection | None = None) -> None:
        self.life: Callable[[], _Life | None] = lambda: None
        self.lives = lives
        self.connection = connection

    def own_life(self) -> _Life:
        """Return the life on which all forks of this process depend."""
        life = self.life()
        if life is None:
            try:
                life = _Life()
            except OSError as error:
                raise exhausted(error) from error
            self.life = weakref.ref(life)
        return life


_this = _Process()


def _begin_process() -> None:
    """In a forked process, also one that the user has forked: leave what belongs to the parent."""
    global _this
    life = _this.life()
    if life is not None:  # else the parent's end would go unnoticed as long as this process lives
        life.leave()
    if _this.connection is not None:
        _this.connection.close()
    _this = _Process()


if CAN_FORK:
    os.register_at_fork(after_in_child=_begin_process)


def _end_with(descriptor: int) -> None:
    """Let the kernel kill this process when the write end of a pipe is closed."""
    own = os.open(f"/proc/self/fd/{descriptor}", os.O_RDONLY | os.O_NONBLOCK)
    os.dup2(own, descriptor, inheritable=False)  # because each opening has one owner
    os.close(own)
    fcntl.fcntl(descriptor, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(descriptor, fcntl.F_SETSIG, _KILL)
    fcntl.fcntl(descriptor, fcntl.F_SETFL, os.O_NONBLOCK | os.O_ASYNC)
    end = select.poll()
    end.register(descriptor, select.POLLHUP)
    if end.poll(0):  # it was closed before
        os._exit(1)


def exhausted(error: OSError) -> BranchError:
    """Make the error that says that there are no more descriptors or processes."""
    return BranchError(f"no process can be forked: {error}; close some clones")


# -- forks ----------------------------------------------------------------------------------------


class Fork:
    """A forked process, and the connection to it.

    Attributes:
        process: The number of the process.
        connection: The connection to it.
        life: The life on which it depends, which must not be freed before.
    """

    def __init__(
        self, process: int, connection: Connection, life: _Life | None, *, is_child: bool
    ) -> None:
        """Take over a process: a child of this process, or a child's."""
        self.process = process
        self.connection = connection
        self.life = life
        self._is_child = is_child
        self._owner = os.getpid()
        self._alive = True

    @classmethod
    def begin(
        cls,
        main: Callable[[Connection], None],
        separate: Callable[[], None],
        *,
        wait: bool,
        outlives: bool = False,
    ) -> Fork:
        """Fork a process that runs a function with its end of the connection, and then ends.

        Args:
            main: The function.
            separate: Separates the new process from this one.
            wait: Whether this process may go on to change shared things, and so waits until they
                are separated.
            outlives: Whether the new process goes on when this one ends, and ends with the
                processes above this one.

        Raises:
            BranchError: There are no more descriptors or processes. Nothing is left behind.
        """
        life = None if outlives else _this.own_life()
        lives = _this.lives if life is None else (*_this.lives, life.reading)
        try:
            here, there = Pipe()
        except OSError as error:
            raise exhausted(error) from error
        with there:
            try:
                process = _start(here, there, lives, separate, wait=wait)
            except BaseException:
                here.close()
                raise
            if process == 0:
                try:
                    here.close()
                    main(there)
                finally:
                    os._exit(0)  # without any of the parent's exit handlers
        return cls(process, here, life, is_child=True)

    @property
    def usable(self) -> bool:
        """Whether the process was not ended, and belongs to this one, which may be a fork."""
        return self._alive and self._owner == os.getpid()

    def limit(self, seconds: float) -> None:
        """Limit the time for which a message is awaited."""
        limit = _TIME.pack(0, 0)  # no limit
        if seconds < _LONGEST:
            whole, part = divmod(max(seconds, 1e-6), 1)
            limit = _TIME.pack(int(whole), int(part * 1e6))
        with _as_socket(self.connection) as same:
            same.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, limit)

    def receive(self) -> bytes:
        """Receive a message. An empty one means that the process has ended.

        Raises:
            TimeoutError: It did not come within the limit.
        """
        return receive(self.connection)

    def end(self) -> str:
        """End the process; return how it has ended. In a fork of this process, only forget it."""
        alive, self._alive = self._alive, False
        if not alive:
            return "its process has ended"
        how = self._kill() if self._owner == os.getpid() else "its process has ended"
        self.life = None
        self.connection.close()
        return how

    def _kill(self) -> str:
        if self._is_child or not self._has_ended():
            with suppress(ProcessLookupError):
                os.kill(self.process, signal.SIGKILL)
        if self._is_child:
            with suppress(ChildProcessError):  # the user has waited for it
                code = os.waitstatus_to_exitcode(os.waitpid(self.process, 0)[1])
                return f"killed by signal {-code}" if code < 0 else f"with exit code {code}"
        return "its process has ended"

    def _has_ended(self) -> bool:
        """Whether the process has closed its connection: its number may be another process's."""
        try:
            return self.connection.poll(0) and self.receive() == b""
        except OSError:
            return True


def _start(
    here: Connection,
    there: Connection,
    lives: tuple[int, ...],
    separate: Callable[[], None],
    *,
    wait: bool,
) -> int:
    """Fork a process. Return its number, and 0 in that process.

    Args:
        here: This process's end of the connection.
        there: The other end.
        lives: The lives with which the process ends.
        separate: Separates it from this process.
        wait: Whether to return after that.

    Raises:
        BranchError: There are no more processes.
    """
    global _this
    flush()  # else both processes would write what is buffered
    try:
        # Python 3.12 warns because the child never releases locks that other threads hold.
        silent = warnings.catch_warnings(action="ignore") if sys.version_info >= (3, 12) else None
        with silent or nullcontext():
            process = os.fork()
    except OSError as error:
        raise exhausted(error) from error
    if process == 0:
        try:
            gc.freeze()  # the collector would write to the memory that is shared, and so copy it
            _this = _Process(lives, there)
            for life in lives:
                _end_with(life)
            _signal.signal(_signal.SIGINT, _signal.SIG_IGN)  # an interrupt is for the user
            _signal.set_wakeup_fd(-1)
            separate()
            if wait:
                there.send_bytes(b".")
        except BaseException:
            os._exit(1)
    elif wait:
        _await_separation(process, here, there)
    return process


def _await_separation(process: int, here: Connection, there: Connection) -> None:
    separated = b""
    try:
        there.close()  # else the end of the process would go unnoticed
        separated = receive(here)
    finally:
        if not separated:  # it has died, or an interrupt has ended the wait
            os.kill(process, _signal.SIGKILL)
            os.waitpid(process, 0)
    if not separated:
        raise BranchError("the forked process died before it was separated from this one")


@contextmanager
def _as_socket(connection: Connection) -> Iterator[socket.socket]:
    """Use a connection as the socket that it is."""
    with socket.socket(fileno=os.dup(connection.fileno())) as same:
        same.setblocking(True)  # whatever the default time limit of sockets is
        yield same


def send_connection(through: Connection, connection: Connection) -> None:
    """Send a connection through another one."""
    with _as_socket(through) as same:
        socket.send_fds(same, [b"."], [connection.fileno()])


def receive_connection(through: Connection) -> Connection | None:
    """Receive a connection. None if there are no more descriptors."""
    with _as_socket(through) as same:
        descriptors = socket.recv_fds(same, 1, 1)[1]
    return Connection(descriptors[0]) if descriptors else None


def receive(connection: Connection) -> bytes:
    """Receive a message. An empty one means that the other end was closed.

    Raises:
        TimeoutError: It did not come within the time limit of the connection.
    """
    try:
        return connection.recv_bytes()
    except BlockingIOError as error:
        raise TimeoutError from error
    except (EOFError, OSError):
        return b""


def flush() -> None:
    """Write out what the standard streams have buffered."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(Exception):
            stream.flush()
