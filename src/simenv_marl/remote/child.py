"""The process of a simulator: starting it, sending and receiving frames, ending it.

Every wait has an end. While this process waits, it reads the standard error of the simulator, so
that the simulator never blocks; errors show the last part of it. The simulator leads a process
group, which ends with it.
"""

import os
import select
import signal
from collections.abc import Mapping, Sequence
from contextlib import suppress
from subprocess import DEVNULL, PIPE, Popen, TimeoutExpired
from time import monotonic, sleep
from typing import Final, Literal, NoReturn, TypeAlias

from ..errors import (
    ProcessDiedError,
    ProcessTimeoutError,
    RemoteError,
    SimEnvError,
    WireError,
    WrongThreadError,
    describe_error,
    short_repr,
)
from ..simulation import RULE, Model
from . import guardian
from .wire import (
    DESCRIPTORS,
    LONGEST,
    STOP,
    VERSION,
    Frame,
    check_frame,
    decode,
    encode,
    encode_answer,
    is_integer,
)

CHUNK: Final = 1 << 16
"""The number of bytes to read at once; pipes hold no more."""

STDERR_TAIL: Final = 4096
"""The number of bytes of its standard error that errors show."""

GRACE: Final = 2.0
"""The time in seconds that a process has to end by itself."""

MOST_FRAMES: Final = 100_000
"""The number of frames that may come between two calls.

Announced calls, updates and removals count.
"""

MOST_WAITS: Final = 20
"""The time that the frames between two calls may take, as a multiple of ``timeout``."""

LOST: Final = 1 << 16
"""The exit code of a process whose exit code was lost. No process can exit with it."""

StrPath: TypeAlias = str | os.PathLike[str]


