"""A simulator's faults are reported precisely and in time; the next episode has a new process."""

import multiprocessing
import os
import select
import signal
import subprocess
import sys

import pytest

import simenv_marl.remote.child as child_module
from simenv_marl import RULE, aec_env, vector_env
from simenv_marl.errors import (
    ProcessDiedError,
    ProcessError,
    ProcessTimeoutError,
    RemoteError,
    WireError,
    WrongThreadError,
)
from simenv_marl.remote import ProcessSimulation, guardian
from simenv_marl.remote.child import DESCRIPTORS, GRACE, STDERR_TAIL, Child
from tests.outside.reservoirs import (
    BOTH,
    PRICE,
    broken,
    by_its_rule,
    child,
    plays_by_its_rule,
    reservoirs,
)
from tests.processes import alone, descriptors, gone, runs
from tests.worlds.models import begun, play

pytestmark = pytest.mark.greenlet("errors of any kind are tested with every driver in the contract")

IN_MID_EPISODE = {
    "garbage": (WireError, "not JSON"),
    "half a line": (
        ProcessDiedError,
        "closed its pipe in the middle of a line, and has exited with code 0",
    ),
    "drop by drop": (ProcessTimeoutError, "still runs; it has sent half a line for 2 s"),
    "silence": (ProcessTimeoutError, "still runs; it has sent nothing for 2 s"),
    "exit": (ProcessDiedError, "closed its pipe, and has exited with code 3"),
    "crash": (ProcessDiedError, "was killed by SIGABRT.*there are many words\na last word"),
    "closed": (ProcessDiedError, "closed its pipe, and still runs"),
    "grandchild": (ProcessTimeoutError, "has exited with code 5; it has sent nothing"),
    "updates": (
        WireError,
        "has sent 100,001 frames since its latest call, and neither a call nor an end",
    ),
    "slow updates": (
        ProcessTimeoutError,
        "has sent updates and removals for 4 s, and neither a call nor an end",
    ),
    "gigabyte": (WireError, "a line of more than 16,777,216 bytes"),
    "error": (RemoteError, "has raised Flood: a dam broke\ndam.cpp:12"),
}


def patience(what):
    """For how long to wait for a simulator, in seconds: not long where no more comes."""
    if what == "slow updates":
        return 0.2
    return 2.0 if what in ("silence", "drop by drop", "grandchild") else 20.0


def before_its_fault(what, make_env=lambda kind, *arguments: kind(*arguments)):
    """An environment whose simulator is about to do something wrong in mid-episode."""
    env = begun(make_env(aec_env, broken(what), "reservoir.inflow"), 1)
    env.step(RULE)
    env.step(RULE)
    return env


@pytest.mark.thorough
@pytest.mark.parametrize("what", IN_MID_EPISODE)
def test_process_simulation_raises_an_error_for_each_fault_in_mid_episode(make_env, what):
    kind, text = IN_MID_EPISODE[what]
    env = before_its_fault(what, make_env)
    number = child(env)
    env.simulation._child.timeout = patience(what)
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


@pytest.mark.parametrize(
    ("command", "text"),
    [
        (["sh", "-c", "exit 3"], "exited with code 3"),
        (["/nowhere/at/all"], "'/nowhere/at/all' cannot be started: FileNotFoundError"),
        ([__file__], "PermissionError"),
        ("", "cannot be started"),
    ],
)
def test_process_simulation_error_tells_why_its_command_does_not_start(command, text):
    simulation = ProcessSimulation(command, BOTH)
    for _ in range(2):
        with pytest.raises(ProcessDiedError, match=text):
            simulation.reset()
        assert simulation._child is None


