"""The clients in C++, Java and Python: programs follow a script, and the test is the other side."""

import ast
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from examples.jvm_market.build import CLIENT, build, java

from tests.outside.conftest import COMPILER, HERE, compiled
from tests.outside.wire import PATIENCE, VALUES, Child

pytestmark = pytest.mark.greenlet("there is no environment")

HELLO = {"hello": 1, "points": ["a", "b"], "can": ["decided", "expect", "reseed"]}
CPP = pytest.mark.parametrize("client", ["C++"], indirect=True)
JAVA = pytest.mark.parametrize("client", ["Java"], indirect=True)
PYTHON = pytest.mark.parametrize("client", ["Python"], indirect=True)
TYPED = pytest.mark.parametrize("client", ["C++", "Java"], indirect=True)
LONGEST = 16 << 20


class Client(NamedTuple):
    """A client's probe, and what it says on standard error when a stop unwinds it."""

    name: str
    command: list[Any]
    unwound: str = "unwound by Stop\n"


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


@pytest.fixture(params=["C++", "Java", "Python"])
def client(request):
    name, _, version = request.param.partition(" ")
    if name == "Python":
        found = (
            sorted((Path.home() / ".pyenv" / "versions").glob(f"{version}.*/bin/python"))
            if version
            else [sys.executable]
        )
        if not found:
            pytest.skip(f"there is no {request.param}")
        return Client(name, [found[-1], HERE / "probe.py"])
    if request.param == "Java":
        return Client("Java", request.getfixturevalue("java_probe"))
    return Client("C++", request.getfixturevalue("cpp_probe"), "unwound by rule 7\n")


@pytest.fixture
def child(client):
    with Child(*client.command) as child:
        hello = child.receive()
        assert {**hello, "can": sorted(hello["can"])} == HELLO
        yield child


def ended(result=None, *, truncated=False):
    return {"end": {"truncated": truncated, "result": result}}


def plays_well(child):
    """Whether an episode is one like any other."""
    return child.begin(5, play="seed") == ended(5)


def has_given_up(child):
    """Whether the process has ended with an error and said nothing more."""
    return child.receive() is None and child.ended()[0] == 1


def plain(client, play, **env):
    """Run a model without an environment, or with one that is none."""
    command, text = [*client.command, play], {"encoding": "utf-8", "errors": "replace"}
    return subprocess.run(
        command, env=os.environ | env, capture_output=True, timeout=PATIENCE, **text
    )


@pytest.mark.parametrize("ascii_only", [True, False])
def test_client_libraries_pass_values_to_the_model_and_back_unchanged(child, client, ascii_only):
    large = [] if client.name == "C++" else [-(2**70)]
    for value in [*VALUES, *large]:
        line = json.dumps(
            {"start": {"seed": 1, "options": {"value": value}}}, ensure_ascii=ascii_only
        )
        # blanks and needless escapes are JSON, too
        child.send(line.replace("/", "\\/").encode() + b"\r\n")
        asked = child.receive()
        assert asked == {
            "decide": 1,
            "point": "a",
            "entity": "ä",
            "time": 0.25,
            "args": {"value": value},
        }
        assert repr(asked["args"]["value"]) == repr(value)
        assert repr(child.act(1, value)) == repr(ended(value))
        child.begin(value=value)
        assert repr(child.rule(1)) == repr(ended(value))
        assert repr(child.decided[-1]) == repr(value), (
            "the rule's decision goes back unchanged, too"
        )


BIG = 123456789012345678901234567890
ARGUMENTS = {
    "C++": [
        {"x": 1.0, "y": 0.10000000149011612},
        {"flags": [True, False], "name": "b", "half": 0.5, "most": 2**64 - 1},
    ],
    "Python": [{"value": [[1, 2], [1, 0.5, {"float": "nan"}], {"float": "inf"}, {"x": 0.5}]}],
    "Java": [
        {
            "value": [
                [1, 2],
                [0.5, {"float": "nan"}],
                [],
                "GLAD",
                "c",
                1.5,
                3,
                [{"1": "one"}],
                7,
                0.5,
                BIG,
                None,
            ],
            "full": True,
            "mark": "m",
        }
    ],
}


