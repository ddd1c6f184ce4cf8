"""The check watches rules, clocks, observations and settings, and blames mappings."""

import asyncio
import contextlib
import functools
import io
import os
import sys
import time
import types
import warnings

import numpy as np
import pytest
import simpy
from gymnasium import spaces

from simenv_marl import difference
from simenv_marl.testing import check_simulation
from tests.testing.test_testing import (
    BOX,
    Walk,
    checked,
    clean,
    finding,
    points,
    report_with,
    table_of,
    variant,
)
from tests.worlds.models import define

WALKS = []
fault = table_of(WALKS)


def fault_of(name, severity, words, *told, **changes):
    """Add a sound walk under faulty definitions to the table."""
    fault(severity, words, *told, changes=changes)(variant(name))


def sound(model, changes=None, **options):
    """The report of a model without any finding but notes."""
    return clean(checked(model, changes, **options))


# -- rules ----------------------------------------------------------------------------------------

CHANGES = "changes the model by deciding"


@fault("warning", CHANGES, "simulation.queue[19]", "its caller change the model", "apply=")
class Serves(Walk):
    def reset(self, seed=None):
        super().reset(seed)
        self.queue = [self.random.choice([-1, 0, 1]) for _ in range(20)]

    def choose(self):
        return self.queue.pop()


@fault("warning", CHANGES, "simulation.asked")
class Counts(Walk):
    asked = 0

    def choose(self):
        self.asked += 1
        return 1


ORDERS = [1] * 10_000


@fault("warning", CHANGES, "variables")
class ServesAll(Walk):
    def choose(self):
        return ORDERS.pop()


class Lazy(Walk):
    """Its rule draws random numbers and stores values that can be computed again."""

    def reset(self, seed=None):
        super().reset(seed)
        self.price_cache = {}

    @functools.cached_property
    def answer(self):
        return 1

    def choose(self):
        self.price_cache[self.number] = self.answer
        return self.random.choice([-1, 0, 1])


def test_check_simulation_accepts_a_rule_that_draws_and_caches():
    sound(Lazy)


def test_check_simulation_lets_apply_change_the_same_state_as_the_rule():
    class Applied(Serves):
        pass

    def take(action, walk):
        walk.queue.pop()
        return action - 1

    sound(Applied, {"action_space_mapping": None, "apply": take})


def test_check_simulation_ignores_attributes_that_a_rule_may_change():
    sound(Counts, fingerprint=lambda walk: walk.place)


class Clocked(Walk):
    """A walk on the clock of SimPy."""

    def reset(self, seed=None):
        super().reset(seed)
        self.clock = simpy.Environment()

    def run(self):
        self.clock.process(self.walk())
        self.clock.run()

    def walk(self):
        for number in range(self.steps):
            self.number = number
            yield self.clock.timeout(1)
            self.place += (yield from self.choose()) + self.random.uniform(-0.5, 0.5)
            self.log.append(self.place)

    def choose(self):
        if self.number < 0:
            yield
        return self.random.choice([-1, 0, 1])

    def time(self):
        return self.clock.now


def test_check_simulation_accepts_generator_points_that_do_not_wait():
    sound(Clocked)


WAITS = "takes time, an action takes none"


@fault("warning", WAITS, "Timeout", "apply may be a generator")
class Hesitates(Clocked):
    def choose(self):
        yield self.clock.timeout(3)
        return 1


def test_check_simulation_accepts_apply_that_waits_like_its_rule():
    class Applied(Hesitates):
        pass

    def apply(action, walk):
        yield walk.clock.timeout(2)
        return action - 1

    sound(Applied, {"action_space_mapping": None, "apply": apply})


def test_check_simulation_finds_apply_that_does_not_wait_like_its_rule():
    class Applied(Hesitates):
        pass

    changes = {"action_space_mapping": None, "apply": lambda action: action - 1}
    assert finding(checked(Applied, changes), WAITS).severity == "warning"


@fault("warning", WAITS)
class Awaits(Walk):
    def run(self):
        asyncio.run(self.walk())

    async def walk(self):
        for number in range(self.steps):
            self.number = number
            self.place += await self.choose() + self.random.uniform(-0.5, 0.5)
            self.log.append(self.place)

    async def choose(self):
        await asyncio.sleep(0)
        return 1


@fault("warning", "yields values and returns none", ": -1", "it gets none under an action")
class Yields(Walk):
    def run(self):
        for number in range(self.steps):
            self.number = number
            for step in self.choose():
                self.place += step
            self.log.append(self.place)

    def choose(self):
        yield 1
        yield -1


# -- who decides ----------------------------------------------------------------------------------


class Animal:
    def __init__(self, walk, number):
        self.walk, self.number = walk, number

    def move(self):
        return 1

    def observe(self):
        return self.walk.observe()


