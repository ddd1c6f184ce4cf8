"""The process of a simulator: starting it, its frames, waiting for it, ending it.

Every wait has an end. The standard error of the process is read while the process is waited for, so
that it never blocks; errors show the last part of it. The process leads its own process group,
which ends with it.
"""

from __future__ import annotations

import atexit
import os
import select
import signal
from collections.abc import Mapping, Sequence
from contextlib import suppress
from subprocess import DEVNULL, PIPE, Popen, TimeoutExpired
from time import monotonic, sleep
from typing import Any, Final, NoReturn
from weakref import WeakSet, finalize

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
from ..simulation import RULE
from . import guardian
from .wire import DESCRIPTORS, LONGEST, STOP, VERSION, check_frame, decode, encode_answer

CHUNK: Final = 1 << 16
"""The number of bytes to read at once; pipes hold no more."""

STDERR_TAIL: Final = 4096
"""The number of bytes of its standard error that errors show."""

GRACE: Final = 2.0
"""The time in seconds that a process has to end by itself."""

MOST_FRAMES: Final = 100_000
"""The number of frames that may come between two calls.

A birth, an update and a removal are one each.
"""

MOST_BYTES: Final = 1 << 30
"""The number of bytes that may come between two calls."""

MOST_WAITS: Final = 20
"""How many times the time to wait for a line the frames between two calls may take."""

LOST: Final = 1 << 16
"""The exit code of a process whose exit code was lost. No process can exit with it."""


