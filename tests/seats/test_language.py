"""A language model decides: its endpoint answers rightly, wrongly, late, with garbage, or never."""

import copy
import json
import pickle
import sys
from collections import Counter
from functools import partial
from multiprocessing import get_context
from threading import Lock
from types import SimpleNamespace

import pytest
from gymnasium import spaces

from simenv_marl import RULE, single_env
from simenv_marl.errors import (
    InvalidActionError,
    LanguageModelError,
    MissingExtraError,
    OptionValueError,
)
from simenv_marl.seats import FallbackPolicy, LanguageModelPolicy, describe
from tests.worlds.seats import FILL, Tank, filling, levels, played

from .endpoint import endpoint, fails, says

openai = pytest.importorskip("openai")


@pytest.fixture(autouse=True)
def impatient(monkeypatch):
    monkeypatch.setattr("openai._base_client.INITIAL_RETRY_DELAY", 0.01)


OPEN = says('{"action": "open"}')


def model(address, **options):
    return LanguageModelPolicy("fake", base_url=address, api_key="a key", **options)


def test_language_policy_decides_by_action_labels():
    with endpoint([OPEN]) as (address, requests):
        policy = model(address, temperature=0.0)
        assert played(policy) == played(lambda observation: 2)
    assert len(requests) == 5
    assert requests[0]["temperature"] == 0.0
    assert requests[0]["key"] == "Bearer a key"
    system, question = requests[0]["messages"]
    assert "Choose how much water flows in." in question["content"]
    assert "level: 5" in question["content"]
    schema = requests[0]["response_format"]["json_schema"]["schema"]
    assert schema["properties"]["action"] == {"type": "string", "enum": ["closed", "half", "open"]}
    assert json.dumps(schema) in system["content"]  # for endpoints that do not enforce it
    seconds = policy.usage["seconds"]
    assert seconds > 0
    assert policy.usage == {
        "requests": 5,
        "prompt_tokens": 50,
        "completion_tokens": 15,
        "seconds": seconds,
    }


def test_language_policy_checks_numbers_against_the_space_bounds():
    points = {Tank.fill: filling(spaces.Box(0, 2, (1,)))}
    with endpoint([says('{"action": 7}'), says('{"action": 1.5}')]) as (address, requests):
        played(model(address), points=points)
    assert (
        requests[0]["response_format"]["json_schema"]["schema"]["properties"]["action"]["maximum"]
        == 2.0
    )
    assert "number from 0 to 2" in requests[1]["messages"][-1]["content"]


def test_language_policy_corrects_a_wrong_answer_in_the_conversation():
    parts = [{"type": "text", "text": "Op"}, {"type": "thought"}, {"type": "text", "text": "en"}]
    with endpoint([says("ajar"), says(parts)]) as (address, requests):
        assert played(model(address))[0] == played(lambda observation: 2)[0]
    answer, correction = requests[1]["messages"][-2:]
    assert answer == {"role": "assistant", "content": "ajar"}
    assert correction["role"] == "user"
    assert "- closed\n- half\n- open" in correction["content"]


@pytest.mark.thorough
@pytest.mark.parametrize("answer", [
    fails(500), fails(503), fails(429, retry_after="0"), "<html>busy</html>",
    says(None, refusal="I would rather not"), says("  "), {"object": "something else"}, 2.0,
], ids=["500", "503", "429", "HTML", "refusal", "nothing", "garbage", "late"])  # fmt: skip
def test_language_policy_retries_temporary_failures(answer):
    with endpoint([answer, OPEN]) as (address, requests):
        assert played(model(address, timeout=1.0))[0] == played(lambda observation: 2)[0]
    assert len(requests) == 6


@pytest.mark.thorough
@pytest.mark.parametrize(("answer", "kind", "error", "match"), [
    (fails(500), "http", LanguageModelError, "fake cannot be asked"),
    ("<html>down</html>", "failed", LanguageModelError, "fake gave no answer"),
    (says(None, refusal="no"), "refused", LanguageModelError, "gave no answer: it refused: 'no'"),
    (says([{"refusal": "no"}]), "refused", LanguageModelError, "gave no answer: it refused: 'no'"),
    (says(None, finish="content_filter"), "refused", LanguageModelError, "content_filter"),
    (says("open", finish="length"), "failed", LanguageModelError, "max_tokens is used up"),
    (says(""), "failed", LanguageModelError, "its content is empty"),
    (says("ajar"), "illegal", InvalidActionError, "'ajar' names no legal action"),
], ids=["500", "HTML", "refusal", "part", "filter", "cut off", "empty", "wrong"])  # fmt: skip
def test_language_policy_raises_lasting_failures_or_uses_the_fallback(answer, kind, error, match):
    with endpoint([answer]) as (address, requests):
        with pytest.raises(error, match=match):
            played(model(address, retries=1))
        guarded = FallbackPolicy(model(address, retries=1))
        assert played(guarded) == played(RULE)
    assert guarded.counts[kind] == guarded.counts["fallbacks"] == 5
    assert len(requests) == 12


