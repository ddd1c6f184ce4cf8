"""Pending decisions as text and as JSON, and texts as actions, by the labels of the model."""

import json
from dataclasses import dataclass, replace
from enum import Enum
from itertools import compress
from typing import NamedTuple

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import RULE, aec_env, clone, joint_env, parallel_env, single_env
from simenv_marl.data import collect_episodes, plot_timeline
from simenv_marl.errors import (
    DefinitionError,
    InvalidActionError,
    NotResetError,
    SimEnvError,
    ViewError,
)
from simenv_marl.seats import describe, parse
from tests.worlds.seats import FILL, POINTS, Tank, filling, played


def env_of(definition=FILL):
    env = single_env(Tank, {Tank.fill: definition})
    env.reset(seed=1)
    return env


def test_describe_tells_a_pending_decision_in_words():
    env = aec_env(Tank, POINTS)
    env.reset(seed=1)
    env.step(2)
    env.step(RULE)
    assert describe(env).splitlines() == [
        "filler decides (decision 2, time 1).",
        "By its rule: Choose how much water flows in.",
        "Observation:",
        f"- level: {env.observe('filler')[0]!s}",
        f"Reward of the previous action: {env.unwrapped.simulation.level!r}",
        "Legal actions:",
        "- closed",
        "- half",
        "- open",
    ]


def test_describe_returns_a_pending_decision_as_json():
    found = describe(env_of(), as_json=True)
    assert json.loads(json.dumps(found)) == {
        "agent": "filler",
        "point": "tests.worlds.seats.Tank.fill",
        "number": 1,
        "time": 0.0,
        "question": "By its rule: Choose how much water flows in.",
        "observation": {"level": 5.0},
        "actions": {"type": "string", "enum": ["closed", "half", "open"]},
        "reward": 0.0,
    }


def test_describe_uses_question_and_display_mapping_if_they_are_given():
    env = env_of(replace(FILL, question="How much?", display_mapping=lambda tank: {"m": "5 of 9"}))
    assert describe(env).splitlines()[1:4] == ["How much?", "Observation:", "- m: 5 of 9"]
    found = describe(env, as_json=True)
    assert (found["question"], found["observation"]) == ("How much?", {"m": "5 of 9"})


@pytest.mark.parametrize("view", [aec_env, parallel_env, joint_env, single_env])
def test_describe_is_the_same_in_every_env_and_its_clones(view):
    env, words = view(Tank, {Tank.fill: FILL}), describe(env_of())
    for use in (describe, lambda env: parse(env, "open")):
        with pytest.raises(NotResetError):
            use(env)
    env.reset(seed=1)
    assert describe(env) == words
    assert parse(env, "open") == 2
    for method in ("fork", "replay"):
        twin = clone(env, method=method)
        assert describe(twin) == words
        assert parse(twin, "open") == 2
        twin.close()


def test_describe_of_a_policys_decision_equals_that_of_its_env():
    said = []

    def policy(observation, *, _decision):
        assert repr(_decision).endswith(" in_clone=False)")
        said.append(describe(_decision))
        return parse(_decision, "closed")

    played(policy, seed=1)
    assert said[0] == describe(env_of())


