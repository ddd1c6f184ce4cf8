"""Spread many simulations over a local cluster, and compare with this process alone.

``make test-clusters`` runs ``python -m tests.clusters.check dask`` and ``... ray``, each in an
environment of its own, because their pins differ. All sockets listen on the loopback address alone.
"""

import argparse
import os
import tempfile
from contextlib import contextmanager
from pathlib import Path

import joblib
import numpy as np
from gymnasium import spaces

from simenv_marl import make_step, simulate_many
from simenv_marl.data import collect_episodes
from simenv_marl.experiments import run_experiment


class Model:
    """In ``__main__`` and so nothing that a worker could import."""

    @make_step(
        observation_space=spaces.Box(-1e6, 1e6, (2,), np.float64),
        observation_space_mapping=lambda model: [model.level, len(model.log)],
        action_space=spaces.Discrete(7),
        action_space_mapping=lambda action: action,
        reward_mapping=lambda model: float(model.level),
    )
    def decide(self):
        return 0

    def __init__(self, bonus=0):
        self.bonus = bonus

    def reset(self, seed):
        self.generator, self.level, self.log = np.random.default_rng(seed), seed + self.bonus, []

    def run(self):
        for _ in range(int(self.generator.integers(1, 20))):
            self.level += self.decide() - int(self.generator.integers(5))
            self.log.append(self.level)


def policy(observations):
    return observations.sum(axis=1).astype(int) % 7


def failing(observations):
    raise ZeroDivisionError("on purpose")


@contextmanager
def dask_cluster():
    from dask.distributed import Client, LocalCluster

    with (
        LocalCluster(
            n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None
        ) as cluster,
        Client(cluster),
        joblib.parallel_config(backend="dask"),
    ):
        yield


@contextmanager
def ray_cluster():
    import ray
    from ray.util.joblib import register_ray

    ray.init(num_cpus=2, include_dashboard=False, _node_ip_address="127.0.0.1", log_to_driver=False)
    register_ray()
    try:
        with joblib.parallel_config(backend="ray"):
            yield
    finally:
        ray.shutdown()


def check():
    """Everything that crosses to the workers and back."""
    policies, seeds = {Model.decide: policy}, range(50)
    alone = simulate_many(Model, policies, seeds=seeds, collect=lambda model: model.log)
    for workers in (2, -1):
        found = simulate_many(
            Model,
            policies,
            seeds=seeds,
            workers=workers,
            progress=True,
            collect=lambda model: (model.log, os.getpid()),
        )
        assert [log for log, _ in found] == alone
        assert os.getpid() not in {process for _, process in found}
    one, other = (
        collect_episodes(Model, policies, seeds=seeds, workers=workers)[Model.decide]
        for workers in (0, 2)
    )
    assert np.array_equal(one.rewards, other.rewards)
    assert np.array_equal(one.observations, other.observations)
    assert one.seeds == other.seeds
    raised = None
    try:
        simulate_many(Model, {Model.decide: failing}, seeds=seeds, workers=2)
    except ZeroDivisionError as error:
        raised = error
    assert raised is not None
    assert raised.args == ("on purpose",)
    assert "seed" in "".join(raised.__notes__)
    assert (
        simulate_many(Model, policies, seeds=seeds, workers=2, collect=lambda model: model.log)
        == alone
    )


def check_experiment():
    """The table of an experiment is the same, and the workers have written it."""
    policies = {"batched": {Model.decide: policy}}
    with tempfile.TemporaryDirectory() as folder:
        tables = [
            run_experiment(
                Model, {"bonus": [0, 3, 5]}, contenders=policies, seeds=range(9),
                points=[Model.decide], batched=True, metric=lambda model: model.level,
                store=Path(folder) / str(workers), workers=workers,
            )
            for workers in (0, 2)
        ]  # fmt: skip
        assert tables[0].equals(tables[1])
        assert len(tables[0]) == 3 * 2 * 9 * 2
        assert list((Path(folder) / "2").glob("*.jsonl"))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cluster", choices=["dask", "ray"])
    name = parser.parse_args().cluster
    with {"dask": dask_cluster, "ray": ray_cluster}[name]():
        check()
        check_experiment()
    print(f"{name}: all is as in one process")
