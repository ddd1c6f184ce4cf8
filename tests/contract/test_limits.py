"""A step that takes too long is an error that shows where the model was, in every view."""

import asyncio
import os
import pickle
import signal
import threading
import time
import traceback
from random import Random

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import (
    RULE,
    aec_env,
    clone,
    evaluate,
    joint_env,
    parallel_env,
    save_episode,
    simulate,
    single_env,
    turn_env,
    vector_env,
)
from simenv_marl.errors import (
    OptionValueError,
    SimEnvError,
    StepTimeoutError,
    UnknownOptionError,
    WrongThreadError,
)
from tests.core.test_threads import in_a_thread
from tests.worlds.models import decision, define, nobody_is_asked, script, stacks
from tests.worlds.vectors import FORK, FORKS

pytestmark = pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="there is no timer")

LIMIT = 0.2
ALARMS = pytest.mark.greenlet("threads need no signal")


class Machine:
    """Decides; what its second decision says happens, in the model."""

    def reset(self, seed=None, options=None):
        self.seed = seed
        self.how = (options or {}).get("how", loop)
        self.unwound = False

    def run(self):
        try:
            while True:
                if self.choose() == 3:
                    self.how(30)
        finally:
            self.unwound = True

    @define(agent="machine")
    def choose(self):
        return 0


GOAL = define(
    agent="machine",
    goal_space=spaces.Box(0, 1, (1,), np.float64),
    achieved_goal_mapping=lambda machine: [0.0],
    desired_goal_mapping=lambda machine: [1.0],
    compute_reward=lambda achieved, desired, info: 0.0,
)

VIEWS = {
    "aec": (aec_env, {}, lambda action: action),
    "parallel": (parallel_env, {}, lambda action: {"machine": action}),
    "single": (single_env, {}, lambda action: action),
    "goal": (single_env, {"points": {f"{__name__}.Machine.choose": GOAL}}, lambda action: action),
    "joint": (joint_env, {}, lambda action: {"machine": action}),
    "turn": (turn_env, {}, lambda action: action),
    "vector": (vector_env, {"num_envs": 2}, lambda action: np.array([1, action])),
    "vector of turns": (
        vector_env,
        {"num_envs": 2, "view": "turn"},
        lambda action: np.array([1, action]),
    ),
    "workers": (
        vector_env,
        {"num_envs": 2, "workers": 2, "context": FORK},
        lambda action: np.array([1, action]),
    ),
}


def limited(view="single", **options):
    make, given, as_action = VIEWS[view]
    options = {"points": Machine.choose, "step_timeout": LIMIT, **given, **options}
    env = make(Machine, **options)
    return env, lambda action: env.step(as_action(action))


def loop(seconds):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        pass


def swallow_errors(seconds):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            loop(seconds)
        except Exception:
            continue


async def wait(seconds):
    other = asyncio.ensure_future(asyncio.sleep(seconds))
    await asyncio.gather(other, asyncio.to_thread(bool))


HANGS = {"loop": loop, "swallow errors": swallow_errors}


@FORKS
@pytest.mark.parametrize("hang", HANGS)
@pytest.mark.parametrize("view", VIEWS)
def test_step_timeout_raises_an_error_with_the_models_stack(view, hang):
    before = set(threading.enumerate())
    env, step = limited(view)
    env.reset(seed=4, options={"how": HANGS[hang]})
    step(1)
    begun = time.monotonic()
    with pytest.raises(StepTimeoutError, match=f"step_timeout={LIMIT}") as caught:
        step(3)
    assert LIMIT <= time.monotonic() - begun < 4
    assert isinstance(caught.value, SimEnvError)
    assert isinstance(caught.value, TimeoutError)
    text = str(caught.value)
    assert "in run\n" in text
    assert "in loop\n" in text
    assert "threading.py" not in text
    assert "in step\n" not in text
    assert "seed 4" in (notes := "".join(caught.value.__notes__)) or "seed 5" in notes
    assert str(pickle.loads(pickle.dumps(caught.value))) == text
    env.reset(seed=5)
    step(1)
    env.close()
    assert nobody_is_asked()
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
    assert signal.getsignal(signal.SIGALRM) is signal.SIG_DFL
    assert set(threading.enumerate()) <= before


def test_step_timeout_unwinds_the_model_through_its_finally_blocks():
    env, step = limited()
    env.reset(options={"how": loop})
    with pytest.raises(StepTimeoutError):
        step(3)
    assert env.simulation.unwound


