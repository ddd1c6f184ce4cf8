"""Sections 5.8 and 11 of the contract: errors surface as themselves, say where, and leave the next reset working."""

import gc
import inspect
import pickle
import re
import threading
from concurrent.futures import ThreadPoolExecutor
from weakref import ref

import pytest
from greenlet import getcurrent

from simenv_marl import RULE, SimEnvError, aec_env, errors, joint_env, parallel_env, single_env
from simenv_marl.errors import ClosedError, EpisodeOverError, NotResetError, ResetNeededError, WrongThreadError
from tests.core.test_threads import in_a_thread
from tests.worlds.models import calling, culprits, decision, notes, play, script, step

VIEWS = pytest.mark.parametrize("view", [aec_env, single_env])
ALL_VIEWS = pytest.mark.parametrize("view", [aec_env, parallel_env, joint_env, single_env])

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


@VIEWS
def test_use_before_reset_after_the_end_and_after_close_are_errors_of_their_own(view):
    def refuses(kind, match, *uses):
        assert issubclass(kind, ResetNeededError)
        assert issubclass(kind, RuntimeError)
        for use in (*uses, *uses):
            with pytest.raises(kind, match=match):
                use()

    def act():
        env.step(1)

    def observe():
        env.observe("choose_0")

    decide = decision()
    env = view(calling(decide), decide)
    looks = [env.last, observe] if view is aec_env else []
    refuses(NotResetError, "no episode yet", act, *looks)
    for _ in range(2):
        env.close()
        env.close()
        refuses(ClosedError, "call reset", act, *looks)
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


def test_agents_books_are_empty_after_an_error_and_after_close():
    decide = decision(lambda: 1 / 0, agent="choose_0")
    env = aec_env(calling(decide), decide)
    env.reset()
    assert env.agents == ["choose_0"]
    with pytest.raises(ZeroDivisionError):
        env.step(RULE)
    assert env.agents == []
    assert env.rewards == env.terminations == env.truncations == env.infos == {}
    env.reset()
    env.close()
    assert env.agents == []


# -- errors of the model and of its mappings ------------------------------------------------------


class Culprit(Exception):
    """An error that nobody but the tests raises."""


class Bomb:
    """Explodes at the given one of its calls; is defused after that."""

    def __init__(self, at, value=None):
        self.at, self.value, self.calls = at, value, 0

    def __call__(self, *args, **kwargs):
        self.calls += 1
        if self.calls == self.at:
            raise Culprit("boom")
        return self.value(*args, **kwargs) if callable(self.value) else self.value


def play_to_the_end(env, seed, answered):
    """Play an episode of either view; write down each answer just before it is given."""
    env.reset(seed=seed)
    while True:
        answered.append(True)
        result = env.step(1)
        if any(env.terminations.values()) if result is None else result[2]:
            return


def surfaces(use, *args):
    """Have a bomb explode; return its error."""
    with pytest.raises(Culprit) as caught:
        use(*args)
    error = caught.value
    assert error.args == ("boom",)
    assert culprits(error)[-1] == "__call__"
    assert "4711" in notes(error)
    assert isinstance(pickle.loads(pickle.dumps(error)), Culprit)
    return error


def goes_on(env):
    """The episode is over, and the next reset works."""
    with pytest.raises(ResetNeededError, match="call reset"):
        env.step(1)
    play_to_the_end(env, 1, [])


VALUES = {
    "observation_space_mapping": [0.0, 0.0],
    "reward_mapping": 0.0,
    "action_mask_mapping": [1] * 10,
    "agent": "culprit_0",
    "choices": [1, 2],
    "action_space_mapping": lambda action: action,
    "apply": 1,
}
"""What the mappings of a decision point return that does not fail."""


