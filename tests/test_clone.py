"""Clones: their behaviour, their isolation and their ends; and that branches behave like clones."""

import ctypes
import errno
import gc
import inspect
import os
import random
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
import weakref
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit

from simenv_marl import branch, clone, joint_env, single_env, vector_env
from simenv_marl.core.copies.forks import Fork
from simenv_marl.errors import (
    BranchError,
    EpisodeOverError,
    InvalidActionError,
    OptionValueError,
    ReentrancyError,
    WrongThreadError,
)
from tests.core.test_global_rng import world
from tests.extent import thorough
from tests.processes import ROOT, alone, descriptors, gone, runs
from tests.test_branch import METHODS, ahead, children
from tests.worlds.copied import POINTS, VIEWS, Free, Lucky, Trip, future, move, outcome, trip
from tests.worlds.models import begun, fails, notes
from tests.worlds.valued import Duel, points
from tests.worlds.vectors import FORK, FORKS, POINT, Counter

LUCKY = {"simulation": Lucky, "global_rng": True}
OPTIONS = {
    "plain": {}, "short": {"skip_forced": True, "max_steps": 4, "render_mode": "ansi"},
    "lucky": LUCKY | {
        "policies": {"guide_0": lambda observation, info: int(info["action_mask"].sum()) - 1},
        "plugins": [(lambda trip: setattr(trip, "place", trip.place + 1), Lucky.luck, "before")],
        "render_mode": "ansi_list", "state_space": "observations",
    },
}  # fmt: skip

FEW_VIEWS = ("aec", "parallel", "single, limited", "joint")
EVERY_VIEW = pytest.mark.parametrize(
    "view", [*FEW_VIEWS, *thorough(*(view for view in VIEWS if view not in FEW_VIEWS))]
)


def number_of(twin):
    return twin.unwrapped.call(lambda env: os.getpid())


@METHODS
@pytest.mark.parametrize("options", ["lucky", *thorough("plain", "short")])
@EVERY_VIEW
def test_clones_and_branches_continue_alike_and_independently(view, options, method):
    given = dict(OPTIONS[options])
    if (options, method) == ("short", "replay"):  # threads cannot be forked
        given["driver"] = "thread"
    for taken in (0, 3):
        env = trip(view, taken=taken, **given)
        env.unwrapped.np_random.random()
        twin, other = clone(env, method=method), clone(env, method=method)
        deeper = clone(twin, method=method)
        other.reset(seed=9)
        branched = branch(env, lambda each, number: (future(each), type(each)), 2, method=method)
        [another] = branch(other, ahead, method=method)
        found = future(twin)
        assert another == future(other) != found == future(env)
        assert branched == [(found, type(env))] * 2
        assert (future(deeper), type(deeper), type(deeper.unwrapped)) == (
            found,
            type(env),
            type(env.unwrapped),
        )


@pytest.mark.filterwarnings("ignore:.* draws from the global generator")
def test_clone_by_replay_leaves_the_users_generators_unchanged():
    class Drawing(Trip):
        def reset(self, seed=None):
            random.random()
            super().reset(seed)

    env, before = trip(simulation=Drawing), world()
    clone(env, method="replay")
    assert world() == before


def test_clone_of_a_clone_has_the_times_and_agents_of_the_original():
    class Short(Duel):
        ceiling = 2.5  # where the one on the left retires

    env = begun(joint_env(Short, points(), discount_rate=0.1), 5)
    twin = clone(env, method="fork")
    action = {"left": 1, "right": 0}
    assert repr(env.step(action)) == repr(twin.step(action))
    twins = [twin, clone(twin, method="fork"), clone(twin, method="replay")]
    twins.append(clone(twins[1], method="replay"))
    acts = []
    over = False
    while not over:
        told = env.step(action)
        over = told[2]
        acts.append(told[4]["acted"]["left"])
        for each in twins:
            assert repr(each.step(action)) == repr(told)
    assert acts[-1] is False
    assert {"elapsed", "discount"} < {*told[4]}


