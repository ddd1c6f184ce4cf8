"""The wire: what is sent arrives, what is no frame is refused; and the check that authors of clients make of them."""

import json
import re
import sys
from math import inf, isnan, nan
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simenv_marl.__main__ import main
from simenv_marl.errors import WireError
from simenv_marl.remote.check import check_wire
from simenv_marl.remote.wire import KEYS, decode, encode
from tests.outside.reservoirs import EXITS_AFTER_STOP, changed, command

pytestmark = pytest.mark.greenlet("no environment is made")

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text().filter(lambda key: key != "float"), inner),
    max_leaves=20,
)


@given(VALUES)
def test_decoded_frames_equal_encoded_ones(value):
    line = encode({"value": value})
    assert line.endswith(b"\n")
    assert line.count(b"\n") == 1
    json.loads(line, parse_constant=lambda constant: pytest.fail(constant))  # any JSON reader can read it
    found = decode(line)["value"]
    assert found == value
    assert repr(found) == repr(value)  # -0.0, and integers that are no floats


def test_numbers_that_are_not_finite():
    line = encode({"value": [nan, inf, -inf, np.float32(inf)]})
    assert json.loads(line)["value"] == [{"float": "nan"}, {"float": "inf"}, {"float": "-inf"}, {"float": "inf"}]
    found = decode(line)["value"]
    assert isnan(found[0])
    assert found[1:] == [inf, -inf, inf]
    assert decode(b'{"a": {"float": 3}, "b": {"float": "nan", "more": 1}}') == {
        "a": {"float": 3},
        "b": {"float": "nan", "more": 1},
    }


@pytest.mark.parametrize(
    ("value", "sent"),
    [
        (np.float64(0.1), "0.1"),
        (np.int64(3), "3"),
        (np.bool_(True), "true"),
        (np.arange(4).reshape(2, 2), "[[0,1],[2,3]]"),
        (np.array(2.5), "2.5"),
        ((1, "a"), '[1,"a"]'),
        ({"a": np.zeros(1)}, '{"a":[0.0]}'),
        ("ä\n\ud800", '"\\u00e4\\n\\ud800"'),
    ],
)
def test_numbers_of_numpy_and_python_are_sent_as_json(value, sent):
    assert encode({"value": value}) == f'{{"value":{sent}}}\n'.encode()


@pytest.mark.parametrize(
    ("value", "where"),
    [({1}, "not JSON"), ([1, [object()]], r"\[1\]\[0\]"), ({"a": {2: 3}}, "'a'"), (b"a", "b'a'"), (1j, "1j")],
)
def test_values_that_are_no_json_are_refused_with_their_place(value, where):
    with pytest.raises(WireError, match=where):
        encode({"value": value})


LONG = b'{"a": ' + b"1" * 10_000 + b"}"


@pytest.mark.parametrize(
    "line", [b"", b"NaN", b"[1]", b"3", b"{", b'{"a": Infinity}', b'{"a": "\xff"}', b"[" * 10**5, LONG]
)
def test_invalid_frames_are_refused(line):
    with pytest.raises(WireError):
        decode(line)


def test_the_page_shows_frames_that_the_wire_has():
    text = (Path(__file__).parents[2] / "docs" / "wire.md").read_text(encoding="utf-8")
    shown = [decode(line.encode()) for line in re.findall("^(?:->|<-)  (.*)$", text, re.MULTILINE)]
    assert {next(iter(frame)) for frame in shown} == {*KEYS, "start", "act", "reseed", "stop"}


def found(report):
    return {finding.tried: finding.verdict for finding in report.findings}


def test_nothing_is_wrong_with_a_simulator_that_does_well():
    report = check_wire(command())
    assert report.ok
    assert len(report.findings) == 18
    assert found(report).pop("a run without an environment") == "note"  # it wants a seed then
    assert "nothing is wrong" in str(report)


def test_a_program_may_play_one_episode_and_be_started_again():
    report = check_wire(command("1"), timeout=10)
    assert report.ok, str(report)
    (one,) = [finding for finding in report.findings if finding.tried == "two episodes in a row with the same seed"]
    assert one.verdict == "note"
    assert "exits with code 0 after an episode, and plays the same in a new process" in one.text


