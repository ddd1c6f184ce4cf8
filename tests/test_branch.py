"""Branches: exact continuations of an episode that is going on."""

import asyncio
import multiprocessing
import os
import random
import signal
import socket
import subprocess
import sys
import textwrap
import threading
import time
import types
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from pettingzoo.utils.wrappers import OrderEnforcingWrapper

from simenv_marl import aec_env, branch, difference, joint_env, parallel_env, single_env
from simenv_marl.core import run
from simenv_marl.core.branching import loops_on
from simenv_marl.errors import (
    BranchError,
    ClosedError,
    EpisodeOverError,
    NotResetError,
    OptionValueError,
    ReentrancyError,
    ViewError,
)
from tests.worlds import exactness, filing
from tests.worlds.copied import Walk
from tests.worlds.models import decision, define, script

ROOT = Path(__file__).parent.parent
METHODS = pytest.mark.parametrize("method", ["fork", "replay"])
VIEWS = pytest.mark.parametrize("make", [aec_env, parallel_env, single_env, joint_env])
POINTS = {
    Walk.choose: None,
    f"{Walk.__module__}.Walk.drift": define(
        agent="wind_0",
        observation_space=spaces.Box(-99, 99, (1,), np.float32),
        observation_space_mapping=lambda walk: [walk.place],
        reward_mapping=difference(lambda walk: walk.place),
    ),
}


def begun(env, seed=3):
    env.reset(seed=seed)
    return env


def move(env, number=0):
    if hasattr(env.unwrapped, "agent_iter"):
        observation, *rest = env.last()
        agent = env.agent_selection
        env.step(None if rest[1] or rest[2] else (env.action_space(agent).sample() + number) % 3)
        return repr((agent, observation, rest, env.rewards, env.infos, env.agents))
    if hasattr(env.unwrapped, "agents"):
        return repr(env.step({agent: (env.action_space(agent).sample() + number) % 3 for agent in env.agents}))
    return repr(env.step(env.action_space.sample()))


def rest_of(env, number=0):
    told = []
    while getattr(env.unwrapped, "agents", True) and not (told and "True" in told[-1] and not hasattr(env, "agents")):
        told.append(move(env, number))
    simulation = env.unwrapped.simulation
    return told, simulation.steps, simulation.place, simulation.random.random()


@METHODS
@VIEWS
def test_branches_are_what_the_environment_would_have_done(make, method):
    points = Walk.choose if make is single_env else POINTS
    for taken in range(5):
        env = begun(make(lambda: Walk(6), points))
        for _ in range(taken):
            move(env)
        same, other, different = branch(env, lambda twin, number: rest_of(twin, max(0, number - 1)), 3, method=method)
        assert same == other == rest_of(env)
        assert different != same or make in (single_env, joint_env)  # whose moves are all alike


@METHODS
def test_branches_of_branches(method):
    def plan(twin, number):
        twin.step(number)
        return branch(twin, lambda deeper, second: (deeper.step(second)[0].tolist(), number, second), 2, method=method)

    found = branch(going_on(steps=0), plan, 2, method=method)
    assert [[entry[1:] for entry in each] for each in found] == [[(0, 0), (0, 1)], [(1, 0), (1, 1)]]
    assert len({repr(entry[0]) for each in found for entry in each}) > 2


@METHODS
def test_wrappers_come_along(method):
    env = begun(TimeLimit(going_on(steps=0, length=9), 4), 1)
    env.step(1)

    def count(twin, number):
        steps = 1
        while not twin.step(1)[3]:
            steps += 1
        return type(twin), steps

    assert branch(env, count, 2, method=method) == [(TimeLimit, 3)] * 2
    assert env.step(1)[3] is False
    wrapped = begun(OrderEnforcingWrapper(aec_env(lambda: Walk(3), Walk.choose)), 1)
    assert branch(wrapped, lambda twin, number: (type(twin), twin.step(1)), 1, method=method) == [(type(wrapped), None)]


def going_on(model=Walk, length=6, steps=1, **options):
    env = begun(single_env(lambda: model(length), Walk.choose, **options))
    for _ in range(steps):
        env.step(1)
    return env


def short(env, number=0):
    return rest_of(env)


@pytest.mark.parametrize("options", [{"global_rng": True}, {"driver": "thread"}, {"max_steps": 3}])
def test_options_hold_in_branches(options):
    class Drawing(Walk):
        def drift(self):
            return random.random() if options.get("global_rng") else 0.0

    env = going_on(Drawing, **options)
    found = branch(env, short, 2)
    assert found[0] == found[1] == branch(env, short, 1, method="replay")[0] == rest_of(env)


