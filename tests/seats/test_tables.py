"""A table with a language model that lies: it is repeated from a recording, bit for bit."""

import json
import re
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

AGENT = "dispatcher_0"

PAGE = (Path(__file__).parents[2] / "docs/seats.md").read_text(encoding="utf-8")

LIES = {
    "none": lambda label, other: says(json.dumps({"action": label})),
    "fence": lambda label, other: says(
        f"Sure!\n```json\n{json.dumps({'why': f'not {other}', 'action': label})}\n```"
    ),
    "words": lambda label, other: says("I'm sorry, but I can't help with that."),
    "masked": lambda label, other: says('{"action": 7}'),
    "reasoning": lambda label, other: says(f"<think>{other}? Too long.</think>\n{label}"),
    "both": lambda label, other: says(f"Either {label}, or {other}."),
    "empty": lambda label, other: says(""),
    "cut off": lambda label, other: says(f'{{"action": "{label}', finish="length"),
    "parts": lambda label, other: says(
        [{"type": "text", "text": label[:5]}, {"type": "text", "text": label[5:]}]
    ),
    "500": lambda label, other: fails(500, "out of memory"),
    "schema": lambda label, other: fails(400, "guided decoding is off on this deployment"),
    "late": lambda label, other: 9.0,
    "number": lambda label, other: says("42"),
}
"""The first one is no lie. A label is meant, and another one said."""

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
    (meant, _), *others = sorted(labels, key=lambda label: float(label[1]))
    lie = lie_at(int(re.search(r"\(decision (\d+)", question)[1]))
    if lie == "schema" and "response_format" not in request:
        lie = "none"
    return LIES[lie](meant, others[0][0] if others else "job 9: none")


def compared(address, path, trained):
    """Compare the language model with the rule, a planner and a trained policy."""
    model = LanguageModelPolicy("liar", base_url=address, api_key="a key", timeout=2.0, retries=0)
    policies = {
        "language model": FallbackPolicy(RecordedPolicy(model, path)),
        "planner": RolloutPolicy(horizon=60.0, horizon_by="time", futures=2, method="replay"),
        "trained": trained,
    }
    contenders = {"rule": {}} | {name: {AGENT: policy} for name, policy in policies.items()}
    return evaluate(MySimulation, contenders, seeds=range(3), max_steps=26, baseline="rule")


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


def test_a_table_with_a_liar_is_repeated_without_a_request(runs):
    (first, second), requests, lines = runs
    assert requests[0] >= len(lines) == 3 * 26
    assert requests[1] == requests[0]
    assert_frame_equal(second.frame, first.frame, check_exact=True)
    assert_frame_equal(second.summary(), first.summary(), check_exact=True)
    counts = [run.seats.drop(columns=["seconds", "tokens"]) for run in (first, second)]
    assert_frame_equal(*counts, check_exact=True)


def test_each_lie_is_understood_or_the_rule_answers(runs):
    _, _, lines = runs
    for line in lines:
        lie = lie_at(line["number"])
        assert line["by"] == ("fallback" if lie in KINDS else "policy"), lie
        assert line["counts"].keys() - {"asked", "fallbacks"} == {KINDS.get(lie)} - {None}, lie
        assert ("why" in line) == (lie in KINDS)


def test_the_table_is_the_one_of_the_page(runs):
    (found, _), _, _ = runs
    seat = found.seats.set_index("contender").loc["language model"]
    kinds = {kind: seat[kind] for kind in ("illegal", "failed", "http", "late")}
    assert kinds == {"illegal": 24, "failed": 12, "http": 6, "late": 6}
    assert (seat["agent"], seat["asked"], seat["fallbacks"]) == (AGENT, 78, 48)
    assert found.summary()["note"]["language model"] == "62% of decisions by a fallback"
    table = found.summary()[COLUMNS]
    for line in table.round(2).to_string().splitlines():
        assert line.rstrip() in PAGE.splitlines()
