"""Sections 5.8 and 11 of the contract: the library's errors, and the handling of a model's."""

import gc
import inspect
import pickle
from functools import partial
from weakref import ref

import numpy as np
import pytest
from greenlet import getcurrent
from gymnasium import spaces

from simenv_marl import RULE, SimEnvError, aec_env, errors, single_env
from simenv_marl.errors import (
    LONGEST,
    AgentError,
    ClosedError,
    EpisodeOverError,
    InvalidActionError,
    NotResetError,
    ObservationError,
    RewardError,
    WrongThreadError,
    describe_error,
    error_text,
    short_repr,
)
from tests.core.test_threads import in_a_thread
from tests.worlds.models import (
    EVERY_VIEW,
    begun,
    calling,
    decision,
    fails,
    notes,
    play,
    script,
    step,
)

# -- the tree -------------------------------------------------------------------------------------

LEAVES = [
    value
    for value in vars(errors).values()
    if inspect.isclass(value) and issubclass(value, SimEnvError)
]
BUILTINS = {
    "CheckFailedError": AssertionError,
    "DefinitionError": ValueError,
    "InvalidActionError": ValueError,
    "MissingExtraError": ImportError,
    "NoDecisionError": RuntimeError,
    "ObservationError": ValueError,
    "OptionValueError": ValueError,
    "RewardError": ValueError,
    "SimulationError": TypeError,
    "StoreError": OSError,
    "UnknownOptionError": TypeError,
    "UnknownPointError": LookupError,
    "WrongThreadError": RuntimeError,
}


def test_all_error_classes_are_public_survive_pickling_and_have_one_base():
    assert len(LEAVES) > 10
    assert SimEnvError.__mro__ == (SimEnvError, Exception, BaseException, object)
    for error in LEAVES:
        assert error is SimEnvError or issubclass(error, tuple(BUILTINS.values()))
        assert issubclass(error, BUILTINS.get(error.__name__, SimEnvError))
        assert error.__name__ in errors.__all__
        assert error.__doc__
        made = error("what, with what, what to do")
        made.add_note("decision 3")
        copied = pickle.loads(pickle.dumps(made))
        assert type(copied) is error
        assert (copied.args, str(copied), copied.__notes__) == (
            made.args,
            str(made),
            made.__notes__,
        )


# -- using an environment at the wrong time -------------------------------------------------------


@pytest.mark.parametrize("view", [aec_env, single_env])
def test_env_refuses_steps_before_reset_after_the_end_and_after_close(view):
    def refuses(kind, match, *uses):
        for use in (*uses, *uses):
            with pytest.raises(kind, match=match):
                use()

    decide = decision()
    env = view(calling(decide), decide)
    act = partial(env.step, 1)
    looks = [env.last, partial(env.observe, "choose_0")] if view is aec_env else []
    refuses(NotResetError, "no episode yet", act, *looks)
    for _ in range(2):
        env.close()
        env.close()
        refuses(ClosedError, "call reset", act, *looks)
        assert view is not aec_env or env.agents == []
        env.reset()
    act()
    if view is aec_env:
        env.step(None)
    refuses(EpisodeOverError, "begin the next one", act, *looks[:1])
    env.close()
    refuses(ClosedError, "call reset", act, *looks)
    assert env.simulation.log == [1]
    env.reset()
    act()


# -- errors of the model and of its mappings ------------------------------------------------------


@pytest.mark.parametrize("action", [1, RULE])
def test_model_can_catch_errors_of_its_own_rule_and_of_apply(action):
    def main(simulation):
        for _ in range(2):
            try:
                simulation.log.append(decide())
            except KeyError as error:
                simulation.log.append(error.args[0])

    def fail_once():
        failed.append(True)
        return "value" if len(failed) > 1 else {}["caught"]

    failed = []
    decide = decision(lambda: fail_once(), apply=lambda action: fail_once())
    env = begun(single_env(script(main), decide))
    env.step(action)
    env.step(action)
    assert env.simulation.log == ["caught", "value"]


# -- threads --------------------------------------------------------------------------------------


