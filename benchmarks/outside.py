"""The cost of a decision of a simulator in another process, beside the minimum for a pipe and JSON.

Times are processor times of both processes, which alternate on one core; on two cores, they are
wall-clock times.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.hand_written import ACTION_SPACE, OBSERVATION_SPACE
from benchmarks.measure import ROOT, Group, MissingError, Row, timer, two_cores
from benchmarks.noop import aec
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


class PingPong:
    """A process that answers each line with a line; both sides only read and write JSON."""

    def __init__(self, program: Path) -> None:
        theirs_in, self._out = os.pipe()
        self._in, theirs_out = os.pipe()
        descriptors = (theirs_in, theirs_out)
        self._process = subprocess.Popen(
            [str(program), *map(str, descriptors)], pass_fds=descriptors
        )
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


def groups(number: int) -> Iterator[Group]:
    """Yield the rows, with a tenth of the number of decisions of each contender."""
    if COMPILER is None or not Path("/proc/self/task").exists():
        raise MissingError("Linux and a compiler for C++")
    number = max(number // 10, 100)
    with TemporaryDirectory() as folder:
        noop, echo = compiler(folder, "noop"), compiler(folder, "echo")
        yield from compare(noop, echo, number, "")
        with two_cores():
            yield from compare(noop, echo, number, ", on two cores", time.perf_counter)


def compare(
    noop: Path, echo: Path, number: int, where: str, *clock: Callable[[], float]
) -> Iterator[Group]:
    """Yield the row of the AEC view beside the bare process."""
    with ExitStack() as stack:
        env = stack.enter_context(closing(aec_env(ProcessSimulation([noop], {"noop.turn": TURN}))))
        env.reset(seed=0)
        asking = child(noop)
        bare = stack.enter_context(closing(PingPong(echo)))
        answering = child(echo)
        ours = aec(env, number, *(clock or [processors(asking)]))
        least = timer(bare.play, number, *(clock or [processors(answering)]))
        row = Row(
            f"AEC, C++ / a JSON round trip{where}", ours, least, *(() if clock else (1.6, 1.3))
        )
        yield Group([row], most=9 if clock else 1_000)


def compiler(folder: str, name: str) -> Path:
    """Compile a program."""
    program = Path(folder) / name
    sources = [f"-I{ROOT / 'clients' / 'cpp'}", str(ROOT / "benchmarks" / "cpp" / f"{name}.cpp")]
    subprocess.run(
        [str(COMPILER), "-std=c++17", "-O2", *sources, "-o", str(program)], check=True, timeout=300
    )
    return program


def child(program: Path) -> int:
    """Return the child process of this process that runs a program."""
    children = Path(f"/proc/self/task/{os.getpid()}/children").read_text("ascii").split()
    return next(
        int(process)
        for process in children
        if Path(f"/proc/{process}/exe").resolve() == program.resolve()
    )


def processors(process: int) -> Callable[[], float]:
    """Make a clock of the processor time of this process and another one."""
    clock = ~process << 3 | 2  # Linux's number of the clock of a process
    return lambda: time.process_time() + time.clock_gettime(clock)
