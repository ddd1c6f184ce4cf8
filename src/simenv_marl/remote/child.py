"""The process of a simulator, and the lines that are exchanged with it.

Every wait has an end. The standard error of the process is read while the process is waited for, so that it never
blocks; errors show the last part of it. The process leads a process group of its own, which ends with it.
"""

from __future__ import annotations

import os
import select
import signal
from collections.abc import Mapping, Sequence
from contextlib import suppress
from subprocess import DEVNULL, PIPE, Popen, TimeoutExpired
from time import monotonic, sleep
from types import NoneType
from typing import Any, Final, NoReturn, TypeGuard
from weakref import finalize

from ..errors import (
    ProcessDiedError,
    ProcessTimeoutError,
    RemoteError,
    SimEnvError,
    WireError,
    WrongThreadError,
    describe_error,
    short_repr,
    warn_user,
)
from .wire import DESCRIPTORS, LONGEST, VERSION, decode

CHUNK: Final = 1 << 16

REMEMBERED: Final = 4096
"""The number of bytes of its standard error that errors show."""

LONGEST_WAIT: Final = 3600.0
"""The longest wait at once, in seconds; ``poll`` takes no more than some weeks."""

GRACE: Final = 2.0
"""The time in seconds that a process has to end by itself."""


_ENTITIES: Final = (str, int, NoneType)
_TIMES: Final = (float, NoneType)


class _Process:
    """A process and its descriptors, which end together.

    Attributes:
        reading, writing: This side's ends of the two pipes.
        stderr: The descriptor of its standard error.
        last: The last part of its standard error.
        owner: The id of the process that started it.
    """

    def __init__(self, command: Sequence[str], env: Mapping[str, str], cwd: Any) -> None:
        self.last = bytearray()
        self.owner, self._ended = os.getpid(), False
        ends: list[int] = []
        try:
            ends += os.pipe()
            ends += os.pipe()
            theirs_in, self.writing, self.reading, theirs_out = ends
            self._popen = Popen(
                command,
                stdin=DEVNULL,
                stderr=PIPE,
                pass_fds=(theirs_in, theirs_out),
                env={**env, DESCRIPTORS: f"{theirs_in},{theirs_out}"},
                cwd=cwd,
                start_new_session=True,  # so that its group can be ended, and a terminal's interrupts miss it
            )
        except BaseException:
            for end in ends:
                os.close(end)
            raise
        os.close(theirs_in)
        os.close(theirs_out)
        assert self._popen.stderr is not None
        self.number, self.stderr = self._popen.pid, self._popen.stderr.fileno()
        for descriptor in (self.reading, self.writing, self.stderr):
            os.set_blocking(descriptor, False)

    def listen(self) -> bool:
        """Read its standard error; return whether more may come."""
        try:
            chunk = os.read(self.stderr, CHUNK)
        except BlockingIOError:
            return True
        self.last += chunk
        del self.last[:-REMEMBERED]
        return bool(chunk)

    def exit_code(self) -> int | None:
        """Return its exit code, or minus the signal that ended it; None while it runs.

        The process is not reaped, so that no other group can get its number.
        """
        if self._popen.returncode is not None or not hasattr(os, "waitid"):
            return self._popen.poll()
        try:
            found = os.waitid(os.P_PID, self.number, os.WEXITED | os.WNOHANG | os.WNOWAIT)
        except ChildProcessError:  # other code in this process reaped it
            return self._popen.poll()
        if found is None:
            return None
        return found.si_status if found.si_code == os.CLD_EXITED else -found.si_status

    def wait(self, patience: float) -> int | None:
        """Wait for its exit, at most ``patience`` seconds; return its exit code."""
        deadline, pause = monotonic() + patience, 0.0005
        while (code := self.exit_code()) is None and monotonic() < deadline:
            self.listen()
            sleep(pause)
            pause = min(2 * pause, 0.02)
        return code

    def close_input(self) -> None:
        """Close its input, if that is open."""
        if self.writing >= 0:
            os.close(self.writing)
            self.writing = -1

    def end(self, patience: float) -> None:
        """Close its pipes, and end it and its group; in a fork of this process, only let go of it.

        Args:
            patience: The time in seconds that it has to end by itself.
        """
        if self._ended:
            return
        self._ended = True
        try:
            os.close(self.reading)
            self.close_input()
            if self.owner == os.getpid():
                self.wait(patience)
        finally:  # also after an interrupt
            if self.owner == os.getpid():
                self._kill()
            else:
                self._popen.returncode = 0  # it is waited for elsewhere
            assert self._popen.stderr is not None
            self._popen.stderr.close()

    def _kill(self) -> None:
        """Kill it and its group at once, and read the rest of its standard error."""
        with suppress(ProcessLookupError, PermissionError):  # the group is empty
            os.killpg(self.number, signal.SIGKILL)
        try:
            self._popen.wait(GRACE)
        except TimeoutExpired:
            warn_user(f"the process {self.number} was killed and has not ended yet", ResourceWarning)
        for _ in range(REMEMBERED):  # processes that left the group may still write
            before = bytes(self.last)
            if not self.listen() or self.last == before:
                break


