"""The check for authors of clients, on simulators that do well, and on those that do not."""

import json
import sys

import pytest

from simenv_marl.__main__ import main
from simenv_marl.remote.check import check_wire
from tests.outside.reservoirs import EXITS_AFTER_STOP, changed, command
from tests.worlds import faulty

pytestmark = pytest.mark.greenlet("no environment is made")


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
    report = check_wire(changed(tmp_path, EXITS_AFTER_STOP.format(code=0)), decisions=5)  # the first is broken off, too
    assert found(report)["two episodes in a row with the same seed"] == "note"


def test_an_episode_that_does_not_end_is_broken_off():
    report = check_wire(command(), options={"hours": 10_000}, decisions=20)
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
        (  # in the middle of the second episode, and with 0
            "decide, calls = outside.Wire.decide, []\n"
            "def exits(*call):\n"
            "    calls.append(call)\n"
            "    return sys.exit() if len(calls) == 30 else decide(*call)\n"
            "outside.Wire.decide = exits",
            "two episodes in a row with the same seed",
        ),
        (
            "receive = outside.Wire.receive\n"
            "def lenient(self):\n    answer = receive(self)\n"
            "    return {**answer, 'act': self.number} if 'act' in answer else answer\n"
            "outside.Wire.receive = lenient",
            "an answer with the number of another call",
        ),
        (
            "import os\n"
            "class Short:\n"
            "    def __init__(self, lines): self.lines = lines\n"
            "    def readline(self): return os.read(self.lines.fileno(), 4096).decode()\n"
            "init = outside.Wire.__init__\n"
            "def short(self):\n    init(self)\n    self.lines = Short(self.lines)\n"
            "outside.Wire.__init__ = short",
            "a line of 1 MiB",
        ),
        (
            "import time\n"
            "receive = outside.Wire.receive\n"
            "def waits(self):\n"
            "    try:\n        return receive(self)\n"
            "    except SystemExit:\n"
            "        if sys._getframe(1).f_code.co_name == 'play':\n            time.sleep(60)\n"
            "        raise\n"
            "outside.Wire.receive = waits",
            "the end of its input between episodes",
        ),
    ],
)
def test_what_is_wrong_is_found(tmp_path, change, tried):
    report = check_wire(changed(tmp_path, change), timeout=10.0)
    assert not report.ok
    assert found(report)[tried] == "wrong", str(report)


@pytest.mark.parametrize(
    "what",
    ["point, no text", "entity", "args", "time", "end", "removed point", "number text", "unknown frame"],
)
def test_frames_that_are_wrong_are_found(what):
    report = check_wire([sys.executable, faulty.__file__, "in mid-episode", what], timeout=10.0)
    assert found(report)["an episode by its own rule"] == "wrong", str(report)


def test_a_reseed_that_changes_nothing_is_noted(tmp_path):
    report = check_wire(changed(tmp_path, "outside.random.Random.seed = lambda *_: None"))
    assert found(report)["reseed"] == "note"


def test_the_command_line(capsys):
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
