"""Messages are short, and what they tell of never takes the place of what is wrong."""

import gc
from contextlib import contextmanager

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import (
    SimEnvError,
    aec_env,
    branch,
    difference,
    joint_env,
    parallel_env,
    simulate_many,
    single_env,
    vector_env,
)
from simenv_marl.data import collect_episodes
from simenv_marl.errors import (
    LONGEST,
    AgentError,
    DefinitionError,
    HandlerError,
    InvalidActionError,
    ObservationError,
    OptionValueError,
    RewardError,
    SimulationError,
    UnknownPointError,
    annotate,
    describe_error,
    error_text,
    short_repr,
)
from simenv_marl.experiments import Variant
from simenv_marl.plugins import attach_handler, handlers
from tests.worlds.models import PAIR, Script, calling, decision, define, notes, play, script


@contextmanager
def refused(error):
    """A context that raises that error, whose message shows some values in short."""
    with pytest.raises(error) as caught:
        yield caught
    assert len(str(caught.value)) < 1000


class Broken:
    """Has no ``repr``."""

    def __repr__(self):
        raise LookupError("no looks, please")


class Worse(Broken):
    """... and what it returns would be no text."""

    def __repr__(self):
        return 3


class BrokenError(Exception):
    def __repr__(self):
        raise LookupError("no looks, please")

    __str__ = __repr__


# -- values -----------------------------------------------------------------------------------------

UNWIELDY = {
    "broken": Broken,
    "worse": Worse,
    "within": lambda: [Broken()],
    "list": lambda: [0.5] * 10**6,
    "tuple": lambda: (0.5,) * 10**6,
    "nested": lambda: [[[0.5] * 100] * 100] * 100,
    "dict": lambda: dict.fromkeys(range(10**6)),
    "text": lambda: "x" * 10**6,
    "bytes": lambda: b"x" * 10**6,
    "array": lambda: np.zeros(10**6),
    "objects": lambda: np.array([Broken(), Broken()]),
    "integer": lambda: 10**10_000,
    "surrogates": lambda: "\ud800",
}

unwieldy = pytest.mark.parametrize("make", UNWIELDY.values(), ids=UNWIELDY)


@unwieldy
def test_any_value_is_shown_in_short(make):
    assert 0 < len(short_repr(make())) <= LONGEST
    assert len(short_repr(make(), 60)) <= 60
    short_repr(make()).encode()


def test_short_values_are_shown_as_they_are():
    for value in (1.5, "text", [1, 2.0, None], {"b": 1, "a": (2,)}, np.arange(3), spaces.Discrete(3)):
        assert sorted(short_repr(value)) == sorted(repr(value))  # keys may be sorted


def test_the_text_of_an_error_may_be_missing():
    assert describe_error(ValueError("bad")) == "ValueError: bad"
    assert describe_error(BrokenError()) == f"BrokenError: {error_text(BrokenError())}"


@unwieldy
@pytest.mark.parametrize("view", [aec_env, single_env, parallel_env, joint_env])
def test_an_action_that_is_none_is_refused_in_short_whatever_it_looks_like(view, make):
    decide = decision(action_space=spaces.MultiDiscrete([3, 3]))
    env = view(calling(decide), decide)
    env.reset(seed=1)
    together = view in (parallel_env, joint_env)
    with refused(InvalidActionError):
        env.step({"choose_0": make()} if together else make())
    env.step({"choose_0": [1, 1]} if together else [1, 1])
    env.close()


@unwieldy
def test_actions_of_many_are_refused_in_short(make):
    decide = decision()
    envs = vector_env(calling(decide), decide, num_envs=2)
    envs.reset(seed=1)
    with refused(InvalidActionError):
        envs.step(make())
    with refused(InvalidActionError):
        simulate_many(calling(decide), {decide: lambda observations: make()}, seeds=range(3))
    envs.close()


@unwieldy
@pytest.mark.parametrize(
    ("name", "error"),
    [("observation_space_mapping", ObservationError), ("reward_mapping", RewardError), ("agent", AgentError)],
)
def test_what_mappings_return_is_refused_in_short(name, error, make):
    if name == "agent" and isinstance(make(), str):
        return  # which is a name
    changes = {
        "observation_space": spaces.Dict({"level": PAIR}),
        "observation_space_mapping": lambda: {"level": [0, 0]},
    }
    decide = decision(**changes | {name: lambda: make()})
    env = aec_env(calling(decide, decide), decide)
    with refused(error) as caught:
        play(env, 1, seed=4)
    assert "seed 4" in notes(caught.value)


DECIDE = decision()


def env_with(**options):
    return aec_env(calling(print), DECIDE, **options)