@pytest.mark.parametrize("when", ["waiting", "between episodes"])
def test_process_simulation_killed_does_not_affect_other_processes(make_env, when):
    envs = [make_env(aec_env, reservoirs()) for _ in range(3)]
    for env in envs:
        env.reset(seed=1)
        if when == "between episodes":
            play(env, reset=False)
    os.kill(child(envs[1]), signal.SIGKILL)
    with pytest.raises(ProcessDiedError, match="SIGKILL"):
        envs[1].step(RULE) if when == "waiting" else envs[1].reset(seed=2)
    numbers = [child(env) for env in envs]
    for seed, env in enumerate(envs):
        assert plays_by_its_rule(env, seed)
    assert [number == child(env) for number, env in zip(numbers, envs, strict=True)] == [
        True,
        False,
        True,
    ]


def test_process_simulation_raises_an_error_if_the_process_does_not_read(make_env):
    env = before_its_fault("silence", make_env)
    simulation = env.simulation
    simulation._child.timeout = 0.3
    os.kill(child(env), signal.SIGSTOP)
    with pytest.raises(ProcessTimeoutError, match="sent nothing and read nothing"):
        simulation._child.send(bytes(1 << 20))
    with pytest.raises(ProcessError):
        env.step(RULE)


def test_process_simulation_sends_and_receives_long_lines(make_env):
    env = make_env(aec_env, reservoirs())
    assert plays_by_its_rule(env, long=["ö" * 1000] * 2000, hours=3)
    with pytest.raises(WireError, match=r"the limit is 16,777,216"):
        env.reset(seed=1, options={"long": "o" * (16 << 20)})
    assert plays_by_its_rule(env, hours=6, words=100_000)  # on its standard error
    os.kill(child(env), signal.SIGKILL)
    with pytest.raises(ProcessDiedError) as caught:
        env.reset()
    assert len(str(caught.value)) < 2 * STDERR_TAIL


TALKS = f"""
import os, time
reading, writing = map(int, os.environ["{DESCRIPTORS}"].split(","))
os.write(writing, b'{{"hello": 1, "points": ["a"]}}\\nno frame\\n')
os.read(reading, 1)
os.write(2, b"broken")
time.sleep(600)
"""


def test_process_simulation_error_quotes_the_end_of_stderr():
    process = Child([sys.executable, "-c", TALKS], 60.0)
    process.send(b"\n")
    assert select.select([process._stderr], [], [], 60.0)[0]
    with pytest.raises(WireError, match=r"no frame(?s:.*)broken"):
        process.receive()


def test_process_simulation_timeout_works_despite_endless_stderr(monkeypatch):
    monkeypatch.setattr(Child, "_read_stderr", lambda process: True)  # so that there is always more
    with pytest.raises(ProcessTimeoutError, match="sent nothing"):
        ProcessSimulation(["sleep", "600"], BOTH, timeout=1.0).reset()


def in_a_fork(check):
    """Call a function that asserts something in a fork of this process."""
    process = multiprocessing.get_context("fork").Process(target=check)
    process.start()
    process.join()
    assert process.exitcode == 0


def test_process_simulation_in_a_fork_can_only_reset(make_env):
    env = begun(make_env(aec_env, reservoirs()), 1)
    number = child(env)

    def closes():
        env.simulation._child.close()
        env.close()

    def begins_anew():
        with pytest.raises(WrongThreadError):
            env.step(RULE)
        assert plays_by_its_rule(env, 2)
        env.close()
        with pytest.raises(ChildProcessError):
            os.waitpid(-1, os.WNOHANG)  # nothing is left that would guard processes

    in_a_fork(closes)
    in_a_fork(begins_anew)
    assert runs(number)
    play(env, reset=False)
    assert env.simulation.result == by_its_rule(1)


def test_process_simulation_releases_descriptors_and_processes():
    alone(fail_many_times)


def test_process_simulation_closes_its_pipe_if_the_second_one_fails(monkeypatch):
    pipes = [os.pipe()]

    def pipe():
        if not pipes:
            raise OSError(24, "Too many open files")
        return pipes.pop()

    monkeypatch.setattr("simenv_marl.remote.child.os.pipe", pipe)
    (ends,) = pipes
    with pytest.raises(OSError, match="Too many open files"):
        ProcessSimulation("true", BOTH).reset()
    monkeypatch.undo()
    for end in ends:
        with pytest.raises(OSError, match="Bad file descriptor"):
            os.fstat(end)


