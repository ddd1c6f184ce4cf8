"""Branches: returns of functions, sharing between forks, and the chance that ``seeds=`` redraws.

That branches do what the environment would have done is asserted beside the same of clones, in
``test_clone.py``.
"""

import asyncio
import io
import mmap
import multiprocessing
import os
import random
import select
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import types
from contextlib import contextmanager
from functools import partial
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path
from textwrap import dedent

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import RULE, branch, clone, single_env
from simenv_marl.core.copies import separation
from simenv_marl.core.copies.separation import event_loops
from simenv_marl.core.episodes import episode as run
from simenv_marl.errors import (
    BranchError,
    ClosedError,
    EpisodeOverError,
    NotResetError,
    OptionValueError,
    ReentrancyError,
    ViewError,
    WorkerError,
)
from tests.core.test_global_rng import world
from tests.processes import gone, python, run_code
from tests.worlds.copied import POINTS, Lucky, Trip, future, move, trip
from tests.worlds.models import begun, define, fails
from tests.worlds.saved import choose, differing_branches, rest_of_archive

METHODS = pytest.mark.parametrize("method", ["fork", "replay"])


def ahead(twin, number):
    return future(twin)


def never(twin, number):
    raise AssertionError("there is no branch")


def children():
    return {
        line
        for path in Path("/proc/self/task").glob("*/children")
        for line in path.read_text().split()
    }


@METHODS
def test_branches_can_be_branched_again_a_few_times(method):
    def plan(twin, number):
        twin.step(number)
        return branch(
            twin,
            lambda deeper, second: (repr(deeper.step(second)), number, second),
            2,
            method=method,
        )

    def deeper(twin, number):
        return branch(twin, deeper, 1, method=method)

    env = trip(taken=0)
    found = branch(env, plan, 2, method=method)
    assert [[entry[1:] for entry in each] for each in found] == [[(0, 0), (0, 1)], [(1, 0), (1, 1)]]
    assert len({entry[0] for each in found for entry in each}) > 2
    with pytest.raises(BranchError, match="nested 4 deep"):
        branch(env, deeper, 1, method=method)


@METHODS
def test_branch_error_is_raised_unchanged_in_the_users_process(method):
    env = trip(simulation=type("Failing", (Trip,), {"reseed": lambda trip, seed: 1 / seed}))
    before, twins = world(), []

    def fail(twin, number):
        twins.append(twin)
        return 1 / (1 - number)

    with fails(ZeroDivisionError, "in branch 1"):
        branch(env, fail, 3, method=method)
    with fails(ZeroDivisionError, "reseeded; seed 0", "in branch 1"):
        branch(env, lambda twin, number: twins.append(twin), 2, method=method, seeds=[1, 0])
    assert world() == before
    assert len(twins) == (3 if method == "replay" else 0)
    for twin in twins:
        with pytest.raises(ClosedError, match="call reset"):
            twin.step(1)
    env.step(1)


class Unpicklable(Exception):
    def __init__(self, one, two):
        super().__init__(one)


@pytest.mark.parametrize(
    ("function", "limit", "message"),
    [
        (
            lambda twin, number: os.kill(os.getpid(), signal.SIGKILL),
            60,
            r"branch [01] has died.*signal 9",
        ),
        (lambda twin, number: os._exit(3), 60, r"branch [01] has died.*exit code 3"),
        (
            lambda twin, number: sys.exit(4),
            float("inf"),
            r"branch [01] has raised[\s\S]*SystemExit: 4",
        ),
        (lambda twin, number: (yield), 60, "cannot be pickled"),
        (lambda twin, number: Unpicklable(1, 2), 60, "cannot be pickled"),
        (lambda twin, number: time.sleep(600), 0.3, "longer than"),
    ],
)
def test_branch_that_dies_raises_an_error_and_the_env_continues(function, limit, message):
    env, before = trip(), children()
    with pytest.raises(BranchError, match=message):
        branch(env, function, 2, method="fork", time_limit=limit)
    assert env.step(1)[2] is False
    assert children() == before


def test_branch_names_an_error_that_cannot_be_pickled():
    def fail(twin, number):
        error = Unpicklable(1, 2)
        error.held = (step for step in ())
        raise error

    with pytest.raises(WorkerError, match="cannot be pickled: Unpicklable: 1") as caught:
        branch(trip(), fail, 1, method="fork")
    assert "in fail" in str(caught.value.__cause__)


