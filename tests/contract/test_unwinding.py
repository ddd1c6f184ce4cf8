"""Section 5.9 of the contract: ends in mid-episode, and what is left behind, which is nothing."""

import gc
import threading
import warnings
import weakref
from contextlib import suppress

import greenlet
import pytest

from simenv_marl import RULE, aec_env, joint_env, parallel_env, single_env
from simenv_marl.errors import ClosedError, InvalidActionError, ReentrancyError
from tests.core.test_threads import in_a_thread
from tests.worlds.models import Script, alive, calling, decision, notes, script, stacks, step, unwinding

VIEWS = pytest.mark.parametrize("view", [aec_env, single_env])
TRIGGERS = pytest.mark.parametrize("trigger", ["close", "reset", "collect"])


@pytest.mark.parametrize("view", [aec_env, parallel_env, joint_env, single_env])
@TRIGGERS
def test_an_end_in_mid_episode_unwinds_the_simulation(view, trigger):
    log = []

    class Managed:
        def __enter__(self):
            log.append("enter")

        def __exit__(self, *error):
            log.append("exit")

    def main(simulation):
        try:
            with Managed():
                try:
                    decide()
                    decide()
                finally:
                    log.append("inner")
            log.append("never")
        finally:
            log.append("outer")

    decide = decision(agent="a_0")
    env = view(script(main), decide)
    env.reset()
    step(env, 1, "a_0")
    assert log == ["enter"]
    if trigger == "collect":
        del env
        gc.collect()
    else:
        getattr(env, trigger)()
    assert log[:4] == ["enter", "inner", "exit", "outer"]
    assert log[4:] == (["enter"] if trigger == "reset" else [])


@VIEWS
@TRIGGERS
def test_decisions_while_unwinding_are_not_answered(view, trigger):
    log, asked = [], []

    def main(simulation):
        try:
            decide()
        finally:
            log.append("finally")
            try:
                log.append(decide())
            finally:
                log.append("inner finally")
                log.append(other())
                log.append("never")

    decide = decision(lambda: log.append("rule"), agent="a_0", reward_mapping=lambda: asked.append(1) or 0)
    other = decision(agent="b_0")
    env = view(script(main), [decide, other], policies={other: RULE} if view is single_env else None)
    env.reset()
    asked.clear()
    if trigger == "collect":
        del env
        gc.collect()
    else:
        getattr(env, trigger)()
    expected = ["finally", "inner finally"]
    # A point that nobody asked for is nothing but its rule.
    assert log == (expected if view is aec_env else [*expected, "rule", "never"])
    assert len(asked) == (1 if trigger == "reset" else 0)  # 1: the next episode's


@VIEWS
def test_closing_does_not_touch_what_has_ended(view):
    decide = decision()
    env = view(calling(decide), decide)
    env.reset()
    env.step(1)
    env.close()
    env.close()
    assert env.unwrapped.simulation.log == [1]


@VIEWS
def test_an_end_by_max_steps_is_unwound_by_what_comes_next(view):
    log = []

    def main(simulation):
        try:
            while True:
                decide()
        finally:
            log.append("unwound")

    decide = decision()
    env = view(script(main), decide, max_steps=2)
    for number in range(3):
        env.reset()
        assert len(log) == number
        env.step(1)
        env.step(1)
    env.close()
    assert len(log) == 3
    env.reset()
    env.step(1)
    env.step(1)
    del env
    gc.collect()
    assert len(log) == 4


@pytest.mark.parametrize("view", [aec_env, parallel_env, joint_env, single_env])
@pytest.mark.parametrize(
    "how",
    [
        "never reset", "suspended", "ended", "truncated", "closed", "action refused", "model failed", "mapping failed",
        "first reset failed", "reset failed", "closing failed",
    ],
)  # fmt: skip
def test_environments_are_collected_and_take_everything_along(view, how):
    armed = []

    def burn(place):
        if place in armed:
            raise ZeroDivisionError

    class Witness:
        pass

    class Watched(Script):
        def __init__(self):
            super().__init__(None)
            self.witness = Witness()

        def reset(self, seed=None, options=None):
            super().reset(seed, options)
            burn("first reset failed")
            burn("reset failed")

        def run(self):
            local = Witness()
            try:
                for _ in range(3):
                    decide(local)
                    burn("model failed")
            finally:
                burn("closing failed")

    def observe(witness):
        burn("mapping failed")
        return [0, 0]

    def step(env, action=1):
        env.step({"a_0": action} if view in (parallel_env, joint_env) else action)

    def fail(env):
        env.close() if how == "closing failed" else env.reset() if "reset" in how else step(env)

    before = stacks()
    decide = decision(lambda witness: 0, agent="a_0", observation_space_mapping=observe)
    env = view(Watched, decide, max_steps=2 if how == "truncated" else None)
    if how not in ("never reset", "first reset failed"):
        env.reset()
        step(env)
    armed.append(how)
    if "failed" in how:
        with pytest.raises(ZeroDivisionError):
            fail(env)
    elif how == "action refused":
        with pytest.raises(InvalidActionError):
            step(env, "nonsense")
    elif how in ("ended", "truncated"):
        for _ in range(2 if how == "ended" else 1):
            step(env)
    elif how == "closed":
        env.close()
    armed.clear()
    references = [weakref.ref(env), weakref.ref(env.unwrapped), weakref.ref(env.unwrapped.simulation)]
    if how == "closing failed":
        env.unwrapped.simulation.env = env
    del env
    gc.collect()
    assert [reference() for reference in references] == [None, None, None]
    assert alive(Witness) == 0
    assert stacks(before) == before