def test_client_libraries_send_arguments_of_all_types(child, client):
    calls, _ = child.play(play="arguments")
    assert repr([call["args"] for call in calls]) == repr(ARGUMENTS[client.name])
    assert "time" not in calls[0]


# The decisions, and the model's values of them; without decisions, those of its rule.
TYPES = {
    "C++": [
        (
            [3, 4.0, 1, "\u00e4\n", [1, 2.5], {"a": [True]}],
            [3.0, 4, True, "\u00e4\n", [1.0, 2.5], {"a": [True]}],
        ),
        *(
            ([{"float": name}, 1, False, "x", [{"float": name}], None],) * 2
            for name in ("nan", "inf", "-inf")
        ),
        (None, [0.5, 3, True, "rule", [1.0, 2.0], None]),
    ],
    "Java": [
        ([3, 2**40, -7, True, "GLAD"], [3.0, 2**40, -7, True, "GLAD"]),
        *(([{"float": name}, 0, 0, False, "GLAD"],) * 2 for name in ("nan", "inf", "-inf")),
        (None, [0.25, 3, 2, False, "GLAD"]),
    ],
}


@TYPED
def test_client_libraries_give_the_model_the_types_that_it_asks_for(child, client):
    for decisions, found in TYPES[client.name]:
        left = iter(decisions or [])
        _, last = child.play(
            None if decisions is None else lambda call, left=left: next(left), play="types"
        )
        assert repr(last) == repr(ended(found))


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


