"""Whatever a simulator does wrong is told as what it is, in time, and the next episode begins in a new process."""

import os
import signal
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from simenv_marl import RULE, aec_env, single_env
from simenv_marl.errors import (
    ProcessDiedError,
    ProcessError,
    ProcessTimeoutError,
    RemoteError,
    UnknownPointError,
    WireError,
    WrongThreadError,
)
from simenv_marl.remote.child import Child
from tests.outside.reservoirs import BOTH, INFLOW, PRICE, broken, by_its_rule, reservoirs
from tests.outside.test_process import all_told, child, ruled
from tests.processes import alone, descriptors, runs
from tests.worlds.faulty import AT_ONCE, FAULTS

IN_MID_EPISODE = {
    "garbage": (WireError, "not JSON"),
    "no object": (WireError, r"not a JSON object.*\[1\]"),
    "no utf-8": (WireError, "UnicodeDecodeError"),
    "deep": (WireError, "not JSON"),
    "nan": (WireError, "NaN is not in JSON"),
    "unknown frame": (WireError, "desire.*not a frame of the wire"),
    "number": (WireError, "call 7 where call 4 was due"),
    "number text": (WireError, "call '4' where call 4"),
    "point": (WireError, r"moon\.phase.*not in its hello"),
    "point, no text": (WireError, r"named the point \['a'\]"),
    "entity": (WireError, r"\['a'\] for reservoir\.inflow; an entity must be"),
    "args": (WireError, r"args .* not an object: \[1\]"),
    "time": (WireError, "the time 'now'"),
    "large time": (WireError, "the time 1000"),
    "removed point": (WireError, r"moon\.phase.*not in its hello"),
    "end": (WireError, "the end True"),
    "half a line": (ProcessDiedError, "closed its pipe in the middle of a line, and has exited with code 0"),
    "half a line, silent": (ProcessTimeoutError, "still runs; it has sent half a line for 2 s"),
    "drop by drop": (ProcessTimeoutError, "still runs; it has sent half a line for 2 s"),
    "silence": (ProcessTimeoutError, "still runs; it has sent nothing for 2 s"),
    "exit": (ProcessDiedError, "closed its pipe, and has exited with code 0"),
    "exit 3": (ProcessDiedError, "closed its pipe, and has exited with code 3"),
    "crash": (ProcessDiedError, "was killed by SIGABRT.*there are many words\na last word"),
    "kill": (ProcessDiedError, "was killed by SIGKILL"),
    "closed": (ProcessDiedError, "closed its pipe, and still runs"),
    "grandchild": (ProcessTimeoutError, "has exited with code 5; it has sent nothing"),
    "gigabyte": (WireError, "a line of more than 16,777,216 bytes"),
    "error": (RemoteError, "has raised Flood: a dam broke\ndam.cpp:12"),
    "error, no object": (WireError, "a dam broke.*not a frame of the wire"),
}

AT_ONCE_TOLD = {
    "no hello": (WireError, "began with .*decide.*, not with a hello"),
    "version 2": (WireError, "speaks version 2 of the wire; this is version 1"),
    "version true": (WireError, "speaks version True"),
    "points": (WireError, "must be lists of strings"),
    "other points": (UnknownPointError, r"no decision point .*; it has moon\.phase"),
    "silence": (ProcessTimeoutError, "sent nothing"),
    "exit": (ProcessDiedError, "exited with code 0"),
    "exit 3": (ProcessDiedError, "exited with code 3"),
    "garbage": (WireError, "Welcome to the simulator"),
    "error": (RemoteError, "has raised Drought: no water"),
    "no start": (WireError, "has sent .*decide.* before the start of an episode"),
    "error, no start": (RemoteError, "has raised Drought: no water"),
}


def test_all_faults_are_tested():
    assert (IN_MID_EPISODE.keys(), AT_ONCE_TOLD.keys()) == (FAULTS.keys(), AT_ONCE.keys())


def patience(what: str) -> float:
    """For how long to wait for a simulator, in seconds: not long where no more comes."""
    return 2.0 if what in ("silence", "drop by drop", "half a line, silent", "grandchild") else 20.0


