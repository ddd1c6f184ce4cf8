"""A simulator that does something wrong: ``python faulty.py WHAT``, one of ``FAULTS``."""

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
import outside


def _grandchild(wire):
    """Leave behind what holds the pipes, and go."""
    subprocess.Popen(["sleep", "600"], pass_fds=(wire.writing, wire.lines.fileno()))
    os._exit(5)


def _close(wire):
    os.close(wire.writing)
    time.sleep(600)


def _flood(wire):
    os.write(2, b"a last word\n")
    os.abort()


UPDATE = {"update": "a", "point": "reservoir.inflow", "args": {}}

FAULTS = {
    "garbage": lambda wire: wire.raw(b"hello?\n"),
    "half a line": lambda wire: (wire.raw(b'{"decide": 4'), os._exit(0)),
    "drop by drop": lambda wire: [(wire.raw(b"{"), time.sleep(0.05)) for _ in range(12_000)],
    "silence": lambda wire: time.sleep(600),
    "exit": lambda wire: os._exit(3),
    "crash": _flood,
    "closed": _close,
    "grandchild": _grandchild,
    "updates": lambda wire: [wire.send(UPDATE) for _ in range(10**6)],
    "slow updates": lambda wire: [(wire.send(UPDATE), time.sleep(0.01)) for _ in range(60_000)],
    "gigabyte": lambda wire: [wire.raw(bytes(1 << 20)) for _ in range(1 << 10)],
    "error": lambda wire: wire.send(
        {"error": {"type": "Flood", "text": "a dam broke", "trace": "dam.cpp:12"}}
    ),
}
"""What goes wrong in mid-episode, after three decisions."""


class Faulty:
    """A model that does it."""

    wire: Any
    what: str

    def __init__(self, seed, options):
        self.options = options

    def run(self, decide, *_):
        """Decide three times, then do it."""
        try:
            for _ in range(3):
                decide(
                    "reservoir.inflow", "a", None, {"level": 1.0, "queue-length": 0}, lambda: 1.0
                )
        except outside.Stopped:
            if self.what == "end after stop":
                self.wire.send({"end": {}})
            raise
        if not self.options.get("well"):
            FAULTS[self.what](self.wire)
            self.wire.receive()

    def result(self):
        """Nothing came of it."""


if __name__ == "__main__":
    Faulty.wire, Faulty.what = outside.Wire(), sys.argv[1]
    print("there are many words", file=sys.stderr)
    Faulty.wire.play(Faulty, outside.POINTS)
