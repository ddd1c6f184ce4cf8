"""The client for models in Java: what it says and does when it is told this and that, right or wrong."""

import json
import subprocess
from pathlib import Path

import pytest
from examples.jvm_market.build import CLIENT, build, java

from tests.outside.wire import PATIENCE, VALUES, Child, exactly

pytestmark = pytest.mark.greenlet("no environment takes part")

ODD_STRINGS = ["\ud800 alone \udc00", "\U0001f600", '"\\/\b\f\n\r\t\x00\x7f\x80\u2028\uffff', ""]


@pytest.fixture(scope="session")
def probe(tmp_path_factory):
    """The command that runs ``Probe.java``."""
    try:
        command, _ = java()
    except RuntimeError as error:
        pytest.skip(str(error))
    out = build(tmp_path_factory.mktemp("java") / "out", [CLIENT, Path(__file__).with_name("Probe.java")])
    return [command, "-XX:+UseSerialGC", "-XX:TieredStopAtLevel=1", "-cp", str(out), "Probe"]


@pytest.fixture
def child(probe):
    with Child(*probe) as child:
        assert child.receive() == {"hello": 1, "points": ["a", "b"], "can": ["reseed"]}
        yield child


def said(child, what, **options):
    """What the only call of an episode tells, after which the rule decides."""
    (call,), last = child.play(do=what, **options)
    assert last == {"end": {"truncated": False, "result": "rule"}}
    return call["args"]["value"]


def plays_well(child):
    """Whether an episode is one like any other."""
    calls, last = child.play(do="count")
    return [call["decide"] for call in calls] == [1, 2, 3, 4, 5] and last["end"]["truncated"]


def error(frame):
    assert list(frame) == ["error"]
    assert set(frame["error"]) == {"type", "text", "trace"}
    return frame["error"]


# -- decisions and values -------------------------------------------------------------------------


def test_the_rule_and_answers_decide(child):
    calls, last = child.play(do="count", seed=-5)
    assert [call["decide"] for call in calls] == [1, 2, 3, 4, 5]
    assert calls[3] == {"decide": 4, "point": "a", "entity": "x", "args": {"i": 3, "half": 1.5}, "time": 3.0}
    assert last == {"end": {"truncated": True, "result": {"sum": 0.0 + 0.1 + 0.2 + 0.1 * 3 + 0.4, "seed": -5}}}
    calls, last = child.play(lambda call: call["args"]["i"], do="count", seed=2**63 - 1)
    assert [call["decide"] for call in calls] == [1, 2, 3, 4, 5]  # from one again
    assert last["end"]["result"] == {"sum": 10.0, "seed": 2**63 - 1}


def test_values_of_all_classes_are_sent(child):
    big = 123456789012345678901234567890
    things = [[1, 2], [0.5, {"float": "nan"}], [], "GLAD", "c", 1.5, 3, [{"1": "one"}], 7, 0.5, big, None]
    assert exactly(said(child, "java")) == exactly(things)


@pytest.mark.parametrize("ascii_only", [True, False])
@pytest.mark.parametrize("value", [*VALUES, -(2**70)], ids=repr)
def test_values_come_back_as_they_went(probe_echo, value, ascii_only):
    child = probe_echo
    line = json.dumps({"start": {"seed": 1, "options": {"do": "echo", "value": value}}}, ensure_ascii=ascii_only)
    child.send(line.replace("/", "\\/").encode() + b"\r\n")  # blanks and needless escapes are JSON, too
    assert exactly(child.receive()["args"]["value"]) == exactly(value)
    assert exactly(child.act(1, value)) == exactly({"end": {"truncated": False, "result": value}})


@pytest.fixture(scope="module")
def probe_echo(probe):
    with Child(*probe) as child:
        child.receive()
        yield child


def test_lone_surrogates_come_back(child):
    assert said(child, "echo", value=ODD_STRINGS) == ODD_STRINGS  # as escapes: they have no UTF-8


def test_decisions_have_types(child):
    answers = iter([3, 2**40, -7, True, "GLAD", {"float": "-inf"}, 0, 0, False, "GLAD"])
    calls, last = child.play(lambda call: next(answers), do="typed")
    assert "entity" not in calls[0]
    assert "time" not in calls[0]
    assert exactly(last["end"]["result"]) == exactly([3.0, 2**40, -7, True, "GLAD"])
    _, last = child.play(lambda call: next(answers), do="typed")
    assert last["end"]["result"][0] == {"float": "-inf"}
    _, last = child.play(do="typed")
    assert exactly(last["end"]["result"]) == exactly([0.25, 3, 2, False, "GLAD"])


WRONG_TYPES = {
    "double": [None, "2", True, [0.5]],
    "long": [None, "2", True, 0.5, 2**63],
    "int": [None, "2", True, 0.5, 2**31],
    "boolean": [None, "true", 1],
    "enum": [None, "SAD", 1],
}


