"""What no driver may do differently: stacks, nesting, threads that models start, forks, ends of the process."""

import asyncio
import contextvars
import gc
import os
import subprocess
import sys
import threading
import weakref
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from textwrap import dedent

import greenlet
import pytest

from simenv_marl import RULE, single_env
from simenv_marl.errors import WrongThreadError
from simenv_marl.hooks.stacks import EVALUATING, STACKS
from tests.core.test_threads import in_a_thread
from tests.worlds.models import Script, calling, culprits, decision, nobody_is_asked, notes, script

DRIVERS = pytest.mark.parametrize("driver", ["greenlet", "thread"])
REFUSED = "choose was called in a thread that the simulation has started"


@pytest.fixture(autouse=True)
def _nobody_is_running_afterwards():
    gc.collect()
    before = set(STACKS)  # of environments that other modules of tests keep
    yield
    gc.collect()
    gc.collect()
    assert nobody_is_asked()
    assert set(STACKS) <= before
    assert EVALUATING == {}


# -- 5.0: one stack of its own, kept over the episodes --------------------------------------------


@DRIVERS
def test_everything_of_a_simulation_runs_on_one_stack_and_in_its_context(driver):
    variable = contextvars.ContextVar("variable", default="nobody's")
    seen = []

    def look():
        seen.append((greenlet.getcurrent(), threading.get_ident()))

    class Engine(Script):
        """Makes a greenlet in ``reset`` to which ``run`` switches, as discrete-event engines do."""

        def __init__(self):
            super().__init__(None)
            look()

        def reset(self, seed=None):
            super().reset(seed)
            look()
            self.log.append(variable.get())
            variable.set("the model's")
            self.worker = greenlet.greenlet(self.work)

        def work(self):
            for _ in range(3):
                self.log.append(decide())

        def run(self):
            look()
            self.log.append(variable.get())
            self.worker.switch()
            self.log.append(variable.get())
            look()

    decide = decision()
    env = single_env(Engine, decide, driver=driver)
    for user in ("one", "two", "after it was closed"):
        token = variable.set(user)
        for _ in range(2):
            env.reset()
            assert variable.get() == user
            for action in (1, 2, RULE):
                env.step(action)
            assert env.unwrapped.simulation.log == [user, "the model's", 1, 2, "rule", "the model's"]
        if user == "two":
            env.reset()
            assert len(set(seen)) == 1
            assert greenlet.getcurrent() is not seen[0][0]
            env.close()
            seen.clear()
        variable.reset(token)
    assert len(set(seen)) == 1
    env.close()


# -- several at once ------------------------------------------------------------------------------


@DRIVERS
def test_unrelated_threads_run_their_rule_while_a_simulation_is_moving(driver):
    decide = decision()
    with ThreadPoolExecutor(1) as pool:
        pool.submit(int).result()  # now its thread is there
        env = single_env(calling(decide, lambda: pool.submit(decide).result(), decide), decide, driver=driver)
        env.reset()
        env.step(1)
        env.step(2)
    assert env.simulation.log == [1, "rule", 2]


# -- threads that models start --------------------------------------------------------------------


def by_thread(function):
    return in_a_thread(lambda: refused_or(function))


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
@pytest.mark.parametrize("last", [False, True])
@pytest.mark.parametrize("way", WAYS, ids=["thread", "grandchild", "pool", "asyncio"])
def test_decisions_in_threads_of_the_model_are_refused_and_the_step_says_so(driver, way, last):
    def main(simulation):
        simulation.log.append(decide())
        with suppress(WrongThreadError):
            simulation.log.append(way(decide))
        simulation.log.append("refused")
        if not last:
            simulation.log.append(decide())

    decide = decision()
    env = single_env(script(main), decide, driver=driver)
    env.reset(seed=5)
    with pytest.raises(WrongThreadError, match=REFUSED) as caught:
        env.step(1)
    assert env.simulation.log == [1, "refused"]
    assert "after decision 1, of 'choose_0'" in notes(caught.value)
    assert "refuse" in culprits(caught.value.__cause__)  # which leads to the thread
    env.reset()
    env.close()