@METHODS
def test_clone_continues_after_its_original_is_closed(method):
    env = trip("single, limited", taken=2)
    checkpoint = clone(clone(env, method=method), method=method)
    env.close()
    found = [future(clone(checkpoint, method=method)) for _ in range(3)]
    for _ in range(4):
        found += branch(checkpoint, ahead, method=method)
    assert found == [future(trip("single, limited", taken=2))] * 7 == [future(checkpoint)] * 7


@pytest.mark.thorough
def test_clones_of_clones_end_when_they_are_garbage_collected():
    twin, numbers = clone(trip(), method="fork"), []
    for _ in range(30):
        numbers.append(number_of(twin))
        twin = clone(twin, method="fork")
    assert all(map(gone, numbers))
    number = number_of(twin)
    assert future(twin) == future(trip())
    del twin
    assert gone(number)


@pytest.mark.thorough
@METHODS
def test_clones_keep_the_step_count_of_time_limit_wrappers(method):
    env = trip("single, limited", Free)
    twin = clone(env, method=method)
    twin.step(1)
    assert twin.unwrapped.call(lambda env: env.unwrapped is env)  # the wrappers are here
    assert (twin._elapsed_steps, env._elapsed_steps) == (2, 1)
    twin.step(1)
    assert clone(twin, method=method).step(1)[3] is twin.step(1)[3] is True
    twin.unwrapped.call(lambda env: env.reset(seed=5))
    assert future(twin.unwrapped) == future(trip("single", Free, taken=0, seed=5))
    outer = begun(TimeLimit(clone(trip(), method=method), 2), 4)
    outer.step(1)
    last = clone(outer, method=method)
    assert last.step(1)[3] is outer.step(1)[3] is True


@pytest.mark.thorough
def test_clone_call_runs_functions_in_the_process_of_the_clone():
    twin, factor = clone(trip(), method="fork"), 2
    assert number_of(twin) != os.getpid() == number_of(clone(twin, method="replay"))
    assert twin.call(lambda env, by: (factor * by, env.step(1)[4]["time"]), 4) == (8, 3.0)
    twin.call(lambda env: env.simulation.steps).clear()
    assert twin.call(lambda env: len(env.simulation.steps)) == 4
    with pytest.raises(BranchError, match=r"\.call\("):
        _ = twin.simulation
    with pytest.raises(TypeError, match="pickle"):
        twin.call(lambda env: env.simulation.held)
    while not twin.step(1)[2]:
        pass
    with pytest.raises(EpisodeOverError):
        twin.step(1)


@METHODS
@EVERY_VIEW
def test_clone_errors_keep_their_type(view, method):
    failing = type("Failing", (Free,), {"luck": lambda trip: 1 / (1 - trip.day)})
    twin = clone(trip(view, failing, taken=0), method=method)
    before = twin.unwrapped.call(outcome)
    with pytest.raises(InvalidActionError):
        twin.unwrapped.call(lambda env: env.unwrapped.step({"walker_0": 99, "guide_0": 99}))
    assert twin.unwrapped.call(outcome) == before
    with fails(ZeroDivisionError, "seed 3") as caught:
        [move(twin) for _ in range(10)]
    assert caught.value.__cause__ is None
    assert method == "replay" or "in <lambda>\n" in notes(caught.value)
    twin.reset(seed=3)
    assert twin.unwrapped.call(outcome) == before


@METHODS
@pytest.mark.parametrize("view", ["aec, padded", "parallel", "single, limited", "joint"])
@pytest.mark.parametrize("options", [{}, LUCKY])
def test_clones_and_branches_with_the_same_seed_have_the_same_future(view, options, method):
    env, threaded = trip(view, **options), trip(view, driver="thread", **options)
    random.gauss(0, 1)  # the generators keep a second number
    np.random.standard_normal()
    before = world()
    twins = [clone(env, seed=seed, method=method) for seed in (5, 6, 5, 5)]
    again = clone(twins.pop(), method="replay")
    found = [future(twin) for twin in twins]
    assert found[1] != found[0] == found[2] == future(again)
    *branched, third = branch(env, ahead, 3, method=method, seeds=np.array([5, 6, 2**70], object))
    assert branched == found[:2] == branch(threaded, ahead, 2, seeds=[5, 6])
    threaded.close()
    assert third not in found
    with pytest.raises(ZeroDivisionError):
        branch(env, lambda twin, number: 1 / 0, method=method, seeds=[1])
    assert world() == before
    assert future(env) == future(trip(view, **options)) != found[0]


