"""driver="thread": simulations in their own threads, and environments in changing threads."""

import gc
import signal
import threading
import time
from contextlib import nullcontext

import pytest

from simenv_marl import RULE, aec_env, single_env
from simenv_marl.core.switching import threads
from simenv_marl.errors import ReentrancyError
from tests.worlds import faults
from tests.worlds.models import EVERY_VIEW, calling, decision, notes, script, step


def in_a_thread(function, *args):
    """Run a function in a thread; return what it has returned, or raise what it has raised."""
    outcome = []

    def run():
        try:
            outcome.append((function(*args), None))
        except BaseException as error:
            outcome.append((None, error))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    result, error = outcome[0]
    if error is not None:
        raise error
    return result


def simulation_threads():
    return [thread for thread in threading.enumerate() if thread.name == "simulation"]


@pytest.fixture(autouse=True)
def older_threads():
    """Those that were there before the test. It is to leave no others."""
    gc.collect()
    before = simulation_threads()
    yield before
    gc.collect()
    assert simulation_threads() == before


# -- where it runs --------------------------------------------------------------------------------


@pytest.mark.parametrize("place", faults.PLACES)
def test_thread_driver_runs_the_model_in_its_own_thread_but_not_mappings(place, older_threads):
    env, farm = faults.farm_env(aec_env, place, driver="thread")
    (own,) = set(simulation_threads()) - set(older_threads)
    seen = set()
    for number, play_on in (
        (1, faults.run),
        (3, faults.run),
        (9, faults.run),
        (1, faults.cut_short),
    ):
        farm.let(lambda: seen.add(threading.current_thread()), place, number)
        play_on(env)
    inside = place in (*faults.IN_THE_MODEL, "reset", "finally", "close")
    assert seen == {own if inside else threading.current_thread()}


# -- from any thread ------------------------------------------------------------------------------


@EVERY_VIEW
def test_thread_driver_env_can_be_used_from_a_new_thread_each_time(view, older_threads):
    decide = decision(agent="a_0")
    env = view(calling(*[decide] * 3), decide, driver="thread")
    for _ in range(2):
        in_a_thread(env.reset)
        for _ in range(3):
            in_a_thread(step, env, 1, "a_0")
        assert env.simulation.log == [1, 1, 1]
    in_a_thread(env.reset)
    assert len(simulation_threads()) == len(older_threads) + 1
    in_a_thread(env.close)
    assert simulation_threads() == older_threads
    env.reset()
    assert env.simulation.episodes == 4
    env.close()
    failing = view(calling(decide, lambda: 1 / 0), decide, driver="thread")
    for _ in range(3):
        failing.reset()
        with pytest.raises(ZeroDivisionError):
            step(failing, 1, "a_0")
    assert len(simulation_threads()) == len(older_threads) + 1


@EVERY_VIEW
@pytest.mark.parametrize("what", ["step", "reset", "close"])
@pytest.mark.parametrize("place", ["rule", "observation", "render"])
def test_thread_driver_env_refuses_two_threads_at_once_and_stays_unchanged(view, what, place):
    inside, go_on = threading.Event(), threading.Event()

    def wait():
        inside.set()
        assert go_on.wait(10)

    (env, farm), (other, undisturbed) = (
        faults.farm_env(view, place, driver="thread") for _ in range(2)
    )
    env.reset(seed=11)
    farm.let(wait, place)
    stepping = threading.Thread(target=faults.take, args=(env, RULE))
    stepping.start()
    assert inside.wait(10)
    with pytest.raises(ReentrancyError, match="another thread"):
        faults.take(env, 0) if what == "step" else getattr(env, what)()
    go_on.set()
    stepping.join()
    other.reset(seed=11)
    faults.take(other, RULE)
    for _ in range(2):
        assert farm.log == undisturbed.log
        faults.take(env, 0)
        faults.take(other, 0)


# -- what is left behind --------------------------------------------------------------------------


def test_thread_driver_raises_an_error_if_no_thread_can_be_started(monkeypatch, older_threads):
    def refuse(*args, **kwargs):
        raise RuntimeError("can't start new thread")

    decide = decision()
    env = single_env(calling(decide), decide, driver="thread")
    env.close()
    monkeypatch.setattr(threading, "_start_joinable_thread", refuse, raising=False)
    monkeypatch.setattr(threading, "_start_new_thread", refuse, raising=False)
    for move in (env.reset, lambda: single_env(calling(decide), decide, driver="thread")):
        with pytest.raises(RuntimeError, match="can't start"):
            move()
    assert simulation_threads() == older_threads
    monkeypatch.undo()
    env.reset()
    env.step(1)
    assert env.simulation.log == [1]


# -- errors and interruptions ---------------------------------------------------------------------


needs_signals = pytest.mark.skipif(
    not hasattr(signal, "pthread_kill"), reason="the platform has no pthread_kill"
)


def interrupt():
    time.sleep(0.02)  # by now it is waited for the simulation
    signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)


@needs_signals
@pytest.mark.parametrize("stops", [True, False])
def test_thread_driver_keyboard_interrupt_ends_the_episode(stops, monkeypatch, older_threads):
    if not stops:
        monkeypatch.setattr(threads, "SECONDS_TO_UNWIND", 0.05)
    go_on, log, decide = threading.Event(), [], decision()

    def main(simulation):
        log.append(decide())
        if log == [1]:
            interrupt()
            assert go_on.wait(10)
        try:
            log.append(decide())
        finally:
            log.append("unwound")

    env = single_env(script(main), decide, driver="thread")
    env.reset()
    (interrupted,) = set(simulation_threads()) - set(older_threads)
    if stops:
        env.simulation.stop = go_on.set  # is called as soon as the interruption has surfaced
    warned = (
        nullcontext() if stops else pytest.warns(ResourceWarning, match=r"Script.*neither decided")
    )
    with pytest.raises(KeyboardInterrupt) as caught, warned:
        env.step(1)
    assert "seed" in notes(caught.value)
    env.reset()
    env.step(2)
    go_on.set()  # what was given up is not to go on for ever
    if not stops:
        interrupted.join(10)
    assert log == ([1, "unwound", 2] if stops else [1, 2, "unwound"])
    assert env.step(3)[2]
    assert log[3:] == [3, "unwound"]


@pytest.mark.parametrize("how", ["close", "collect"])
def test_thread_driver_warns_and_gives_up_a_model_that_does_not_unwind(
    monkeypatch, how, older_threads
):
    monkeypatch.setattr(threads, "SECONDS_TO_UNWIND", 0.05)
    go_on, decide = threading.Event(), decision()

    def main(simulation):
        try:
            decide()
        finally:
            go_on.wait(10)

    held = [single_env(script(main), decide, driver="thread")]
    held[0].reset()
    (stuck,) = set(simulation_threads()) - set(older_threads)
    with pytest.warns(ResourceWarning, match=r"Script.*neither decided") as caught:
        held[0].close() if how == "close" else held.clear()
    assert len(caught) == 1
    go_on.set()
    stuck.join(10)


def test_thread_driver_raises_errors_of_a_threads_start_to_its_caller(monkeypatch):
    def fail():
        raise MemoryError("no room for the stack")

    monkeypatch.setattr("simenv_marl.core.switching.driver.watch_resources", fail)
    with pytest.raises(MemoryError, match="no room"):
        single_env(script(lambda simulation: None), decision(), driver="thread")
