"""Workers that die are replaced: their episodes end truncated, and the others do not notice."""

import ctypes
import faulthandler
import gc
import multiprocessing
import os
import signal
import time
import warnings
from collections import deque
from itertools import repeat
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from simenv_marl import vector_env
from simenv_marl.errors import OptionValueError, WorkerError
from simenv_marl.many import restarts
from tests.processes import alone, descriptors
from tests.worlds.models import BY_DRIVER
from tests.worlds.vectors import (
    FORK,
    FORKS,
    MODES,
    POINT,
    VARIETY,
    Counter,
    definition,
    legal_actions,
    same,
)

pytestmark = [
    pytest.mark.usefixtures("no_workers_left"),
    FORKS,
    pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="there is no SIGKILL"),
]

ONES = np.ones(4, np.int64)
ENDS = {
    "killed": lambda: os.kill(os.getpid(), 9),
    "exited": lambda: os._exit(7),
    "segmentation fault": lambda: (faulthandler.disable(), ctypes.string_at(0)),
}


class Mortal(Counter):
    """Counts; the process of a seed ends at a count, and at 0 in the reset."""

    ends = MappingProxyType({})

    def reset(self, seed=None, options=None):
        super().reset(seed, options)
        self.process = os.getpid()
        self.end_if_due()

    def decide(self):
        return 1

    def run(self):
        while self.count < self.goal:
            self.count += self.decide()
            self.end_if_due()

    def end_if_due(self):
        self.ends.get((self.seed, self.count), bool)()


def mortal(ends):
    return type("Doomed", (Mortal,), {"ends": ends})


MORTAL = {f"{__name__}.Mortal.decide": definition()}


def restarting(model=Mortal, points=None, **options):
    options = {"num_envs": 4, "workers": 2, "context": FORK, "restart": True, **options}
    return vector_env(model, points or MORTAL, **options)


def once(path, end):
    """End the process at the first call only."""

    def call():
        try:
            Path(path).touch(exist_ok=False)
        except FileExistsError:
            return
        end()

    return call


def play(envs, steps):
    """Step with ones; where episodes are not reset by themselves, reset those that are over."""
    log = [(*envs.reset(seed=0), *np.zeros((3, 4)))]
    for _ in range(steps):
        observations, rewards, terminations, truncations, infos = envs.step(ONES)
        log.append((observations, infos, rewards, terminations, truncations))
        over = terminations | truncations
        if envs.metadata["autoreset_mode"] == AutoresetMode.DISABLED and over.any():
            envs.reset(options={"reset_mask": over})
    return log


def own(step, places):
    """The observations, rewards and flags of some simulations."""
    observations, _, *columns = step
    return [observations[places], *(column[places] for column in columns)]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("end", ENDS)
def test_vector_env_truncates_the_episodes_of_a_dead_worker(mode, end):
    with warnings.catch_warnings(action="error"):
        unharmed = play(restarting(autoreset_mode=mode), 30)
    envs = restarting(mortal({(3, 2): ENDS[end]}), autoreset_mode=mode)
    with pytest.warns(UserWarning, match="worker 1 .* died with exit code .*; restart 1") as told:
        log = play(envs, 30)
    assert len(told) == 1
    assert envs.restarts == 1
    for step, other in zip(log, unharmed, strict=True):
        assert same(own(step, slice(2)), own(other, slice(2)))
    observations, infos, rewards, terminations, truncations = log[2]
    assert rewards[2:].tolist() == [0.0, 0.0]
    assert terminations.tolist() == [False] * 4
    assert truncations.tolist() == [False, False, True, True]
    last = observations
    if mode == AutoresetMode.SAME_STEP:
        assert observations[2:, 0].tolist() == [0, 0]
        last, infos = infos["final_obs"], infos["final_info"]
    assert same(np.stack(last[2:]), log[1][0][2:])
    assert infos["lost"].tolist() == infos["_lost"].tolist() == [False, False, True, True]
    assert infos["lost_why"].shape == (4,)
    assert "worker 1" in infos["lost_why"][3]
    assert infos["lost_why"][0] is None
    seeds = [model.seed for model in envs.get_attr("simulation")]
    again = restarting(mortal({(3, 2): ENDS[end]}), autoreset_mode=mode)
    with pytest.warns(UserWarning, match="restart 1"):
        assert same(play(again, 30), log)
    assert [model.seed for model in again.get_attr("simulation")] == seeds
    assert len(set(seeds)) == 4