# By labels, of which those in brackets are masked: texts, and the numbers of the actions they name.
SAID = {
    ("closed", "half", "open"): {
        **dict.fromkeys(
            ["open", " Open ", '"open"', '{"action": "open"}', "2", '{"action": 2}'], 2
        ),
        **dict.fromkeys(
            ["ajar", "3", "-1", "", "{}", '{"action": null}', "[1]", "true", "1.5", "open closed"]
        ),
    },
    ("1", "2", "3"): {"1": 0, "2": 1, '{"action": "3"}': 2, '{"action": 2.0}': 1, "0": None},
    ("R", "R'", "U"): {"R'": 1},
    ("bxc3", "Bxc3", "a"): {"bxc3": 0, "Bxc3": 1, "I play Bxc3.": None},
    (" open", "shut", "ajar"): {" open": 0},
    ("1.5", "2", "3"): {"1.50": 0},
    ("open", "half open", "shut"): {
        "I choose half open; half open is safe.": 1,
        "half\nopen": 1,
        "half-open": None,
        '```json\n{"action": "shut"}\n```': 2,
        'Perhaps {"action": "open"}, or rather {"action": "shut"}.': 2,
    },
    ("OPEN", "open", "shut"): {"Open": None},
    # What is said in JSON is not searched as text.
    ("buy", "sell", "hold"): {
        '{"action": "buy", "reason": "to hold would not pay"}': 0,
        '{"reason": "to hold would not pay", "Action": "BUY", "sure": true}': 0,
        'I hold it wise: ```json\n{"action": "sell", "of": {"buy": 1}}\n``` and hold.': 1,
        '{"move": "sell", "why": "to hold is bad"}': 1,
        '{"action": ...} means {"action": "hold"}': 2,
        **dict.fromkeys(
            [
                '{"action": "I hold"}',
                '{"action": "none", "instead": "buy"}',
                '{"move": "sell", "or": "buy"}',
                '{"action": "buy", "action": "sell"}',
                '{"reason": "to hold would be',  # it was cut off
                '{"rejected": {"action": "buy"}, "act',
                '["buy"]',
                "[" * 99999,
                '{"a":' * 99999,
            ]
        ),
    },
    # Reasoning is not an answer.
    ("up", "down", "stay"): {
        "<think>up or down?</think> stay": 2,
        '<THINKING>{"action": "up"}</THINKING>\n{"action": "down"}': 1,
        "up or down?</think>down": 1,
        "[THINK]up[/THINK]**Stay**": 2,
        "<think>up or down? up": None,
        "<think></think>": None,
    },
    # A text says one label as a whole word, and does not deny it.
    ("wait", "[wait for truck]", "go"): {
        "I wait.": 0,
        "_Go_!": 2,
        **dict.fromkeys(
            [
                *["wait for truck", "Wait for\ntruck!", "1", '{"action": "wait for truck"}'],
                *["go, not wait", "go/wait", "waiting", "go-around", "I do not go", "Don't wait!"],
                *["go rather than wait for truck", "go\u2014not wait for truck"],
            ]
        ),
    },
    ("buy it", "[sell]", "hold"): {"sell, not buy it": None, "sell": None, "HOLD": 2},
    # Signs and digits have many forms.
    ("-2", "2", "x"): {
        **dict.fromkeys(
            ["-2", "\u22122", "- 2", "\u2013 2", "\uff0d\uff12", '{"action": "- 2"}'], 0
        ),
        **dict.fromkeys(["I say \u22122!", "answer: - 2", "-2.0", '{"action": -2}'], 0),
        **dict.fromkeys(["2", "\uff12", "+2", '{"action": 2}', "2 of 7"], 1),
        **dict.fromkeys(["1-2", "1", "2.5", ".2", "x-2", "2, x", "0"]),
    },
    ("10", "\u221220", "30"): {"-20": 1, "1": None, '{"action": 2}': None, "30.0": 2},
}


@pytest.mark.parametrize(
    ("labels", "said"), [(labels, said) for labels in SAID for said in SAID[labels]]
)
def test_parse_returns_one_legal_action_or_an_error_lists_them(labels, said):
    mask = [not label.startswith("[") for label in labels]
    texts = [label.strip("[]") for label in labels]
    env = env_of(
        replace(FILL, action_labels=texts, action_mask_mapping=lambda tank: np.array(mask, np.int8))
    )
    action = SAID[labels][said]
    if action is None:
        legal = "\n".join(f"- {text}" for text in compress(texts, mask))
        with pytest.raises(InvalidActionError, match=f"'filler'; these are legal:\n{legal}$"):
            parse(env, said)
    else:
        assert parse(env, said) == action


def test_describe_omits_masked_actions():
    env = env_of(replace(FILL, action_mask_mapping=lambda tank: [1, 0, 1]))
    assert "half" not in describe(env)
    assert describe(env, as_json=True)["actions"] == {"type": "string", "enum": ["closed", "open"]}


class Valve(Enum):
    CLOSED = 0
    HALF = 1
    OPEN = 2


class Move(NamedTuple):
    piece: str
    hours: float


@dataclass
class Job:
    number: int
    start: float


class Plain:
    pass