def fail(*_):
    raise OSError(errno.EAGAIN, "no more")


@pytest.mark.thorough
@METHODS
def test_clone_that_cannot_be_made_leaves_no_process(method, monkeypatch):
    faulty, fixed = (
        trip(simulation=type("Model", (Trip,), {"reseed": reseed})) for reseed in (fail, None)
    )
    twin = clone(fixed, method="fork")
    gc.collect()
    before = children(), descriptors().keys()
    monkeypatch.setattr(os, "fork", os.fork if method == "replay" else fail)
    if method == "fork":
        twin.call(lambda env: setattr(os, "fork", fail))
    refused = [(faulty, seed, OptionValueError, "seed must") for seed in (-1, True, 2.0, "3")]
    refused += [
        (fixed, 1, BranchError, "reseed"),
        (twin, 1, BranchError, "reseed"),
        (faulty, 1, OSError, "no more"),
    ]
    if method == "fork":
        refused += [
            (each, None, BranchError, "no process .* no more; close some clones")
            for each in (fixed, twin)
        ]
    for source, seed, error, message in refused:
        with pytest.raises((error, BranchError), match=message):
            clone(source, seed=seed, method=method)
    gc.collect()
    assert (children(), descriptors().keys(), twin.call(lambda env: children())) == (*before, set())


TWO = ["reset 8", "unwound 8", "closed 8", "reset 9", "unwound 9", "closed 9"]
USES = [
    (lambda twin: twin.step(1), []),
    (lambda twin: twin.reset(seed=9), TWO[3:]),
    (lambda twin: twin.call(lambda env: env.reset(seed=9)), TWO[3:]),
    (lambda twin: [twin.reset(seed=8), twin.reset(seed=9)], TWO),
]


@FORKS
def test_clone_interrupted_while_it_is_made_leaves_no_process():
    before = children()

    def interrupt(*_):
        raise KeyboardInterrupt

    handler = signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, 0.1)
    try:
        with pytest.raises(KeyboardInterrupt):
            Fork.begin(None, lambda: time.sleep(600), 600.0).start()
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, handler)
    with pytest.raises(BranchError, match="died"):
        Fork.begin(None, lambda: os._exit(0), 600.0).start()
    assert children() - before == set()  # those of earlier tests may end meanwhile


@pytest.mark.thorough
@pytest.mark.parametrize("end", [lambda twins: twins[0].close(), list.clear])
@pytest.mark.parametrize(("use", "told"), USES)
def test_clone_unwinds_and_closes_only_episodes_that_begin_in_it(use, told, end, tmp_path):
    env = trip(simulation=lambda: Trip(tmp_path / "diary"))
    twins = [clone(env, method="fork")]
    use(twins[0])
    clone(twins[0], method="fork").close()
    end(twins)
    assert (tmp_path / "diary").read_text().splitlines() == ["reset 3", *told]
    env.close()


