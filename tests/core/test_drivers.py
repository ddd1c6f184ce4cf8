"""What no driver may do differently: results, nesting, threads that models start, forks, ends of the process."""

import asyncio
import gc
import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from queue import Queue
from textwrap import dedent

import pytest

from simenv_marl import single_env
from simenv_marl.errors import WrongThreadError
from simenv_marl.hooks.stacks import STACKS
from tests.core.test_threads import in_a_thread
from tests.worlds.models import Script, calling, culprits, decision, nobody_is_asked, notes, script

DRIVERS = pytest.mark.parametrize("driver", ["greenlet", "thread"])


@pytest.fixture(autouse=True)
def _nobody_is_running_afterwards():
    before = set(STACKS)  # of environments that other modules of tests keep
    yield
    gc.collect()
    assert nobody_is_asked()
    assert STACKS.keys() <= before


# -- several at once ------------------------------------------------------------------------------


@pytest.mark.parametrize("outer", ["greenlet", "thread"])
@pytest.mark.parametrize("inner", ["greenlet", "thread"])
def test_environments_run_inside_each_others_simulations(outer, inner):
    decide, deeper = decision(agent="outer_0"), decision(agent="inner_0")

    def main(simulation):
        env = single_env(calling(deeper, deeper), deeper, driver=inner)
        env.reset()
        for _ in range(2):
            number = decide()
            simulation.log.append((number, env.step(number)[2]))
        simulation.log.append(env.simulation.log)
        simulation.log.append(deeper())

    env = single_env(script(main), decide, driver=outer)
    env.reset()
    env.step(1)
    env.step(2)
    assert env.simulation.log == [(1, False), (2, True), [1, 2], "rule"]
    env.reset()
    env.close()


@DRIVERS
def test_unrelated_threads_run_their_rule_while_a_simulation_is_moving(driver):
    asked, answered, pool = threading.Event(), threading.Event(), ThreadPoolExecutor(1)
    said = []

    def unrelated():
        assert asked.wait(10)
        said.append(decide())
        answered.set()

    def main(simulation):
        decide()
        asked.set()
        assert answered.wait(10)
        decide()

    decide = decision()
    env = single_env(script(main), decide, driver=driver)
    env.reset()
    thread = threading.Thread(target=unrelated)
    thread.start()
    env.step(1)
    thread.join()
    pool.shutdown()
    assert said == ["rule"]
    env.close()


# -- threads that models start --------------------------------------------------------------------


def by_thread(function):
    """In a thread of its own: what it has returned, or what it has raised."""
    with suppress(Exception):
        return in_a_thread(function)
    return "refused"


def by_grandchild(function):
    return by_thread(lambda: by_thread(function))


def by_timer(function):
    said = []

    def run():
        said.append("refused")
        with suppress(WrongThreadError):
            said[0] = function()

    timer = threading.Timer(0, run)
    timer.start()
    timer.join()
    return said[0]


def by_pool(function):
    with ThreadPoolExecutor(1) as pool, suppress(WrongThreadError):
        return pool.submit(function).result()
    return "refused"


def by_asyncio(function):
    with suppress(WrongThreadError):
        return asyncio.run(asyncio.to_thread(function))
    return "refused"


WAYS = pytest.mark.parametrize("way", [by_thread, by_grandchild, by_timer, by_pool, by_asyncio])


@DRIVERS
@WAYS
def test_decisions_in_threads_of_the_model_are_refused_and_the_next_step_says_so(driver, way):
    def main(simulation):
        simulation.log.append(decide())
        simulation.log.append(way(decide))
        simulation.log.append(decide())

    decide = decision()
    env = single_env(script(main), decide, driver=driver)
    env.reset(seed=5)
    with pytest.raises(
        WrongThreadError, match="choose was called in a thread that the simulation has started"
    ) as caught:
        env.step(1)
    assert env.simulation.log == [1, "refused"]
    assert "after decision 1, of 'choose_0'" in notes(caught.value)
    assert "refuse" in culprits(caught.value.__cause__)  # which leads to the thread
    env.reset()
    env.close()


