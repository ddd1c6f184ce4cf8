"""The clients in C++ and Java: programs that play what they are told to, over pipes whose other side is the test's."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
from typing import Any, NamedTuple

import pytest
from examples.jvm_market.build import CLIENT, build, java

from tests.outside.conftest import COMPILER, HERE, compiled
from tests.outside.wire import PATIENCE, VALUES, Child, exactly

pytestmark = pytest.mark.greenlet("there is no environment")

HELLO = {"hello": 1, "points": ["a", "b"], "can": ["reseed"]}
CPP = pytest.mark.parametrize("client", ["C++"], indirect=True)
JAVA = pytest.mark.parametrize("client", ["Java"], indirect=True)
LONGEST = 16 << 20


class Client(NamedTuple):
    """A client's probe, and what it says on standard output at its start, and on standard error when unwound."""

    name: str
    command: list[Any]
    said: str
    unwound: str


@pytest.fixture(scope="session")
def java_probe(tmp_path_factory):
    try:
        command, _ = java()
    except RuntimeError as error:
        pytest.skip(str(error))
    out = build(tmp_path_factory.mktemp("java") / "out", [CLIENT, HERE / "Probe.java"])
    return [command, "-XX:+UseSerialGC", "-XX:TieredStopAtLevel=1", "-cp", str(out), "Probe"]


@pytest.fixture(scope="session")
def cpp_probe(tmp_path_factory):
    if COMPILER is None:
        pytest.skip("no C++ compiler: neither g++ nor clang++ is installed")
    return [compiled(HERE / "probe.cpp", tmp_path_factory.mktemp("cpp"))]


@pytest.fixture(params=["C++", "Java"])
def client(request):
    if request.param == "Java":
        command = request.getfixturevalue("java_probe")
        return Client("Java", command, "standard output is the model's\n4\n", "unwound by Stop\n")
    return Client("C++", request.getfixturevalue("cpp_probe"), "", "unwound by rule 7\n")


@pytest.fixture
def child(client):
    with Child(*client.command) as child:
        assert child.receive() == HELLO
        yield child


def ended(result: Any = None, *, truncated: bool = False) -> dict[str, Any]:
    return {"end": {"truncated": truncated, "result": result}}


def plays_well(child: Child) -> bool:
    """Whether an episode is one like any other."""
    return child.begin(5, play="seed") == ended(5)


def has_given_up(child: Child) -> bool:
    """Whether the process has ended with an error and said nothing more."""
    return child.receive() is None and child.ended()[0] == 1


def plain(client: Client, *arguments: str, descriptors: str | None = None) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if name != "SIMENV_MARL_FDS"}
    if descriptors is not None:
        environment["SIMENV_MARL_FDS"] = descriptors
    command = [*client.command, *arguments]
    return subprocess.run(
        command, env=environment, capture_output=True, encoding="utf-8", errors="replace", timeout=PATIENCE
    )


@pytest.mark.parametrize("ascii_only", [True, False])
def test_values_go_to_the_model_and_back_unchanged(child, client, ascii_only):
    large = [-(2**70)] if client.name == "Java" else []
    for value in [*VALUES, *large]:
        line = json.dumps({"start": {"seed": 1, "options": {"value": value}}}, ensure_ascii=ascii_only)
        child.send(line.replace("/", "\\/").encode() + b"\r\n")  # blanks and needless escapes are JSON, too
        asked = child.receive()
        assert asked == {"decide": 1, "point": "a", "entity": "ä", "time": 0.25, "args": {"value": value}}
        assert exactly(asked["args"]["value"]) == exactly(value)
        assert exactly(child.act(1, value)) == exactly(ended(value))


BIG = 123456789012345678901234567890
ARGUMENTS = {
    "C++": [
        {"x": 1.0, "y": 0.10000000149011612},
        {"flags": [True, False], "name": "b", "half": 0.5, "most": 2**64 - 1},
    ],
    "Java": [{"value": [[1, 2], [0.5, {"float": "nan"}], [], "GLAD", "c", 1.5, 3, [{"1": "one"}], 7, 0.5, BIG, None]}],
}