USER = """
import os, sys, threading, time
from tqdm import tqdm
from simenv_marl import clone
from tests.worlds.copied import trip
def number(env):
    return os.getpid()
def keep(env):
    kept.append(clone(env))
    return kept[0].call(number)
def spin(env, place):
    os.mkdir(place)
    while True: pass
def show():
    for count in tqdm(range(10**9), mininterval=0):
        print(count, flush=True)
        if cloned.is_set(): return
kept, cloned = [], threading.Event()
shows = threading.Thread(target=show)
shows.start()
twins = [clone(trip(), method="fork") for _ in range(20)]
twins += [clone(twins[0]), clone(twins[0])]
twins.append(clone(twins[-1]))
numbers = [*[twin.call(number) for twin in twins], twins[1].call(keep)]
cloned.set()
shows.join()
for twin in twins[2], twins[-1]:
    place = os.path.join(sys.argv[1], str(twin.call(number)))
    threading.Thread(target=twin.call, args=(spin, place), daemon=True).start()
    while not os.path.exists(place): time.sleep(0.01)
if os.fork() == 0:  # it does not keep clones alive
    time.sleep(30)
    os._exit(0)
print("all", *numbers, flush=True)
"""
INTERRUPTED = """
try: twins[0].call(lambda env: print("ready", flush=True) or time.sleep(600))
except KeyboardInterrupt: print(twins[1].call(lambda env: "well"))
twins[0].step(1)
"""
ENDS = [
    ("os.kill(os.getpid(), 9)", ""),
    ("1 / 0", "ZeroDivisionError"),
    ("os._exit(0)", ""),
    ("", ""),
]
ENDS += [(INTERRUPTED, "BranchError: the clone is gone: it was ended by an interrupt")]


@pytest.mark.thorough
@pytest.mark.parametrize(("end", "error"), ENDS)
def test_clones_end_with_the_users_process_and_ignore_interrupts(end, error, tmp_path):
    command, told = [sys.executable, "-c", USER + end, str(tmp_path)], tmp_path / "told"
    options = {"cwd": ROOT, "stdout": subprocess.PIPE, "text": True, "start_new_session": True}
    with told.open("w") as file, subprocess.Popen(command, stderr=file, **options) as process:
        try:
            numbers = next(line for line in process.stdout if line.startswith("all")).split()[1:]
            if end is INTERRUPTED:
                assert process.stdout.readline() == "ready\n"
                os.killpg(process.pid, signal.SIGINT)
                assert process.stdout.readline() == "well\n"
            process.wait(60)
            assert all(gone(int(number)) for number in numbers)
            assert (len({*numbers}), error in told.read_text()) == (24, True)
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


def test_clone_that_dies_raises_an_error_and_other_clones_continue():
    env = trip()
    killed, exits, late, other = (
        clone(env, method="fork", time_limit=limit) for limit in (60, 60, 0.3, float("inf"))
    )
    os.kill(number_of(killed), signal.SIGKILL)
    for use in (number_of, lambda twin: twin.step(1), clone, lambda twin: twin.reset(), number_of):
        with pytest.raises(BranchError, match="has died, killed by signal 9"):
            use(killed)
    with pytest.raises(BranchError, match="has died, with exit code 3"):
        exits.call(lambda env: os._exit(3))
    number = number_of(late)
    with pytest.raises(BranchError, match=r"longer than 0\.3 s"):
        late.call(lambda env: time.sleep(600))
    assert gone(number)
    assert future(other) == future(env)


def test_clone_never_kills_a_reused_process_id(monkeypatch):
    """The system may have given the number to another process."""
    twin = clone(trip(), method="fork")
    deeper = clone(twin, method="fork")
    number, killed = number_of(deeper), []
    os.kill(number, signal.SIGKILL)
    assert gone(number)
    monkeypatch.setattr(os, "kill", lambda *given: killed.append(given[0]))
    with pytest.raises(BranchError):
        deeper.step(None)
    monkeypatch.undo()
    assert number not in killed
    twin.close()


def test_clone_can_be_used_by_one_thread_at_a_time(tmp_path):
    def wait(env):
        (tmp_path / "begun").touch()
        while not (tmp_path / "over").exists():
            time.sleep(0.01)

    env = trip()
    twin = clone(env, method="fork")
    with ThreadPoolExecutor(1) as pool:
        with pytest.raises(WrongThreadError, match="thread"):
            pool.submit(clone, env).result()
        assert future(pool.submit(clone, twin, method="fork").result()) == future(env)
        waits = pool.submit(twin.call, wait)
        while not (tmp_path / "begun").exists():
            time.sleep(0.01)
        for use in (lambda: twin.step(1), twin.reset, lambda: clone(twin)):
            with pytest.raises(ReentrancyError):
                use()
        (tmp_path / "over").touch()
        waits.result()
    twin.step(1)


