"""Section 5.0 of the contract: a simulation has one stack of its own, kept over its episodes."""

import asyncio
import contextvars
import gc
import sqlite3
import subprocess
import sys
import threading
import weakref
from contextlib import suppress
from textwrap import dedent

import greenlet
import pytest

from simenv_marl import RULE, aec_env, generate_env, parallel_env, single_env
from simenv_marl.errors import WrongThreadError
from simenv_marl.hooks.stacks import EVALUATING, STACKS
from tests.core.test_threads import in_a_thread
from tests.worlds.models import Script, calling, decision, script, stacks, unwinding

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


def test_the_script_of_its_user_goes_on():
    code = """
        import greenlet
        from simenv_marl import single_env
        from tests.worlds.models import define
        class Simulation:
            def reset(self): self.worker = greenlet.greenlet(lambda: self.pick())
            def run(self): self.worker.switch()
            @define()
            def pick(self): return 0
        env = single_env(Simulation, Simulation.pick)
        env.reset()
        print(env.step(1)[2])
    """
    result = subprocess.run([sys.executable, "-c", dedent(code)], capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout, result.stderr) == (0, "True\n", "")


@DRIVERS
@pytest.mark.filterwarnings("ignore:unclosed database", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_connection_that_was_opened_in_reset_is_used_in_run_and_over_episodes(driver):
    class Books(Script):
        def __init__(self):
            super().__init__(None)
            self.archive = sqlite3.connect(":memory:")
            self.archive.execute("create table seeds (seed integer)")

        def reset(self, seed=None):
            super().reset(seed)
            self.books = sqlite3.connect(":memory:")
            self.books.execute("create table sold (number integer)")
            self.archive.execute("insert into seeds values (?)", (seed,))

        def run(self):
            for _ in range(2):
                self.books.execute("insert into sold values (?)", (decide(),))
            self.log += self.books.execute("select number from sold").fetchall()
            self.log += self.archive.execute("select seed from seeds").fetchall()

    decide = decision()
    env = single_env(Books, decide, driver=driver)
    for number in range(1, 4):
        env.reset(seed=number)
        env.step(4)
        assert env.step(5)[2]
        assert env.simulation.log == [(4,), (5,), *[(seed,) for seed in range(1, number + 1)]]
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


# -- nothing decides but run ------------------------------------------------------------------------


@DRIVERS
def test_decisions_run_their_rule_while_a_simulation_is_made_and_reset(driver):
    class Model(Script):
        def __init__(self):
            super().__init__(None)
            self.first = decide()

        def reset(self, seed=None):
            super().reset(seed)
            self.log.append(decide())

        def run(self):
            self.log.append(decide())

    decide = decision()
    for source in (Model, lambda: Model()):
        env = single_env(source, decide, driver=driver)
        for _ in range(2):
            env.reset()
            env.step(3)
            assert (env.simulation.first, env.simulation.log) == ("rule", ["rule", 3])
        env.close()


def test_a_factory_is_called_once_for_each_environment():
    made = []

    def factory():
        made.append(greenlet.getcurrent())
        return calling(decide)()

    decide = decision()
    env = single_env(factory, decide)
    env.reset()
    env.reset()
    assert len(made) == 1
    other = generate_env(factory, decide)
    assert len(made) == 2  # looked at
    env_class = [other(), other()]
    assert len(made) == 3
    for each in env_class:
        each.reset()
        each.step(1)
        each.close()
    env.close()
    made.clear()


# -- threads ----------------------------------------------------------------------------------------


def test_between_episodes_an_environment_may_change_threads():
    decide = decision()
    env = single_env(calling(decide, decide), decide)
    simulation = env.simulation

    def episode():
        env.reset()
        env.step(1)
        assert env.step(2)[2]

    for _ in range(3):
        in_a_thread(episode)
        episode()
    assert env.simulation is simulation
    assert simulation.episodes == 6
    env.reset()
    with pytest.raises(WrongThreadError):
        in_a_thread(env.step, 1)
    env.step(1)
    env.close()


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
@pytest.mark.parametrize("view", [single_env, aec_env, parallel_env])
def test_a_thousand_episodes_leave_nothing_behind(driver, view):
    def main(simulation):
        decide()
        if simulation.episodes % 3 == 0:
            raise ZeroDivisionError
        decide()

    decide = decision()
    env = view(script(main), decide, driver=driver)
    action = {"choose_0": 1} if view is parallel_env else 1
    env.reset()
    before, threads = stacks(), threading.active_count()
    for number in range(1000):
        env.reset()
        if number % 4:
            with suppress(ZeroDivisionError):
                env.step(action)
    env.reset()
    assert (stacks(), threading.active_count()) == (before, threads)
    env.close()
    if driver == "greenlet":
        before -= 1
    else:
        threads -= 1
    assert (stacks(before), threading.active_count()) == (before, threads)


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


def test_a_stack_that_was_given_up_is_replaced_with_a_fresh_simulation():
    stop = []

    def main(simulation):
        while not stop:
            with suppress(BaseException):
                simulation.log.append(decide())

    decide = decision()
    env = single_env(script(main), decide)
    env.reset()
    env.step(1)
    first = env.simulation
    with pytest.warns(ResourceWarning, match="refuses to end"):
        env.reset()
    assert env.simulation is not first
    env.step(2)
    assert (first.log, env.simulation.log) == ([1], [2])
    stop.append(True)
    assert env.step(3)[2]
    env.close()


# -- what belongs to a simulation -------------------------------------------------------------------


class Hub:
    """Runs greenlets of others, as gevent's does: it is their parent, whoever has spawned them."""

    def __init__(self):
        self.waiting = []

    def spawn(self, function):
        spawned = Spawned(function, greenlet.getcurrent())
        spawned.parent = self.greenlet
        self.waiting.append(spawned)
        return spawned

    def loop(self):
        while self.waiting:
            self.waiting.pop(0).switch()


class Spawned(greenlet.greenlet):
    def __init__(self, function, spawner):
        super().__init__(function)
        self.spawning_greenlet = weakref.ref(spawner)


def test_a_model_that_waits_in_a_hub_leaves_other_greenlets_of_its_user_alone():
    hub, said = Hub(), []
    hub.greenlet = greenlet.greenlet(hub.loop)

    def main(simulation):
        decide()
        here = greenlet.getcurrent()
        hub.waiting.append(here)
        hub.greenlet.switch()  # until the hub comes back to it
        simulation.log.append(decide())

    decide = decision()
    env = single_env(script(main), decide)
    env.reset()
    hub.spawn(lambda: said.append(decide()))  # the user's own
    env.step(1)
    assert said == ["rule"]
    env.step(2)
    assert env.simulation.log == [2]
    env.close()


def test_what_a_model_spawns_on_a_hub_of_others_is_refused():
    hub, said = Hub(), []
    hub.greenlet = greenlet.greenlet(hub.loop)

    def work():
        try:
            said.append(decide())
        except WrongThreadError as error:
            said.append(str(error))

    def main(simulation):
        decide()
        hub.spawn(work)
        hub.waiting.append(greenlet.getcurrent())
        hub.greenlet.switch()
        decide()

    decide = decision()
    env = single_env(script(main), decide)
    env.reset()
    with pytest.raises(WrongThreadError, match="spawned with gevent"):
        env.step(1)
    assert "spawned with gevent" in said[0]
    env.reset()
    env.close()


@pytest.mark.skipif(sys.platform != "linux", reason="the platform does not fork")
@DRIVERS
def test_a_worker_that_a_model_has_forked_is_refused(driver):
    code = f"""
        import multiprocessing, warnings
        warnings.simplefilter("ignore", DeprecationWarning)
        from simenv_marl import single_env
        from simenv_marl.errors import WrongThreadError
        from tests.worlds.models import decision, script
        decide = decision()
        def work(queue):
            try:
                queue.put(("decided", decide()))
            except WrongThreadError as error:
                queue.put(("refused", "forked" in str(error)))
        def main(simulation):
            simulation.log.append(decide())
            context = multiprocessing.get_context("fork")
            queue = context.SimpleQueue()
            worker = context.Process(target=work, args=(queue,))
            worker.start()
            simulation.log.append(queue.get())
            worker.join()
            simulation.log.append(worker.exitcode)
            simulation.log.append(decide())
        env = single_env(script(main), decide, driver={driver!r})
        env.reset()
        env.step(1)
        assert env.step(2)[2]
        print(env.simulation.log)
        env.close()
    """
    result = subprocess.run([sys.executable, "-c", dedent(code)], capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout) == (0, "[1, ('refused', True), 0, 2]\n"), result.stderr


# -- use from inside --------------------------------------------------------------------------------


@DRIVERS
@pytest.mark.parametrize("inside", ["greenlet", "thread"])
def test_mappings_of_an_environment_that_is_used_inside_another_are_not_the_others(driver, inside):
    seen = []

    def spy(*args):
        seen.append(point())
        return [0, 0]

    point = decision(agent="point_0")
    inner = decision(
        agent="inner_0",
        observation_space_mapping=spy,
        reward_mapping=lambda: spy() and 0.0,
        action_space_mapping=lambda action: spy() and action,
    )

    def main(simulation):
        env = single_env(calling(inner, inner), inner, driver=inside)
        env.reset()
        env.step(1)
        simulation.log.append(point())
        env.step(2)
        simulation.log.append(list(env.simulation.log))
        env.close()
        simulation.log.append(point())

    env = single_env(script(main), point, driver=driver)
    env.reset()
    env.step(3)
    assert env.step(4)[2]
    assert env.simulation.log == [3, [1, 2], 4]
    assert set(seen) == {"rule"}
    env.close()
