"""The cost of a decision for a simulator in another process, beside the minimum for a pipe and JSON.

Run it with ``make benchmark``, or alone with ``python -m benchmarks.core --only outside``. It needs a C++ compiler.
Times are processor times of both processes, which alternate on one core. The effect of two cores is measured as well,
in wall-clock time.
"""

from __future__ import annotations

import json
import os
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.branches import on
from benchmarks.hand_written import ACTION_SPACE, OBSERVATION_SPACE
from benchmarks.measure import ROOT, Section, Times, alone, ratio, side_by_side, timed
from benchmarks.noop import Model, Turns, aec, last_and_step
from simenv_marl import aec_env, make_step
from simenv_marl.remote import ProcessSimulation

COMPILER = shutil.which("g++") or shutil.which("clang++")

TURN = make_step(
    observation_space=OBSERVATION_SPACE,
    observation_space_mapping=lambda call: call.values,
    action_space=ACTION_SPACE,
    action_space_mapping=int,
    reward_mapping=lambda call: 1.0,
    agent=lambda call: call.entity,
)

OURS, BARE, PLAIN = "AEC, C++", "a JSON round trip", "the plain C++"


class PingPong:
    """A process that answers each line with a line; both sides only read and write JSON."""

    def __init__(self, program: Path) -> None:
        theirs_in, self._out = os.pipe()
        self._in, theirs_out = os.pipe()
        descriptors = (theirs_in, theirs_out)
        self._process = subprocess.Popen([str(program), *map(str, descriptors)], pass_fds=descriptors)
        self.number = self._process.pid
        for descriptor in descriptors:
            os.close(descriptor)

    def play(self, number: int) -> None:
        """Exchange a number of lines."""
        loads, dumps, reading, writing = json.loads, json.dumps, self._in, self._out
        for _ in range(number):
            frame = loads(os.read(reading, 65536))
            os.write(writing, dumps({"act": frame["decide"], "value": 1}).encode() + b"\n")

    def close(self) -> None:
        """End the process."""
        os.close(self._out)
        os.close(self._in)
        self._process.wait(timeout=10)


def compiled(name: str, folder: str) -> Path:
    """Compile a program."""
    program = Path(folder) / name
    sources = [f"-I{ROOT / 'clients' / 'cpp'}", str(ROOT / "benchmarks" / "cpp" / f"{name}.cpp")]
    subprocess.run([str(COMPILER), "-std=c++17", "-O2", *sources, "-o", str(program)], check=True, timeout=300)
    return program


def children() -> set[int]:
    """Return the child processes of this process."""
    return {int(process) for process in Path(f"/proc/self/task/{os.getpid()}/children").read_text("ascii").split()}


def processors(process: int) -> Callable[[], float]:
    """Make a clock of the processor time of this process and another one."""
    clock = ~process << 3 | 2  # Linux's number of the clock of a process
    return lambda: time.process_time() + time.clock_gettime(clock)


def compared(rounds: int, number: int, *, wall: bool = False) -> Times:
    """Compare the AEC view of a simulator process with the bare process and with the same program alone."""
    with TemporaryDirectory() as folder:
        noop, bare = compiled("noop", folder), PingPong(compiled("echo", folder))
        env = aec_env(ProcessSimulation([noop], {"noop.turn": TURN}))
        here = aec_env(Turns, [Model.left, Model.right])
        before = children()
        loop = last_and_step(env)
        (asking,) = children() - before
        clocks = [time.perf_counter] * 2 if wall else [processors(asking), processors(bare.number)]
        contenders = {
            OURS: timed(loop, number, clocks[0]),
            BARE: timed(bare.play, number, clocks[1]),
            "AEC, in this process": aec(here, number),
            PLAIN: lambda: float(subprocess.run([noop], check=True, capture_output=True, timeout=60).stdout.split()[0]),
        }
        times = side_by_side(contenders, rounds)
        for each in (env, here, bare):
            each.close()
    return times


def over_the_plain(times: Times) -> float:
    """Compute the additional time of a decision in an environment, in units of a JSON round trip."""
    over = [ours - plain for ours, plain in zip(times[OURS], times[PLAIN], strict=True)]
    return ratio({OURS: over, BARE: times[BARE]}, OURS, BARE)


def measure(rounds: int, number: int) -> Section:
    """Measure in a number of rounds, with a number of decisions of each contender."""
    section = Section("A simulator in another process", "microseconds per decision")
    if COMPILER is None:
        section.remarks.append("A simulator in another process: no compiler for C++, so that nothing was measured.")
        return section
    number = max(number // 10, 100)
    with on({min(os.sched_getaffinity(0))}):
        times = compared(rounds, number)
    section.ratio("AEC, C++, over the plain C++ / a JSON round trip", over_the_plain(times), 1.6, 1.3)
    if (os.cpu_count() or 1) > 1:
        apart, ours, bare = alone("outside", str(min(rounds, 9)), str(number), cores="0,1")
        section.ratio("the same on two cores, by the wall clock", apart)
        section.time(f"{OURS}, on two cores", ours)
        section.time(f"{BARE}, on two cores", bare)
    section.times(times)
    return section


def main(rounds: int, number: int) -> None:
    """Measure in wall-clock time, on all cores of this process."""
    times = compared(rounds, number, wall=True)
    print(json.dumps([over_the_plain(times), *(statistics.median(times[name]) for name in (OURS, BARE))]))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