def test_a_simulator_may_exit_after_a_stop(tmp_path):
    report = check_wire(changed(tmp_path, EXITS_AFTER_STOP.format(code=0)))
    assert report.ok, str(report)
    stops = {tried: verdict for tried, verdict in found(report).items() if tried.startswith("stop")}
    assert len(stops) == 3
    assert set(stops.values()) == {"note"}


def test_an_episode_that_does_not_end_is_broken_off():
    report = check_wire(command(), options=MappingProxyType({"hours": 10_000}), decisions=20)
    assert report.ok
    assert found(report)["an episode by its own rule"] == "note"


@pytest.mark.parametrize(
    ("change", "tried"),
    [
        ("outside.Wire.play = lambda *_: None", "starts, and says hello"),
        ("outside.POINTS = []", "starts, and says hello"),
        ("outside.Reservoirs.run = lambda *_: None", "an episode by its own rule"),
        ("outside.random.Random = lambda seed: outside.random", "two episodes in a row with the same seed"),
        (
            "stopped = outside.Stopped\n"
            "class Stopped(Exception):\n"
            "    def __init__(self): wire.send({'end': {}})\n"
            "init = outside.Wire.__init__\n"
            "def keep(self):\n    global wire\n    wire = self\n    init(self)\n"
            "outside.Wire.__init__, outside.Stopped = keep, Stopped",
            "stop in place of the answer to call 1",
        ),
        (EXITS_AFTER_STOP.format(code=3), "stop in place of the answer to call 1"),
        (
            "receive = outside.Wire.receive\n"
            "def lenient(self):\n    answer = receive(self)\n"
            "    return {**answer, 'act': self.number} if 'act' in answer else answer\n"
            "outside.Wire.receive = lenient",
            "an answer with the number of another call",
        ),
    ],
)
def test_wire_check_finds_faults(tmp_path, change, tried):
    report = check_wire(changed(tmp_path, change), timeout=10.0)
    assert not report.ok
    assert found(report)[tried] == "wrong", str(report)


SENDS = """
send = outside.Wire.send
def sends(self, frame):
    {}
    send(self, frame)
outside.Wire.send = sends
"""
SEEDS = """
init = outside.Reservoirs.__init__
def begin(self, seed, options): init(self, {}, options)
outside.Reservoirs.__init__ = begin
"""
DECIDES = """
decide = outside.Wire.decide
def decides(self, point, entity, time, arguments, rule):
    value = decide(self, point, entity, time, arguments, rule)
    {}
outside.Wire.decide = decides
"""