def test_language_policy_does_not_retry_a_refused_api_key(monkeypatch):
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)
    with pytest.raises(LanguageModelError, match="api_key"):
        played(LanguageModelPolicy("fake", base_url="http://127.0.0.1:9/v1"))
    with endpoint([fails(401, "unknown key")]) as (address, requests):
        policy = model(address)
        with pytest.raises(LanguageModelError, match=r"fake cannot be asked: .*unknown key"):
            played(policy)
    assert len(requests) == 1


@pytest.mark.parametrize(("status", "problem"), [
    (400, "response_format is not supported"), (422, "extra inputs are not permitted"),
    (404, "no endpoint can do structured outputs"), (500, "unknown response_format"),
])  # fmt: skip
def test_language_policy_works_without_structured_output(status, problem):
    with endpoint([fails(status, problem), OPEN]) as (address, requests):
        assert played(model(address, retries=0)) == played(lambda observation: 2)
    assert ["response_format" in request for request in requests] == [True] + [False] * 5
    assert "schema" not in json.dumps(requests[-1])


@pytest.mark.parametrize(("answer", "kind"), [(fails(404, "no such model"), "http"), (0.5, "late")])
def test_language_policy_keeps_structured_output_after_other_errors(answer, kind):
    with endpoint([answer]) as (address, _):
        policy = FallbackPolicy(model(address, timeout=0.1, retries=0))
        assert played(policy) == played(RULE)
    assert policy.policy.structured
    assert policy.counts[kind] == 5


@pytest.mark.thorough
@pytest.mark.parametrize("wrap", [lambda make: None, lambda make: make(), lambda make: make])
def test_language_policy_opens_a_connection_per_process(wrap):
    async def closing(observation):
        await policy._client_here().close()
        return 2

    with endpoint([OPEN]) as (address, requests):
        make = partial(openai.AsyncOpenAI, base_url=address, api_key="a key")
        policy = model(address, client=wrap(make))
        process = get_context("fork").Process(target=played, args=(policy,))
        assert played(policy) == played(policy)
        process.start()
        process.join()
        assert played(policy) == played(closing)
    assert process.exitcode == 0
    ports = Counter(request["port"] for request in requests)
    assert sorted(ports.values()) == [5, 15]


def test_language_policy_refuses_an_uncopyable_client_in_another_process():
    policy = LanguageModelPolicy("own", client=SimpleNamespace(chat=Lock()))
    with pytest.raises(LanguageModelError, match="client= be a function that makes it"):
        played(copy.copy(policy))


def test_language_policy_requests_contain_the_agents_latest_decisions():
    with endpoint([says("open"), says("half"), says("closed")]) as (address, requests):
        played(model(address, history=2))
    roles = [[message["role"][0] for message in request["messages"]] for request in requests[:4]]
    assert ["".join(own) for own in roles] == ["su", "suau", "suauau", "suauau"]
    messages = requests[3]["messages"]
    answers = [message["content"] for message in messages if message["role"] == "assistant"]
    assert answers == ["half", "closed"]


def test_language_policy_keeps_a_history_per_episode():
    with endpoint([OPEN]) as (address, requests):
        levels(model(address, history=9), seeds=[7, 7])
    assert sorted(len(request["messages"]) for request in requests) == [
        2,
        2,
        4,
        4,
        6,
        6,
        8,
        8,
        10,
        10,
    ]


def test_language_policy_sent_to_another_process_decides_there():
    with endpoint([OPEN]) as (address, _):
        policy = model(address)
        assert played(policy) == played(pickle.loads(pickle.dumps(policy)))


def test_language_policy_takes_a_custom_client_and_instructions():
    asked = []

    async def create(**request):
        asked.append(request)
        return SimpleNamespace(choices=[SimpleNamespace(message=SimpleNamespace(content="open"))])

    client = SimpleNamespace(chat=SimpleNamespace(completions=SimpleNamespace(create=create)))
    policy = LanguageModelPolicy(
        "own",
        client=client,
        instructions="Be quick.",
        describe=lambda decision: f"at {decision.observation[0]:.0f} m",
    )
    assert played(policy) == played(lambda observation: 2)
    assert asked[0]["messages"][0]["content"].endswith("Be quick.")
    assert asked[0]["messages"][1]["content"] == "at 5 m"
    assert {len(request["messages"]) for request in asked} == {2}  # no decisions before


def test_language_policy_shows_the_prompt_of_a_pending_decision():
    env = single_env(Tank, {Tank.fill: FILL})
    env.reset(seed=1)
    found = LanguageModelPolicy("fake", instructions="Be quick.").prompt(env)
    assert found.startswith("You decide for 'filler'")
    assert "Be quick." in found
    assert found.endswith(describe(env))


def test_language_policy_without_openai_names_the_missing_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "openai", None)
    with pytest.raises(MissingExtraError, match=r"simenv-marl\[language\]"):
        played(LanguageModelPolicy("fake"))


@pytest.mark.parametrize("arguments", [{"history": -1}, {"retries": 1.5}, {"describe": "words"}])
def test_language_policy_refuses_invalid_arguments(arguments):
    with pytest.raises(OptionValueError, match=next(iter(arguments))):
        LanguageModelPolicy("fake", **arguments)
