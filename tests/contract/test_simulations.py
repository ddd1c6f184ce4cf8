"""Sections 2 and 5.1 of the contract: how a simulation is made, reset, seeded and ended."""

import threading

import numpy as np
import pytest

from simenv_marl import (
    TRUNCATED,
    SimulationInterface,
    aec_env,
    generate_env,
    joint_env,
    parallel_env,
    single_env,
)
from simenv_marl.errors import NoDecisionError, NotResetError, OptionValueError, SimulationError
from tests.worlds.models import (
    Script,
    begun,
    calling,
    decision,
    decisions,
    define,
    plainly,
    play,
    script,
)

# -- sources --------------------------------------------------------------------------------------


class Model:
    @define()
    def decide(self):
        return 0


class Simulation(SimulationInterface):
    def __init__(self):
        self.parts = ["as made"]
        self.resets = 0

    def reset(self):
        self.resets += 1
        self.model = Model()

    def run(self):
        for _ in range(2):
            self.parts.append(self.model.decide())


def test_env_copies_a_simulation_instance_when_it_is_made():
    original = Simulation()
    original.parts.append("grown")
    one, two = aec_env(original, Model.decide), aec_env(original, Model.decide)
    original.parts.append("too late")
    play(one, 4)
    play(two, 5)
    assert original.resets == 0
    assert not hasattr(original, "model")
    assert original.parts == ["as made", "grown", "too late"]
    assert one.simulation.parts == ["as made", "grown", 4, 4]
    assert two.simulation.parts == ["as made", "grown", 5, 5]


@pytest.mark.parametrize("named", [True, False], ids=["points", "points of the simulation"])
@pytest.mark.parametrize("kind", ["class", "factory"])
def test_env_makes_its_simulation_once_and_resets_it_per_episode(kind, named):
    made = []

    class Counted(Simulation):
        points = None if named else [Model.decide]

        def __init__(self):
            super().__init__()
            made.append(self)

    env_class = generate_env(
        Counted if kind == "class" else lambda: Counted(), Model.decide if named else None
    )
    env = env_class()
    simulation = env.simulation
    assert made == [simulation]
    for number in (1, 2, 3):
        env.reset()
        assert simulation.resets == number
        env.step(1)
    env.close()
    env.reset()
    assert env.simulation is simulation
    others = [env_class(), env_class(max_steps=3)]
    assert made == [simulation, *(other.simulation for other in others)]


def test_env_accepts_any_object_with_run_and_reset_as_a_simulation():
    class Duck:
        __slots__ = ("log",)

        def reset(self):
            self.log = []

        def run(self):
            self.log.append(Model().decide())

    class Derived(Duck, SimulationInterface):
        pass

    for source in (Duck, Duck(), lambda: Duck(), Derived):
        env = begun(single_env(source, Model.decide))
        env.reset()  # in mid-episode, without a stop
        env.step(3)
        assert env.simulation.log == [3]
    with pytest.raises(TypeError):
        SimulationInterface()


class NoReset:
    def run(self):
        pass


class NoRun:
    def reset(self):
        pass


class Lockable(Simulation):
    def __init__(self):
        super().__init__()
        self.lock = threading.Lock()


@pytest.mark.parametrize(
    "source",
    [3, "Simulation", None, NoReset(), NoReset, NoRun, NoRun(), lambda: None, Lockable()],
    ids=plainly,
)
def test_env_refuses_objects_without_run_and_reset(source):
    with pytest.raises(SimulationError, match="simulation"):
        single_env(source, Model.decide)


# -- seeds and options ----------------------------------------------------------------------------


def recording(reset_of):
    class Recording:
        def __init__(self):
            self.got = []

        reset = reset_of

        def run(self):
            Model().decide()

    return Recording


def reset_seed(self, seed=None):
    self.got.append(seed)


SIZE = {"size": 3}


@pytest.mark.parametrize(
    ("reset", "given", "expected"),
    [
        (lambda self: self.got.append({}), SIZE, {}),
        (lambda self, seed: self.got.append({"seed": seed}), SIZE, {"seed": 7}),
        (lambda self, seed=None, options=None: self.got.append((seed, options)), SIZE, (7, SIZE)),
        (lambda self, seed=None, options=None: self.got.append((seed, options)), None, (7, None)),
        (
            lambda self, *, seed=None, options=None: self.got.append((seed, options)),
            SIZE,
            (7, SIZE),
        ),
        (lambda self, **keywords: self.got.append(keywords), SIZE, {"seed": 7, "options": SIZE}),
        (lambda self, options=None: self.got.append({"options": options}), SIZE, {"options": SIZE}),
    ],
)
def test_simulation_reset_gets_only_the_parameters_it_declares(reset, given, expected):
    env = single_env(recording(reset), Model.decide)
    env.reset(seed=7, options=given)
    assert env.simulation.got == [expected]