def children():
    return {line for path in Path("/proc/self/task").glob("*/children") for line in path.read_text().split()}


class Unpicklable(Exception):
    def __init__(self, one, two):
        super().__init__(one)


@METHODS
def test_an_error_in_a_branch_surfaces_as_itself(method):
    def fail(twin, number):
        twin.step(1)
        return 1 / (1 - number)

    env = going_on()
    with pytest.raises(ZeroDivisionError) as caught:
        branch(env, fail, 3, method=method)
    assert "in branch 1" in "\n".join(caught.value.__notes__)
    with pytest.raises(ValueError, match="action"):
        branch(env, lambda twin, number: twin.step(99), 1, method=method)
    env.step(1)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda twin, number: os.kill(os.getpid(), signal.SIGKILL), r"branch [01] has died.*signal 9"),
        (lambda twin, number: os._exit(3), r"branch [01] has died.*exit code 3"),
        (lambda twin, number: sys.exit(4), r"branch [01] has raised[\s\S]*SystemExit: 4"),
        (lambda twin, number: (yield), "cannot be pickled"),
        (lambda twin, number: Unpicklable(1, 2), "cannot be pickled"),
    ],
)
def test_a_branch_that_dies_says_so_and_leaves_the_environment_whole(function, message):
    env, before = going_on(), children()
    with pytest.raises(BranchError, match=message):
        branch(env, function, 2, method="fork")
    assert env.step(1)[2] is False
    assert children() == before


def test_errors_that_are_not_made_of_their_arguments_or_cannot_be_pickled():
    def fail(twin, number):
        error = Unpicklable(1, 2)
        if number:
            error.held = (step for step in ())
        raise error

    with pytest.raises(Unpicklable):
        branch(going_on(), fail, 1, method="fork")
    with pytest.raises(BranchError, match="cannot be pickled: Unpicklable: 1") as caught:
        branch(going_on(), lambda twin, number: fail(twin, 1), 1, method="fork")
    assert "in fail" in str(caught.value.__cause__)


def test_a_branch_that_takes_too_long_is_ended():
    env, before = going_on(), children()
    with pytest.raises(BranchError, match="longer than"):
        branch(env, lambda twin, number: time.sleep(600), 2, method="fork", time_limit=0.3)
    assert children() == before
    env.step(1)
    assert branch(env, lambda twin, number: number, 2, method="fork", time_limit=float("inf")) == [0, 1]


def test_simulations_that_are_random_for_themselves():
    class Dice(Walk):
        def reset(self, seed=None):
            super().reset()

    env = going_on(Dice)
    with pytest.raises(BranchError, match=r"the same seed and the same actions[\s\S]*fork"):
        branch(env, short, 1, method="replay")
    found = branch(env, short, 2, method="fork")
    assert found[0] == found[1] == rest_of(env)


@pytest.mark.parametrize("make", [single_env, parallel_env])
def test_too_many_decisions_to_be_kept(make, monkeypatch):
    monkeypatch.setattr(run, "LONGEST_TAPE", 3)
    env = make(lambda: Walk(9), Walk.choose)
    for _ in range(2):
        env.reset(seed=3)
        for number in range(5):
            if number <= 3:
                assert branch(env, short, 1, method="replay") == branch(env, short, 1)
            move(env)
        with pytest.raises(BranchError, match="fork"):
            branch(env, short, 1, method="replay")
        found = branch(env, short, 1)
    assert found == [rest_of(env)]
    env = going_on(length=9, steps=0, max_steps=4)
    assert [env.step(1)[3] for _ in range(4)] == [False, False, False, True]


@METHODS
def test_what_cannot_be_continued(method):
    env, called = single_env(lambda: Walk(1), Walk.choose), []

    def calls(twin, number):
        called.append(number)

    with pytest.raises(NotResetError, match="no episode yet"):
        branch(env, calls, method=method)
    env.reset()
    for wrong in (-1, 2.0, True, False, "1", None):
        with pytest.raises(OptionValueError, match="n must be a non-negative integer"):
            branch(env, calls, wrong, method=method)
    with pytest.raises(OptionValueError, match="method"):
        branch(env, calls, method="clone")
    assert branch(env, calls, 0, method=method) == []
    env.step(1)
    with pytest.raises(EpisodeOverError, match="begin the next one"):
        branch(env, calls, method=method)
    with pytest.raises(ViewError, match="branch needs an environment of one simulation"):
        branch("env", calls, method=method)
    assert called == []


