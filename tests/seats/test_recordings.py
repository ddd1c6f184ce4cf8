"""Recordings of answers, which are repeated without asking."""

import asyncio
import json
import random
import time
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import RULE, evaluate
from simenv_marl.data import collect_episodes
from simenv_marl.errors import OptionValueError
from simenv_marl.files.values import digest_of
from simenv_marl.seats import FallbackPolicy, LanguageModelPolicy, RecordedPolicy
from tests.worlds.seats import FILL, POINTS, Tank, filling, levels, played


@pytest.fixture
def path(tmp_path):
    return tmp_path / "answers.jsonl"


def lines_of(path):
    """Return the lines of a recording, without the run that has written them."""
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    return [line for line in lines if line.pop("run")]


class Asked:
    """A policy that counts how often it is asked."""

    def __init__(self):
        self.times = 0

    def __call__(self, observation, *, _decision):
        self.times += 1
        return RULE if _decision.number == 2 else int(observation[0] * 1000) % 3


class Waiting(Asked):
    async def __call__(self, observation, *, _decision):
        await asyncio.sleep(0)
        return super().__call__(observation, _decision=_decision)


def raises(observation):
    raise ZeroDivisionError


@pytest.mark.parametrize("kind", [Asked, Waiting])
def test_recorded_policy_repeats_its_seeds_without_calling_the_policy(kind, path):
    first = kind()
    recorded = levels(RecordedPolicy(first, path), range(4))
    assert first.times == len(lines_of(path)) == 20
    line = lines_of(path)[0]
    assert line.keys() == {"seed", "agent", "number", "observation", "legal", "action", "by"}
    assert line["agent"] == "filler"
    second = kind()
    repeated = levels(RecordedPolicy(second, path), range(5))
    assert repeated[:4] == recorded == levels(kind(), range(4))
    assert second.times == 5  # those of the new seed


def test_recorded_policy_loses_only_the_torn_last_line_of_its_file(path):
    def asked_again():
        policy = Asked()
        assert played(RecordedPolicy(policy, path)) == played(Asked())
        return policy.times

    assert asked_again() == 5
    path.write_text(path.read_text()[:-9])
    assert asked_again() == 1
    assert len(path.read_text().splitlines()) == 6  # the torn one was ended
    assert asked_again() == 0
    path.write_text('"no answer"\n')
    with pytest.warns(UserWarning, match=r"line 1 of .* is no answer"):
        assert asked_again() == 5


# -- fallbacks ------------------------------------------------------------------------------------


async def unreliable(observation, *, _decision):
    """Fail in six ways, or answer."""
    match (_decision.number + _decision.seed) % 6:
        case 0:
            raise ConnectionError("busy")
        case 1:
            await asyncio.sleep(5)
        case 2:
            return 7
        case 3:
            return RULE
    return int(observation[0] * 1000) % 3


def slow(observation, *, _decision):
    """Answer late now and then; the time is measured afterwards."""
    if _decision.number % 2:
        time.sleep(0.06)
    return 2


def by_chance(observation):
    return random.SystemRandom().randrange(3)


def nested(outer, policy, path, **options):
    """Put a fallback that cannot be repeated outside of a recording, or inside."""
    guard = partial(FallbackPolicy, fallback=by_chance, timeout=0.05, **options)
    if outer is FallbackPolicy:
        guarded = guard(RecordedPolicy(policy, path))
        return guarded, guarded
    guarded = guard(policy)
    return RecordedPolicy(guarded, path), guarded


@pytest.mark.thorough
@pytest.mark.parametrize("policy", [unreliable, slow])
@pytest.mark.parametrize("outer", [FallbackPolicy, RecordedPolicy])
def test_fallback_and_recorded_policy_repeat_a_run_in_either_nesting(policy, outer, path):
    def run(outer, policy):
        decided, guarded = nested(outer, policy, path, retries=1)
        found = evaluate(Tank, {"guarded": {"filler": decided}}, seeds=range(3), points=POINTS)
        seats = found.seats.drop(columns="seconds").to_dict("index")
        return found.frame.to_dict("index"), seats, found.summary().to_dict(), guarded.counts

    first = run(outer, policy)
    assert first[-1]["fallbacks"] > 0
    assert len(lines_of(path)) == 15
    for other in (outer, FallbackPolicy, RecordedPolicy):
        failing = slow if policy is slow else raises  # neither one is asked
        assert run(other, policy) == run(other, failing) == first
    by_fallback = [line for line in lines_of(path) if line["by"] == "fallback"]
    assert len(by_fallback) == first[-1]["fallbacks"]
    assert all(line["why"] for line in by_fallback)


