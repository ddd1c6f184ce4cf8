"""Forked processes: each continues as this process would, answers over a socket, and ends with the first process."""

from __future__ import annotations

import _signal  # type: ignore[import-not-found]  # without the enums of signal, which a fork would have to copy
import gc
import os
import select
import signal
import socket
import struct
import sys
import warnings
import weakref
from collections.abc import Callable
from contextlib import nullcontext, suppress
from typing import Any, Final

from ..errors import BranchError

CAN_FORK: Final = sys.platform == "linux"
"""Whether processes can be forked: elsewhere, nothing ends a busy one with its user's process."""

if CAN_FORK:
    import fcntl

_KILL: Final = int(signal.SIGKILL)

_LENGTH: Final = struct.Struct("!Q")
"""The number of bytes of a message, which precedes it."""

_TIME: Final = struct.Struct("ll")
"""A time limit of a socket: seconds and microseconds."""

_LONGEST: Final = 1e9
"""The number of seconds from which on there is no limit."""


# -- the first process ----------------------------------------------------------------------------


class _Life:
    """A pipe whose write end only this process holds. Its end ends the processes that were forked for this one.

    A signal of the kernel ends them, because a process that is busy would not notice the end of a
    pipe. The kernel's other signal, at the end of a parent, is of no use: it comes at the end of
    the thread that has forked.
    """

    def __init__(self) -> None:
        self.reading, self.writing = os.pipe()

    def __del__(self) -> None:
        for descriptor in (self.reading, self.writing):
            with suppress(OSError):
                os.close(descriptor)


class _Process:
    """What this process has of its own: its life, while it has forked others.

    And as a fork, what it has from above.

    Attributes:
        life: A weak reference to the life that all forks of this process hold.
        lives: The read ends of the lives of the processes above this one.
        connection: The socket to the process that uses this one.
    """

    def __init__(self) -> None:
        self.life: Callable[[], _Life | None] = lambda: None
        self.lives: tuple[int, ...] = ()
        self.connection: socket.socket | None = None


_this = _Process()


def _own_life() -> _Life:
    """Return the life on which all forks of this process depend."""
    life = _this.life()
    if life is None:
        try:
            life = _Life()
        except OSError as error:
            raise exhausted(error) from error
        _this.life = weakref.ref(life)
    return life


def _begin_process() -> None:
    """In a forked process, also one that the user has forked: let go of what belongs to the parent."""
    global _this
    life = _this.life()
    if life is not None:  # else the parent's end would go unnoticed as long as this process lives
        os.close(life.writing)
        life.reading = life.writing = -1  # where this process has the read end, it keeps it
    if _this.connection is not None:
        _this.connection.close()
    _this = _Process()


if CAN_FORK:
    os.register_at_fork(after_in_child=_begin_process)


def _end_with(descriptor: int) -> None:
    """Let the kernel kill this process when the write end of a pipe is closed."""
    # the owner belongs to the opening
    own = os.open(f"/proc/self/fd/{descriptor}", os.O_RDONLY | os.O_NONBLOCK)
    os.dup2(own, descriptor, inheritable=False)
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
        process: The process's number.
        connection: The socket that leads to it.
        life: What keeps it from ending.
    """

    def __init__(
        self, process: int, connection: socket.socket, life: Any, *, is_child: bool
    ) -> None:
        """Take over a process that ends with a life: a child of this process, or a child's."""
        self.process, self.connection, self.life, self._is_child = (
            process,
            connection,
            life,
            is_child,
        )
        connection.settimeout(None)  # whatever is the default: the socket itself has the limit
        self._owner = os.getpid()
        self._alive = True

    @classmethod
    def begin(
        cls, main: Callable[[socket.socket], None], separate: Callable[[], None], *, wait: bool
    ) -> Fork:
        """Fork a process that separates itself from this one, and runs ``main`` with its end of the connection.

        ``wait``: This process may go on to change what they share, so it waits until they are
        separated.

        Raises:
            BranchError: There are no more descriptors or processes. Nothing is left behind.
        """
        life = _own_life()
        here, there = pair()
        with there:
            try:
                process = start(here, there, (*_this.lives, life.reading), separate, wait=wait)
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
        """Whether the process was not ended, and belongs to this one, which may have been forked itself."""
        return self._alive and self._owner == os.getpid()

    def limit(self, seconds: float) -> None:
        """Limit the time for which a message is awaited."""
        # zeros: there is no limit
        whole, part = divmod(max(seconds, 1e-6), 1) if seconds < _LONGEST else (0, 0)
        limit = _TIME.pack(int(whole), int(part * 1e6))
        self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, limit)

    def receive(self) -> bytes:
        """Receive a message; an empty one if the process has ended.

        Raises:
            TimeoutError: It did not come within the limit.
        """
        return receive(self.connection)

    def receive_descriptors(self) -> list[int]:
        """Receive the descriptors that the process sends with a single byte."""
        try:
            return socket.recv_fds(self.connection, 1, 1)[1]
        except BlockingIOError as error:
            raise TimeoutError from error

    def end(self) -> str:
        """End the process, and wait for its end; return how it has ended.

        In a copy of this one, only let go of it.
        """
        how, alive, self._alive = "its process has ended", self._alive, False
        if not alive:
            return how
        if self._owner == os.getpid():
            if self._is_child or not self._has_ended():
                with suppress(ProcessLookupError):
                    os.kill(self.process, signal.SIGKILL)
            if self._is_child:
                with suppress(ChildProcessError):  # the user has waited for it
                    code = os.waitstatus_to_exitcode(os.waitpid(self.process, 0)[1])
                    how = f"killed by signal {-code}" if code < 0 else f"with exit code {code}"
        self.life = None
        self.connection.close()
        return how

    def _has_ended(self) -> bool:
        """Whether the process has closed its end of the connection: then its number may be another process's."""
        try:
            return self.connection.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT) == b""
        except BlockingIOError:
            return False
        except OSError:
            return True