class Child:
    """A simulator in a process of its own that speaks the wire protocol.

    Attributes:
        points: The names of its decision points.
        can: Its further abilities, such as "reseed".
        may_exit: Whether its episode is over, so that it may exit.
    """

    def __init__(
        self, command: Sequence[str], timeout: float, env: Mapping[str, str] | None = None, cwd: Any = None
    ) -> None:
        """Start the process, and read its first frame.

        Args:
            command: The program and its arguments.
            timeout: The time to wait for each line, in seconds.
            env: The environment variables of the process. None: those of this process.
            cwd: The folder in which it runs. None: that of this process.

        Raises:
            ProcessDiedError, ProcessTimeoutError, WireError: It does not start, or breaks the rules of the wire.
            RemoteError: It reported an error.
        """
        self.timeout, self.may_exit = timeout, False
        self._rest = b""  # received bytes of the next lines
        try:
            self._process = _Process(command, os.environ if env is None else env, cwd)
        except (OSError, ValueError) as error:
            raise ProcessDiedError(f"{command[0]!r} cannot be started: {describe_error(error)}") from error
        self._finalizer = finalize(self, self._process.end, GRACE)
        self._name = f"the process {self._process.number} ({command[0]})"
        self._poll = select.poll()
        self._poll.register(self._process.reading, select.POLLIN)
        self._poll.register(self._process.stderr, select.POLLIN)
        try:
            hello = self.receive()
        except BaseException:  # an interrupt, too
            self.end(patience=0.0)
            raise
        version, points, can = hello.get("hello"), hello.get("points"), hello.get("can", [])
        if version is None:
            self.refuse(hello, f"began with {short_repr(hello)}, not with a hello")
        if type(version) is not int or version != VERSION:
            self.fail(WireError(f"{self} speaks version {short_repr(version)} of the wire; this is version {VERSION}"))
        if not _are_strings(points) or not _are_strings(can):
            self.fail(
                WireError(f'{self} has said {short_repr(hello)}; its "points" and "can" must be lists of strings')
            )
        self.points: frozenset[str] = frozenset(points)
        self.can: frozenset[str] = frozenset(can)

    def __str__(self) -> str:
        return self._name

    # -- lines ------------------------------------------------------------------------------------

    def receive(self) -> dict[str, Any]:
        """Wait for the next frame.

        Raises:
            ProcessDiedError: The process has ended, or has closed its pipe.
            ProcessTimeoutError: Nothing came.
            WireError: It sent something that is not a frame.
        """
        line = complete = self._rest
        if line:
            line, complete, self._rest = line.partition(b"\n")
        if not complete:
            line = self._completed(line)
        try:
            return decode(line)
        except WireError as error:
            self.fail(WireError(f"{self} has sent {error}"))

    def _completed(self, line: bytes) -> bytes:
        """Wait for the rest of a line, given its beginning."""
        parts, length, reading, begun = [line], len(line), self._process.reading, monotonic()
        while True:
            self._wait(reading, begun, "half a line" if length else "nothing")
            chunk = os.read(reading, CHUNK)
            if not chunk:
                self._died(half=length > 0)
            part, complete, self._rest = chunk.partition(b"\n")
            length += len(part)
            if length >= LONGEST:
                self.fail(WireError(f"{self} has sent a line of more than {LONGEST:,} bytes"))
            if length == len(part) and complete:  # most lines come in one piece
                return part
            parts.append(part)
            if complete:
                return b"".join(parts)

    def check_silent(self) -> None:
        """Check that it has sent nothing when nothing is due.

        Raises:
            WireError, RemoteError: It has sent a frame.
            ProcessDiedError, ProcessTimeoutError: As ``receive``.
        """
        if self._rest or self._process.reading in dict(self._poll.poll(0)):
            frame = self.receive()
            self.refuse(frame, f"has sent {short_repr(frame)} before the start of an episode")

    def check_named(self, frame: Mapping[str, Any], entity: Any) -> tuple[str, float | None]:
        """Return the point and the time of a frame that names an entity.

        Raises:
            WireError: The point, the time, the entity or the arguments are invalid.
        """
        name, arguments, time = frame.get("point"), frame.get("args"), frame.get("time")
        if not isinstance(name, str) or name not in self.points:
            self.fail(WireError(f"{self} has named the point {short_repr(name)}, which is not in its hello"))
        if type(entity) not in _ENTITIES:
            self.fail(
                WireError(
                    f"{self} has sent the entity {short_repr(entity)} for {name}; an entity must be a"
                    " string or an integer"
                )
            )
        if arguments is not None and not isinstance(arguments, dict):
            self.fail(WireError(f"{self} has sent args for {name} that are not an object: {short_repr(arguments)}"))
        if type(time) is int and abs(time) < 1 << 1000:  # floats are not larger
            time = float(time)
        if type(time) not in _TIMES:
            self.fail(WireError(f"{self} has sent the time {short_repr(time)} for {name}, which is not a number"))
        return name, time

    def check_end(self, end: Any) -> None:
        """Check an "end" frame.

        Raises:
            WireError: It is invalid.
        """
        if not isinstance(end, dict):
            self.fail(
                WireError(
                    f'{self} has sent the end {short_repr(end)}; it must be an object with "truncated" and "result"'
                )
            )

    def send(self, lines: bytes) -> None:
        """Send lines.

        If the process is gone, nothing happens here: ``receive`` raises the error, which may have the reason.

        Raises:
            ProcessTimeoutError: It does not read.
        """
        process, begun = self._process, 0.0
        if process.owner != os.getpid():
            raise WrongThreadError(
                f"{self} belongs to the process from which this one was forked; reset() starts another one"
            )
        while lines:
            try:
                lines = lines[os.write(process.writing, lines) :]
            except BrokenPipeError:
                return
            except BlockingIOError:
                begun = begun or monotonic()
                self._poll.unregister(process.reading)
                self._poll.register(process.writing, select.POLLOUT)
                self._wait(process.writing, begun, "nothing and read nothing")
                self._poll.unregister(process.writing)
                self._poll.register(process.reading, select.POLLIN)
            except OSError as error:  # its input is closed
                raise ProcessDiedError(f"{self} has been ended already") from error

    def _wait(self, descriptor: int, begun: float, sent: str) -> None:
        """Wait until a descriptor is ready; read standard error meanwhile."""
        found = False
        while not found:
            left = begun + self.timeout - monotonic()
            for which, _ in self._poll.poll(min(left, LONGEST_WAIT) * 1000 if left > 0 else 0):
                if which == descriptor:
                    found = True
                elif not self._process.listen():
                    self._poll.unregister(which)
            if left <= 0:  # even if data keeps trickling in
                self.fail(ProcessTimeoutError(f"{self} {self._state()}; it has sent {sent} for {self.timeout:g} s"))

    # -- ends -------------------------------------------------------------------------------------

    @property
    def usable(self) -> bool:
        """Whether it was not ended and belongs to this process."""
        return self._finalizer.alive and self._process.owner == os.getpid()

    def exit_code(self) -> int | None:
        """Return its exit code, or minus the signal that ended it; None while it runs."""
        return self._process.exit_code()

    def close_input(self) -> None:
        """Close its input; its output can still be received."""
        self._process.close_input()

    def fail(self, error: SimEnvError) -> NoReturn:
        """End the process at once, and raise an error with the last part of its standard error."""
        self.end(patience=0.0)
        text = self._process.last.decode(errors="replace").strip()
        raise type(error)(f"{error}. The end of its standard error:\n{text}" if text else str(error))

    def refuse(self, frame: Mapping[str, Any], what: str) -> NoReturn:
        """Raise the error that a frame reports, or say that the frame is invalid or not due."""
        error = frame.get("error")
        if not isinstance(error, dict):
            self.fail(WireError(f"{self} {what}"))
        kind, text, trace = (error.get(name) or "" for name in ("type", "text", "trace"))
        where = f"\n{trace}" if trace else ""
        self.fail(RemoteError(f"the model in {self} has raised {kind or 'an error'}: {text}{where}"))

    def end(self, patience: float = GRACE) -> None:
        """Close its pipes, and end it and all processes that it started.

        Args:
            patience: The time in seconds that it has to end by itself.
        """
        self._finalizer.detach()
        self._process.end(patience)

    def _died(self, *, half: bool) -> NoReturn:
        """Raise the error for a process that closed its pipe, maybe within a line."""
        self._process.wait(GRACE)
        where = " in the middle of a line" if half else ""
        self.fail(ProcessDiedError(f"{self} has closed its pipe{where}, and {self._state()}"))

    def _state(self) -> str:
        code = self.exit_code()
        if code is None:
            return "still runs"
        if code >= 0:
            return f"has exited with code {code}"
        try:
            return f"was killed by {signal.Signals(-code).name}"
        except ValueError:
            return f"was killed by signal {-code}"


def _are_strings(value: Any) -> TypeGuard[list[str]]:
    return isinstance(value, list) and all(isinstance(item, str) for item in value)
