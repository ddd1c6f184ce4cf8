"""Section 5.9 of the contract: what ends in mid-episode is unwound, and nothing of it is left."""

import asyncio
import ctypes
import gc
import random
import sys
import weakref
from contextlib import suppress
from functools import partial
from pathlib import Path

import greenlet
import pytest
from benchmarks import soak

from simenv_marl import RULE, aec_env, joint_env, single_env
from simenv_marl.core.plans.options import Options
from simenv_marl.errors import ClosedError, InvalidActionError
from tests.core.test_threads import in_a_thread
from tests.processes import alone
from tests.worlds.models import EVERY_VIEW, alive, begun, decision, script, stacks, step, unwinding

VIEWS = pytest.mark.parametrize("view", [aec_env, single_env])
TRIGGERS = pytest.mark.parametrize("trigger", ["close", "reset", "collect"])
decide = decision()


def ended_by(trigger, held):
    """End the episode of the one environment of a list, which nobody else holds."""
    if trigger == "collect":
        held.clear()
        gc.collect()
    else:
        getattr(held[0], trigger)()


# -- ends in mid-episode --------------------------------------------------------------------------


@EVERY_VIEW
@TRIGGERS
@pytest.mark.parametrize("max_steps", [None, 1])
def test_env_close_and_reset_unwind_the_model_without_answering_decisions(view, trigger, max_steps):
    log, rewarded = [], []

    def main(simulation):
        log.append("begun")
        try:
            try:
                decide()
                decide()
            finally:
                log.append("inner")
                log.append(decide())
            log.append("never")
        finally:
            log.append("outer")
            log.append(other())
            log.append("still its rule")

    decide = decision(agent="a_0", reward_mapping=lambda: rewarded.append(1) or 0)
    other = decision(agent="b_0")
    unasked = view in (single_env, joint_env)
    policies = {other: RULE} if unasked else None
    held = [view(script(main), [decide, other], policies=policies, max_steps=max_steps)]
    held[0].reset()
    assert step(held[0], 1, "a_0") is (max_steps == 1)
    assert log == ["begun"]
    rewarded.clear()
    ended_by(trigger, held)
    last = ["rule", "still its rule"] if unasked else []
    again = ["begun"] if trigger == "reset" else []
    assert log == ["begun", "inner", "outer", *last, *again]
    assert len(rewarded) == len(again)


def test_env_close_unwinds_a_model_that_raises_an_exception_group():
    others = []

    def main(simulation):
        try:
            decide()
        except BaseException as error:
            nested = BaseExceptionGroup("inner", [error])
            raise BaseExceptionGroup("tasks", [nested, *others]) from None

    env = begun(single_env(script(main), decide))
    env.close()
    others.append(ZeroDivisionError())
    env.reset()
    with pytest.raises(BaseExceptionGroup, match="tasks"):
        env.close()


# -- what is left ---------------------------------------------------------------------------------


class Witness:
    """What must not be left."""


class RaisedError(Exception):
    pass


def left(kind):
    """How many objects of a type there are, without the help of the collector."""
    return sum(type(thing) is kind for thing in gc.get_objects())


@pytest.mark.thorough
def test_env_leaks_nothing_after_thousands_of_aborted_episodes():
    draw = random.Random(5)
    driver = Options.__init__.__kwdefaults__["driver"]
    soak.play(driver, 200, draw)
    before = soak.figures()
    soak.play(driver, 1000, draw)
    after = soak.figures()
    for name in ("threads", "greenlets", "descriptors", "objects"):
        assert after[name] <= before[name] + soak.GROWTH.get(name, 0), name


@pytest.mark.usefixtures("_collected")
@EVERY_VIEW
@pytest.mark.parametrize(
    "when", ["never reset", "suspended", "ended", "truncated", "closed", "action refused"]
)
@pytest.mark.parametrize("where", ["here", "elsewhere"])
def test_dropped_env_unwinds_its_model_at_once_and_is_freed(view, when, where):
    def main(simulation):
        witness = Witness()
        try:
            decide(witness)
            decide(witness)
        finally:
            log.append("unwound")
        return witness

    before, log = stacks(), []
    decide = decision(lambda witness: 0, agent="a_0")
    env = view(script(main), decide, max_steps=1 if when == "truncated" else None)
    if when != "never reset":
        env.reset()
        step(env, 1, "a_0")
    if when == "ended":
        step(env, 1, "a_0")
        assert left(Witness) == 0
    elif when == "closed":
        env.close()
    elif when == "action refused":
        with pytest.raises(InvalidActionError):
            step(env, "nonsense", "a_0")
    references = [weakref.ref(thing) for thing in (env, env.unwrapped, env.simulation)]
    held = [env]
    del env
    in_a_thread(held.clear) if where == "elsewhere" else held.clear()
    # a stack of another thread unwinds when something switches
    greenlet.greenlet(lambda: None).switch()
    assert log == ([] if when == "never reset" else ["unwound"])
    gc.collect()
    assert [reference() for reference in references] == [None] * 3
    assert alive(Witness) == 0
    assert not stacks(before)


@pytest.mark.usefixtures("_collected")
@VIEWS
@pytest.mark.parametrize("where", ["model", "mapping"])
def test_env_keeps_no_errors_or_arguments_of_an_episode_alive(view, where):
    def observe(witness):
        if where == "mapping" and env.simulation.log:
            raise RaisedError
        return [0, 0]

    def main(simulation):
        simulation.log.append(decide(Witness()))
        if where == "model":
            raise RaisedError(Witness())
        decide(Witness())

    decide = decision(lambda witness: 0, agent="a_0", observation_space_mapping=observe)
    env = view(script(main), decide)
    env.reset()
    assert left(Witness) == 1
    with suppress(RaisedError):  # pytest.raises would keep it
        env.step(1)
        pytest.fail("nothing was raised")
    assert left(RaisedError) == 0
    env.close()
    assert left(Witness) == 0