@DRIVERS
def test_an_error_of_a_refused_thread_that_the_model_passes_on_is_raised_once(driver):
    def main(simulation):
        decide()
        with ThreadPoolExecutor(1) as pool:
            pool.submit(decide).result()

    decide = decision()
    env = single_env(script(main), decide, driver=driver)
    env.reset()
    with pytest.raises(WrongThreadError, match="in a thread that the simulation has started") as caught:
        env.step(1)
    assert "main" in culprits(caught.value)
    assert notes(caught.value).count("\n") == 0
    env.reset()
    env.close()


@DRIVERS
def test_another_error_of_the_model_tells_of_the_refusal_too(driver):
    def main(simulation):
        decide()
        by_thread(decide)
        raise KeyError("nobody has put it there")

    decide = decision()
    env = single_env(script(main), decide, driver=driver)
    env.reset()
    with pytest.raises(KeyError) as caught:
        env.step(1)
    assert "a decision was refused" in notes(caught.value)


@DRIVERS
def test_a_refusal_in_the_last_step_surfaces_at_the_end(driver):
    decide = decision()
    env = single_env(calling(decide, lambda: by_thread(decide)), decide, driver=driver)
    env.reset()
    with pytest.raises(WrongThreadError, match="in a thread that the simulation has started"):
        env.step(1)
    assert env.simulation.log == [1, "refused"]


@DRIVERS
@pytest.mark.parametrize("how", ["step", "close", "reset"])
def test_a_thread_that_runs_while_the_simulation_is_suspended_is_refused_too(driver, how):
    ask, said = threading.Event(), []

    def work():
        assert ask.wait(10)
        said.append("refused")
        with suppress(WrongThreadError):
            said[0] = decide()

    def main(simulation):
        simulation.thread = threading.Thread(target=work)
        simulation.thread.start()
        decide()
        decide()

    decide = decision()
    env = single_env(script(main), decide, driver=driver)
    env.reset()
    ask.set()
    env.simulation.thread.join()
    assert said == ["refused"]
    with pytest.raises(WrongThreadError, match="in a thread that the simulation has started"):
        env.step(1) if how == "step" else getattr(env, how)()
    ask.clear()
    env.reset()
    ask.set()
    env.simulation.thread.join()
    with pytest.raises(WrongThreadError, match="in a thread that the simulation has started"):
        env.close()


class Pooled(Script):
    """Has threads that are there before any episode, or that outlive some."""

    def __init__(self, main):
        super().__init__(main)
        self.requests, self.answers = Queue(), Queue()
        self.thread = None

    def work(self):
        for function in iter(self.requests.get, None):
            try:
                self.answers.put(function())
            except WrongThreadError:
                self.answers.put("refused")

    def hire(self):
        self.thread = threading.Thread(target=self.work, daemon=True)
        self.thread.start()

    def ask(self, function):
        self.requests.put(function)
        return self.answers.get(timeout=10)


@DRIVERS
@pytest.mark.parametrize("when", ["made", "reset", "episode before"])
def test_threads_that_are_older_than_the_episode_are_refused_too(driver, when):
    class Hiring(Pooled):
        def __init__(self):
            super().__init__(main)
            if when == "made":
                self.hire()

        def reset(self):
            super().reset()
            if when == "reset":
                self.hire()
                self.log.append(self.ask(decide))

    def main(simulation):
        simulation.log.append(decide())
        if simulation.thread is None:
            simulation.hire()
            return
        simulation.log.append(simulation.ask(decide))
        decide()

    decide = decision()
    env = single_env(Hiring, decide, driver=driver)
    env.reset()
    if when == "episode before":
        assert env.step(1)[2]
        simulation = env.simulation
        assert simulation.ask(decide) == "rule"  # between episodes nobody would be asked anyway
        env.reset()
    with pytest.raises(WrongThreadError, match="in a thread that the simulation has started"):
        env.step(1)
    assert env.simulation.log == [*(["rule"] if when == "reset" else []), 1, "refused"]
    env.close()
    assert env.simulation.ask(decide) == "rule"
    env.simulation.requests.put(None)
    env.simulation.thread.join()


