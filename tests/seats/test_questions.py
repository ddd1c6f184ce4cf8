"""Questions and displays, which people and language models read."""

from dataclasses import replace

import numpy as np
import pytest

from simenv_marl import aec_env, simulate
from simenv_marl.errors import DefinitionError, NoDecisionError
from simenv_marl.testing import check_simulation
from tests.worlds.seats import FILL, POINTS, Tank


def decisions(points, **options):
    """Return the decisions of a policy, which has not looked at them."""
    seen = []

    def policy(observation, *, _decision):
        seen.append(_decision)
        return 1

    simulate(Tank, {"filler": policy}, points=points, seed=7, **options)
    return seen


def shown(**parts):
    """Return what each decision of an episode asks and displays."""
    seen = []

    def policy(observation, *, _decision):
        seen.append((_decision.question, _decision.display))
        return 1

    simulate(Tank, {"filler": policy}, points={Tank.fill: replace(FILL, **parts)}, seed=7)
    return seen


def test_question_of_make_step_is_a_text_or_a_function_of_the_arguments():
    assert {question for question, _ in shown(question="How much?")} == {"How much?"}
    asked = shown(question=lambda tank, *, _simulation: f"Day {_simulation.day}?")
    assert [question for question, _ in asked] == [f"Day {day}?" for day in range(5)]


@pytest.mark.parametrize(
    ("doc", "question"),
    [
        (None, ""),
        ("Fill the tank", "By its rule: Fill the tank"),
        ("Fill 1.5 units.  Never\n    more! Or less.\n\n    Args:", "By its rule: Fill 1.5 units."),
        ("\n    Fill it\n    again? Yes.", "By its rule: Fill it again?"),
    ],
)
def test_question_defaults_to_the_first_sentence_of_the_docstring(monkeypatch, doc, question):
    monkeypatch.setattr(Tank.fill, "__doc__", doc)
    assert decisions(POINTS)[0].question == question


def test_display_mapping_is_called_only_when_read_and_once():
    calls = []

    def display(tank):
        calls.append(tank.day)
        return {"level": f"{tank.level:.0f} m", "day": np.float32(tank.day)}

    points = {Tank.fill: replace(FILL, display_mapping=display)}
    seen = decisions(points)
    assert calls == []
    with pytest.raises(NoDecisionError, match="decision 1 of 'filler' was answered"):
        _ = seen[0].display

    def policy(observation, *, _decision):
        assert _decision.display is _decision.display
        return 1

    simulate(Tank, {"filler": policy}, points=points, seed=7)
    assert calls == [0, 1, 2, 3, 4]


def test_display_mapping_is_called_with_the_arguments_of_the_call():
    seen = shown(display_mapping=lambda tank: {"level": tank.level, "day": str(tank.day)})
    assert seen[0] == ("By its rule: Choose how much water flows in.", {"level": 5.0, "day": "0"})
    assert shown()[0][1] is None


def test_question_can_be_given_for_split_items():
    class Ward:
        def reset(self, seed=None):
            self.log = []

        def run(self):
            self.log += self.treat(["Ann", "Bob"])

        def treat(self, names):
            return [0 for name in names]

    definition = replace(
        FILL,
        agent=lambda name, ward, names: name,
        split=lambda ward, names: names,
        observation_space_mapping=lambda name: [1],
        reward_mapping=lambda name: 0.0,
        question=lambda name: f"What does {name} get?",
        display_mapping=lambda name, ward, names: {"waiting": len(names)},
    )
    seen = []

    def policy(observation, *, _decision):
        seen.append((_decision.question, _decision.display["waiting"]))
        return 1

    simulate(Ward, {"Ann": policy, "Bob": policy}, points={Ward.treat: definition})
    assert seen == [("What does Ann get?", 2), ("What does Bob get?", 2)]


@pytest.mark.parametrize(
    ("part", "value"),
    [
        ("question", lambda tank: 3),
        ("display_mapping", lambda tank: ["level"]),
        ("display_mapping", lambda tank: {"level": [tank.level]}),
        ("display_mapping", lambda tank: {0: tank.level}),
    ],
)
def test_question_and_display_mapping_that_return_no_text_are_refused(part, value):
    with pytest.raises(DefinitionError, match=f"{part} of .*fill has returned"):
        shown(**{part: value})
    report = check_simulation(Tank, {Tank.fill: replace(FILL, **{part: value})})
    assert f"{part} of" in str(report)


@pytest.mark.parametrize("parts", [{"question": ""}, {"question": 3}, {"display_mapping": {}}])
def test_make_step_refuses_invalid_question_and_display_mapping(parts):
    with pytest.raises(DefinitionError, match=f"{next(iter(parts))} must be"):
        replace(FILL, **parts)


def test_display_mapping_can_take_an_argument_that_no_other_mapping_takes():
    class Shop(Tank):
        def run(self):
            self.log.append(self.order("nails", 3))

        def order(self, name, number):
            return number

    definition = replace(FILL, display_mapping=lambda shop, name, number: {name: number})
    env = aec_env(Shop, {Shop.order: definition})
    env.reset(seed=1)
    episode = env.unwrapped.episode
    assert episode.decision_of(episode.deciding).display == {"nails": 3}
