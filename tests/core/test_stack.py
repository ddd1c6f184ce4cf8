"""Section 5.0 of the contract: a simulation has one stack of its own, kept over its episodes."""

import asyncio
import contextvars
import gc
import subprocess
import sys
import threading
import weakref
from contextlib import suppress
from textwrap import dedent

import greenlet
import pytest

from simenv_marl import RULE, aec_env, single_env
from simenv_marl.hooks.stacks import EVALUATING, STACKS
from tests.core.test_threads import in_a_thread
from tests.worlds.models import Script, decision, script, stacks, unwinding

DRIVERS = pytest.mark.parametrize("driver", ["greenlet", "thread"])


@pytest.fixture(autouse=True)
def _no_stack_stays_behind():
    gc.collect()
    before = set(STACKS)
    yield
    gc.collect()
    gc.collect()
    assert set(STACKS) <= before
    assert EVALUATING == {}


# -- what belongs where reset has made it -----------------------------------------------------------


class Engine(Script):
    """Makes a greenlet in ``reset`` to which ``run`` switches, as discrete-event engines do."""

    def __init__(self, decide, picks=1):
        super().__init__(None)
        self.decide, self.picks = decide, picks

    def reset(self, seed=None):
        super().reset(seed)
        self.worker = greenlet.greenlet(self.work)

    def work(self):
        for _ in range(self.picks):
            self.log.append(self.decide())

    def run(self):
        self.worker.switch()
        self.log.append("after")


@DRIVERS
def test_a_greenlet_that_was_made_in_reset_decides_in_run(driver):
    decide = decision()
    env = single_env(lambda: Engine(decide, picks=3), decide, driver=driver)
    for _ in range(2):
        env.reset()
        assert [env.step(action)[2] for action in (1, 2, RULE)] == [False, False, True]
        assert env.simulation.log == [1, 2, "rule", "after"]
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

    async def use(env):
        env.reset()
        await asyncio.sleep(0)
        env.step(1)
        assert asyncio.get_running_loop().is_running()
        return env.step(2)[2]

    decide = decision()
    env = single_env(Office, decide, driver=driver)
    assert asyncio.run(use(env))
    assert env.simulation.log == [1, 2, "done"]
    env.reset()
    env.step(3)
    assert env.step(4)[2]
    assert env.simulation.log == [3, 4, "done"]
    env.close()


@DRIVERS
def test_everything_of_a_simulation_runs_on_one_stack(driver):
    seen = []

    class Watching(Script):
        def __init__(self):
            super().__init__(None)
            seen.append((greenlet.getcurrent(), threading.get_ident()))

        def reset(self, seed=None):
            super().reset(seed)
            seen.append((greenlet.getcurrent(), threading.get_ident()))

        def run(self):
            decide()
            seen.append((greenlet.getcurrent(), threading.get_ident()))

    decide = decision()
    env = aec_env(Watching, decide, driver=driver)
    for _ in range(3):
        env.reset()
        env.step(1)
        env.reset()
    assert len(set(seen)) == 1
    assert greenlet.getcurrent() is not seen[0][0]
    env.close()
    seen.clear()
    env.reset()  # closed, it has ended
    env.step(1)
    assert len(set(seen)) == 1
    env.close()
    seen.clear()


@DRIVERS
def test_reset_and_run_of_an_episode_share_a_context_that_is_its_own(driver):
    variable = contextvars.ContextVar("variable", default="nobody's")

    class Model(Script):
        def __init__(self):
            super().__init__(None)

        def reset(self, seed=None):
            super().reset(seed)
            self.log.append(variable.get())
            variable.set("the model's")

        def run(self):
            self.log.append(variable.get())
            decide()
            self.log.append(variable.get())

    decide = decision()
    env = single_env(Model, decide, driver=driver)
    for user in ("one", "two"):
        token = variable.set(user)
        env.reset()
        assert variable.get() == user
        env.step(1)
        assert env.simulation.log == [user, "the model's", "the model's"]
        variable.reset(token)
    env.close()


# -- threads ----------------------------------------------------------------------------------------


@DRIVERS
@pytest.mark.parametrize("when", ["between", "amid", "never reset"])
@pytest.mark.parametrize("where", ["here", "elsewhere"])
def test_an_environment_that_is_dropped_takes_its_stack_along(driver, when, where):
    gc.collect()
    before, log, decide = stacks(len(STACKS) + 1, looks=20), [], decision()
    held = [single_env(unwinding(decide, log), decide, driver=driver)]
    simulation = weakref.ref(held[0].simulation)
    if when != "never reset":
        held[0].reset()
    if when == "between":
        held[0].step(1)
    if where == "here":
        held.clear()
    else:
        in_a_thread(held.clear)
    greenlet.greenlet(lambda: None).switch()  # a stack of another thread unwinds when something switches
    assert log == ([] if when == "never reset" else ["unwound"])
    gc.collect()
    assert simulation() is None
    assert stacks(before) == before


@DRIVERS
def test_what_an_episode_returns_or_raises_is_not_kept(driver):
    class Witness:
        pass

    class RaisedError(Exception):
        pass

    references = []

    def main(simulation):
        decide()
        witness = Witness()
        references.append(weakref.ref(witness))
        if simulation.episodes == 2:
            raise RaisedError(witness)
        return witness

    decide = decision()
    env = single_env(script(main), decide, driver=driver)
    gc.disable()
    try:
        env.reset()
        env.step(1)
        assert references[-1]() is None
        env.reset()
        with suppress(RaisedError):
            env.step(1)
        assert len(references) == 2
        assert references[-1]() is None
    finally:
        gc.enable()
    env.close()


def test_starting_threads_is_watched_only_while_there_are_simulations():
    said = subprocess.run(  # where other tests have left no environment
        [
            sys.executable,
            "-c",
            dedent("""
            import threading
            from simenv_marl import single_env
            from tests.worlds.models import calling, decision
            original, watched = threading.Thread.start, []
            decide = decision()
            env = single_env(calling(decide), decide)
            watched.append(threading.Thread.start is not original)
            other = single_env(calling(decide), decide)
            env.close()
            watched.append(threading.Thread.start is not original)
            del other
            watched.append(threading.Thread.start is not original)
            print(watched)
            """),
        ],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert said.stdout == "[True, True, False]\n"