@TYPED
def test_client_libraries_raise_an_error_for_a_decision_of_another_type(child, client):
    kind, text = {
        "C++": (
            "simenv::JsonError",
            r"decision {}, at a: .* is not of the type that the model takes",
        ),
        # cannot be swallowed
        "Java": ("java.lang.IllegalArgumentException", r"a cannot take the decision .*"),
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
def test_cpp_client_can_ask_for_a_decision_without_a_rule(child):
    child.begin(play="optional")
    assert child.act(1, 2) == ended(2.0)
    child.begin(play="optional")
    assert child.rule(1) == ended(-1.0)
    child.begin(play="reported")
    assert child.rule(1) == ended(0)
    assert child.decided == [None, 7]


def test_client_libraries_report_null_if_the_rule_fails(child):
    child.begin(play="careless")
    child.send(act=1, rule=True)
    assert [child.receive() for _ in range(2)] == [
        {"decided": 1, "value": None},
        {"decide": 2, "point": "a", "entity": "x", "args": {}},
    ]
    assert child.rule(2) == ended(1)
    assert child.decided == [1]


def test_client_libraries_send_updates_removals_and_expected_calls(child, client):
    entity = "12" if client.name == "Java" else 12
    call = {"point": "a", "args": {"level": 0.5}, "time": 1.5}
    assert [child.begin(play="reports"), *(child.receive() for _ in range(6))] == [
        {"update": entity, **call},
        {"remove": entity, "point": "a"},
        {"remove": '"b"', "point": "a"},
        {"update": None, "point": "a", "args": {"level": 1}},
        {"expect": [{"entity": entity, **call}]},
        {"expect": [{"entity": None, "point": "b", "args": {}}]},
        ended(),
    ]


def test_client_libraries_let_a_model_truncate_its_episode(child):
    assert child.begin(play="truncated") == ended({"reached": 3}, truncated=True)
    assert child.begin(play="none") == ended()


def test_client_libraries_allow_a_decision_inside_a_rule_not_reported(client):
    with Child(*client.command, NESTED="1") as child:
        assert sorted(child.receive()["can"]) == ["expect", "reseed"]
        frames = child.begin(play="nested"), child.rule(1)
        assert [(call["decide"], call["point"], call["entity"]) for call in frames] == [
            (1, "a", "x"),
            (2, "b", "y"),
        ]
        assert child.act(2, 6) == ended(60)


def test_client_libraries_refuse_a_decision_inside_a_rule_that_is_reported(child):
    child.begin(play="nested")
    text = child.rule(1)["error"]["text"]
    assert re.match("the rule of a has asked for a decision.*report_?[rR]ules", text)
    assert plays_well(child)


@CPP
def test_cpp_client_sends_braced_pairs_as_json_objects(child):
    assert child.begin(play="objects") == ended({"a": 1, "b": {"c": "d"}, "e": [1, "f"]})


@PYTHON
def test_python_client_asks_for_the_decision_of_a_decorated_function(child):
    asked = child.begin(play="decorated")
    assert asked == {"decide": 1, "point": "a", "entity": "x", "time": 2.0, "args": {"level": 3}}
    assert child.rule(1) == ended(4)
    child.begin(play="decorated")
    assert child.act(1, "other") == ended("other")


@PYTHON
def test_python_client_refuses_decisions_in_another_thread(child):
    error = child.begin(play="threaded")["error"]
    assert error["type"] == "RuntimeError"
    assert "thread 'callbacks'" in error["text"]
    assert "thread 'MainThread'" in error["text"]
    assert "in callback" in error["trace"]
    assert plays_well(child)


@JAVA
def test_java_client_lets_threads_decide_one_at_a_time_and_stops_them(child):
    calls, last = child.play(lambda call: call["args"]["n"] + 1, play="threads")
    assert [call["decide"] for call in calls] == list(range(1, 201))
    assert last == ended([50, 100, 150, 200])
    child.begin(play="threads")
    child.send(stop=True)
    assert plays_well(child)


def slowly(call):
    """Takes longer than a thread of the stopped episode sleeps."""
    time.sleep(0.005)
    return call["args"]["n"]


@JAVA
def test_java_client_thread_of_a_stopped_episode_does_not_decide_later(child):
    child.begin(play="late_threads")
    child.send(stop=True)
    calls, _ = child.play(slowly, play="late_threads")
    assert len(calls) == 100


SEEDS = {"C++": (0, 2**64 - 1), "Java": (-(2**63), 2**63 - 1), "Python": (0, 2**31 - 1)}


def test_client_libraries_get_a_seed_or_draw_one(child, client):
    least, most = SEEDS[client.name]
    for seed in (least, 7, most):
        assert child.begin(seed, play="seed") == ended(seed)
    drawn = []
    for start in ({"seed": None}, {}):
        child.send(start=start | {"options": {"play": "seed"}})
        drawn.append(child.receive()["end"]["result"])
    assert drawn[0] != drawn[1]
    assert least <= min(drawn) <= max(drawn) <= most


def test_client_libraries_reseed_generators_before_an_answer(child, client):
    child.begin(play="reseed")
    child.send(reseed=12)
    child.send(reseed=13)
    own = 1000 if client.name == "Java" else 0  # the callback's own decision, which is its rule's
    assert child.rule(1) == ended(13 + own)


def test_client_libraries_unwind_the_model_at_a_stop(child, client):
    for answered in (0, 1, 1):
        child.begin(play="count")
        if answered:
            child.act(1, 1)
        child.send(stop=True)
        if client.name == "Java":
            child.send(stop=True)  # one too many is none
        assert plays_well(child)
    child.out.close()
    assert child.ended() == (0, "", client.unwound * 3)


@pytest.mark.parametrize(
    ("client", "gone"),
    [("C++", False), ("C++", True), ("Java", True), ("Python", False), ("Python", True)],
    indirect=["client"],
)
def test_client_libraries_end_a_model_that_ignores_a_stop(child, client, gone):
    child.begin(play="deaf")
    if gone:
        child.out.close()
    else:
        child.send(stop=True)
    assert child.receive() is None
    status, output, errors = child.ended()
    assert (status, output) == (1, "")
    assert client.name == "Java" or "the model catches" in errors


@CPP
@pytest.mark.skipif(not os.path.exists("/proc/self/statm"), reason="no /proc")
def test_cpp_client_does_not_leak_memory_over_many_stops(child):
    resident = []
    for number in range(3_000):
        child.begin(play="count")
        child.send(stop=True)
        if number in (500, 2_999):
            resident.append(
                int(Path(f"/proc/{child.process.pid}/statm").read_text("ascii").split()[1])
            )
    assert resident[1] <= resident[0] + 16, "pages"


# -- errors ----------------------------------------------------------------------------------------

# By what is played: patterns of the type and the text.
NOT_UTF_8 = ("simenv::JsonError", "a text that is not UTF-8: \ufffd.*")
JAVA_REFUSES = "java.lang.IllegalArgumentException"
FAILURES = {
    "C++": {
        "fail": (".*std::runtime_error.*", "the pump is broken \ufffd"),
        "number": ("unknown", ".+"),
        "text": NOT_UTF_8,
        "name": NOT_UTF_8,
        "huge": ("std::length_error", "a line of more than 16 MiB"),
    },
    "Java": {
        "fail": ("java.io.IOException", "the pump is broken \u2603"),
        "silent": ("java.lang.RuntimeException", ""),
        "huge": (JAVA_REFUSES, "16777273 bytes are to be sent, and 16 MiB is the most"),
        "bad rule": (
            JAVA_REFUSES,
            "the rule's decision of call 1 cannot be sent: a java.lang.Object.*",
        ),
        **{
            f"bad {what}": (JAVA_REFUSES, "a java.lang.Object cannot be sent")
            for what in ("arguments", "result")
        },
    },
    "Python": {
        "fail": ("RuntimeError", "the pump is broken"),
        "huge": ("ValueError", r"a line of 16\d* bytes cannot be sent; 16 MiB is the most"),
        "reserved": ("ValueError", "'time' cannot be the name of an argument at a: .*"),
        **{
            f"bad {what}": ("TypeError", "<object .*> cannot be sent: .*")
            for what in ("arguments", "result")
        },
    },
}
TRACES = {
    "C++": r"(caused by std::out_of_range: the cause\n)?\Z",
    "Java": r"java\..*\tat Probe\.",
    "Python": "Traceback",
}


def test_client_libraries_send_a_models_error_and_play_the_next_episode(child, client):
    for play, (kind, text) in FAILURES[client.name].items():
        error = child.begin(play=play)
        error = (child.rule(1) if "decide" in error else error)["error"]
        assert re.fullmatch(kind, error["type"])
        assert re.fullmatch(text, error["text"])
        assert re.match(TRACES[client.name], error["trace"], re.DOTALL)
        assert client.name == "Java" or ("the cause" in error["trace"]) == (play == "fail")
        assert plays_well(child), "nothing of the line was sent"


@CPP
def test_cpp_client_names_an_option_of_another_type(child):
    assert child.begin(play="leave", status="x")["error"]["text"].startswith(
        'option status: "x" is not of the type'
    )


def test_client_libraries_send_and_receive_lines_of_the_maximum_length(child):
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
    b'{"act": true, "value": 0}': "call 1 waits for its answer",
    b'{"act": 1}': "an answer to call 1 was expected",
    b'{"pause": 1}': 'an answer to call 1 was expected, and this came: {"pause":1}',
    b'{"stop": false}': None,
    b'{"reseed": "x"}': None,
    b"[1]": "one object was expected",
    b"garbage": "a line is not understood: a value was expected, near garbage",
    b"": "more was expected",
    b'{"act": 1, "value": "x': "a string does not end",
    b'{"act": 1 "value": 0}': "a comma or } was expected, near",
    b'{"act": 1, "value": NaN}': "a value was expected",
    b'{"act": 1, "value": 18446744073709551616}': None,
    b'{"act": 1, "value": 1e999}': None,
    b'{"act": 1, "value": "\\x"}': "there is no such escape",
    b'{"act": 1, "value": "\\ud834"}': None,
    b'{"act": 1, "value": "\xed\xa0\x80"}': "MalformedInput",
    b'{"act": 1, "value": ' + b"[" * 100_000: "it is nested too deeply",
    b" " * LONGEST: "a line has more than 16 MiB",
}


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("client", "line"),
    [("C++", line) for line in ANSWERS]
    + [("Java", line) for line, text in ANSWERS.items() if text is not None]
    + [("Python", line) for line in ANSWERS if not re.search(rb"184467|1e999|ud834", line)],
    indirect=["client"],
    ids=lambda value: repr(value[:40]),
)
def test_client_libraries_end_with_an_error_after_an_invalid_answer(child, client, line):
    child.begin(play="count")
    child.send(line + b"\n")
    error = child.receive()["error"]
    assert error["text"]
    if client.name == "C++":
        assert error["type"] == "simenv::WireError"
    elif client.name == "Python":
        assert error["type"] == "simenv_marl_client.WireError"
    else:
        assert ANSWERS[line] in error["text"]
    assert child.receive() is None
    assert child.ended() == (1, "", client.unwound), (
        "the model was unwound, though it catches errors"
    )