@pytest.mark.parametrize(("kind", "value"), [(kind, value) for kind, values in WRONG_TYPES.items() for value in values])
def test_a_decision_of_another_type_is_an_error_that_the_model_cannot_swallow(probe_echo, kind, value):
    child = probe_echo
    calls, last = child.play(lambda call: value, do="bad decision", type=kind)
    assert len(calls) == 1
    assert error(last)["type"] == "java.lang.IllegalArgumentException"
    assert error(last)["text"] == f"a cannot take the decision {json.dumps(value)}"
    assert plays_well(child)


def test_a_rule_may_decide(child):
    frames = child.begin(do="nested"), child.rule(1)
    assert [(call["decide"], call["point"], call["entity"]) for call in frames] == [(1, "a", "x"), (2, "b", "y")]
    assert child.act(2, 6)["end"]["result"] == 60


def test_what_is_decided_while_arguments_are_made_is_left_to_the_rule(child):
    (call,), last = child.play(lambda call: 9, do="in arguments")
    assert call["args"] == {"n": 5}
    assert last["end"]["result"] == 9


def test_updates_and_removals_are_told(child):
    child.begin(do="removals")
    assert [child.rule(1), *(child.receive() for _ in range(4))] == [
        {"remove": "x", "point": "a"},
        {"update": "y", "point": "a", "args": {"level": 0.5, "full": True, "mark": "m"}, "time": 3.0},
        {"update": None, "point": "a", "args": {}},
        {"remove": "y", "point": "a"},
        {"end": {"truncated": False, "result": None}},
    ]


def test_threads_of_the_model_decide_one_at_a_time(child):
    calls, last = child.play(lambda call: call["args"]["n"] + 1, do="threads")
    assert [call["decide"] for call in calls] == list(range(1, 201))
    assert last["end"]["result"] == [50, 100, 150, 200]


def test_a_stop_reaches_all_threads(child):
    child.begin(do="threads")
    child.send(stop=True)
    assert plays_well(child)


# -- seeds ----------------------------------------------------------------------------------------


def test_another_future_is_seeded_before_the_answer(child):
    assert child.begin(do="count", seed=1)["decide"] == 1
    assert child.act(1, 0)["decide"] == 2
    child.send(reseed=12)
    child.send(reseed=30)
    for number in range(2, 6):
        last = child.act(number, 0)
    assert last["end"]["result"] == {"sum": 0.0, "seed": 1030}  # the callback's own decision: its rule


def test_an_error_of_the_callback_is_one_of_the_episode(child):
    child.begin(do="count")
    child.send(reseed=-1)
    assert error(child.act(1, 0.5))["text"] == "no such seed"
    assert plays_well(child)


def test_a_model_without_a_callback_cannot_be_seeded_anew(probe):
    with Child(*probe, PROBE_CANNOT_RESEED="1") as child:
        assert child.receive() == {"hello": 1, "points": ["a"], "can": []}
        child.begin(do="count")
        child.send(reseed=1)
        assert "an answer to call 1 was expected" in error(child.receive())["text"]
        assert child.ended()[0] == 1


def test_where_no_seed_is_named_one_is_drawn(child):
    seeds = {child.play(do="count", seed=None)[1]["end"]["result"]["seed"] for _ in range(5)}
    assert len(seeds) == 5


@pytest.mark.parametrize("seed", [2**63, 0.5, "7"])
def test_seeds_are_integers_of_64_bits(child, seed):
    assert f"and is {json.dumps(seed)}" in error(child.play(do="count", seed=seed)[1])["text"]
    assert plays_well(child)


# -- ends -----------------------------------------------------------------------------------------


def test_a_stop_unwinds_the_model_silently(child, tmp_path):
    seen = tmp_path / "seen"
    assert child.begin(do="swallows", file=str(seen))["decide"] == 1
    assert child.act(1, 3)["args"] == {"value": "finally"}
    assert child.act(2, 4) == {"update": "x", "point": "a", "args": {"i": 1}}
    assert child.receive() == {"remove": "x", "point": "a"}
    assert child.receive()["decide"] == 3
    child.send(stop=True)
    child.send(stop=True)  # one too many is none
    assert plays_well(child)  # nothing was said in between
    assert seen.read_text().split("\n") == ["answer 3", "Stop"]  # neither swallowed nor answered


@pytest.mark.parametrize(
    ("what", "kind", "text"),
    [
        ("throws", "java.io.IOException", "the mill \u2603 burnt down"),
        ("silent throw", "java.lang.RuntimeException", ""),
        ("bad arguments", "java.lang.IllegalArgumentException", "a java.lang.Object cannot be sent"),
        ("bad update", "java.lang.IllegalArgumentException", "a java.lang.Object cannot be sent"),
        ("too much", "java.lang.IllegalArgumentException", "16777273 bytes are to be sent, and 16 MiB is the most"),
        ("bad result", "java.lang.IllegalArgumentException", "a java.lang.Object cannot be sent"),
    ],
)
def test_an_error_is_told_and_the_next_episode_works(child, what, kind, text):
    _, last = child.play(do=what)
    assert error(last)["type"] == kind
    assert error(last)["text"] == text
    assert error(last)["trace"].startswith(kind)
    assert "\tat Probe." in error(last)["trace"]
    assert plays_well(child)


