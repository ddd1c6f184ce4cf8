"""Many simulations, spread over processes by joblib."""

import gc
import os
import re
import signal
import subprocess
import sys
import textwrap
import threading
import time
from functools import partial

import joblib
import pytest
from joblib._parallel_backends import ThreadingBackend

from simenv_marl import RULE, difference, simulate_many
from simenv_marl.data import collect_episodes
from simenv_marl.errors import InvalidActionError, WorkerError
from simenv_marl.experiments import Variant
from simenv_marl.many import parallel
from simenv_marl.plugins import expose_to_plugins
from tests.contract.test_simulate_many import ones
from tests.processes import ROOT, alone, descriptors, python
from tests.worlds import valued
from tests.worlds.entities import Colony, ColonyDesign, Creature, colony_points
from tests.worlds.models import calling, decision, define, fails, script
from tests.worlds.valued import Shop
from tests.worlds.vectors import same

# Where work is given up, joblib empties its queue of work while a thread of its own may be about to
# take from it, and ends that thread in any case.
pytestmark = pytest.mark.filterwarnings(
    "ignore:Exception in thread ExecutorManagerThread:pytest.PytestUnhandledThreadExceptionWarning"
)

DESIGN = ColonyDesign(initial=4, most=12, ticks=4, overseen="before", truncates=True)
POINTS = colony_points(overseen=True)


@pytest.fixture(scope="module", autouse=True)
def _workers_end():
    yield
    joblib.externals.loky.get_reusable_executor().shutdown(wait=True)


def policy(observations):
    return [
        RULE if number == 5 else number
        for number in (observations.sum(axis=1) % 6).astype(int).tolist()
    ]


def traces(**arguments):
    policies = {Creature.act: policy, "overseer_0": policy}
    return simulate_many(
        lambda: Colony(DESIGN), policies, points=POINTS, collect=lambda s: s.trace, **arguments
    )


@pytest.mark.parametrize(
    "arguments", [{"seeds": range(9)}, {"seeds": [5, 3], "batch_size": 1}, {"seeds": []}], ids=str
)
def test_simulate_many_workers_give_the_same_results_in_the_same_order(arguments):
    assert traces(workers=2, **arguments) == traces(**arguments)
    assert os.getpid() not in simulate_many(
        calling(), workers=2, collect=lambda model: os.getpid(), **arguments
    )


def test_collect_episodes_with_workers_returns_the_same_episodes():
    policies = {
        Creature.act: lambda observations: (
            policy(observations),
            {"sums": observations.sum(axis=1)},
        )
    }
    policies |= {"overseer_0": policies[Creature.act], "creature_99": ones}  # who is never born
    given = {
        "points": POINTS,
        "seeds": range(9),
        "collect": lambda simulation: simulation.trace,
        "batch_size": 2,
    }
    alone, shared = (
        collect_episodes(lambda: Colony(DESIGN), policies, **given, workers=number)
        for number in (0, 2)
    )
    assert alone["creature_99"].collected == tuple(traces(seeds=range(9)))
    assert list(alone) == list(shared) == list(policies)
    for key, found in alone.items():
        assert same(vars(found), vars(shared[key]))


@pytest.mark.thorough
def test_simulate_many_workers_get_functions_defined_anywhere():
    """Functions without an importable name work in workers: local, differences, handlers."""

    class Model:
        @expose_to_plugins
        @define(
            agent="model_0",
            observation_space_mapping=lambda model: [model.level, level_changed(model)],
            reward_mapping=difference(lambda model: model.level),
        )
        def decide(self):
            return 0

        @classmethod
        @define(agent="class_0")
        def of_class(cls):
            return "rule"

        def reset(self, seed):
            self.level, self.log = seed, []

        def run(self):
            for _ in range(3):
                action = self.decide()
                self.level += action
                self.log.append((action, Model.of_class()))

    level_changed = difference(lambda model: model.level)

    def two(observations):
        return 1 + observations[:, 1].astype(int) % 2

    def handler(model):
        model.level += 3

    policies = {Model.decide: two, Model.of_class: ones}
    points, plugins = [Model.decide, Model.of_class], [(handler, Model.decide, "before")]
    arguments = {"points": points, "plugins": plugins, "seeds": range(3)}
    for workers in (0, 2):
        found = simulate_many(Model, policies, workers=workers, **arguments)
        assert [simulation.log for simulation in found] == [[(1, 1), (1, 1), (1, 1)]] * 3
        # what comes back is what it was
        assert all(type(simulation) is Model for simulation in found)
        collected = collect_episodes(Model, policies, workers=workers, **arguments)
        assert collected[Model.decide].rewards.tolist() == [4.0, 4.0, 1.0] * 3


