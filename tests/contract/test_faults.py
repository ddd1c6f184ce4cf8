"""Every failure surfaces as itself, leaves nothing behind, and does not affect the next episode."""

import gc
import os
import sys
import warnings
import weakref
from dataclasses import dataclass
from functools import partial
from itertools import count, product

import greenlet
import pytest

import simenv_marl
from simenv_marl import (
    aec_env,
    parallel_env,
    simulate,
    simulate_many,
    single_env,
    vector_env,
)
from simenv_marl.core.switching import threads
from simenv_marl.errors import NotResetError, ReentrancyError, ResetNeededError
from simenv_marl.hooks.stacks import EVALUATING
from tests.core.test_threads import in_a_thread
from tests.processes import alone
from tests.worlds import faults
from tests.worlds.faults import PLAN, POINTS, Beast, Farm, Small, cut_short, farm_env, run, take
from tests.worlds.models import (
    EVERY_VIEW,
    VIEWS,
    culprits,
    decision,
    nobody_is_asked,
    notes,
    stacks,
    step,
)

ORIGINALS = [dict(vars(Farm)), dict(vars(Beast))]


def everywhere(*views, places=faults.PLACES):
    """All of the places that an episode comes by, in these views."""
    there = [(view, place) for view in views for place in places if faults.comes_by(view, place)]
    return pytest.mark.parametrize(("view", "place"), there)


def nothing_is_left():
    """In this thread nothing runs, and what was patched is as it was."""
    assert nobody_is_asked()
    assert EVALUATING == {}
    assert [dict(vars(Farm)), dict(vars(Beast))] == ORIGINALS


# -- errors of every kind -------------------------------------------------------------------------


@dataclass(frozen=True)
class FrozenError(Exception):
    value: int


def in_circles():
    """An error that is its own cause, by way of another."""
    error, other = ValueError("one"), ValueError("other")
    error.__cause__, other.__cause__ = other, error
    return error


ERRORS = {
    "KeyboardInterrupt": KeyboardInterrupt,
    "SystemExit": lambda: SystemExit(3),
    "GeneratorExit": GeneratorExit,
    "GreenletExit": greenlet.GreenletExit,
    "StopIteration": lambda: StopIteration("value"),
    "MemoryError": MemoryError,
    "RecursionError": RecursionError,
    "group": lambda: ExceptionGroup("several", [ValueError(), KeyError()]),
    "base group": lambda: BaseExceptionGroup("several", [KeyboardInterrupt()]),
    "frozen": lambda: FrozenError(1),
    "circular": in_circles,
    "warning": lambda: UserWarning("as an error"),
}


def throw(error):
    raise error


def play_and_cut_short(env):
    run(env)
    cut_short(env)


@pytest.mark.thorough
@everywhere(*VIEWS)
def test_env_raises_any_model_error_unchanged_and_resets_cleanly(view, place):
    before = stacks()
    fresh = run(farm_env(view, place)[0])
    env, farm = farm_env(view, place)
    kinds = list(ERRORS.items())
    later = [] if place in faults.ONCE else kinds[:6]
    for time, (kind, make) in [
        *product([1], kinds[: None if view is aec_env else 6]),
        *product([3], later),
    ]:
        error = make()
        cause = error.__cause__
        farm.let(partial(throw, error), place, time)
        with pytest.raises(type(error)) as caught:
            play_and_cut_short(env)
        assert caught.value is error, kind
        assert culprits(error)[-1] == "throw"
        assert error.__cause__ is cause
        if place != "finally":
            assert error.__context__ is None
        if place not in ("render", "close"):
            assert "seed 11" in notes(error), kind
        if isinstance(error, Exception):
            assert farm.caught == (place in faults.IN_THE_MODEL)
        if place not in ("render", "action"):  # after which the episode goes on
            with pytest.raises(ResetNeededError, match=r"call reset\(\)"):
                take(env, 0)
            assert view is not aec_env or not (
                env.agents or env.rewards or env.terminations or env.infos
            )
        env.close()
        del caught, error, cause, farm.happen
        nothing_is_left()
        assert run(env) == fresh, kind
        env.close()
    farm.let(partial(throw, KeyError()), place)
    with pytest.raises(KeyError):
        play_and_cut_short(env)
    gone = weakref.ref(farm)
    del env, farm.happen, farm
    gc.collect()
    gc.collect()  # the first time only its finalizer runs
    assert gone() is None
    assert not stacks(before)
    nothing_is_left()