@pytest.mark.parametrize("make", [Broken, lambda: [[Broken()] * 10**6]])
@pytest.mark.parametrize(
    ("use", "error"),
    [
        (lambda thing: env_with(max_steps=thing), OptionValueError),
        (lambda thing: env_with(driver=thing), OptionValueError),
        (lambda thing: env_with(policies={1: thing}), OptionValueError),
        (lambda thing: env_with(plugins=[thing]), HandlerError),
        (lambda thing: env_with(render_mode=thing), OptionValueError),
        (lambda thing: env_with().reset(seed=thing), OptionValueError),
        (lambda thing: aec_env(thing, DECIDE), SimulationError),
        (lambda thing: Variant(thing, Script), OptionValueError),
        (lambda thing: branch(thing, print), SimEnvError),
        (lambda thing: collect_episodes(Script, thing, seeds=[1]), OptionValueError),
        (lambda thing: define(observation_space=thing), DefinitionError),
        (lambda thing: define(reward_mapping=thing), DefinitionError),
        (lambda thing: difference(thing), DefinitionError),
        (lambda thing: attach_handler(thing, f"{__name__}.Broken.__repr__", "before"), HandlerError),
        (lambda thing: attach_handler(print, f"{__name__}.Broken.__repr__", thing), HandlerError),
    ],
)
def test_what_cannot_be_an_argument_is_refused_in_short(use, error, make):
    with refused(error):
        use(make())


# -- errors -----------------------------------------------------------------------------------------


@pytest.mark.usefixtures("_collected")
def test_an_error_without_looks_is_no_obstacle_to_the_first_one():
    """It is raised while the simulation is unwound for another."""

    def main(simulation):
        try:
            decide()
        finally:
            raise BrokenError

    decide = decision(observation_space_mapping=lambda: "nothing")
    env = aec_env(script(main), decide)
    with pytest.raises(ObservationError) as caught:
        env.reset(seed=4)
    assert "unwinding the simulation raised" in notes(caught.value)
    decide = decision()
    env = single_env(script(main), decide)
    env.reset()
    env.itself = env  # so that it goes with the collector
    del env
    with pytest.warns(ResourceWarning, match="abandoned raised"):
        gc.collect()
    envs = vector_env(script(main), decide, num_envs=2)
    envs.reset()
    with pytest.raises(BrokenError):
        envs.close()


def test_handlers_and_policies_without_looks_are_told_of():
    class Handler(Broken):
        def __call__(self, *args, **kwargs):
            raise ZeroDivisionError

    decide = decision()
    env = aec_env(calling(decide), decide, plugins=[(Handler(), decide, "before")])
    for use in (env.reset, lambda: simulate_many(calling(decide), {decide: Handler()}, seeds=[1])):
        with pytest.raises(ZeroDivisionError) as caught:
            use()
        assert "simenv_marl: in" in notes(caught.value)
    with handlers((Handler(), decide, "before")), pytest.raises(ZeroDivisionError):
        decide()
    with pytest.raises(UnknownPointError):
        aec_env(calling(decide), decide, policies={Handler(): print})


class Anything(Exception):
    """Notes may be anything."""

    def __init__(self, notes):
        super().__init__()
        self.__notes__ = notes


class NoAttributes(Exception):
    __dict__ = property(lambda self: 1 / 0)

    def add_note(self, note):
        raise LookupError("no notes, please")


class NoNotes(NoAttributes):
    __notes__ = property(lambda self: 1 / 0)


@pytest.mark.parametrize(
    "make",
    [
        *(lambda given=given: Anything(given) for given in ("text", 3, None, ("one",), {}, [3], Broken())),
        NoNotes,
        NoAttributes,
        BrokenError,
    ],
)
@pytest.mark.parametrize("where", ["model", "mapping", "handler", "reset", "unwinding", "several"])
def test_an_error_stays_itself_whatever_is_in_the_place_of_its_notes(make, where):
    annotate(make(), "a note")
    error = make()

    def fail(*_, **__):
        raise error

    def main(simulation):
        try:
            decide()
            if where == "model":
                fail()
            decide()
        finally:
            if where in ("unwinding", "several"):
                fail()

    class Model(Script):
        def reset(self, seed=None, options=None):
            super().reset(seed, options)
            if where == "reset":
                fail()

    decide = decision(reward_mapping=fail if where in ("mapping", "several") else lambda *_: 0.0)
    plugins = [(fail, decide, "before")] if where == "handler" else []
    env = aec_env(lambda: Model(main), decide, plugins=plugins)

    def use():
        env.reset()
        env.step(1)
        env.close()

    with pytest.raises(type(error)) as caught:
        use()
    assert caught.value is error