def test_arguments_of_all_classes_are_sent(child, client):
    calls, _ = child.play(play="arguments")
    assert exactly([call["args"] for call in calls]) == exactly(ARGUMENTS[client.name])
    assert "time" not in calls[0]


# The decisions, and the model's values of them; without decisions, those of its rule.
TYPES = {
    "C++": [
        ([3, 4.0, 1, "\u00e4\n", [1, 2.5], {"a": [True]}], [3.0, 4, True, "\u00e4\n", [1.0, 2.5], {"a": [True]}]),
        *(([{"float": name}, 1, False, "x", [{"float": name}], None],) * 2 for name in ("nan", "inf", "-inf")),
        (None, [0.5, 3, True, "rule", [1.0, 2.0], None]),
    ],
    "Java": [
        ([3, 2**40, -7, True, "GLAD"], [3.0, 2**40, -7, True, "GLAD"]),
        *(([{"float": name}, 0, 0, False, "GLAD"],) * 2 for name in ("nan", "inf", "-inf")),
        (None, [0.25, 3, 2, False, "GLAD"]),
    ],
}


def test_the_model_has_the_types_that_it_asks_for(child, client):
    for decisions, found in TYPES[client.name]:
        left = iter(decisions or [])
        _, last = child.play(None if decisions is None else lambda call, left=left: next(left), play="types")
        assert exactly(last) == exactly(ended(found))


# By the number of the call.
WRONG_TYPES = {
    "C++": {1: ["x", None, True], 2: [0.5, 2**31, -(2**31) - 1], 3: [2], 4: [1], 5: [[1, "x"], 1]},
    "Java": {
        1: [None, "2", True, [0.5]],
        2: [None, "2", True, 0.5, 2**63],
        3: [None, "2", True, 0.5, 2**31],
        4: [None, "true", 1],
        5: [None, "SAD", 1],
    },
}


def test_a_decision_of_another_type_is_an_error_of_the_model(child, client):
    kind, text = {
        "C++": ("simenv::JsonError", r"decision {}, at a: .* is not of the type that the model takes"),
        "Java": ("java.lang.IllegalArgumentException", r"a cannot take the decision .*"),  # cannot be swallowed
    }[client.name]
    for call, wrong in WRONG_TYPES[client.name].items():
        for value in wrong:
            child.begin(play="types")
            for number in range(1, call):
                child.rule(number)
            error = child.act(call, value)["error"]
            assert error["type"] == kind
            assert re.fullmatch(text.format(call), error["text"])
            assert client.name == "C++" or error["text"].endswith(f" {json.dumps(value)}")
            assert plays_well(child)


@CPP
def test_a_model_may_ask_without_naming_its_rule(child):
    child.begin(play="optional")
    assert child.act(1, 2) == ended(2.0)
    child.begin(play="optional")
    assert child.rule(1) == ended(-1.0)


def test_episodes_follow_each_other_and_calls_are_counted_anew(child):
    for _ in range(2):
        asked = child.begin(play="count", times=2)
        assert asked == {"decide": 1, "point": "a", "entity": "x", "args": {"sum": 0}}
        assert child.act(1, 5)["args"] == {"sum": 5}
        assert child.rule(2)["decide"] == 3, "the guard's, which asks at its end"
        assert child.act(3, 0) == {"update": "last", "point": "b", "args": {"i": 1}}
        assert child.receive() == {"remove": "last", "point": "b"}
        assert child.receive() == ended(6)


