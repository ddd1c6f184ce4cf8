"""Sections 5.8 and 11 of the contract: the library's own errors, and who may catch those of a model."""

import gc
import inspect
import pickle
from functools import partial
from weakref import ref

import pytest
from greenlet import getcurrent

from simenv_marl import RULE, SimEnvError, aec_env, errors, joint_env, parallel_env, single_env
from simenv_marl.errors import ClosedError, EpisodeOverError, NotResetError, WrongThreadError
from tests.core.test_threads import in_a_thread
from tests.worlds.models import calling, decision, script, step

# -- the tree -------------------------------------------------------------------------------------

LEAVES = [value for value in vars(errors).values() if inspect.isclass(value) and issubclass(value, SimEnvError)]
BUILTINS = (ValueError, TypeError, LookupError, RuntimeError, AssertionError, ImportError, OSError)


def test_all_errors_are_public_survive_pickling_and_have_one_root():
    assert len(LEAVES) > 10
    assert SimEnvError.__mro__ == (SimEnvError, Exception, BaseException, object)
    for error in LEAVES:
        assert error is SimEnvError or issubclass(error, BUILTINS)
        assert error.__name__ in errors.__all__
        assert error.__doc__
        made = error("what, with what, what to do")
        made.add_note("decision 3")
        copied = pickle.loads(pickle.dumps(made))
        assert type(copied) is error
        assert (copied.args, str(copied), copied.__notes__) == (made.args, str(made), made.__notes__)


# -- using an environment at the wrong time -------------------------------------------------------


@pytest.mark.parametrize("view", [aec_env, single_env])
def test_use_before_reset_after_the_end_and_after_close_are_errors_of_their_own(view):
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
    assert env.unwrapped.simulation.log == [1]
    env.reset()
    act()


# -- errors of the model and of its mappings ------------------------------------------------------


@pytest.mark.parametrize("action", [1, RULE])
def test_the_model_may_catch_the_errors_of_its_own_rule_and_of_apply(action):
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
    env = single_env(script(main), decide)
    env.reset()
    env.step(action)
    env.step(action)
    assert env.unwrapped.simulation.log == ["caught", "value"]


# -- threads --------------------------------------------------------------------------------------


@pytest.mark.greenlet("threads of their own may be used from any other")
@pytest.mark.parametrize("view", [aec_env, parallel_env, joint_env, single_env])
@pytest.mark.parametrize("what", ["step", "reset", "close"])
def test_using_an_environment_from_another_thread_is_a_clear_error_and_changes_nothing(what, view):
    unwound = []

    def main(simulation):
        try:
            for _ in range(3):
                simulation.log.append(decide())
        finally:
            unwound.append(True)

    decide = decision(agent="a_0")
    env = view(script(main), decide)
    env.reset()
    step(env, 1, "a_0")
    roots = []

    def use():
        roots.append(ref(getcurrent()))
        step(env, 5, "a_0") if what == "step" else getattr(env, what)()

    with pytest.raises(WrongThreadError, match='driver="thread"') as caught:
        in_a_thread(use)
    assert isinstance(caught.value, RuntimeError)
    # Else the collector crashes in greenlet. So it does if a variable has the root: here is only a weak reference.
    (root,) = roots
    assert root() is None or not gc.get_referrers(root())
    assert not unwound
    step(env, 2, "a_0")
    assert env.unwrapped.simulation.log == [1, 2]
    env.close()
    assert unwound == [True]