@pytest.mark.skipif(
    not os.path.exists("/proc/self"), reason="what ends with its parent is Linux's to say"
)
def test_branch_that_ends_also_ends_its_nested_branches(tmp_path):
    def slow(twin, number):
        (tmp_path / str(os.getpid())).touch()
        time.sleep(600)

    for limit in (0.5, 2.0, 8.0, 32.0):  # until the branch in the branch begins within it
        with pytest.raises(BranchError, match="longer than"):
            branch(
                trip(),
                lambda twin, _: branch(twin, slow, 1, method="fork"),
                1,
                method="fork",
                time_limit=limit,
            )
        if inner := [int(path.name) for path in tmp_path.iterdir()]:
            break
    assert inner
    assert all(map(gone, inner))


def test_branch_by_replay_refuses_a_model_that_does_not_repeat_itself(tmp_path):
    dice = type("Dice", (Trip,), {"reset": lambda trip, seed=None: Trip.reset(trip)})
    env = trip(simulation=lambda: dice(tmp_path / "diary"))
    for copied in (partial(branch, env, never), partial(clone, env)):
        with pytest.raises(BranchError, match=r"the same seed and the same actions[\s\S]*fork"):
            copied(method="replay")
    told = (tmp_path / "diary").read_text().split(" None\n")
    assert told == ["reset", *["reset", "unwound", "closed"] * 2, ""]

    def moves(env, number=0):
        return [move(env) for _ in range(4)]

    twin, found = clone(env, method="fork"), branch(env, moves, 2, method="fork")
    assert found[0] == found[1] == moves(twin) == moves(env)


@pytest.mark.parametrize("view", ["single", "parallel"])
def test_branch_by_replay_is_refused_after_too_many_decisions(view, monkeypatch):
    monkeypatch.setattr(run, "LONGEST_TAPE", 3)
    env = trip(view, taken=0)
    for _ in range(2):
        env.reset(seed=3)
        for _ in range(4):
            assert branch(env, ahead, method="replay") == branch(env, ahead)
            move(env)
        with pytest.raises(BranchError, match="fork"):
            branch(env, ahead, method="replay")
    assert branch(env, ahead) == [future(env)]
    env = trip(taken=0, max_steps=4)
    assert [env.step(1)[3] for _ in range(4)] == [False, False, False, True]


@METHODS
def test_branch_refuses_envs_without_a_pending_decision(method):
    env = single_env(Trip, POINTS, agent="walker_0", max_steps=1)
    with pytest.raises(NotResetError, match="no episode yet"):
        branch(env, never, method=method)
    env.reset()
    assert (
        branch(env, never, 0, method=method) == branch(env, never, 0, method=method, seeds=[]) == []
    )
    env.step(1)
    with pytest.raises(EpisodeOverError, match="begin the next one"):
        branch(env, never, method=method, seeds=[1])
    with pytest.raises(ViewError, match="branch needs an environment of one simulation"):
        branch("env", never, method=method)


WRONG_SEEDS = [
    [],
    [1],
    [1, 2, 3],
    [1, True],
    [1, -1],
    [1, 2.0],
    [1, None],
    [1, "2"],
    "12",
    1,
    {1, 2},
    iter([1, 2]),
]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        *[({"n": n}, "n must be a non-negative integer") for n in (-1, 2.0, True, None)],
        *[({"time_limit": limit}, "time_limit") for limit in (0, float("nan"), "1")],
        *[
            ({"n": 2, "seeds": seeds}, "seeds must be n = 2 non-negative integers")
            for seeds in WRONG_SEEDS
        ],
        ({"method": "clone"}, "method must be"),
    ],
)
def test_branch_refuses_invalid_arguments(given, message):
    with pytest.raises(OptionValueError, match=message):
        branch(trip(), never, **given)


def test_branch_by_fork_refuses_the_thread_driver():
    with pytest.raises(OptionValueError, match=r'needs .* driver="greenlet"[\s\S]*"replay"'):
        branch(trip(driver="thread"), never, method="fork")


def test_branch_refuses_calls_from_a_policy_of_the_env():
    env = trip(taken=0, policies={"guide_0": lambda observation: branch(env, never)})
    with pytest.raises(ReentrancyError, match="was used from"):
        env.step(1)