@pytest.mark.parametrize(
    ("change", "tried", "text"),
    [
        (
            "def remove(self, point, entity):\n    for name in 'ab': self.send({'remove': name, 'point': point})\n"
            "outside.Wire.remove = remove",
            "an episode by its own rule",
            r"call \d+ is of '[ab]' at reservoir\.inflow, which was removed before; an entity .* needs a name",
        ),
        (
            DECIDES.format("return rule() if point == 'broker.price' else value"),
            "other decisions at broker.price",
            'the decisions 0, 1, 100 lead to the same episode: continue with the "value" of "act"',
        ),
        (
            DECIDES.format("return rule()")  # its rule's decisions are strings, and are known to be legal
            + SENDS.format("frame = {**frame, 'can': ['reseed', 'decided']} if 'hello' in frame else frame")
            + "receive = outside.Wire.receive\n"
            "def told(self):\n    answer = receive(self)\n"
            "    if answer.get('rule'): send(self, {'decided': self.number, 'value': 'abc'[self.number % 3]})\n"
            "    return answer\n"
            "outside.Wire.receive = told",
            "other decisions at reservoir.inflow",
            "the decisions '[abc]', '[abc]' lead to the same episode",
        ),
        (SEEDS.format("seed % 2**16"), "other seeds", "1 to 4 lead to the same episodes as .*: keep all 31 bits"),
        (
            SEEDS.format("seed & ~127 if seed > 2**24 else seed"),
            "other seeds",
            "1073741825 to .* lead to the same episode:",
        ),
        (SEEDS.format("7"), "other seeds", 'though "reseed" changes it: seed the generators with the seed of "start"'),
        (
            "from time import time_ns\nsys.argv.append('1')\n" + SEEDS.format("time_ns()"),
            "two episodes in a row with the same seed",
            r"frame \d is .*, and in a new process it was .*; seed all generators",
        ),
        (
            SENDS.format("frame = {**frame, 'argz': {}} if 'decide' in frame else frame"),
            "an episode by its own rule",
            "the key 'argz' of .* does not exist; did you mean args",
        ),
        (
            SENDS.format("frame = {'end': {'score': 3}} if 'end' in frame else frame"),
            "an episode by its own rule",
            "the key 'score' of .* does not exist; an argument belongs into args, another result into result",
        ),
        (
            SENDS.format("frame = {**frame, 'name': 'dam'} if 'hello' in frame else frame"),
            "starts, and says hello",
            "the key 'name' of .* does not exist",
        ),
        (
            SENDS.format("frame = {**frame, 'can': ['reseeds']} if 'hello' in frame else frame"),
            "starts, and says hello",
            "the \"can\" of its hello lists 'reseeds', which does not exist; did you mean reseed",
        ),
        (
            SENDS.format("frame = {'end': {'truncated': 'yes'}} if 'end' in frame else frame"),
            "an episode by its own rule",
            r"'truncated': 'yes'.*\"truncated\" \(true or false\)",
        ),
        (
            SENDS.format("frame = {**frame, 'end': {}} if frame.get('decide') == 3 else frame"),
            "an episode by its own rule",
            "decide and end in one frame, .*; each needs a line of its own",
        ),
    ],
    ids=range(13),
)
def test_wire_check_says_what_is_wrong_and_what_to_do(tmp_path, change, tried, text):
    report = check_wire(changed(tmp_path, change), timeout=10.0)
    (finding,) = [finding for finding in report.findings if finding.tried == tried]
    assert finding.verdict == "wrong", str(report)
    assert re.search(f"(?s){text}", finding.text), finding.text


def test_seeds_that_change_nothing_are_noted_where_nothing_may_be_random(tmp_path):
    report = check_wire(changed(tmp_path, SEEDS.format("7") + "outside.random.Random.seed = lambda *_: None"))
    assert found(report)["other seeds"] == "note", str(report)


def test_decisions_of_another_kind_are_noted(tmp_path):
    report = check_wire(
        changed(tmp_path, DECIDES.format("return value if value < 10 and value is not True else 1 // 0"))
    )
    assert found(report)["other decisions at reservoir.inflow"] == "note", str(report)


def test_a_reseed_that_changes_nothing_is_noted(tmp_path):
    report = check_wire(changed(tmp_path, "outside.random.Random.seed = lambda *_: None"))
    assert found(report)["reseed"] == "note"


def test_the_run_without_an_environment_has_the_variables_of_this_process(tmp_path, monkeypatch):
    monkeypatch.setenv("NEEDED", "3")
    report = check_wire(changed(tmp_path, "import os; print(os.environ['NEEDED'], file=sys.stderr)"))
    assert "KeyError" not in report.findings[-1].text


def test_the_command_wire_check_reports_and_exits(capsys):
    assert main(["wire-check", "--seed", "3", "--", *command()]) == 0
    assert "nothing is wrong" in capsys.readouterr().out
    assert main(["wire-check", "--json", "--options", '{"hours": 3}', *command()]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["ok"]
    assert "broker.price 1" in told["findings"][1]["text"]
    assert main(["wire-check", "--timeout", "5", sys.executable, "-c", "pass"]) == 1
    assert "has exited with code 0" in capsys.readouterr().out
    assert main(["wire-check"]) == 2
    assert "needs a command" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["wire-check", "--options", "[1]", *command()])
    assert "not a JSON object" in capsys.readouterr().err
