"""All drivers agree on stacks, nesting, threads of models, forks and ends of the process."""

import asyncio
import contextvars
import gc
import os
import threading
import weakref
from concurrent import futures
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial

import greenlet
import pytest

from simenv_marl import RULE, single_env
from simenv_marl.errors import WrongThreadError
from simenv_marl.hooks.stacks import EVALUATING, STACKS
from tests.core.test_threads import in_a_thread
from tests.processes import run_code
from tests.worlds.models import (
    BY_DRIVER,
    EVERY_DRIVER,
    Script,
    begun,
    calling,
    culprits,
    decision,
    nobody_is_asked,
    notes,
    script,
)

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


@EVERY_DRIVER
def test_simulation_runs_on_one_stack_with_one_set_of_context_variables():
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
    env = single_env(Engine, decide)
    for user in ("one", "two", "after it was closed"):
        token = variable.set(user)
        for _ in range(2):
            env.reset()
            assert variable.get() == user
            for action in (1, 2, RULE):
                env.step(action)
            assert env.simulation.log == [
                user,
                "the model's",
                1,
                2,
                "rule",
                "the model's",
            ]
        if user == "two":
            env.reset()
            assert len(set(seen)) == 1
            assert greenlet.getcurrent() is not seen[0][0]
            env.close()
            seen.clear()
        variable.reset(token)
    assert len(set(seen)) == 1
    env.close()


# -- threads --------------------------------------------------------------------------------------


@EVERY_DRIVER
@pytest.mark.parametrize("inner", ["greenlet", "thread"])
def test_other_threads_can_use_models_and_envs_while_an_env_steps(inner):
    decide, other = decision(), decision(lambda: "its rule")
    deeper = decision(agent="inner_0", reward_mapping=lambda: decide() == "rule")

    def use():
        env = begun(single_env(calling(deeper, deeper), deeper, driver=inner))
        return [env.step(1)[1:3], env.step(2)[1:3], env.simulation.log]

    with ThreadPoolExecutor(1) as pool:
        pool.submit(int).result()  # now its thread is there, which is none of the simulation's
        functions = [
            lambda: pool.submit(decide).result(),
            lambda: in_a_thread(other),  # which is no point of the environment
            lambda: in_a_thread(use),
        ]
        env = begun(single_env(calling(decide, *functions, decide), decide))
        env.step(1)
        env.step(2)
    assert env.simulation.log == [1, "rule", "its rule", [(1.0, False), (1.0, True), [1, 2]], 2]


def by_pool(function):
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(function).result()


WAYS = {
    "thread": in_a_thread,
    "grandchild": lambda function: in_a_thread(lambda: in_a_thread(function)),
    "pool": by_pool,
    "asyncio": lambda function: asyncio.run(asyncio.to_thread(function)),
}


@EVERY_DRIVER
@pytest.mark.parametrize("last", [False, True])
@pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)
def test_env_step_raises_an_error_if_a_models_thread_decides(way, last):
    def work():
        roots.append(weakref.ref(greenlet.getcurrent()))
        decide()

    def main(simulation):
        simulation.log.append(decide())
        with suppress(WrongThreadError):
            simulation.log.append(way(work))
        simulation.log.append("refused")
        if not last:
            simulation.log.append(decide())

    roots, decide = [], decision()
    env = begun(single_env(script(main), decide), 5)
    with pytest.raises(WrongThreadError, match=REFUSED) as caught:
        env.step(1)
    assert env.simulation.log == [1, "refused"]
    assert "after decision 1, of 'choose_0'" in notes(caught.value)
    assert "refuse" in culprits(caught.value.__cause__)  # which leads to the thread
    env.reset()
    env.close()
    # Else greenlet frees that root too early, if the collector runs while the thread ends, and the
    # process crashes.
    (root,) = roots
    assert root() is None or not gc.get_referrers(root())


@EVERY_DRIVER
def test_wrong_thread_error_is_raised_once_or_noted_on_the_models_error():
    def passed_on():
        return by_pool(decide)

    def followed_by_another():
        with suppress(WrongThreadError):
            by_pool(decide)
        raise KeyError("nobody has put it there")

    decide = decision()
    for function, kind in ((passed_on, WrongThreadError), (followed_by_another, KeyError)):
        env = begun(single_env(calling(decide, function), decide))
        with pytest.raises(kind) as caught:
            env.step(1)
        env.close()
        assert function.__name__ in culprits(caught.value)
        if kind is KeyError:
            assert "a decision was refused" in notes(caught.value)
        else:
            assert REFUSED in str(caught.value)
            assert len(caught.value.__notes__) == 1