@VIEWS
@pytest.mark.parametrize("held_by", ["mapping", "policy", "simulation"])
def test_closed_environments_are_collected_though_their_own_parts_refer_to_them(view, held_by):
    def closed():
        one = decision(agent="one_0", **({"reward_mapping": lambda: env.max} if held_by == "mapping" else {}))
        two = decision(agent="two_0")
        policy = (lambda observation: env.max) if held_by == "policy" else RULE
        env = view(calling(one, two, one), [one, two], policies={two: policy})
        env.max = 1
        env.reset()
        env.step(1)
        if held_by == "simulation":
            env.unwrapped.simulation.environment = env
        env.close()
        return weakref.ref(env)

    reference = closed()
    gc.collect()
    assert reference() is None


@VIEWS
def test_an_episode_that_has_ended_holds_nothing_that_its_model_has_let_go(view):
    class Witness:
        pass

    def main(simulation):
        witness = Witness()
        decide(witness)
        decide(witness)

    decide = decision(lambda witness: 0, agent="a_0", observation_space_mapping=lambda witness: [0, 0])
    env = view(script(main), decide)
    env.reset()
    env.step(1)
    assert alive(Witness) == 1
    env.step(1)
    assert alive(Witness) == 0
    env.close()


@VIEWS
def test_an_abandoned_environment_goes_without_the_collector(view):
    log, decide = [], decision()
    gc.collect()
    gc.disable()
    try:
        env = view(unwinding(decide, log), decide)
        env.reset()
        del env
        assert log == ["unwound"]
    finally:
        gc.enable()


@VIEWS
@pytest.mark.parametrize("where", ["model", "observation_space_mapping", "reward_mapping"])
def test_an_error_that_was_dealt_with_leaves_nothing_behind(view, where):
    class Witness:
        pass

    def fail(*arguments):
        if env.failing:
            raise ZeroDivisionError
        return 0.0 if where == "reward_mapping" else [0, 0]

    def main(simulation):
        local = Witness()
        decide(local)
        if where == "model":
            fail()
        decide(local)

    changes = {} if where == "model" else {where: fail}
    decide = decision(lambda witness: 0, agent="a_0", **changes)
    before = stacks()
    env = view(script(main), decide)
    env.failing = False
    env.reset()
    env.failing = True
    gc.disable()
    try:
        with suppress(ZeroDivisionError):
            env.step(1)
            pytest.fail("nothing was raised")
        env.close()
        assert sum(type(thing) is Witness for thing in gc.get_objects()) == 0
    finally:
        gc.enable()
    assert stacks(before) == before


def test_a_simulation_that_refers_to_itself_and_to_its_frames_is_collected():
    class Knotted(Script):
        def run(self):
            self.generator = (self for _ in [1])
            self.me = self
            frames = [self]
            frames.append(frames)
            decide()

    decide = decision()
    env = single_env(lambda: Knotted(None), decide)
    env.reset()
    reference = weakref.ref(env.unwrapped.simulation)
    del env
    gc.collect()
    assert reference() is None


# -- models that resist ---------------------------------------------------------------------------


def swallow_exceptions(simulation):
    while True:
        try:
            decide()
        except Exception:
            simulation.log.append("swallowed")


def swallow_once(simulation):
    with suppress(BaseException):
        decide()
    return "done"


def swallow_a_few(simulation):
    for _ in range(4):
        with suppress(BaseException):
            decide()


def translate(simulation):
    try:
        decide()
    except BaseException as error:
        raise RuntimeError("translated") from error


def stop_in_finally(simulation):
    while True:
        try:
            decide()
        finally:
            break  # noqa: B012


decide = decision()


