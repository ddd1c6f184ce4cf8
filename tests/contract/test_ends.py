"""Ends: of episodes, environments, threads and processes. Nothing is left of any of them, and none of them hangs."""

import gc
import random
import signal
import subprocess
import sys
import warnings
from contextlib import suppress
from textwrap import dedent

import pytest
from benchmarks import soak

from simenv_marl import single_env
from simenv_marl.core.options import Options
from tests.worlds.models import decision, define, script

SECONDS = 60
"""What a process may take at most: far more than it needs, so that only one that hangs is ended."""

needs_signals = pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="this platform has no timers that signal")

PRELUDE = """
    import os, random, signal, sys, threading, time
    from simenv_marl import RULE, aec_env, joint_env, parallel_env, single_env
    from simenv_marl.core.options import Options
    from tests.worlds.models import calling, decision, script
    Options.__init__.__kwdefaults__["driver"] = {driver!r}
"""


def driver():
    """The driver that environments of this test have."""
    return Options.__init__.__kwdefaults__["driver"]


def process(code):
    """Run a program in a process of its own, with warnings as errors."""
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", dedent(PRELUDE.format(driver=driver())) + dedent(code)],
        capture_output=True, text=True, check=False, timeout=SECONDS,
    )  # fmt: skip


# -- many episodes --------------------------------------------------------------------------------


def test_thousands_of_episodes_that_are_cut_short_leave_nothing():
    draw = random.Random(5)
    soak.play(driver(), 200, draw)
    before = soak.figures()
    soak.play(driver(), 1500, draw)
    after = soak.figures()
    for name in ("threads", "greenlets", "descriptors", "objects"):
        assert after[name] <= before[name] + soak.GROWTH.get(name, 0), name


# -- environments ---------------------------------------------------------------------------------


class Patched:
    """A model whose ``act`` is a decision point for some environments alone."""

    refuses = True

    def reset(self):
        pass

    def run(self):
        while self.refuses:
            with suppress(BaseException):
                self.act()

    def act(self):
        return 0


ACT = Patched.act


def test_what_was_patched_is_put_back_though_an_abandoned_model_refuses_to_end(monkeypatch):
    env = single_env(Patched, {f"{__name__}.Patched.act": define()})
    env.reset()
    assert Patched.act is not ACT
    printed = []
    monkeypatch.setattr(sys, "unraisablehook", lambda error: printed.append(error.exc_type))
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # what is raised in a finalizer is printed
        del env
        gc.collect()
    assert printed == [ResourceWarning]
    assert Patched.act is ACT


def test_an_exit_in_a_group_is_an_exit_and_what_is_with_it_is_an_error():
    others = []

    def main(simulation):
        try:
            decide()
        except BaseException as error:
            nested = BaseExceptionGroup("inner", [error])
            raise BaseExceptionGroup("tasks", [nested, *others]) from None

    decide = decision()
    env = single_env(script(main), decide)
    env.reset()
    env.close()
    others.append(ZeroDivisionError())
    env.reset()
    with pytest.raises(BaseExceptionGroup, match="tasks"):
        env.close()


# -- processes ------------------------------------------------------------------------------------


def test_a_model_may_end_the_process():
    code = """
        def main(simulation):
            decide()
            END
        decide = decision()
        env = aec_env(script(main), decide)
        env.reset()
        env.step(1)
        print("went on")
    """
    assert process(code.replace("END", "sys.exit(3)")).returncode == 3
    assert process(code.replace("END", "os._exit(4)")).returncode == 4
    said = process(code.replace("END", "raise KeyboardInterrupt"))
    assert "KeyboardInterrupt" in said.stderr
    assert "went on" not in said.stdout


@needs_signals
def test_signals_at_any_time_never_spoil_an_environment():
    result = process("""
        class Alarm(BaseException):
            pass
        def ring(*_):
            raise Alarm
        signal.signal(signal.SIGALRM, ring)
        decide = decision()
        def main(simulation):
            for _ in range(5):
                simulation.log.append(decide())
        draw, rung = random.Random(3), 0
        envs = [view(script(main), decide) for view in (aec_env, single_env, parallel_env)]
        def use(env):
            env.reset()
            for _ in range(5):
                env.step({"choose_0": 2} if env is envs[2] else 2)
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