@pytest.mark.greenlet("threads of their own may be used from any other")
@EVERY_VIEW
@pytest.mark.parametrize("what", ["step", "reset", "close"])
def test_env_refuses_use_from_another_thread_and_stays_intact(what, view):
    unwound = []

    def main(simulation):
        try:
            for _ in range(3):
                simulation.log.append(decide())
        finally:
            unwound.append(True)

    decide = decision(agent="a_0")
    env = begun(view(script(main), decide))
    step(env, 1, "a_0")
    roots = []

    def use():
        roots.append(ref(getcurrent()))
        step(env, 5, "a_0") if what == "step" else getattr(env, what)()

    with pytest.raises(WrongThreadError, match='driver="thread"'):
        in_a_thread(use)
    # Else the collector crashes in greenlet. So it does if a variable has the root: here is only a
    # weak reference.
    (root,) = roots
    assert root() is None or not gc.get_referrers(root())
    assert not unwound
    step(env, 2, "a_0")
    assert env.simulation.log == [1, 2]
    env.close()
    assert unwound == [True]


# -- messages: short, and never in the place of what is wrong ------------------------------------

LONGEST_MESSAGE = 1000


class Broken:
    """Has no ``repr``."""

    def __repr__(self):
        raise LookupError("no looks, please")


class BrokenError(Exception):
    def __repr__(self):
        raise LookupError("no looks, please")

    __str__ = __repr__


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
def test_error_messages_shorten_long_values(make):
    assert 0 < len(short_repr(make())) <= LONGEST
    assert len(short_repr(make(), 60)) <= 60
    short_repr(make()).encode()


def test_error_messages_show_short_values_unchanged():
    for value in (
        1.5,
        "text",
        [1, 2.0, None],
        {"b": 1, "a": (2,)},
        np.arange(3),
        spaces.Discrete(3),
    ):
        assert sorted(short_repr(value)) == sorted(repr(value))  # keys may be sorted
    assert describe_error(ValueError("bad")) == "ValueError: bad"
    assert describe_error(BrokenError()) == f"BrokenError: {error_text(BrokenError())}"


@unwieldy
@EVERY_VIEW
def test_error_for_a_huge_action_is_short(view, make):
    decide = decision(action_space=spaces.MultiDiscrete([3, 3]))
    env = begun(view(calling(decide), decide), 1)
    with pytest.raises(InvalidActionError) as caught:
        step(env, make(), "choose_0")
    assert len(str(caught.value)) < LONGEST_MESSAGE
    step(env, [1, 1], "choose_0")


@unwieldy
@pytest.mark.parametrize(
    ("name", "error"),
    [
        ("observation_space_mapping", ObservationError),
        ("reward_mapping", RewardError),
        ("agent", AgentError),
    ],
)
def test_env_refuses_invalid_results_of_mappings_with_short_messages(name, error, make):
    if name == "agent" and isinstance(make(), str):
        return  # which is a name
    decide = decision(**{name: lambda: make()})
    env = aec_env(calling(decide, decide), decide)
    with pytest.raises(error) as caught:
        play(env, 1, seed=4)
    assert len(str(caught.value)) < LONGEST_MESSAGE
    assert "seed 4" in notes(caught.value)


@pytest.mark.usefixtures("_collected")
def test_model_error_whose_repr_fails_does_not_hide_the_first_error():
    """It is raised while the simulation is unwound for another."""

    def main(simulation):
        try:
            decide()
        finally:
            raise BrokenError

    decide = decision(observation_space_mapping=lambda: "nothing")
    env = aec_env(script(main), decide)
    with fails(ObservationError, "unwinding the simulation raised"):
        env.reset(seed=4)


@pytest.mark.parametrize("given", ["text", 3, None, ("one",), {}, [3], Broken()])
def test_env_step_raises_a_model_error_with_malformed_notes_unchanged(given):
    def fail(*_):
        error.__notes__ = given
        raise error

    error = RuntimeError()
    decide = decision(reward_mapping=fail)
    env = aec_env(calling(decide, decide), decide)
    with pytest.raises(RuntimeError) as caught:
        play(env, 1)
    assert caught.value is error
