"""Sections 5.8 and 11 of the contract: errors surface as themselves, say where, and leave the next reset working."""

import inspect
import pickle
import re
import threading

import pytest
from gymnasium import spaces

from simenv_marl import RULE, SimEnvError, aec_env, errors, joint_env, parallel_env, single_env
from simenv_marl.errors import (
    ClosedError,
    EpisodeOverError,
    InvalidActionError,
    NotResetError,
    ResetNeededError,
    WrongThreadError,
)
from tests.core.test_threads import in_a_thread
from tests.worlds.models import Script, calling, culprits, decision, decisions, define, notes, play, script, step

VIEWS = pytest.mark.parametrize("view", [aec_env, parallel_env, joint_env, single_env])

# -- the tree -------------------------------------------------------------------------------------

LEAVES = [value for value in vars(errors).values() if inspect.isclass(value) and issubclass(value, SimEnvError)]
BUILTINS = (ValueError, TypeError, LookupError, RuntimeError, AssertionError, ImportError, OSError)


def test_all_errors_are_public_and_have_one_root():
    assert len(LEAVES) > 10
    assert SimEnvError.__mro__ == (SimEnvError, Exception, BaseException, object)
    for error in LEAVES:
        assert error is SimEnvError or issubclass(error, BUILTINS)
        assert error.__name__ in errors.__all__
        assert error.__doc__


@pytest.mark.parametrize("error", LEAVES)
def test_errors_survive_pickling_their_notes_included(error):
    made = error("what, with what, what to do")
    made.add_note("decision 3")
    copied = pickle.loads(pickle.dumps(made))
    assert type(copied) is error
    assert copied.args == made.args
    assert str(copied) == str(made)
    assert copied.__notes__ == ["decision 3"]


def test_raised_errors_survive_pickling():
    decide = decision()
    env = single_env(calling(decide), decide)
    env.reset(seed=77)
    with pytest.raises(InvalidActionError, match="is not in its action space") as caught:
        env.step(99)
    copied = pickle.loads(pickle.dumps(caught.value))
    assert str(copied) == str(caught.value)
    assert "99" in str(copied)
    assert "Discrete(10)" in str(copied)
    assert notes(copied) == notes(caught.value)


# -- using an environment at the wrong time -------------------------------------------------------


@pytest.mark.parametrize("make", [aec_env, single_env])
def test_steps_before_reset_after_the_end_and_after_close_are_errors_of_their_own(make):
    decide = decision()
    env = make(calling(decide), decide)
    with pytest.raises(NotResetError, match="reset"):
        env.step(1)
    env.reset()
    env.step(1)
    if make is aec_env:
        env.step(None)
    for _ in range(2):
        with pytest.raises(EpisodeOverError, match="reset"):
            env.step(1)
    env.close()
    for _ in range(2):
        with pytest.raises(ClosedError, match="reset"):
            env.step(1)
    env.reset()
    env.step(1)
    kinds = {NotResetError, EpisodeOverError, ClosedError}
    assert all(issubclass(kind, ResetNeededError) and issubclass(kind, RuntimeError) for kind in kinds)


def test_looking_before_reset_after_the_end_and_after_close_are_errors_too():
    decide = decision()
    env = aec_env(calling(decide), decide)
    looks = [env.last, lambda: env.observe("choose_0")]
    for look in looks:
        with pytest.raises(NotResetError, match="no episode yet"):
            look()
    env.reset()
    env.step(1)
    env.step(None)
    with pytest.raises(EpisodeOverError, match="begin the next one"):
        env.last()
    env.close()
    for look in looks:
        with pytest.raises(ClosedError, match="call reset"):
            look()


@pytest.mark.parametrize("make", [aec_env, single_env])
def test_closing_before_the_first_reset_or_in_mid_episode_is_an_error_of_its_own_too(make):
    decide = decision()
    env = make(calling(decide, decide), decide)
    for _ in range(2):
        env.close()
        env.close()
        with pytest.raises(ClosedError, match="call reset"):
            env.step(1)
        env.reset()
    env.step(1)


@pytest.mark.parametrize("make", [aec_env, single_env])
def test_agents_books_are_empty_after_an_error_and_after_close(make):
    decide = decision(lambda: 1 / 0, agent="choose_0")
    env = make(calling(decide), decide)
    env.reset()
    with pytest.raises(ZeroDivisionError):
        env.step(RULE)
    with pytest.raises(EpisodeOverError, match="begin the next one"):
        env.step(1)
    if make is aec_env:
        assert env.agents == []
        assert env.rewards == env.terminations == env.truncations == env.infos == {}
    env.reset()
    if make is aec_env:
        assert env.agents == ["choose_0"]
        env.close()
        assert env.agents == []


# -- errors of the model and of its mappings ------------------------------------------------------


class Culprit(Exception):
    """An error that nobody but the tests raises."""


