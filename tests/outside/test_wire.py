"""The wire: frames arrive, other bytes are refused; and the check for authors of clients."""

import json
import re
import sys
from math import inf, nan
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
from tests.outside.reservoirs import changed, command

pytestmark = pytest.mark.greenlet("no environment is made")

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: (
        st.lists(inner) | st.dictionaries(st.text().filter(lambda key: key != "float"), inner)
    ),
    max_leaves=20,
)


@given(VALUES)
def test_wire_frames_are_decoded_as_they_were_encoded(value):
    line = encode({"value": value})
    assert line.endswith(b"\n")
    assert line.count(b"\n") == 1
    # any JSON reader can read it
    json.loads(line, parse_constant=lambda constant: pytest.fail(constant))
    assert repr(decode(line)["value"]) == repr(value)  # nan, -0.0, and integers that are no floats


@pytest.mark.parametrize(
    ("value", "sent"),
    [
        (
            [nan, inf, -inf, np.float32(inf)],
            '[{"float":"nan"},{"float":"inf"},{"float":"-inf"},{"float":"inf"}]',
        ),
        (np.float64(0.1), "0.1"),
        (np.bool_(True), "true"),
        (np.arange(4).reshape(2, 2), "[[0,1],[2,3]]"),
        (np.array(2.5), "2.5"),
        ((1, "a"), '[1,"a"]'),
        ({"a": np.zeros(1)}, '{"a":[0.0]}'),
        ("ä\n\ud800", '"\\u00e4\\n\\ud800"'),
    ],
)
def test_wire_sends_numbers_of_numpy_and_python_as_json(value, sent):
    assert encode({"value": value}) == f'{{"value":{sent}}}\n'.encode()


ROUND = []
ROUND.append(ROUND)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ({1}, "not JSON"),
        ([1, [object()]], r"\[1\]\[0\]"),
        ({"a": {2: 3}}, "'a'"),
        (b"a", "b'a'"),
        (1j, "1j"),
        (ROUND, "cannot be written as JSON"),
        (10**5000, "cannot be written as JSON"),
    ],
    ids=type,
)
def test_wire_refuses_values_that_are_no_json_and_names_their_place(value, text):
    with pytest.raises(WireError, match=text):
        encode({"value": value})


@pytest.mark.parametrize(
    ("line", "text"),
    [
        (b"", "not JSON"),
        (b"NaN", "NaN is not in JSON"),
        (b"[1]", "not a JSON object"),
        (b"3", "not a JSON object"),
        (b"{", "not JSON"),
        (b'{"a": Infinity}', "Infinity is not in JSON"),
        (b'{"a": "\xff"}', "UnicodeDecodeError"),
        (b"[" * 10**5, "not JSON"),
        (b'{"a": ' + b"1" * 10_000 + b"}", "not JSON"),
    ],
    ids=range(9),
)
def test_wire_refuses_invalid_lines(line, text):
    with pytest.raises(WireError, match=text):
        decode(line)


def test_wire_decodes_objects_that_only_look_like_numbers_unchanged():
    frame = {"a": {"float": 3}, "b": {"float": "nan", "more": 1}}
    assert decode(json.dumps(frame).encode()) == frame


def test_wire_page_of_the_docs_shows_existing_frames():
    text = (Path(__file__).parents[2] / "docs" / "wire.md").read_text(encoding="utf-8")
    shown = [decode(line.encode()) for line in re.findall("^(?:->|<-)  (.*)$", text, re.MULTILINE)]
    assert {next(iter(frame)) for frame in shown} == {*KEYS, "start", "act", "reseed", "stop"}


def test_wire_check_aborts_an_episode_that_does_not_end():
    report = check_wire(command(), options=MappingProxyType({"hours": 10_000}), decisions=20)
    assert report.ok
    assert report.findings[1].verdict == "note"
    assert "it was stopped after 20 decisions" in report.findings[1].text


SENDS = """
send = outside.Wire.send
def sends(self, frame):
    send(self, {{**frame, **{}.get(next(iter(frame)), {{}})}})
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


RECEIVES = """
receive = outside.Wire.receive
def receives(self):
    answer = receive(self)
    {}
    return answer
outside.Wire.receive = receives
"""
EXITS_AFTER_STOP = """
stoppable = outside.Wire.decide
def exits(*call):
    try:
        return stoppable(*call)
    except outside.Stopped:
        sys.exit({})
