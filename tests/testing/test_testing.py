"""Checks of simulations: each fault is found and named, and what is right stays clean."""

import contextlib
import dataclasses
import gc
import itertools
import json
import pickle
import random
import re
import sys
import time
import warnings

import numpy as np
import pytest
from examples.greenhouse_coop.env import GreenhouseSim
from gymnasium import spaces

from simenv_marl import TRUNCATED, Streams
from simenv_marl.errors import (
    CheckFailedError,
    OptionValueError,
    SimulationError,
    UnknownOptionError,
    UnknownPointError,
)
from simenv_marl.plugins import ChangedResult
from simenv_marl.testing import CheckReport, Finding, check_simulation, inspect_simulation
from simenv_marl.testing.fingerprint import MOST_PARTS, differences, fingerprint
from simenv_marl.testing.report import order_of
from tests.contract.test_mesa import Meadow, herd
from tests.worlds import entities
from tests.worlds.models import define, script
from tests.worlds.random_worlds import KINDS, World, WorldDesign, points_of

BOX = spaces.Box(-100, 100, (2,), np.float32)


class Walk:
    """A walk with a generator of its own. Nothing is wrong with it."""

    steps = 12

    def reset(self, seed=None):
        self.random = random.Random(seed)
        self.place, self.log = 0.0, []

    def run(self):
        for number in range(self.steps):
            self.number = number
            self.place += self.choose() + self.random.uniform(-0.5, 0.5)
            self.log.append(self.place)

    def choose(self):
        return self.random.choice([-1, 0, 1])

    def observe(self):
        return [self.place, len(self.log)]

    def rest(self):
        raise AssertionError("a walk never rests")


def points(simulation, function="choose", **changes):
    given = {
        "observation_space": BOX,
        "observation_space_mapping": lambda walk: walk.observe(),
        "action_space": spaces.Discrete(3),
        "action_space_mapping": lambda action: action - 1,
        "reward_mapping": lambda walk: -abs(walk.place),
        "agent": "walker_0",
    }
    return {getattr(simulation, function): define(**given | changes)}


def checked(simulation, changes=None, **options):
    """The report of a walk, with few episodes."""
    options = {"episodes": 4, "max_steps": 60} | options
    return check_simulation(simulation, points(simulation, **(changes or {})), **options)


def finding(report, words):
    """The one finding whose title has these words."""
    found = [finding for finding in report.findings if words in finding.title]
    assert len(found) == 1, str(report)
    return found[0]


def only_error(report, words):
    """The finding with these words is the only error."""
    assert report.of("error") == (finding(report, words),), str(report)


def clean(report):
    assert report.ok, str(report)
    assert not report.of("warning"), str(report)
    return report


def test_check_simulation_finds_nothing_in_a_sound_simulation():
    report = clean(checked(Walk))
    assert report.findings == ()
    assert "nothing to complain of" in str(report)
    report.raise_for_errors()
    assert any("aec, parallel, single, joint, turn" in line for line in report.checked)
    assert any("Gymnasium's check_env (turn view)" in line for line in report.checked)


def test_check_simulation_finds_nothing_in_sound_points_of_all_kinds():
    design = WorldDesign(KINDS, tuple((number % 9, number % 3) for number in range(27)))
    functions = points_of(design)
    report = clean(check_simulation(lambda: World(design, functions), functions, episodes=4))
    methods = [part for part in report.statistics if part.point == report.statistics[0].point]
    assert [part.agents for part in methods] == ["point_0", "point_5", "point_7", "point_8"]
    assert methods[0].decisions == methods[1].decisions == 12


COLONY = entities.ColonyDesign(initial=4, most=10, ticks=6, overseen="before")


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("simulation", "points"),
    [
        (GreenhouseSim, None),
        (lambda: entities.AnnouncingColony(COLONY), entities.colony_points(overseen=True)),
        (Meadow, herd()),
    ],
    ids=["greenhouse", "colony", "meadow"],
)
def test_check_simulation_finds_nothing_if_agents_are_born_and_die(simulation, points):
    report = clean(check_simulation(simulation, points, episodes=2, max_steps=300, seeds=[5]))
    if simulation is GreenhouseSim:
        assert re.fullmatch(r"\(update_air_exchange choose_water_amount\)\{\d+\}", report.calls)
        assert [part.agents for part in report.statistics] == ["waterer_0", "ventilator_0"]


