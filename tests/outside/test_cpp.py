"""The client in C++, with a program that plays what it is told to, over pipes whose other side is played by hand."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.outside.compiling import COMPILER, SOURCES, compiled
from tests.outside.wire import PATIENCE, VALUES, Child, exactly

pytestmark = [
    pytest.mark.skipif(COMPILER is None, reason="no C++ compiler: neither g++ nor clang++ is installed"),
    pytest.mark.greenlet("there is no environment"),
]

POINTS = [f"probe.{name}" for name in ("echo", "count", "types", "deaf", "last")]
HELLO = {"hello": 1, "points": POINTS, "can": ["reseed"]}


@pytest.fixture
def child(probe):
    with Child(probe) as child:
        assert child.receive() == HELLO
        yield child


def ended(result: Any = None, *, truncated: bool = False) -> dict[str, Any]:
    return {"end": {"truncated": truncated, "result": result}}


def plain(probe: Any, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if name != "SIMENV_MARL_FDS"}
    return subprocess.run(
        [probe, *arguments], env=environment, capture_output=True, encoding="utf-8", errors="replace", timeout=PATIENCE
    )


# -- values -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", VALUES, ids=repr)
def test_a_value_goes_to_the_model_and_back_unchanged(child, value):
    asked = child.begin(value=value)
    assert asked == {"decide": 1, "point": "probe.echo", "entity": "ä", "time": 0.0, "args": {"value": value}}
    assert exactly(asked["args"]["value"]) == exactly(value)
    assert exactly(child.act(1, value)["end"]["result"]) == exactly(value)


@pytest.mark.parametrize("name", ["nan", "inf", "-inf"])
def test_numbers_that_are_not_finite_are_numbers_of_the_model(child, name):
    child.begin(play="types")
    for call, value in enumerate([{"float": name}, 1, False, "x", [{"float": name}], None], 1):
        last = child.act(call, value)
    assert last["end"]["result"]["double"] == {"float": name}
    assert last["end"]["result"]["vector"] == [{"float": name}]


values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
)


@settings(max_examples=5, deadline=None)
@given(st.lists(values, min_size=30, max_size=60))
def test_any_values_go_to_the_model_and_back_unchanged(probe, several):
    with Child(probe) as child:
        child.receive()
        asked = child.begin(value=None, times=len(several))
        for call, value in enumerate(several, 1):
            asked = child.act(call, value)
            came = asked["args"]["value"] if "args" in asked else asked["end"]["result"]
            assert exactly(came) == exactly(value)


def test_numbers_without_the_standard_librarys_conversions(folder):
    source = (SOURCES / "probe.cpp").read_text(encoding="utf-8")
    older = folder / "older.cpp"
    older.write_text(source, encoding="utf-8")
    with Child(compiled(older, folder, "-DSIMENV_NO_TO_CHARS")) as child:
        child.receive()
        for value in [0.1, -0.0, 1.0, 5e-324, 1.7976931348623157e308, 1 / 3, 1e22]:
            asked = child.begin(value=value)
            assert exactly(asked["args"]["value"]) == exactly(value)
            child.act(1, 0)


def test_the_model_has_the_types_that_it_asks_for(child):
    asked = [child.begin(play="types")]
    decisions = [3, 4.0, 1, "\u00e4\n", [1, 2.5], {"a": [True]}]
    for call, value in enumerate(decisions, 1):
        asked.append(child.act(call, value))
    assert [frame["args"] for frame in asked[:3]] == [
        {"x": 1.0, "y": 0.10000000149011612},
        {"flags": [True, False], "name": "b"},
        {"half": 0.5, "most": 2**64 - 1},
    ]
    assert "time" not in asked[0]
    result = asked[-1]["end"]["result"]
    assert exactly(result) == exactly(
        {"double": 3.0, "int": 4, "bool": True, "string": "\u00e4\n", "vector": [1.0, 2.5], "json": {"a": [True]}}
    )


def test_the_rule_decides_with_its_own_types(child):
    child.begin(play="types")
    for call in range(1, 7):
        last = child.rule(call)
    assert exactly(last["end"]["result"]) == exactly(
        {"double": 0.5, "int": 3, "bool": True, "string": "rule", "vector": [1.0, 2.0], "json": None}
    )


@pytest.mark.parametrize(
    ("call", "value"),
    [(1, "x"), (1, None), (1, True), (2, 0.5), (2, 2**31), (2, -(2**31) - 1), (3, 2), (4, 1), (5, [1, "x"]), (5, 1)],
)
def test_a_decision_of_another_type_is_an_error_of_the_model(child, call, value):
    child.begin(play="types")
    for number in range(1, call):
        child.rule(number)
    error = child.act(call, value)["error"]
    assert error["type"] == "simenv::JsonError"
    assert re.fullmatch(rf"decision {call}, at probe.types: .* is not of the type that the model takes", error["text"])
    assert child.begin(5, play="seed") == ended(5)


def test_a_model_may_ask_without_naming_its_rule(child):
    child.begin(play="optional")
    assert child.act(1, 2) == ended(2.0)
    child.begin(play="optional")
    assert child.rule(1) == ended(-1.0)


# -- episodes ---------------------------------------------------------------------------------------------------------


def test_episodes_follow_each_other_and_calls_are_counted_anew(child):
    for seed in (0, 7, 2**64 - 1):
        child.send(start={"seed": seed, "options": {"play": "seed"}})
        assert child.receive() == ended(seed)
    for _ in range(2):
        asked = child.begin(play="count", times=2)
        assert asked == {"decide": 1, "point": "probe.count", "entity": "a", "args": {"sum": 0}}
        assert child.act(1, 5)["args"] == {"sum": 5}
        assert child.rule(2)["decide"] == 3, "the guard's, which asks at its end"
        assert child.act(3, 0)["remove"] == "a"
        assert child.receive() == ended(6)


def test_an_entity_is_told_of_and_goes_before_what_comes_next(child):
    assert child.begin(play="remove")["entity"] == 12
    assert child.act(1, 0) == {"update": 12, "point": "probe.echo", "args": {"level": 0.5}, "time": 1.5}
    assert child.receive() == {"remove": 12, "point": "probe.echo"}
    assert child.receive() == {"remove": '"b"', "point": "probe.echo"}
    assert child.receive() == {"update": None, "point": "probe.echo", "args": {"level": 1}}
    assert child.receive() == ended()


def test_a_model_may_end_its_episode_itself_truncated(child):
    assert child.begin(play="truncated") == ended({"reached": 3}, truncated=True)
    assert child.begin(play="none") == ended()


def test_generators_are_seeded_anew_before_an_answer(child):
    child.begin(play="reseed")
    child.send(reseed=12)
    child.send(reseed=13)
    assert child.rule(1) == ended(13)


def test_a_seed_that_is_none_is_drawn(child):
    drawn = []
    for start in ({"seed": None}, {}):
        child.send(start=start | {"options": {"play": "seed"}})
        drawn.append(child.receive()["end"]["result"])
    assert 0 <= min(drawn) < max(drawn) < 2**64


def test_options_that_are_missing_are_none(child):
    child.send(start={"seed": 1, "options": None})
    assert child.receive()["args"] == {"value": None}


def test_an_option_of_another_type_is_an_error_that_names_it(child):
    assert child.begin(times="x")["error"]["text"].startswith('option times: "x" is not of the type')


def test_a_loop_of_the_authors_own(folder):
    with Child(compiled(SOURCES / "loop.cpp", folder)) as child:
        assert child.receive() == {"hello": 1, "points": ["loop.go"], "can": []}
        child.begin(5)
        assert child.act(1, 1)["decide"] == 2
        child.send(stop=True)
        assert child.begin(6)["args"] == {"seed": 6, "episodes": 2}
        assert child.act(1, "x")["error"]["type"] == "simenv::JsonError"
        child.begin(7)
        child.send(act=1, value=0)
        assert child.receive() == ended(), "the model has left it open, and waits for the next"
        child.close("out")
        assert child.ended()[0] == 3
    assert plain(folder / "loop").returncode == 1, "one episode, outside an environment"


# -- stops ------------------------------------------------------------------------------------------------------------


def test_a_stop_unwinds_the_model_which_is_silent_until_the_next_start(child):
    for answered in (0, 1, 1):
        child.begin(play="count")
        if answered:
            child.act(1, 1)
        child.send(stop=True)
        assert child.begin(3, play="seed") == ended(3)
    child.close("out")
    assert child.ended() == (0, "", "unwound by rule 7\n" * 3)


def test_a_model_that_does_not_hear_is_told_again(child):
    child.begin(play="deaf")
    child.send(stop=True)
    assert child.begin(4, play="seed") == ended(4)


@pytest.mark.parametrize("gone", [False, True])
def test_a_model_that_never_hears_is_ended(child, gone):
    child.begin(play="deaf", times=-1)
    if gone:
        child.close("out")
    else:
        child.send(stop=True)
    assert child.receive() is None
    assert child.ended() == (1, "", "simenv: the model catches simenv::Stop again and again, and does not unwind\n")


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


def test_an_exception_of_the_model_is_told_with_its_causes(child):
    error = child.begin(play="fail")["error"]
    assert "std::runtime_error" in error["type"]
    assert error["text"] == "the pump is broken \ufffd"
    assert error["trace"] == "caused by std::out_of_range: the cause\n"
    assert child.begin(5, play="seed") == ended(5), "and the next episode is one like any other"


def test_what_is_thrown_may_be_anything(child):
    assert child.begin(play="fail", how="number")["error"]["type"] == "unknown"


def test_a_model_that_catches_its_errors_goes_on(child):
    child.begin(play="count", times=3)
    child.act(1, 1)
    child.act(2, "what is no number")
    assert child.act(3, 1)["point"] == "probe.last", "the guard's, which asks at its end"
    child.act(4, 0)
    assert child.receive() == ended(2)


@pytest.mark.parametrize("play", ["text", "name"])
def test_a_text_that_is_not_utf_8_is_an_error_of_the_model(child, play):
    error = child.begin(play=play)["error"]
    assert error["type"] == "simenv::JsonError"
    assert error["text"].startswith("a text that is not UTF-8: \ufffd")
    assert child.begin(5, play="seed") == ended(5), "nothing of the line was sent"


def test_a_result_beyond_the_longest_line_is_an_error_of_the_model(child):
    assert len(child.begin(play="large")["end"]["result"]) == 15 << 20
    assert child.begin(play="huge")["error"] == {
        "type": "std::length_error",
        "text": "a line of more than 16 MiB",
        "trace": "",
    }
    assert child.begin(5, play="seed") == ended(5)


ANSWERS = {
    "another number": b'{"act": 2, "value": 0}',
    "number 0": b'{"act": 0, "value": 0}',
    "a number as a text": b'{"act": "1", "value": 0}',
    "no value": b'{"act": 1}',
    "no rule": b'{"act": 1, "rule": false}',
    "an unknown frame": b'{"pause": 1}',
    "another start": b'{"start": {"seed": 1, "options": {}}}',
    "a stop that is none": b'{"stop": false}',
    "a reseed without a seed": b'{"reseed": "x"}',
    "no object": b"[1]",
    "garbage": b"garbage",
    "nothing": b"",
    "a torn object": b'{"act": 1, "value": ',
    "no end of a text": b'{"act": 1, "value": "x',
    "no colon": b'{"act" 1}',
    "no comma": b'{"act": 1 "value": 0}',
    "a comma too many": b'{"act": 1, "value": [1,]}',
    "a name that is none": b"{1: 2}",
    "two objects": b'{"act": 1, "value": 0}{"act": 1, "value": 0}',
    "a number that begins with 0": b'{"act": 1, "value": 01}',
    "a number that begins with +": b'{"act": 1, "value": +1}',
    "a number that ends with its point": b'{"act": 1, "value": 1.}',
    "a number without digits": b'{"act": 1, "value": -}',
    "NaN": b'{"act": 1, "value": NaN}',
    "an integer that is too large": b'{"act": 1, "value": 18446744073709551616}',
    "a double that is too large": b'{"act": 1, "value": 1e999}',
    "an escape that is none": b'{"act": 1, "value": "\\x"}',
    "an escape of three digits": b'{"act": 1, "value": "\\u00e"}',
    "half a pair of surrogates": b'{"act": 1, "value": "\\ud834"}',
    "a low surrogate alone": b'{"act": 1, "value": "\\udd1e"}',
    "a line's end in a text": b'{"act": 1, "value": "\x01"}',
    "Latin-1": b'{"act": 1, "value": "\xe4"}',
    "an overlong character": b'{"act": 1, "value": "\xc0\x80"}',
    "a surrogate in UTF-8": b'{"act": 1, "value": "\xed\xa0\x80"}',
    "a torn character": b'{"act": 1, "value": "\xe2\x82"}',
    "what is nested too deeply": b'{"act": 1, "value": ' + b"[" * 100_000,
}


@pytest.mark.parametrize("line", ANSWERS.values(), ids=ANSWERS)
def test_what_is_no_answer_ends_the_child_with_an_error(child, line):
    child.begin(play="count")
    child.send(line + b"\n")
    error = child.receive()["error"]
    assert error["type"] == "simenv::WireError"
    assert error["text"]
    assert child.receive() is None
    assert child.ended() == (1, "", "unwound by rule 7\n"), "the model was unwound, though it catches errors"


def test_a_line_without_an_end_is_given_up(child):
    child.begin(play="count")
    child.send(b" " * (16 << 20))
    assert child.receive()["error"]["text"] == "a line of more than 16 MiB"
    assert child.ended()[0] == 1


def test_the_longest_line_is_read(child):
    child.begin(play="echo")
    frame = b'{"act": 1, "value": 1}'
    child.send(b" " * ((16 << 20) - len(frame) - 1) + frame + b"\n")
    assert child.receive() == ended(1)


@pytest.mark.parametrize(
    "frame",
    [
        {"act": 1, "value": 0},
        {"stop": True},
        {"start": {"seed": "x"}},
        {"start": {"seed": -1}},
        {"start": {"seed": 0.5}},
        {"start": 1},
    ],
    ids=repr,
)
def test_what_begins_no_episode_ends_the_child_with_an_error(child, frame):
    child.send(**frame)
    assert child.receive()["error"]["type"] == "simenv::WireError"
    assert child.receive() is None
    assert child.ended()[0] == 1


def test_a_reseed_that_was_not_offered_is_an_error(probe):
    with Child(probe, "1", "{}", "without") as child:
        assert child.receive() == HELLO | {"can": []}
        child.begin(play="reseed")
        child.send(reseed=12)
        assert child.receive()["error"]["type"] == "simenv::WireError"


# -- ends -------------------------------------------------------------------------------------------------------------


def test_a_closed_input_ends_the_child_between_episodes(child):
    child.begin(play="seed")
    child.close("out")
    assert child.ended() == (0, "", "")


def test_a_parent_that_is_gone_ends_the_child_in_mid_episode(child):
    child.begin(play="count")
    child.close("into")
    child.close("out")
    assert child.ended() == (0, "", "unwound by rule 7\n")


def test_a_reader_that_is_gone_ends_the_child_without_a_signal(child):
    child.begin(play="count")
    child.close("into")
    child.send(act=1, value=1)
    assert child.ended() == (0, "", "unwound by rule 7\n")


def test_what_the_model_starts_has_nothing_of_the_wire(child):
    reading, writing = child.descriptors
    command = f'test -z "$SIMENV_MARL_FDS" && ! test -e /dev/fd/{reading} && ! test -e /dev/fd/{writing}'
    assert child.begin(play="shell", command=command) == ended(0)


def test_what_the_model_starts_is_ended_by_a_broken_pipe_as_ever(child):
    assert child.begin(play="shell", command="kill -PIPE $$") == ended(signal.SIGPIPE)


# -- outside an environment -------------------------------------------------------------------------------------------


def test_outside_an_environment_the_model_runs_once_on_its_rule(probe):
    assert plain(probe, "7", json.dumps({"value": [1, 2.0, "ü"], "times": 3})).stdout == '[1,2.0,"ü"]\n'
    assert plain(probe, "7", '{"play": "count"}').stdout == "5\n"
    assert plain(probe).stdout == "null\n"


def test_outside_an_environment_errors_are_the_models(probe):
    done = plain(probe, "7", '{"play": "fail"}')
    assert done.returncode == -signal.SIGABRT
    assert "the pump is broken" in done.stderr


@pytest.mark.parametrize("said", ["", "3", "3,", "a,b", "3,4,5", "998,999"])
def test_descriptors_that_are_none_are_refused(probe, said):
    environment = os.environ | {"SIMENV_MARL_FDS": said}
    done = subprocess.run([probe], env=environment, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == -signal.SIGABRT
    assert "SIMENV_MARL_FDS" in done.stderr