@pytest.mark.parametrize("what", IN_MID_EPISODE)
def test_in_mid_episode(what):
    kind, text = IN_MID_EPISODE[what]
    simulation = broken("in mid-episode", what)
    env = aec_env(simulation, "reservoir.inflow")
    env.reset(seed=1)
    number = child(env)
    env.step(RULE)
    env.step(RULE)
    env.unwrapped.simulation._child.timeout = patience(what)
    with pytest.raises(kind, match=f"(?s){text}") as caught:
        env.step(RULE)
    assert "there are many words" in str(caught.value)
    assert isinstance(caught.value, ProcessError)
    assert not runs(number)
    env.reset(seed=1, options={"well": True})
    assert child(env) != number
    for _ in range(3):
        env.step(RULE)
    assert env.terminations == {"a": True}
    env.close()


@pytest.mark.parametrize("what", AT_ONCE_TOLD)
def test_at_once(what):
    kind, text = AT_ONCE_TOLD[what]
    env = aec_env(broken("at once", what, timeout=patience(what)), "reservoir.inflow")
    for _ in range(2):
        with pytest.raises(kind, match=f"(?s){text}"):
            env.reset(seed=1)
        left = env.unwrapped.simulation._child
        assert left is None or not left.usable
    env.close()


def test_a_command_that_leads_nowhere_is_told_with_the_reason():
    simulation = reservoirs()
    simulation.command = ["/nowhere/at/all"]
    with pytest.raises(ProcessDiedError, match=r"'/nowhere/at/all' cannot be started: FileNotFoundError"):
        aec_env(simulation).reset()
    simulation.command = [str(Path(__file__))]
    with pytest.raises(ProcessDiedError, match="PermissionError"):
        aec_env(simulation).reset()


def test_one_process_that_is_killed_leaves_the_others_alone():
    envs = [aec_env(reservoirs()) for _ in range(4)]
    for seed, env in enumerate(envs):
        env.reset(seed=seed)
        env.step(RULE)
    os.kill(child(envs[1]), signal.SIGKILL)
    with pytest.raises(ProcessDiedError, match="SIGKILL"):
        envs[1].step(RULE)
    for seed in (0, 2, 3):
        while envs[seed].agents:
            _, _, terminated, truncated, _ = envs[seed].last()
            envs[seed].step(None if terminated or truncated else RULE)
        assert envs[seed].unwrapped.simulation.result == by_its_rule(seed)
    all_told(envs[1], 1, ruled)
    assert envs[1].unwrapped.simulation.result == by_its_rule(1)
    for env in envs:
        env.close()


def test_a_process_that_was_killed_between_episodes_is_told_of():
    env = aec_env(reservoirs())
    all_told(env, 1, ruled)
    os.kill(child(env), signal.SIGKILL)
    with pytest.raises(ProcessDiedError, match="SIGKILL"):
        env.reset(seed=2)
    all_told(env, 2, ruled)
    assert env.unwrapped.simulation.result == by_its_rule(2)
    env.close()


def test_a_process_that_does_not_read_is_told_of():
    env = single_env(broken("in mid-episode", "silence", points={"reservoir.inflow": INFLOW}), agent="a")
    env.reset(seed=1)
    simulation = env.unwrapped.simulation
    simulation._child.timeout = 0.3
    os.kill(child(env), signal.SIGSTOP)
    with pytest.raises(ProcessTimeoutError, match="sent nothing and read nothing"):
        simulation._child.send(bytes(1 << 20))
    with pytest.raises(ProcessError):
        env.step(np.ones(1))
    env.close()


def test_what_is_long_crosses_in_both_directions():
    env = aec_env(reservoirs())
    env.reset(seed=1, options={"long": ["ö" * 1000] * 2000, "hours": 3})
    while env.agents:
        _, _, terminated, truncated, _ = env.last()
        env.step(None if terminated or truncated else RULE)
    assert env.unwrapped.simulation.result == by_its_rule(1, hours=3)
    with pytest.raises(WireError, match=r"the limit is 16,777,216"):
        env.reset(seed=1, options={"long": "o" * (16 << 20)})
    env.close()


def test_a_process_that_writes_much_on_its_standard_error_is_not_held_up():
    env = aec_env(reservoirs())
    env.reset(seed=1, options={"hours": 6, "words": 100_000})
    while env.agents:
        _, _, terminated, truncated, _ = env.last()
        env.step(None if terminated or truncated else RULE)
    assert env.unwrapped.simulation.result == by_its_rule(1, hours=6)
    env.close()