# -- models that resist ---------------------------------------------------------------------------


def swallow_exceptions(simulation):
    while True:
        try:
            decide()
        except Exception:
            simulation.log.append("swallowed")


def swallow_a_few(simulation):
    for _ in range(4):
        with suppress(BaseException):
            decide()


@VIEWS
@TRIGGERS
@pytest.mark.parametrize("main", [swallow_exceptions, swallow_a_few])
def test_env_close_unwinds_a_model_that_catches_its_exit_a_few_times(view, trigger, main):
    before = stacks()
    held = [view(script(main), decide)]
    held[0].reset()
    log = held[0].unwrapped.simulation.log
    ended_by(trigger, held)
    assert log == []
    if trigger != "reset":
        assert not stacks(before)


@VIEWS
@pytest.mark.parametrize("trigger", ["close", "reset"])
def test_env_close_warns_and_gives_up_a_model_that_does_not_unwind(view, trigger):
    stop = [False]

    def refuse(simulation):
        while not stop[0]:
            with suppress(BaseException):
                simulation.log.append(decide())

    env = begun(view(script(refuse), decide))
    env.step(1)
    refusing = env.simulation
    with pytest.warns(ResourceWarning, match="Script refuses to end") as caught:
        getattr(env, trigger)()
    assert caught[0].filename == __file__
    assert refusing.log == [1]  # none of its decisions was answered
    if trigger == "close":
        with pytest.raises(ClosedError, match="call reset"):
            env.step(1)
        env.reset()
    assert env.simulation is not refusing
    env.step(2)
    assert (refusing.log, env.simulation.log) == ([1], [2])
    stop[0] = True
    env.step(3)


def test_dropped_env_reports_errors_that_its_model_raises_while_unwinding():
    def main(simulation):
        try:
            decide()
        finally:
            raise KeyError("while unwinding")

    held = [single_env(script(main), decide)]
    held[0].reset()
    with pytest.warns(ResourceWarning, match="while unwinding"):
        ended_by("collect", held)


# -- threads --------------------------------------------------------------------------------------


def test_env_can_be_reset_or_dropped_after_its_thread_has_ended():
    env = single_env(unwinding(decide, []), decide)
    in_a_thread(env.reset)
    env.reset()
    assert env.step(1)[2]
    in_a_thread(env.reset)
    reference = weakref.ref(env)
    del env
    gc.collect()
    assert reference() is None


# -- through code of others -----------------------------------------------------------------------


def close_through_printing_c_code(path):
    async def work():
        sys.modules["__main__"].decide = decide
        ctypes.pythonapi.PyRun_SimpleString(b"decide()")  # which calls PyErr_Print

    decide = decision()
    env = begun(single_env(script(lambda simulation: asyncio.run(work())), decide))
    env.close()
    Path(path).touch()


def test_env_close_does_not_end_a_process_whose_c_code_prints_errors(tmp_path):
    alone(close_through_printing_c_code, str(tmp_path / "closed"))
    assert (tmp_path / "closed").exists()


class EngineError(Exception):
    """What an engine raises in place of what it has caught."""


def wrap(decide, how):
    """Decide in an engine that raises an error of its own, unlike a cleanup that fails."""
    kept = None
    try:
        decide()
    except BaseException as error:
        if how == "from it":
            raise EngineError("a process has failed") from error
        if how == "implicitly":
            raise EngineError("a process has failed")  # noqa: B904
        if how == "exit":
            sys.exit(3)
        kept = error
    if how == "text":
        raise EngineError(str(kept))
    raise EngineError("a process has failed", kept)


@pytest.mark.parametrize("how", ["from it", "exit", "text", "later"])
@pytest.mark.parametrize("end", ["close", "reset"])
def test_env_close_ignores_errors_that_the_models_exit_has_caused(how, end):
    decide = decision()
    env = begun(single_env(script(lambda simulation: wrap(decide, how)), decide))
    getattr(env, end)()
    env.close()


def test_env_close_raises_an_error_that_replaces_the_models_exit():
    decide = decision()
    env = begun(single_env(script(lambda simulation: wrap(decide, "implicitly")), decide))
    with pytest.raises(EngineError):
        env.close()
    env.reset()
    with pytest.raises(EngineError):
        env.close()


class Engine:
    """Makes its worker once, for all episodes."""

    def __init__(self, decide):
        self.worker, self.decide = greenlet.greenlet(self.work), decide

    def reset(self, seed=None):
        self.log = []

    def work(self):
        while True:
            self.log.append(self.decide())
            greenlet.getcurrent().parent.switch()

    def run(self):
        for _ in range(3):
            self.worker.switch()


@pytest.mark.parametrize("steps", [0, 1, 3])
def test_env_reset_ignores_greenlets_kept_from_an_earlier_episode(steps):
    decide = decision()
    env = begun(single_env(partial(Engine, decide), decide))
    simulation = env.simulation
    for number in range(steps):
        env.step(number)
    env.close()
    for _ in range(2):
        env.reset()
        assert [env.step(number)[2] for number in range(3)] == [False, False, True]
        assert env.simulation.log == [0, 1, 2]
        env.close()
    assert env.simulation is not simulation