class Bomb:
    """Explodes at the given one of its calls; is defused after that."""

    def __init__(self, at, value=None):
        self.at, self.value, self.calls = at, value, 0

    def culprit(self):
        self.calls += 1
        if self.calls == self.at:
            raise Culprit("boom")

    def __call__(self, *args, **kwargs):
        self.culprit()
        return self.value(*args, **kwargs) if callable(self.value) else self.value


def play_to_the_end(env, seed, answered):
    """Play an episode of either view; write down each answer just before it is given."""
    env.reset(seed=seed)
    while True:
        answered.append(True)
        result = env.step(1)
        if any(env.terminations.values()) if result is None else result[2]:
            return


def surfaces(env, *, seed=4711):
    """Play until the bomb explodes; return the error, and how many answers were given before."""
    answered = []
    with pytest.raises(Culprit) as caught:
        play_to_the_end(env, seed, answered)
    error = caught.value
    assert type(error) is Culprit
    assert error.args == ("boom",)
    assert culprits(error)[-1] == "culprit"
    assert str(seed) in notes(error)
    assert isinstance(pickle.loads(pickle.dumps(error)), Culprit)
    return error, len(answered)


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
@pytest.mark.parametrize("view", [aec_env, single_env])
def test_errors_surface_as_themselves_and_tell_of_agent_and_decision(place, view):
    if place == "agent" and view is single_env:
        return
    answers = place in ("action_space_mapping", "apply", "rule", "model")  # it comes after the answer
    ends = place.endswith("mapping") and not answers  # there is a fifth, that of the end
    for at in (1, 3, 4, 5) if ends else (1, 3, 4):
        bomb = Bomb(at, VALUES.get(place))
        decide = decision(**{"agent": "culprit_0"} | ({place: bomb} if place in VALUES else {}))
        other = {"rule": decision(lambda bomb=bomb: bomb()), "model": bomb}.get(place, lambda: None)
        env = view(calling(*[decide, other] * 4), decide)
        error, answered = surfaces(env)
        assert answered == (at if answers else at - 1)
        if place != "agent":
            assert "culprit_0" in notes(error)
            assert at == 5 or re.search(rf"decision {at}\b", notes(error)), notes(error)
        if place == "action_space_mapping":  # nothing has moved yet
            play_to_the_end(env, 1, [])
        else:
            goes_on(env)


def test_errors_in_policies_surface_as_themselves():
    for policy_of in (lambda bomb: lambda observation: bomb(), lambda bomb: lambda observation, info: bomb()):
        bomb = Bomb(2, 1)
        one, two = decision(agent="one_0"), decision(agent="culprit_0")
        env = aec_env(calling(*[one, two] * 3), [one, two], policies={two: policy_of(bomb)})
        error, answered = surfaces(env)
        assert answered == 2
        assert "culprit_0" in notes(error)
        goes_on(env)


@pytest.mark.parametrize("trigger", ["close", "reset"])
@pytest.mark.parametrize("where", ["stop", "finally"])
def test_errors_while_unwinding_surface_as_themselves(where, trigger):
    unwound = []

    class Stopping(Script):
        def stop(self):
            if where == "stop":
                bomb()

    def main(simulation):
        try:
            decide()
        finally:
            unwound.append(True)
            if where == "finally":
                bomb()

    decide = decision(agent="culprit_0")
    for view in (aec_env, single_env):
        bomb = Bomb(1)
        env = view(lambda: Stopping(main), decide)
        env.reset(seed=4711)
        unwound.clear()
        with pytest.raises(Culprit) as caught:
            getattr(env, trigger)()
        assert culprits(caught.value)[-1] == "culprit"
        assert "4711" in notes(caught.value)
        assert unwound == [True]
        goes_on(env)


def test_errors_in_rendering_surface_as_themselves():
    class Rendering(Script):
        def render(self, mode):
            bomb()

    bomb, decide = Bomb(1), decision()
    env = single_env(lambda: Rendering(lambda simulation: decide()), decide, render_mode="ansi")
    env.reset()
    with pytest.raises(Culprit) as caught:
        env.render()
    assert culprits(caught.value)[-1] == "culprit"
    env.step(1)  # nothing has happened to the episode


def test_errors_in_mappings_unwind_the_simulation_and_are_not_seen_by_it():
    def main(simulation):
        try:
            decide()
            decide()
        except Exception as error:
            seen.append(error)
        finally:
            seen.append("unwound")

    for name, value in VALUES.items():
        if name.endswith("mapping"):
            seen, decide = [], decision(**{name: Bomb(2, value)})
            with pytest.raises(Culprit):
                play_to_the_end(single_env(script(main), decide), 1, [])
            assert seen == ["unwound"], name