def use_and_step(envs, use, actions):
    if use == "call":
        assert len(envs.call("driver")) == 4
    elif use == "set_attr":
        envs.set_attr("mark", [1, 2, 3, 4])
        assert envs.get_attr("mark") == (1, 2, 3, 4)
    elif use == "reset":
        envs.reset(seed=8)
        assert [model.seed for model in envs.get_attr("simulation")] == [8, 9, 10, 11]
    elif use == "partial reset":
        envs.reset(seed=8, options={"reset_mask": np.array([True, False, True, False])})
    return envs.step(actions)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["nested", "masked", "dict action", "goal"])
@pytest.mark.parametrize("use", ["step", "call", "set_attr", "reset", "partial reset"])
@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.DISABLED])
def test_vector_env_replaces_a_worker_killed_between_steps(kind, use, mode):
    model, decision = VARIETY[kind]
    others = set(multiprocessing.active_children())  # of other tests
    envs = restarting(model, {POINT: decision}, autoreset_mode=mode)
    envs.reset(seed=8)
    actions = legal_actions(envs, {}, np.random.default_rng(0)) if kind != "masked" else ONES
    victim = (set(multiprocessing.active_children()) - others).pop()
    os.kill(victim.pid, signal.SIGKILL)
    victim.join()
    with pytest.warns(UserWarning, match="exit code -9"):
        *_, truncations, infos = use_and_step(envs, use, actions)
    if use == "reset":
        assert not truncations.any()
        return
    assert sorted([truncations[:2].all(), truncations[2:].all()]) == [False, True]
    infos = infos["final_info"] if mode == AutoresetMode.SAME_STEP else infos
    assert infos["lost"].tolist() == truncations.tolist()
    if mode == AutoresetMode.DISABLED:
        for place in np.flatnonzero(truncations):  # one by one
            envs.reset(options={"reset_mask": np.arange(4) == place})
    assert not envs.step(actions)[3].any()


def test_vector_env_repeats_a_reset_in_which_a_worker_dies_with_its_seed(tmp_path):
    unharmed = play(restarting(), 5)
    for number, ends in enumerate([{(2, 0)}, {(0, 0), (2, 0), (3, 0)}]):
        envs = restarting(
            mortal({end: once(tmp_path / f"{number} {end}", ENDS["exited"]) for end in ends})
        )
        with pytest.warns(UserWarning, match="exit code 7"):
            assert same(play(envs, 5), unharmed)
        assert envs.restarts == len(ends)


def test_vector_env_begins_an_episode_anew_if_its_worker_dies_in_autoreset(tmp_path):
    """Another simulation of the worker ends in that step, and begins; the dead one is truncated."""
    reset = once(tmp_path / "reset", ENDS["killed"])

    class Dies(Mortal):
        def reset(self, seed=None, options=None):
            super().reset(seed, options)
            if seed not in range(4):
                reset()

    envs = restarting(Dies, num_envs=2, workers=1)
    observations, _ = envs.reset(seed=0)
    first, second = observations[:, 1].astype(int)
    assert first != second
    both = np.ones(2, int)
    for _ in range(min(first, second)):
        envs.step(both)
    with pytest.warns(UserWarning, match="exit code -9"):
        observations, rewards, _, truncations, infos = envs.step(both)
    assert truncations.tolist() == [second < first, first < second]
    assert infos["lost"].tolist() == truncations.tolist()
    assert observations[int(second < first), 0] == 0
    assert rewards.tolist() == [0.0, 0.0]


def play_again_and_again(envs):
    for _ in range(3):
        envs.reset(seed=0)
        envs.step(ONES)


