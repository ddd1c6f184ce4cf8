"""MyModel: a paint shop in SimPy, and an agent that learns which job comes next. Replace the model by yours.

``python -m simenv_marl.testing.templates.simpy`` trains the agent and compares it with the model's
own rule.
"""

import sys
from collections import namedtuple
from typing import Any

import numpy as np
import simpy
from gymnasium.spaces import Box, Discrete

from simenv_marl import (
    TRUNCATED,
    SimulationInterface,
    Streams,
    difference,
    evaluate,
    make_step,
    single_env,
)

# -- 1. The model: SimPy's processes, and a rule of its own ---------------------------------------


Job = namedtuple("Job", ["minutes", "due"])  # how long it takes, and when it is to be ready


class MyModel:
    """A paint shop. Jobs come at random, wait, and are painted one by one."""

    def __init__(self, seed: int | None = None) -> None:
        self.streams = Streams(seed)  # generators by name: the same seed brings the same run
        self.clock = simpy.Environment()
        self.waiting: list[Job] = []
        self.late = 0.0  # minutes of all finished jobs
        self.clock.process(self.receive_orders())
        self.clock.process(self.paint())

    def receive_orders(self) -> Any:
        """Let jobs come in: one in four is urgent."""
        # independent of each other
        arrivals, kinds = self.streams["arrivals"], self.streams["kinds of jobs"]
        while True:
            due = self.clock.now + kinds.choice([20.0, 120.0, 120.0, 120.0])
            self.waiting.append(Job(kinds.choice([4.0, 8.0, 20.0]), due))
            yield self.clock.timeout(arrivals.exponential(11.0))

    def paint(self) -> Any:
        """Paint one job after the other, as long as there are any."""
        while True:
            if self.waiting:
                job = self.choose_job()
                self.waiting.remove(job)
                yield self.clock.timeout(job.minutes)
                self.late += max(0.0, self.clock.now - job.due)
            yield self.clock.timeout(1.0)  # a minute to clean up, or to wait

    def choose_job(self) -> Any:
        """The rule: first come, first served."""
        return self.waiting[0]


# -- 2. The decision: what the agent sees, what it can do, and what it is rewarded for ------------


def observe(shop: MyModel) -> Any:
    """See a row for each of the first eight jobs: that it is there, its minutes, and the time that is left for it."""
    rows = np.zeros((8, 3), np.float32)
    for row, job in zip(rows, shop.waiting, strict=False):
        row[:] = 1, job.minutes / 20, (job.due - shop.clock.now - job.minutes) / 60
    return rows.clip(-10, 10)


dispatch = make_step(
    observation_space=Box(-10, 10, (8, 3), np.float32),
    observation_space_mapping=observe,  # gets the arguments of the decision call
    action_space=Discrete(8),
    choices=lambda shop: shop.waiting[:8],  # the action is an index
    reward_mapping=difference(lambda shop: -shop.late / 60),  # since the last decision
    agent="dispatcher_0",
)

# -- 3. The simulation: what an episode is --------------------------------------------------------


class MySimulation(SimulationInterface):
    """A day of eight hours."""

    points = {MyModel.choose_job: dispatch}  # the model's class stays as it is

    def reset(self, seed: int | None = None) -> None:
        """Begin a day."""
        self.model = MyModel(seed)

    def run(self) -> Any:
        """Run SimPy's own loop.

        It is suspended at each decision; nothing here has to be stepped.
        """
        self.model.clock.run(until=8 * 60)
        return TRUNCATED  # time is up, but the shop goes on: no end of the task

    def time(self) -> float:
        """The clock, for ``info["time"]`` and ``info["elapsed"]``: decisions are not equally far apart."""
        return float(self.model.clock.now)

    def reseed(self, seed: int) -> None:
        """Draw another future, for planning."""
        self.model.streams.reseed(seed)


# -- 4. The environment, training, and what it is worth -------------------------------------------


def env() -> Any:
    """Make the environment: a ``gymnasium.Env``, with ``action_masks()`` for learners that know masks."""
    return single_env(MySimulation, skip_forced=True)  # one waiting job is no choice


def policy_of(weights: Any) -> Any:
    """Make a policy that gives points to each job, and takes the job with the most.

    For one observation or many.
    """
    return lambda seen: np.where(
        seen[..., 0] > 0, seen[..., 1:] @ np.asarray(weights), -np.inf
    ).argmax(-1)


def train(candidates: int, days: int) -> Any:
    """Train by random search: all candidates meet the same days, and the best becomes the policy."""
    policies = [
        policy_of(weights) for weights in np.random.default_rng(1).normal(size=(candidates, 2))
    ]
    contenders: dict[str, Any] = {
        str(number): {"dispatcher_0": policy} for number, policy in enumerate(policies)
    }
    found = evaluate(MySimulation, contenders, seeds=range(days), batched=True)
    return policies[int(found.summary()["mean"].idxmax())]


if __name__ == "__main__":
    quick = "--quick" in sys.argv  # only to see that everything runs
    policies: dict[str, Any] = {
        "rule": {},
        "trained": {"dispatcher_0": train(*(5, 2) if quick else (40, 20))},
    }
    seeds = range(100_000, 100_010 if quick else 100_050)  # days that it was not trained on
    print("Minus the hours late in a day; differences are paired by seed, with 95 % intervals:")
    print(
        evaluate(MySimulation, policies, seeds=seeds, baseline="rule", batched=True)
        .summary()
        .round(1)
        .to_string()
    )