@DRIVERS
def test_points_that_are_not_active_run_their_rule_in_threads_of_the_model(driver):
    active, other = decision(), decision(lambda: "its rule")
    env = single_env(calling(active, lambda: by_thread(other), active), active, driver=driver)
    env.reset()
    env.step(1)
    env.step(2)
    assert env.simulation.log == [1, "its rule", 2]


@DRIVERS
@pytest.mark.parametrize("inner", ["greenlet", "thread"])
def test_threads_of_the_model_may_use_environments_of_their_own(driver, inner):
    decide, deeper = decision(agent="outer_0"), decision(agent="inner_0", reward_mapping=lambda: decide() == "rule")

    def use():
        env = single_env(calling(deeper, deeper), deeper, driver=inner)
        env.reset()
        return [env.step(1)[1:3], env.step(2)[1:3], env.simulation.log]

    env = single_env(calling(decide, lambda: by_thread(use), decide), decide, driver=driver)
    env.reset()
    env.step(1)
    env.step(2)
    assert env.simulation.log == [1, [(1.0, False), (1.0, True), [1, 2]], 2]


# -- forks and ends of the process ----------------------------------------------------------------

needs_fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="the platform has no fork")


def run(code):
    """Run code in a process of its own; return what it has printed."""
    preamble = """
        import os, sys, threading
        from simenv_marl import aec_env, single_env
        from simenv_marl.errors import WrongThreadError
        from tests.worlds.models import calling, decision, script
        def in_a_child(function):
            child = os.fork()
            if child == 0:
                status = 1
                try:
                    function()
                    status = 0
                except BaseException as error:
                    print("the child has raised", repr(error), flush=True)
                finally:
                    os._exit(status)
            assert os.waitpid(child, 0)[1] == 0
    """
    # Python warns of forks where there are other threads; here there are, and that is what is tested.
    command = [sys.executable, "-W", "error", "-W", "ignore:This process:DeprecationWarning", "-c"]
    result = subprocess.run(
        [*command, dedent(preamble) + dedent(code)], capture_output=True, text=True, check=False, timeout=60
    )
    assert (result.returncode, result.stderr) == (0, ""), result.stdout + result.stderr
    return result.stdout


@needs_fork
def test_a_process_that_is_forked_in_mid_episode_goes_on_twice_with_greenlets():
    said = run("""
        decide = decision()
        env = single_env(calling(decide, decide), decide)
        env.reset()
        env.step(1)
        def child():
            assert env.step(2)[2]
            print("child", env.simulation.log, flush=True)
            env.reset()
            env.step(7)
        in_a_child(child)
        env.step(3)
        print("parent", env.simulation.log)
    """)
    assert said == "child [1, 2]\nparent [1, 3]\n"


@needs_fork
def test_a_decision_in_a_process_that_the_model_has_forked_is_refused():
    said = run("""
        from simenv_marl.errors import WrongThreadError
        decide = decision()
        def main(simulation):
            simulation.log.append(decide())
            child = os.fork()
            if child == 0:
                try:
                    decide()
                except WrongThreadError as error:
                    print("a process that the simulation has forked" in str(error), flush=True)
                os._exit(0)
            assert os.waitpid(child, 0)[1] == 0
            simulation.log.append(decide())
        env = single_env(script(main), decide)
        env.reset()
        env.step(1)
        assert env.step(2)[2]
        print(env.simulation.log, flush=True)
    """)
    assert said == "True\n[1, 2]\n"


