"""What no driver may do differently: stacks, nesting, threads that models start, forks, ends of the process."""

import asyncio
import contextvars
import gc
import os
import signal
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from textwrap import dedent

import greenlet
import pytest

from simenv_marl import RULE, aec_env, single_env
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
@pytest.mark.parametrize("view", [aec_env, single_env])
def test_everything_of_a_simulation_runs_on_one_stack_and_in_its_context(driver, view):
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
    env = view(Engine, decide, driver=driver)
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


@DRIVERS
def test_an_event_loop_is_the_simulations_own_while_that_is_unwound(driver):
    async def work(simulation):
        try:
            decide()
        finally:
            simulation.log.append(asyncio.get_running_loop() is not here)
            await asyncio.sleep(0)
            simulation.log.append("unwound")

    async def use(env):
        nonlocal here
        here = asyncio.get_running_loop()
        env.reset()
        env.close()
        return asyncio.get_running_loop()

    decide, here = decision(), None
    env = single_env(script(lambda simulation: asyncio.run(work(simulation))), decide, driver=driver)
    assert asyncio.run(use(env)) is here
    assert env.simulation.log == [True, "unwound"]


@DRIVERS
def test_an_event_loop_that_was_made_in_reset_is_used_in_run(driver):
    class Office(Script):
        def __init__(self):
            super().__init__(None)

        def reset(self, seed=None):
            super().reset(seed)
            self.loop = asyncio.new_event_loop()
            self.done = self.loop.create_future()

        async def work(self):
            self.loop.call_soon(self.done.set_result, "done")
            for _ in range(2):
                await asyncio.sleep(0)
                self.log.append(decide())
            return await self.done

        def run(self):
            try:
                self.log.append(self.loop.run_until_complete(self.work()))
            finally:
                self.loop.close()

    async def use():
        env.reset()
        await asyncio.sleep(0)
        env.step(1)
        assert asyncio.get_running_loop().is_running()
        return env.step(2)[2]

    decide = decision()
    env = single_env(Office, decide, driver=driver)
    for _ in range(2):
        assert asyncio.run(use())
        assert env.simulation.log == [1, 2, "done"]
    env.reset()
    env.step(1)
    assert env.step(2)[2]
    env.close()


# -- several at once ------------------------------------------------------------------------------


@DRIVERS
@pytest.mark.parametrize("inside", ["greenlet", "thread"])
def test_environments_run_inside_each_others_simulations(driver, inside):
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
def test_a_refusal_is_raised_once_or_told_of_by_another_error(driver):
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
@pytest.mark.parametrize("when", ["made", "reset", "episode before"])
def test_threads_that_are_older_than_the_episode_are_refused_too(driver, when):
    class Hiring(Script):
        pool = None

        def __init__(self):
            super().__init__(main)
            if when == "made":
                self.hire()

        def reset(self):
            super().reset()
            if when == "reset":
                self.hire()
                self.log.append(self.ask())

        def hire(self):
            self.pool = ThreadPoolExecutor(1)
            self.pool.submit(int).result()  # now its thread is there

        def ask(self):
            return self.pool.submit(refused_or, decide).result()

    def main(simulation):
        simulation.log.append(decide())
        if simulation.pool is None:
            simulation.hire()
            return
        simulation.log.append(simulation.ask())
        decide()

    decide = decision()
    env = single_env(Hiring, decide, driver=driver)
    env.reset()
    if when == "episode before":
        assert env.step(1)[2]
        assert env.simulation.ask() == "rule"  # between episodes nobody would be asked anyway
        env.reset()
    with pytest.raises(WrongThreadError, match=REFUSED):
        env.step(1)
    assert env.simulation.log == [*(["rule"] if when == "reset" else []), 1, "refused"]
    env.close()
    assert env.simulation.ask() == "rule"
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
        import os, random, signal, sys, threading, time
        from contextlib import suppress
        from simenv_marl import aec_env, parallel_env, single_env
        from simenv_marl.errors import WrongThreadError
        from tests.worlds.models import calling, decision, script
        decide = decision()
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
    return subprocess.run(
        [*command, dedent(preamble) + dedent(code)], capture_output=True, text=True, check=False, timeout=60
    )


def run(code):
    """Run code that ends well in a process of its own; return what it has printed."""
    result = process(code)
    assert (result.returncode, result.stderr) == (0, ""), result.stdout + result.stderr
    return result.stdout


@needs_fork
def test_a_process_that_is_forked_in_mid_episode_goes_on_twice_with_greenlets():
    said = run("""
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
                    with suppress(ZeroDivisionError):
                        env.step(1)
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


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="this platform has no timers that signal")
@DRIVERS
def test_signals_at_any_time_never_spoil_an_environment(driver):
    result = process(f"""
        class Alarm(BaseException):
            pass
        def ring(*_):
            raise Alarm
        signal.signal(signal.SIGALRM, ring)
        def main(simulation):
            for _ in range(5):
                simulation.log.append(decide())
        draw, rung = random.Random(3), 0
        envs = [view(script(main), decide, driver={driver!r}) for view in (aec_env, single_env, parallel_env)]
        def use(env):
            env.reset()
            for _ in range(5):
                env.step(dict(choose_0=2) if env is envs[2] else 2)
        for env in envs:
            use(env)
        begun = time.perf_counter()
        for env in envs:
            use(env)
        usual = (time.perf_counter() - begun) / 3
        for number in range(6000):
            if number > 600 and rung > 20:
                break
            env = envs[number % 3]
            try:
                signal.setitimer(signal.ITIMER_REAL, draw.uniform(0.1, 1.5) * min(usual, 0.0005))
                try:
                    use(env)
                finally:
                    signal.setitimer(signal.ITIMER_REAL, 0)
            except Alarm:
                rung += 1
            except RuntimeError as error:  # Python itself starts threads with a lock that gives way to signals
                assert isinstance(error.__context__, Alarm)
            use(env)
            assert env.unwrapped.simulation.log == [2] * 5
        for env in envs:
            env.close()
        assert sum(thread.is_alive() for thread in threading.enumerate()) == 1
        print(rung > 20)
    """)
    # Whether an alarm rang in the midst of Python's own cleaning up is printed, but of no consequence.
    assert (result.returncode, result.stdout) == (0, "True\n"), result.stderr


def test_starting_threads_is_watched_only_while_there_are_simulations():
    said = run("""
        def is_watched():
            return threading.Thread.start is not original
        original, watched = threading.Thread.start, []
        env = single_env(calling(decide), decide)
        watched.append(is_watched())
        other = single_env(calling(decide), decide)
        env.close()
        watched.append(is_watched())
        del other
        watched.append(is_watched())
        print(watched)
    """)
    assert said == "[True, True, False]\n"