class Child:
    """A simulator in another process, which speaks the wire protocol.

    Attributes:
        pid: The id of the process.
        hello: Its first frame.
        points: The names of its decision points.
        can: Its further abilities, such as "reseed".
        timeout: The time to wait for each line, in seconds.
        state: "idle" between episodes, "running" its model, "waiting" for the answer to a call, or
            "stopped".
        number: The number of its latest call in the episode; 0 before the first one.
        time: Its latest time in the episode; None if it sent none.
        origin: What it was started with, and in; equal for processes that can replace each other.
    """

    origin: Any = None

    def __init__(
        self,
        command: Sequence[str],
        timeout: float,
        env: Mapping[str, str] | None = None,
        cwd: Any = None,
    ) -> None:
        """Start the process, and read its first frame.

        The arguments are those of ``ProcessSimulation``.

        Raises:
            ProcessDiedError, ProcessTimeoutError, WireError: It does not start, or breaks the rules
                of the wire.
            RemoteError: It reported an error.
        """
        self.timeout, self.state, self.number = timeout, "idle", 0
        self.time: float | None = None
        self._rest = b""  # received bytes of the next lines
        self._tail = bytearray()  # the last part of its standard error
        self._owner, self._closed = os.getpid(), False
        try:
            self._start(command, os.environ if env is None else env, cwd)
        except (OSError, ValueError) as error:
            raise ProcessDiedError(
                f"{command[0]!r} cannot be started: {describe_error(error)}"
            ) from error
        self.pid = self._popen.pid
        _children.add(self)
        self._name = f"the process {self.pid} ({command[0]})"
        self._output = self._poll(self._reading, select.POLLIN)
        try:
            guardian.guard(self.pid)
            hello = self.receive()
        except BaseException:  # an interrupt, too
            self.close(patience=0.0)
            raise
        self.hello = hello
        version, points, can = hello.get("hello"), hello.get("points", ()), hello.get("can", [])
        if version is None:
            self.refuse(hello, f"began with {short_repr(hello)}, not with a hello")
        if type(version) is not int or version != VERSION:
            self.fail(
                WireError(
                    f"{self} speaks version {short_repr(version)} of the wire; this is version"
                    f" {VERSION}"
                )
            )
        for names in (points, can):
            if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
                what = f'{short_repr(hello)}; its "points" and "can" must be lists of strings'
                self.fail(WireError(f"{self} has said {what}"))
        self.points: frozenset[str] = frozenset(points)
        self.can: frozenset[str] = frozenset(can)

    def _start(self, command: Sequence[str], env: Mapping[str, str], cwd: Any) -> None:
        """Start the process with its pipes."""
        ends: list[int] = []
        try:
            ends += os.pipe()
            ends += os.pipe()
            child_reading, self._writing, self._reading, child_writing = ends
            self._popen = Popen(
                command,
                stdin=DEVNULL,
                stderr=PIPE,
                pass_fds=(child_reading, child_writing),
                env={**env, DESCRIPTORS: f"{child_reading},{child_writing}"},
                cwd=cwd,
                # so that its group can be ended, and a terminal's interrupts miss it
                start_new_session=True,
            )
        except BaseException:
            for end in ends:
                os.close(end)
            raise
        os.close(child_reading)
        os.close(child_writing)
        assert self._popen.stderr is not None
        self._stderr = self._popen.stderr
        for descriptor in (self._reading, self._writing, self._stderr.fileno()):
            os.set_blocking(descriptor, False)

    def __str__(self) -> str:
        return self._name

    # -- episodes ---------------------------------------------------------------------------------

    def begin(self, start: bytes) -> dict[str, Any]:
        """Begin an episode with a line; return the first frame, as ``next_frame``."""
        stopped = self.state == "stopped"
        # First, because the process may have exited.
        self.state, self.number, self.time, self._frames = "running", 0, None, 0
        if self._rest or self._reading in dict(self._output.poll(0)):
            frame = self.receive()
            self.refuse(frame, f"has sent {short_repr(frame)} before the start of an episode")
        self.send(start)
        frame = self.next_frame()
        if stopped and "end" in frame:
            self.refuse(
                frame,
                (
                    f'has sent {short_repr(frame)} after "stop"; it must be silent until the next'
                    " start"
                ),
            )
        return frame

    def next_frame(self) -> dict[str, Any]:
        """Wait for the next frame of the episode, a "decide", "expect", "update", "remove" or "end", and check it.

        All but the last always get an item "entity"; of "expect", each item gets it.

        Raises:
            ProcessDiedError, ProcessTimeoutError: As ``receive``.
            WireError: The frame is invalid.
            RemoteError: The model raised an error.
        """
        frame = self.receive()
        try:
            time = check_frame(frame, self.points)
        except WireError as error:
            self.fail(WireError(f"{self} has {error}"))
        if time is not None:
            self.time = time
        if "end" in frame:
            self.state = "idle"
        elif "decide" in frame:
            number, due = frame["decide"], self.number + 1
            if type(number) is not int or number != due:
                self.fail(
                    WireError(f"{self} has made call {short_repr(number)} where call {due} was due")
                )
            self.number, self.state, self._frames = number, "waiting", 0
        elif not (
            "update" in frame or "remove" in frame or ("expect" in frame and "expect" in self.can)
        ):
            unasked = [name for name in ("decided", "expect") if name in frame]
            why = (
                'is not due, or not in the "can" of its hello'
                if unasked
                else "is not a frame of the wire"
            )
            self.refuse(frame, f"has sent {short_repr(frame)}, which {why}")
        if self.state == "running":
            self._check_flood()
        return frame

    def _check_flood(self) -> None:
        """Count a frame that is neither a call nor an end, so that such frames end some time."""
        if not self._frames:  # the first one since the latest call
            self._bytes, self._since = 0, monotonic()
        self._frames, self._bytes = self._frames + 1, self._bytes + self._length
        if self._frames > MOST_FRAMES or self._bytes > MOST_BYTES:
            what = f"{self._frames:,} frames of {self._bytes:,} bytes"
            self.fail(
                WireError(
                    f"{self} has sent {what} since its latest call, and neither a call nor an end"
                )
            )
        if monotonic() - self._since > MOST_WAITS * self.timeout:
            what = f"has sent updates and removals for {MOST_WAITS * self.timeout:g} s, and neither a call nor an end"
            self.fail(ProcessTimeoutError(f"{self} {what}"))

    def leave_to_rule(self, before: bytes = b"") -> Any:
        """Answer the call by the process's rule, after other lines.

        Returns:
            The rule's decision; ``RULE`` if the process does not tell it.

        Raises:
            WireError: The process tells another thing. Other errors are those of ``receive``.
        """
        self.answer(before + encode_answer(self.number, RULE))
        if "decided" not in self.can:
            return RULE
        frame = self.receive()
        if (
            frame.get("decided") != self.number
            or type(frame["decided"]) is not int
            or "value" not in frame
        ):
            due = f'{{"decided": {self.number}, "value": ...}} was due: what its rule decided'
            self.refuse(frame, f"has sent {short_repr(frame)} where {due}")
        return frame["value"]

    def answer(self, lines: bytes) -> None:
        """Send the lines that answer the call for which it waits."""
        self.state = "running"
        self.send(lines)

    def break_off(self) -> None:
        """End the episode, if one is under way: a waiting process unwinds, a running one is ended."""
        if self.usable and self.state == "waiting":
            self.state = "stopped"
            with suppress(SimEnvError):  # it is ended then, and the next episode starts a new one
                self.send(STOP)
        elif self.usable and self.state == "running":
            self.close(patience=0.0)

    # -- lines ------------------------------------------------------------------------------------

    def receive(self) -> dict[str, Any]:
        """Wait for the next frame.

        Raises:
            ProcessDiedError: The process has ended, or has closed its pipe.
            ProcessTimeoutError: Nothing came.
            WireError: It sent something that is not a frame.
        """
        begun, reading = monotonic(), self._reading
        line, complete, self._rest = self._rest.partition(b"\n")
        while not complete:
            self._wait(self._output, reading, begun, "half a line" if line else "nothing")
            chunk = os.read(reading, CHUNK)
            if not chunk:
                self._wait_for_exit(GRACE)
                where = " in the middle of a line" if line else ""
                self.fail(
                    ProcessDiedError(f"{self} has closed its pipe{where}, and {self._exit()}")
                )
            part, complete, self._rest = chunk.partition(b"\n")
            line += part
            if len(line) >= LONGEST:
                self.fail(WireError(f"{self} has sent a line of more than {LONGEST:,} bytes"))
        self._length = len(line)
        try:
            return decode(line)
        except WireError as error:
            self.fail(WireError(f"{self} has sent {error}"))

    def send(self, lines: bytes) -> None:
        """Send lines.

        If the process is gone, nothing happens here: ``receive`` raises the error, which may have
        the reason.

        Raises:
            ProcessTimeoutError: It does not read.
        """
        begun = 0.0
        if self._owner != os.getpid():
            raise WrongThreadError(
                f"{self} belongs to the process from which this one was forked; reset() starts"
                " another one"
            )
        while lines:
            try:
                lines = lines[os.write(self._writing, lines) :]
            except BrokenPipeError:
                return
            except BlockingIOError:
                begun = begun or monotonic()
                poll = self._poll(self._writing, select.POLLOUT)
                self._wait(poll, self._writing, begun, "nothing and read nothing")
            except OSError as error:  # its input is closed
                raise ProcessDiedError(f"{self} has been ended already") from error

    def _read_stderr(self) -> bool:
        """Read its standard error; return whether more may come."""
        try:
            chunk = os.read(self._stderr.fileno(), CHUNK)
        except BlockingIOError:
            return True
        self._tail += chunk
        del self._tail[:-STDERR_TAIL]
        return bool(chunk)

    def _poll(self, descriptor: int, event: int) -> select.poll:
        """Make an object that waits for an event and for standard error."""
        poll = select.poll()
        poll.register(descriptor, event)
        poll.register(self._stderr, select.POLLIN)
        return poll

    def _wait(self, poll: select.poll, descriptor: int, begun: float, sent: str) -> None:
        """Wait until a descriptor is ready; read standard error meanwhile."""
        found = False
        while not found:
            left = begun + self.timeout - monotonic()
            # it takes no more than some weeks
            for which, _ in poll.poll(1000 * max(0, min(left, 3600))):
                if which == descriptor:
                    found = True
                elif not self._read_stderr():
                    poll.unregister(which)
            if left <= 0:  # even if data keeps trickling in
                self.fail(
                    ProcessTimeoutError(
                        f"{self} {self._exit()}; it has sent {sent} for {self.timeout:g} s"
                    )
                )

    # -- ends -------------------------------------------------------------------------------------

    @property
    def usable(self) -> bool:
        """Whether it was not closed and belongs to this process."""
        return not self._closed and self._owner == os.getpid()

    def exit_code(self) -> int | None:
        """Return its exit code, or minus the signal that ended it.

        None while it runs; ``LOST`` if it is not known.
        """
        if self._popen.returncode is None:
            try:
                os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT)
            except ChildProcessError:  # ``poll`` would say 0
                self._popen.returncode = LOST
        return self._popen.poll()

    def fail(self, error: SimEnvError) -> NoReturn:
        """End the process at once, and raise an error with the last part of its standard error."""
        self.close(patience=0.0)
        text = self._tail.decode(errors="replace").strip()
        raise type(error)(
            f"{error}. The end of its standard error:\n{text}" if text else str(error)
        )

    def refuse(self, frame: Mapping[str, Any], what: str) -> NoReturn:
        """Raise the error that a frame reports, or say that the frame is invalid or not due."""
        error = frame.get("error")
        if not isinstance(error, dict):
            self.fail(WireError(f"{self} {what}"))
        kind, text, trace = (error.get(name) or "" for name in ("type", "text", "trace"))
        where = f"\n{trace}" if trace else ""
        self.fail(
            RemoteError(f"the model in {self} has raised {kind or 'an error'}: {text}{where}")
        )

    def close_input(self) -> None:
        """Close its input; its output can still be received."""
        if self._writing >= 0:
            os.close(self._writing)
            self._writing, self._without_input = -1, monotonic()  # when it was closed

    def close(self, patience: float = GRACE) -> None:
        """Close its pipes.

        ``patience`` seconds after the end of its input at the latest, kill it and its group.

        So processes whose inputs were closed together end together. A fork of this process only
        closes its copies of the pipes.
        """
        if self._closed:
            return
        self._closed, mine = True, self._owner == os.getpid()
        try:
            os.close(self._reading)
            self.close_input()
            if mine:
                self._wait_for_exit(self._without_input + patience - monotonic())
        finally:  # also after an interrupt
            if mine:
                self._kill()
            else:
                self._popen.returncode = 0  # only its owner waits for it
            self._stderr.close()

    def _kill(self) -> None:
        """Kill it and its group at once, and read the rest of its standard error."""
        with suppress(ProcessLookupError, PermissionError):  # the group is empty
            os.killpg(self.pid, signal.SIGKILL)
        guardian.release(self.pid)
        try:
            self._popen.wait(GRACE)
        except TimeoutExpired:
            warn_user(f"{self} was killed and has not ended yet", ResourceWarning)
        self._read_stderr()

    def _wait_for_exit(self, patience: float) -> None:
        """Wait for its exit, at most ``patience`` seconds."""
        deadline, pause = monotonic() + patience, 0.0005
        while self.exit_code() is None and monotonic() < deadline:
            self._read_stderr()
            sleep(pause)
            pause = min(2 * pause, 0.02)

    def _exit(self) -> str:
        """Describe its exit."""
        code = self.exit_code()
        if code is None:
            return "still runs"
        if code == LOST:
            return (
                "has ended; its exit code is lost, because this process ignores SIGCHLD or other"
                " code has read it"
            )
        if code >= 0:
            return f"has exited with code {code}"
        try:
            return f"was killed by {signal.Signals(-code).name}"
        except ValueError:
            return f"was killed by signal {-code}"


# -- at the end of this process -------------------------------------------------------------------

_children: Final[WeakSet[Child]] = WeakSet()


def _close_inputs() -> None:
    """Close the inputs of all simulators, so that those that do not notice are waited for together."""
    for child in list(_children):
        if child.usable:
            child.break_off()
            child.close_input()


# registers the hook by which finalizers run at exit, for this one to run before it
finalize(Child, int).detach()
atexit.register(_close_inputs)