REPORTS = {
    "C++": [
        {"update": 12, "point": "a", "args": {"level": 0.5}, "time": 1.5},
        {"remove": 12, "point": "a"},
        {"remove": '"b"', "point": "a"},
        {"update": None, "point": "a", "args": {"level": 1}},
    ],
    "Java": [
        {"remove": "x", "point": "a"},
        {"update": "y", "point": "a", "args": {"level": 0.5, "full": True, "mark": "m"}, "time": 3.0},
        {"update": None, "point": "a", "args": {}},
        {"remove": '"b"', "point": "a"},
    ],
}


def test_clients_send_updates_and_removals(child, client):
    told = [child.begin(play="reports"), *(child.receive() for _ in range(4))]
    assert told == [*REPORTS[client.name], ended()]


def test_a_model_may_end_its_episode_truncated(child):
    assert child.begin(play="truncated") == ended({"reached": 3}, truncated=True)
    assert child.begin(play="none") == ended()


@JAVA
def test_a_rule_may_decide(child):
    frames = child.begin(play="nested"), child.rule(1)
    assert [(call["decide"], call["point"], call["entity"]) for call in frames] == [(1, "a", "x"), (2, "b", "y")]
    assert child.act(2, 6) == ended(60)


@JAVA
def test_threads_of_the_model_decide_one_at_a_time_and_are_all_stopped(child):
    calls, last = child.play(lambda call: call["args"]["n"] + 1, play="threads")
    assert [call["decide"] for call in calls] == list(range(1, 201))
    assert last == ended([50, 100, 150, 200])
    child.begin(play="threads")
    child.send(stop=True)
    assert plays_well(child)


def test_seeds_arrive_and_one_that_is_none_is_drawn(child, client):
    for seed in {"C++": (0, 7, 2**64 - 1), "Java": (-5, 7, 2**63 - 1)}[client.name]:
        assert child.begin(seed, play="seed") == ended(seed)
    drawn = []
    for start in ({"seed": None}, {}):
        child.send(start=start | {"options": {"play": "seed"}})
        drawn.append(child.receive()["end"]["result"])
    assert drawn[0] != drawn[1]
    assert {"C++": 0, "Java": -(2**63)}[client.name] <= min(drawn) <= max(drawn) < 2**64


def test_generators_are_seeded_anew_before_an_answer(child, client):
    child.begin(play="reseed")
    child.send(reseed=12)
    child.send(reseed=13)
    own = {"C++": 0, "Java": 1000}[client.name]  # the callback's own decision, which is its rule's
    assert child.rule(1) == ended(13 + own)


def test_a_stop_unwinds_the_model_which_is_silent_until_the_next_start(child, client):
    for answered in (0, 1, 1):
        child.begin(play="count")
        if answered:
            child.act(1, 1)
        child.send(stop=True)
        if client.name == "Java":
            child.send(stop=True)  # one too many is none
        assert plays_well(child)
    child.close("out")
    assert child.ended() == (0, client.said, client.unwound * 3)


def test_a_model_that_ignores_a_stop_is_stopped_again(child):
    child.begin(play="deaf", times=3)
    child.send(stop=True)
    assert plays_well(child)


DEAF = "simenv: the model catches simenv::Stop again and again, and does not unwind\n"


@pytest.mark.parametrize(("client", "gone"), [("C++", False), ("C++", True), ("Java", True)], indirect=["client"])
def test_a_model_that_never_hears_is_ended(child, client, gone):
    child.begin(play="deaf", times=-1)
    if gone:
        child.close("out")
    else:
        child.send(stop=True)
    assert child.receive() is None
    assert child.ended() == (1, client.said, DEAF if client.name == "C++" else "")


@CPP
def test_many_stops_leave_nothing_behind(child):
    def resident() -> int:
        with open(f"/proc/{child.process.pid}/statm", encoding="ascii") as file:
            return int(file.read().split()[1])

    if not os.path.exists("/proc/self/statm"):
        pytest.skip("no /proc")
    sizes = []
    for round_ in range(3_000):
        child.begin(play="count")
        child.send(stop=True)
        if round_ in (500, 2_999):
            sizes.append(resident())
    assert sizes[1] <= sizes[0] + 16, "pages"