@needs_fork
def test_a_process_that_is_forked_in_mid_episode_has_to_reset_with_threads():
    said = run("""
        decide = decision()
        env = single_env(calling(decide, decide), decide, driver="thread")
        other = single_env(calling(decide), decide, driver="thread")
        other.reset()
        env.reset()
        env.step(1)
        def child():
            for _ in range(2):
                try:
                    env.step(2)
                except WrongThreadError as error:
                    assert "reset()" in str(error)
            env.reset()
            env.step(4)
            assert env.step(5)[2]
            print("child", env.simulation.log, flush=True)
            other.close()
        in_a_child(child)
        env.step(3)
        print("parent", env.simulation.log)
    """)
    assert said == "child [4, 5]\nparent [1, 3]\n"


@needs_fork
def test_a_model_in_a_thread_that_forks_cannot_decide_in_the_child():
    said = run("""
        decide = decision()
        def main(simulation):
            simulation.log.append(decide())
            def child():
                try:
                    decide()
                except WrongThreadError as error:
                    assert "forked" in str(error)
                    print("refused", flush=True)
            in_a_child(child)
            simulation.log.append(decide())
        env = single_env(script(main), decide, driver="thread")
        env.reset()
        env.step(1)
        assert env.step(2)[2]
        print(env.simulation.log)
    """)
    assert said == "refused\n[1, 2]\n"


@needs_fork
def test_what_a_forked_model_in_a_thread_does_not_catch_is_printed():
    said = run("""
        decide = decision()
        def main(simulation):
            decide()
            child = os.fork()
            if child == 0:
                os.dup2(1, 2)
            else:
                os.waitpid(child, 0)
            decide()
        env = single_env(script(main), decide, driver="thread")
        env.reset()
        env.step(1)
        env.close()
    """)
    assert "WrongThreadError" in said
    assert "forked" in said


@needs_fork
@DRIVERS
def test_a_fork_while_other_threads_are_moving_leaves_nothing_of_them_in_the_child(driver):
    said = run(f"""
        inside, go_on = threading.Event(), threading.Event()
        decide = decision()
        def main(simulation):
            decide()
            inside.set()
            assert go_on.wait(10)
            decide()
        env = single_env(script(main), decide, driver={driver!r})
        def use():
            env.reset()
            env.step(1)
            env.close()
        user = threading.Thread(target=use)
        user.start()
        inside.wait(10)
        def child():
            assert decide() == "rule"
            mine = single_env(calling(decide), decide, driver={driver!r})
            mine.reset()
            mine.step(1)
            env.reset()
            print(env.simulation.episodes, flush=True)
        in_a_child(child)
        go_on.set()
        user.join()
    """)
    assert said == "2\n"


@DRIVERS
@pytest.mark.parametrize("where", ["suspended", "several", "over", "closed", "inside", "in a thread", "moving"])
def test_a_process_ends_cleanly_with_environments_in_mid_episode(driver, where):
    said = run(f"""
        where = {where!r}
        decide = decision()
        inside = threading.Event()
        def main(simulation):
            try:
                if where == "inside":
                    simulation.inner = single_env(script(leaf), decide, driver={driver!r})
                    simulation.inner.reset()
                decide()
                if where == "moving":
                    inside.set()
                    threading.Event().wait()
                decide()
            finally:
                print("unwound", flush=True)
        def leaf(simulation):
            try:
                decide()
            finally:
                print("unwound", flush=True)
        envs = [single_env(script(main), decide, driver={driver!r}) for _ in range(3 if where == "several" else 1)]
        def use():
            for env in envs:
                env.reset()
                if where in ("over", "moving"):
                    env.step(1)
                if where == "over":
                    env.step(1)
                if where == "closed":
                    env.close()
        if where == "moving":
            threading.Thread(target=use, daemon=True).start()
            inside.wait()
        elif where == "in a thread":
            user = threading.Thread(target=use)
            user.start()
            user.join()
        else:
            use()
    """)
    # What is moving when the process ends, or was on a greenlet of a thread that has ended, is not unwound.
    never = where == "moving" or (where == "in a thread" and driver == "greenlet")
    assert said == "unwound\n" * (0 if never else {"several": 3, "inside": 2}.get(where, 1))
