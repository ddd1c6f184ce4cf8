"""A JVM beyond a pair of pipes, and the environment's side of the wire, byte by byte."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import time

PATIENCE = 30.0
"""Seconds after which any wait is a failure."""


class Child:
    """A process that speaks the wire, to which any bytes can be said."""

    def __init__(self, command, **environment):
        down, up = os.pipe(), os.pipe()
        self._write, self._read = down[1], up[0]
        self._rest = b""
        fds = {"SIMENV_MARL_FDS": f"{down[0]},{up[1]}"}
        self.process = subprocess.Popen(
            command,
            env=os.environ | fds | environment,
            pass_fds=(down[0], up[1]),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
        os.close(down[0])
        os.close(up[1])

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.hang_up()
        os.close(self._read)
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.communicate(timeout=PATIENCE)

    def say(self, frame):
        """Send a frame; bytes are sent as they are."""
        data = frame if isinstance(frame, bytes) else json.dumps(frame).encode() + b"\n"
        while data:
            data = data[os.write(self._write, data) :]

    def hear(self, patience=PATIENCE):
        """The next frame; None where the child has hung up."""
        deadline = time.monotonic() + patience
        while b"\n" not in self._rest:
            ready, *_ = select.select([self._read], [], [], max(0.0, deadline - time.monotonic()))
            assert ready, f"silent for {patience} s, after {self._rest[:200]!r}"
            data = os.read(self._read, 1 << 20)
            if not data:
                return None
            self._rest += data
        line, self._rest = self._rest.split(b"\n", 1)
        return json.loads(line, parse_constant=_refuse)

    def hang_up(self):
        """Close what the child reads from."""
        if self._write is not None:
            os.close(self._write)
            self._write = None

    def ended(self):
        """Wait for its end: the exit code, and what it has written."""
        out, err = self.process.communicate(timeout=PATIENCE)
        return self.process.returncode, out.decode(), err.decode()

    def start(self, seed=7, **options):
        """Begin an episode."""
        self.say({"start": {"seed": seed, "options": options}})

    def play(self, answer, seed=7, **options):
        """Play an episode: what ``answer`` of each call is sent back.

        Returns:
            The calls, and the frame that came last.
        """
        self.start(seed, **options)
        calls = []
        while True:
            frame = self.hear()
            if frame is None or "decide" not in frame:
                return calls, frame
            calls.append(frame)
            self.say({"act": frame["decide"]} | answer(frame))


def rule(call):
    return {"rule": True}


def _refuse(constant):
    raise ValueError(f"{constant} is no JSON")