class Sheep(Animal):
    def move(self):
        return 2


class Lamb(Animal):
    def move(self):
        return super().move()


class Deer(Sheep):
    """Nobody calls it."""

    def move(self):
        return 3


class Herd(Walk):
    kinds = (Animal, Sheep, Lamb)

    def run(self):
        animals = [kind(self, number) for number, kind in enumerate(self.kinds)]
        for _ in range(self.steps):
            for animal in animals:
                self.place += animal.move() + self.random.random()
            self.log.append(self.place)


class SoundHerd(Herd):
    kinds = (Animal, Lamb)


def herd(*kinds):
    definition = define(
        observation_space=BOX,
        observation_space_mapping=lambda animal: animal.observe(),
        action_space=spaces.Discrete(3),
        reward_mapping=lambda animal: animal.walk.place,
        agent=lambda animal: f"animal_{animal.number}",
    )
    return {kind.move: definition for kind in kinds}


def test_check_simulation_reports_an_override_that_is_no_decision_point():
    report = check_simulation(Herd, herd(Animal), episodes=2)
    seen = finding(report, "override a decision point")
    assert seen.severity == "error"
    assert "Sheep.move" in seen.evidence
    assert "add it to points" in " ".join(seen.explanation.split())


def test_check_simulation_accepts_overrides_that_decide_or_call_super():
    clean(check_simulation(Herd, herd(Animal, Sheep), episodes=2))
    clean(check_simulation(SoundHerd, herd(Animal), episodes=2))


@fault("warning", "before run()", "in reset", "no environment is asked")
class DecidesEarly(Walk):
    def reset(self, seed=None):
        super().reset(seed)
        self.place = self.choose()


@fault("warning", "before run()", "in __init__")
class DecidesWhenMade(Walk):
    def __init__(self):
        super().reset(1)
        self.first = self.choose()


@fault("note", "while the model is made or reset", "in play", "a history that no agent")
class HasAHistory(Walk):
    def reset(self, seed=None):
        super().reset(seed)
        self.play()

    def play(self):
        self.place = self.choose()


# -- clocks ---------------------------------------------------------------------------------------


@fault("error", "time goes back", "in another plain run", "from 10 to 9")
class Countdown(Walk):
    def time(self):
        return 10 - len(self.log)


@fault("error", "time goes back", "random legal actions", "no number")
class LosesTime(Walk):
    def run(self):
        super().run()
        self.log *= 2

    def choose(self):
        return 1

    def time(self):
        return float("nan") if self.place < 0 else self.number


@fault("error", "time stands still", "600 decisions, the last at 3", "a loop that waits")
class WaitsForALoop(Walk):
    def run(self):
        while len(self.log) < 3 or self.choose() < 5:
            self.number = 0
            self.place = (self.place + self.choose()) % 10
            self.log = [*self.log, 0][:3]

    def time(self):
        return float(len(self.log))


@fault(
    "error", "neither ends nor asks", "simulated time 2", "events cause each other", time_limit=2
)
class EventsWithoutDelay(Walk):
    def run(self):
        while True:
            if len(self.log) < 2:
                self.log.append(self.choose())

    def time(self):
        return float(len(self.log))


class Busy(Walk):
    """Its agent takes many decisions on each of its days, and ends."""

    steps = 150

    def time(self):
        return len(self.log) // 50


def test_check_simulation_accepts_many_decisions_at_one_time():
    report = checked(Busy)
    assert report.ok, report


@fault("error", "neither ends nor asks", "in run)", time_limit=2)
class Sleeps(Walk):
    def run(self):
        super().run()
        time.sleep(1000)


@fault("warning", "time limit", "after 1 seconds, while the simulation was made", time_limit=1)
class SleepsWhenMade(Walk):
    def __init__(self):
        time.sleep(1000)


@fault("warning", "time limit", "throughout", time_limit=2)
class Slow(Walk):
    def choose(self):
        time.sleep(0.02)
        return 1


def test_check_simulation_lists_checks_skipped_at_its_time_limit():
    begin = time.monotonic()
    report = checked(Slow, time_limit=2)
    assert time.monotonic() - begin < 5
    assert not any("plain runs against" in line for line in report.checked)
    assert "because the time is up" in left_out(report)


# -- observations, labels, settings ---------------------------------------------------------------

fault_of("SeesNothing", "warning", "always the same", "array([1., 2.]", "never changes",
         observation_space_mapping=lambda walk: [1, 2])  # fmt: skip
fault_of("SeesNoNumber", "error", "contain NaN", "observation[1]: nan",
         observation_space_mapping=lambda walk: [1, np.log(-1.0) if walk.log else 0])  # fmt: skip