@pytest.mark.skipif(
    not hasattr(os, "sched_setaffinity"), reason="the number of cores cannot be set"
)
def test_branch_runs_no_more_processes_at_a_time_than_there_are_cores(tmp_path):
    env = trip()

    def alone(twin, number):
        (tmp_path / str(number)).touch()
        time.sleep(0.1)
        there = len(list(tmp_path.iterdir()))
        (tmp_path / str(number)).unlink()
        return there

    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        assert branch(env, alone, 6, method="fork") == [1] * 6
    finally:
        os.sched_setaffinity(0, cores)


def test_branch_replays_actions_as_they_were_given():
    """Later changes by the user, a policy or the mapping do not count; no policy is asked twice."""
    walk, buffer, asked = next(iter(POINTS)), np.zeros(1, np.float32), []
    amount = define(
        agent="walker_0",
        action_space=spaces.Box(-9, 9, (1,), np.float32),
        action_space_mapping=lambda action: -action.__imul__(-1).item(),
    )

    def answer(observation=None):
        asked.append(1)
        buffer[0] += 0.25
        return buffer

    for agent, policies in (("guide_0", {"walker_0": answer}), ("walker_0", None)):
        env = begun(single_env(Trip, POINTS | {walk: amount}, agent=agent, policies=policies), 3)
        for _ in range(3):
            env.step(RULE if policies else answer())
        before = len(asked)
        places = branch(env, lambda twin, number: twin.simulation.place, 2, method="replay")
        assert places == [env.simulation.place] * 2
        assert len(asked) == before


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore:.* draws from the global generator")
def test_branches_and_clones_of_random_models_continue_exactly():
    """Also of files and of global generators.

    For a larger number: ``python -m tests.worlds.saved 10000 branches``.
    """
    differ, number = differing_branches(300)
    assert (differ, number >= 300) == (0, True)


# -- what forks share -----------------------------------------------------------------------------


class Holding:
    def reset(self, seed=None):
        self.chance, self.log = random.Random(seed), []

    def run(self):
        opened = self.open()
        with opened:
            for _ in range(6):
                self.log.append((choose(), self.chance.random()))


@contextmanager
def a_socket(model):
    one, other = socket.socketpair()
    with one, other:
        yield


@contextmanager
def a_child(model):
    with subprocess.Popen(["cat"], stdin=subprocess.PIPE):
        yield


@contextmanager
def a_thread(model):
    over = threading.Event()
    thread = threading.Thread(target=over.wait)
    thread.start()
    yield
    over.set()
    thread.join()


@contextmanager
def anonymous_memory(model):
    with mmap.mmap(-1, 100) as memory:
        yield memory


@contextmanager
def shared_memory(model):
    memory = SharedMemory(create=True, size=100)
    yield memory
    memory.close()
    memory.unlink()


def mapped(mode):
    @contextmanager
    def a_memmap(model):
        with tempfile.TemporaryFile() as file:
            file.write(bytes(80))
            file.flush()
            memory = np.memmap(file, float, mode, shape=10)
            yield
            del memory

    return a_memmap


@contextmanager
def a_semaphore(model):
    semaphore = multiprocessing.Semaphore()
    yield
    del semaphore


@contextmanager
def a_progress_bar(model):
    bar = pytest.importorskip("tqdm").tqdm(total=9, file=io.StringIO())
    assert bar.monitor.is_alive()
    yield
    bar.close()


def held_by(model):
    """An environment of a model that decides while it holds something."""
    return begun(single_env(model, choose), 4)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("held", "name"),
    [
        (a_socket, "a socket"),
        (a_child, "a child process"),
        (a_thread, "a thread"),
        (anonymous_memory, r"shared memory \(/dev/zero"),
        (shared_memory, r"shared memory \(/dev/shm/"),
        (mapped("w+"), r"shared memory \(/tmp/"),
        (mapped("r+"), r"shared memory \(/tmp/"),
    ],
)
def test_branch_replays_or_names_the_resource_that_prevents_a_fork(held, name):
    env = held_by(type("Model", (Holding,), {"open": held}))
    env.step(1)
    for copied in (partial(branch, env, never), partial(clone, env)):
        with pytest.raises(BranchError, match=f"{name}.*replay"):
            copied(method="fork")
    found, twin = branch(env, rest_of_archive, 2), clone(env)
    deeper = clone(twin)
    assert deeper.call(lambda env: os.getpid()) == os.getpid()
    for each in (deeper, twin, env):  # to its end, or its thread stays
        found.append(rest_of_archive(each))
    assert found == [found[0]] * 5


