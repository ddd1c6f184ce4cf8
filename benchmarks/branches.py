"""The cost of branches and clones beside the minimum for the task, and the speed-up by two cores.

Times are wall-clock times, as these are processes. On one core, branches run one after another.
"""

from __future__ import annotations

import os
import pickle
import random
import socket
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from examples.greenhouse_coop.env import env as make_greenhouse

from benchmarks.measure import Contender, Group, Row, timer, two_cores
from benchmarks.noop import Alone, Busy, Model, steps
from simenv_marl import branch, clone, reseed_generators, single_env
from simenv_marl.planning import TreeSearchPolicy
from simenv_marl.planning.tree import Tree

BRANCHES, STEPS = 20, 10
MANY = 64
"""The number of branches that are spread over two cores."""


class Chancy(Alone):
    """One agent, whose simulation has a generator."""

    def reset(self, seed: int | None = None) -> None:
        super().reset()
        self.random = random.Random(seed)

    def reseed(self, seed: int) -> None:
        reseed_generators(self, seed)


class Slow(Busy):
    """A simulation that takes 10 milliseconds per decision."""

    seconds = 10e-3


def groups(number: int) -> Iterator[Group]:
    """Yield the rows.

    The number of decisions does not matter, but a smoke test has few branches.
    """
    count, many = min(BRANCHES, number // 40), min(MANY, number // 40)
    env = single_env(Chancy, Model.left)
    env.reset(seed=0)
    least = milliseconds(lambda: [by_hand(env, number) for number in range(count)], count)
    ours = milliseconds(lambda: branch(env, some_steps, count, method="fork"), count)
    with_seeds = milliseconds(
        lambda: branch(env, some_steps, count, method="fork", seeds=range(count)), count
    )
    replay = milliseconds(lambda: branch(env, some_steps, count, method="replay"), count)
    what, hand = "a branch of ten steps", "os.fork and a pipe by hand"
    yield Group(
        [
            Row(f"{what} / {hand}", ours, least, 1.6, 1.3, unit="ms"),
            Row(f"{what}, with seeds / {hand}", with_seeds, least, unit="ms"),
            Row(f"{what}, replayed / {hand}", replay, least, unit="ms"),
        ]
    )
    ours = milliseconds(lambda: [clone(env, method="fork").close() for _ in range(count)], count)
    least = milliseconds(lambda: [os.waitpid(child(int), 0) for _ in range(count)], count)
    yield Group(
        [Row("a clone, made and closed / os.fork by hand", ours, least, 2.0, 1.5, unit="ms")]
    )
    number, clock = min(number, 1_000), time.perf_counter
    through, direct = (steps(each, 0, number, clock) for each in (clone(env, method="fork"), env))
    row = Row(
        "a step of a clone / a round trip to a process by hand",
        through,
        timer(echo(), number, clock),
    )
    yield Group(
        [row, Row("a step of a clone, less a step", lambda: through() - direct(), None, 110, 80)]
    )
    memory = partial(memory_of_clones, min(300, number // 2))
    yield Group(
        [Row("memory of each of 300 clones of the greenhouse", memory, None, 3, 2, unit="MiB")],
        most=1,
    )
    env.close()
    env = single_env(Slow, Model.left)
    env.reset(seed=0)
    with two_cores():
        two = milliseconds(
            lambda: branch(env, lambda env, _: env.step(0)[1], many, method="fork"), many
        )

        def one() -> float:
            both = os.sched_getaffinity(0)
            os.sched_setaffinity(0, {min(both)})
            try:
                return two()
            finally:
                os.sched_setaffinity(0, both)

        row = Row(
            "branches of 10 ms: two cores beside one", two, one, 1.7, 1.9, faster=True, unit="ms"
        )
        yield Group([row], most=9)
    env.close()
    kept, replayed = (search(8 if number < 400 else 64, keeps=keeps) for keeps in (True, False))
    what = "a tree search with states kept / replayed, steps of 5 ms, depth 8"
    yield Group([Row(what, kept, replayed, 0.6, 0.4, unit="ms")], most=3)


class ReplayingTree(Tree):
    """A tree in which each rollout begins at the pending decision."""

    def begin_checkpoints(self) -> None:
        """Keep no states."""


def search(budget: int, *, keeps: bool) -> Contender:
    """Make a contender of a search for one decision, in one exact future, which may keep states."""
    simulation = Busy()
    simulation.seconds = 5e-3
    env = single_env(simulation, Model.left)
    env.reset(seed=0)
    policy = TreeSearchPolicy([0, 1], depth=8, horizon=8, budget=budget)
    if not keeps:
        vars(policy)["_rollouts"] = ReplayingTree
    warnings.filterwarnings("ignore", ".*foresees")  # with one future, it does
    return milliseconds(lambda: policy.choose(env), 1)


def some_steps(env: Any, number: int) -> float:
    """Take the steps of a branch."""
    step, total = env.step, 0.0
    for _ in range(STEPS):
        total += step(0)[1]
    return total


def milliseconds(run: Callable[[], Any], number: int) -> Contender:
    """Make a contender of a number of branches: the milliseconds of each."""
    microseconds = timer(lambda number: run(), number, time.perf_counter)
    return lambda: microseconds() / 1e3


def by_hand(env: Any, number: int) -> Any:
    """Do the same in a process that is forked by hand and answers through a pipe."""
    reading, writing = os.pipe()
    process = child(lambda: os.write(writing, pickle.dumps(some_steps(env, number))))
    os.close(writing)
    answer = os.read(reading, 1 << 16)
    os.close(reading)
    os.waitpid(process, 0)
    return pickle.loads(answer)


def child(main: Callable[[], Any]) -> int:
    """Fork a process that only calls a function; return its number."""
    process = os.fork()
    if process == 0:
        main()
        os._exit(0)
    return process


def echo() -> Callable[[int], None]:
    """Fork a process that sends back what it receives.

    Return a function that sends it a number of messages.
    """
    here, there = socket.socketpair()

    def answer() -> None:
        here.close()
        while message := there.recv(1 << 16):
            there.sendall(message)

    def ask(number: int) -> None:
        for _ in range(number):
            here.sendall(bytes(100))
            here.recv(1 << 16)

    child(answer)
    there.close()
    return ask


def memory_of_clones(number: int = 300) -> float:
    """Measure the growth of the memory of all processes per clone of a greenhouse, in MiB."""
    env, own = make_greenhouse(), str(os.getpid())
    env.reset(seed=0)

    def memory() -> int:
        """What n processes share counts as an n-th in each."""
        kib = 0
        for path in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):  # it has just ended
                if own in (path.name, (path / "stat").read_text().rpartition(")")[2].split()[1]):
                    kib += int(
                        (path / "smaps_rollup").read_text().partition("\nPss:")[2].split()[0]
                    )
        return kib

    before, clones = memory(), [clone(env, method="fork") for _ in range(number)]
    time.sleep(1.0)  # until all have started
    return (memory() - before) / len(clones) / 1024