fault_of("SeesNoEnd", "error", "infinite numbers", "observation[0]: 0 to inf",
         observation_space_mapping=lambda walk: [float("inf") if walk.log else 0, 1],
         observation_space=spaces.Box(-np.inf, np.inf, (2,)))  # fmt: skip
for labels in (
    {1: "left", 2: "stay", 3: "right"}, ["left", "right"], ["left", "left", "right"],
):  # fmt: skip
    fault_of("Labels", "error", "callable of labels", "not texts for the parts", "in episode 1",
             action_labels=lambda walk, labels=labels: labels)  # fmt: skip
fault_of("NoLabels", "error", "The action_labels of", "KeyError",
         action_labels=lambda walk: {}["left"])  # fmt: skip
fault_of("OneLabel", "error", "callable of labels",
         observation_labels=lambda walk: ["place"])  # fmt: skip


def test_check_simulation_accepts_a_space_of_one_observation():
    nothing = {"observation_space": spaces.Discrete(1), "observation_space_mapping": lambda walk: 0}
    sound(Walk, nothing)


def test_check_simulation_accepts_labels_of_legal_actions_only():
    sound(Walk, {"action_labels": lambda walk: {0: "left"}})


@fault("warning", "settings that the model has changed", "warnings.filters, sys.stdout",
       "the working directory", "Leave the block before the decision")  # fmt: skip
class Tidy(Walk):
    def run(self):
        folder = os.getcwd()
        try:
            os.chdir("/")
            with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
                super().run()
        finally:
            os.chdir(folder)


def test_check_simulation_reports_a_torch_grad_mode_set_by_the_model(monkeypatch):
    modes = [True]
    torch = types.SimpleNamespace(is_grad_enabled=lambda: modes[-1])
    monkeypatch.setitem(sys.modules, "torch", torch)

    class Predicts(Walk):
        def run(self):
            modes.append(False)
            super().run()
            modes.pop()

    seen = finding(checked(Predicts), "settings that the model has changed")
    assert "torch's grad mode" in seen.evidence
    assert 'driver="thread"' in seen.explanation


# -- mappings -------------------------------------------------------------------------------------


class Mapping:
    def __call__(self, walk):
        return {0: 1}[len(walk.log)]


def broken(walk):
    return {0: 1}[len(walk.log)]


for number, mapping in enumerate(
    (broken, functools.partial(broken), Mapping(), Mapping().__call__, difference(broken))
):
    fault_of(f"RewardsBadly{number}", "error", "The reward_mapping of", "raises",
             "The model may be right", reward_mapping=mapping)  # fmt: skip
fault_of("MasksBadly", "error", "The action_mask_mapping", "MaskError",
         action_mask_mapping=lambda walk: [1])  # fmt: skip
fault_of("SeesBadly", "error", "The observation_space_mapping raises ObservationError",
         observation_space_mapping=lambda walk: [1])  # fmt: skip


@fault("error", "The simulation raises ZeroDivisionError", "No mapping has raised it")
class Broken(Walk):
    def run(self):
        super().run()
        self.place /= 0


@pytest.mark.thorough
@pytest.mark.parametrize(("model", "changes", "options", "severity", "words", "told"), WALKS)
def test_check_simulation_reports_each_fault_with_its_place(
    model, changes, options, severity, words, told
):
    report_with(model, changes, options, severity, words, told)


# -- tests that are left out ----------------------------------------------------------------------


def left_out(report):
    return " ".join(line for line in report.checked if line.startswith("Left out"))


def test_check_simulation_names_skipped_checks_with_the_reason():
    assert not left_out(checked(Walk))
    errors = left_out(checked(Walk, {"observation_space": spaces.Box(-1, 1, (2,), np.float32)}))
    assert "PettingZoo's api_test, seed_test" in errors
    assert "because there are errors" in errors
    herds = left_out(check_simulation(SoundHerd, herd(Animal), episodes=2))
    assert "agent=" in herds
    assert "Gymnasium's check_env (single view)" in herds
    shifted = {"action_space": spaces.Discrete(3, start=1)}
    shifted["action_space_mapping"] = lambda action: action - 2
    assert "PettingZoo's api_test, because it takes illegal actions" in left_out(
        checked(Walk, shifted)
    )


def test_check_simulation_skips_turn_env_if_spaces_cannot_be_united():
    other = points(Walk, "rest", agent="rester_0", action_space=spaces.MultiBinary(3))
    report = check_simulation(Walk, points(Walk) | other, episodes=2)
    assert report.ok
    told = left_out(report)
    assert "Gymnasium's check_env (turn view), because agents with different action spaces" in told
    assert "joint; drivers" in report.checked[0]


def test_check_simulation_takes_state_in_info_as_an_option():
    class Charted(Walk):
        def state(self):
            return [self.place]

    assert not checked(Charted, state_in_info=True, episodes=1).findings
