"""Simulations in several processes give the results of one process, and leave nothing behind."""

import gc
import multiprocessing
import os
import pickle
import signal
import threading
import time
from functools import partial

import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv

from simenv_marl import single_env, vector_env
from simenv_marl.errors import EpisodeOverError, OptionValueError, RewardError, WorkerError
from tests.envs.test_vector import begun
from tests.extent import DRIVERS
from tests.processes import alone, descriptors, gone, python
from tests.worlds.models import fails, notes
from tests.worlds.vectors import FORK, FORKS, MODES, POINT, VARIETY, Counter, agree, definition

pytestmark = [FORKS, pytest.mark.usefixtures("no_workers_left")]


def workers(model=Counter, decision=None, **options):
    options = {"num_envs": 4, "workers": 2, "context": FORK, **options}
    return vector_env(model, {POINT: decision or definition()}, **options)


class Failing(Counter):
    """Counts for ever; calls its reset's option for its seed after decisions and in unwinding."""

    def __init__(self):
        self.process = os.getpid()

    def run(self):
        try:
            while True:
                self.count += self.decide()
                self.call("decided")
        finally:
            self.call("unwinding")

    def call(self, when):
        happens = (self.options or {}).get(when, {})
        if self.seed in happens:
            happens[self.seed]()


ONES = np.ones(4, np.int64)
KILLED = pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="there is no SIGKILL")


def goes_on(envs, seed=0):
    envs.reset(seed=seed)
    assert [simulation.seed for simulation in envs.get_attr("simulation")] == [
        seed + place for place in range(4)
    ]
    assert envs.step(ONES)[0][:, 0].tolist() == [1, 1, 1, 1]


@pytest.mark.thorough
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    ("kind", "context"), [("masked", "spawn"), ("box", FORK), ("image", FORK), ("goal", FORK)]
)
def test_vector_env_with_workers_matches_gymnasiums_async_vector_env(kind, context, mode):
    model, decision = VARIETY[kind]
    makers = [partial(single_env, model, {POINT: decision}, driver=driver) for driver in DRIVERS]
    ours = vector_env(model, {POINT: decision}, num_envs=len(makers), autoreset_mode=mode)
    theirs = AsyncVectorEnv(makers, autoreset_mode=mode, context=context)
    agree(ours, theirs, 25, np.random.default_rng(1))
    assert ours.get_attr("np_random_seed") == theirs.get_attr("np_random_seed")
    theirs.close()


def processes_of(envs):
    return [simulation.process for simulation in envs.get_attr("simulation")]


def test_vector_env_workers_share_simulations_evenly():
    for number, asked, sizes in ((5, 3, [1, 2, 2]), (2, 5, [1, 1])):
        there = processes_of(workers(Failing, num_envs=number, workers=asked))
        assert sorted(map(there.count, set(there))) == sizes
        assert os.getpid() not in there


@pytest.mark.thorough
@pytest.mark.parametrize("context", multiprocessing.get_all_start_methods())
def test_vector_env_workers_get_models_and_mappings_defined_in_functions(context):
    class Local(Counter):
        decide = definition(reward_mapping=lambda self: float(self.seed + self.count))(
            lambda self: 0
        )

    envs = vector_env(Local, Local.decide, num_envs=3, workers=2, context=context)
    assert envs.reset(seed=4)[0][:, 0].tolist() == [0, 0, 0]
    observations, rewards, *_ = envs.step([1, 2, 3])
    assert observations[:, 0].tolist() == [1, 2, 3]
    assert rewards.tolist() == [5.0, 7.0, 9.0]


def test_vector_env_with_workers_refuses_objects_that_cannot_be_pickled():
    lock = threading.Lock()
    with pytest.raises(OptionValueError, match="cannot be sent to another process"):
        vector_env(lambda: (lock, Counter())[1], {POINT: definition()}, num_envs=2, workers=1)


