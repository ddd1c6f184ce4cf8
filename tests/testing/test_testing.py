"""Checks of simulations: each fault is found and named, and what is right stays clean."""

import contextlib
import dataclasses
import itertools
import json
import pickle
import random
import re
import subprocess
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
from examples.greenhouse_coop.env import GreenhouseSim
from gymnasium import spaces

import simenv_marl
from simenv_marl import TRUNCATED, SimEnvError, testing
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
from simenv_marl.testing.report import FINDINGS, order_of
from tests.contract.test_mesa import Meadow, Prison, herd, prisoners
from tests.worlds import many_worlds, worlds
from tests.worlds.models import define

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


def titles(report, severity=None):
    return [finding.title for finding in report.findings if severity in (None, finding.severity)]


def finding(report, words):
    """The one finding whose title has these words."""
    found = [finding for finding in report.findings if words in finding.title]
    assert len(found) == 1, str(report)
    return found[0]


def only_error(report, words):
    """The finding with these words, which is the only error."""
    assert titles(report, "error") == [finding(report, words).title], str(report)
    assert not report.ok
    return finding(report, words)


# -- what is right --------------------------------------------------------------------------------


def clean(report):
    assert report.ok, str(report)
    assert not report.of("warning"), str(report)
    return report


def test_a_sound_walk_is_clean():
    report = clean(checked(Walk))
    assert report.findings == ()
    assert "nothing to complain of" in str(report)
    report.raise_for_errors()
    assert any("aec, parallel, single, joint" in line for line in report.checked)


def test_the_greenhouse_is_clean():
    report = clean(check_simulation(GreenhouseSim))
    assert report.calls == "(update_air_exchange choose_water_amount){9}"
    assert [part.agents for part in report.statistics] == ["waterer_0", "ventilator_0"]


@pytest.mark.parametrize("kind", worlds.KINDS)
def test_worlds_are_clean(kind):
    design = worlds.Design((kind, "method"), tuple((number % 2, number % 3) for number in range(14)))
    functions = worlds.points_of(design)
    report = check_simulation(lambda: worlds.World(design, functions), functions, episodes=4)
    assert report.ok, str(report)
    assert titles(report, "warning") == []


def test_points_of_the_same_name_are_told_apart():
    design = worlds.Design(("method", "method"), tuple((number % 2, number % 3) for number in range(14)))
    functions = worlds.points_of(design)
    report = check_simulation(lambda: worlds.World(design, functions), functions, episodes=4)
    assert len({part.point for part in report.statistics}) == 1
    assert [(part.agents, part.decisions) for part in report.statistics] == [("point_0", 28), ("point_1", 28)]


@pytest.mark.parametrize("simulation", [many_worlds.Colony, many_worlds.Announcing])
def test_colonies_are_clean(simulation):
    design = many_worlds.Design(initial=4, most=10, ticks=6, overseen="before")
    clean(check_simulation(lambda: simulation(design), many_worlds.colony_points(overseen=True), episodes=4))


@pytest.mark.parametrize("simulation", [many_worlds.Hunt, many_worlds.AnnouncedHunt])
def test_entities_that_are_let_go_are_clean(simulation):
    report = check_simulation(simulation, many_worlds.hunters(), episodes=4)
    assert report.ok, str(report)


def test_wolves_and_sheep_are_clean():
    report = check_simulation(Meadow, herd(), episodes=3, max_steps=300, seeds=[5, 6])
    assert report.ok, str(report)
    assert titles(report, "warning") == []
    assert {part.point.rpartition("agents.")[2] for part in report.statistics} == {"Wolf.move", "Sheep.move"}


def test_prisoners_are_clean():
    report = check_simulation(Prison, prisoners(), episodes=2, max_steps=500, seeds=[3])
    assert report.ok, str(report)


def test_generators_of_the_process_are_left_as_they_were():
    random.seed(4)
    np.random.seed(4)
    expected = random.Random(4).random(), np.random.RandomState(4).rand()
    checked(Walk)
    inspect_simulation(Walk, points(Walk))
    assert (random.random(), np.random.rand()) == expected


def test_functions_are_left_as_they_were():
    before = vars(Walk)["choose"]
    checked(Walk)
    assert vars(Walk)["choose"] is before
    decorated = next(iter(points(Walk).values()))(Walk.observe)
    rule = decorated.__wrapped__
    assert rule is Walk.observe