def test_check_simulation_finds_nothing_in_masks_of_several_components():
    changes = {
        "action_space": spaces.MultiDiscrete([3, 2]),
        "action_space_mapping": lambda action: int(action[0]) - 1,
        "action_mask_mapping": lambda walk: ([1, 1, 0], [1, 0]),
    }
    report = clean(checked(Walk, changes))
    assert report.statistics[0].never_legal == ()


def in_one_generator(seed):
    return dict.fromkeys("012", np.random.default_rng(seed))


@pytest.mark.parametrize(
    ("generators", "noted"),
    [(in_one_generator, ["1 for 3 agents, being_0 and being_1 among them"]), (Streams, [])],
)
def test_check_simulation_notes_entities_that_share_generators(generators, noted):
    def main(simulation):
        simulation.beings, simulation.generators = (
            list(map(entities.Being, range(3))),
            generators(simulation.seed),
        )
        for being in simulation.beings:
            being.act()
            being.health += simulation.generators[str(being.number)].random()

    report = check_simulation(script(main), entities.beings(removed_by=()), episodes=2)
    found = [finding for finding in report.findings if "share random generators" in finding.title]
    assert [(finding.severity, finding.evidence) for finding in found] == [
        ("note", text) for text in noted
    ]


def moving(walk):
    """A mapping that changes the model."""
    walk.place += 0.25
    return walk.observe()


def seen_by(walk):
    """An observation that leaves a note."""
    walk.seen = walk.number
    return walk.observe()


def test_check_simulation_compares_only_the_given_fingerprint():
    clean(
        checked(Walk, {"observation_space_mapping": seen_by}, fingerprint=lambda walk: walk.place)
    )

    def observe(walk):
        walk.unseen = walk.random.random() < 2
        return walk.observe()

    class Secretive(Walk):
        def state(self):
            return np.array([self.place])

    changes = {"observation_space_mapping": observe}
    # what a simulation tells of itself is compared: the place, in the end
    assert not checked(Secretive, changes).ok
    only_error(
        checked(Walk, changes, fingerprint=lambda walk: [round(walk.place, 6)]), "differently when"
    )


# -- what is wrong with models --------------------------------------------------------------------


def table_of(rows):
    """Return a decorator that adds models to rows, each with the one finding it must have."""

    def found(severity, words, *told, changes=None, **options):
        def add(model):
            row = model, changes, options, severity, words, told
            rows.append(pytest.param(*row, id=model.__name__))
            return model

        return add

    return found


def report_with(model, changes, options, severity, words, told):
    """The report of a model, and its one finding with these words."""
    report = checked(model, changes, **options)
    seen = finding(report, words)
    assert seen.severity == severity
    text = " ".join(f"{seen.title} {seen.evidence} {seen.explanation}".split())
    assert all(part in text for part in told), text
    return report, seen


FOUND = []
found = table_of(FOUND)


def variant(name, **functions):
    """A walk with other functions."""
    return type(name, (Walk,), functions)


def of_mapping(severity, words, *told, like="observation_space_mapping", mapping, **changes):
    """Makes a walk with that mapping a row of the table, too."""
    found(severity, words, *told, changes={like: mapping, **changes})(Walk)


REWARD = "reward_mapping"
OBSERVED = "differently when it is observed"
of_mapping("error", OBSERVED, "aec view, driver greenlet, seed 0", "simulation.place is first",
           "must not change it or draw random numbers", mapping=moving)  # fmt: skip
of_mapping(
    "error",
    OBSERVED,
    "state of the generator",
    like=REWARD,
    mapping=lambda walk: walk.random.random(),
)
of_mapping(
    "error",
    "a mapping draws from",
    "should only read the model",
    mapping=lambda walk: [np.random.rand(), 0.0],
)
of_mapping("error", "outside their space", "walker_0 has observed", "Box(-1.0, 1.0, (2,), float32)",
           mapping=Walk.observe, observation_space=spaces.Box(-1, 1, (2,), np.float32))  # fmt: skip
of_mapping("error", "raises RewardError", "nan", "walker_0", "decision 6", like=REWARD,
           mapping=lambda walk: float("nan") if len(walk.log) == 5 else 0.5)  # fmt: skip
of_mapping("warning", "write into the model", "simulation.seen", mapping=seen_by)
of_mapping(
    "warning", "agents do changes nothing", like="action_space_mapping", mapping=lambda action: 0
)
of_mapping("warning", "always zero", like=REWARD, mapping=lambda walk: 0)
of_mapping("note", "always the same", like=REWARD, mapping=lambda walk: 2)

