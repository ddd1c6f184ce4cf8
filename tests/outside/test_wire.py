"""The wire: what is sent arrives, what is no frame is refused; and the check that authors of clients make of them."""

import json
import sys
from math import inf, isnan, nan
from types import MappingProxyType

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simenv_marl.__main__ import main
from simenv_marl.errors import WireError
from simenv_marl.remote.check import check_wire
from simenv_marl.remote.wire import decode, encode
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


def found(report):
    return {finding.tried: finding.verdict for finding in report.findings}


def test_nothing_is_wrong_with_a_simulator_that_does_well():
    report = check_wire(command())
    assert report.ok
    assert len(report.findings) == 15
    assert found(report).pop("a run without an environment") == "note"  # it wants a seed then
    assert "nothing is wrong" in str(report)
    assert check_wire(command("1"), timeout=10).ok  # one episode for each process


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


def test_a_reseed_that_changes_nothing_is_noted(tmp_path):
    report = check_wire(changed(tmp_path, "outside.random.Random.seed = lambda *_: None"))
    assert found(report)["reseed"] == "note"


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