@VIEWS
@TRIGGERS
@pytest.mark.parametrize("main", [swallow_exceptions, swallow_once, swallow_a_few, translate, stop_in_finally])
def test_models_that_resist_a_little_are_unwound(view, trigger, main):
    before = stacks()
    env = view(script(main), decide)
    env.reset()
    simulation = env.unwrapped.simulation
    log = simulation.log
    if trigger == "collect":
        del env
        gc.collect()
    else:
        getattr(env, trigger)()
    assert log == []
    if trigger != "reset":
        assert stacks(before) == before


@VIEWS
@pytest.mark.parametrize("trigger", ["close", "reset"])
def test_a_model_that_refuses_to_unwind_is_given_up_with_a_warning(view, trigger):
    stop = [False]

    def refuse(simulation):
        while not stop[0]:
            with suppress(BaseException):
                simulation.log.append(decide())

    env = view(script(refuse), decide)
    env.reset()
    env.step(1)
    refusing = env.unwrapped.simulation
    with pytest.warns(ResourceWarning, match="Script refuses to end") as caught:
        getattr(env, trigger)()
    assert caught[0].filename == __file__
    assert refusing.log == [1]  # none of its decisions was answered
    if trigger == "close":
        with pytest.raises(ClosedError, match="call reset"):
            env.step(1)
        env.reset()
    assert env.unwrapped.simulation is not refusing
    env.step(2)
    assert (refusing.log, env.unwrapped.simulation.log) == ([1], [2])
    stop[0] = True
    env.step(3)


@VIEWS
def test_a_model_that_refuses_to_unwind_when_it_is_collected_is_given_up_with_a_warning(view):
    def refuse(simulation):
        while True:
            with suppress(BaseException):
                decide()

    env = view(script(refuse), decide)
    env.reset()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        del env
        gc.collect()
    assert [warning.category for warning in caught] == [ResourceWarning]


def test_errors_while_a_collected_simulation_unwinds_are_not_lost():
    def main(simulation):
        try:
            decide()
        finally:
            raise KeyError("while unwinding")

    env = single_env(script(main), decide)
    env.reset()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        del env
        gc.collect()
    assert "while unwinding" in str(caught[0].message)


# -- threads --------------------------------------------------------------------------------------


def test_an_environment_whose_thread_has_ended_can_be_reset_or_dropped():
    env = single_env(unwinding(decide, []), decide)
    in_a_thread(env.reset)
    env.reset()
    assert env.step(1)[2]
    in_a_thread(env.reset)
    reference = weakref.ref(env)
    del env
    gc.collect()
    assert reference() is None


@pytest.mark.greenlet("threads of their own unwind at once, wherever their environment is dropped")
def test_an_environment_that_is_dropped_in_another_thread_unwinds_in_its_own():
    log = []

    def main(simulation):
        try:
            decide()
        finally:
            log.append(threading.get_ident())
            decide()
            log.append("nobody was asked")

    held = [single_env(script(main), decide)]
    held[0].reset()
    in_a_thread(held.clear)
    gc.collect()
    greenlet.greenlet(lambda: None).switch()  # whatever switches next
    assert log == [threading.get_ident(), "nobody was asked"]
    assert decide() == "rule"
    env = single_env(calling(decide), decide)
    env.reset()
    assert decide() == "rule"
    env.step(1)
    assert env.unwrapped.simulation.log == [1]


# -- from inside ----------------------------------------------------------------------------------


@pytest.mark.parametrize("view", [aec_env, single_env, parallel_env, joint_env])
@pytest.mark.parametrize("where", ["stop", "finally", "close"])
@pytest.mark.parametrize("use", ["close", "reset", "step"])
def test_an_environment_that_is_used_while_it_unwinds_its_simulation_says_so(view, where, use):
    action = {"choose_0": 1} if view in (parallel_env, joint_env) else 1

    class Model(Script):
        def stop(self):
            if where == "stop":
                use_it()

        def close(self):
            if where == "close":
                use_it()

    def main(simulation):
        try:
            decide()
            decide()
        finally:
            if where == "finally":
                use_it()

    def use_it():
        with pytest.raises(ReentrancyError):
            env.step(action) if use == "step" else getattr(env, use)()
        used.append(use)

    used, decide = [], decision()
    env = view(lambda: Model(main), decide)
    env.reset()
    env.close()
    env.reset()
    env.reset()
    env.close()
    assert used == [use] * 3
    with pytest.raises(ClosedError):
        env.step(action)


@pytest.mark.parametrize("view", [aec_env, single_env, parallel_env, joint_env])
@pytest.mark.parametrize("use", ["close", "reset"])
def test_a_stop_that_passes_that_on_has_it_raised_once(view, use):
    class Model(Script):
        def stop(self):
            getattr(env, use)()

    decide = decision()
    env = view(lambda: Model(calling(decide, decide)().main), decide)
    env.reset()
    with pytest.raises(ReentrancyError) as caught:
        env.close()
    assert "decision 1" in notes(caught.value)
    env.close()
    env.reset()