@pytest.mark.parametrize("where", ["reset", "user"])
def test_step_timeout_excludes_reset_and_the_users_own_time(where):
    class Slow(Machine):
        def reset(self, seed=None, options=None):
            time.sleep(2 * LIMIT if where == "reset" else 0)
            super().reset(seed, options)

    env = single_env(Slow, Slow.choose, step_timeout=LIMIT)
    for _ in range(2):
        env.reset()
        for _ in range(3):
            if where == "user":
                time.sleep(LIMIT)
            env.step(1)


def test_step_timeout_does_not_change_results():
    logs = []
    for limit in (None, 30, 0.5):
        env, step = limited(step_timeout=limit)
        logs.append([env.reset(seed=3), *(step(action % 3) for action in range(30)), step(RULE)])
    assert str(logs[0]) == str(logs[1]) == str(logs[2])


@pytest.mark.thorough
def test_step_timeout_gives_up_a_model_that_never_unwinds(monkeypatch):
    for place in ("hooks.limits", "core.switching.threads"):
        monkeypatch.setattr(f"simenv_marl.{place}.SECONDS_TO_UNWIND", 0.3)
    monkeypatch.setattr(f"{__name__}.LIMIT", 0.1)

    ends = time.monotonic() + 5

    def refuse(seconds):
        while time.monotonic() < ends:
            try:
                loop(5)
            except BaseException:
                continue

    env, step = limited(step_timeout=0.1)
    env.reset(options={"how": refuse})
    with pytest.warns(ResourceWarning, match="is abandoned"), pytest.raises(StepTimeoutError):
        step(3)
    env.reset()
    step(1)
    env.close()
    time.sleep(max(ends - time.monotonic(), 0) + 0.2)  # threads end


def test_step_timeout_does_not_replace_an_error_raised_in_time():
    def fail(seconds):
        try:
            raise KeyError("mine")
        finally:
            time.sleep(LIMIT / 2)

    env, step = limited()
    env.reset(options={"how": fail})
    with pytest.raises(KeyError, match="mine"):
        step(3)


@pytest.mark.filterwarnings("ignore")
def test_step_timeout_ends_tasks_of_an_event_loop():
    env, step = limited()
    env.reset(options={"how": lambda seconds: asyncio.run(wait(1))})
    with pytest.raises(StepTimeoutError) as caught:
        step(3)
    assert "in wait\n" in str(caught.value) or "in run\n" in str(caught.value)
    env.reset()
    step(1)


def test_envs_refuse_invalid_step_timeouts():
    for wrong in (0, -1, float("inf"), "1", True):
        with pytest.raises(OptionValueError, match="step_timeout must be a positive number"):
            limited(step_timeout=wrong)
    for run in (simulate, lambda *_, **given: evaluate(*_, {"a": {}}, seeds=[1], **given)):
        with pytest.raises(UnknownOptionError, match="step_timeout is an option of environments"):
            run(Machine, step_timeout=1)


def test_episode_that_timed_out_can_be_saved(tmp_path):
    env, step = limited()
    env.reset(seed=3)
    step(1)
    with pytest.raises(StepTimeoutError):
        step(3)
    save_episode(env, tmp_path / "late.jsonl")
    assert "StepTimeoutError" in (tmp_path / "late.jsonl").read_text(encoding="utf-8")


@pytest.mark.parametrize("view", [view for view in VIEWS if view != "workers"])
def test_step_timeout_may_interrupt_a_step_at_any_moment(view):
    before = set(threading.enumerate())
    random, late = Random(0), 0
    for seed in range(40):
        env, step = limited(view, step_timeout=random.choice([1e-5, 3e-5, 1e-4]) * random.random())
        for _ in range(3):
            env.reset(seed=seed)
            try:
                for _ in range(10):
                    step(1)
            except StepTimeoutError:
                late += 1
            assert signal.getsignal(signal.SIGALRM) is signal.SIG_DFL
            assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
        env.close()
    assert late
    assert nobody_is_asked()
    assert set(threading.enumerate()) <= before


# -- signals --------------------------------------------------------------------------------------


@ALARMS
@pytest.mark.parametrize("view", VIEWS)
def test_step_timeout_outside_the_main_thread_needs_the_thread_driver(view):
    if view == "workers":
        pytest.skip("workers have main threads")
    env, _ = limited(view)
    with pytest.raises(WrongThreadError, match='use driver="thread"'):
        in_a_thread(env.reset)
    env.close()


def test_step_timeout_works_in_any_thread_with_the_thread_driver():
    def play():
        env, step = limited(driver="thread")
        env.reset(options={"how": loop})
        with pytest.raises(StepTimeoutError):
            step(3)
        env.close()

    in_a_thread(play)


@pytest.fixture
def _alarms():
    yield
    signal.setitimer(signal.ITIMER_REAL, 0)
    signal.signal(signal.SIGALRM, signal.SIG_DFL)