@pytest.mark.parametrize(
    ("view", "place", "time", "where"),
    [
        (aec_env, "reset", 1, "while the simulation was reset"),
        (aec_env, "run", 1, "before the first decision"),
        (aec_env, "run", 3, "in the model, after decision 10, of 'picker' at Farm.pick"),
        (aec_env, "rule", 3, "in the model, after decision 5, of 'picker' at Farm.pick"),
        (aec_env, "observation", 3, "at decision 1, of 'beast_1' at Beast.move"),
        (aec_env, "mask", 3, "at decision 11, of 'planner' at Farm.plan"),
        (aec_env, "action", 1, "at decision 6, of 'planner' at Farm.plan"),
        (single_env, "apply", 1, "in the model, after decision 2, of 'planner' at Farm.plan"),
        (single_env, "reward", 3, "at decision 3, of 'planner' at Farm.plan"),
        (parallel_env, "policy", 1, "at decision 2, of 'worker' at Farm.work"),
    ],
)
@pytest.mark.parametrize("seed", [31, None])  # None: it is drawn
def test_env_error_note_names_decision_point_agent_and_seed(view, place, time, where, seed):
    env, farm = farm_env(view, place)
    farm.let(partial(throw, ValueError("told")), place, time)
    with pytest.raises(ValueError, match="told") as caught:
        run(env, seed)
    env.close()
    [note] = caught.value.__notes__
    expected = f"simenv_marl: {where}; seed {farm.seed}"
    is_early = where.startswith(("while", "before", "at decision 1,"))
    if not is_early and place != "action":  # there are answers, and the decision is not pending
        expected += "; save_episode(env, path) writes the episode to a file"
    assert note.replace(f"{faults.__name__}.", "") == expected
    assert seed in (farm.seed, None)


# -- uses from inside -----------------------------------------------------------------------------

INSIDE = [place for place in faults.PLACES if place != "render"]  # which comes after the step


@pytest.mark.thorough
@everywhere(*VIEWS, faults.vector, faults.vector_of_joint, places=INSIDE)
@pytest.mark.parametrize("method", ["step", "reset", "close"])
def test_env_refuses_a_step_within_a_step_and_the_episode_continues(view, place, method):
    def use():
        take(env, 0) if method == "step" else getattr(env, method)()

    def use_in_vain():
        with pytest.raises((ReentrancyError, NotResetError)) as caught:
            use()
        in_reset = not farm.log
        assert "was used from" in str(caught.value) or in_reset
        used.append(True)

    fresh = run(farm_env(view, place)[0])
    env, farm = farm_env(view, place)
    for time in [1, 3] if method == "step" and place not in faults.ONCE else [1]:
        used = []
        farm.let(use_in_vain, place, time)
        assert run(env) == fresh
        cut_short(env)
        assert used == [True]
    farm.let(use, place, time)
    with pytest.raises((ReentrancyError, NotResetError)):
        play_and_cut_short(env)
    assert run(env) == fresh
    env.close()


# -- interrupts -----------------------------------------------------------------------------------

_PACKAGE = os.path.dirname(simenv_marl.__file__)
decide = decision()


class Model:
    """Decides twice, and says so in advance."""

    def reset(self, seed=None):
        self.log = [decide()]

    def expected_calls(self, point):
        return [()]

    def run(self):
        try:
            for _ in range(2):
                self.log.append(decide())
        finally:
            self.log.append("unwound")


def act(env):
    step(env, 3, "choose_0")


