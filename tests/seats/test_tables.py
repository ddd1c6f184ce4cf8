"""A table with a language model that lies: it is repeated from a recording, bit for bit."""

import json
import re
from collections import Counter
from pathlib import Path

import pytest
from pandas.testing import assert_frame_equal

from simenv_marl import evaluate
from simenv_marl.planning import RolloutPolicy
from simenv_marl.seats import FallbackPolicy, LanguageModelPolicy, RecordedPolicy
from simenv_marl.testing.templates.simpy import MySimulation, train

from .endpoint import endpoint, fails, says

pytest.importorskip("openai")

COLUMNS = ["mean", "difference", "difference_low", "difference_high", "fallbacks"]

OPTIONS = {"seeds": range(100, 104), "max_steps": 20, "skip_forced": True}

AGENT = "dispatcher_0"

PAGE = (Path(__file__).parents[2] / "docs/seats.md").read_text(encoding="utf-8")

LIES = {
    "none": lambda label, other, *more: says(json.dumps({"action": label})),
    "fence": lambda label, other, *more: says(
        f"Sure!\n```json\n{json.dumps({'why': f'not {other}', 'action': label})}\n```"
    ),
    "words": lambda label, other, *more: says("I'm sorry, but I can't help with that."),
    "masked": lambda label, other, *more: says(json.dumps({"action": len(more) + 2})),
    "reasoning": lambda label, other, *more: says(f"<think>{other}? Too long.</think>\n{label}"),
    "both": lambda label, other, *more: says(f"Either {label}, or {other}."),
    "empty": lambda label, other, *more: says(""),
    "cut off": lambda label, other, *more: says(f'{{"action": "{label}', finish="length"),
    "parts": lambda label, other, *more: says(
        [{"type": "text", "text": label[:5]}, {"type": "text", "text": label[5:]}]
    ),
    "500": lambda label, other, *more: fails(500, "out of memory"),
    "schema": lambda label, other, *more: fails(400, "guided decoding is off on this deployment"),
    "late": lambda label, other, *more: 9.0,
    "number": lambda label, other, *more: says("42"),
}
"""Answers that mean the first label. The first answer is no lie."""

KINDS = {
    **dict.fromkeys(["words", "masked", "both", "number"], "illegal"),
    **dict.fromkeys(["empty", "cut off"], "failed"),
    "500": "http",
    "late": "late",
}
"""The lies for which the rule answers. All others are understood."""


def lie_at(number):
    """Return the name of the lie in a decision."""
    return [*LIES][(number - 1) % len(LIES)]


def answer(request):
    """Mean the most urgent job, and lie in a way that depends on the decision alone."""
    question = request["messages"][-1]["content"]
    labels = re.findall(r"^- (job .*, due in (.*))$", question, re.MULTILINE)
    urgent = [label for label, due in sorted(labels, key=lambda pair: float(pair[1]))]
    lie = lie_at(int(re.search(r"\(decision (\d+)", question)[1]))
    if lie == "schema" and "response_format" not in request:
        lie = "none"
    return LIES[lie](*urgent)


def compared(address, path, trained):
    """Compare the language model with the rule, a planner and a trained policy."""
    model = LanguageModelPolicy("liar", base_url=address, api_key="a key", timeout=2.0, retries=0)
    policies = {
        "language model": FallbackPolicy(RecordedPolicy(model, path)),
        "planner": RolloutPolicy(horizon=60.0, horizon_by="time", futures=2, method="replay"),
        "trained": trained,
    }
    contenders = {"rule": {}} | {name: {AGENT: policy} for name, policy in policies.items()}
    return evaluate(MySimulation, contenders, baseline="rule", **OPTIONS)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Run twice from one recording. Return the tables, the requests after each, the recording."""
    path = tmp_path_factory.mktemp("liar") / "answers.jsonl"
    trained = train(20, 5)
    tables, requests = [], []
    with endpoint(answer) as (address, asked):
        for _ in range(2):
            tables.append(compared(address, path, trained))
            requests.append(len(asked))
    return tables, requests, [json.loads(line) for line in path.read_text().splitlines()]


def test_language_policy_table_in_the_docs_is_repeated_from_recordings(runs):
    (first, second), requests, lines = runs
    assert requests[0] >= len(lines) == 4 * 20
    assert requests[1] == requests[0]
    assert_frame_equal(second.frame, first.frame, check_exact=True)
    assert_frame_equal(second.summary(), first.summary(), check_exact=True)
    counts = [run.seats.drop(columns=["seconds", "tokens"]) for run in (first, second)]
    assert_frame_equal(*counts, check_exact=True)


@pytest.mark.thorough
def test_language_policy_wrong_answer_is_parsed_or_the_rule_decides(runs):
    _, _, lines = runs
    for line in lines:
        lie = lie_at(line["number"])
        assert line["by"] == ("fallback" if lie in KINDS else "policy"), lie
        assert line["counts"].keys() - {"asked", "fallbacks"} == {KINDS.get(lie)} - {None}, lie
        assert ("why" in line) == (lie in KINDS)


def test_language_policy_table_equals_the_one_in_the_docs(runs):
    (found, _), _, lines = runs
    seat = found.seats.set_index("contender").loc["language model"]
    kinds = Counter(KINDS[lie] for line in lines if (lie := lie_at(line["number"])) in KINDS)
    assert {kind: seat[kind] for kind in kinds} == kinds
    assert seat["fallbacks"] == kinds.total()
    table = found.summary()[COLUMNS].round(2).to_string()
    seats = found.seats[["contender", "agent", "decisions", "asked", "fallbacks"]]
    for line in [*table.splitlines(), *seats.to_string(index=False).splitlines()]:
        assert line.rstrip() in PAGE.splitlines()