found("error", "same seed does not give the same run", "made without a seed", "test_testing.py")(
    variant("IgnoresItsSeed", reset=lambda walk, seed=None: Walk.reset(walk))
)
found("error", "The simulation never asks for a decision", "choose")(
    variant("Silent", run=lambda walk: None)
)
found("error", "raises TypeError", "needed")(
    variant("CannotBeMade", __init__=lambda walk, needed: None)
)
found("note", "All seeds give the same episode")(
    variant("Alike", reset=lambda walk, seed=None: Walk.reset(walk, 7))
)
found("note", "takes no seed")(variant("Seedless", reset=lambda walk: Walk.reset(walk, 7)))
found(
    "warning",
    "An environment warns",
    "wlaker",
    changes={"agent": lambda walk: "walker"},
    policies={"wlaker": abs},
)(variant("Misspelt"))


@found("error", "raises OSError", "closed in mid-episode: OSError: disk full")
class FailsWhenClosed(Walk):
    def run(self):
        try:
            super().run()
        finally:
            if self.number < self.steps - 1:
                raise OSError("disk full")


@found(
    "error", "same seed does not give the same run", "the clock is read (perf_counter)", "in choose"
)
class Timely(Walk):
    def choose(self):
        return time.perf_counter() % 1


@found(
    "error",
    "generators that the whole process shares (Python's random)",
    "global_rng=True",
    "in choose",
)
class Global(Walk):
    def choose(self):
        return random.choice([-1, 0, 1])


@found("error", "left over from earlier episodes", "walker_0")
class Heavy(Walk):
    luggage = 0

    def run(self):
        super().run()
        self.luggage += 1

    def observe(self):
        return [self.place, self.luggage]


@found("error", "disturb each other", "step")
class Together(Walk):
    board = {}  # noqa: RUF012 - that is what is wrong with it

    def reset(self, seed=None):
        super().reset(seed)
        self.board["place"] = 0.0

    def run(self):
        for _ in range(self.steps):
            change = self.choose() + self.random.random()
            self.board["place"] += change
            self.place = self.board["place"]


@found(
    "error",
    "raises KeyError",
    "in episode 3 of random legal actions, seed 2",
    "in run)",
    "the third",
    seeds=[0],
)
class FailsLate(Walk):
    played = 0

    def run(self):
        self.played += 1
        if self.played == 3:
            raise KeyError("the third")
        super().run()


found("error", "raises SystemExit", "in a plain run")(
    variant("FailsByItself", run=lambda walk: sys.exit("bye"))
)
found("note", "stopped before their end", "60 decisions")(variant("Endless", steps=10**9))


@found("error", "neither ends nor asks", "wait forever", time_limit=2)
class Stuck(Walk):
    def run(self):
        while True:
            self.place = 0.0


@found("error", "neither ends nor asks", "in episode ", time_limit=8)
class StuckByItsActions(Walk):
    """It swallows what is raised in it, too."""

    def run(self):
        if self.choose() < 1:
            while self.choose() != 1:
                pass
            while True:
                with contextlib.suppress(BaseException):
                    self.place = 0.0

    def choose(self):
        return self.random.choice([1, 2])


@found("note", "between two plain runs", "simulation.number_of_the_run")
class Numbered(Walk):
    numbers = itertools.count()

    def reset(self, seed=None):
        super().reset(seed)
        self.number_of_the_run = next(self.numbers)


@found("warning", "shares (Python's random)", "side by side")
class Seeding(Global):
    def reset(self, seed=None):
        super().reset(seed)
        random.seed(seed)


@pytest.mark.thorough
@pytest.mark.parametrize(("model", "changes", "options", "severity", "words", "told"), FOUND)
def test_check_simulation_finds_faults_of_models(model, changes, options, severity, words, told):
    report, seen = report_with(model, changes, options, severity, words, told)
    assert report.of("error") == ((seen,) if severity == "error" else ()), str(report)


def test_check_simulation_statistics_describe_the_checked_episodes():
    space = spaces.Dict({"still": spaces.Box(0, 1, (2,), np.float32), "which": spaces.Discrete(30)})
    changes = {
        "observation_space": space,
        "observation_space_mapping": lambda walk: {"still": [0.5, 0.25], "which": len(walk.log)},
    }
    report = checked(Walk, changes, episodes=2, seeds=[0])
    statistics = report.statistics[0]
    assert statistics.decisions == 2 * Walk.steps
    assert statistics.never_legal == ()
    assert [dataclasses.astuple(part) for part in statistics.observations] == [
        ("observation.still[0]", 0.5, 0.5, 0.5),
        ("observation.still[1]", 0.25, 0.25, 0.25),
        ("observation.which", 0, Walk.steps / 2, Walk.steps),  # once more at the end
    ]
    assert statistics.rewards.minimum <= statistics.rewards.mean <= statistics.rewards.maximum < 0
    assert report.episodes == {"terminated": 2, "truncated": 0, "cut": 0}
    assert "observation.still[1]: 0.25 to 0.25, mean 0.25" in str(report)
    assert "Episodes of random legal actions: 2 terminated" in str(report)


