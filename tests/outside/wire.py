"""The environment's side of the wire for tests, played by hand, byte by byte."""

import json
import os
import signal
import subprocess
import threading
from contextlib import suppress

PATIENCE = 120.0
"""Seconds after which a process is killed, so that each wait has an end."""

INTEGERS = [0, -1, 2**63 - 1, -(2**63), 2**64 - 1, 2**53 + 1]
FLOATS = [
    0.0,
    -0.0,
    0.1,
    1 / 3,
    1.0,
    5e-324,
    2.2250738585072014e-308,
    1.7976931348623157e308,
    1e22,
    1e-7,
    12345678.125,
]
TEXTS = ["", '\x00\x1f\x7f "quoted" \\ / \b\f\n\r\t', "ä € 𝄞 \ufffd \u2028 \U0010ffff", "x" * 5000]
NAMED = [
    {"float": "nan"},
    {"float": "inf"},
    {"float": "-inf"},
    {"float": "nan", "other": 1},
    {"float": 1.0},
]
NESTED = [
    [],
    {},
    [[], {}, [[1, 2.5, "x"]], None],
    {"": {"a": [1]}, "float": "nan ", "ü": [None, True, False]},
]
VALUES = [None, True, *INTEGERS, *FLOATS, *TEXTS, *NAMED, *NESTED]
"""What a model can be sent, and sends back unchanged."""


class Child:
    """A process that speaks the wire, whose frames are written and read by hand."""

    def __init__(self, *command, **env):
        read_by_child, out = os.pipe()
        into, written_by_child = os.pipe()
        self.descriptors = (read_by_child, written_by_child)
        self.decided = []
        self.process = subprocess.Popen(
            [str(part) for part in command],
            env=os.environ | env | {"SIMENV_MARL_FDS": "{},{}".format(*self.descriptors)},
            pass_fds=self.descriptors,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
        for descriptor in self.descriptors:
            os.close(descriptor)
        self.out, self.into = os.fdopen(out, "wb", buffering=0), os.fdopen(into, "rb")
        self._end = threading.Timer(PATIENCE, os.killpg, [self.process.pid, signal.SIGKILL])
        self._end.start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._end.cancel()
        self.out.close()
        self.into.close()
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.communicate()

    def send(self, line=b"", **frame):
        """Send a frame, or bytes as they are."""
        data = line or json.dumps(frame).encode() + b"\n"
        with suppress(BrokenPipeError):
            while data:
                data = data[self.out.write(data) :]

    def receive(self):
        """The next frame; None where the child has closed its end."""
        line = self.into.readline()
        assert not line or line.endswith(b"\n")
        return json.loads(line, parse_constant=_refuse) if line else None

    def begin(self, seed=0, **options):
        """Start an episode; return the first frame of it."""
        self.send(start={"seed": seed, "options": options})
        return self.receive()

    def act(self, number, value):
        """Answer a call; return the next frame."""
        self.send(act=number, value=value)
        return self.receive()

    def rule(self, number):
        """Leave a call to the rule; return the next frame.

        What the rule decides is added to ``decided``.
        """
        self.send(act=number, rule=True)
        frame = self.receive()
        if frame is None or "decided" not in frame:
            return frame
        assert frame["decided"] == number
        self.decided.append(frame["value"])
        return self.receive()

    def play(self, choose=None, seed=7, **options):
        """Play an episode, each call answered by ``choose`` or left to the rule.

        Return them, and the last frame.
        """
        calls, frame = [], self.begin(seed, **options)
        while frame is not None and "decide" in frame:
            calls.append(frame)
            number = frame["decide"]
            frame = self.rule(number) if choose is None else self.act(number, choose(frame))
        return calls, frame

    def ended(self):
        """Wait until the process has ended; return its status, its stdout and its stderr."""
        output, errors = self.process.communicate()
        return self.process.returncode, output.decode(), errors.decode()


def _refuse(constant):
    raise ValueError(f"{constant} is no JSON")