def seeds_of(env):
    return env.simulation.got


def test_env_reset_without_a_seed_draws_one_or_derives_it_from_the_last():
    one, two, three = (
        make(recording(reset_seed), Model.decide) for make in (aec_env, single_env, aec_env)
    )
    for env in (one, two):
        env.reset()
    assert seeds_of(one) != seeds_of(two)
    for seed in (5, np.int64(5), 0, 2**40):
        for env in (one, two, three):
            env.reset(seed=seed)
            for _ in range(3):
                env.reset()
    seeds = seeds_of(three)
    assert seeds_of(one)[1:] == seeds_of(two)[1:] == seeds
    assert seeds[:4] == seeds[4:8]
    assert (seeds[0], seeds[8], seeds[12]) == (5, 0, 2**40)
    assert len(set(seeds)) == 12
    assert {type(seed) for seed in [*seeds_of(one), *seeds]} == {int}


@pytest.mark.parametrize("seed", [-1, 1.5, "1", [1]])
def test_env_reset_refuses_invalid_seeds_before_it_resets_the_model(seed):
    env = begun(single_env(recording(reset_seed), Model.decide), 1)
    with pytest.raises(OptionValueError, match="seed must be a non-negative"):
        env.reset(seed=seed)
    assert seeds_of(env) == [1]
    env.step(3)


def test_env_reset_seeds_action_spaces_in_use_and_later_ones():
    points = [decision(agent="a_0"), decision(agent="b_0")]
    one, two = (aec_env(calling(*points), points) for _ in range(2))
    before = {agent: two.action_space(agent) for agent in ("a_0", "b_0")}
    singles = [single_env(calling(points[0]), points[0]) for _ in range(2)]
    for env in (one, two, *singles):
        env.reset(seed=3)
    for agent, space in before.items():
        assert two.action_space(agent) is space
        assert samples(one.action_space(agent)) == samples(space)
    drawn, again = (samples(env.action_space) for env in singles)
    assert drawn == again


def samples(space):
    return [space.sample() for _ in range(8)]


# -- ends -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ends", "truncated"),
    [(None, False), (TRUNCATED, True), (True, False), (0, False), ("truncated", False)],
)
def test_episode_ends_when_the_models_run_returns(ends, truncated):
    decide = decision()
    env = begun(single_env(calling(decide, ends=ends), decide))
    flags = env.step(1)[2:4]
    assert flags == (not truncated, truncated)
    assert [type(flag) for flag in flags] == [bool, bool]


def test_env_calls_the_models_stop_only_to_abort_an_episode():
    class Stoppable(Script):
        stops = 0

        def stop(self):
            self.stops += 1

    decide = decision()
    env = begun(single_env(lambda: Stoppable(lambda simulation: decide()), decide))
    env.step(1)
    for use, stops in ((env.reset, 0), (env.reset, 1), (env.close, 2), (env.close, 2)):
        use()
        assert env.simulation.stops == stops


@pytest.mark.parametrize("make", [aec_env, single_env])
def test_env_reset_raises_an_error_if_an_episode_has_no_decision(make):
    decide, calls = decision(), []
    env = make(script(lambda simulation: [call() for call in calls]), decide)
    with pytest.raises(NoDecisionError, match="without a decision"):
        env.reset()
    with pytest.raises(NotResetError, match="no episode yet"):
        env.step(1)
    calls.append(decide)
    env.reset()
    env.step(1)
    calls.clear()
    with pytest.raises(NoDecisionError, match="without a decision"):
        env.reset()


# -- decisions where nobody can be asked ----------------------------------------------------------


def test_decisions_in_reset_stop_or_render_follow_the_models_rule():
    class Curious(Script):
        def __init__(self):
            super().__init__(lambda simulation: simulation.log.append(Model().decide()))
            self.seen = [Model().decide()]

        def reset(self, seed=None, options=None):
            super().reset(seed, options)
            self.seen.append(Model().decide())

        def stop(self):
            self.seen.append(Model().decide())

        def render(self, mode):
            self.seen.append(Model().decide())
            return mode

    env = aec_env(Curious, Model.decide, render_mode="ansi")
    simulation = env.simulation
    env.reset()
    assert env.render() == "ansi"
    env.step(5)
    assert simulation.log == [5]
    env.reset()
    env.close()
    assert simulation.seen == [0] * 5