outside.Wire.decide = exits
"""
SEEDS_NOTHING = "outside.random.Random.seed = lambda *_: None"

HELLO, EPISODE, TWO = (
    "starts, and says hello",
    "an episode by its own rule",
    "two episodes in a row with the same seed",
)
STOP, SEED, VALUE = "stop in place of the answer to call 1", "other seeds", "other decisions at "


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("change", "tried", "text"),
    [
        ("outside.Wire.play = lambda *_: None", HELLO, "has exited with code 0"),
        ("outside.POINTS = []", HELLO, "it has no points"),
        ("outside.Reservoirs.run = lambda *_: None", EPISODE, "it asked for no decision"),
        ("outside.random.Random = lambda seed: outside.random", TWO, "seed all generators"),
        (
            RECEIVES.format("if 'stop' in answer: self.send({'end': {}})"),
            STOP,
            """has sent .*'end'.* (after "stop"|before the start)""",
        ),
        (EXITS_AFTER_STOP.format(3), STOP, "has exited with code 3"),
        (
            RECEIVES.format(
                "answer = {**answer, 'act': self.number} if 'act' in answer else answer"
            ),
            "an answer with the number of another call",
            "it continues with .*; it must end, or send an error",
        ),
        (
            "def remove(self, point, entity):\n    for name in 'ab':"
            " self.send({'remove': name, 'point': point})\n"
            "outside.Wire.remove = remove",
            EPISODE,
            (
                r"call \d+ is of '[ab]' at reservoir\.inflow, which was removed before; an entity"
                r" .* needs a name"
            ),
        ),
        (
            DECIDES.format("return rule() if point == 'broker.price' else value"),
            VALUE + "broker.price",
            'the decisions 0, 1, 100 lead to the same episode: continue with the "value" of "act"',
        ),
        (
            "sys.argv.append('tells')\n"
            # its rule's decisions are strings, and are known to be legal
            + DECIDES.format("return rule()")
            + SENDS.format("{'decided': {'value': 'abc'[self.number % 3]}}"),
            VALUE + "reservoir.inflow",
            "the decisions '[abc]', '[abc]' lead to the same episode",
        ),
        (
            "sys.argv.append('tells')\n" + RECEIVES.format("assert 'value' not in answer"),
            VALUE + "broker.price",
            "AssertionError",
        ),
        (
            RECEIVES.format("if 'value' in answer: self.send({'end': 1})"),
            VALUE + "broker.price",
            "has sent the end 1",
        ),
        (
            SEEDS.format("seed % 2**16"),
            SEED,
            "1 to 4 lead to the same episodes as .*: keep all 31 bits",
        ),
        (
            SEEDS.format("seed & ~127 if seed > 2**24 else seed"),
            SEED,
            "1073741825 to .* lead to the same episode:",
        ),
        (
            SEEDS.format("7"),
            SEED,
            'though "reseed" changes it: seed the generators with the seed of "start"',
        ),
        (
            "from time import time_ns\nsys.argv.append('1')\n" + SEEDS.format("time_ns()"),
            TWO,
            r"frame \d is .*, and in a new process it was .*; seed all generators",
        ),
        (
            SENDS.format({"decide": {"argz": {}}}),
            EPISODE,
            "the key 'argz' of .* does not exist; did you mean args",
        ),
        (
            SENDS.format({"end": {"end": {"score": 3}}}),
            EPISODE,
            "'score' of .* does not exist; an argument belongs into",
        ),
        (SENDS.format({"hello": {"name": "dam"}}), HELLO, "the key 'name' of .* does not exist"),
        (
            SENDS.format({"hello": {"can": ["reseeds"]}}),
            HELLO,
            "'reseeds', which does not exist; did you mean reseed",
        ),
    ],
    ids=range(20),
)
def test_wire_check_reports_each_fault_and_its_remedy(tmp_path, change, tried, text):
    report = check_wire(changed(tmp_path, change), timeout=10.0)
    (finding,) = [finding for finding in report.findings if finding.tried == tried]
    assert finding.verdict == "wrong", str(report)
    assert re.search(f"(?s){text}", finding.text), finding.text
    assert not report.ok


def test_wire_check_notes_behaviour_that_may_be_intended(tmp_path, monkeypatch):
    monkeypatch.setenv(
        "NEEDED", "by the run without an environment, which is started in this one's"
    )
    needs = "import os\nos.environ['NEEDED']\nsys.argv.append('1')  # plays one episode"
    numbers = DECIDES.format("return value if value < 10 and value is not True else 1 // 0")
    change = "\n".join(
        [needs, numbers, EXITS_AFTER_STOP.format(0), SEEDS.format("7"), SEEDS_NOTHING]
    )
    report = check_wire(changed(tmp_path, change))
    noted = {
        finding.tried: finding.text for finding in report.findings if finding.verdict == "note"
    }
    stops = {tried for tried in noted if tried.startswith("stop")}
    assert report.ok, str(report)
    assert len(stops) == 3
    assert noted.keys() - stops == {
        TWO,
        "reseed",
        SEED,
        VALUE + "reservoir.inflow",
        VALUE + "broker.price",
    }
    assert "exits with code 0 after an episode, and plays the same in a new process" in noted[TWO]


def test_wire_check_command_reports_and_exits_with_a_status(capsys):
    assert main(["wire-check", "--seed", "3", "--", *command()]) == 0
    assert "nothing is wrong" in capsys.readouterr().out
    assert main(["wire-check", "--json", "--options", '{"hours": 3}', *command()]) == 0
    told = json.loads(capsys.readouterr().out)
    *findings, plain_run = told["findings"]
    assert told["ok"]
    assert [finding["verdict"] for finding in findings] == ["ok"] * 17
    assert plain_run["verdict"] == "note"  # it wants a seed then
    assert "broker.price 1" in findings[1]["text"]
    assert main(["wire-check", "--timeout", "5", sys.executable, "-c", "pass"]) == 1
    assert "has exited with code 0" in capsys.readouterr().out
    assert main(["wire-check"]) == 2
    assert "needs a command" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["wire-check", "--options", "[1]", *command()])
    assert "not a JSON object" in capsys.readouterr().err
