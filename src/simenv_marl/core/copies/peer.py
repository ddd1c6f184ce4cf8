"""One request to another process: a name and arguments there, and the response back.

A process ``serve``s an object, whose methods its user calls by a ``Peer``. Each message is pickled.
A wait for an answer ends when the other process ends.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple

from .forks import receive
from .packing import pack_outcome, pack_plainly, unpack, unpack_outcome


class Response(NamedTuple):
    """The result of a request, or its error."""

    result: Any
    error: BaseException | None


class PeerLostError(Exception):
    """The other process has ended."""


class Peer:
    """Another process that serves an object, as its user sees it.

    Attributes:
        connection: The connection to the process.
    """

    def __init__(self, connection: Connection, sentinels: Sequence[int] = ()) -> None:
        """Use a connection. The ``sentinels`` are ready when the process has ended."""
        self.connection = connection
        self._sentinels = sentinels

    def send(self, name: str, args: tuple[Any, ...]) -> None:
        """Send a request. Raise the error of ``lost`` if the process has ended."""
        self.send_packed(pack_plainly((name, args)))

    def send_packed(self, message: bytes) -> None:
        """Send a request that is packed. Raise the error of ``lost`` if the process has ended."""
        try:
            self.connection.send_bytes(message)
        except OSError as error:
            raise self.lost() from error

    def receive(self, seconds: float | None = None) -> Response | None:
        """Wait for the outcome of a request. None if it does not come within some seconds.

        Raises:
            PeerLostError: The process has ended. A subclass may raise another error.
            TimeoutError: The outcome did not come within the limit of the connection.
        """
        if self._sentinels or seconds is not None:
            if not wait([self.connection, *self._sentinels], seconds):
                return None
            if not self._has_message():
                raise self.lost()
        parcel = receive(self.connection)
        if not parcel:
            raise self.lost()
        return Response(*unpack_outcome(parcel))

    def _has_message(self) -> bool:
        try:
            return self.connection.poll()
        except OSError:  # on Windows, where the other end is closed
            return False

    def lost(self) -> Exception:
        """Make the error for the end of the process. A subclass may say how it has ended."""
        return PeerLostError("the other process has ended")


def serve(connection: Connection, served: object, after: Callable[[], None] | None = None) -> None:
    """Answer requests to call methods of an object until the other end is closed.

    Args:
        connection: The connection to the user.
        served: The object.
        after: Called after each request.
    """

    def call(message: bytes) -> Any:
        name, args = unpack(message)
        return getattr(served, name)(*args)

    while message := receive(connection):
        outcome = pack_outcome(pack_plainly, call, message)
        if after is not None:
            after()
        try:
            connection.send_bytes(outcome)
        except OSError:  # the user's process has ended
            return