def test_vector_env_worker_error_names_its_sub_environment():
    envs = workers(
        Failing,
        definition(
            reward_mapping=lambda self: float("nan") if self.options == {"poor": self.seed} else 0.0
        ),
    )
    envs.reset(seed=0, options={"poor": 2})
    with fails(RewardError, "sub-environment 2", "seed 2", match="not finite"):
        envs.step(ONES)
    with pytest.raises(EpisodeOverError, match="begin the next ones"):
        envs.step(ONES)
    with pytest.raises(EpisodeOverError, match="without a reset_mask"):
        envs.reset(options={"reset_mask": np.array([0, 0, 1, 0], bool)})
    goes_on(envs)


@KILLED
@pytest.mark.parametrize("code", [-9, 7, 1])
def test_vector_env_replaces_a_dead_worker_at_the_next_reset(code):
    envs = workers(Failing)
    end = (lambda: os.kill(os.getpid(), 9)) if code == -9 else (lambda: os._exit(code))
    envs.reset(seed=0, options={"decided": {3: end}})
    with pytest.raises(
        WorkerError, match=f"worker 1 .*2 to 3.* died with exit code {code}"
    ) as caught:
        envs.step(ONES)
    # with which an error in a script ends it
    assert ("__main__" in str(caught.value)) == (code == 1)
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)
    with pytest.raises(EpisodeOverError, match="begin the next ones"):
        envs.step(ONES)
    with pytest.raises(WorkerError, match="is dead"):
        envs.call("simulation")
    goes_on(envs)


@KILLED
@pytest.mark.parametrize("use", ["step", "call", "close"])
def test_vector_env_notices_workers_killed_between_steps(use):
    envs = begun(workers(Failing))
    there = set(processes_of(envs)) if use != "call" else processes_of(envs)[:1]
    for process in there:
        os.kill(process, signal.SIGKILL)
    if use != "close":
        dead = "0" if use == "call" else "[01]"  # either may be noticed first
        with pytest.raises(WorkerError, match=rf"worker {dead} .* exit code -9"):
            envs.step(ONES) if use == "step" else envs.call("simulation")
        for method in (envs.step, lambda ones: envs.reset(options={"reset_mask": ones > 0})):
            with pytest.raises(EpisodeOverError, match="an error has ended the episodes"):
                method(np.array([0, 0, 0, 1]) if method != envs.step else ONES)
        goes_on(envs)
    envs.close()
    assert envs.closed


def test_vector_env_close_raises_errors_and_ends_its_workers():
    envs = workers(Failing, context=multiprocessing.get_context(FORK))
    envs.reset(
        seed=0, options={"unwinding": dict.fromkeys(range(4), lambda: {}["it would not go"])}
    )
    with pytest.raises(KeyError, match="it would not go"):
        envs.close()
    assert envs.closed


def test_vector_env_second_close_ends_workers_after_an_interrupted_close(monkeypatch):
    envs = begun(workers(Failing))
    there = processes_of(envs)

    def interrupt(*_):
        monkeypatch.undo()
        raise KeyboardInterrupt

    monkeypatch.setattr(multiprocessing.process.BaseProcess, "join", interrupt)
    with pytest.raises(KeyboardInterrupt):
        envs.close()
    assert not envs.closed
    envs.close()
    assert envs.closed
    assert all(map(gone, there))


def test_vector_env_workers_end_when_the_env_is_dropped(tmp_path):
    def finish(path):
        time.sleep(0.3)
        path.touch()

    envs = workers(Failing)
    envs.reset(
        seed=0,
        options={"unwinding": {seed: partial(finish, tmp_path / str(seed)) for seed in range(4)}},
    )
    there = set(processes_of(envs))
    del envs
    gc.collect()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0", "1", "2", "3"]
    assert all(map(gone, there))


def test_vector_env_with_workers_closes_even_if_a_simulation_hangs(monkeypatch):
    monkeypatch.setattr("simenv_marl.many.parallel.SECONDS_TO_CLOSE", 0.5)
    envs = workers(Failing)
    envs.reset(seed=0, options={"unwinding": {0: partial(time.sleep, 60)}})
    with pytest.warns(ResourceWarning, match="did not close"):
        envs.close()
    assert envs.closed