# -- what behaves differently ---------------------------------------------------------------------


def test_a_mapping_that_changes_the_model():
    def observe(walk):
        walk.place += 0.25
        return walk.observe()

    found = only_error(checked(Walk, {"observation_space_mapping": observe}), "differently when it is observed")
    assert "aec view, driver greenlet, seed 0" in found.evidence
    assert "simulation.place is first" in found.evidence


def test_a_mapping_that_draws_from_the_models_generator():
    def reward(walk):
        return walk.random.random()

    found = only_error(checked(Walk, {"reward_mapping": reward}), "differently when it is observed")
    assert "state of the generator" in found.evidence
    assert "must not change it or draw random numbers" in found.explanation


def test_a_mapping_that_leaves_notes_in_the_model_is_warned_of():
    def reward(walk):
        walk.paid = walk.place
        return walk.place

    report = checked(Walk, {"reward_mapping": reward})
    assert report.ok
    assert "simulation.paid" in finding(report, "write into the model").evidence


def test_a_mask_that_changes_the_model():
    def legal(walk):
        walk.place -= 1
        return [1, 1, 1]

    only_error(checked(Walk, {"action_mask_mapping": legal}), "differently when it is observed")


def test_what_a_simulation_tells_of_itself_is_compared():
    class Secretive(Walk):
        def state(self):
            return np.array([self.place])

    def observe(walk):
        walk.unseen = walk.random.random() < 2
        return walk.observe()

    changes = {"observation_space_mapping": observe}
    assert not checked(Secretive, changes).ok  # the place, in the end
    found = only_error(checked(Walk, changes, fingerprint=lambda walk: [round(walk.place, 6)]), "differently when")
    assert found


def test_a_fingerprint_of_ones_own_leaves_out_what_it_leaves_out():
    def observe(walk):
        walk.seen = walk.number
        return walk.observe()

    changes = {"observation_space_mapping": observe}
    assert finding(checked(Walk, changes), "write into the model")
    clean(checked(Walk, changes, fingerprint=lambda walk: walk.place))


def test_mappings_that_draw_from_the_global_generators():
    changes = {"observation_space_mapping": lambda walk: [np.random.rand(), 0.0]}
    assert (
        "Mappings should only read the model" in only_error(checked(Walk, changes), "a mapping draws from").explanation
    )


def test_a_model_that_refuses_to_end():
    class Stubborn(Walk):
        def run(self):
            for _ in range(2000):
                with contextlib.suppress(BaseException):
                    self.choose()

    report = checked(Stubborn, episodes=1, seeds=[0])
    found = finding(report, "An environment warns")
    assert (found.severity, "refuses to end" in found.evidence) == ("warning", True)


def test_a_model_that_fails_when_it_is_closed():
    class Failing(Walk):
        def run(self):
            try:
                super().run()
            finally:
                if self.number < self.steps - 1:
                    raise OSError("disk full")

    assert "closed in mid-episode: OSError: disk full" in only_error(checked(Failing), "raises OSError").evidence


# -- seeds ----------------------------------------------------------------------------------------


class Unseeded(Walk):
    def reset(self, seed=None):
        super().reset()


def test_a_model_that_ignores_its_seed():
    found = only_error(checked(Unseeded), "same seed does not give the same run")
    assert "made without a seed" in found.evidence
    assert "test_testing.py" in found.evidence


def test_a_model_that_is_always_seeded_alike():
    class Alike(Walk):
        def reset(self, seed=None):
            super().reset(7)

    report = checked(Alike)
    assert report.ok, str(report)
    assert finding(report, "All seeds give the same episode").severity == "note"


def test_seeds_that_only_attributes_show():
    class Marked(Walk):
        def reset(self, seed=None):
            super().reset(7)
            self.mark = np.full(3, float(seed))

    report = checked(Marked)
    assert report.ok, str(report)
    assert not [title for title in titles(report) if "All seeds" in title]


def test_a_model_that_takes_no_seed():
    class Seedless(Walk):
        def reset(self):
            super().reset(7)

    report = checked(Seedless)
    assert report.ok, str(report)
    assert finding(report, "takes no seed").severity == "note"