def fail_many_times():
    """End processes in all ways in which they fail, and look for what is left open."""
    before = descriptors()
    for what in ("exit", "garbage", "silence"):
        env = before_its_fault(what)
        env.simulation._child.timeout = 0.3
        os.kill(guardian._shell.pid, signal.SIGSTOP)
        with pytest.raises(ProcessError):
            env.step(RULE)
        env.close()
    for _ in range(3):
        for command in ("false", "/nowhere"):
            with pytest.raises(ProcessDiedError):
                ProcessSimulation(command, BOTH).reset()
    assert descriptors() == before


def test_process_simulation_killed_with_a_lost_exit_code_raises_an_error():
    alone(ignore_children)


def ignore_children():
    """Kill a process whose exit code the system does not keep."""
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    env = begun(aec_env(reservoirs(), "reservoir.inflow"), 1)
    number = child(env)
    play(env, reset=False)
    os.kill(number, signal.SIGKILL)
    with pytest.raises(
        ProcessDiedError, match="its exit code is lost, because this process ignores SIGCHLD"
    ):
        env.reset(seed=2)
    env.reset(seed=2)
    assert child(env) != number
    env.close()


BUSY = """
import json, os, subprocess, sys
_, writing = map(int, os.environ["SIMENV_MARL_FDS"].split(","))
descendant = subprocess.Popen([sys.executable, "-c", "while True: pass"])
hello = {"hello": 1, "points": [], "descendant": descendant.pid}
os.write(writing, json.dumps(hello).encode() + b"\\n")
while True:
    pass
"""


def test_process_simulation_busy_process_ends_when_its_parent_is_killed():
    parent = f"""
import signal, threading
from simenv_marl.remote.child import Child
children = []
command = {[sys.executable, "-c", BUSY]}
thread = threading.Thread(target=lambda: children.append(Child(command, 60.0)))
thread.start()
thread.join()
print(children[0].pid, children[0].hello["descendant"], flush=True)
signal.pause()
"""
    with subprocess.Popen([sys.executable, "-c", parent], stdout=subprocess.PIPE) as process:
        numbers = [int(word) for word in process.stdout.readline().split()]
        assert len(numbers) == 2
        assert all(map(runs, numbers))
        process.kill()
    assert all(map(gone, numbers))


def test_process_simulations_that_hang_are_ended_in_one_grace_period(monkeypatch):
    clock = [0.0]
    env = begun(vector_env(reservoirs({"broker.price": PRICE}), "broker.price", num_envs=5), 1)
    numbers = [simulation._child.pid for simulation in env.get_attr("simulation")]
    for number in numbers:
        os.kill(number, signal.SIGSTOP)
    monkeypatch.setattr(child_module, "monotonic", lambda: clock[0])
    monkeypatch.setattr(child_module, "sleep", lambda seconds: clock.append(clock.pop() + seconds))
    env.close()
    assert not any(map(runs, numbers))
    assert clock[0] < 1.5 * GRACE


def test_process_simulation_ignores_an_end_frame_after_a_stop(make_env):
    for arrived, text in ((False, '(after "stop"|before the start)'), (True, "before the start")):
        env = before_its_fault("end after stop", make_env)
        if arrived:
            process = env.simulation._child
            process.break_off()
            select.select([process._reading], [], [])
        with pytest.raises(WireError, match=f"has sent .*end.* {text}"):
            env.reset(seed=2)
        env.reset(seed=2)


def test_process_simulation_keyboard_interrupt_ends_the_process(tmp_path):
    script = 'echo $$ > "$0"; sleep 0.5; kill -INT $PPID; sleep 600'
    simulation = ProcessSimulation(["sh", "-c", script, str(tmp_path / "number")], BOTH)
    with pytest.raises(KeyboardInterrupt) as caught:
        simulation.reset()
    assert not runs(int((tmp_path / "number").read_text()))
    assert caught.tb  # all that the traceback holds lives