def test_check_report_prints_the_most_important_findings_first():
    changes = {
        "observation_space": spaces.Box(-1, 1, (2,), np.float32),
        "reward_mapping": lambda walk: 0,
    }
    report = checked(Walk, {"observation_space_mapping": moving, **changes})
    text = str(report)
    severities = [finding.severity for finding in report.findings]
    assert severities == sorted(severities, key=("error", "warning", "note").index)
    assert text.startswith("Walk: 2 errors, 1 warning")
    assert text.index("ERROR") < text.index("WARNING") < text.index("What was checked")
    assert all(len(line) <= 110 or "/" in line for line in text.splitlines())


def test_check_report_survives_pickling_and_json():
    report = checked(Walk, {"action_mask_mapping": lambda walk: [1, len(walk.log) % 2, 0]})
    assert finding(report, "never legal").evidence == "actions 2"
    assert pickle.loads(pickle.dumps(report)) == report
    assert report.statistics[0].never_legal == (2,)
    told = json.loads(json.dumps(report.to_dict(), allow_nan=False))
    assert told["ok"] is True
    assert told["findings"][0]["severity"] == "note"
    assert told["statistics"][0]["observations"][1]["name"] == "observation[1]"


def test_check_report_can_raise_its_errors_as_assertions():
    report = CheckReport(
        "Walk",
        (Finding("error", "It limps", "Mend it.", "at step 3"), Finding("note", "B", "C")),
        (),
    )
    with pytest.raises(CheckFailedError, match="It limps") as caught:
        report.raise_for_errors()
    assert "at step 3" in str(caught.value)
    assert "NOTE" not in str(caught.value)


def test_check_simulation_restores_generators_and_functions(capsys):
    class Loud(Walk):
        def run(self):
            print("hello")
            warnings.warn("careful", stacklevel=1)
            super().run()

    gc.collect()  # environments of earlier tests may still have patched the class
    before = vars(Walk)["choose"]
    random.seed(4)
    np.random.seed(4)
    expected = random.Random(4).random(), np.random.RandomState(4).rand()
    checked(Loud)
    inspect_simulation(Loud, points(Loud))
    assert capsys.readouterr() == ("", "")
    assert (random.random(), np.random.rand()) == expected
    assert vars(Walk)["choose"] is before


def test_check_simulation_passes_options_and_points_to_its_envs():
    report = check_simulation(
        Walk, points(Walk) | points(Walk, "rest", agent="rester_0"), episodes=3
    )
    assert finding(report, "rest was never called").severity == "warning"
    with pytest.raises(UnknownOptionError, match="polices"):
        checked(Walk, polices={})
    report = checked(Walk, flatten=True)  # which is of joint and turn views alone
    assert report.ok
    assert "single, joint, turn; drivers" in report.checked[0]
    assert checked(Walk, state_space=spaces.Box(0, 1, (1,), np.float32)).ok
    policies = {"ventilator_0": lambda observation: [0.5]}
    report = check_simulation(GreenhouseSim, policies=policies, episodes=1, seeds=[5])
    assert report.ok, str(report)  # in comparisons, what policies answer is left to the rule
    assert [part.agents for part in report.statistics] == ["waterer_0"]


def test_check_simulation_refuses_invalid_arguments():
    with pytest.raises(SimulationError, match="is not a simulation"):
        check_simulation(3, points(Walk))
    with pytest.raises(UnknownPointError, match="cannot be found"):
        check_simulation(Walk, "tests.testing.test_testing.Walk.chose")
    for wrong in (
        {"seeds": []},
        {"seeds": [-1]},
        {"episodes": 0},
        {"max_steps": 0},
        {"time_limit": 0},
    ):
        with pytest.raises(OptionValueError, match=next(iter(wrong))):
            checked(Walk, **wrong)


def test_check_simulation_stops_at_its_time_limit(monkeypatch):
    looks = itertools.count()
    # a second goes by between two looks
    monkeypatch.setattr(time, "monotonic", lambda: float(next(looks)))
    report = checked(Walk, time_limit=1000.0, episodes=1000)
    assert finding(report, "time limit").severity == "warning"
    assert next(looks) < 2000


