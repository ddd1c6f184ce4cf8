"""The settings of an event loop are the model's while it runs, and the user's between steps."""

import asyncio
import gc
import logging
import signal
import sys
from functools import partial

import pytest

from simenv_marl import SimulationInterface, single_env
from simenv_marl.errors import SimulationError
from tests.worlds.models import BY_DRIVER, EVERY_DRIVER, begun, decision, script


def around():
    """What event loops set for a whole thread."""
    return (
        asyncio._get_running_loop(),
        sys.get_asyncgen_hooks(),
        sys.get_coroutine_origin_tracking_depth(),
    )


@pytest.fixture(autouse=True)
def _nothing_stays_behind():
    before, interrupt = around(), signal.getsignal(signal.SIGINT)
    yield
    stayed, handler = around(), signal.getsignal(signal.SIGINT)
    asyncio._set_running_loop(before[0])  # a failed test is no reason for others to fail
    sys.set_asyncgen_hooks(*before[1])
    sys.set_coroutine_origin_tracking_depth(before[2])
    signal.signal(signal.SIGINT, interrupt)
    assert stayed == before
    assert handler is interrupt


@pytest.fixture
def loud(caplog):
    """Whatever asyncio logs, be it only when something is collected."""
    with caplog.at_level(logging.DEBUG, logger="asyncio"):
        yield caplog


def told(caplog):
    gc.collect()
    return [
        record.getMessage().partition("\n")[0]
        for record in caplog.records
        if record.levelno > logging.DEBUG
    ]


# -- what is set for the thread -------------------------------------------------------------------


def tracking(decide):
    """A model that notes the settings around it, before and after each decision within a loop."""

    async def work(simulation):
        simulation.log.append(around())
        for _ in range(3):
            decide()
            simulation.log.append(around())

    def main(simulation):
        decide()
        simulation.log.append(around())
        asyncio.run(work(simulation), debug=True)
        simulation.log.append(around())
        decide()

    return script(main)


def check_tracked(env, outside):
    """The model's surroundings were its loop's throughout, and before and after it none."""
    before, *within, after = env.simulation.log
    assert before == after == outside
    assert len({str(seen) for seen in within}) == 1
    loop, hooks, depth = within[0]
    assert loop is not None
    assert hooks.firstiter.__self__ is hooks.finalizer.__self__ is loop
    assert depth > 0


NOTHING = (None, (None, None), 0)


@BY_DRIVER
def test_env_of_an_asyncio_model_keeps_the_users_async_generator_hooks(driver):
    def hook(generator):
        """What takes note of asynchronous generators."""

    decide = decision()
    env = single_env(tracking(decide), decide, driver=driver)
    sys.set_asyncgen_hooks(hook, hook)
    sys.set_coroutine_origin_tracking_depth(3)
    try:
        mine = around()
        env.reset()
        seen = [around()]
        while not env.step(1)[2]:
            seen.append(around())
        assert {*seen, around()} == {mine}
        check_tracked(env, mine if driver == "greenlet" else NOTHING)
    finally:
        sys.set_asyncgen_hooks(None, None)
        sys.set_coroutine_origin_tracking_depth(0)


@EVERY_DRIVER
@pytest.mark.parametrize("inside", [(), (1, 2, 3, 4, 5), (0, 1), (5,)])
def test_env_in_a_users_event_loop_keeps_its_async_generator_hooks(inside):
    """The reset and five steps are made inside a loop of the user's, or outside all."""

    async def act(move):
        mine = around()
        assert mine[1].firstiter.__self__ is mine[0]
        ended = move()
        assert around() == mine
        return ended

    def move():
        return env.step(1)[2]

    decide = decision()
    env = single_env(tracking(decide), decide)
    moves = [env.reset, *[move] * 5]
    for _ in range(2):
        for number, moved in enumerate(moves):
            ended = asyncio.run(act(moved)) if number in inside else moved()
            assert around() == NOTHING
        assert ended
        check_tracked(env, NOTHING)
    env.reset()
    asyncio.run(act(env.close))


# -- Ctrl-C ---------------------------------------------------------------------------------------


def deciding(driver, interrupted=False):
    """An environment of a model that decides four times, all but the first inside a loop."""

    async def work(simulation):
        try:
            for _ in range(3):
                simulation.log.append(decide())
                if interrupted:
                    signal.raise_signal(signal.SIGINT)
                    await asyncio.sleep(0)
        except asyncio.CancelledError:
            simulation.log.append("cancelled")
            raise

    def main(simulation):
        simulation.log.append(decide())
        asyncio.run(work(simulation))

    decide = decision()
    return begun(single_env(script(main), decide, driver=driver))


@BY_DRIVER
def test_keyboard_interrupt_between_steps_reaches_the_users_signal_handler(driver):
    caught = []

    def handler(number, frame):
        caught.append(number)

    env, before = deciding(driver), signal.getsignal(signal.SIGINT)
    for number in (0, 1):
        if driver == "thread":
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
        env.step(number)
    signal.signal(signal.SIGINT, handler)  # while the model has a loop, which has one of its own
    try:
        for number in (2, 3):
            signal.raise_signal(signal.SIGINT)
            assert env.step(number)[2] is (number == 3)
            assert signal.getsignal(signal.SIGINT) is handler
        assert len(caught) == 2
    finally:
        signal.signal(signal.SIGINT, before)
    assert env.simulation.log == [0, 1, 2, 3]


def test_keyboard_interrupt_in_an_asyncio_model_reaches_its_event_loop():
    env = deciding("greenlet", interrupted=True)
    env.step(1)
    with pytest.raises(KeyboardInterrupt):
        env.step(2)
    assert env.simulation.log == [1, 2, "cancelled"]