@pytest.mark.parametrize("when", [0, 1])
def test_vector_env_raises_an_error_after_more_worker_deaths_than_allowed(when, monkeypatch):
    envs = restarting(mortal({(3, when): ENDS["exited"]}), most_restarts=2)
    with (
        warnings.catch_warnings(action="ignore"),
        pytest.raises(WorkerError, match=r"3 workers were lost within an hour.*most_restarts=2"),
    ):
        play_again_and_again(envs)
    assert envs.restarts == 2
    with pytest.raises(WorkerError, match="is dead"):
        envs.call("driver")
    envs.reset(seed=10)
    assert not envs.step(ONES)[3].any()
    if when:
        monkeypatch.setattr(restarts, "HOUR", 0.0)  # the others are longer ago
        envs.reset(seed=0)
        with pytest.warns(UserWarning, match="restart 1 "):
            envs.step(ONES)


def test_vector_env_raises_a_model_error_even_if_another_worker_dies():
    ends = {(0, 1): lambda: 1 / 0, (3, 1): ENDS["killed"]}
    envs = restarting(mortal(ends))
    envs.reset(seed=0)
    with pytest.warns(UserWarning, match="worker 1"), pytest.raises(ZeroDivisionError):
        envs.step(ONES)
    envs.reset(seed=10)
    assert not envs.step(ONES)[3].any()


def loop(seconds=60):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        pass


def loop_in_c():
    deque(repeat(1), maxlen=0)  # looks for no signals


@pytest.mark.parametrize(("hang", "why"), [(loop, "in loop\n"), (loop_in_c, "exit code 1")])
@BY_DRIVER
def test_vector_env_replaces_a_worker_that_takes_too_long_for_a_step(
    hang, why, driver, monkeypatch
):
    monkeypatch.setattr("simenv_marl.envs.vector_batch.SECONDS_TO_UNWIND", 0.3)
    unharmed = play(restarting(), 3)
    envs = restarting(mortal({(3, 2): hang}), step_timeout=0.3, driver=driver)
    begun = time.monotonic()
    with pytest.warns(UserWarning, match="restart 1"):
        log = play(envs, 3)
    assert time.monotonic() - begun < 5
    for step, other in zip(log, unharmed, strict=True):
        assert same(own(step, slice(2)), own(other, slice(2)))
    infos = log[2][1]
    assert infos["lost"].tolist() == [False, False, True, True]
    assert why in infos["lost_why"][3]


def test_vector_env_step_timeout_does_not_apply_to_autoresets(monkeypatch):
    monkeypatch.setattr("simenv_marl.envs.vector_batch.SECONDS_TO_UNWIND", 0.1)

    class Slow(Mortal):
        def reset(self, seed=None, options=None):
            super().reset(seed, options)
            if seed not in range(4):
                loop(0.5)

    for mode in (AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP):
        envs = restarting(Slow, step_timeout=0.2, autoreset_mode=mode)
        with warnings.catch_warnings(action="error"):
            play(envs, 12)


def test_vector_env_refuses_restarts_without_workers():
    with pytest.raises(OptionValueError, match="needs workers="):
        restarting(workers=0)
    with pytest.raises(OptionValueError, match="most_restarts"):
        restarting(most_restarts=-1)


@pytest.mark.thorough
@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="descriptors are not told of")
@pytest.mark.parametrize("context", [FORK, "spawn"])
def test_vector_env_close_leaves_no_process_and_no_file_descriptor(context):
    alone(restart_often, context)


def restart_often(context):
    warnings.simplefilter("ignore")

    def run():
        envs = restarting(context=context)
        envs.reset(seed=0)
        for _ in range(3):
            os.kill(envs.get_attr("simulation")[0].process, signal.SIGKILL)
            envs.step(ONES)
            envs.step(ONES)
        assert envs.restarts == 3
        assert len(multiprocessing.active_children()) == 2
        envs.close()
        gc.collect()
        return descriptors()

    assert run() == run()
    assert multiprocessing.active_children() == []