def test_inspect_simulation_shows_points_calls_and_the_end():
    seen = inspect_simulation(GreenhouseSim)
    assert seen.calls == "(update_air_exchange choose_water_amount){9}"
    assert [point["agent"] for point in seen.points] == ["waterer_0", "ventilator_0"]
    assert seen.views == ("aec", "parallel", "joint", "turn")
    assert "terminated" in seen.ended
    assert "waterer_0" in str(seen)
    assert json.dumps(seen.to_dict())
    seen = inspect_simulation(Meadow, herd(), seed=5)
    assert "truncated" in seen.ended
    assert sum(seen.counts.values()) > 50
    assert any("removed_by" in point["uses"] for point in seen.points)
    views = "aec, parallel, turn, single with agent=, joint with possible_agents="
    assert f"Possible views: {views}" in str(seen)


def test_inspect_simulation_shows_where_a_model_fails():
    class Broken(Walk):
        def choose(self):
            return 1 // (3 - self.number)

    seen = inspect_simulation(Broken, points(Broken))
    assert seen.calls == "choose{4}"
    assert "ZeroDivisionError" in seen.ended


@pytest.mark.parametrize(
    ("calls", "told"),
    [
        ("aaaa", "a{4}"),
        ("aabaabc", "(a{2} b){2} c"),
        ("", ""),
        (["a.B.run", "a.C.walk"], "run walk"),
        (["a.B.run", "a.C.run"], "a.B.run a.C.run"),
        (
            [str(number) for number in range(50)] * 100,
            " ".join(map(str, range(30))) + " ... and 5000 calls in all",
        ),
    ],
)
def test_inspect_simulation_abbreviates_the_order_of_calls(calls, told):
    assert order_of(calls) == told


Thing = dataclasses.make_dataclass(
    "Thing", ["value", ("other", object, None)], eq=False, slots=True
)


def holding(**attributes):
    holder = Walk()
    vars(holder).update(attributes)
    return fingerprint("simulation", holder)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (1, True),
        (np.zeros(3), np.array([0.0, 0.0, -0.0])),
        ([1, 2], [2, 1]),
        ({"a": 1}, {"b": 1}),
        (Thing(1), Thing(2)),
        (np.random.default_rng(1), np.random.default_rng(2)),
        (itertools.islice, itertools.count),
        ([Thing(1)], [Thing(1), Thing(1)]),
    ],
)
def test_check_simulation_finds_every_kind_of_changed_attribute(one, other):
    assert differences(holding(it=one), holding(it=other))


@pytest.mark.parametrize(
    "make",
    [
        lambda: float("nan"),
        lambda: {"a": {1, "b"}, (1, 2): random.Random(3)},
        lambda: itertools.count(4),
        lambda: (n for n in range(3)),
        lambda: {Thing(1): 2},
        lambda: np.array([None, 1], object),
    ],
)
def test_check_simulation_finds_no_differences_between_equal_models(make):
    assert differences(holding(it=make()), holding(it=make())) == []


def test_check_simulation_compares_objects_that_refer_to_themselves():
    thing = Thing(1)
    thing.other = [thing]
    assert holding(it=thing)["simulation.it.other[0]"] == "the same object as simulation.it"


def test_check_simulation_compares_attributes_after_a_long_list():
    history = [[number] * 10 for number in range(10_000)]
    one, other = (holding(history=history, thing=random.Random(seed)) for seed in (1, 2))
    assert len(one) >= MOST_PARTS
    assert [path for path, _, _ in differences(one, other)] == [
        "simulation.thing (state of the generator)"
    ]


def test_check_simulation_counts_episodes_by_how_they_end():
    limited, endless = (
        variant("Limited", run=lambda walk: Walk.run(walk) or TRUNCATED),
        variant("Long", steps=10**9),
    )
    assert clean(checked(limited)).episodes == {"terminated": 0, "truncated": 4, "cut": 0}
    assert checked(endless).episodes == {"terminated": 0, "truncated": 0, "cut": 4}
    only_error(checked(endless, {"observation_space_mapping": moving}), OBSERVED)


def doubled(walk, _result):
    return ChangedResult(_result * 2)


@pytest.mark.parametrize(
    ("model", "options"),
    [(Global, {"global_rng": True}), (Walk, {"plugins": [(doubled, Walk.choose, "after")]})],
    ids=["global generators of its own", "plugins"],
)
def test_check_simulation_runs_the_model_without_env_but_with_plugins(model, options):
    """Models that draw from everybody's are cured; what plugins change, they change on purpose."""
    report = clean(checked(model, **options))
    assert "plain runs against RULE" in report.checked[0]