@pytest.mark.parametrize("place", [*VALUES, "rule", "model"])
@VIEWS
def test_errors_surface_as_themselves_and_tell_of_agent_and_decision(place, view):
    if place == "agent" and view is single_env:
        return
    answers = place in ("action_space_mapping", "apply", "rule", "model")  # it comes after the answer
    ends = place.endswith("mapping") and not answers  # there is a fifth, that of the end
    for at in (1, 3, 4, 5) if ends else (1, 3, 4):
        bomb, answered = Bomb(at, VALUES.get(place)), []
        decide = decision(**{"agent": "culprit_0"} | ({place: bomb} if place in VALUES else {}))
        other = {"rule": decision(lambda bomb=bomb: bomb()), "model": bomb}.get(place, lambda: None)
        env = view(calling(*[decide, other] * 4), decide)
        error = surfaces(play_to_the_end, env, 4711, answered)
        assert len(answered) == (at if answers else at - 1)
        if place != "agent":
            assert "culprit_0" in notes(error)
            assert at == 5 or re.search(rf"decision {at}\b", notes(error)), notes(error)
        if place == "action_space_mapping":  # nothing has moved yet
            play_to_the_end(env, 1, [])
        else:
            goes_on(env)


@pytest.mark.parametrize("place", [name for name in VALUES if name.endswith("mapping")])
def test_errors_in_mappings_unwind_the_simulation_and_are_not_seen_by_it(place):
    def main(simulation):
        try:
            decide()
            decide()
        except Exception as error:
            seen.append(error)
        finally:
            seen.append("unwound")

    seen, decide = [], decision(**{place: Bomb(2, VALUES[place])})
    with pytest.raises(Culprit):
        play_to_the_end(single_env(script(main), decide), 1, [])
    assert seen == ["unwound"]


@pytest.mark.parametrize("action", [1, RULE])
def test_the_model_may_catch_the_errors_of_its_own_rule_and_of_apply(action):
    def main(simulation):
        for _ in range(2):
            try:
                simulation.log.append(decide())
            except Culprit:
                simulation.log.append("caught")

    bomb = Bomb(1, "value")
    decide = decision(lambda: bomb(), apply=lambda action: bomb())
    env = single_env(script(main), decide)
    env.reset()
    env.step(action)
    env.step(action)
    assert env.unwrapped.simulation.log == ["caught", "value"]


def test_causes_and_contexts_are_kept_and_none_are_added():
    def culprit():
        try:
            raise KeyError("inner")
        except KeyError as error:
            raise Culprit("outer") from error

    for rule, cause in ((culprit, KeyError), (Bomb(1), type(None))):
        decide = decision(lambda rule=rule: rule())
        env = single_env(calling(decide), decide)
        env.reset()
        with pytest.raises(Culprit) as caught:
            env.step(RULE)
        assert type(caught.value.__cause__) is type(caught.value.__context__) is cause


@pytest.mark.parametrize("seed", [31, None])  # None: it is drawn
def test_one_note_names_agent_decision_and_seed_of_the_episode(seed):
    one, other = decision(agent="one_0"), decision(agent="other_0", observation_space_mapping=Bomb(2, [0, 0]))
    env = aec_env(calling(one, other, one, one, other), [one, other])
    with pytest.raises(Culprit) as caught:
        play(env, 1, seed=seed)
    [told] = caught.value.__notes__
    assert "other_0" in told
    assert re.search(rf"seed {env.unwrapped.simulation.seed}\b", told)
    assert re.search(r"decision 5\b", told)


# -- threads --------------------------------------------------------------------------------------


@pytest.mark.greenlet("threads of their own may be used from any other")
@ALL_VIEWS
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
    with pytest.raises(WrongThreadError, match='driver="thread"') as caught:
        in_a_thread(
            lambda: (roots.append(ref(getcurrent())), step(env, 5, "a_0") if what == "step" else getattr(env, what)())
        )
    assert isinstance(caught.value, RuntimeError)
    # Else the collector crashes in greenlet. So it does if a variable has the root: here is only a weak reference.
    (root,) = roots
    assert root() is None or not gc.get_referrers(root())
    assert not unwound
    step(env, 2, "a_0")
    assert env.unwrapped.simulation.log == [1, 2]
    env.close()
    assert unwound == [True]


def test_threads_with_environments_of_their_own_do_not_meet():
    decide, barrier = decision(), threading.Barrier(4)

    def work(number):
        env = single_env(calling(*[decide] * 20), decide)
        barrier.wait()
        for _ in range(3):
            env.reset()
            while not env.step(number)[2]:
                assert decide() == in_a_thread(decide) == "rule"
        assert decide() == "rule"
        return env.unwrapped.simulation.log

    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(work, range(4))) == [[number] * 20 for number in range(4)]