def test_recorded_policy_repeats_extras_of_a_policy(path):
    def sure(observation):
        return 1, {"confidence": np.float32(observation[0]), "votes": np.array([1, 2])}

    def extras(policy):
        guarded = FallbackPolicy(RecordedPolicy(policy, path))
        found = collect_episodes(Tank, {"filler": guarded}, seeds=[1], points=POINTS)["filler"]
        return found.extras

    first = extras(sure)
    assert first["confidence"].dtype == np.float32
    np.testing.assert_equal(extras(raises), first)


def test_recorded_policy_does_not_record_illegal_actions(path):
    with pytest.raises(ValueError, match="not in its action space"):
        played(RecordedPolicy(lambda observation: 9, path))
    assert not path.exists()


# -- which answer belongs to which decision -------------------------------------------------------


def test_recorded_policy_refuses_an_episode_with_other_observations(path):
    class Fuller(Tank):
        def reset(self, seed=None):
            super().reset(seed)
            self.level = 6.0

    levels(RecordedPolicy(Asked(), path), [1, 2])
    recorded = path.read_text()
    changed = {Fuller.fill: FILL}
    with pytest.raises(OptionValueError, match=r"decision 1 of 'filler'.*5 to .*its observation"):
        played(RecordedPolicy(Asked(), path), 1, changed, simulation=Fuller)
    assert path.read_text() == recorded
    played(RecordedPolicy(Asked(), path), 3, changed, simulation=Fuller)  # it has no answers yet
    assert len(lines_of(path)) == 15


def test_recorded_policy_refuses_an_episode_with_other_legal_actions(path):
    played(RecordedPolicy(Asked(), path))
    for part in (
        {"action_mask_mapping": lambda tank: [1, 1, tank.level < 5.1]},
        {"action_labels": ["shut", "half", "open"]},
    ):
        with pytest.raises(OptionValueError, match="its legal actions and the recorded ones"):
            played(RecordedPolicy(Asked(), path), points={Tank.fill: replace(FILL, **part)})


def test_recorded_policy_continues_its_file_if_the_episode_is_longer(path, monkeypatch):
    played(RecordedPolicy(Asked(), path))
    monkeypatch.setattr(Tank, "days", 8)
    policy = Asked()
    played(RecordedPolicy(policy, path))
    assert policy.times == 3


def test_recorded_policy_refuses_answers_of_another_language_model(path):
    def policy(model="small", **options):
        async def create(*, messages, **request):
            message = SimpleNamespace(content='{"action": "open"}')
            return SimpleNamespace(choices=[SimpleNamespace(message=message)])

        chat = SimpleNamespace(completions=SimpleNamespace(create=create))
        client = SimpleNamespace(chat=chat)
        return RecordedPolicy(LanguageModelPolicy(model, client=client, **options), path)

    first = played(policy())
    assert played(policy()) == first
    with pytest.raises(OptionValueError, match="its model is 'small', and now 'large'"):
        played(policy("large"))
    for other in (
        policy(instructions="Be quick."),
        FallbackPolicy(policy(describe=lambda decision: "What now?")),
    ):
        with pytest.raises(OptionValueError, match="its prompt is"):
            played(other)


class Shuffled(Tank):
    """A tank that asks twice a day, in an order that differs from run to run."""

    order = (0, 1)

    def run(self):
        answers = {}
        for self.day in range(3):
            for level in self.order:
                self.level = level
                answers[self.day, level] = self.fill()
        self.log = sorted(answers.items())