@DRIVERS
@pytest.mark.parametrize("way", WAYS, ids=["thread", "grandchild", "pool", "asyncio"])
def test_a_refusal_that_is_kept_does_not_keep_the_root_of_its_thread(driver, way):
    """Else greenlet frees that root too early, if the collector runs while the thread ends, and the process crashes."""

    def main(simulation):
        decide()
        with suppress(WrongThreadError):
            way(lambda: (roots.append(weakref.ref(greenlet.getcurrent())), decide()))

    roots, decide = [], decision()
    env = single_env(script(main), decide, driver=driver)
    env.reset()
    with pytest.raises(WrongThreadError) as caught:
        env.step(1)
    env.close()
    assert caught.value.__cause__.__traceback__
    (root,) = roots
    assert root() is None or not gc.get_referrers(root())


@DRIVERS
def test_a_refusal_is_raised_once_or_noted_on_another_error(driver):
    def passed_on():
        return by_pool(decide)

    def followed_by_another():
        by_thread(decide)
        raise KeyError("nobody has put it there")

    def raised_by(function, kind):
        env = single_env(calling(decide, function), decide, driver=driver)
        env.reset()
        with pytest.raises(kind) as caught:
            env.step(1)
        env.close()
        return caught.value

    decide = decision()
    error = raised_by(passed_on, WrongThreadError)
    assert REFUSED in str(error)
    assert "passed_on" in culprits(error)
    assert notes(error).count("\n") == 0
    assert "a decision was refused" in notes(raised_by(followed_by_another, KeyError))


def refused_or(function):
    """What it has returned in this thread, or that it was refused."""
    with suppress(WrongThreadError):
        return function()
    return "refused"


@DRIVERS
@pytest.mark.parametrize("how", ["step", "close", "reset"])
def test_a_thread_that_runs_while_the_simulation_is_suspended_is_refused_too(driver, how):
    def work():
        assert ask.wait(10)
        said.append(refused_or(decide))

    def main(simulation):
        simulation.thread = threading.Thread(target=work)
        simulation.thread.start()
        decide()
        decide()

    ask, said, decide = threading.Event(), [], decision()
    env = single_env(script(main), decide, driver=driver)
    for use in (how, "close"):
        ask.clear()
        env.reset()
        ask.set()
        env.simulation.thread.join()
        with pytest.raises(WrongThreadError, match=REFUSED):
            env.step(1) if use == "step" else getattr(env, use)()
    assert said == ["refused"] * 2


@DRIVERS
def test_threads_that_are_older_than_the_episode_are_refused_too(driver):
    class Hiring(Script):
        def __init__(self):
            super().__init__(main)
            self.pool = ThreadPoolExecutor(1)
            self.pool.submit(int).result()  # now its thread is there

        def ask(self):
            return self.pool.submit(refused_or, decide).result()

    def main(simulation):
        simulation.log.append(decide())
        simulation.log.append(simulation.ask())
        decide()

    decide = decision()
    env = single_env(Hiring, decide, driver=driver)
    for _ in range(2):
        assert env.simulation.ask() == "rule"  # between episodes nobody would be asked anyway
        env.reset()
        with pytest.raises(WrongThreadError, match=REFUSED):
            env.step(1)
        assert env.simulation.log == [1, "refused"]
    env.close()
    env.simulation.pool.shutdown()


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


def process(code):
    """Run code in a process of its own, with warnings as errors; one that hangs is ended."""
    preamble = """
        import os, sys, threading
        from simenv_marl import aec_env, single_env
        from simenv_marl.errors import WrongThreadError
        from tests.worlds.models import calling, decision, script
        decide = decision()
    """
    # Python warns of forks where there are other threads; here there are, and that is what is tested.
    command = [sys.executable, "-W", "error", "-W", "ignore:This process:DeprecationWarning", "-c"]
    return subprocess.run(
        [*command, dedent(preamble) + dedent(code)], capture_output=True, text=True, check=False, timeout=60
    )