class InTurn(futures.Executor):
    """Runs each call when it is submitted, in place of a ``ThreadPoolExecutor``."""

    def submit(self, function, /, *args, **kwargs):
        future = futures.Future()
        try:
            future.set_result(function(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


@EVERY_DRIVER
def test_model_with_a_thread_pool_can_use_a_sequential_executor_instead(monkeypatch):
    def main(simulation):
        with futures.ThreadPoolExecutor() as pool:
            simulation.log += pool.map(lambda number: (number, decide()), range(3))

    decide = decision()
    env = single_env(script(main), decide)
    with pytest.raises(WrongThreadError, match="as executors that run in turn do"):
        env.reset()
    monkeypatch.setattr(futures, "ThreadPoolExecutor", InTurn)
    env.reset()
    for action in (4, 5, 6):
        env.step(action)
    assert env.simulation.log == [(0, 4), (1, 5), (2, 6)]
    env.close()
    env.reset()
    env.close()


@EVERY_DRIVER
@pytest.mark.parametrize("how", ["run", "step", "close", "reset"])
def test_decision_in_a_thread_older_than_the_episode_is_refused(how):
    class Hiring(Script):
        def __init__(self):
            super().__init__(main)
            self.pool = ThreadPoolExecutor(1)
            self.pool.submit(int).result()  # now its thread is there

        def ask(self):
            with suppress(WrongThreadError):
                return self.pool.submit(decide).result()
            return "refused"

    def main(simulation):
        simulation.log.append(decide())
        if how == "run":
            simulation.log.append(simulation.ask())
        decide()

    decide = decision()
    env = single_env(Hiring, decide)
    for _ in range(1 if how == "close" else 2):  # after a close the threads are those of nobody
        assert env.simulation.ask() == "rule"  # between episodes nobody would be asked anyway
        env.reset()
        if how != "run":
            assert env.simulation.ask() == "refused"
        with pytest.raises(WrongThreadError, match=REFUSED):
            getattr(env, how)() if how in ("close", "reset") else env.step(1)
        assert how != "run" or env.simulation.log == [1, "refused"]
    env.close()
    env.simulation.pool.shutdown()


# -- forks and ends of the process ----------------------------------------------------------------

needs_fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="the platform has no fork")


PREAMBLE = """
    import os, sys, threading
    from simenv_marl import aec_env, single_env
    from simenv_marl.errors import WrongThreadError
    from tests.worlds.models import calling, decision, script
    decide = decision()
"""
# Python warns of forks where there are other threads; here there are, and that is what is tested.
run = partial(
    run_code, PREAMBLE, options=["-W", "error", "-W", "ignore:This process:DeprecationWarning"]
)


@needs_fork
def test_forked_process_must_reset_a_thread_driver_env():
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
def test_forked_process_of_a_model_in_a_thread_prints_uncaught_errors():
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


@pytest.mark.thorough
@BY_DRIVER
@pytest.mark.parametrize(
    "where", ["suspended", "closed", "inside", "in a thread", "in daemons", "moving"]
)
def test_python_exits_cleanly_with_envs_in_mid_episode(driver, where):
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


@BY_DRIVER
@pytest.mark.parametrize(("end", "status"), [("sys.exit(3)", 3), ("os._exit(4)", 4)])
def test_model_can_end_the_python_process(driver, end, status):
    said = run(
        f"""
        def main(simulation):
            decide()
            {end}
        env = aec_env(script(main), decide, driver={driver!r})
        env.reset()
        env.step(1)
        print("went on")
        """,
        status=status,
    )
    assert said == ""


def test_thread_start_is_patched_only_while_environments_exist():
    said = run("""
        original = threading.Thread.start
        env = single_env(calling(decide), decide)
        print(threading.Thread.start is original)
        del env
        print(threading.Thread.start is original)
    """)
    assert said == "False\nTrue\n"
