"""Ends in mid-episode that pass through code of others: C code, engines, event loops, greenlets and threads."""

import asyncio
import ctypes
import gc
import sys
from functools import partial
from pathlib import Path

import greenlet
import pytest

from simenv_marl import single_env
from tests.conftest import DRIVERS
from tests.processes import alone
from tests.worlds.models import decision, script

DRIVERS = pytest.mark.parametrize("driver", DRIVERS)


# -- the exit -------------------------------------------------------------------------------------


def close_through_printing_c_code(driver, path):
    async def work():
        sys.modules["__main__"].decide = decide
        ctypes.pythonapi.PyRun_SimpleString(b"decide()")  # which calls PyErr_Print

    decide = decision()
    env = single_env(script(lambda simulation: asyncio.run(work())), decide, driver=driver)
    env.reset()
    env.close()
    Path(path).touch()


@DRIVERS
def test_the_exit_does_not_end_a_process_whose_c_code_prints_it(driver, tmp_path):
    alone(close_through_printing_c_code, driver, str(tmp_path / "closed"))
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


@DRIVERS
@pytest.mark.parametrize("end", ["close", "reset"])
def test_a_loop_of_the_models_own_cancels_its_tasks_and_closes_its_generators(driver, end):
    decide, cleanup = decision(), []
    env = single_env(script(lambda simulation: asyncio.run(office(simulation, decide, cleanup))), decide, driver=driver)
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

    def __init__(self, decide):
        self.worker, self.decide = greenlet.greenlet(self.work), decide

    def reset(self, seed=None):
        self.log = []

    def work(self):
        while True:
            self.log.append(self.decide())
            greenlet.getcurrent().parent.switch()

    def run(self):
        for _ in range(3):
            self.worker.switch()


@DRIVERS
@pytest.mark.parametrize("steps", [0, 1, 3])
def test_greenlets_that_a_model_has_kept_do_not_decide_after_a_close(driver, steps):
    decide = decision()
    env = single_env(partial(Engine, decide), decide, driver=driver)
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