def run(code):
    """Run code that ends well in a process of its own; return what it has printed."""
    result = process(code)
    assert (result.returncode, result.stderr) == (0, ""), result.stdout + result.stderr
    return result.stdout


@needs_fork
def test_a_process_that_is_forked_in_mid_episode_has_to_reset_with_threads():
    said = run("""
        env = single_env(calling(decide, decide), decide, driver="thread")
        inside, go_on = threading.Event(), threading.Event()
        def main(simulation):
            decide()
            inside.set()
            assert go_on.wait(10)
        other = single_env(script(main), decide, driver="thread")
        other.reset()
        moving = threading.Thread(target=other.step, args=(1,))
        moving.start()
        inside.wait(10)
        env.reset()
        env.step(1)
        child = os.fork()
        if child == 0:
            for _ in range(2):
                try:
                    env.step(2)
                except WrongThreadError as error:
                    assert "reset()" in str(error)
            env.reset()
            env.step(4)
            assert env.step(5)[2]
            print("child", env.simulation.log, flush=True)
            other.reset()  # in the child nobody moves it
            other.close()
            os._exit(0)
        assert os.waitpid(child, 0)[1] == 0
        go_on.set()
        moving.join()
        env.step(3)
        print("parent", env.simulation.log)
    """)
    assert said == "child [4, 5]\nparent [1, 3]\n"


@needs_fork
def test_uncaught_errors_of_a_forked_model_in_a_thread_are_printed():
    said = run("""
        def main(simulation):
            decide()
            child = os.fork()
            os.waitpid(child, 0) if child else os.dup2(1, 2)
            decide()
        env = single_env(script(main), decide, driver="thread")
        env.reset()
        env.step(1)
        env.close()
    """)
    assert "WrongThreadError" in said
    assert "forked" in said


@DRIVERS
@pytest.mark.parametrize("where", ["suspended", "closed", "inside", "in a thread", "in daemons", "moving"])
def test_a_process_ends_cleanly_with_environments_in_mid_episode(driver, where):
    said = run(f"""
        where = {where!r}
        ready, never = threading.Event(), threading.Event()
        def inner(simulation):
            try:
                decide()
            finally:
                print("unwound", flush=True)
        def main(simulation):
            try:
                if where == "inside":
                    simulation.inner = single_env(script(inner), decide, driver={driver!r})
                    simulation.inner.reset()
                decide()
                ready.set()
                never.wait()
            finally:
                print("unwound", flush=True)
        envs = [view(script(main), decide, driver={driver!r}) for view in (single_env, aec_env)]
        def use():
            for env in envs:
                env.reset()
                if where == "closed":
                    env.close()
            if where == "moving":
                env.step(1)
            if where == "in daemons":
                ready.set()
                never.wait()
        user = threading.Thread(target=use, daemon=where != "in a thread")
        if where in ("suspended", "closed", "inside"):
            use()
        else:
            user.start()
            user.join() if where == "in a thread" else ready.wait()
    """)
    # What is moving when the process ends, or was on a greenlet of another thread, is not unwound.
    if where in ("in a thread", "in daemons", "moving") and driver == "greenlet":
        assert said == ""
    else:
        assert said == "unwound\n" * {"inside": 4, "moving": 1}.get(where, 2)


@DRIVERS
def test_a_model_may_end_the_process(driver):
    code = f"""
        def main(simulation):
            decide()
            END
        env = aec_env(script(main), decide, driver={driver!r})
        env.reset()
        env.step(1)
        print("went on")
    """
    assert process(code.replace("END", "sys.exit(3)")).returncode == 3
    assert process(code.replace("END", "os._exit(4)")).returncode == 4
    said = process(code.replace("END", "raise KeyboardInterrupt"))
    assert "KeyboardInterrupt" in said.stderr
    assert "went on" not in said.stdout


def test_starting_threads_is_watched_only_while_there_are_simulations():
    said = run("""
        original = threading.Thread.start
        env = single_env(calling(decide), decide)
        print(threading.Thread.start is original)
        del env
        print(threading.Thread.start is original)
    """)
    assert said == "False\nTrue\n"
