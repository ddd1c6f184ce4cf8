"""What goes wrong in a model in C++, as the user of its environment meets it."""

import gc

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import RULE, aec_env, make_step, simulate
from simenv_marl.errors import ProcessDiedError, RemoteError
from simenv_marl.remote import ProcessSimulation
from tests.outside.compiling import COMPILER, ROOT, compiled
from tests.processes import gone

pytestmark = pytest.mark.skipif(COMPILER is None, reason="no C++ compiler: neither g++ nor clang++ is installed")

ANYTHING = make_step(
    observation_space=spaces.Discrete(1),
    observation_space_mapping=lambda call: 0,
    action_space=spaces.Discrete(2),
    apply=lambda action, call: ANSWERS[action],
    reward_mapping=lambda call: 0.0,
    agent=lambda call: call.entity,
)
ANSWERS = {0: 1, 1: "what is no number"}


@pytest.fixture(scope="module")
def probe(tmp_path_factory):
    return compiled(ROOT / "tests" / "outside" / "cpp" / "probe.cpp", tmp_path_factory.mktemp("cpp"))


@pytest.fixture
def env(probe):
    points = dict.fromkeys(("probe.count", "probe.echo", "probe.deaf"), ANYTHING)
    env = aec_env(ProcessSimulation(probe, points, timeout=10.0))
    yield env
    env.close()


def begin(env, play, **options):
    env.reset(seed=1, options={"play": play} | options)


def test_an_exception_surfaces_with_its_type_text_and_causes(env):
    for _ in range(2):
        with pytest.raises(
            RemoteError, match=r"(?s)std::runtime_error.*the pump is broken.*std::out_of_range: the cause"
        ):
            begin(env, "fail")
    begin(env, "count", times=1)
    assert env.agent_selection == "a"


def test_a_decision_of_another_type_surfaces_where_the_model_meets_it(env):
    begin(env, "number")
    with pytest.raises(
        RemoteError, match=r"simenv::JsonError: decision 1, at probe\.echo: \"what is no number\" is not"
    ):
        env.step(1)


def test_a_model_that_catches_its_errors_goes_on(env):
    begin(env, "count", times=3)
    for action in (0, 1, 0):
        env.step(action)
    assert env.agent_selection == "a"
    env.step(RULE)
    assert env.simulation.result == 2


def test_an_exit_and_a_crash_surface_with_what_they_say(env):
    with pytest.raises(ProcessDiedError, match="exited with code 3"):
        begin(env, "leave", status=3)
    with pytest.raises(ProcessDiedError, match=r"(?s)SIGABRT.*terminate called"):
        begin(env, "crash")
    begin(env, "count")


@pytest.mark.parametrize("play", ["count", "deaf"])
def test_a_model_that_is_given_up_unwinds_and_its_process_plays_on(env, play):
    begin(env, play)
    number = process(env)
    env.step(0)
    begin(env, "count", times=1)
    env.step(0)
    assert (env.simulation.result, process(env)) == (1, number)


def test_an_environment_that_is_gone_takes_its_process_along(probe):
    env = aec_env(ProcessSimulation(probe, {"probe.count": ANYTHING}))
    begin(env, "count")
    number = process(env)
    del env
    gc.collect()
    assert gone(number)


def test_arrays_and_nested_values_are_decisions(probe):
    given = {"array": np.arange(3, dtype=np.float32), "nested": [None, {"x": np.nan}], "whole": np.int64(3)}
    point = make_step(
        observation_space=spaces.Discrete(1),
        observation_space_mapping=lambda call: 0,
        action_space=spaces.Discrete(2),
        apply=lambda action, call: given,
        reward_mapping=lambda call: 0.0,
        agent="a",
    )
    done = simulate(ProcessSimulation(probe, {"probe.echo": point}), {"a": lambda observation: 0}, seed=1)
    assert repr(done.result) == repr({"array": [0.0, 1.0, 2.0], "nested": [None, {"x": float("nan")}], "whole": 3})


def process(env):
    """The number of the process of an environment."""
    return env.simulation._child.pid
