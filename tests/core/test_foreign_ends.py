"""Ends in mid-episode that pass through code of others: C code, engines, event loops, greenlets and threads."""

import asyncio
import ctypes
import gc
import sys
import threading
from functools import partial
from pathlib import Path

import greenlet
import pytest

from simenv_marl import single_env
from simenv_marl.core.run import Run
from simenv_marl.errors import ReentrancyError
from tests.conftest import DRIVERS
from tests.processes import alone
from tests.worlds.models import decision, script

DRIVERS = pytest.mark.parametrize("driver", DRIVERS)


# -- the exit -------------------------------------------------------------------------------------


def close_through_printing_c_code(driver, loop, path):
    def ask():
        sys.modules["__main__"].decide = decide
        ctypes.pythonapi.PyRun_SimpleString(b"decide()")  # which calls PyErr_Print

    async def work():
        ask()

    decide = decision()
    env = single_env(script(lambda simulation: asyncio.run(work()) if loop else ask()), decide, driver=driver)
    env.reset()
    env.close()
    Path(path).touch()


@DRIVERS
@pytest.mark.parametrize("loop", [False, True], ids=["plain", "asyncio"])
def test_the_exit_does_not_end_a_process_whose_c_code_prints_it(driver, loop, tmp_path):
    alone(close_through_printing_c_code, driver, loop, str(tmp_path / "closed"))
    assert (tmp_path / "closed").exists()


class EngineError(Exception):
    """What an engine raises in place of what it has caught."""


def wrap(decide, how):
    """Decide in an engine that raises an error of its own. Only a cleanup that fails is an error of the model."""
    kept = None
    try:
        decide()
    except BaseException as error:
        if how == "implicitly":
            raise EngineError("a process has failed")  # noqa: B904
        if how == "hidden":
            raise EngineError("a process has failed") from None
        if how == "twice":
            try:
                raise EngineError("a process has failed")
            except EngineError:
                raise EngineError("the engine has failed")  # noqa: B904
        if how == "exit":
            sys.exit(3)
        kept = error
    if how == "text":
        raise EngineError(str(kept))
    raise EngineError("a process has failed", kept)


@DRIVERS
@pytest.mark.parametrize("how", ["implicitly", "hidden", "twice", "exit", "text", "later"])
@pytest.mark.parametrize("end", ["close", "reset"])
def test_an_error_that_an_engine_raises_in_place_of_the_exit_is_not_the_models(driver, how, end):
    decide = decision()
    env = single_env(script(lambda simulation: wrap(decide, how)), decide, driver=driver)
    env.reset()
    getattr(env, end)()
    env.close()


@DRIVERS
def test_an_error_of_a_cleanup_is_the_models(driver):
    def main(simulation):
        try:
            decide()
        finally:
            raise EngineError("the disk is full")

    decide = decision()
    env = single_env(script(main), decide, driver=driver)
    env.reset()
    with pytest.raises(EngineError, match="disk"):
        env.close()


# -- event loops that end -------------------------------------------------------------------------


async def numbers(log, cleanup=lambda: None):
    try:
        while True:
            yield await asyncio.sleep(0)
    finally:
        cleanup()
        await asyncio.sleep(0)
        log.append("generator closed")


async def stay(log, cleanup):
    try:
        await asyncio.sleep(3600)
    finally:
        cleanup()
        await asyncio.sleep(0)
        log.append("task cancelled")


async def office(simulation, decide, cleanup):
    """Decide while tasks and asynchronous generators of the model are left, of which some decide in their cleanup."""

    def quietly():
        cleanup.append("decides")
        decide()

    generators = [numbers(simulation.log, *args) for args in [(), (quietly,), ()]]
    for generator in generators:
        await anext(generator)
    works = [lambda: None, quietly, lambda: None, quietly, lambda: None]
    tasks = [asyncio.create_task(stay(simulation.log, work)) for work in works]
    await asyncio.sleep(0)
    decide()
    await asyncio.wait(tasks)


def run_in_a_runner(work):
    with asyncio.Runner() as runner:
        runner.run(work)


@DRIVERS
@pytest.mark.parametrize("run", [asyncio.run, run_in_a_runner])
@pytest.mark.parametrize("end", ["close", "reset"])
def test_a_loop_of_the_models_own_cancels_its_tasks_and_closes_its_generators(driver, run, end):
    decide, cleanup = decision(), []
    env = single_env(script(lambda simulation: run(office(simulation, decide, cleanup))), decide, driver=driver)
    env.reset()
    log = env.simulation.log
    getattr(env, end)()
    assert sorted(log) == ["generator closed"] * 2 + ["task cancelled"] * 3
    assert len(cleanup) == 3
    env.close()
    gc.collect()


# -- greenlets that outlive their stack -----------------------------------------------------------


class Engine:
    """Makes its worker once, for all episodes."""

    def __init__(self, decide, back):
        self.worker, self.decide, self.back = greenlet.greenlet(self.work), decide, back

    def reset(self, seed=None):
        self.log, self.main = [], None

    def work(self):
        while True:
            self.log.append(self.decide())
            (self.main or greenlet.getcurrent().parent).switch()

    def run(self):
        self.main = greenlet.getcurrent() if self.back == "by name" else None
        for _ in range(3):
            self.worker.switch()


@DRIVERS
@pytest.mark.parametrize("steps", [0, 1, 3])
@pytest.mark.parametrize("back", ["by name", "to the parent"])
def test_greenlets_that_a_model_has_kept_do_not_decide_after_a_close(driver, steps, back):
    decide = decision()
    env = single_env(partial(Engine, decide, back), decide, driver=driver)
    env.reset()
    simulation = env.simulation
    for number in range(steps):
        env.step(number)
    env.close()
    for _ in range(2):
        env.reset()
        assert [env.step(number)[2] for number in range(3)] == [False, False, True]
        assert env.simulation.log == [0, 1, 2]
        env.close()
    assert env.simulation is not simulation


@DRIVERS
def test_a_simulation_without_greenlets_stays_the_same_after_a_close(driver):
    decide = decision()
    env = single_env(script(lambda simulation: decide()), decide, driver=driver)
    simulation = env.simulation
    for _ in range(2):
        env.reset()
        env.close()
        assert env.simulation is simulation


# -- threads that use one environment -------------------------------------------------------------


@DRIVERS
@pytest.mark.parametrize("use", ["close", "reset"])
def test_a_thread_that_ends_an_episode_while_another_one_does_is_refused(driver, use, monkeypatch):
    """The second thread is on its way while the first one, which waits in the model's cleanup, comes to the end."""
    arrived, errors, explain = [threading.Event() for _ in range(3)], [], Run.refusal

    def main(simulation):
        try:
            decide()
        finally:
            arrived[0].set()
            assert arrived[1].wait(60)

    def late(run):
        arrived[1].set()
        assert arrived[2].wait(60)
        return explain(run)

    def use_it():
        assert arrived[0].wait(60)
        try:
            getattr(env, use)()
        except Exception as error:
            errors.append(type(error))
        arrived[1].set()

    monkeypatch.setattr(Run, "refusal", late)
    decide = decision()
    env = single_env(script(main), decide, driver=driver)
    env.reset()
    thread = threading.Thread(target=use_it)
    thread.start()
    env.close()
    arrived[2].set()
    thread.join()
    assert errors == [ReentrancyError]
