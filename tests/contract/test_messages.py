"""Messages are short, and what they tell of never takes the place of what is wrong."""

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import aec_env, joint_env, parallel_env, single_env
from simenv_marl.errors import (
    LONGEST,
    AgentError,
    InvalidActionError,
    ObservationError,
    RewardError,
    describe_error,
    error_text,
    short_repr,
)
from tests.worlds.models import calling, decision, notes, play, script, step

LONGEST_MESSAGE = 1000


class Broken:
    """Has no ``repr``."""

    def __repr__(self):
        raise LookupError("no looks, please")


class BrokenError(Exception):
    def __repr__(self):
        raise LookupError("no looks, please")

    __str__ = __repr__


# -- values -----------------------------------------------------------------------------------------

UNWIELDY = {
    "broken": Broken,
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


def test_short_values_and_errors_are_shown_as_they_are():
    for value in (1.5, "text", [1, 2.0, None], {"b": 1, "a": (2,)}, np.arange(3), spaces.Discrete(3)):
        assert sorted(short_repr(value)) == sorted(repr(value))  # keys may be sorted
    assert describe_error(ValueError("bad")) == "ValueError: bad"
    assert describe_error(BrokenError()) == f"BrokenError: {error_text(BrokenError())}"


@unwieldy
@pytest.mark.parametrize("view", [aec_env, single_env, parallel_env, joint_env])
def test_an_action_that_is_none_is_refused_in_short_whatever_it_looks_like(view, make):
    decide = decision(action_space=spaces.MultiDiscrete([3, 3]))
    env = view(calling(decide), decide)
    env.reset(seed=1)
    with pytest.raises(InvalidActionError) as caught:
        step(env, make(), "choose_0")
    assert len(str(caught.value)) < LONGEST_MESSAGE
    step(env, [1, 1], "choose_0")


@unwieldy
@pytest.mark.parametrize(
    ("name", "error"),
    [("observation_space_mapping", ObservationError), ("reward_mapping", RewardError), ("agent", AgentError)],
)
def test_invalid_results_of_mappings_are_refused_with_short_messages(name, error, make):
    if name == "agent" and isinstance(make(), str):
        return  # which is a name
    decide = decision(**{name: lambda: make()})
    env = aec_env(calling(decide, decide), decide)
    with pytest.raises(error) as caught:
        play(env, 1, seed=4)
    assert len(str(caught.value)) < LONGEST_MESSAGE
    assert "seed 4" in notes(caught.value)


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


@pytest.mark.parametrize("given", ["text", 3, None, ("one",), {}, [3], Broken()])
def test_an_error_stays_itself_whatever_is_in_the_place_of_its_notes(given):
    def fail(*_):
        error.__notes__ = given
        raise error

    error = RuntimeError()
    decide = decision(reward_mapping=fail)
    env = aec_env(calling(decide, decide), decide)
    with pytest.raises(RuntimeError) as caught:
        play(env, 1)
    assert caught.value is error