def test_simulate_many_workers_get_undecorated_models_and_variants():
    number, before = 7, vars(Creature)["act"]
    points = {Creature.act: colony_points(overseen=False)[Creature.act]}
    own = {"creature_0": lambda observation: 3}
    variant = Variant("mine", Colony, parameters={"design": DESIGN}, points=points, policies=own)

    def of_many(observations):
        return [number % 5] * len(observations)

    given = {"seeds": range(4), "collect": lambda simulation: simulation.trace}
    alone, shared = (
        simulate_many(variant, {Creature.act: of_many}, **given, workers=workers)
        for workers in (0, 2)
    )
    assert shared == alone
    assert vars(Creature)["act"] is before


def test_simulate_many_errors_in_workers_keep_their_type():
    class LocalError(Exception):
        """Of which workers cannot know by its name."""

    def raising(observations):
        raise LocalError("a")

    def main(simulation):
        simulation.log.append(ant() // (simulation.seed - 13))

    ant = decision(agent="ant_0")
    for policy, error, match, told in (
        (ones, ZeroDivisionError, "division", "seed 13"),
        (raising, LocalError, "^a", "seed"),
        (lambda observations: [1], InvalidActionError, "decisions", "seed"),
    ):
        with fails(error, told, match=match) as caught:
            simulate_many(
                script(main),
                {ant: policy},
                seeds=range(20),
                workers=2,
                collect=lambda simulation: None,
            )
        # where it was raised there
        assert error is not ZeroDivisionError or "in main" in str(caught.value.__cause__)


def test_simulate_many_keyboard_interrupt_cancels_the_remaining_work(monkeypatch):
    """After an interrupt between results, the rest is cancelled, and the next call works."""

    def interrupted(parcel):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("simenv_marl.many.parallel.unpack_outcome", interrupted)
        with pytest.raises(KeyboardInterrupt):
            traces(seeds=range(40), workers=2, batch_size=1)
    assert len(traces(seeds=range(2), workers=2)) == 2


SCRIPT = """
    import gc, sys, time
    from simenv_marl import simulate_many
    from tests.worlds.models import define

    def define_model():
        global Model
        class Model:
            @define(observation_space_mapping=lambda model: [model.level, 0])
            def decide(self):
                return 0

            def reset(self, seed):
                gc.disable()  # what a worker has got stays there
                self.level = seed

            def run(self):
                for _ in range(3):
                    self.level += self.decide()
                    if len(sys.argv) > 1:
                        open(sys.argv[1], "w").close()
                        time.sleep(60)

    if __name__ == "__main__":
        given = {"seeds": range(3), "batch_size": 1, "collect": lambda model: model.level}
        try:
            for workers in (2, 2, 0):
                define_model()  # as one does again and again in a notebook
                policies = {Model.decide: lambda seen: seen[:, 0].astype(int) % 5}
                print(simulate_many(Model, policies, workers=workers, **given))
        except KeyboardInterrupt:
            print("interrupted")
"""


def test_simulate_many_workers_run_models_of_a_script(tmp_path, monkeypatch):
    """What a script defines has no name under which workers could import it."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([*filter(None, sys.path), str(ROOT)]))
    path, begun = tmp_path / "script.py", tmp_path / "begun"
    path.write_text(textwrap.dedent(SCRIPT), encoding="utf-8")
    assert python(path).stdout.splitlines() == ["[0, 8, 11]"] * 3
    command = [sys.executable, path, begun]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True
    ) as process:
        for _ in range(600):
            if begun.exists():
                break
            time.sleep(0.1)
        os.killpg(process.pid, signal.SIGINT)
        try:
            # and not after the minute for which they sleep
            printed, _ = process.communicate(timeout=30)
        finally:
            process.kill()  # which else is waited for, for ever
    assert printed.split() == [b"interrupted"]


def test_simulate_many_progress_option_shows_a_bar(capsys):
    for workers in (0, 2):
        traces(seeds=range(5), workers=workers, progress=True)
        assert "5/5" in capsys.readouterr().err
    traces(seeds=range(5))
    collect_episodes(lambda: Colony(DESIGN), {Creature.act: ones}, points=POINTS, seeds=range(5))
    assert capsys.readouterr().err == ""


def test_joblib_backends_without_generators_share_the_work_evenly(monkeypatch):
    class Silent(ThreadingBackend):
        supports_return_generator = False

    sizes, work = [], parallel._work
    monkeypatch.setattr(
        parallel, "_work", lambda *given: (sizes.append(len(given[-1])), work(*given))[1]
    )
    monkeypatch.setitem(joblib.parallel.BACKENDS, "silent", Silent)
    with joblib.parallel_config(backend="silent"):
        assert traces(seeds=range(9), workers=2, batch_size=1) == traces(seeds=range(9))
    assert sorted(sizes) == [1, 2, 2, 2, 2]


@pytest.mark.parametrize("seeds", [range(4), range(8)])
def test_collect_episodes_includes_simulations_without_decisions_in_order(seeds):
    ant = decision(agent="ant_0")
    given = {
        "seeds": seeds,
        "batch_size": 2,
        "workers": 2,
        "collect": lambda simulation: simulation.seed * 10,
    }
    found = collect_episodes(
        script(lambda simulation: ant() if simulation.seed == 5 else None), {ant: ones}, **given
    )
    assert found[ant].collected == tuple(10 * seed for seed in seeds)
    assert found[ant].episodes.tolist() == ([5] if 5 in seeds else [])


@pytest.mark.thorough
@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="descriptors are not told of")
@pytest.mark.parametrize("what", ["it cannot be started", "it ends"])
def test_simulate_many_worker_that_fails_leaves_no_file_descriptors(what):
    alone(work_in_vain, what)


def work_in_vain(what):
    loky, home = joblib.externals.loky, os.getpid()

    def refuse(process):
        raise OSError("no more processes")

    def model():
        return Colony(DESIGN) if what != "it ends" or os.getpid() == home else os._exit(3)

    def run():
        loky.get_reusable_executor().shutdown(wait=True)
        with pytest.raises(Exception):  # noqa: B017
            simulate_many(model, {Creature.act: policy}, points=POINTS, seeds=range(4), workers=2)
        loky.get_reusable_executor().shutdown(wait=True)
        gc.collect()
        return len(descriptors())

    if what == "it cannot be started":
        loky.backend.process.LokyProcess.start = refuse
    first = max(run(), run())  # joblib keeps some for the next time
    assert any(run() <= first for _ in range(6))  # some of it goes a little later


MAIN_SCRIPT = """
from simenv_marl import simulate_many, vector_env
from tests.worlds.models import define

def zero(*args):
    return 0.0

def pair(*args):
    return [1.0, 2.0]

class Base:
    def drain(self):
        return 0

class Tank(Base):
    pass

def choose():
    return 0

class Yard:
    @define(agent="yard")
    def open(self):
        return 0

class Sim:
    def reset(self):
        self.log = []

    def run(self):
        self.log.append((Tank().drain(), choose(), Yard().open()))

class Owner(Sim):
    points = {{"__main__.choose": define()}}

    def expected_calls(self, point):
        assert point == "__main__.choose", point
        return [()]

def log_of(simulation):
    return simulation.log

def ones(observations):
    return [1] * len(observations)

if __name__ == "__main__":
    decided = {definition}
    for model, points in [
        (Sim, {{"__main__.Tank.drain": decided}}),
        (Sim, {{"__main__.choose": decided}}),
        (Sim, {{choose: decided}}),
        (Sim, "__main__.Yard.open"),
        (Owner, None),
    ]:
        key = points if isinstance(points, str) else next(iter(points or model.points))
        for _ in range(2):
            logs = simulate_many(
                model, {{key: ones}}, points=points, seeds=[1, 2], collect=log_of, workers=2
            )
            print(logs)
        envs = vector_env(model, points, num_envs=2, workers=2)
        envs.reset()
        envs.step([1, 1])
        envs.close()
"""


@pytest.mark.thorough
@pytest.mark.parametrize(
    "definition",
    [
        "define()",
        "define(observation_space_mapping=pair, action_space_mapping=abs, reward_mapping=zero)",
    ],
)
def test_simulate_many_workers_find_a_scripts_decision_points_by_name(definition, tmp_path):
    """They are pickled by value with lambdas, and else found in the imported script."""
    path = tmp_path / "script.py"
    path.write_text(MAIN_SCRIPT.format(definition=definition), encoding="utf-8")
    tank, chosen, yard = [f"[[{log}], [{log}]]" for log in ("(1, 0, 0)", "(0, 1, 0)", "(0, 0, 1)")]
    expected = [tank] * 2 + [chosen] * 4 + [yard] * 2 + [chosen] * 2
    assert python(path).stdout.splitlines() == expected


@pytest.mark.parametrize("backend", ["loky", "threading"])
def test_simulate_many_progress_bar_moves_with_each_episode_of_a_worker(backend, capsys):
    def asked(observation, *, _decision):
        return 5

    shop = partial(Shop, kind="slow")
    given = {"seeds": range(60), "points": valued.POINTS, "workers": 2, "progress": True}
    with joblib.parallel_config(backend=backend):
        collect_episodes(shop, {"keeper": asked}, **given)
    numbers = list(map(int, re.findall(r" (\d+)/60 \[", capsys.readouterr().err)))
    assert numbers == sorted(numbers)
    assert len({*numbers}) > 4
    assert numbers[-1] == 60


def test_simulate_many_progress_bar_counts_workers_without_shared_files(capsys, monkeypatch):
    def update(bar, number=1):
        if threading.current_thread() is threading.main_thread():
            real(bar, number)
        else:
            bar.missing += number

    real = parallel._SharedBar.update
    monkeypatch.setattr(parallel._SharedBar, "update", update)
    with joblib.parallel_config(backend="threading"):
        simulate_many(Shop, seeds=range(8), workers=2, batch_size=2, progress=True)
    assert "8/8" in capsys.readouterr().err


# -- workers that die -----------------------------------------------------------------------------


class Doomed(Shop):
    """A shop whose process ends in the run of some seeds: always, or once for each of a folder."""

    def __init__(self, folder, always=(), once=()):
        super().__init__()
        self.folder, self.always, self.once = folder, always, once

    def reset(self, seed):
        super().reset(seed)
        self.own_seed = seed

    def run(self):
        path = self.folder / str(self.own_seed)
        with path.open("a") as file:
            file.write("x")
        if self.own_seed in self.always or (
            self.own_seed in self.once and path.stat().st_size == 1
        ):
            os.kill(os.getpid(), signal.SIGKILL)
        return super().run()


def doomed(folder, **ends):
    return partial(Doomed, folder, **ends)


def seed_of(simulation):
    return simulation.own_seed


@pytest.mark.thorough
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="there is no SIGKILL")
@pytest.mark.parametrize("batch_size", [1, 1024])
def test_simulate_many_repeats_runs_of_a_dead_worker_once_each_alone(batch_size, tmp_path):
    given = {"seeds": range(24), "workers": 2, "batch_size": batch_size, "collect": seed_of}
    found = simulate_many(doomed(tmp_path, always=(3,), once=(0, 7, 8, 21)), **given)
    assert isinstance(found[3], WorkerError)
    assert "3" in str(found[3])
    found[3] = 3
    assert found == [*range(24)]
    assert len((tmp_path / "3").read_text()) in (2, 3)  # it may not have begun at the first death
    with pytest.raises(WorkerError, match="died twice"):
        simulate_many(doomed(tmp_path, always=(1, 2)), seeds=[1, 2], workers=2)


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="there is no SIGKILL")
def test_collect_episodes_omits_episodes_whose_worker_died(tmp_path):
    given = {"points": valued.POINTS, "collect": seed_of, "batch_size": 2}
    model, policies = doomed(tmp_path, always=(2, 9), once=(4,)), {"keeper": ones}
    found = collect_episodes(model, policies, seeds=range(12), workers=2, **given)["keeper"]
    seeds = [seed for seed in range(12) if seed not in (2, 9)]
    whole = collect_episodes(doomed(tmp_path), policies, seeds=seeds, **given)["keeper"]
    assert found.lost == (2, 9)
    assert whole.lost == ()
    assert same(
        {**vars(found), "lost": (), "lengths": None}, {**vars(whole), "lost": (), "lengths": None}
    )
    one = collect_episodes(model, policies, seeds=[9], workers=2, **given)["keeper"]
    assert (len(one), one.seeds, one.lost, one.collected) == (0, (), (9,), ())