def interrupt_at(number, function, *args):
    """Call a function.

    Raise a KeyboardInterrupt where Python looks for signals in this package, the given time.

    That is where a function begins, and where a call of a builtin has returned.

    Returns where that was, None if it never was, and what the function has raised.
    """
    left, where, raised = number, None, None

    def look(frame, event, arg):
        nonlocal left, where
        if event not in ("call", "c_return") or not frame.f_code.co_filename.startswith(_PACKAGE):
            return
        if frame.f_code.co_name in ("__exit__", "__del__"):
            # where a ``with`` ends: there nobody can help it; and where Python itself swallows it
            return
        left -= 1
        if left == 0:
            sys.setprofile(None)
            file = os.path.basename(frame.f_code.co_filename)
            where = f"{file}:{frame.f_lineno} {event} {frame.f_code.co_name}"
            raise KeyboardInterrupt

    before = sys.getprofile()
    sys.setprofile(look)
    try:
        function(*args)
    except BaseException as error:
        raised = error
    finally:
        sys.setprofile(before)
    return where, raised


@pytest.mark.thorough
@EVERY_VIEW
def test_keyboard_interrupt_anywhere_is_raised_and_the_next_episode_works(view):
    # In a process of its own: where greenlets were interrupted amid a switch, the collector may
    # crash later.
    alone(interrupt_anywhere, view.__name__)


def interrupt_anywhere(name):
    """Interrupt a run of a view at each call, one after the other."""
    threads.SECONDS_TO_UNWIND, view = 0.05, getattr(simenv_marl, name)

    def whole_run(env):
        env.reset(seed=1)
        act(env)
        act(env)
        if view is aec_env:
            env.step(None)
        env.reset(seed=2)
        env.close()

    for number in count(1):
        env = view(Model, decide)
        where, raised = interrupt_at(number, whole_run, env)
        if where is None:
            assert raised is None
            break
        assert type(raised) is KeyboardInterrupt, where
        del raised
        assert nobody_is_asked(), where
        with warnings.catch_warnings():
            # a thread that was never begun cannot be unwound
            warnings.simplefilter("ignore", ResourceWarning)
            whole_run(env)
            env.reset(seed=1)
            act(env)
            assert env.simulation.log == ["rule", 3], where
            env.close()
        assert in_a_thread(env.close) is None, where  # nothing of it is left to this one
    assert number > 100


USES = {
    "aec_env": lambda: cut_short(farm_env(aec_env, "before")[0]),
    "vector_env": lambda: vector_env(Small, {PLAN: POINTS[PLAN]}, num_envs=2).close(),
    "simulate": lambda: simulate(Small, points=POINTS),
    "simulate_many": lambda: simulate_many(
        Small, {"planner": lambda o: [0] * len(o)}, points=POINTS, seeds=[1, 2]
    ),
}


@pytest.mark.thorough
@pytest.mark.greenlet("the release is the same with every driver")
@pytest.mark.parametrize("use", USES)
def test_keyboard_interrupt_in_env_creation_or_close_leaves_no_patches(use):
    alone(interrupt_what_opens_and_closes, use)  # as above


def interrupt_what_opens_and_closes(use):
    gc.disable()
    USES[use]()
    where, number = "", 0
    while where is not None:
        number += 7
        where, raised = interrupt_at(number, USES[use])
        assert raised is None or type(raised) is KeyboardInterrupt, where
        del raised
        gc.collect()
        nothing_is_left()
    assert number > 100


# -- the end of the stack -------------------------------------------------------------------------


def deep_down(function, room):
    """Call a function where there is room for so many more calls only."""

    def down(left):
        return function() if left <= 0 else down(left - 1)

    here, frame = 0, sys._getframe()
    while frame is not None:
        here, frame = here + 1, frame.f_back
    return down(sys.getrecursionlimit() - here - room)


@pytest.mark.usefixtures("_collected")
@EVERY_VIEW
def test_env_works_after_a_recursion_error_in_the_users_code(view):
    env, ends = view(Model, decide), set()
    for room in range(1, 60):
        env.reset()
        log = env.simulation.log
        for use in (partial(act, env), env.reset, env.close):
            try:
                deep_down(use, room)
                ends.add("went well")
            except RecursionError:
                ends.add("came to the end")
            except ResetNeededError:
                ends.add("was over")
        env.reset()
        assert log[-1] == "unwound"
        act(env)
        act(env)
        assert env.simulation.log == ["rule", 3, 3, "unwound"]
        assert nobody_is_asked()
    assert ends >= {"went well", "came to the end"}
