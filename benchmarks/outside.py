"""What a decision costs that a simulator in another process asks for, beside the least that a pipe and JSON cost.

Run with ``make benchmark``, or alone with ``python -m benchmarks.core --only outside``. It takes a compiler for C++.
The time is the processor's, of both processes, which take turns on one core. What two cores bring is measured beside
it, by the wall clock.
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
from simenv_marl import ProcessSimulation, aec_env, make_step

COMPILER = shutil.which("g++") or shutil.which("clang++")

TURN = make_step(
    observation_space=OBSERVATION_SPACE,
    observation_space_mapping=lambda call: call.values,
    action_space=ACTION_SPACE,
    action_space_mapping=int,
    reward_mapping=lambda call: 1.0,
    agent=lambda call: call.entity,
)

OURS, BARE, PLAIN = "AEC, C++", "a line of JSON to and fro", "the plain C++"


class PingPong:
    """A process that sends a line for each line that it gets, and nothing more on either side than JSON."""

    def __init__(self, program: Path) -> None:
        theirs_in, self._out = os.pipe()
        self._in, theirs_out = os.pipe()
        descriptors = (theirs_in, theirs_out)
        self._process = subprocess.Popen([str(program), *map(str, descriptors)], pass_fds=descriptors)
        self.number = self._process.pid
        for descriptor in descriptors:
            os.close(descriptor)

    def play(self, number: int) -> None:
        """So many lines."""
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
    """A program, compiled."""
    program = Path(folder) / name
    sources = [f"-I{ROOT / 'clients' / 'cpp'}", str(ROOT / "benchmarks" / "cpp" / f"{name}.cpp")]
    subprocess.run([str(COMPILER), "-std=c++17", "-O2", *sources, "-o", str(program)], check=True, timeout=300)
    return program


def children() -> set[int]:
    """The processes that this one has started."""
    return {int(process) for process in Path(f"/proc/self/task/{os.getpid()}/children").read_text("ascii").split()}


def processors(process: int) -> Callable[[], float]:
    """A clock of the processor's time that this process and another one take."""
    clock = ~process << 3 | 2  # the number of the clock of a process, as Linux has it
    return lambda: time.process_time() + time.clock_gettime(clock)


def compared(rounds: int, number: int, *, wall: bool = False) -> Times:
    """Compare the AEC view of the process that asks with the other process, and with the same program by itself."""
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
    """By how much a decision takes longer than without an environment, in units of a line to and fro."""
    over = [ours - plain for ours, plain in zip(times[OURS], times[PLAIN], strict=True)]
    return ratio({OURS: over, BARE: times[BARE]}, OURS, BARE)


def measure(rounds: int, number: int) -> Section:
    """Measure in so many rounds, with so many decisions of a contender in each."""
    section = Section("A simulator in another process", "microseconds per decision")
    if COMPILER is None:
        section.remarks.append("A simulator in another process: no compiler for C++, so that nothing was measured.")
        return section
    number = max(number // 10, 100)
    with on({min(os.sched_getaffinity(0))}):
        times = compared(rounds, number)
    section.ratio("AEC, C++, over the plain C++ / a line of JSON to and fro", over_the_plain(times), 1.6, 1.3)
    if (os.cpu_count() or 1) > 1:
        apart, ours, bare = alone("outside", str(min(rounds, 9)), str(number), cores="0,1")
        section.ratio("the same on two cores, by the wall clock", apart)
        section.time(f"{OURS}, on two cores", ours)
        section.time(f"{BARE}, on two cores", bare)
    section.times(times)
    return section


def main(rounds: int, number: int) -> None:
    """Measure by the wall clock, on all cores that this process has."""
    times = compared(rounds, number, wall=True)
    print(json.dumps([over_the_plain(times), *(statistics.median(times[name]) for name in (OURS, BARE))]))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
