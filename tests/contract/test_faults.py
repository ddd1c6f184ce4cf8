"""Whatever fails, wherever: it surfaces as itself, nothing hangs or stays behind, and the next episode is as ever."""

import gc
import os
import random
import sys
import warnings
import weakref
from dataclasses import dataclass
from itertools import count, product

import greenlet
import pytest
from gymnasium import spaces

import simenv_marl
from simenv_marl import RULE, aec_env, joint_env, parallel_env, simulate, simulate_many, single_env, vector_env
from simenv_marl.core import threads
from simenv_marl.errors import ResetNeededError
from simenv_marl.hooks.stacks import EVALUATING
from tests.core.test_threads import in_a_thread
from tests.processes import alone
from tests.worlds.models import Script, culprits, decision, define, nobody_is_asked, notes, play, step

# -- a model that may fail anywhere ---------------------------------------------------------------


class Beast:
    """One of those that decide one by one."""

    def __init__(self, farm, number):
        self.farm, self.number = farm, number

    def burn(self, place):
        self.farm.burn(place)

    def move(self):
        self.burn("rule")
        return self.farm.random.randrange(5)


class Farm:
    """A simulation that raises ``error`` at a given place, once it has come by often enough."""

    render_modes = ("human",)
    rounds = 3

    def __init__(self):
        self.place, self.fuse, self.error = None, 0, None

    def burn(self, place):
        if place == self.place:
            self.fuse -= 1
            if self.fuse == 0:
                raise self.error

    def reset(self, seed=None):
        self.burn("reset")
        self.random = random.Random(seed)
        self.now, self.log = 0, []
        self.herd = [Beast(self, number) for number in range(3)]

    def run(self):
        try:
            for _ in range(self.rounds):
                self.burn("run")
                self.log.append(self.plan())
                self.now += 1
                for beast in list(self.herd):
                    self.log.append(beast.move())
                self.log.append(self.pick())
                self.log.append(self.work())
                if self.now == self.rounds - 1:
                    self.remove(self.herd[0])
        finally:
            self.burn("finally")

    def plan(self):
        self.burn("rule")
        return self.random.randrange(10)

    def pick(self):
        self.burn("rule")
        return 0

    def work(self):
        self.burn("rule")
        return self.random.randrange(3)

    def remove(self, beast):
        self.herd.remove(beast)

    def stop(self):
        self.burn("stop")

    def time(self):
        self.burn("time")
        return float(self.now)

    def expected_calls(self, point):
        self.burn("expected_calls")
        return [(beast,) for beast in self.herd] if point.endswith("move") else []

    def render(self, mode):
        self.burn("render")


class Small(Farm):
    """One that is soon over, for those who play it very often."""

    rounds = 1


ORIGINALS = [dict(vars(Farm)), dict(vars(Beast))]


def at(place, value):
    """A mapping that may fail, with that value."""

    def mapping(*args):
        args[-1].burn(place)
        return value(*args) if callable(value) else value

    return mapping


def apply(action, farm):
    farm.burn("apply")
    return action + farm.random.randrange(3)


PLACE = f"{__name__}.Farm"
POINTS = {
    f"{PLACE}.plan": define(
        agent="planner",
        observation_space_mapping=at("observation", [0, 0]),
        reward_mapping=at("reward", 1.0),
        action_mask_mapping=at("mask", [1] * 10),
        apply=apply,
    ),
    f"{__name__}.Beast.move": define(
        agent=at("agent", lambda beast: f"beast_{beast.number}"),
        observation_space_mapping=at("observation", [0, 0]),
        reward_mapping=at("reward", 1.0),
        removed_by={f"{PLACE}.remove": lambda farm, beast: at("removed_by", f"beast_{beast.number}")(beast)},
    ),
    f"{PLACE}.pick": define(
        agent="picker", choices=at("choices", lambda farm: list(range(farm.now + 1))), action_space=spaces.Discrete(5)
    ),
    f"{PLACE}.work": define(agent="worker", observation_space_mapping=at("observation", [0, 0])),
}
PLACES = (
    "reset", "run", "finally", "rule", "apply", "observation", "reward", "mask", "agent", "removed_by", "choices",
    "policy", "stop", "time", "expected_calls", "render", "before", "after", "instead",
)  # fmt: skip
VIEWS = pytest.mark.parametrize("view", [aec_env, parallel_env, joint_env, single_env])