# -- errors -----------------------------------------------------------------------------------------------------------

# By what is played: type, text and how the trace begins; the first two are patterns.
JAVA_REFUSES = "java.lang.IllegalArgumentException"
NOT_UTF_8 = ("simenv::JsonError", "a text that is not UTF-8: \ufffd.*", "")
CANNOT_BE_SENT = (JAVA_REFUSES, "a java.lang.Object cannot be sent", JAVA_REFUSES)
FAILURES = {
    "C++": {
        "fail": (".*std::runtime_error.*", "the pump is broken \ufffd", "caused by std::out_of_range: the cause\n"),
        "number": ("unknown", ".+", ""),
        "text": NOT_UTF_8,
        "name": NOT_UTF_8,
        "huge": ("std::length_error", "a line of more than 16 MiB", ""),
    },
    "Java": {
        "fail": ("java.io.IOException", "the mill \u2603 burnt down", "java.io.IOException"),
        "silent": ("java.lang.RuntimeException", "", "java.lang.RuntimeException"),
        "huge": (JAVA_REFUSES, "16777273 bytes are to be sent, and 16 MiB is the most", JAVA_REFUSES),
        **{f"bad {what}": CANNOT_BE_SENT for what in ("arguments", "result")},
    },
}


def test_an_error_is_sent_and_the_next_episode_works(child, client):
    for play, (kind, text, trace) in FAILURES[client.name].items():
        error = child.begin(play=play)["error"]
        assert re.fullmatch(kind, error["type"])
        assert re.fullmatch(text, error["text"])
        if client.name == "C++":
            assert error["trace"] == trace
        else:
            assert error["trace"].startswith(trace)
            assert "\tat Probe." in error["trace"]
        assert plays_well(child), "nothing of the line was sent"


@CPP
def test_an_option_of_another_type_is_an_error_that_names_it(child):
    assert child.begin(play="deaf", times="x")["error"]["text"].startswith('option times: "x" is not of the type')


def test_the_longest_lines_go_both_ways(child):
    text = "y" * (LONGEST - 100)
    assert len(child.begin(value=text)["args"]["value"]) == len(text)
    assert child.act(1, text) == ended(text)
    child.begin(value=0)
    frame = b'{"act": 1, "value": 1}'
    child.send(b" " * (LONGEST - len(frame) - 1) + frame + b"\n")
    assert child.receive() == ended(1)


# What is no answer, and what Java says of it; None: it takes that for an answer.
ANSWERS = {
    b'{"act": 2, "value": 0}': "call 1 waits for its answer, and this came: ",
    b'{"act": "1", "value": 0}': "call 1 waits for its answer",
    b'{"act": true, "value": 0}': "call 1 waits for its answer",
    b'{"act": 1}': "an answer to call 1 was expected",
    b'{"rule": true}': "an answer to call 1 was expected",
    b'{"pause": 1}': 'an answer to call 1 was expected, and this came: {"pause":1}',
    b'{"stop": false}': None,
    b'{"reseed": "x"}': None,
    b"[1]": "one object was expected",
    b"garbage": "a line is not understood: a value was expected, near garbage",
    b"": "more was expected",
    b'{"act": 1, "value": "x': "a string does not end",
    b'{"act": 1 "value": 0}': "a comma or } was expected, near",
    b'{"act": 1, "value": [1,]}': "a value was expected",
    b'{"act": 1, "value": NaN}': "a value was expected",
    b'{"act": 1, "value": 18446744073709551616}': None,
    b'{"act": 1, "value": 1e999}': None,
    b'{"act": 1, "value": "\\x"}': "there is no such escape",
    b'{"act": 1, "value": "\\ud834"}': None,
    b'{"act": 1, "value": "\xed\xa0\x80"}': "MalformedInput",
    b'{"act": 1, "value": ' + b"[" * 100_000: "it is nested too deeply",
}


