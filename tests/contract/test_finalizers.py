"""Finalizers that decide: processes of an episode that is gone are freed while another one runs."""

import gc

import pytest

from simenv_marl import single_env
from tests.worlds.models import define

PUMP = f"{__name__}.Plant.pump"
POINTS = {PUMP: define(agent="pump", rule_action_mapping=int)}


ABANDONED = []


class Plant:
    """Its processes pump once more when they are freed. The later episodes free the earlier."""

    def __init__(self):
        self.pumped = []

    def reset(self, seed=None):
        self.seed = seed

    def pump(self):
        return 0

    def work(self, seed):
        try:
            while True:
                self.pumped.append((seed, "works", self.pump()))
                yield
        finally:
            self.pumped.append((seed, "ends", self.pump()))

    def run(self):
        process = self.work(self.seed)
        next(process)
        self.free()
        next(process)
        self.keep(process)

    def free(self):
        ABANDONED.clear()

    def keep(self, process):
        ABANDONED.append(process)


class Circular(Plant):
    """Only the garbage collector frees its processes."""

    def free(self):
        gc.collect()

    def keep(self, process):
        cycle = [process]
        cycle.append(cycle)


@pytest.mark.parametrize("kind", [Plant, Circular])
def test_decision_of_a_freed_generator_never_reaches_another_env(kind):
    ABANDONED.clear()
    first = single_env(kind, POINTS)
    second = single_env(kind, POINTS)
    gc.disable()
    try:
        for seed, env in enumerate((first, first, second)):
            env.reset(seed=seed)
            over = False
            while not over:
                *_, over, _, _ = env.step(1)
    finally:
        gc.enable()
        ABANDONED.clear()
    pumped = first.simulation.pumped
    assert [act for act in pumped if act[1] == "works"] == [
        (seed, "works", 1) for seed in (0, 0, 1, 1)
    ]
    assert [act for act in pumped if act[1] == "ends"] == [(0, "ends", 0), (1, "ends", 0)]
    assert second.simulation.pumped[:2] == [(2, "works", 1)] * 2