CHOICES = {
    "numbers": ([np.float64(8.0), np.int64(3), np.float32(0.1)], ["8.0", "3", "0.1"]),
    "records": (
        [Move("rook", np.float64(8.0)), Job(2, np.float32(0.1)), Valve.OPEN],
        ["Move(piece='rook', hours=8.0)", "Job(number=2, start=0.1)", "Valve.OPEN"],
    ),
    "containers": (
        [(np.int64(1), "a"), [np.float64(0.5)], {"x": np.float64(2.0)}],
        ["(1, 'a')", "[0.5]", "{'x': 2.0}"],
    ),
    "equal": ([Plain(), Plain(), "Plain (1)"], ["Plain (0)", "Plain (1) (1)", "Plain (1) (2)"]),
    "like numbers of actions": (["2", "2"], ["2 (0)", "2 (1)"]),
    "blank": (["", " "], ["''", "' '"]),
}


@pytest.mark.parametrize("kind", CHOICES)
def test_describe_labels_each_choice_differently(kind):
    choices, labels = CHOICES[kind]
    env = env_of(
        replace(FILL, action_labels=None, action_space_mapping=None, choices=lambda tank: choices)
    )
    assert describe(env, as_json=True)["actions"]["enum"] == labels
    assert [parse(env, label) for label in labels] == list(range(len(labels)))


@pytest.mark.parametrize(("labels", "decisions", "enum"), [
    (None, {0: 0.0, 1: 1.0, 2: 2.0}, ["0.0", "1.0", "2.0"]),
    (None, {0: "no", 1: [2], 2: "no"}, ["no (0)", "[2]", "no (2)"]),
    (lambda tank: {0: "1"}, str, ["1", "1 (1)", "2"]),
])  # fmt: skip
def test_describe_labels_actions_by_their_decision_or_number(labels, decisions, enum):
    env = env_of(replace(FILL, action_labels=labels, action_space_mapping=decisions))
    assert describe(env, as_json=True)["actions"]["enum"] == enum


def test_action_labels_can_be_a_function_of_the_arguments():
    env = env_of(
        replace(
            FILL, action_labels=lambda tank: [f"{litres} of {tank.level}" for litres in range(3)]
        )
    )
    assert parse(env, "2 of 5.0") == 2
    for labels in (["one"], {1: "one", 2: "two", 3: "three"}, ["one", "two", "one"]):
        bad = env_of(replace(FILL, action_labels=lambda tank, labels=labels: labels))
        with pytest.raises(
            DefinitionError, match=r"labels of .*Tank.fill for a call are .*, which are not texts"
        ):
            describe(bad)


SPACES = {
    "number": (
        spaces.Box(0, 2, (1,)),
        None,
        ["1.5", "[1.5]", '{"action": 1.5}', '{"valve": 1.5}', "\uff11.5"],
        [1.5],
    ),
    "numbers": (
        spaces.Box(0, 2, (2,)),
        ["in", "out"],
        ['{"in": 1, "out": 0.5, "why": "in"}', "[1, 0.5]", "1, 0.5", '["+1", "0.5"]'],
        [1, 0.5],
    ),
    "below": (
        spaces.Box(-9, 0, (2,)),
        None,
        ["\u22122, - 3", '{"0": "\u2212 2", "1": -3}', "```\n[-2, -3]\n```"],
        [-2, -3],
    ),
    "counts": (spaces.MultiDiscrete([3, 4]), ["a", "b"], ['{"a": 2, "b": 3}', "[2, 3]"], [2, 3]),
    "switches": (spaces.MultiBinary(2), None, ["[1, 0]", '{"0": 1, "1": 0}'], [1, 0]),
    "parts": (
        spaces.Dict({"kind": spaces.Discrete(3), "size": spaces.Box(0, 9, (1,))}),
        {"kind": "Kind", "size": "Size in m"},
        ['{"Kind": 2, "Size in m": 4}', '{"action": {"kind": 2, "size": 4}, "why": "kind 1"}'],
        {"kind": 2, "size": [4]},
    ),
    "pair": (
        spaces.Tuple([spaces.Discrete(3), spaces.Discrete(2)]),
        None,
        ["[2, 1]", '{"0": 2, "1": 1}', "2 1"],
        (2, 1),
    ),
    "text": (
        spaces.Text(4, charset="abc "),
        None,
        ["ab", " ab\n", '"ab"', '{"action": "ab", "why": "c"}', "<think>c</think>```\nab\n```"],
        "ab",
    ),
}