def test_a_rule_that_depends_on_the_clock():
    class Timely(Walk):
        def choose(self):
            return time.perf_counter() % 1

    found = only_error(checked(Timely), "same seed does not give the same run")
    assert "the clock is read (perf_counter)" in found.evidence
    assert "in choose" in found.evidence


def test_what_differs_between_plain_runs_but_decides_nothing_is_no_error():
    numbers = itertools.count()

    class Numbered(Walk):
        def reset(self, seed=None):
            super().reset(seed)
            self.number_of_the_run = next(numbers)

    report = checked(Numbered)
    assert report.ok, str(report)
    assert "simulation.number_of_the_run" in finding(report, "between two plain runs").evidence


class Global(Walk):
    def choose(self):
        return random.choice([-1, 0, 1])


def test_a_model_that_draws_from_the_global_generators():
    found = only_error(checked(Global), "generators that the whole process shares (Python's random)")
    assert "global_rng=True" in found.explanation
    assert "in choose" in found.evidence

    class Legacy(Walk):
        def choose(self):
            return np.random.randint(3) - 1

    only_error(checked(Legacy), "the whole process shares (numpy.random)")


def test_a_model_that_seeds_the_global_generators_itself_is_warned_of():
    class Seeding(Global):
        def reset(self, seed=None):
            super().reset(seed)
            random.seed(seed)

    report = checked(Seeding)
    assert report.ok, str(report)
    assert "side by side" in " ".join(finding(report, "shares (Python's random)").explanation.split())


# -- episodes -------------------------------------------------------------------------------------


def test_state_that_is_left_over_between_episodes():
    class Heavy(Walk):
        luggage = 0

        def run(self):
            super().run()
            self.luggage += 1

        def observe(self):
            return [self.place, self.luggage]

    found = only_error(checked(Heavy), "left over from earlier episodes")
    assert "walker_0" in found.evidence


def test_state_that_is_left_over_in_the_class():
    class Shared(Walk):
        episodes: list = []  # noqa: RUF012 - that is what is wrong with it

        def reset(self, seed=None):
            super().reset(seed)
            self.episodes.append(seed)

        def observe(self):
            return [self.place, len(self.episodes)]

    found = only_error(checked(Shared), "same seed does not give the same run")
    assert "class attributes" in found.explanation.replace("\n", " ")


def test_environments_that_disturb_each_other():
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

    found = only_error(checked(Together), "disturb each other")
    assert "step" in found.evidence


def test_a_model_that_never_decides():
    class Silent(Walk):
        def run(self):
            pass

    found = only_error(checked(Silent), "The simulation never asks for a decision")
    assert "choose" in found.explanation


def test_a_model_that_raises_in_its_third_episode():
    class Brittle(Walk):
        played = 0

        def run(self):
            self.played += 1
            if self.played == 3:
                raise KeyError("the third")
            super().run()

    found = only_error(checked(Brittle, seeds=[0]), "raises KeyError")
    assert "in episode 3 of random legal actions, seed 2" in found.evidence
    assert "in run)" in found.evidence
    assert "the third" in found.evidence


def test_a_model_that_raises_by_itself():
    class Broken(Walk):
        def run(self):
            raise SystemExit("bye")

    found = only_error(checked(Broken), "raises SystemExit")
    assert "in a plain run" in found.evidence


def test_a_model_that_cannot_be_made():
    class Unmade(Walk):
        def __init__(self, needed):
            self.needed = needed

    found = only_error(checked(Unmade), "raises TypeError")
    assert "needed" in found.evidence


def test_actions_that_the_model_cannot_take():
    class Narrow(Walk):
        def run(self):
            for _ in range(self.steps):
                self.place += {-1: 0.5, 1: 1.5}[self.choose()]

        def choose(self):
            return 1

    found = only_error(checked(Narrow), "raises KeyError")
    assert "action_mask_mapping" in found.explanation
    assert "decision" in found.evidence


def test_a_model_that_never_ends():
    class Endless(Walk):
        def run(self):
            for number in itertools.count():
                self.number = number
                self.place = 0.9 * self.place + self.choose() + self.random.random()

    report = checked(Endless)
    assert report.ok, str(report)
    assert "60 decisions" in finding(report, "stopped before their end").explanation
    assert report.episodes == {"terminated": 0, "truncated": 0, "cut": 4}

    def observe(walk):
        walk.place += 1
        return walk.observe()

    only_error(checked(Endless, {"observation_space_mapping": observe}), "differently when it is observed")