def test_the_model_may_catch_the_errors_of_its_own_rule_and_of_apply():
    def main(simulation):
        for _ in range(2):
            try:
                simulation.log.append(decide())
            except Culprit:
                simulation.log.append("caught")

    decide = decision(lambda: bomb(), apply=lambda action: bomb())
    for action in (1, RULE):
        bomb = Bomb(1, "value")
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

    bomb = Bomb(1)
    for rule, cause in ((culprit, KeyError), (lambda: bomb(), type(None))):
        decide = decision(rule)
        env = single_env(calling(decide), decide)
        env.reset()
        with pytest.raises(Culprit) as caught:
            env.step(RULE)
        assert type(caught.value.__cause__) is type(caught.value.__context__) is cause


def test_notes_name_agent_decision_and_seed_of_the_episode():
    def culprit(name):
        if name == "c":
            raise Culprit("boom")
        return 0

    decide = decision(culprit, agent=lambda name: f"agent_{name}")
    env = aec_env(calling(*[lambda name=name: decide(name) for name in "abac"]), decide)
    for seed in (31, 62):
        with pytest.raises(Culprit) as caught:
            play(env, RULE, seed=seed)
        told = notes(caught.value)
        assert "agent_c" in told
        assert str(seed) in told
        assert re.search(r"decision 4\b", told), told
        assert caught.value.__notes__ == [told]  # one note of one environment


class Being:
    """Has a mapping that fails at its second decision; a method, as most decisions are."""

    def __init__(self, name):
        self.name, self.decisions = name, 0

    def observe(self):
        self.decisions += 1
        if self.name == "b" and self.decisions == 2:
            raise Culprit("boom")
        return [self.decisions, 0]

    @define(agent=lambda self: f"being_{self.name}", observation_space_mapping=observe)
    def choose(self):
        return 0

    @define(agent="alone_0", observation_space_mapping=observe)
    def choose_alone(self):
        return 0


@pytest.mark.parametrize(("point", "agent"), [(Being.choose, "being_b"), (Being.choose_alone, "alone_0")])
def test_notes_of_errors_at_later_decisions_of_methods(point, agent):
    def main(simulation):
        beings = [Being("a"), Being("b")]
        for number in (1, 0, 0, 0, 1):
            point(beings[number])

    env = aec_env(script(main), point)
    with pytest.raises(Culprit) as caught:
        play(env, 1, seed=17)
    assert agent in notes(caught.value)
    assert "17" in notes(caught.value)
    assert re.search(r"decision 5\b", notes(caught.value))


def test_drawn_seeds_are_told_too_and_reproduce_the_error():
    seeds = []

    class Seeded(Script):
        def reset(self, seed=None):
            super().reset(seed)
            seeds.append(seed)

    decide = decision(lambda: 1 / 0)
    env = single_env(lambda: Seeded(lambda simulation: decide()), decide)
    env.reset()
    with pytest.raises(ZeroDivisionError) as caught:
        env.step(RULE)
    assert str(seeds[-1]) in notes(caught.value)


# -- threads --------------------------------------------------------------------------------------


@pytest.mark.greenlet("threads of their own may be used from any other")
@VIEWS
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
    with pytest.raises(WrongThreadError, match='driver="thread"') as caught:
        in_a_thread(lambda: step(env, 5, "a_0") if what == "step" else getattr(env, what)())
    assert isinstance(caught.value, RuntimeError)
    assert not unwound
    step(env, 2, "a_0")
    assert env.unwrapped.simulation.log == [1, 2]
    env.close()
    assert unwound == [True]


def test_an_episode_may_run_in_any_thread_from_its_reset_on():
    decide = decision(agent="a_0")
    env = aec_env(calling(*[decide] * 3), decide)
    simulation = env.simulation
    for _ in range(2):
        assert decisions(in_a_thread(lambda: play(env, 1))) == ["a_0"] * 3
        assert decisions(play(env, 1)) == ["a_0"] * 3
    assert env.simulation is simulation
    assert simulation.episodes == 4


def test_threads_with_environments_of_their_own_do_not_meet():
    decide = decision(observation_space=spaces.Discrete(100), observation_space_mapping=lambda: 1)
    barrier = threading.Barrier(4)
    logs = {}

    def work(number):
        env = single_env(calling(*[decide] * 50), decide)
        barrier.wait()
        for _ in range(3):
            env.reset()
            while not env.step(number)[2]:
                assert decide() == "rule"
        logs[number] = env.unwrapped.simulation.log
        assert decide() == "rule"

    threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert logs == {number: [number] * 50 for number in range(4)}


def test_a_suspended_simulation_leaves_other_threads_and_the_users_own_calls_alone():
    decide = decision()
    env = single_env(calling(decide, decide), decide)
    env.reset()
    assert decide() == "rule"
    assert in_a_thread(decide) == "rule"
    env.step(1)
    assert decide() == "rule"
