"""One request to another process: a name and arguments there, and the outcome back.

A process ``serve``s an object, whose methods its user calls by a ``Peer``. Each message is pickled.
A wait for an answer ends when the other process ends.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple

from .forks import receive
from .packing import pack_outcome, pack_plainly, unpack, unpack_outcome


class Outcome(NamedTuple):
    """The result of a request, or its error."""

    result: Any
    error: BaseException | None


class PeerLostError(Exception):
    """The other process has ended. The user of the peer raises an error that says how."""


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
        """Send a request, or raise a ``PeerLostError``."""
        self.send_packed(pack_plainly((name, args)))

    def send_packed(self, message: bytes) -> None:
        """Send a request that is packed, or raise a ``PeerLostError``."""
        try:
            self.connection.send_bytes(message)
        except OSError as error:
            raise PeerLostError("the other process has ended") from error

    def receive(self, seconds: float | None = None) -> Outcome | None:
        """Wait for the outcome of a request. None if it does not come within some seconds.

        Raises:
            PeerLostError: The process has ended.
            TimeoutError: The outcome did not come within the limit of the connection.
        """
        if self._sentinels or seconds is not None:
            if not wait([self.connection, *self._sentinels], seconds):
                return None
            if not self.connection.poll():
                raise PeerLostError("the other process has ended")
        parcel = receive(self.connection)
        if not parcel:
            raise PeerLostError("the other process has ended")
        return Outcome(*unpack_outcome(parcel))


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
