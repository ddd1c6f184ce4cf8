"""Branches: exact continuations of an episode that is going on; with ``seeds=``, the chance ahead is drawn anew."""

import asyncio
import os
import random
import select
import signal
import socket
import subprocess
import sys
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
from simenv_marl.core.separation import loops_on
from simenv_marl.errors import (
    BranchError,
    ClosedError,
    EpisodeOverError,
    NotResetError,
    OptionValueError,
    ReentrancyError,
    ViewError,
)
from tests.core.test_global_rng import world
from tests.worlds import exactness, filing
from tests.worlds.copied import Walk
from tests.worlds.models import decision, define, notes, script

ROOT = Path(__file__).parent.parent
METHODS = pytest.mark.parametrize("method", ["fork", "replay"])
POINTS = {
    Walk.choose: None,
    f"{Walk.__module__}.Walk.drift": define(
        agent="wind_0",
        observation_space=spaces.Box(-99, 99, (1,), np.float32),
        observation_space_mapping=lambda walk: [walk.place],
        reward_mapping=difference(lambda walk: walk.place),
    ),
}
VIEWS = pytest.mark.parametrize(
    ("make", "points"), [(aec_env, POINTS), (parallel_env, POINTS), (single_env, Walk.choose), (joint_env, POINTS)]
)


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
def test_branches_are_what_the_environment_would_have_done(make, points, method):
    for taken in range(5):
        env = begun(make(lambda: Walk(6), points))
        for _ in range(taken):
            move(env)
        same, other, different = branch(env, lambda twin, number: rest_of(twin, max(0, number - 1)), 3, method=method)
        assert same == other == rest_of(env)
        assert different != same or make in (single_env, joint_env)  # whose moves are all alike


@METHODS
def test_branches_can_be_branched(method):
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


def test_an_error_that_cannot_be_pickled_is_named():
    def fail(twin, number):
        error = Unpicklable(1, 2)
        error.held = (step for step in ())
        raise error

    with pytest.raises(BranchError, match="cannot be pickled: Unpicklable: 1") as caught:
        branch(going_on(), fail, 1, method="fork")
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

        def run(self):
            try:
                super().run()
            finally:
                ended.append(self)

    ended = []
    env = going_on(Dice)
    with pytest.raises(BranchError, match=r"the same seed and the same actions[\s\S]*fork") as caught:
        branch(env, short, 1, method="replay")
    assert (len(ended), ended[0] is env.unwrapped.simulation) == (1, False), caught  # which keeps the replay
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
def test_environments_without_a_pending_decision_cannot_be_branched(method):
    env, called = single_env(lambda: Walk(1), Walk.choose), []

    def calls(twin, number):
        called.append(number)

    with pytest.raises(NotResetError, match="no episode yet"):
        branch(env, calls, method=method)
    env.reset()
    for wrong in (-1, 2.0, True, None):
        with pytest.raises(OptionValueError, match="n must be a non-negative integer"):
            branch(env, calls, wrong, method=method)
    for limit in (0, float("nan"), "1"):
        with pytest.raises(OptionValueError, match="time_limit"):
            branch(env, calls, method=method, time_limit=limit)
    with pytest.raises(OptionValueError, match="method"):
        branch(env, calls, method="clone")
    with pytest.raises(OptionValueError, match=r'needs .* driver="greenlet"[\s\S]*"replay"'):
        branch(going_on(driver="thread"), calls, method="fork")
    assert branch(env, calls, 0, method=method) == []
    env.step(1)
    with pytest.raises(EpisodeOverError, match="begin the next one"):
        branch(env, calls, method=method)
    with pytest.raises(ViewError, match="branch needs an environment of one simulation"):
        branch("env", calls, method=method)
    assert called == []


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