def test_clones_are_not_affected_by_the_default_socket_timeout():
    socket.setdefaulttimeout(0.05)
    try:
        twin = clone(trip(), method="fork")
        deeper = clone(twin, method="fork")
    finally:
        socket.setdefaulttimeout(None)
    assert (
        deeper.call(lambda env: time.sleep(0.3) or 5)
        == twin.call(lambda env: time.sleep(0.3) or 5)
        == 5
    )


@FORKS
def test_clone_refuses_use_in_a_fork_of_its_users_process():
    twin, child = clone(trip(), method="fork"), os.fork()
    if child == 0:
        with suppress(BaseException):
            try:
                twin.step(1)
            except BranchError as error:
                twin.close()
                os._exit("another process" in str(error))
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 1
    assert future(twin) == future(trip())


def crowd():
    env = trip()
    clone(env, method="fork").close()  # from then on, a pipe is open for the ends of forks
    before = descriptors()
    twins = [clone(env, method="fork") for _ in range(100)]
    assert (
        sum(each.startswith("socket") for each in descriptors().values()) == len(children()) == 100
    )
    while twins:
        twins.pop().close()
    assert (children(), descriptors()) == (set(), before)


def starve():
    resource.setrlimit(resource.RLIMIT_NOFILE, (64, 64))
    env, number = trip(), os.getpid()
    for source, spare in product((env, clone(env, method="fork")), range(9)):
        before, taken, twins = children(), [], []
        with suppress(OSError):
            while True:
                taken.append(os.dup(0))
        while len(taken) > 50 - spare:
            os.close(taken.pop())
        with suppress(BranchError):
            twins.append(clone(source, method="fork"))
        while taken:
            os.close(taken.pop())
        assert number not in map(number_of, twins)
        twins.clear()
        assert (children(), source.call(lambda env: children())) == (
            before,
            before if source is env else set(),
        )


def lean():
    """A clone's process has no descriptors that it does not need."""
    with open(__file__, encoding="utf-8"):  # each has its own opening
        env = trip()
        other, number = clone(env, method="fork"), len(descriptors())
        twin = clone(env, method="fork")
        twin.call(lambda env: setattr(sys, "unraisablehook", lambda unclosed: os._exit(1)))
        for each in (twin, clone(twin, method="fork"), other):
            assert each.call(lambda env: len(descriptors())) == number - (each is other)


@pytest.mark.thorough
@pytest.mark.parametrize("function", [crowd, starve, lean])
def test_clones_use_one_file_descriptor_each_and_leak_none(function):
    alone(function)


# -- memory ---------------------------------------------------------------------------------------


class Cyclic:
    """Only the collector frees it."""

    def __init__(self):
        self.me = self


@pytest.mark.thorough
def test_clone_by_fork_frees_objects_that_the_original_frees():
    env = trip()
    model = env.simulation
    model.alive = [Cyclic(), Cyclic()]
    model.known = weakref.WeakSet([*model.alive, Cyclic()])  # one is garbage at the fork

    def count(env, *_):
        env.simulation.alive.pop()
        gc.collect()
        return len(env.simulation.known)

    twin = clone(env, method="fork")
    deeper = clone(twin, method="fork")
    found = [twin.call(count), deeper.call(count), *branch(env, count, 1, method="fork")]
    assert found == [count(env)] * 3 == [1] * 3


@pytest.mark.thorough
def test_clone_closed_within_a_chain_of_clones_is_freed():
    twin = clone(trip(), method="fork")
    depth = twin.call(lambda env: len(inspect.stack()))
    links = []
    for _ in range(40):
        links.append((weakref.ref(twin.unwrapped), weakref.ref(twin.unwrapped.session._fork)))
        deeper = clone(twin, method="fork")
        twin.close()
        twin = deeper
    gc.collect()
    assert not [link for pair in links for link in pair if link() is not None]
    assert twin.call(lambda env: len(inspect.stack())) == depth
    assert future(twin) == future(trip())


# -- errors ---------------------------------------------------------------------------------------