# -- unwinding ------------------------------------------------------------------------------------


def clerk_of(decide):
    async def clerk():
        await asyncio.sleep(0)
        for _ in range(2):
            decide()
            await asyncio.sleep(0)

    return clerk


async def grouped(clerk):
    async with asyncio.TaskGroup() as group:
        for _ in range(3):
            group.create_task(clerk())


async def gathered(clerk):
    await asyncio.gather(*[clerk() for _ in range(3)])


async def waited(clerk):
    await asyncio.wait([asyncio.create_task(asyncio.wait_for(clerk(), 100)) for _ in range(3)])


@EVERY_DRIVER
@pytest.mark.parametrize("way", [grouped, gathered, waited])
@pytest.mark.parametrize("steps", [0, 1])
@pytest.mark.parametrize("how", ["close", "reset", "collected"])
def test_env_close_reports_no_errors_of_unwound_asyncio_tasks(way, steps, how, loud):
    decide = decision()
    env = begun(single_env(script(lambda simulation: asyncio.run(way(clerk_of(decide)))), decide))
    for _ in range(steps):
        env.step(1)
    if how != "collected":
        getattr(env, how)()
        env.close()
    del env
    assert told(loud) == []


@EVERY_DRIVER
def test_env_close_reports_errors_of_asyncio_tasks_that_fail_on_their_own(loud):
    async def fail():
        raise ValueError

    async def clerk():
        keep = asyncio.create_task(fail())
        await asyncio.sleep(0)
        try:
            decide()
        finally:
            del keep

    decide = decision()
    env = begun(single_env(script(lambda simulation: asyncio.run(grouped(clerk))), decide))
    env.close()
    assert told(loud) == ["Task exception was never retrieved"]
    assert isinstance(loud.records[-1].exc_info[1], ValueError)


async def numbers(log, cleanup=lambda: None):
    try:
        while True:
            yield await asyncio.sleep(0)
    finally:
        cleanup()
        await asyncio.sleep(0)
        log.append("generator closed")


async def stay(log, cleanup):
    try:
        await asyncio.sleep(3600)
    finally:
        cleanup()
        await asyncio.sleep(0)
        log.append("task cancelled")


async def office(simulation, decide, cleanup):
    """Decide beside tasks and asynchronous generators, of which some decide in their clean-up."""

    def quietly():
        cleanup.append("decides")
        decide()

    generators = [numbers(simulation.log, *args) for args in [(), (quietly,), ()]]
    for generator in generators:
        await anext(generator)
    works = [lambda: None, quietly, lambda: None, quietly, lambda: None]
    tasks = [asyncio.create_task(stay(simulation.log, work)) for work in works]
    await asyncio.sleep(0)
    decide()
    await asyncio.wait(tasks)


@EVERY_DRIVER
@pytest.mark.parametrize("end", ["close", "reset"])
def test_asyncio_models_event_loop_cancels_its_tasks_at_the_end(end):
    decide, cleanup = decision(), []
    env = begun(
        single_env(
            script(lambda simulation: asyncio.run(office(simulation, decide, cleanup))),
            decide,
        )
    )
    log = env.simulation.log
    getattr(env, end)()
    assert sorted(log) == ["generator closed"] * 2 + ["task cancelled"] * 3
    assert len(cleanup) == 3
    env.close()
    gc.collect()


class Lasting(SimulationInterface):
    """Has a loop that outlives its episodes."""

    def __init__(self, work):
        self.work, self.handlers, self.loop = work, set(), asyncio.new_event_loop()

    def reset(self, seed=None):
        self.handlers.add(self.loop.get_exception_handler())

    def run(self):
        self.loop.run_until_complete(self.work())


@EVERY_DRIVER
def test_event_loop_that_a_model_keeps_over_episodes_is_patched_once(loud):
    decide, messages = decision(), []
    env = single_env(lambda: Lasting(clerk_of(decide)), decide)
    model = env.simulation
    model.loop.set_exception_handler(lambda loop, context: messages.append(context["message"]))
    for _ in range(10):
        env.reset()
        assert around() == NOTHING
    env.close()
    gc.collect()
    assert messages == []
    assert len(model.handlers) == 2
    model.loop.call_exception_handler({"message": "something else"})
    assert messages == ["something else"]
    model.loop.close()


# -- trio -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("driver", "number"), [("greenlet", 1), ("thread", 3)])
def test_trio_models_run_one_at_a_time_or_side_by_side_in_threads(driver, number):
    trio, decide = pytest.importorskip("trio"), decision()

    async def work(simulation):
        for _ in range(2):
            await trio.lowlevel.checkpoint()
            simulation.log.append(decide())

    model = script(lambda simulation: trio.run(partial(work, simulation)))
    envs = [single_env(model, decide, driver=driver) for _ in range(number)]
    for env in envs * 2:
        env.reset()
    assert [[env.step(action)[2] for env in envs] for action in range(2)] == [
        [False] * number,
        [True] * number,
    ]
    assert [env.simulation.log for env in envs] == [[0, 1]] * number


@pytest.mark.filterwarnings(
    "ignore:coroutine .* was never awaited", "ignore::pytest.PytestUnraisableExceptionWarning"
)
def test_env_reset_raises_an_error_if_a_kept_event_loop_has_old_tasks():
    """A loop that outlives its episodes keeps their tasks and passes on their exit later."""
    decide, raised = decision(), None
    env = single_env(lambda: Lasting(partial(gathered, clerk_of(decide))), decide)
    for _ in range(10):
        try:
            env.reset()
        except SimulationError as error:
            raised = error
    assert "of an earlier episode" in str(raised)
    env.close()
    env.simulation.loop.close()
    del env, raised
    gc.collect()  # what this loop has kept, before another test does