def test_threads_are_not_forked():
    env = going_on(steps=0, driver="thread")
    with pytest.raises(OptionValueError, match="replay"):
        branch(env, short, method="fork")
    env.close()


def test_not_from_inside_its_own_mappings():
    envs = []

    def observe():
        if envs:
            branch(envs[0], short)
        return [0, 0]

    ant = decision(agent="ant_0", observation_space_mapping=observe)
    env = begun(aec_env(script(lambda simulation: [ant(), ant()]), ant))
    envs.append(env)
    with pytest.raises(ReentrancyError, match="was used from"):
        env.step(1)
    envs.clear()


def test_branches_are_closed_when_their_function_has_returned():
    env, twins = going_on(), []

    def keep(twin, number):
        twins.append(twin.unwrapped)
        if number:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        branch(env, keep, 2, method="replay")
    for twin in twins:
        with pytest.raises(ClosedError, match="call reset"):
            twin.step(1)
    env.step(1)


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the number of cores cannot be set")
def test_no_more_branches_run_at_a_time_than_there_are_cores(tmp_path):
    env = going_on()

    def alone(twin, number):
        (tmp_path / str(number)).touch()
        there = len(list(tmp_path.iterdir()))
        (tmp_path / str(number)).unlink()
        return there

    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        assert branch(env, alone, 6, method="fork") == [1] * 6
    finally:
        os.sched_setaffinity(0, cores)


def test_forked_branches_leave_torchs_threads_behind(monkeypatch):
    """Those of a library whose threads do not come along would be waited for."""
    told = []
    torch = types.ModuleType("torch")
    torch.set_num_threads = told.append
    monkeypatch.setitem(sys.modules, "torch", torch)
    assert branch(going_on(), lambda twin, number: told, 1, method="fork") == [[1]]
    assert told == []


def test_what_was_decided_is_replayed_as_it_was_given():
    """Actions of the user and of a policy, who change them later; and nobody is asked again for what he has said."""
    amount = {
        "action_space": spaces.Box(-9, 9, (1,), np.float32),
        "action_space_mapping": lambda action: float(action[0]),
        "reward_mapping": lambda walk: 0.0,
    }
    buffer, action, asked = np.zeros(1, np.float32), np.zeros(1, np.float32), []

    def policy(observation):
        asked.append(1)
        buffer[0] += 0.25
        return buffer

    for policies, own in (({"wind_0": policy}, 1), (None, action)):
        points = {f"{Walk.__module__}.Walk.drift": define(agent="wind_0", **amount)}
        env = begun(aec_env(lambda: Walk(6), points | ({Walk.choose: None} if policies else {}), policies=policies))
        for _ in range(3):
            action[0] += 0.5
            env.step(own)
        before = len(asked)
        places = branch(env, lambda twin, number: twin.simulation.place, 2, method="replay")
        assert places == [env.simulation.place] * 2
        assert len(asked) == before


@pytest.mark.filterwarnings("ignore:.* draws from the global generator")
def test_branches_of_random_worlds_are_exact():
    """Also of files and of global generators. For a larger number: ``python -m tests.worlds.exactness 10000``."""
    differ, number = exactness.differing(200)
    assert (differ, number >= 200) == (0, True)


class Holding:
    def reset(self, seed=None):
        self.chance, self.log = random.Random(seed), []

    def run(self):
        with self.open():
            for _ in range(6):
                self.log.append((filing.choose(), self.chance.random()))


@contextmanager
def a_socket(model):
    one, other = socket.socketpair()
    with one, other:
        yield


@contextmanager
def a_child(model):
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as child:
        yield
        child.communicate(b"\n")


@contextmanager
def a_thread(model):
    over = threading.Event()
    thread = threading.Thread(target=over.wait)
    thread.start()
    yield
    over.set()
    thread.join()


@contextmanager
def a_worker(model):
    worker = multiprocessing.get_context("fork").Process(target=time.sleep, args=(60,))
    worker.start()
    yield
    worker.kill()
    worker.join()


