"""Locks that a suspended simulation holds while another simulation waits for them."""

import os
import sys
import threading
import time
import warnings
from functools import cached_property

import pytest

from simenv_marl import clone, single_env
from simenv_marl.core.switching import threads
from simenv_marl.errors import SimulationError
from simenv_marl.hooks import locks
from simenv_marl.hooks.stacks import STACKS
from tests.worlds.models import BY_DRIVER, define

TASKS = "/proc/self/task"
LISTED = os.path.exists(TASKS)
NOT_LISTED = "the system does not list threads"


class Model:
    """A simulation with one decision, inside ``work``."""

    lock = threading.Lock()

    def reset(self):
        self.own = threading.Lock()

    def run(self):
        self.work()

    def work(self):
        self.decide()

    def decide(self):
        return 0


class Fills(Model):
    def work(self):
        with self.lock:
            if self is None:
                return
            self.decide()


class Drains(Model):
    def work(self):
        Model.lock.acquire()
        try:
            self.decide()
        finally:
            Model.lock.release()


class Caches(Model):
    @cached_property
    def plan(self):
        return self.decide()

    def work(self):
        return self.plan

    def reset(self):
        vars(self).pop("plan", None)


ONE_LOCK = sys.version_info < (3, 12)  # for each ``cached_property``


@pytest.fixture(autouse=True)
def impatient(monkeypatch):
    """Look more often than a second, and leave no watching thread."""
    monkeypatch.setattr(locks, "PERIOD", 0.05)
    monkeypatch.setattr(threads, "_LONGEST_WAIT", 0.05)
    yield
    wait_for(lambda: len(STACKS) > 1 or not locks._stops)  # other tests may leave simulations


def wait_for(condition):
    end = time.monotonic() + 5
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def env_of(model, driver):
    return single_env(model, points={Model.decide: define(agent="a_0")}, driver=driver)


def begin(model, driver, envs):
    envs.append(env_of(model, driver))
    envs[-1].reset()


# -- told -----------------------------------------------------------------------------------------


@BY_DRIVER
@pytest.mark.parametrize(
    ("holder", "waiter"),
    [
        (Fills, Fills),
        (Drains, Drains),
        (Fills, Drains),
        (Drains, Fills),
        pytest.param(Caches, Caches, marks=pytest.mark.skipif(not ONE_LOCK, reason="has no lock")),
    ],
)
def test_env_raises_an_error_if_a_model_waits_for_another_models_lock(driver, holder, waiter):
    if driver == "greenlet" and holder is Caches:
        pytest.skip("greenlets of a thread share its RLock")
    first = env_of(holder, driver)
    first.reset()
    envs = []
    with warnings.catch_warnings(action="ignore"), pytest.raises(SimulationError) as caught:
        begin(waiter, driver, envs)  # gives up the thread
    text = str(caught.value)
    for kind in (holder, waiter):
        assert f"{kind.__name__} object at 0x" in text
    assert ("in plan" if holder is Caches else f"in {holder.__name__}.") in text
    first.step(0)  # it goes on, and releases the lock
    first.close()
    for second in envs:
        second.reset()
        second.close()


@BY_DRIVER
def test_env_reports_on_stderr_a_lock_wait_in_another_thread(driver, capfd):
    def use():
        first.reset()
        second.reset()  # waits
        second.close()
        Model.lock.acquire()  # for the first
        first.close()

    first = env_of(Fills, driver)
    second = env_of(Drains, driver)
    user = threading.Thread(target=use)
    user.start()
    told = ""
    end = time.monotonic() + 5
    while "The other simulation" not in told and time.monotonic() < end:
        told += capfd.readouterr().err
        time.sleep(0.05)
    time.sleep(0.5)
    told += capfd.readouterr().err
    Model.lock.release()
    user.join(5)
    assert not user.is_alive()
    assert told.count("simenv_marl: ") == 1
    assert "Drains object at 0x" in told.partition("waits for a lock that")[0]
    assert "Fills object at 0x" in told.partition("waits for a lock that")[2]
    assert told.count("in work\n") == 2  # both stacks


# -- not told -------------------------------------------------------------------------------------


TIMERS = []


class Sleeps(Model):
    def run(self):
        self.later(lambda: None)
        time.sleep(0.4)
        self.decide()

    def later(self, function):
        timer = threading.Timer(0.4, function)
        timer.start()
        TIMERS.append(timer)


class Lends(Sleeps):
    """A lock of each object, that a thread releases."""

    def run(self):
        self.own.acquire()
        self.later(self.own.release)
        with self.own:
            self.decide()


class Leaves(Sleeps):
    """A lock of the class, that each object has left before it decides."""

    def run(self):
        with self.lock:
            self.passed = True
        Model.lock.acquire()
        Model.lock.release()
        self.decide()
        Model.lock.acquire()
        self.later(Model.lock.release)
        with self.lock:
            self.decide()
        with self.lock:
            self.decide()


@BY_DRIVER
@pytest.mark.parametrize("model", [Sleeps, Lends, Leaves])
def test_env_does_not_report_a_short_wait_for_a_lock(driver, model, capfd):
    first = env_of(Leaves if model is Leaves else Lends if model is Lends else Model, driver)
    second = env_of(model, driver)
    first.reset()
    second.reset()
    if model is Leaves:
        second.step(0)
    second.close()
    first.close()
    while TIMERS:
        TIMERS.pop().join()
    assert capfd.readouterr().err == ""


# -- the watching thread --------------------------------------------------------------------------


def fork():
    """Fork a process that ends at once. Return how many threads this process has then."""
    process = os.fork()
    if process == 0:
        os._exit(0)
    number = len(os.listdir(TASKS))
    os.waitpid(process, 0)
    return number


@pytest.mark.skipif(not LISTED, reason=NOT_LISTED)
def test_forked_process_has_no_thread_that_watches_locks():
    alone = fork()  # threads of NumPy end at forks, too
    listed = threading.enumerate()
    first, second = [env_of(Model, "greenlet") for _ in range(2)]
    first.reset()
    for _ in range(20):
        second.reset()
        assert threading.enumerate() == listed
        assert len(os.listdir(TASKS)) == alone + 1
        assert fork() == alone
    second.reset()
    branch = clone(second, method="fork")
    assert len(os.listdir(TASKS)) == alone
    for env in (branch, first, second):
        env.close()
