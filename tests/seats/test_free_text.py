"""Free text: a space of any string up to a length, as an action and as an observation."""

import pickle
from copy import deepcopy
from dataclasses import replace
from functools import partial

import pytest
from gymnasium import spaces

from simenv_marl import aec_env, load_episode, save_episode, turn_env
from simenv_marl.errors import InvalidActionError, OptionValueError, ViewError
from simenv_marl.seats import RecordedPolicy, describe, free_text, parse
from simenv_marl.testing import check_simulation
from tests.worlds.seats import DRAIN, FILL, Tank, filling, played

SAID = 'Größer 大 "quotes" \n{x: 1} \N{GRINNING FACE}'


def litres_of(action):
    return len(action) / 20


POINTS = {Tank.fill: filling(free_text(40), litres_of)}


def heard(tank):
    return f"day {tank.day}"


@pytest.fixture
def env():
    env = aec_env(Tank, POINTS)
    env.reset(seed=1)
    return env


def test_free_text_space_contains_any_text_up_to_its_length():
    space = free_text(40)
    assert all(text in space for text in ("", SAID, "x" * 40))
    assert all(text not in space for text in ("x" * 41, 3, None, b"x"))
    assert repr(space) == "free_text(40)"
    assert space == free_text(40) == pickle.loads(pickle.dumps(space)) == deepcopy(space)
    assert space not in (free_text(41), spaces.Text(40))
    space.seed(1)
    samples = [space.sample() for _ in range(20)]
    assert all(sample in space for sample in samples)
    assert len(set(samples)) == 20


@pytest.mark.parametrize("number", [0, -1, 1.5, "9"])
def test_free_text_length_must_be_a_positive_integer(number):
    with pytest.raises(OptionValueError, match="n must be an integer of at least 1"):
        free_text(number)


def test_free_text_action_is_described_with_its_length(env):
    assert describe(env).endswith("Legal actions:\n- any text of at most 40 characters")
    schema = describe(env, as_json=True)["actions"]
    assert schema == {"type": "string", "maxLength": 40}


@pytest.mark.parametrize(
    ("text", "action"),
    [
        (SAID, SAID),
        ("I propose {price: 3}", "I propose {price: 3}"),
        ('{"price": 3}', '{"price": 3}'),  # without a key "action", an object is the text
        ('{"action": "yes", "why": "no"}', "yes"),
        ('I say {"action": ""}', ""),
        ('"yes"', "yes"),
        ("<think>no</think>\n yes\n", "yes"),
        ("3", "3"),
    ],
)
def test_free_text_answer_is_parsed_as_text_or_as_its_action(env, text, action):
    assert parse(env, text) == action


@pytest.mark.parametrize("text", ["x" * 41, '{"action": 3}', "<think>no"])
def test_free_text_refusal_of_an_answer_names_the_longest_length(env, text):
    with pytest.raises(InvalidActionError, match="any text of at most 40 characters"):
        parse(env, text)


def test_free_text_actions_are_repeated_by_recordings_and_episode_files(env, tmp_path):
    logs = [
        played(RecordedPolicy(policy, tmp_path / "answers"), points=POINTS)
        for policy in (lambda observation: SAID, pytest.fail)
    ]
    assert logs[0] == logs[1]
    env.step(SAID)
    save_episode(env, tmp_path / "episode")
    again = load_episode(tmp_path / "episode")
    assert again.unwrapped.simulation.level == env.unwrapped.simulation.level


class Lazy:
    """Loads itself when it is looked at, as modules of clients do."""

    @property
    def __class__(self):
        LAZY["loaded"] = 1
        return Lazy


LAZY = {"one": Lazy()}


def test_episode_file_is_written_despite_lazily_loaded_modules(env, tmp_path):
    LAZY.pop("loaded", None)
    env.step("yes")
    save_episode(env, tmp_path / "episode")
    assert "loaded" in LAZY


def test_free_text_can_be_an_observation():
    points = {
        Tank.fill: FILL,
        Tank.drain: replace(
            DRAIN,
            observation_space=free_text(9),
            observation_space_mapping=heard,
            observation_labels=None,
        ),
    }
    env = aec_env(Tank, points, possible_agents=["filler", "drainer"])
    env.reset(seed=1)
    assert env.observe("drainer") == ""  # before its first decision
    env.step(1)
    assert env.observe("drainer") == "day 0"
    assert "- day 0" in describe(env)
    with pytest.raises(ViewError, match=r"cannot\s+be: free_text"):
        turn_env(Tank, points)


@pytest.mark.thorough
def test_check_simulation_accepts_a_simulation_with_free_text():
    report = check_simulation(partial(Tank), POINTS, episodes=2)
    assert "error" not in {finding.severity for finding in report.findings}
