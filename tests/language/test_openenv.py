"""Agents' seats as OpenEnv environments: its own validation, its clients, many sessions at once."""

import os
import re
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest
from examples.greenhouse_coop.env import GreenhouseSim
from examples.queue_admission.env import QueueSimulation

from simenv_marl import single_env
from simenv_marl.seats import describe
from simenv_marl.testing.templates.simpy import MySimulation

pytest.importorskip("openenv")

import uvicorn
from openenv.core.generic_client import GenericEnvClient

from simenv_marl.seats.openenv import seat, serve

ROOT = Path(__file__).parents[2]
GREENHOUSE = "examples.greenhouse_coop.env:GreenhouseSim"
watering = partial(single_env, GreenhouseSim, agent="waterer_0")
queueing = partial(single_env, QueueSimulation, agent="admission_0")
painting = partial(single_env, MySimulation, agent="dispatcher_0")


def command(*arguments, **options):
    return subprocess.Popen(
        [sys.executable, "-m", "simenv_marl", "serve", *arguments],
        cwd=ROOT,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        **options,
    )


@contextmanager
def served(make):
    app = serve(make, name="greenhouse")
    server = uvicorn.Server(uvicorn.Config(app, port=0, log_level="error"))
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        time.sleep(0.01)
    try:
        yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    finally:
        server.should_exit = True
        thread.join()


def check(url):
    """Let OpenEnv's own command validate a server."""
    program = Path(sys.executable).with_name("openenv")
    done = subprocess.run(
        [program, "validate", "--url", url], capture_output=True, text=True, check=False
    )
    assert "Verdict: PASS" in done.stdout, done.stdout + done.stderr
    assert "FAIL" not in done.stdout


@pytest.mark.parametrize("make", [queueing, painting])
def test_openenv_server_of_an_agent_passes_openenvs_validation(make):
    with served(make) as url:
        check(url)


def test_openenv_command_serves_an_agent_until_an_interrupt():
    server = command(GREENHOUSE, "--seat", "waterer_0", "--port", "0")
    try:
        url = re.search(r"http://127\.0\.0\.1:\d+", server.stdout.readline())[0]
        check(url)
    finally:
        server.send_signal(signal.SIGINT)
        end, errors = server.communicate(timeout=30)
    assert (end, errors) == ("GreenhouseSim is no longer served\n", "")
    assert server.returncode == 0


def test_openenv_command_refuses_an_unknown_agent():
    server = command(GREENHOUSE, "--seat", "nobody", "--port", "0")
    said, errors = server.communicate(timeout=60)
    assert (server.returncode, said) == (2, "")
    assert "waterer_0" in errors


# -- one seat -------------------------------------------------------------------------------------


def test_openenv_server_gives_the_prompts_and_actions_of_the_env():
    kind = seat(painting, name="shop")
    assert kind.__name__ == "shop"
    answer = kind.action_class
    env, own = painting(), kind()
    env.reset(seed=4)
    seen = own.reset(seed=4, episode_id="one")
    assert (seen.prompt, seen.decision) == (describe(env), describe(env, as_json=True))
    assert (seen.reward, seen.done, seen.error) == (None, False, None)
    labels = seen.decision["actions"]["enum"]
    web = own.web_actions({**seen.model_dump(), "reward": None, "done": False})
    assert web == [(label, {"action": label}) for label in labels]

    wrong = own.step(answer(action="the blue one"))
    assert (wrong.prompt, wrong.decision, wrong.reward) == (seen.prompt, seen.decision, 0.0)
    assert "names no legal action" in wrong.error
    for say in (str, "I take {}".format, lambda label: 0):
        _, reward, *_ = env.step(0)
        seen = own.step(answer(action=say(labels[0])))
        assert (seen.prompt, seen.reward) == (describe(env), reward)
        labels = seen.decision["actions"]["enum"]
    assert (own.state.episode_id, own.state.step_count) == ("one", 3)
    while not seen.done:
        seen = own.step(answer(action=seen.decision["actions"]["enum"][0]))
    assert (seen.prompt, seen.decision) == ("", None)
    own.close()
    own.close()


def test_openenv_server_accepts_numbers_lists_and_dicts_as_box_actions():
    kind = seat(watering)
    rewards = []
    for said in (0.25, [0.25], {"share of 1000 litres": 0.25}, "0.25"):
        own = kind()
        own.reset(seed=1)
        rewards.append(own.step(kind.action_class(action=said)).reward)
        own.close()
    assert len(set(rewards)) == 1


def test_openenv_requests_without_a_session_leave_nothing_behind():
    own = seat(watering)()
    with ThreadPoolExecutor(1) as pool:
        pool.submit(own.reset, seed=1).result()
    own.close()  # in another thread, as OpenEnv does


# -- many sessions --------------------------------------------------------------------------------


def answers(number):
    return [{"action": (0.02 + 0.001 * (number + day) % 0.05)} for day in range(20)]


def play(client, number):
    client.reset(seed=number)
    return [(step.reward, step.observation) for step in map(client.step, answers(number))]


def play_in_session(url, number):
    with GenericEnvClient(base_url=url).sync() as client:
        return play(client, number)


def sockets():
    """Return the open sockets of this process."""
    files = [os.readlink(file.path) for file in os.scandir("/proc/self/fd") if file.is_symlink()]
    return [file for file in files if file.startswith("socket:")]


def test_openenv_64_concurrent_sessions_match_sequential_ones():
    before = sockets()
    with served(watering) as url:
        alone = [play_in_session(url, number) for number in range(64)]
        threads = threading.active_count()
        with ThreadPoolExecutor(64) as pool:
            together = list(pool.map(partial(play_in_session, url), range(64)))
        assert together == alone
        deadline = time.monotonic() + 10
        while threading.active_count() > threads and time.monotonic() < deadline:
            time.sleep(0.05)
        assert threading.active_count() <= threads
    assert sockets() == before
    env = watering()
    env.reset(seed=3)
    plain = [env.step([answer["action"]])[1] for answer in answers(3)]
    assert [reward for reward, _ in alone[3]] == plain