def test_a_model_that_neither_ends_nor_decides():
    class Stuck(Walk):
        def run(self):
            while True:
                self.place = 0.0

    found = only_error(checked(Stuck, time_limit=2), "neither ends nor asks")
    assert "wait forever" in found.explanation


def test_a_model_that_gets_stuck_by_some_actions_and_swallows_what_is_raised_in_it():
    class Waiting(Walk):
        def run(self):
            while self.choose() != 1:
                pass
            while True:
                with contextlib.suppress(BaseException):
                    self.place = 0.0

        def choose(self):
            return self.random.choice([1, 2])

    class Rule(Waiting):
        def run(self):
            if self.choose() < 1:
                super().run()

    report = checked(Rule, time_limit=8)
    assert only_error(report, "neither ends nor asks").evidence.startswith("in episode ")


def test_an_agent_that_is_revived():
    class Undead(Walk):
        def run(self):
            for number in range(6):
                self.place = float(self.choose())
                if number == 2:
                    self.bury()

        def bury(self):
            pass

    definition = points(Undead, removed_by={f"{__name__}.Bury.bury": lambda walk: "walker_0"})
    Bury.bury = Undead.bury
    Undead.bury = lambda self: Bury.bury(self)
    report = check_simulation(Undead, definition, episodes=2)
    found = only_error(report, "raises AgentError")
    assert "after its end" in found.evidence
    assert "walker_0" in found.evidence


class Bury:
    def bury(self):
        pass


def test_errors_are_told_once():
    class Broken(Walk):
        def choose(self):
            return self.random.choice([0])

    def reward(walk):
        raise ZeroDivisionError

    report = checked(Broken, {"reward_mapping": reward})
    assert titles(report, "error") == ["The simulation raises ZeroDivisionError"]


# -- spaces and rewards ---------------------------------------------------------------------------


def test_observations_beyond_their_bounds():
    space = spaces.Box(-1, 1, (2,), np.float32)
    found = only_error(checked(Walk, {"observation_space": space}), "outside their space")
    assert "walker_0 has observed" in found.evidence
    assert "Box(-1.0, 1.0, (2,), float32)" in found.evidence


def test_observations_that_are_no_number():
    changes = {"observation_space_mapping": lambda walk: [float("nan"), 0.0]}
    found = only_error(checked(Walk, changes), "raises ObservationError")
    assert "nan" in found.evidence


def test_observations_of_the_wrong_shape():
    changes = {"observation_space_mapping": lambda walk: [1.0, 2.0, 3.0]}
    found = only_error(checked(Walk, changes), "raises ObservationError")
    assert "(3,)" in found.evidence


def test_observations_that_their_dtype_cannot_hold():
    space = spaces.Box(0, 255, (2,), np.uint8)
    changes = {"observation_space": space, "observation_space_mapping": lambda walk: np.array([-3, len(walk.log)])}
    found = only_error(checked(Walk, changes), "raises ObservationError")
    assert "numbers that uint8 cannot hold" in found.evidence


def test_statistics_are_those_of_the_episodes():
    space = spaces.Dict({"still": spaces.Box(0, 1, (2,), np.float32), "which": spaces.Discrete(30)})
    changes = {
        "observation_space": space,
        "observation_space_mapping": lambda walk: {"still": [0.5, 0.25], "which": len(walk.log)},
    }
    report = checked(Walk, changes, episodes=2, seeds=[0])
    statistics = report.statistics[0]
    assert statistics.decisions == 2 * Walk.steps
    assert [dataclasses.astuple(part) for part in statistics.observations] == [
        ("observation.still[0]", 0.5, 0.5, 0.5),
        ("observation.still[1]", 0.25, 0.25, 0.25),
        ("observation.which", 0, Walk.steps / 2, Walk.steps),  # once more at the end
    ]
    assert statistics.rewards.minimum <= statistics.rewards.mean <= statistics.rewards.maximum < 0
    assert report.episodes == {"terminated": 2, "truncated": 0, "cut": 0}
    assert "observation.still[1]: 0.25 to 0.25, mean 0.25" in str(report)
    assert "Episodes of random legal actions: 2 terminated" in str(report)