def test_client_libraries_end_with_an_error_after_an_unexpected_answer(child, client):
    child.begin(play="count")
    child.send(stop=True)
    error = child.rule(1)["error"]
    assert (
        client.name != "Java"
        or 'a start was expected, and this came: {"act":1,"rule":true}' in error["text"]
    )
    assert has_given_up(child)


@pytest.mark.parametrize("client", ["C++", "Python"], indirect=True)
@pytest.mark.parametrize(
    "frame", [{"stop": True}, {"start": {"seed": "x"}}, {"start": {"seed": 0.5}}, {"start": 1}]
)
def test_client_libraries_end_with_an_error_after_an_invalid_start(child, frame):
    child.send(**frame)
    assert child.receive()["error"]["type"].endswith("WireError")
    assert has_given_up(child)


@pytest.mark.parametrize(
    "closed", [["out"], ["into", "out"], ["into"]], ids=["input", "both", "output"]
)
def test_client_libraries_end_when_their_parents_pipes_close(child, client, closed):
    if "into" in closed:
        child.begin(play="count")
    for end in closed:
        getattr(child, end).close()
    if "out" not in closed:
        child.send(act=1, value=1)
    assert child.ended() == (0, "", client.unwound if "into" in closed else ""), "and no signal"


def test_client_libraries_let_a_model_exit_its_process(child):
    assert child.begin(play="leave", status=3) is None
    assert child.ended()[0] == 3