def test_a_stack_that_overflows_is_told_when_it_is_unwound(child):
    calls, last = child.play(do="overflow")
    assert len(calls) > 100
    assert error(last)["type"] == "java.lang.StackOverflowError"


def test_long_lines_go_both_ways(child):
    text = "y" * ((16 << 20) - 100)
    assert len(child.begin(do="long line")["args"]["value"]) == len(text)
    assert child.act(1, text) == {"end": {"truncated": False, "result": text}}


@pytest.mark.parametrize("where", ["before", "in mid-episode"])
def test_a_parent_that_is_gone_is_the_end(child, where, tmp_path):
    if where == "in mid-episode":
        child.begin(do="swallows", file=str(tmp_path / "seen"))
    child.close("out")
    child.close("into")
    assert child.ended() == (0, "standard output is the model's\n4\n", "")
    assert where != "in mid-episode" or (tmp_path / "seen").read_text() == "Stop"


def test_a_model_that_refuses_to_unwind_is_left_when_the_parent_is_gone(child):
    child.begin(do="refuses")
    child.close("out")
    assert child.ended()[0] == 1


def test_a_model_may_exit(child):
    child.begin(do="exits")
    assert child.rule(1) is None
    assert child.ended()[0] == 3


def test_without_pipes_the_model_runs_by_its_rule(probe):
    plain = subprocess.run([*probe, "count"], capture_output=True, text=True, timeout=PATIENCE)
    _, decided, ended = plain.stdout.splitlines()
    assert decided == "4"
    assert json.loads(ended) == {"truncated": True, "result": {"sum": 1.0, "seed": 7}}
    assert plain.stderr == ""


# -- what the environment may say wrong -----------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "text"),
    [
        (b'{"act": 2, "rule": true}', 'call 1 waits for its answer, and this came: {"act":2,"rule":true}'),
        (b'{"act": true, "rule": true}', "call 1 waits for its answer"),
        (b'{"act": 1.0, "rule": true}', "call 1 waits for its answer"),
        (b'{"act": 1}', "an answer to call 1 was expected"),
        (b'{"rule": true}', "an answer to call 1 was expected"),
        (b'{"act": 1, "rule": false}', "an answer to call 1 was expected"),
        (b'{"start": {"seed": 1, "options": {}}}', "an answer to call 1 was expected"),
        (b'{"dance": 1}', 'an answer to call 1 was expected, and this came: {"dance":1}'),
        (b"[1]", "one object was expected"),
        (b"{} {}", "one object was expected"),
        (b"", "more was expected"),
        (b"garbage", "a line is not understood: a value was expected, near garbage"),
        (b'{"act": 1, "value": NaN}', "a value was expected"),
        (b'{"act": 1, "value": 0.5', "more was expected, near"),
        (b'{"act": 1 "value": 0.5}', "a comma or } was expected, near"),
        (b'{"act": 1, "value": "x}', "a string does not end"),
        (b'{"act": 1, "value": "\\x"}', "there is no such escape"),
        (b'{"act": 1, "value": "\xff"}', "MalformedInput"),
        (b'{"act": 1, "value": trve}', "true was expected"),
        (b'{"act": 1, "value": 1.2.3}', "NumberFormatException"),
        (b'{"act": 1, "value": -}', "NumberFormatException"),
        (b'{"act": 1, "value": ' + b"[" * 100_000 + b"}", "it is nested too deeply"),
        (b"x" * (16 << 20), "a line has more than 16 MiB"),
    ],
)
def test_what_is_not_understood_is_an_error_and_the_end(child, line, text):
    child.begin(do="swallows", file="/dev/null")
    child.send(line + b"\n")
    assert text in error(child.receive())["text"]
    assert child.receive() is None
    assert child.ended()[0] == 1


def test_an_answer_between_episodes_is_an_error_and_the_end(child):
    child.begin(do="swallows", file="/dev/null")
    child.send(stop=True)
    assert 'a start was expected, and this came: {"act":1,"rule":true}' in error(child.rule(1))["text"]
    assert child.ended()[0] == 1


@pytest.mark.parametrize(("numbers", "text"), [("98,99", "/dev/fd/98"), ("7", "has to be two numbers")])
def test_pipes_that_are_none_are_an_error(probe, numbers, text):
    environment = {"SIMENV_MARL_FDS": numbers}
    plain = subprocess.run(probe, env=environment, capture_output=True, text=True, timeout=PATIENCE)
    assert plain.returncode == 1
    assert text in plain.stderr


# -- what is missing ------------------------------------------------------------------------------


def test_what_is_missing_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(RuntimeError, match=r"java is not found on the PATH; install a JDK of version 17"):
        build(tmp_path / "out")
    for name, said in {"java": "", "javac": "echo javac 11.0.2"}.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{said}\n")
        (tmp_path / name).chmod(0o755)
    with pytest.raises(RuntimeError, match=r"javac is of version 11\.0\.2; install a JDK"):
        build(tmp_path / "out")
