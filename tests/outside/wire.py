"""The other side of the wire for tests: a child over two pipes, told and asked frame by frame; each wait has an end."""

from __future__ import annotations

import json
import os
import select
import subprocess
import time
from pathlib import Path
from typing import Any

PATIENCE = 20.0
"""Seconds that any wait may take."""


class Child:
    """A process that speaks the wire, whose frames are written and read by hand."""

    def __init__(self, *command: str | Path) -> None:
        read_by_child, self.out = os.pipe()
        self.into, written_by_child = os.pipe()
        self.descriptors = (read_by_child, written_by_child)
        self._rest = b""
        self.process = subprocess.Popen(
            [str(part) for part in command],
            env=os.environ | {"SIMENV_MARL_FDS": "{},{}".format(*self.descriptors)},
            pass_fds=self.descriptors,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        )
        for descriptor in self.descriptors:
            os.close(descriptor)

    def __enter__(self) -> Child:
        return self

    def __exit__(self, *_: object) -> None:
        for end in ("out", "into"):
            self.close(end)
        self.process.kill()
        self.process.communicate(timeout=PATIENCE)

    def close(self, end: str) -> None:
        """Close what is written to the child (``"out"``) or read from it (``"into"``)."""
        descriptor = getattr(self, end)
        if descriptor is not None:
            setattr(self, end, None)
            os.close(descriptor)

    def write(self, data: bytes) -> None:
        """Write bytes as they are."""
        try:
            while data:
                data = data[os.write(self.out, data) :]
        except BrokenPipeError:
            pass

    def send(self, **frame: Any) -> None:
        """Send a frame."""
        self.write(json.dumps(frame).encode() + b"\n")

    def receive(self) -> Any:
        """The next frame; None where the child has closed its end."""
        until = time.monotonic() + PATIENCE
        while b"\n" not in self._rest:
            if not select.select([self.into], [], [], max(until - time.monotonic(), 0.0))[0]:
                raise TimeoutError(f"no frame within {PATIENCE} s")
            got = os.read(self.into, 1 << 20)
            if not got:
                assert self._rest == b""
                return None
            self._rest += got
        line, _, self._rest = self._rest.partition(b"\n")
        return json.loads(line)

    def begin(self, seed: int = 0, **options: Any) -> Any:
        """Start an episode; return the first frame of it."""
        self.send(start={"seed": seed, "options": options})
        return self.receive()

    def act(self, number: int, value: Any) -> Any:
        """Answer a call; return the next frame."""
        self.send(act=number, value=value)
        return self.receive()

    def rule(self, number: int) -> Any:
        """Leave a call to the rule; return the next frame."""
        self.send(act=number, rule=True)
        return self.receive()

    def ended(self) -> tuple[int, str]:
        """Wait until the process has ended: its status, and what it has written on stderr."""
        _, errors = self.process.communicate(timeout=PATIENCE)
        return self.process.returncode, errors.decode()