@pytest.mark.parametrize("client", ["C++", "Python"], indirect=True)
def test_client_libraries_keep_pipes_from_processes_of_the_model(child, client):
    reading, writing = child.descriptors
    command = (
        f'test -z "$SIMENV_MARL_FDS" && ! test -e /dev/fd/{reading} && ! test -e /dev/fd/{writing}'
    )
    assert child.begin(play="shell", command=command) == ended(0)
    if client.name == "C++":
        assert child.begin(play="shell", command="kill -PIPE $$") == ended(signal.SIGPIPE), (
            "as ever"
        )


def test_client_libraries_run_the_rule_without_an_environment(client):
    done = plain(client, "count")
    assert (done.stdout, done.stderr) == ("5\n", "unwound by rule 7\n")
    failed = plain(client, "fail")
    assert failed.returncode == (-signal.SIGABRT if client.name == "C++" else 1)
    assert "the pump is broken" in failed.stderr


INVALID = ["", "3,", "a,b", "3,4,5", "998,999"]


@pytest.mark.parametrize(
    ("client", "said", "text"),
    [
        *((name, said, "SIMENV_MARL_FDS") for name in ("C++", "Python") for said in INVALID),
        ("Java", "98,99", "/dev/fd/98"),
        ("Java", "7", "has to be two numbers"),
    ],
    indirect=["client"],
)
def test_client_libraries_refuse_invalid_descriptors(client, said, text):
    done = plain(client, "echo", SIMENV_MARL_FDS=said)
    assert done.returncode == (-signal.SIGABRT if client.name == "C++" else 1)
    assert text in done.stderr


# -- other Pythons ---------------------------------------------------------------------------------

PYTHON_CLIENT = HERE.parents[1] / "clients" / "python" / "simenv_marl_client.py"


def test_python_client_uses_only_syntax_of_its_oldest_python():
    ast.parse(PYTHON_CLIENT.read_text(encoding="utf-8"), feature_version=(3, 8))


@pytest.mark.parametrize("client", [f"Python 3.{minor}" for minor in (8, 9, 10, 13)], indirect=True)
def test_python_client_works_with_other_python_versions(child):
    for value in VALUES:
        assert child.begin(value=value)["args"] == {"value": value}
        assert repr(child.act(1, value)) == repr(ended(value))
    child.begin(play="count")
    child.send(stop=True)
    assert child.begin(play="fail")["error"]["type"] == "RuntimeError"
    child.out.close()
    assert child.ended() == (0, "", "unwound by Stop\n")
