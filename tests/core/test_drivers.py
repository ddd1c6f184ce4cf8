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


@DRIVERS
@pytest.mark.parametrize("inside", ["greenlet", "thread"])
def test_environments_run_inside_each_others_simulations(driver, inside):
    """Each decides for itself alone, and the mappings of the inner one are not the outer one's."""
    seen = []

    def spy(value):
        seen.append(outer())
        return value

    outer = decision(agent="outer_0")
    inner = decision(
        agent="inner_0",
        observation_space_mapping=lambda: spy([0, 0]),
        reward_mapping=lambda: spy(0.0),
        action_space_mapping=spy,
    )

    def main(simulation):
        env = single_env(calling(inner, inner), inner, driver=inside)
        env.reset()
        for _ in range(2):
            number = outer()
            simulation.log.append((number, env.step(number)[2]))
        simulation.log.append(env.simulation.log)
        simulation.log.append(inner())
        env.close()
        simulation.log.append(outer())

    env = single_env(script(main), outer, driver=driver)
    env.reset()
    assert [env.step(number)[2] for number in (1, 2, 3)] == [False, False, True]
    assert env.simulation.log == [(1, False), (2, True), [1, 2], "rule", 3]
    assert set(seen) == {"rule"}
    env.reset()
    env.close()


@DRIVERS
def test_unrelated_threads_run_their_rule_while_a_simulation_is_moving(driver):
    asked, answered = threading.Event(), threading.Event()
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
    assert said == ["rule"]
    env.close()


# -- threads that models start --------------------------------------------------------------------


def by_thread(function):
    """In a thread of its own: what it has returned there, or that it was refused."""
    with suppress(WrongThreadError):
        return in_a_thread(function)
    return "refused"


def by_pool(function):
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(function).result()


WAYS = [
    in_a_thread,
    lambda function: in_a_thread(lambda: in_a_thread(function)),
    by_pool,
    lambda function: asyncio.run(asyncio.to_thread(function)),
]


@DRIVERS
@pytest.mark.parametrize("way", WAYS, ids=["thread", "grandchild", "pool", "asyncio"])
def test_decisions_in_threads_of_the_model_are_refused_and_the_next_step_says_so(driver, way):
    def main(simulation):
        simulation.log.append(decide())
        with suppress(WrongThreadError):
            simulation.log.append(way(decide))
        simulation.log.append("refused")
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
def test_a_refusal_is_raised_once_or_told_of_by_another_error(driver):
    def passed_on():
        return by_pool(decide)

    def followed_by_another():
        by_thread(decide)
        raise KeyError("nobody has put it there")

    decide = decision()
    env = single_env(calling(decide, passed_on), decide, driver=driver)
    env.reset()
    with pytest.raises(WrongThreadError, match="in a thread that the simulation has started") as caught:
        env.step(1)
    assert "passed_on" in culprits(caught.value)
    assert notes(caught.value).count("\n") == 0
    env.close()
    env = single_env(calling(decide, followed_by_another), decide, driver=driver)
    env.reset()
    with pytest.raises(KeyError) as caught:
        env.step(1)
    assert "a decision was refused" in notes(caught.value)
    env.close()


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
@pytest.mark.parametrize(
    "where", ["suspended", "a hundred", "failed", "over", "closed", "inside", "in a thread", "in daemons", "moving"]
)
def test_a_process_ends_cleanly_with_environments_in_mid_episode(driver, where):
    said = run(f"""
        where = {where!r}
        decide = decision()
        ready, never = threading.Event(), threading.Event()
        def main(simulation):
            try:
                if where == "inside":
                    simulation.inner = single_env(script(main_inside), decide, driver={driver!r})
                    simulation.inner.reset()
                decide()
                if where == "moving":
                    ready.set()
                    never.wait()
                if where == "failed":
                    raise ZeroDivisionError
                decide()
            finally:
                print("unwound", flush=True)
        def main_inside(simulation):
            try:
                decide()
            finally:
                print("unwound", flush=True)
        number = 100 if where == "a hundred" else 1
        views = (single_env, aec_env)
        envs = [views[number % 2](script(main), decide, driver={driver!r}) for number in range(number)]
        def use():
            for env in envs:
                env.reset()
                if where in ("over", "moving", "failed"):
                    try:
                        env.step(1)
                    except ZeroDivisionError:
                        pass
                if where == "over":
                    env.step(1)
                if where == "closed":
                    env.close()
            if where == "in daemons":
                ready.set()
                never.wait()
        if where in ("moving", "in daemons"):
            threading.Thread(target=use, daemon=True).start()
            ready.wait()
        elif where == "in a thread":
            user = threading.Thread(target=use)
            user.start()
            user.join()
        else:
            use()
    """)
    # What is moving when the process ends, or was on a greenlet of another thread, is not unwound.
    never = where == "moving" or (where in ("in a thread", "in daemons") and driver == "greenlet")
    assert said == "unwound\n" * (0 if never else {"a hundred": 100, "inside": 2}.get(where, 1))
