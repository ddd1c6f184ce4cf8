"""One request to another process: a method and its arguments there, and the response back.

A process ``serve``s an object, whose methods its user calls by a ``Peer``. Each message is pickled.
"""

from __future__ import annotations

import _signal  # type: ignore[import-not-found]  # without the enums of signal, which forks copy
import sys
from collections.abc import Callable
from contextlib import suppress
from math import inf
from multiprocessing.connection import Connection

from ...simulation import Model
from .packing import pack_outcome, pack_plainly, unpack


class PeerLostError(Exception):
    """The other process has ended."""


class Peer:
    """Another process that serves an object, as its user sees it.

    Attributes:
        connection: The connection to the process.
    """

    def __init__(self, connection: Connection) -> None:
        self.connection = connection

    def send(self, request: bytes) -> None:
        """Send a request of ``pack_request``. Raise the error of ``lost`` if the process ended."""
        try:
            self.connection.send_bytes(request)
        except OSError as error:
            raise self.lost() from error

    def receive(self, seconds: float = inf) -> bytes:
        """Wait for a response, which ``unpack_outcome`` unpacks.

        Raises:
            TimeoutError: It did not come within some seconds.
            PeerLostError: The process has ended. A subclass may raise another error.
        """
        response = receive(self.connection, seconds)
        if response is None:
            raise TimeoutError
        if not response:
            raise self.lost()
        return response

    def lost(self) -> Exception:
        """Make the error for the end of the process. A subclass may say how it has ended."""
        return PeerLostError("the other process has ended")


def pack_request(method: Callable[..., object], *args: object) -> bytes:
    """Pack a request to call a method of the object that the other process serves."""
    return pack_plainly((method, args))


def serve(connection: Connection, served: object, first: Callable[[], object]) -> None:
    """Answer requests to call methods of an object until the other end is closed.

    The first response comes without a request: the result of a function.
    """
    _leave_signals()

    def call(request: bytes) -> Model:
        method, args = unpack(request)
        return method(served, *args)

    response = pack_outcome(first)
    with suppress(OSError):  # the user's process has ended
        while True:
            flush()
            connection.send_bytes(response)
            request = receive(connection)
            if not request:
                return
            response = pack_outcome(call, request)


def _leave_signals() -> None:
    """Leave interrupts, and the signals that the user handles, to the user's process."""
    _signal.signal(_signal.SIGINT, _signal.SIG_IGN)
    _signal.set_wakeup_fd(-1)
    for number in range(1, _signal.NSIG):
        if callable(_signal.getsignal(number)):
            # Not SIG_IGN, because child processes of the model would inherit that.
            _signal.signal(number, lambda *_: None)


def receive(connection: Connection, seconds: float = inf) -> bytes | None:
    """Receive a message. An empty one means that the other end was closed.

    None if there is no message within some seconds.
    """
    try:
        if seconds < inf and not connection.poll(seconds):
            return None
        return connection.recv_bytes()
    except (EOFError, OSError):
        return b""


def flush() -> None:
    """Write out the buffers of the standard streams."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(Exception):
            stream.flush()