def test_recorded_policy_finds_answers_in_any_order_of_decisions(path, monkeypatch):
    points = {
        Shuffled.fill: replace(
            FILL, observation_space_mapping=lambda tank: [tank.day * 2 + tank.level]
        )
    }
    policy = Asked()
    first = played(RecordedPolicy(policy, path), points=points, simulation=Shuffled)
    monkeypatch.setattr(Shuffled, "order", (1, 0))
    again = played(RecordedPolicy(policy, path), points=points, simulation=Shuffled)
    assert (again, policy.times) == (first, 6)


def test_recorded_policy_answers_equal_decisions_in_their_order(path):
    points = {Tank.fill: replace(FILL, observation_space_mapping=lambda tank: [0])}

    def counting(observation, *, _decision):
        return _decision.number % 3

    first = played(RecordedPolicy(counting, path), points=points)
    assert played(RecordedPolicy(raises, path), points=points) == first


def test_recorded_policy_reads_files_of_older_versions(path):
    seen = []

    def taken(action):
        seen.append(action)
        return 1.0

    points = {Tank.fill: replace(FILL, observation_space_mapping=lambda tank: [tank.day])}
    with path.open("w") as file:
        for number in range(1, 6):
            line = {"seed": 3, "agent": "filler", "number": number, "answer": [number % 3]}
            line["observation"] = digest_of(np.array([number - 1], np.float32))
            file.write(json.dumps(line | ({"answer": None} if number == 2 else {})) + "\n")
    played(
        RecordedPolicy(raises, path),
        points={Tank.fill: replace(points[Tank.fill], action_space_mapping=taken)},
    )
    assert seen == [1, 0, 1, 2]


UNTYPED = {
    "box": (spaces.Box(-1, 1, (2,), np.float32), [0.1, -0.7], np.array([0.1, -0.7], np.float32)),
    "tuple": (spaces.Tuple([spaces.Box(0, 1, (1,)), spaces.Discrete(3)]), [[0.5], 1], ([0.5], 1)),
    "dict": (spaces.Dict(x=spaces.Box(0, 1, (2,))), {"x": [0.5, 0.1]}, {"x": [0.5, 0.1]}),
}


@pytest.mark.parametrize("kind", UNTYPED)
def test_recorded_policy_reads_actions_without_types(kind, tmp_path):
    space, written, action = UNTYPED[kind]
    seen, path = [], tmp_path / "answers"
    points = {Tank.fill: filling(space, lambda action: seen.append(action) or 1.0)}
    played(RecordedPolicy(lambda observation: space.sample(), path), points=points)
    lines = [json.loads(line) | {"action": written} for line in path.read_text().splitlines()[:1]]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    seen.clear()
    played(RecordedPolicy(lambda observation: space.sample(), path), points=points)
    assert space.contains(seen[0])
    np.testing.assert_allclose(spaces.flatten(space, seen[0]), spaces.flatten(space, action))


PARTS = {
    "box": (spaces.Box(-1, 1, (2,), np.float32), np.array([0.1, -0.7], np.float32)),
    "scalar": (spaces.Box(0, 1, (1,), np.float64), 0.1 + 0.2),
    "nested": (
        spaces.Dict(
            {
                "a": spaces.Discrete(3),
                "b": spaces.Tuple([spaces.Box(0, 1, (1,)), spaces.MultiBinary(2)]),
            }
        ),
        {"a": 2, "b": (0.25, np.array([1, 0], np.int8))},
    ),
    "text": (spaces.Text(4, min_length=0), ""),
    "many": (spaces.MultiDiscrete([3, 4]), np.array([2, 3])),
}


@pytest.mark.parametrize("kind", PARTS)
def test_recorded_policy_repeats_actions_of_any_space_exactly(kind, tmp_path):
    space, action = PARTS[kind]
    seen = []
    points = {Tank.fill: filling(space, lambda action: seen.append(action) or 1.0)}
    for policy in (lambda observation: action, raises):
        played(RecordedPolicy(policy, tmp_path / "answers"), points=points)
    assert len(seen) == 10
    for given, repeated in zip(seen[:5], seen[5:], strict=True):
        assert type(repeated) is type(given)
        np.testing.assert_equal(repeated, given)