@pytest.mark.skipif(not hasattr(signal, "SIGALRM"), reason="there is no SIGALRM")
def test_vector_env_workers_work_after_an_interrupted_step():
    home = os.getpid()

    def interrupt(*_):
        raise KeyboardInterrupt

    def alarm():
        time.sleep(0.1)
        os.kill(home, signal.SIGALRM)
        time.sleep(0.3)

    envs = workers(Failing)
    envs.reset(seed=0, options={"decided": {0: alarm}})
    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        with pytest.raises(KeyboardInterrupt):
            envs.step(ONES)
    finally:
        signal.signal(signal.SIGALRM, before)
    with pytest.raises(EpisodeOverError, match="begin the next ones"):
        envs.step(ONES)
    goes_on(envs, 7)


SCRIPT = """
import os
from simenv_marl import vector_env
from tests.worlds.vectors import Counter

class Model(Counter):
    def run(self):
        try:
            super().run()
        finally:
            print("unwound", flush=True)

if __name__ == "__main__":
    envs = vector_env(Model, Counter.decide, num_envs=2, workers=2, context={context!r})
    envs.reset(seed=0)
    print(envs.step([1, 2])[0][:, 0].tolist(), flush=True)
    {end}
"""


@pytest.mark.thorough
@pytest.mark.parametrize("context", ["spawn", FORK])
@pytest.mark.parametrize(
    ("end", "status"),
    [("", 0), ("raise KeyboardInterrupt", -2), ("os.kill(os.getpid(), 9)", -9)],
)
def test_vector_env_workers_end_with_the_python_process(context, end, status, tmp_path):
    strict = ["-W", "error", "-W", "ignore:This process:DeprecationWarning", "-X", "dev"]
    path = tmp_path / "script.py"
    path.write_text(SCRIPT.format(context=context, end=end), encoding="utf-8")
    # The output ends when the last worker does.
    done = python(*strict, path, status=status)
    assert done.stdout.splitlines()[0] == "[1.0, 2.0]"
    assert done.stdout.count("unwound") == 2
    assert end or done.stderr == ""
    assert "leaked" not in done.stderr


@pytest.mark.skipif(FORK != "fork", reason="there is no fork")
def test_vector_env_workers_belong_to_the_process_that_started_them():
    envs = begun(workers())
    child = os.fork()
    if child == 0:
        code = 1
        try:
            envs.step(ONES)
        except WorkerError:
            code = 0
        finally:
            del envs
            gc.collect()
            os._exit(code)
    assert os.waitpid(child, 0)[1] == 0
    assert envs.step(ONES)[0][:, 0].tolist() == [1, 1, 1, 1]


@pytest.mark.thorough
@pytest.mark.parametrize("error", ["OSError", "ZeroDivisionError", "WorkerError"])
@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="descriptors are not told of")
def test_vector_env_worker_that_fails_to_start_leaves_no_descriptors(error):
    alone(start_in_vain, error)


def start_in_vain(error):
    context, home = multiprocessing.get_context(FORK), os.getpid()
    start, started = context.Process.start, []

    def start_once(process):
        if started:
            raise OSError("no more")
        started.append(process)
        start(process)

    def model():
        if os.getpid() == home:
            return Counter()
        return os._exit(3) if error == "WorkerError" else 1 / 0

    workers().close()  # multiprocessing keeps its shared memory for the next time
    gc.collect()
    before = descriptors()
    if error == "OSError":
        context.Process.start = start_once
    with pytest.raises(Exception) as raised:
        workers(model, context=context)
    assert raised.typename == error
    assert error != "ZeroDivisionError" or "worker 0" in notes(raised.value)
    assert descriptors() == before  # even while the error is kept


@pytest.mark.thorough
def test_vector_env_with_workers_names_a_scripts_missing_main_guard(tmp_path):
    text = SCRIPT.format(context="spawn", end="").replace('if __name__ == "__main__":', "if True:")
    (tmp_path / "script.py").write_text(text, encoding="utf-8")
    last = python(tmp_path / "script.py", status=1).stderr.strip().splitlines()[-1]
    assert last.startswith("simenv_marl.errors.WorkerError: ")
    assert 'if __name__ == "__main__":' in last