class Child:
    """A simulator in another process, which speaks the protocol of ``wire``.

    Attributes:
        pid: The id of the process.
        launch: The command, timeout, environment variables and folder that it was started with.
        hello: Its first frame.
        points: The names of its decision points.
        can: Its further abilities, such as "reseed".
        timeout: The time to wait for each line, in seconds.
        state: "idle" between episodes, "running" its model, "waiting" for the answer to a call, or
            "stopped".
        number: The number of its latest call in the episode; 0 before the first one.
        rule_frame: The frame with the rule's decision of the latest call; None before it has come.
        time: Its latest time in the episode; None if it sent none.
    """

    state: Literal["idle", "running", "waiting", "stopped"] = "idle"
    number = 0
    rule_frame: Frame | None = None
    time: float | None = None

    _closed = False
    _exit_code_lost = False
    _buffer = b""  # of received bytes
    _frames = 0  # since the latest call
    _running_since = 0.0
    _seed: int | None = None  # to send with the next answer

    def __init__(
        self,
        command: Sequence[str],
        timeout: float,
        env: Mapping[str, str] | None = None,
        cwd: StrPath | None = None,
    ) -> None:
        """Start the process, and read its first frame.

        The arguments are described at ``ProcessSimulation``.

        Raises:
            ProcessDiedError, ProcessTimeoutError, WireError: It does not start, or breaks the rules
                of the protocol.
            RemoteError: It reported an error.
        """
        self.launch = command, timeout, env, cwd
        self.timeout = timeout
        self._owner = os.getpid()
        self._stderr_tail = bytearray()
        try:
            self._start()
        except (OSError, ValueError) as error:
            raise ProcessDiedError(
                f"{command[0]!r} cannot be started: {describe_error(error)}"
            ) from error
        self.pid = self._popen.pid
        try:
            guardian.guard(self.pid)
            self.hello = self.receive()
        except BaseException:  # an interrupt, too
            self.close(patience=0.0)
            raise
        self._check_hello()

    def _start(self) -> None:
        """Start the process with its pipes."""
        command, _, env, cwd = self.launch
        ends: list[int] = []
        try:
            ends += os.pipe()
            ends += os.pipe()
            theirs = ends[::3]  # to read from and to write to
            self._popen = Popen(
                command,
                stdin=DEVNULL,
                stderr=PIPE,
                bufsize=0,
                pass_fds=theirs,
                env={
                    **(os.environ if env is None else env),
                    DESCRIPTORS: ",".join(map(str, theirs)),
                },
                cwd=cwd,
                # so that its group can be ended, and a terminal's interrupts miss it
                start_new_session=True,
            )
        except BaseException:
            for end in ends:
                os.close(end)
            raise
        for end in theirs:
            os.close(end)
        _, self._writing, self._reading, _ = ends
        assert self._popen.stderr is not None
        self._stderr = self._popen.stderr
        for descriptor in (self._reading, self._writing, self._stderr.fileno()):
            os.set_blocking(descriptor, False)

    def _check_hello(self) -> None:
        hello = {"can": [], **self.hello}
        if "hello" not in hello:
            self.fail(f"began with {short_repr(hello)}, not with a hello")
        version = hello["hello"]
        if not is_integer(version, VERSION):
            self.fail(
                f"speaks version {short_repr(version)} of the wire; this is version {VERSION}"
            )
        for names in (hello.get("points"), hello["can"]):
            if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
                self.fail(
                    f'has said {short_repr(hello)}; its "points" and "can" must be lists of strings'
                )
        self.points = frozenset(hello["points"])
        self.can = frozenset(hello["can"])

    def __str__(self) -> str:
        return f"the process {self.pid} ({self.launch[0][0]})"

    # -- episodes ---------------------------------------------------------------------------------

    def begin(self, start: bytes) -> Frame:
        """Begin an episode with a line; return the first frame, as ``next_frame``."""
        stopped = self.state == "stopped"
        self.number = 0
        self.time = None
        self._seed = None
        self._set_running()  # before frames are read, because the process may have exited
        with suppress(BlockingIOError):
            self._buffer += os.read(self._reading, CHUNK)
        if self._buffer:
            self._refuse(self.receive(), " before the start of an episode")
        self.send(start)
        frame = self.next_frame()
        if stopped and "end" in frame:
            self._refuse(frame, ' after "stop"; it must be silent until the next start')
        return frame

    def next_frame(self) -> Frame:
        """Wait for the next frame of the episode, and check it.

        It is a "decide", "expect", "update", "remove" or "end". Calls, updates and removals get an
        item "entity", and so do the items of "expect".

        Raises:
            ProcessDiedError, ProcessTimeoutError: As ``receive``.
            WireError: The frame is invalid.
            RemoteError: The model raised an error.
        """
        frame = self.receive()
        try:
            time = check_frame(frame, self.points)
        except WireError as error:
            self.fail(f"has {error}")
        if time is not None:
            self.time = time
        match frame:
            case {"decide": number}:
                due = self.number + 1
                if not is_integer(number, due):
                    self.fail(f"has made call {short_repr(number)} where call {due} was due")
                self.number = due
                self.rule_frame = None
                self.state = "waiting"
            case {"end": _}:
                self.state = "idle"
            case {"update": _} | {"remove": _}:
                self._check_flood()
            case {"expect": _} if "expect" in self.can:
                self._check_flood()
            case {"expect": _} | {"decided": _}:
                self._refuse(frame, ', which is not due, or not in the "can" of its hello')
            case _:
                self._refuse(frame, ", which is not a frame of the wire")
        return frame

    def _set_running(self) -> None:
        """Begin to count the frames until the next call."""
        self.state = "running"
        self._frames = 0
        self._running_since = monotonic()

    def _check_flood(self) -> None:
        """Count a frame between two calls; limit the number and time of such frames."""
        self._frames += 1
        if self._frames > MOST_FRAMES:
            self.fail(
                f"has sent {self._frames:,} frames since its latest call, and neither a call nor an"
                " end"
            )
        limit = MOST_WAITS * self.timeout
        if monotonic() - self._running_since > limit:
            self.fail(
                f"has sent updates and removals for {limit:g} s, and neither a call nor an end",
                ProcessTimeoutError,
            )

    def reseed(self, seed: int) -> None:
        """Send a seed for the process's generators with the next answer."""
        self._seed = seed

    def decide_by_rule(self) -> Model:
        """Answer the call by the process's rule, at most once.

        Returns:
            The rule's decision; ``RULE`` if the process does not report it.

        Raises:
            WireError: The process sends another frame.
            ProcessError: As ``answer`` and ``receive``.
        """
        if self.rule_frame is None:
            self.answer(RULE)
            if "decided" not in self.can:
                return RULE
            match self.receive():
                case {"decided": number, "value": _} as frame if is_integer(number, self.number):
                    self.rule_frame = frame
                case frame:
                    self._refuse(
                        frame,
                        f' where {{"decided": {self.number}, "value": ...}} was due: the decision'
                        " of its rule",
                    )
        return self.rule_frame["value"]

    def answer(self, value: Model) -> None:
        """Answer the pending call, by a decision or ``RULE``.

        Raises:
            WireError: The decision is not JSON data.
            ProcessError: As ``send``.
        """
        lines = encode_answer(self.number, value)
        if self._seed is not None:
            lines = encode({"reseed": self._seed}) + lines
            self._seed = None
        self._set_running()
        self.send(lines)

    def break_off(self) -> None:
        """End the episode, if one is under way: a waiting process unwinds, a running one ends."""
        if not self.usable:
            return
        if self.state == "waiting":
            self.state = "stopped"
            with suppress(
                SimEnvError
            ):  # which has ended it, so that the next episode starts a new one
                self.send(STOP)
        elif self.state == "running":
            self.close(patience=0.0)

    # -- lines ------------------------------------------------------------------------------------

    def receive(self) -> Frame:
        """Wait for the next frame.

        Raises:
            ProcessDiedError: The process has ended, or has closed its pipe.
            ProcessTimeoutError: Nothing came.
            RemoteError: It reported an error.
            WireError: It sent a line that is not a frame.
        """
        deadline = monotonic() + self.timeout
        line, complete, self._buffer = self._buffer.partition(b"\n")
        while not complete:
            sent = "half a line" if line else "nothing"
            self._wait(self._reading, select.POLLIN, deadline, sent)
            chunk = os.read(self._reading, CHUNK)
            if not chunk:
                self._wait_for_exit(monotonic() + GRACE)
                where = " in the middle of a line" if line else ""
                self.fail(
                    f"has closed its pipe{where}, and {self._describe_exit()}", ProcessDiedError
                )
            part, complete, self._buffer = chunk.partition(b"\n")
            line += part
            if len(line) >= LONGEST:
                self.fail(f"has sent a line of more than {LONGEST:,} bytes")
        try:
            frame = decode(line)
        except WireError as error:
            self.fail(f"has sent {error}")
        if "error" in frame:
            match frame["error"]:
                case {**report}:
                    kind, text, trace = (report.get(key) or "" for key in ("type", "text", "trace"))
                    kind = kind or "an error"
                    self.fail(f"has raised {kind}: {text}\n{trace}".rstrip(), RemoteError)
        return frame

    def send(self, lines: bytes) -> None:
        """Send lines.

        If the process has ended, this does nothing, because ``receive`` raises an error with the
        reason.

        Raises:
            ProcessTimeoutError: It does not read.
            ProcessDiedError: It was closed before.
            WrongThreadError: This process is a fork of the one that started it.
        """
        if self._owner != os.getpid():
            raise WrongThreadError(
                f"{self} belongs to the process from which this one was forked; reset() starts"
                " another one"
            )
        deadline = monotonic() + self.timeout
        while lines:
            try:
                lines = lines[os.write(self._writing, lines) :]
            except BrokenPipeError:
                return
            except BlockingIOError:
                self._wait(self._writing, select.POLLOUT, deadline, "nothing and read nothing")
            except OSError as error:  # because its input is closed
                raise ProcessDiedError(f"{self} has been ended already") from error

    def _read_stderr(self) -> bool:
        """Read its standard error; return whether more may come."""
        chunk = self._stderr.read(CHUNK)  # None if nothing has come
        self._stderr_tail += chunk or b""
        del self._stderr_tail[:-STDERR_TAIL]
        return chunk != b""

    def _wait(self, descriptor: int, event: int, deadline: float, sent: str) -> None:
        """Wait for an event of a descriptor; read standard error meanwhile."""
        stderr = self._stderr.fileno()
        poll = select.poll()
        poll.register(descriptor, event)
        poll.register(stderr, select.POLLIN)
        while True:
            left = deadline - monotonic()
            if left <= 0:  # even if data keeps trickling in
                self.fail(
                    f"{self._describe_exit()}; it has sent {sent} for {self.timeout:g} s",
                    ProcessTimeoutError,
                )
            # at most an hour, because ``poll`` refuses more than some weeks
            ready = dict(poll.poll(1000 * min(left, 3600)))
            if stderr in ready and not self._read_stderr():
                poll.unregister(stderr)
            if descriptor in ready:
                return

    # -- ends -------------------------------------------------------------------------------------

    @property
    def usable(self) -> bool:
        """Whether it is open, and was started by this process."""
        return not self._closed and self._owner == os.getpid()

    def exit_code(self) -> int | None:
        """Return its exit code, or minus the signal that ended it.

        None while it runs; ``LOST`` if it is not known.
        """
        if self._popen.returncode is None:
            try:
                os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT)
            except ChildProcessError:  # for which ``poll`` would return 0
                self._exit_code_lost = True
        code = self._popen.poll()
        return LOST if self._exit_code_lost else code

    def fail(self, text: str, kind: type[SimEnvError] = WireError) -> NoReturn:
        """End the process at once, and raise an error.

        Its message has the name of the process, the text, and the last part of standard error.
        """
        self.close(patience=0.0)
        stderr = self._stderr_tail.decode(errors="replace").strip()
        if stderr:
            text = f"{text}. The end of its standard error:\n{stderr}"
        raise kind(f"{self} {text}")

    def _refuse(self, frame: Frame, reason: str) -> NoReturn:
        self.fail(f"has sent {short_repr(frame)}{reason}")

    def close_input(self) -> None:
        """Close its input; its output can still be received."""
        if self._writing >= 0:
            os.close(self._writing)
            self._writing = -1
            self._input_closed_at = monotonic()

    def close(self, patience: float = GRACE) -> None:
        """Close its pipes; kill it and its group ``patience`` seconds after the end of its input.

        The time runs from the end of the input, so that several processes can end together. A fork
        of this process only closes its copies of the pipes.
        """
        if self._closed:
            return
        owned = self.usable
        self._closed = True
        try:
            os.close(self._reading)
            self.close_input()
            if owned:
                self._wait_for_exit(self._input_closed_at + patience)
        finally:  # also after an interrupt
            if owned:
                self._kill()
            else:
                self._popen.poll()  # because Popen warns of processes that it believes to run
            self._stderr.close()

    def _kill(self) -> None:
        """Kill it and its group at once, and read the rest of its standard error."""
        with suppress(ProcessLookupError, PermissionError):  # the group is empty
            os.killpg(self.pid, signal.SIGKILL)
        guardian.release(self.pid)
        with suppress(TimeoutExpired):
            self._popen.wait(GRACE)
        self._read_stderr()

    def _wait_for_exit(self, deadline: float) -> None:
        pause = 0.0005
        while self.exit_code() is None and monotonic() < deadline:
            self._read_stderr()
            sleep(pause)
            pause = min(2 * pause, 0.02)

    def _describe_exit(self) -> str:
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
