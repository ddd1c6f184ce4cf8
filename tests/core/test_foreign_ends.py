"""Ends in mid-episode that pass through code of others: C code, engines, event loops, greenlets and threads."""

import asyncio
import ctypes
import sys
from pathlib import Path

import pytest

from simenv_marl import single_env
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