@pytest.mark.parametrize(
    ("held", "name"),
    [(a_socket, "a socket"), (a_child, "a child process"), (a_worker, "a child process"), (a_thread, "a thread")],
)
def test_what_a_fork_could_not_go_on_with_is_replayed_or_named(held, name):
    env = begun(single_env(type("Model", (Holding,), {"open": held}), filing.choose), 4)
    env.step(1)
    with pytest.raises(BranchError, match=f"{name}.*replay"):
        branch(env, filing.left, method="fork")
    found = branch(env, filing.left, 2)
    assert found[0] == found[1] == filing.left(env)
    env.close()


def in_a_process(code, *options, **streams):
    command = [sys.executable, *options, "-c", textwrap.dedent(code)]
    return subprocess.run(command, cwd=ROOT, check=True, timeout=60, **streams)


def test_what_the_user_has_opened_is_no_obstacle():
    in_a_process("""
        import os, socket, subprocess, sys
        from simenv_marl import branch, single_env
        from tests.worlds.models import calling, decision

        one, other = socket.socketpair()
        choose = decision()
        env = single_env(calling(choose, choose), choose)
        env.reset(seed=1)
        two, another = socket.socketpair()
        child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
        assert branch(env, lambda env, number: os.getpid(), method="fork") != [os.getpid()]
        child.communicate(b"\\n")
    """)


class Clerks(Holding):
    async def clerk(self, number):
        for _ in range(3):
            await asyncio.sleep(0)
            self.log.append((number, filing.choose(), self.chance.random()))
        asyncio.get_running_loop().call_soon_threadsafe(self.log.append, number)
        await asyncio.sleep(0.002)

    async def all(self):
        await asyncio.gather(self.clerk(1), self.clerk(2))

    def run(self):
        asyncio.run(self.all())


class Listening(Clerks):
    async def all(self):
        loop, (reading, writing) = asyncio.get_running_loop(), os.pipe()
        for number in range(3):
            heard = loop.create_future()
            loop.add_reader(reading, lambda heard=heard: heard.done() or heard.set_result(os.read(reading, 1)))
            filing.choose()
            os.write(writing, bytes([number]))
            self.log.append(await asyncio.wait_for(heard, 10))
        loop.remove_reader(reading)
        os.close(reading)
        os.close(writing)


def test_event_loops_of_asyncio_go_on_in_a_fork():
    env = begun(single_env(Listening, filing.choose))
    env.step(1)
    assert branch(env, filing.left, 1, method="fork") == [filing.left(env)] == [[b"\0", b"\1", b"\2"]]
    env = begun(single_env(Clerks, filing.choose), 4)
    for _ in range(3):
        found = branch(env, filing.left, 2, method="fork")
        env.step(3)
    assert found[0] == found[1] == filing.left(env)


def test_where_asyncio_is_not_imported_there_are_no_event_loops(monkeypatch):
    monkeypatch.delitem(sys.modules, "asyncio.selector_events")
    assert loops_on({0}) == []


@pytest.mark.parametrize("modes", [["w"], ["a", "w"], ["r+"], ["a", "r"]])
def test_copies_of_files_are_what_they_were(tmp_path, modes):
    path = tmp_path / "letters"

    class Model(Holding):
        def run(self):
            path.write_text("abcdefghij")
            files = [open(path, mode) for mode in modes]  # noqa: SIM115 - closed below
            files[-1].seek(4)
            for number in range(6):
                filing.choose()
                for file in files:
                    if file.writable():
                        file.write(f"{number}line")
                        file.flush()
                    self.log += [file.tell(), os.fstat(file.fileno()).st_size, file.read(3) if file.readable() else ""]
            for file in files:
                file.close()

    env = begun(single_env(Model, filing.choose))
    for _ in range(3):
        before = path.read_text()
        found = branch(env, filing.left, 2, method="fork")
        assert path.read_text() == before
        env.step(1)
    assert found[0] == found[1] == filing.left(env)


@pytest.mark.parametrize("flush", [False, True])
def test_what_a_branch_prints_is_printed_once(flush, tmp_path):
    path = tmp_path / "out"
    code = f"""
        from simenv_marl import branch, single_env
        from tests.worlds.models import calling, decision

        choose = decision()
        env = single_env(calling(choose, choose), choose)
        env.reset()
        print("before", flush={flush})
        branch(env, lambda env, number: print("in", number, flush={flush}), method="fork")
        print("after", flush={flush})
    """
    with path.open("w") as out:
        ran = in_a_process(code, "-W", "error", stdout=out, stderr=subprocess.PIPE)
    assert path.read_text().splitlines() == ["before", "in 0", "after"]
    assert ran.stderr == b""