def test_masks_without_a_legal_action():
    changes = {"action_mask_mapping": lambda walk: [0, 0, 0] if len(walk.log) == 3 else [1, 1, 1]}
    found = only_error(checked(Walk, changes), "raises MaskError")
    assert "no legal action" in found.evidence
    assert "decision 4" in found.evidence


def test_masks_with_actions_that_the_model_cannot_take():
    class Narrow(Walk):
        def choose(self):
            return 0

        def run(self):
            for _ in range(self.steps):
                self.place += {-1: 0.5, 0: 1.0, 1: 1.5}[self.choose()]

    changes = {
        "action_space": spaces.Discrete(4),
        "action_mask_mapping": lambda walk: [1, 1, 0, 1],
        "action_space_mapping": lambda action: action - 1,
    }
    only_error(checked(Narrow, changes), "raises KeyError")


def test_actions_that_never_are_legal():
    report = checked(Walk, {"action_mask_mapping": lambda walk: [1, len(walk.log) % 2, 0]})
    assert report.ok, str(report)
    assert finding(report, "never legal").evidence == "actions 2"
    assert report.statistics[0].never_legal == (2,)


def test_rewards_that_are_no_number():
    changes = {"reward_mapping": lambda walk: float("nan") if len(walk.log) == 5 else 0.5}
    found = only_error(checked(Walk, changes), "raises RewardError")
    assert "nan" in found.evidence
    assert "walker_0" in found.evidence


def test_rewards_that_are_always_zero_or_the_same():
    assert finding(checked(Walk, {"reward_mapping": lambda walk: 0}), "always zero").severity == "warning"
    assert finding(checked(Walk, {"reward_mapping": lambda walk: 2}), "always the same").severity == "note"


def test_actions_that_change_nothing():
    class Deaf(Walk):
        def run(self):
            for _ in range(self.steps):
                self.choose()
                self.place += self.random.random()
                self.log.append(self.place)

        def choose(self):
            return 0

    report = checked(Deaf)
    assert finding(report, "agents do changes nothing").severity == "warning"


def test_points_that_are_never_called():
    class Both(Walk):
        def other(self):
            return 0

    named = points(Both) | points(Both, "other", agent="other_0")
    report = check_simulation(Both, named, episodes=3)
    assert finding(report, "other was never called").severity == "warning"


# -- reports --------------------------------------------------------------------------------------


def test_reports_read_as_text_with_the_most_important_first():
    def observe(walk):
        walk.place += 0.25
        return [200.0, 1.0]

    report = checked(Walk, {"observation_space_mapping": observe, "reward_mapping": lambda walk: 0})
    text = str(report)
    severities = [finding.severity for finding in report.findings]
    assert severities == sorted(severities, key=("error", "warning", "note").index)
    assert text.startswith("Walk: 2 errors, 2 warnings")
    assert text.index("ERROR") < text.index("WARNING") < text.index("What was checked")
    assert all(len(line) <= 110 or "/" in line for line in text.splitlines())


def test_reports_are_frozen_and_survive_pickling_and_json():
    report = checked(Walk, {"action_mask_mapping": lambda walk: [1, 1, 0]})
    with pytest.raises(dataclasses.FrozenInstanceError):
        report.findings = ()
    assert pickle.loads(pickle.dumps(report)) == report
    told = json.loads(json.dumps(report.to_dict(), allow_nan=False))
    assert told["ok"] is True
    assert told["findings"][0]["severity"] == "note"
    assert told["statistics"][0]["observations"][1]["name"] == "observation[1]"


def test_errors_are_raised_as_assertions():
    report = CheckReport("Walk", (Finding("error", "It limps", "Mend it.", "at step 3"), Finding("note", "B", "C")), ())
    with pytest.raises(CheckFailedError, match="It limps") as caught:
        report.raise_for_errors()
    assert isinstance(caught.value, AssertionError)
    assert isinstance(caught.value, SimEnvError)
    assert "at step 3" in str(caught.value)
    assert "NOTE" not in str(caught.value)


def test_all_findings_have_words_and_all_words_a_finding():
    words = {name for texts in FINDINGS.values() for name in texts}
    assert len(words) == sum(map(len, FINDINGS.values()))
    files = [path for path in Path(testing.__file__).parent.glob("*.py") if path.name != "report.py"]
    code = "".join(path.read_text(encoding="utf-8") for path in files)
    assert {name for name in words if f'"{name}"' not in code} == set()
    assert set(re.findall(r'(?:\.add|\bfinding)\(\s*"(\w+)"', code)) <= words