def test_actions_are_replayed_as_they_were_given():
    """Actions of the user and of a policy, who change them later; and nobody is asked again for what he has said."""
    amount = {
        "action_space": spaces.Box(-9, 9, (1,), np.float32),
        "action_space_mapping": lambda action: -action.__imul__(-1).item(),
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


@pytest.mark.parametrize(
    ("held", "name"),
    [(a_socket, "a socket"), (a_child, "a child process"), (a_thread, "a thread")],
)
def test_resources_that_forks_cannot_share_are_replayed_or_named(held, name):
    env = begun(single_env(type("Model", (Holding,), {"open": held}), filing.choose), 4)
    env.step(1)
    with pytest.raises(BranchError, match=f"{name}.*replay"):
        branch(env, filing.left, method="fork")
    found = branch(env, filing.left, 2)
    assert found[0] == found[1] == filing.left(env)
    env.close()


def test_resources_of_the_user_do_not_keep_a_branch_from_forking():
    env, (one, other) = going_on(), socket.socketpair()
    with one, other, subprocess.Popen(["cat"], stdin=subprocess.PIPE):
        assert branch(env, lambda twin, number: os.getpid(), method="fork") != [os.getpid()]


class Listening(Holding):
    def run(self):
        asyncio.run(self.listen())

    async def listen(self):
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


def test_event_loops_of_asyncio_go_on_in_a_fork(monkeypatch):
    env = begun(single_env(Listening, filing.choose))
    env.step(1)
    assert branch(env, filing.left, 1, method="fork") == [filing.left(env)] == [[b"\0", b"\1", b"\2"]]
    monkeypatch.delitem(sys.modules, "asyncio.selector_events")  # as where asyncio is not imported
    assert loops_on({0}) == []


class Polling(Holding):
    """Waits for a pipe that can be read at once, of which it is told once."""

    def run(self):
        reading, writing = os.pipe()
        os.write(writing, b"x")
        with select.epoll() as poll:
            poll.register(reading, select.EPOLLIN | select.EPOLLONESHOT)
            for _ in range(2):
                filing.choose()
                self.log.append(len(poll.poll(0)))
        os.close(reading)
        os.close(writing)


@pytest.mark.skipif(not hasattr(select, "epoll"), reason="only Linux has epoll")
def test_selectors_of_branches_take_no_events_from_the_environment():
    env = begun(single_env(Polling, filing.choose))
    assert branch(env, filing.left, 2, method="fork") == [[1, 0]] * 2
    assert filing.left(env) == [1, 0]


@pytest.mark.parametrize("flush", [False, True])
def test_output_of_a_branch_is_printed_once(flush):
    code = f"""if True:
        from simenv_marl import branch, single_env
        from tests.worlds.models import calling, decision

        choose = decision()
        env = single_env(calling(choose, choose), choose)
        env.reset()
        print("before", flush={flush})
        branch(env, lambda env, number: print("in", number, flush={flush}), method="fork")
        print("after", flush={flush})
    """
    command = [sys.executable, "-W", "error", "-c", code]
    ran = subprocess.run(command, cwd=ROOT, check=True, timeout=60, capture_output=True, text=True)
    assert ran.stdout.splitlines() == ["before", "in 0", "after"]
    assert ran.stderr == ""


class Reseeded(Walk):
    """A walk whose chance can be drawn anew."""

    def reseed(self, seed):
        self.random.seed(seed)
        self.place += 1000  # seen by those who look whether it was called
        self.chosen = self.choose()


class Gambling(Walk):
    """One that draws from the global generators."""

    def drift(self):
        return random.random() + np.random.standard_normal()


class Both(Gambling):
    def reseed(self, seed):
        self.random.seed(seed)


def reseedable(make=single_env, points=Walk.choose, simulation=Reseeded, **options):
    env = make(lambda: simulation(6), points, **options)
    env.reset(seed=3)
    move(env)
    return env


def drawn(env, number):
    """What a base that draws from the global generators would draw."""
    return random.random(), random.gauss(0, 1), np.random.random(), np.random.standard_normal()


@pytest.mark.parametrize(("simulation", "options"), [(Reseeded, {}), (Gambling, {"global_rng": True})])
@VIEWS
def test_the_same_seeds_are_the_same_futures(make, points, simulation, options):
    """By either method and driver, and whatever has been drawn before; other seeds are other futures."""
    env = reseedable(make, points, simulation, **options)
    threaded = reseedable(make, points, simulation, driver="thread", **options)
    seeds = [5, 6, 5, 2**70]
    forked, replayed = (branch(env, short, 4, method=method, seeds=seeds) for method in ("fork", "replay"))
    random.random()
    assert forked == replayed == branch(env, short, 4, seeds=np.array(seeds, object))
    assert forked == branch(threaded, short, 4, seeds=seeds)
    assert forked[0] == forked[2]
    assert len({repr(each) for each in forked}) == 3
    assert branch(env, short, 1, seeds=[6]) == forked[1:2]
    threaded.close()


@METHODS
@VIEWS
def test_the_present_stays_what_it_is(make, points, method):
    env = reseedable(make, points)

    def present(twin, number):
        pending, simulation = twin.unwrapped._session.episode.pending, twin.unwrapped.simulation
        return pending.name, pending.observation.tolist(), simulation.steps, simulation.place

    *seen, place = present(env, 0)
    assert branch(env, present, 2, method=method, seeds=[1, 2]) == [(*seen, place + 1000)] * 2


@METHODS
@pytest.mark.parametrize(("simulation", "options"), [(Reseeded, {}), (Both, {"global_rng": True})])
@VIEWS
def test_neither_the_environment_nor_the_generators_of_its_user_move(make, points, simulation, options, method):
    env = reseedable(make, points, simulation, **options)
    random.gauss(0, 1)
    np.random.standard_normal()
    (ahead,), before = branch(env, short, 1, method=method), world()
    branch(env, short, 2, method=method, seeds=[1, 2])
    with pytest.raises(ZeroDivisionError):
        branch(env, lambda twin, number: 1 / 0, 1, method=method, seeds=[1])
    assert world() == before
    assert rest_of(env) == ahead


@METHODS
def test_the_generators_of_the_process_are_seeded_for_each_future(method):
    """Those of a base policy: alike for the same seeds, and not with the simulation's numbers."""
    env, own = reseedable(simulation=Both, global_rng=True), []

    def base(twin, number):
        with twin._session.context():
            own.append(drawn(twin, number))
        return drawn(twin, number), own[-1], twin.simulation.random.random()

    found = branch(env, base, 3, method=method, seeds=[7, 8, 7])
    assert found[0] == found[2] != found[1]
    assert found[0][2] != found[1][2]  # the simulation is reseeded, too
    assert found == branch(env, base, 3, seeds=[7, 8, 7])
    assert len({value for each in found[:2] for part in each[:2] for value in part}) == 16
    plain = [random.Random(7).random(), np.random.RandomState(7).random(), np.random.default_rng(7).random()]
    for child in np.random.SeedSequence(7).spawn(3):
        plain += [np.random.default_rng(part).random() for part in (child, *child.spawn(3))]
    assert not {*plain} & {value for part in found[0][:2] for value in part}


@METHODS
def test_another_kind_of_generator_behind_numpys_functions(method):
    """It is seeded whatever its kind, and put back as it was."""
    env, kept, mine = reseedable(), np.random.get_bit_generator(), np.random.PCG64(5)
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
def test_torchs_generator_is_seeded_too_and_forks_use_none_of_its_threads(monkeypatch, method):
    """The threads do not come along, and torch would wait for them."""
    threads = []
    generator = types.SimpleNamespace(state=0, get_state=lambda: generator.state)
    generator.set_state = generator.manual_seed = lambda state: setattr(generator, "state", state)
    torch = types.ModuleType("torch")
    torch.set_num_threads, torch.default_generator = threads.append, generator
    monkeypatch.setitem(sys.modules, "torch", torch)
    found = branch(reseedable(), lambda *_: (generator.state, threads), 3, method=method, seeds=[1, 2, 1])
    assert 0 != found[0][0] == found[2][0] != found[1][0] != 0
    assert found[0][1] == ([1] if method == "fork" else [])
    assert (generator.state, threads) == (0, [])


@METHODS
def test_decisions_of_reseed_are_the_rules(method):
    env = reseedable()
    found = branch(env, lambda twin, number: twin.simulation.chosen, 8, method=method, seeds=range(8))
    assert found == [random.Random(seed).choice([-1, 1]) for seed in range(8)]


@METHODS
def test_seeds_without_a_reseed_raise_an_error_with_the_remedy(monkeypatch, method):
    env = reseedable(simulation=Walk)
    monkeypatch.setattr(os, "fork", None)
    with pytest.raises(BranchError, match=r"Walk[\s\S]*reseed\(seed\)[\s\S]*global_rng=True"):
        branch(env, short, 2, method=method, seeds=[1, 2])
    env.simulation.reseed = None
    with pytest.raises(BranchError, match="reseed"):
        branch(env, short, 1, method=method, seeds=[1])
    env.step(1)


@pytest.mark.parametrize(
    "seeds", [[], [1], [1, 2, 3], [1, True], [1, -1], [1, 2.0], [1, None], [1, "2"], "12", 1, {1, 2}, iter([1, 2])]
)
def test_seeds_are_one_integer_for_each_branch(seeds):
    with pytest.raises(OptionValueError, match="seeds must be n = 2 non-negative integers"):
        branch(reseedable(), short, 2, seeds=seeds)
    assert branch(reseedable(), short, 0, seeds=[]) == []
    with pytest.raises(NotResetError):
        branch(single_env(lambda: Reseeded(6), Walk.choose), short, 1, seeds=[1])


class Failing(Walk):
    def reseed(self, seed):
        return 1 / (1 - seed)


@METHODS
def test_an_error_of_reseed_surfaces_as_itself(method):
    env, before = reseedable(simulation=Failing), random.getstate()
    with pytest.raises(ZeroDivisionError) as caught:
        branch(env, short, 2, method=method, seeds=[0, 1])
    assert "reseeded; seed 1" in notes(caught.value)
    assert "in branch 1" in notes(caught.value)
    assert random.getstate() == before
    env.step(1)