@pytest.mark.parametrize("kind", SPACES)
def test_parse_reads_actions_of_other_spaces_from_json(kind):
    space, labels, texts, action = SPACES[kind]
    env = env_of(filling(space, action_labels=labels))
    for text in texts:
        found = parse(env, text)
        assert space.contains(found)
        np.testing.assert_equal(found, action)
    for text in ("[9, 9, 9]", '{"valve": 77}', "many", "[77, 77]", "{}", "abcab"):
        with pytest.raises(InvalidActionError, match="these are legal"):
            parse(env, text)
    for name in labels or ():
        assert (labels[name] if isinstance(labels, dict) else name) in describe(env)


def test_describe_json_schema_has_bounds_and_labels_of_numbers():
    def schema(space, **labels):
        return describe(env_of(filling(space, **labels)), as_json=True)["actions"]

    amount = spaces.Box(0, 2, (1,))
    found = schema(
        spaces.Dict(
            {"a": amount, "b": spaces.Box(-np.inf, 1, (2,)), "c": spaces.Discrete(3, start=1)}
        )
    )
    assert found["required"] == ["a", "b", "c"]
    assert found["additionalProperties"] is False
    assert found["properties"]["a"] == {"type": "number", "minimum": 0.0, "maximum": 2.0}
    assert found["properties"]["b"]["properties"]["1"] == {"type": "number", "maximum": 1.0}
    assert found["properties"]["c"] == {"type": "integer", "minimum": 1, "maximum": 3}
    pair = schema(spaces.MultiDiscrete([3, 4]))["properties"]
    assert pair == {
        str(at): {"type": "integer", "minimum": 0, "maximum": 2 + at} for at in range(2)
    }
    assert schema(amount, action_labels=["litres"]) == found["properties"]["a"] | {
        "description": "litres"
    }
    assert describe(env_of(filling(amount, action_labels=["litres"]))).endswith(
        "\n- litres: a number from 0 to 2"
    )
    assert schema(spaces.Text(3, min_length=2, charset="a-]b")) == {
        "type": "string",
        "minLength": 2,
        "maxLength": 3,
        "pattern": r"^[\-\]ab]*$",
    }
    with pytest.raises(ViewError, match="cannot be put into words"):
        schema(spaces.Box(0, 1, (2, 2)))


def test_describe_names_components_of_an_observation_by_labels():
    definition = replace(
        FILL,
        observation_space=spaces.Dict(
            {"level": spaces.Box(-50, 50, (1,)), "day": spaces.Discrete(9)}
        ),
        observation_space_mapping=lambda tank: {"level": [tank.level], "day": tank.day},
        observation_labels={"level": "Level in m", "day": "Day"},
    )
    assert describe(env_of(definition), as_json=True)["observation"] == {
        "Day": 0,
        "Level in m": [5.0],
    }


@pytest.mark.parametrize(("dtype", "lines"), [
    ("f4", ["- a: 16777218", "- b: 0.1", "- c: 0.33333334", "- d: 2"]),
    ("f8", ["- a: 16777217.5", "- b: 0.1", "- c: 0.3333333333333333", "- d: 2"]),
])  # fmt: skip
def test_describe_keeps_all_significant_digits_of_numbers(dtype, lines):
    definition = replace(
        FILL,
        observation_space=spaces.Box(-np.inf, np.inf, (4,), dtype),
        observation_space_mapping=lambda tank: [16777217.5, 0.1, 1 / 3, 2.0],
        observation_labels=list("abcd"),
    )
    assert describe(env_of(definition)).splitlines()[3:7] == lines


def test_plot_timeline_names_actions_by_their_labels():
    trajectories = collect_episodes(Tank, {"filler": RULE}, seeds=[1], points=POINTS)
    axes = plot_timeline(trajectories).axes
    assert "half" in {label.get_text() for one in axes for label in one.get_yticklabels()}


@pytest.mark.parametrize("labels", [
    *[{"action_labels": labels} for labels in (["a", "b"], {0: "a", 1: "b"}, "abc", ["a", "b", 3])],
    *[{"action_labels": labels} for labels in (["a", "b", "a"], ["a", "b", " "], Valve)],
    *[{"observation_labels": labels} for labels in (["a", "b"], {"level": "a"})],
    {"observation_labels": ["a", "a"], "observation_space": spaces.Box(0, 1, (2,))},
    {"observation_labels": ["a", "b"], "observation_space": spaces.Box(0, 1, (2, 2))},
])  # fmt: skip
def test_make_step_refuses_labels_that_do_not_fit_their_space(labels):
    with pytest.raises(SimEnvError, match=f"{next(iter(labels))} must be texts for the parts"):
        replace(FILL, **labels)