def handler(place):
    def handle(farm, **_):
        farm.burn(place)
        return 0  # of which only ``instead`` makes use

    return handle


def farm_env(view, place=None, farm=Farm):
    """An environment of a farm, in which that place is come by."""

    def policy(observation):
        farms[0].burn("policy")
        return 2

    farms, work = [], f"{PLACE}.work"
    options = {"policies": {work: policy if place == "policy" else RULE}}
    if place in ("before", "after", "instead"):
        options["plugins"] = [(handler(place), work, place)]
    if place == "render":
        options["render_mode"] = "human"
    points = POINTS
    if view is single_env:
        points = {f"{PLACE}.plan": POINTS[f"{PLACE}.plan"], work: POINTS[work]}
    elif view is joint_env:
        options["possible_agents"] = {f"{__name__}.Beast.move": [f"beast_{number}" for number in range(3)]}
    env = view(farm, points, **options)
    farms.append(env.unwrapped.simulation)
    return env


def run(env, view, seed=11):
    """Play an episode, every third decision by its rule; return what it was like."""
    answers = (RULE if number % 3 == 0 else 0 for number in count())
    if view is aec_env:
        told = [turn[:6] for turn in play(env, lambda agent, env: next(answers), seed=seed)]
    else:
        told = [env.reset(seed=seed)]
        while view is parallel_env and env.agents:
            told.append(env.step({agent: next(answers) for agent in env.agents}))
        while view is not parallel_env and not any(told[-1][2:4]):
            action = next(answers)
            joint = view is joint_env and action is not RULE
            told.append(env.step(dict.fromkeys(env.action_space, 0) if joint else action))
    return str(told), list(env.unwrapped.simulation.log)


def cut_short(env, view):
    """Begin an episode, go on a little, and close it."""
    env.reset(seed=11)
    env.step(dict.fromkeys(env.agents, RULE) if view is parallel_env else RULE)
    env.close()


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


@VIEWS
@pytest.mark.parametrize("place", PLACES)
def test_any_error_anywhere_surfaces_as_itself_and_leaves_no_trace(view, place):
    if view is single_env and place in ("agent", "removed_by", "choices", "expected_calls"):
        return
    fresh = run(farm_env(view, place), view)
    env = farm_env(view, place)
    farm = env.unwrapped.simulation
    kinds = list(ERRORS.items())
    once = place in ("reset", "finally", "stop", "removed_by", "apply")
    for fuse, (kind, make) in [*product([1], kinds), *product([3], [] if once else kinds[:6])]:
        farm.place, farm.fuse, farm.error = place, fuse, make()
        with pytest.raises(type(farm.error)) as caught:
            (cut_short if place in ("stop", "finally") else run)(env, view)
        assert caught.value is farm.error, kind
        assert "burn" in culprits(farm.error)
        if place != "render":
            assert "seed 11" in notes(farm.error), kind
        env.close()
        farm.place = farm.error = None
        del caught
        nothing_is_left()
        assert run(env, view) == fresh, kind
        env.close()
    nothing_is_left()
    gone = weakref.ref(farm)
    del env, farm
    gc.collect()
    assert gone() is None


# -- interrupts -----------------------------------------------------------------------------------

_PACKAGE = os.path.dirname(simenv_marl.__file__)