@pytest.mark.parametrize(
    ("client", "line"),
    [("C++", line) for line in ANSWERS] + [("Java", line) for line, text in ANSWERS.items() if text is not None],
    indirect=["client"],
    ids=lambda value: repr(value[:40]),
)
def test_an_invalid_answer_ends_the_child_with_an_error(child, client, line):
    child.begin(play="count")
    child.send(line + b"\n")
    error = child.receive()["error"]
    assert error["text"]
    if client.name == "C++":
        assert error["type"] == "simenv::WireError"
    else:
        assert ANSWERS[line] in error["text"]
    assert child.receive() is None
    assert child.ended() == (1, client.said, client.unwound), "the model was unwound, though it catches errors"


def test_a_line_without_an_end_is_given_up(child, client):
    child.begin(play="count")
    child.send(b" " * LONGEST)
    text = {"C++": "a line of more than 16 MiB", "Java": "a line has more than 16 MiB"}[client.name]
    assert child.receive()["error"]["text"] == text
    assert has_given_up(child)


def test_an_answer_between_episodes_is_an_error_and_the_end(child, client):
    child.begin(play="count")
    child.send(stop=True)
    error = child.rule(1)["error"]
    assert client.name == "C++" or 'a start was expected, and this came: {"act":1,"rule":true}' in error["text"]
    assert has_given_up(child)


@CPP
@pytest.mark.parametrize(
    "frame", [{"stop": True}, {"start": {"seed": "x"}}, {"start": {"seed": -1}}, {"start": {"seed": 0.5}}, {"start": 1}]
)
def test_an_invalid_start_ends_the_child_with_an_error(child, frame):
    child.send(**frame)
    assert child.receive()["error"]["type"] == "simenv::WireError"
    assert has_given_up(child)


@pytest.mark.parametrize("closed", [["out"], ["into", "out"], ["into"]], ids=["input", "both", "output"])
def test_a_parent_that_is_gone_is_the_end(child, client, closed):
    if "into" in closed:
        child.begin(play="count")
    for end in closed:
        child.close(end)
    if "out" not in closed:
        child.send(act=1, value=1)
    assert child.ended() == (0, client.said, client.unwound if "into" in closed else ""), "and no signal"


def test_a_model_may_exit(child):
    assert child.begin(play="leave", status=3) is None
    assert child.ended()[0] == 3


@CPP
def test_processes_of_the_model_inherit_nothing_of_the_wire(child):
    reading, writing = child.descriptors
    command = f'test -z "$SIMENV_MARL_FDS" && ! test -e /dev/fd/{reading} && ! test -e /dev/fd/{writing}'
    assert child.begin(play="shell", command=command) == ended(0)
    assert child.begin(play="shell", command="kill -PIPE $$") == ended(signal.SIGPIPE), "as ever"


def test_outside_an_environment_the_model_runs_once_on_its_rule(client):
    done = plain(client, "count")
    assert (done.stdout, done.stderr) == (f"{client.said}5\n", "unwound by rule 7\n")
    failed = plain(client, "fail")
    assert failed.returncode == {"C++": -signal.SIGABRT, "Java": 1}[client.name]
    assert {"C++": "the pump is broken", "Java": "burnt down"}[client.name] in failed.stderr
    assert client.name == "Java" or plain(client, "echo", '[1, 2.0, "ü"]').stdout == '[1,2.0,"ü"]\n'


@pytest.mark.parametrize(
    ("client", "said", "text"),
    [
        *(("C++", said, "SIMENV_MARL_FDS") for said in ["", "3,", "a,b", "3,4,5", "998,999"]),
        ("Java", "98,99", "/dev/fd/98"),
        ("Java", "7", "has to be two numbers"),
    ],
    indirect=["client"],
)
def test_descriptors_that_are_none_are_refused(client, said, text):
    done = plain(client, descriptors=said)
    assert done.returncode == {"C++": -signal.SIGABRT, "Java": 1}[client.name]
    assert text in done.stderr
