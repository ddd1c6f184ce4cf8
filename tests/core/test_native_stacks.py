"""Native stack traces inside a model, as torch makes one for the message of each error."""

import ctypes
import platform
import sys
import types

import pytest

from simenv_marl import single_env
from simenv_marl.core.switching import greenlets
from tests.processes import alone
from tests.worlds.models import define

CHOOSE = f"{__name__}.Traced.choose"
POINTS = {CHOOSE: define(agent="agent_0")}


class Traced:
    """Reads its native stack before and after each decision."""

    def __init__(self):
        self.depths = []

    def reset(self, seed=None):
        self.trace()

    def trace(self):
        frames = (ctypes.c_void_p * 500)()
        self.depths.append(ctypes.CDLL(None).backtrace(frames, 500))

    def choose(self):
        return 0

    def run(self):
        for _ in range(20):
            self.choose()
            self.trace()


def at_a_depth(depth, function, *args):
    """Call a function below so many frames of C."""
    if depth == 0:
        return function(*args)
    return next(map(lambda _: at_a_depth(depth - 1, function, *args), "C"))  # noqa: C417 - in C


def trace_at_all_depths():
    env = at_a_depth(7, single_env, Traced, POINTS)
    at_a_depth(3, lambda: env.reset(seed=1))
    for depth in range(20):
        at_a_depth(depth % 10, env.step, 1)
    assert len(env.simulation.depths) == 21
    assert max(env.simulation.depths) < 50


SYSTEM = (sys.platform, platform.machine())


@pytest.mark.skipif(SYSTEM != ("linux", "x86_64"), reason="there is no begin of stacks elsewhere")
def test_native_stack_trace_in_a_simulation_ends_where_its_stack_begins():
    alone(trace_at_all_depths)


def test_env_warns_of_libraries_with_unsafe_native_stack_traces(monkeypatch):
    monkeypatch.setattr(greenlets, "_definition", lambda: None)
    monkeypatch.setitem(sys.modules, "torch", types.ModuleType("torch"))
    greenlets.warn_of_native_traces.cache_clear()
    with pytest.warns(UserWarning, match='error of torch .* kills the process .* driver="thread"'):
        single_env(Traced, POINTS, driver="greenlet")