class Broken(Trip):
    """Whatever is asked of it after an error of the model fails, too."""

    broken = None

    def luck(self):
        self.broken = KeyError("the model is broken")
        raise ZeroDivisionError("in the model")

    def time(self):
        if self.broken is not None:
            raise self.broken
        return 0.0

    def state(self):
        return [self.place, (None if self.broken is None else 1 / 0) or self.day]


@pytest.mark.thorough
@METHODS
@pytest.mark.parametrize("view", ["single", "aec", "parallel", "joint"])
def test_clone_raises_a_model_error_before_errors_that_follow_from_it(view, method):
    twin = clone(trip(view, Broken, taken=0), method=method)
    with pytest.raises(ZeroDivisionError, match="in the model"):
        all(True for _ in iter(lambda: move(twin), None))
    with pytest.raises(EpisodeOverError):
        move(twin)


class Bad:
    """An object that can be pickled, but not unpickled."""

    def __init__(self, number=0):
        pass

    def __reduce__(self):
        return int, ("no number",)


def unsendable():
    return {"generator": (step for step in ()), "broken": Bad(), "lock": threading.Lock()}


@pytest.mark.parametrize("kind", unsendable())
def test_clone_names_an_info_that_cannot_be_pickled(kind):
    def leave(env, fails):
        env.episode.pending.info["more"] = unsendable()[kind]
        if fails:
            raise ZeroDivisionError

    env = trip()
    twin = clone(env, method="fork")
    with pytest.raises(ZeroDivisionError):
        twin.call(leave, True)
    twin = clone(env, method="fork")
    with pytest.raises(BranchError, match=r"cannot be sent.*replay"):
        twin.call(leave, False)
    with pytest.raises(EpisodeOverError):
        twin.step(1)
    twin.reset(seed=3)
    assert move(twin) == move(trip(taken=0))
    leave(env, False)
    with pytest.raises(BranchError, match=r"cannot be sent.*replay"):
        clone(env, method="fork")


@pytest.mark.thorough
@METHODS
@pytest.mark.parametrize("view", ["single", "aec", "parallel", "joint"])
@pytest.mark.parametrize("kind", unsendable())
def test_clone_refuses_actions_that_cannot_be_pickled(kind, view, method):
    env = trip(view)
    twin = clone(env, method=method)
    bad = action = unsendable()[kind]
    if view in ("parallel", "joint"):
        action = {"walker_0": bad, "guide_0": 0}
    for each in (env, twin):
        with pytest.raises(InvalidActionError):
            each.step(action)
    assert future(twin) == future(env)


# -- ends -----------------------------------------------------------------------------------------


def test_clone_raises_an_error_if_its_process_has_exited():
    twin = clone(trip(), method="fork")
    with pytest.raises(BranchError, match=r"has died, because .*os\._exit\(0\)"):
        twin.call(lambda env: os._exit(0))
    twin = clone(trip(), method="fork")
    with pytest.raises(BranchError, match=r"has died, (because|killed)"):
        twin.call(lambda env: os.closerange(3, 1000))
    with pytest.raises(BranchError, match="branch 0 has died without a result, because"):
        branch(trip(), lambda env, number: os._exit(0), method="fork")
    twin = clone(trip(), method="fork")
    number = number_of(twin)
    os.kill(number, signal.SIGKILL)
    os.waitpid(number, 0)  # as handlers of SIGCHLD may do
    with pytest.raises(BranchError, match="its process has ended"):
        twin.step(1)


def reap(order):
    prctl = ctypes.CDLL(None).prctl
    assert prctl(36, 1, 0, 0, 0) == 0  # PR_SET_CHILD_SUBREAPER: as the first of a container
    twins = [clone(trip(), method="fork")]
    for _ in range(3):
        twins.append(clone(twins[-1], method="fork"))
    for place in map(int, order):
        twins[place].close()
    assert children() == set()


@pytest.mark.thorough
@pytest.mark.parametrize("order", ["0123", "3210", "1032", "0213"])
def test_closed_clones_leave_no_zombie_process_in_a_container(order):
    alone(reap, order)