def test_branch_forks_a_model_that_shows_a_progress_bar(monkeypatch):
    tqdm = pytest.importorskip("tqdm").tqdm
    monkeypatch.setattr(tqdm, "monitor", None)  # so that this model starts it
    env = held_by(type("Model", (Holding,), {"open": a_progress_bar}))
    assert branch(env, rest_of_archive, 1, method="fork") == [rest_of_archive(env)]
    tqdm.monitor.exit()


@pytest.mark.parametrize("held", [mapped("r"), mapped("c"), a_semaphore])
def test_branch_forks_a_model_with_read_only_shared_memory(held):
    env = held_by(type("Model", (Holding,), {"open": held}))
    with anonymous_memory(None):  # which the simulation does not hold
        assert branch(env, rest_of_archive, 1, method="fork") == [rest_of_archive(env)]


@pytest.mark.thorough
def test_branch_forks_despite_memory_shared_before_the_import():
    code = """
import mmap
memory = mmap.mmap(-1, 100)
from simenv_marl import branch
from tests.worlds.copied import trip
env = trip()
print(branch(env, lambda env, number: number, 1, method="fork"))
"""
    assert run_code(code) == "[0]\n"


def test_branch_forks_despite_open_resources_of_the_user():
    env, (one, other) = trip(), socket.socketpair()
    with one, other, mmap.mmap(-1, 100), subprocess.Popen(["cat"], stdin=subprocess.PIPE):
        assert branch(env, lambda twin, number: os.getpid(), method="fork") != [os.getpid()]


class Listening(Holding):
    def run(self):
        asyncio.run(self.listen())

    async def listen(self):
        loop, (reading, writing) = asyncio.get_running_loop(), os.pipe()
        for number in range(3):
            heard = loop.create_future()
            loop.add_reader(
                reading, lambda heard=heard: heard.done() or heard.set_result(os.read(reading, 1))
            )
            choose()
            os.write(writing, bytes([number]))
            self.log.append(await asyncio.wait_for(heard, 10))
        loop.remove_reader(reading)
        os.close(reading)
        os.close(writing)


def test_branch_by_fork_continues_asyncio_event_loops(monkeypatch):
    env = held_by(Listening)
    env.step(1)
    assert (
        branch(env, rest_of_archive, 1, method="fork")
        == [rest_of_archive(env)]
        == [[b"\0", b"\1", b"\2"]]
    )
    monkeypatch.delitem(sys.modules, "asyncio.selector_events")  # as where asyncio is not imported
    assert event_loops() == []


class Polling(Holding):
    """Waits for a pipe that can be read at once, of which it is told once."""

    def run(self):
        reading, writing = os.pipe()
        os.write(writing, b"x")
        with select.epoll() as poll:
            poll.register(reading, select.EPOLLIN | select.EPOLLONESHOT)
            for _ in range(2):
                choose()
                self.log.append(len(poll.poll(0)))
        os.close(reading)
        os.close(writing)


@pytest.mark.skipif(not hasattr(select, "epoll"), reason="only Linux has epoll")
def test_branch_replays_simulations_with_an_epoll_object():
    env = held_by(Polling)
    with pytest.raises(BranchError, match=r"an epoll object \(descriptor \d+\).*replay"):
        branch(env, rest_of_archive, 2, method="fork")
    assert branch(env, rest_of_archive, 2) == [[1, 0]] * 2
    assert rest_of_archive(env) == [1, 0]


@pytest.mark.thorough
@pytest.mark.parametrize("flush", [False, True])
def test_branches_and_clones_print_their_output_once_and_in_order(flush):
    code = f"""
        from simenv_marl import branch, clone
        from tests.worlds.copied import trip

        env = trip()
        print("before", flush={flush})
        branch(env, lambda env, number: print("in", number, flush={flush}), method="fork")
        twin = clone(env, method="fork")
        twin.unwrapped.call(lambda env: print("in a clone", flush={flush}))
        print("after", flush=True)
    """
    ran = python("-W", "error", "-c", dedent(code), env={"PYTHONUNBUFFERED": ""})
    assert ran.stdout.splitlines() == ["before", "in 0", "in a clone", "after"]
    assert ran.stderr == ""


# -- chance that is drawn anew --------------------------------------------------------------------


