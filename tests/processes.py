"""What tests ask of other processes."""

import os
import time
from pathlib import Path


def runs(number: int) -> bool:
    """Whether a process runs, and is no zombie."""
    try:
        os.kill(number, 0)
        if not Path("/proc/self").exists():
            return True
        return Path(f"/proc/{number}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0] != "Z"
    except (ProcessLookupError, FileNotFoundError):
        return False


def gone(number: int) -> bool:
    """Whether a process ends, within a time that is long enough on a machine that is busy with other things."""
    until = time.monotonic() + 60
    while runs(number) and time.monotonic() < until:
        time.sleep(0.01)
    return not runs(number)