@pytest.mark.parametrize("at", ["waitpid", "kill"])
def test_clone_second_close_ends_the_process_after_an_interrupted_close(at, monkeypatch):
    twin = clone(trip(), method="fork")
    number = number_of(twin)

    def interrupt(*_):
        monkeypatch.undo()
        raise KeyboardInterrupt

    monkeypatch.setattr(os, at, interrupt)
    with pytest.raises(KeyboardInterrupt):
        twin.close()
    assert runs(number)
    twin.close()
    assert not runs(number)


SIGNALS = [signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1]


def handled(place):
    def note(number, frame):
        with open(place, "a", encoding="utf-8") as file:
            file.write(f"{os.getpid()}\n")

    os.setpgid(0, 0)
    for number in SIGNALS:
        signal.signal(number, note)
    env = trip()
    twin = clone(env, method="fork")
    deeper = clone(twin, method="fork")
    envs = begun(vector_env(Counter, POINT, num_envs=2, workers=2, context=FORK), 0)

    def wait(env, number):
        time.sleep(0.5)  # the parent sends the signals meanwhile
        return number

    timer = threading.Timer(0.2, lambda: [os.killpg(0, number) for number in SIGNALS[1:]])
    timer.start()
    assert branch(env, wait, 2, method="fork") == [0, 1]
    envs.step(envs.action_space.sample())
    os.kill(number_of(twin), signal.SIGTERM)
    assert future(twin) == future(deeper) == future(env)
    envs.close()
    assert {*Path(place).read_text(encoding="utf-8").split()} == {str(os.getpid())}


@pytest.mark.thorough
def test_clones_do_not_run_the_users_signal_handlers(tmp_path):
    alone(handled, str(tmp_path / "signals"))


# -- locks ----------------------------------------------------------------------------------------


HELD = threading.Lock()


def hold(env, number=0):
    HELD.acquire()


@pytest.mark.thorough
def test_clone_by_fork_that_waits_for_a_lock_forever_raises_an_error():
    HELD.acquire()  # as by a thread that is not in the fork
    env = trip()
    began = time.monotonic()
    twin = clone(env, method="fork")
    deeper = clone(twin, method="fork")
    patient = clone(env, method="fork")

    with ThreadPoolExecutor(1) as pool:
        waits = pool.submit(patient.call, lambda env: threading.Event().wait(8))
        for use in (
            lambda: twin.call(hold),
            lambda: deeper.call(hold),
            lambda: branch(env, hold, 2, method="fork"),
        ):
            with pytest.raises(BranchError, match=r"locks.*OpenMP.*replay.*one thread"):
                use()
        assert time.monotonic() - began < 30
        assert waits.result() is False  # it waits with a limit of time
    HELD.release()


class Slow(type):
    """Whoever changes its classes, as environments do, takes a while."""

    begun = threading.Event()

    def __setattr__(cls, name, value):
        cls.begun.set()
        time.sleep(0.3)
        super().__setattr__(name, value)


def make_slowly():
    class Model(Trip, metaclass=Slow):
        def walk(self):
            return 1

    Slow.begun.clear()
    single_env(Model, {Model.walk: POINTS["tests.worlds.copied.Trip.walk"]}).close()


def by_hand(env):
    child = os.fork()
    if child == 0:
        signal.alarm(20)
        make_slowly()
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


@pytest.mark.thorough
@FORKS
@pytest.mark.parametrize(
    "forked",
    [
        by_hand,
        lambda env: clone(env, method="fork", time_limit=20).call(lambda env: not make_slowly()),
        lambda env: branch(env, lambda env, _: not make_slowly(), method="fork", time_limit=20)[0],
    ],
)
def test_clone_by_fork_does_not_hang_while_a_thread_makes_an_env(forked):
    env = trip()
    make_slowly()
    with ThreadPoolExecutor(1) as pool:
        Slow.begun.clear()
        made = pool.submit(make_slowly)
        assert Slow.begun.wait(20)
        assert forked(env)
        made.result()