@METHODS
def test_branch_with_a_seed_keeps_the_present_observation_and_reward(method):
    class Reseeded(Trip):
        def reseed(self, seed):
            super().reseed(seed)
            self.place += 1000
            self.chosen = self.walk()

    def present(twin, number):
        return repr(twin.episode.pending.observation), twin.simulation.place, twin.simulation.chosen

    env = trip(simulation=Reseeded)
    seen, place = repr(env.episode.pending.observation), env.simulation.place + 1000
    expected = [(seen, place, random.Random(seed).choice([-1, 1])) for seed in range(8)]
    assert branch(env, present, 8, method=method, seeds=range(8)) == expected


def drawn(env, number):
    """What a base that draws from the global generators would draw."""
    return random.random(), random.gauss(0, 1), np.random.random(), np.random.standard_normal()


@METHODS
def test_branch_seeds_global_generators_for_each_future(method):
    """Those of a base policy: alike for the same seeds, and not with the simulation's numbers."""
    env = trip(simulation=Lucky, global_rng=True)

    def base(twin, number):
        with twin.session.context():
            own = drawn(twin, number)
        return drawn(twin, number), own, twin.simulation.random.random()

    found = branch(env, base, 3, method=method, seeds=[7, 8, 7])
    assert found[0] == found[2] != found[1]
    assert found[0][2] != found[1][2]  # the simulation is reseeded, too
    assert found == branch(env, base, 3, seeds=[7, 8, 7])
    assert len({value for each in found[:2] for part in each[:2] for value in part}) == 16
    plain = [
        random.Random(7).random(),
        np.random.RandomState(7).random(),
        np.random.default_rng(7).random(),
    ]
    for child in np.random.SeedSequence(7).spawn(3):
        plain += [np.random.default_rng(part).random() for part in (child, *child.spawn(3))]
    assert not {*plain} & {value for part in found[0][:2] for value in part}


@METHODS
def test_branch_seeds_and_restores_any_global_numpy_bit_generator(method):
    """It is seeded whatever its kind, and put back as it was."""
    env, kept, mine = trip(), np.random.get_bit_generator(), np.random.PCG64(5)
    try:
        np.random.set_bit_generator(mine)
        state, sequence = mine.state, mine.seed_seq
        expected = branch(env, drawn, 2, method="fork", seeds=[1, 2])
        assert branch(env, drawn, 2, method=method, seeds=[1, 2]) == expected
        assert np.random.get_bit_generator() is mine
        assert (mine.state, mine.seed_seq) == (state, sequence)
    finally:
        np.random.set_bit_generator(kept)


@METHODS
def test_branch_seeds_torchs_generator_for_each_future(monkeypatch, method):
    """The threads do not come along, and torch would wait for them."""
    threads = []
    generator = types.SimpleNamespace(state=0, get_state=lambda: generator.state)
    generator.set_state = generator.manual_seed = lambda state: setattr(generator, "state", state)
    torch = types.ModuleType("torch")
    torch.set_num_threads, torch.default_generator = threads.append, generator
    monkeypatch.setitem(sys.modules, "torch", torch)
    found = branch(trip(), lambda *_: (generator.state, threads), 3, method=method, seeds=[1, 2, 1])
    assert 0 != found[0][0] == found[2][0] != found[1][0] != 0
    assert found[0][1] == ([1] if method == "fork" else [])
    assert (generator.state, threads) == (0, [])


@METHODS
def test_branch_with_seeds_refuses_a_model_without_reseed(monkeypatch, method):
    monkeypatch.setattr(os, "fork", None)
    for env in (held_by(Polling), trip(simulation=type("Fixed", (Trip,), {"reseed": None}))):
        with pytest.raises(BranchError, match=r"reseed\(seed\)[\s\S]*global_rng=True"):
            branch(env, never, 2, method=method, seeds=[1, 2])
        env.step(1)


def test_branch_forks_a_model_whose_open_file_is_garbage_collected(monkeypatch, tmp_path):
    """Garbage, such as the fonts of plots, may go at any time in the fork."""
    env = trip()
    replace = separation._replace
    with (tmp_path / "notes").open("w+") as file:

        def collect_and_replace(openings, path):
            if any(file.fileno() in opening.descriptors for opening in openings):
                os.close(file.fileno())
            replace(openings, path)

        monkeypatch.setattr(separation, "_replace", collect_and_replace)
        assert branch(env, lambda twin, number: number, 2, method="fork") == [0, 1]
    env.close()
