"""Decisions in callbacks of C code, and exceptions that are raised there."""

import ctypes
import gc
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import pytest

from simenv_marl import single_env
from simenv_marl.remote import CallbackGuard
from tests.worlds.models import begun, culprits, decision, notes, script, stacks

COMPARE = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.POINTER(ctypes.c_int), ctypes.POINTER(ctypes.c_int))
EACH = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_int)

pytestmark = pytest.mark.skipif(
    sys.platform == "win32", reason="libc is looked for in the process itself"
)


@pytest.fixture(autouse=True)
def _silent(capfd):
    """An exception that is lost in a callback is printed."""
    yield
    gc.collect()
    assert capfd.readouterr().err == ""


@cache
def loops():
    if shutil.which("cc") is None:
        pytest.skip("there is no C compiler")
    library, source = Path(mkdtemp()) / "loops.so", Path(__file__).with_name("loops.c")
    subprocess.run(["cc", "-shared", "-fPIC", "-o", library, source], check=True, timeout=60)
    return ctypes.CDLL(str(library))


def sort(callback):
    """Sort nine numbers by the C library."""
    array = (ctypes.c_int * 9)(*range(9, 0, -1))
    ctypes.CDLL(None).qsort(array, 9, ctypes.sizeof(ctypes.c_int), COMPARE(callback))
    return list(array)


def sorting(ask, log, stop=None):
    """A simulation that sorts numbers; each comparison calls ``ask`` with two numbers."""

    def main(simulation):
        guard = CallbackGuard(stop)
        try:
            with guard:
                simulation.log.append(
                    sort(guard.callback(lambda one, other: ask(one[0], other[0])))
                )
        finally:
            log.append("finally")

    return script(main)


def comparing():
    return decision(lambda one, other: one - other, agent="a_0")


@pytest.mark.parametrize("trigger", ["close", "reset", "collect"])
def test_env_close_in_mid_episode_unwinds_a_model_called_from_c(trigger):
    log, decide, before = [], comparing(), stacks()
    env = begun(single_env(sorting(decide, log, stop=lambda: log.append("stop")), decide))
    env.step(1)
    if trigger != "collect":
        getattr(env, trigger)()
        assert log == ["stop", "finally"]
    del env
    gc.collect()
    assert log == ["stop", "finally"] * (2 if trigger == "reset" else 1)
    assert not stacks(before)


@pytest.mark.parametrize("error", [ZeroDivisionError, KeyboardInterrupt, SystemExit, StopIteration])
def test_error_in_a_callback_from_c_is_raised_by_env_step(error):
    def fail(one, other):
        if decide(one, other):
            raise error("in C")

    log, decide = [], comparing()
    env = begun(single_env(sorting(fail, log), decide), 7)
    with pytest.raises(error, match="in C") as caught:
        env.step(1)
    assert culprits(caught.value)[-1] == "fail"
    assert "seed 7" in notes(caught.value)
    assert log == ["finally"]


def test_error_of_a_stop_function_is_raised_with_the_callbacks_error():
    guard = CallbackGuard(stop=lambda: {}["cannot stop"])
    with pytest.raises(KeyError, match="cannot stop") as caught, guard:
        sort(guard.callback(lambda *_: 1 // 0))
    assert isinstance(caught.value.__context__, ZeroDivisionError)


def test_c_code_gets_default_results_after_a_callback_has_failed():
    guard, answers = CallbackGuard(), []
    divide = guard.callback(lambda number: 1 // number, result=-1)
    with pytest.raises(ZeroDivisionError), guard:
        answers += [divide(1), divide(0), divide(1)]
    assert answers == [1, -1, -1]
    with pytest.raises(ZeroDivisionError):  # outside a block a callback is called as it is
        divide(0)


@pytest.mark.parametrize("during", ["step", "close"])
def test_keyboard_interrupt_during_c_code_is_raised_by_env_step(during):
    def main(simulation):
        with guard:
            loops().loop_interrupted(EACH(guard.callback(decide)), 9, 1)

    guard, decide = CallbackGuard(), decision(lambda number: 0, agent="a_0")
    env = begun(single_env(script(main), decide))
    with pytest.raises(KeyboardInterrupt):
        env.step(1) if during == "step" else env.close()