def interrupt_at(number, function, *args):
    """Call a function; raise a KeyboardInterrupt where Python looks for signals in this package, the given time.

    That is where a function begins, and where a call of a builtin has returned.

    Returns where that was, None if it never was, and what the function has raised.
    """
    left, where, raised = number, None, None

    def look(frame, event, arg):
        nonlocal left, where
        if event not in ("call", "c_return") or not frame.f_code.co_filename.startswith(_PACKAGE):
            return
        if frame.f_code.co_name in ("__exit__", "__del__"):
            return  # where a ``with`` ends: there nobody can help it; and where Python itself swallows it
        left -= 1
        if left == 0:
            sys.setprofile(None)
            where = f"{os.path.basename(frame.f_code.co_filename)}:{frame.f_lineno} {event} {frame.f_code.co_name}"
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


@VIEWS
def test_an_interrupt_anywhere_surfaces_and_the_next_episode_is_complete(view):
    # In a process of its own: where greenlets were interrupted amid a switch, the collector may crash later.
    alone(interrupt_anywhere, view.__name__)


def interrupt_anywhere(name):
    """Interrupt a run of a view at each call, one after the other."""
    threads.SECONDS_TO_UNWIND, view = 0.05, globals()[name]
    decide = decision()

    class Model(Script):
        def reset(self, seed=None, options=None):
            super().reset(seed, options)
            decide()

        def expected_calls(self, point):
            return [()]

    def main(simulation):
        for _ in range(2):
            simulation.log.append(decide())

    def whole_run(env):
        env.reset(seed=1)
        for _ in range(2):
            step(env, 3, "choose_0")
        if view is aec_env:
            env.step(None)
        env.reset(seed=2)
        env.close()

    for number in count(1):
        env = view(lambda: Model(main), decide)
        where, raised = interrupt_at(number, whole_run, env)
        if where is None:
            assert raised is None
            break
        assert type(raised) is KeyboardInterrupt, where
        del raised
        assert nobody_is_asked(), where
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ResourceWarning)  # a thread that was never begun cannot be unwound
            whole_run(env)
            env.reset(seed=1)
            step(env, 3, "choose_0")
            assert env.unwrapped.simulation.log == [3], where
            env.close()
        assert in_a_thread(env.close) is None, where  # nothing of it is left to this one
    assert number > 100


USES = {
    "aec_env": lambda: cut_short(farm_env(aec_env, "before"), aec_env),
    "vector_env": lambda: vector_env(Small, {f"{PLACE}.plan": POINTS[f"{PLACE}.plan"]}, num_envs=2).close(),
    "simulate": lambda: simulate(Small, points=POINTS),
    "simulate_many": lambda: simulate_many(Small, {"planner": lambda o: [0] * len(o)}, points=POINTS, seeds=[1, 2]),
}


@pytest.mark.greenlet("the release is the same with every driver")
@pytest.mark.parametrize("use", USES)
def test_an_interrupt_anywhere_in_what_opens_and_closes_leaves_nothing_patched(use):
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


class Announced(Script):
    def expected_calls(self, point):
        return [()]


@pytest.mark.usefixtures("_collected")
@VIEWS
def test_an_environment_survives_the_end_of_its_users_stack(view):
    decide = decision()

    def main(simulation):
        try:
            for _ in range(3):
                simulation.log.append(decide())
        finally:
            simulation.log.append("unwound")

    env = view(lambda: Announced(main), decide)
    ends = set()
    for room in range(1, 60):
        env.reset()
        log = env.unwrapped.simulation.log
        for what in (lambda: step(env, 3, "choose_0"), env.reset, env.close):
            try:
                deep_down(what, room)
                ends.add("went well")
            except RecursionError:
                ends.add("came to the end")
            except ResetNeededError:
                ends.add("was over")
        env.reset()
        assert log[-1] == "unwound"
        for _ in range(3):
            step(env, 3, "choose_0")
        assert env.unwrapped.simulation.log == [3, 3, 3, "unwound"]
        assert nobody_is_asked()
    assert ends >= {"went well", "came to the end"}
