"""What tests ask of other processes."""

import os
import subprocess
import sys
import time
from pathlib import Path
from textwrap import dedent

from simenv_marl.core.plans.options import Options

ROOT = Path(__file__).parents[1]


def python(*words, status=0, **options):
    """Run Python where it finds the library and the tests, until it ends with that status."""
    path = os.pathsep.join([*filter(None, sys.path), str(ROOT)])
    given = {
        "env": {**os.environ, "PYTHONPATH": path, **options.pop("env", {})},
        "cwd": ROOT,
        "text": True,
        "timeout": 120,
    }
    done = subprocess.run(
        [sys.executable, *map(str, words)], capture_output=True, check=False, **given | options
    )
    assert done.returncode == status, (done.stdout, done.stderr)
    return done


def alone(function, *arguments):
    """Call a function of a test file in a fresh process, without open resources of other tests.

    Environments have the driver of the test that calls. The arguments are strings and numbers.
    """
    code = f"""
import gc
from simenv_marl.core.plans.options import Options
from {function.__module__} import {function.__name__}
gc.collect()
gc.freeze()  # so that the function's own collections look at what it makes
Options.__init__.__kwdefaults__["driver"] = {(Options.__init__.__kwdefaults__ or {})["driver"]!r}
{function.__name__}(*{arguments!r})
"""
    python("-c", code)


def run_code(*parts, status=0, options=()):
    """Run code in a process of its own, which ends with that status; return what it has printed.

    One that ends well prints no errors; one that hangs is ended.
    """
    done = python(*options, "-c", "\n".join(map(dedent, parts)), status=status)
    assert status or done.stderr == "", done.stdout + done.stderr
    return str(done.stdout)


def descriptors():
    """What this process has open: the descriptors, and what they lead to."""
    found = {}
    for number in os.listdir("/proc/self/fd"):
        try:
            found[number] = os.readlink(f"/proc/self/fd/{number}")
        except FileNotFoundError:  # the one that listed the folder
            continue
    return found


def runs(number):
    """Whether a process runs, and is no zombie."""
    try:
        os.kill(number, 0)
        if not Path("/proc/self").exists():
            return True
        return (
            Path(f"/proc/{number}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0]
            != "Z"
        )
    except (ProcessLookupError, FileNotFoundError):
        return False


def gone(number):
    """Whether a process ends within a generous time, for busy machines."""
    until = time.monotonic() + 60
    while runs(number) and time.monotonic() < until:
        time.sleep(0.01)
    return not runs(number)