@ALARMS
@pytest.mark.usefixtures("_alarms")
@pytest.mark.parametrize("interval", [0.0, 0.05])
def test_step_timeout_leaves_the_users_alarm_signals_working(interval):
    rung = []
    handler = signal.signal(signal.SIGALRM, lambda *_: rung.append(time.monotonic() - begun))
    assert handler is signal.SIG_DFL
    handler = signal.getsignal(signal.SIGALRM)
    env, step = limited(step_timeout=1.0)
    env.reset(options={"how": lambda seconds: loop(0.2)})
    begun = time.monotonic()
    signal.setitimer(signal.ITIMER_REAL, 0.1, interval)
    step(3)
    assert rung == pytest.approx([0.1, 0.15, 0.2][: 1 + 2 * bool(interval)], abs=0.04)
    assert signal.getsignal(signal.SIGALRM) is handler
    if interval:
        assert signal.getitimer(signal.ITIMER_REAL)[1] == pytest.approx(interval)
        number = len(rung)
        time.sleep(0.06)
        assert len(rung) > number
    else:
        assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
    signal.setitimer(signal.ITIMER_REAL, 0.5)
    step(1)
    left, _ = signal.getitimer(signal.ITIMER_REAL)
    assert 0.3 < left <= 0.5
    number = len(rung)
    os.kill(os.getpid(), signal.SIGALRM)
    assert len(rung) == number + 1


@ALARMS
@pytest.mark.usefixtures("_alarms")
def test_step_timeout_raises_errors_of_the_users_signal_handler():
    def handler(*_):
        raise BlockingIOError("the user's own limit")

    signal.signal(signal.SIGALRM, handler)
    env, step = limited(step_timeout=5)
    env.reset(options={"how": loop})
    signal.setitimer(signal.ITIMER_REAL, 0.1)
    with pytest.raises(BlockingIOError) as caught:
        step(3)
    assert "loop" in "".join(traceback.format_exception(caught.value))
    assert signal.getsignal(signal.SIGALRM) is handler
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


@ALARMS
@pytest.mark.usefixtures("_alarms")
def test_step_timeout_allows_a_model_its_own_alarm_signal():
    rung = []

    def with_alarm(seconds):
        before = signal.signal(signal.SIGALRM, lambda *_: rung.append(1))
        signal.setitimer(signal.ITIMER_REAL, 0.05)
        loop(0.1)
        signal.signal(signal.SIGALRM, before)

    def and_keeps_it(seconds):
        signal.signal(signal.SIGALRM, with_alarm)

    env, step = limited()
    env.reset(options={"how": with_alarm})
    step(3)
    assert rung == [1]
    assert signal.getsignal(signal.SIGALRM) is signal.SIG_DFL
    env.reset(options={"how": and_keeps_it})
    step(3)
    assert signal.getsignal(signal.SIGALRM) is with_alarm


@ALARMS
def test_step_timeout_interrupts_a_slow_mapping():
    before = stacks()
    choose = decision(agent="ant", observation_space_mapping=lambda: [loop(len(slow)) or 0, 0])
    slow = []

    def main(simulation):
        while True:
            choose()

    env = single_env(script(main), choose, step_timeout=LIMIT)
    env.reset()
    env.step(1)
    slow += [1, 2]
    with pytest.raises(StepTimeoutError, match="in <lambda>"):
        env.step(1)
    env.close()
    assert not stacks(before)


@ALARMS
@pytest.mark.parametrize(("inner", "outer"), [(0.1, 5), (5, 0.1), (None, 0.1)])
def test_shorter_step_timeout_of_nested_envs_applies(inner, outer):
    before = stacks()
    within, step = limited(step_timeout=inner)
    seen = []

    def observe():
        if seen:
            step(3)
        seen.append(1)
        return [0.0, 0.0]

    choose = decision(agent="ant", observation_space_mapping=observe)
    env = single_env(script(lambda _: [choose() for _ in range(5)]), choose, step_timeout=outer)
    within.reset()
    env.reset()
    begun = time.monotonic()
    with pytest.raises(StepTimeoutError, match=r"step_timeout=0\.1"):
        env.step(1)
    assert time.monotonic() - begun < 2
    assert signal.getsignal(signal.SIGALRM) is signal.SIG_DFL
    env.close()
    within.close()
    assert not stacks(before)


@pytest.mark.parametrize("method", ["fork", "replay"])
def test_clones_keep_the_step_timeout(method, request):
    if method == "fork" and request.node.callspec.params["_driver"] == "thread":
        pytest.skip("threads are not forked")
    env, step = limited()
    env.reset(options={"how": loop})
    step(1)
    copy = clone(env, method=method)
    with pytest.raises(StepTimeoutError, match="in loop"):
        copy.step(3)
    copy.close()
    step(1)