def test_nothing_is_printed_and_nothing_warned_of(capsys):
    class Loud(Walk):
        def run(self):
            print("hello")
            warnings.warn("careful", stacklevel=1)
            super().run()

    checked(Loud)
    inspect_simulation(Loud, points(Loud))
    assert capsys.readouterr() == ("", "")


def test_options_reach_the_environments():
    with pytest.raises(UnknownOptionError, match="polices"):
        checked(Walk, polices={})
    report = checked(Walk, flatten=True)  # which is of the joint view alone
    assert report.ok
    assert "single, joint; drivers" in report.checked[0]
    report = checked(Walk, state_space=spaces.Box(0, 1, (1,), np.float32))
    assert report.ok


def test_policies_answer_in_random_episodes_and_run_their_rule_in_comparisons():
    class Both(Walk):
        def run(self):
            for _ in range(self.steps):
                self.place += self.choose() + self.other()

        def other(self):
            return self.random.random()

    named = points(Both) | points(Both, "other", agent="other_0")
    report = check_simulation(Both, named, policies={"other_0": lambda observation: 2}, episodes=3)
    assert report.ok, str(report)
    assert [part.agents for part in report.statistics] == ["walker_0"]


def test_what_cannot_be_used_is_an_error_of_the_caller():
    with pytest.raises(SimulationError, match="is not a simulation"):
        check_simulation(3, points(Walk))
    with pytest.raises(UnknownPointError, match="cannot be found"):
        check_simulation(Walk, "tests.testing.test_testing.Walk.chose")
    for wrong in ({"seeds": []}, {"seeds": [-1]}, {"episodes": 0}, {"max_steps": 0}, {"time_limit": 0}):
        with pytest.raises(OptionValueError, match=next(iter(wrong))):
            checked(Walk, **wrong)


def test_the_time_limit_stops_the_check(monkeypatch):
    looks = itertools.count()
    monkeypatch.setattr(time, "monotonic", lambda: float(next(looks)))  # a second goes by between two looks
    report = checked(Walk, time_limit=1000.0, episodes=1000)
    assert finding(report, "time limit").severity == "warning"
    assert next(looks) < 2000


def test_the_library_does_not_import_its_checks():
    code = "import sys, simenv_marl; sys.exit('simenv_marl.testing' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, env=_environment()).returncode == 0
    assert not hasattr(simenv_marl, "check_simulation")


def _environment():
    import os

    return os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}


# -- inspection -----------------------------------------------------------------------------------


def test_inspection_of_the_greenhouse():
    seen = inspect_simulation(GreenhouseSim)
    assert seen.calls == "(update_air_exchange choose_water_amount){9}"
    assert [point["agent"] for point in seen.points] == ["waterer_0", "ventilator_0"]
    assert seen.views == ("aec", "parallel", "joint")
    assert "terminated" in seen.ended
    assert "waterer_0" in str(seen)
    assert json.dumps(seen.to_dict())


def test_inspection_of_wolves_and_sheep():
    seen = inspect_simulation(Meadow, herd(), seed=5)
    assert "truncated" in seen.ended
    assert sum(seen.counts.values()) > 50
    assert any("removed_by" in point["uses"] for point in seen.points)


def test_inspection_of_what_fails():
    class Broken(Walk):
        def choose(self):
            if self.number == 3:
                raise KeyError("three")
            return 0

    seen = inspect_simulation(Broken, points(Broken))
    assert seen.calls == "choose{4}"
    assert "KeyError" in seen.ended


def test_compression_of_calls():
    assert order_of("abababc") == "(a b){3} c"
    assert order_of("aaaa") == "a{4}"
    assert order_of("aabaab" + "c") == "(a{2} b){2} c"
    assert order_of("") == ""
    assert order_of("abcbababcbab") == "(a b c b{1} a b){2}".replace("b{1}", "b")
    long = order_of([str(number) for number in range(50)] * 100)
    assert long.startswith("0 1 2")
    assert long.endswith("... and 5000 calls in all")