def test_decisions_in_mappings_and_policies_follow_the_models_rule():
    seen = []

    def ask(*args, answer=None):
        seen.append(Model().decide())
        return args[0] if answer is None else answer

    decide = decision(
        observation_space_mapping=lambda: ask(answer=[0, 0]),
        reward_mapping=lambda: ask(0.0),
        action_space_mapping=ask,
        action_mask_mapping=lambda: ask(answer=[1] * 10),
        agent=lambda: f"agent_{ask(0)}",
    )
    other = decision(agent="other_0")
    policies = {Model.decide: lambda observation: 7, other: lambda observation: ask(1)}
    env = aec_env(calling(decide, other, decide), [decide, other, Model.decide], policies=policies)
    assert decisions(play(env, 3)) == ["agent_0", "agent_0"]
    assert set(seen) == {0}
    assert env.simulation.log == [3, 1, 3]


# -- attributes and methods of the model's own ----------------------------------------------------

OPTIONAL = ("time", "close", "stop", "expected_calls", "state", "render", "reseed")
OTHERS = {
    "numbers": dict.fromkeys(OPTIONAL, 3.5),
    "texts": dict.fromkeys(OPTIONAL, "open"),
    "methods": {
        name: lambda self, one, two: 1 / 0 for name in OPTIONAL if name != "expected_calls"
    },
    "properties": {name: property(lambda self: 1 / 0) for name in OPTIONAL},
}


@pytest.mark.parametrize("own", OTHERS.values(), ids=OTHERS)
@pytest.mark.parametrize("make", [aec_env, parallel_env, joint_env])
def test_env_ignores_attributes_named_like_a_models_optional_methods(make, own):
    env = make(type("Own", (Simulation,), own), Model.decide)
    with pytest.raises(NotImplementedError, match=r"has no method state\(\)"):
        env.unwrapped.state()
    for _ in range(2):  # the second reset stops the first episode
        env.reset(seed=1)
    if make is aec_env:
        env.step(1)
        assert "time" not in env.last()[4]
    env.close()
    with pytest.warns(UserWarning, match="it has none"):
        make(type("Own", (Simulation,), own), Model.decide, render_mode="human")
    with pytest.raises(OptionValueError, match=r"has no method time\(\)"):
        make(type("Own", (Simulation,), own), Model.decide, discount_rate=1.0).reset()


def test_env_ignores_attributes_that_reset_names_like_optional_methods():
    class Own(Simulation):
        def reset(self):
            super().reset()
            self.time = 0.0
            self.state = "open"
            self.stop = self.close = None

    env = begun(aec_env(Own, Model.decide))
    env.reset()
    assert "time" not in env.last()[4]
    env.close()


def test_env_accepts_optional_model_methods_with_default_parameters():
    log = []

    class Own(Simulation):
        def time(self, unit="h"):
            return 2.0

        def stop(self, *reasons):
            log.append("stop")

        def close(self, *, last=False, force=False):
            log.append(("close", last))

        def render(self, mode, size=3):
            return mode

    env = begun(aec_env(Own, Model.decide, render_mode="ansi"))
    assert env.last()[4]["time"] == 2.0
    assert env.render() == "ansi"
    env.close()
    assert log == ["stop", ("close", True)]


@pytest.mark.parametrize("method", [lambda self: [], lambda self, point, number: []])
def test_env_refuses_expected_calls_without_its_parameter(method):
    kind = type("Own", (Simulation,), {"expected_calls": method})
    with pytest.raises(SimulationError, match=r"def expected_calls\(self, point\)"):
        aec_env(kind, Model.decide)


async def _wait(self):
    Model().decide()


def _yield(self):
    yield Model().decide()


async def _do_both(self):
    yield Model().decide()


@pytest.mark.parametrize("name", ["run", "reset"])
@pytest.mark.parametrize(
    ("function", "kind", "line"),
    [
        (_wait, "a coroutine function", "asyncio.run(self.{}_model())"),
        (_yield, "a generator function", "for _ in self.{}_model(): pass"),
        (_do_both, "an async generator function", "async for _ in self.{}_model(): pass"),
    ],
)
def test_env_refuses_a_generator_or_coroutine_as_run_or_reset(function, kind, line, name):
    model = type("Own", (Simulation,), {name: function})
    for source in (model, model(), lambda: model()):
        with pytest.raises(SimulationError, match=rf"{name}\(\) of Own is {kind}") as raised:
            aec_env(source, Model.decide)
        assert f"def {name}(self): " in str(raised.value)
        assert line.format(name) in str(raised.value)