def pair() -> tuple[socket.socket, socket.socket]:
    """Make two connected sockets, or raise a ``BranchError``."""
    try:
        here, there = socket.socketpair()
    except OSError as error:
        raise exhausted(error) from error
    for end in (here, there):
        end.settimeout(None)  # whatever is the default
    return here, there


def start(
    here: socket.socket,
    there: socket.socket,
    lives: tuple[int, ...],
    separate: Callable[[], None],
    *,
    wait: bool,
) -> int:
    """Fork a process that ends with the given lives; return its number, and 0 in that process.

    The sockets are the two ends of its connection. ``wait``: Return after the process was
    separated.

    Raises:
        BranchError: There are no more processes.
    """
    flush()  # else both processes would write what is buffered
    try:
        # Python 3.12 warns because the child never releases locks that other threads hold.
        with (
            warnings.catch_warnings(action="ignore")
            if sys.version_info >= (3, 12)
            else nullcontext()
        ):
            process = os.fork()
    except OSError as error:
        raise exhausted(error) from error
    if process == 0:
        try:
            # the collector would write to what is shared with the parent, and so copy it
            gc.freeze()
            _this.lives, _this.connection = lives, there
            for life in lives:
                _end_with(life)
            # an interrupt is for the user's process
            _signal.signal(_signal.SIGINT, _signal.SIG_IGN)
            _signal.set_wakeup_fd(-1)
            separate()
            if wait:
                there.sendall(b".")
        except BaseException:
            os._exit(1)
    elif wait:
        separated = b""
        try:
            there.close()  # else the end of the process would go unnoticed
            separated = here.recv(1)
        finally:
            if not separated:  # it has died, or an interrupt has ended the wait
                os.kill(process, _signal.SIGKILL)
                os.waitpid(process, 0)
        if not separated:
            raise BranchError("the forked process died before it was separated from this one")
    return process


def lives_above() -> tuple[int, ...]:
    """The lives of the processes above this one, for forks that belong to them."""
    return _this.lives


def send(connection: socket.socket, message: bytes) -> None:
    """Send a message."""
    connection.sendall(_LENGTH.pack(len(message)) + message)


def receive(connection: socket.socket) -> bytes:
    """Receive a message; an empty one if the other end was closed.

    Raises:
        TimeoutError: It did not come within the time limit of the connection.
    """
    try:
        part = connection.recv(1 << 16)
        if not part:
            return b""
        size = _LENGTH.size + _LENGTH.unpack_from(part)[0]
        if len(part) == size:
            return part[_LENGTH.size :]
        parts = bytearray(part)
        while part and len(parts) < size:
            part = connection.recv(1 << 20)
            parts += part
        return bytes(parts[_LENGTH.size :]) if part else b""
    except BlockingIOError as error:
        raise TimeoutError from error
    except ConnectionError:
        return b""


def flush() -> None:
    """Write out what the standard streams have buffered."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(Exception):
            stream.flush()