def test_order_of_calls_by_names_that_tell_them_apart():
    assert order_of(["a.B.run", "a.C.walk"]) == "run walk"
    assert order_of(["a.B.run", "a.C.run"]) == "a.B.run a.C.run"


# -- fingerprints ---------------------------------------------------------------------------------


class Thing:
    __slots__ = ("other", "value")

    def __init__(self, value):
        self.value = value


def holding(**attributes):
    holder = Walk()
    vars(holder).update(attributes)
    return fingerprint("simulation", holder)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (1, 1.0),
        (1, True),
        (np.zeros(3), np.zeros(3, np.float32)),
        (np.zeros(3), np.array([0.0, 0.0, -0.0])),
        ([1, 2], [2, 1]),
        ({"a": 1}, {"b": 1}),
        ({1, 2}, {1, 3}),
        (Thing(1), Thing(2)),
        (random.Random(1), random.Random(2)),
        (np.random.default_rng(1), np.random.default_rng(2)),
        (itertools.islice, itertools.count),
        ([Thing(1)], [Thing(1), Thing(1)]),
    ],
)
def test_differences_are_seen(one, other):
    assert differences(holding(it=one), holding(it=other))


@pytest.mark.parametrize(
    "make",
    [
        lambda: float("nan"),
        lambda: [Thing(1), Thing(np.arange(3))],
        lambda: {"a": {1, "b"}, (1, 2): random.Random(3)},
        lambda: itertools.count(4),
        lambda: iter([1, 2]),
        lambda: open,
        lambda: (n for n in range(3)),
        lambda: {Thing(1): 2},
        lambda: np.array([None, 1], object),
    ],
)
def test_what_is_the_same_is_the_same(make):
    assert differences(holding(it=make()), holding(it=make())) == []


def test_things_that_refer_to_themselves_are_written_down():
    thing = Thing(1)
    thing.other = [thing]
    assert holding(it=thing)["simulation.it.other[0]"] == "the same object as simulation.it"


def test_a_long_history_does_not_hide_the_rest():
    history = [[number] * 10 for number in range(10_000)]
    one, other = (holding(history=history, thing=random.Random(seed)) for seed in (1, 2))
    assert len(one) >= MOST_PARTS
    assert [path for path, _, _ in differences(one, other)] == ["simulation.thing (state of the generator)"]


def test_a_simulation_that_truncates_by_itself_is_told_from_one_that_is_cut():
    class Limited(Walk):
        def run(self):
            super().run()
            return TRUNCATED

    report = clean(checked(Limited))
    assert report.episodes == {"terminated": 0, "truncated": 4, "cut": 0}


def test_global_generators_of_its_own_are_a_cure():
    """With them, the model that draws from everybody's is compared with its plain run like any other."""

    class Lottery(Walk):
        def run(self):
            for _ in range(4):
                self.place += self.choose() + random.uniform(-0.5, 0.5)
                self.log.append(self.place)

    assert not checked(Lottery).ok
    report = clean(checked(Lottery, global_rng=True))
    assert "plain runs against RULE" in report.checked[0]


def test_plugins_are_part_of_the_plain_run_too():
    """What an environment's plugins change, they change on purpose."""

    def doubled(walk, _result):
        return ChangedResult(_result * 2)

    report = clean(checked(Walk, plugins=[(doubled, Walk.choose, "after")]))
    assert "plain runs against RULE" in report.checked[0]


def test_objects_that_share_one_agent():
    """Nothing was said of agents, and several objects decide."""

    class Pair:
        def reset(self, seed=None):
            self.walks = [Walk(), Walk()]
            for number, walk in enumerate(self.walks):
                walk.reset(seed if seed is None else seed + number)

        def run(self):
            for _ in range(5):
                for walk in self.walks:
                    walk.place += walk.choose()

    found = finding(check_simulation(Pair, points(Walk, agent=None), episodes=2), "An environment warns")
    assert found.severity == "warning"
    assert "decide" in found.evidence
    assert "choose_0" in found.evidence
    one = check_simulation(Pair, points(Walk, agent="walkers"), episodes=2)
    assert not [title for title in titles(one) if "warns" in title]


def test_agents_that_options_name_and_that_never_come():
    report = checked(Walk, {"agent": lambda walk: "walker"}, policies={"wlaker": lambda observation: 0})
    assert "wlaker" in finding(report, "An environment warns").evidence