def test_words_without_end_do_not_put_off_the_limit(monkeypatch):
    monkeypatch.setattr(Child, "_read_stderr", lambda process: True)  # so that there is always more
    with pytest.raises(ProcessTimeoutError, match="sent nothing"):
        broken("at once", "silence", timeout=1.0).reset()


def test_a_fork_cannot_go_on_with_the_process_and_can_begin_anew():
    env = aec_env(reservoirs())
    env.reset(seed=1)
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            try:
                env.step(RULE)
            except WrongThreadError:
                all_told(env, 2, ruled)
                code = 0 if env.unwrapped.simulation.result == by_its_rule(2) else 2
                env.close()
        finally:
            os._exit(code)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
    all_told(env, 1, ruled)
    assert env.unwrapped.simulation.result == by_its_rule(1)
    env.close()


def test_an_error_in_a_mapping_breaks_the_episode_off_and_leaves_the_process():
    wrong = replace(PRICE, observation_space_mapping=lambda call: [call.total / 0])
    env = aec_env(reservoirs({**BOTH, "broker.price": wrong}))
    env.reset(seed=1)
    number = child(env)
    with pytest.raises(ZeroDivisionError):
        all_told(env, 1, ruled)
    env.reset(seed=1)
    assert child(env) == number
    env.close()


def test_descriptors_and_processes_are_given_back():
    alone(fail_many_times)


def fail_many_times() -> None:
    """End processes in all ways in which they fail, and look for what is left open."""
    before = descriptors()
    for what in ("exit 3", "garbage", "silence"):
        env = aec_env(broken("in mid-episode", what), "reservoir.inflow")
        env.reset(seed=1)
        env.step(RULE)
        env.step(RULE)
        env.unwrapped.simulation._child.timeout = 0.3
        with pytest.raises(ProcessError):
            env.step(RULE)
        env.close()
    for _ in range(3):
        with pytest.raises(ProcessDiedError):
            aec_env(broken("at once", "exit 3")).reset()
    assert descriptors() == before


def test_a_process_that_does_not_end_is_ended():
    env = aec_env(broken("in mid-episode", "silence"), "reservoir.inflow")
    env.reset(seed=1)
    number = child(env)
    os.kill(number, signal.SIGSTOP)
    env.close()
    assert not runs(number)


def test_an_end_that_follows_a_stop_is_not_the_next_episode():
    env = aec_env(broken("in mid-episode", "end after stop"), "reservoir.inflow")
    env.reset(seed=1)
    with pytest.raises(WireError, match=r"has sent .*end.* (after \"stop\"|before the start)"):
        env.reset(seed=2)
    env.reset(seed=2)
    env.close()


# -- interrupts, and what runs out ----------------------------------------------------------------

INTERRUPTS = """
import os, signal, sys, time
reading, writing = map(int, os.environ["SIMENV_MARL_FDS"].split(","))
if sys.argv[1] == "on close":
    os.write(writing, b'{"hello": 1, "points": ["reservoir.inflow", "broker.price"]}\\n')
    os.read(reading, 1000)
    os.write(writing, b'{"end": {}}\\n')
    os.read(reading, 1000)
open(sys.argv[2], "w").write(str(os.getpid()))
os.kill(os.getppid(), signal.SIGINT)
time.sleep(600)
"""


@pytest.mark.parametrize("when", ["before hello", "on close"])
def test_an_interrupt_ends_the_process(when, tmp_path):
    simulation = reservoirs()
    simulation.command = [sys.executable, "-c", INTERRUPTS, when, str(tmp_path / "number")]

    def begin_and_close():
        simulation.reset()
        simulation.close()

    with pytest.raises(KeyboardInterrupt) as caught:
        begin_and_close()
    assert not runs(int((tmp_path / "number").read_text()))
    assert caught.tb  # all that the traceback holds lives


def test_no_descriptor_is_left_where_there_are_no_more():
    alone(run_out_of_descriptors)


def run_out_of_descriptors() -> None:
    """Start a process that gets one of its two pipes, and look for what is left open."""
    before, pipes, pipe = descriptors(), [], os.pipe

    def scarce():
        if pipes:
            raise OSError("too many open files")
        pipes.append(1)
        return pipe()

    os.pipe = scarce  # type: ignore[assignment]
    with pytest.raises(ProcessDiedError, match="too many open files"):
        reservoirs().reset()
    assert descriptors() == before
