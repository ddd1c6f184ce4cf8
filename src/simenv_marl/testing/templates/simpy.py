"""MyModel: a paint shop in SimPy, and an agent that schedules it. Replace the model with yours.

``python -m simenv_marl.testing.templates.simpy`` trains the agent and compares it with the model's
own rule.
"""

import sys
from typing import Any, ClassVar, NamedTuple

import numpy as np
import simpy
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from simpy.events import ProcessGenerator

from simenv_marl import (
    TRUNCATED,
    SimulationInterface,
    Streams,
    difference,
    evaluate,
    make_step,
    single_env,
)
from simenv_marl.envs import SimulationEnv

# -- 1. The model: SimPy's processes, and its own rule --------------------------------------------


class Job(NamedTuple):
    """A job: how long it takes, and when it is due."""

    minutes: float
    due: float


class MyModel:
    """A paint shop. Jobs arrive at random, wait, and are painted one by one."""

    def __init__(self, seed: int | None = None) -> None:
        self.streams = Streams(seed)  # generators by name, so that a seed repeats a run
        self.clock = simpy.Environment()
        self.waiting: list[Job] = []
        self.late = 0.0  # minutes of all finished jobs
        self.clock.process(self.receive_orders())
        self.clock.process(self.paint())

    def receive_orders(self) -> ProcessGenerator:
        """Let jobs arrive: one in four is urgent."""
        arrivals = self.streams["arrivals"]
        kinds = self.streams["kinds of jobs"]
        while True:
            due = self.clock.now + float(kinds.choice([20.0, 120.0, 120.0, 120.0]))
            self.waiting.append(Job(float(kinds.choice([4.0, 8.0, 20.0])), due))
            yield self.clock.timeout(arrivals.exponential(11.0))

    def paint(self) -> ProcessGenerator:
        """Paint one job after the other, as long as there are any."""
        while True:
            if self.waiting:
                job = self.choose_job()
                self.waiting.remove(job)
                yield self.clock.timeout(job.minutes)
                self.late += max(0.0, self.clock.now - job.due)
            yield self.clock.timeout(1.0)  # a minute to clean up, or to wait

    def choose_job(self) -> Job:
        """The rule: first come, first served."""
        return self.waiting[0]


# -- 2. The decision: the agent's observation, its actions and its reward -------------------------


def observe(shop: MyModel) -> NDArray[np.float32]:
    """Return three numbers for each of eight jobs: that it waits, its minutes, the time left."""
    rows = np.zeros((8, 3), np.float32)
    for row, job in zip(rows, shop.waiting, strict=False):
        row[:] = 1, job.minutes / 20, (job.due - shop.clock.now - job.minutes) / 60
    return rows.clip(-10, 10).ravel()


dispatch = make_step(
    observation_space=Box(-10, 10, (24,), np.float32),
    observation_space_mapping=observe,  # gets the arguments of the decision call
    action_space=Discrete(8),
    choices=lambda shop: shop.waiting[:8],  # the action is an index
    reward_mapping=difference(lambda shop: -shop.late / 60),  # since the last decision
    agent="dispatcher_0",
    # For people and language models:
    question="Which job is painted next?",
    action_labels=lambda shop: {
        action: f"job {action + 1}: {job.minutes:g} minutes, due in {job.due - shop.clock.now:.0f}"
        for action, job in enumerate(shop.waiting[:8])
    },
    observation_labels=[
        f"job {job}: {part}"
        for job in range(1, 9)
        for part in ("it waits", "minutes / 20", "hours left")
    ],
    display_mapping=lambda shop: {
        "minutes since the morning": f"{shop.clock.now:.0f}",
        "waiting jobs": len(shop.waiting),
        "minutes too late so far": f"{shop.late:.0f}",
    },
)

# -- 3. The simulation: an episode ----------------------------------------------------------------


class MySimulation(SimulationInterface):
    """A day of eight hours."""

    points: ClassVar = {MyModel.choose_job: dispatch}  # the class of the model does not change

    def reset(self, seed: int | None = None) -> None:
        """Begin a day."""
        self.model = MyModel(seed)

    def run(self) -> object:
        """Run SimPy's own loop, which is suspended at each decision."""
        self.model.clock.run(until=8 * 60)
        return TRUNCATED  # a time limit, not an end of the task: the shop remains

    def time(self) -> float:
        """Return the clock for ``info["time"]`` and ``info["elapsed"]``."""
        return float(self.model.clock.now)

    def reseed(self, seed: int) -> None:
        """Draw another future, for planning."""
        self.model.streams.reseed(seed)


# -- 4. The environment, the training, and its value ----------------------------------------------


def env() -> SimulationEnv:
    """Make the environment, a ``gymnasium.Env`` with ``action_masks()``."""
    return single_env(MySimulation, skip_forced=True)  # a single job is no choice


def score_jobs(weights: Any) -> Any:
    """Make a policy for one observation or many: it takes the job with the highest score."""

    def choose(observations: NDArray[np.float32]) -> Any:
        rows = observations.reshape(*observations.shape[:-1], 8, 3)
        return np.where(rows[..., 0] > 0, rows[..., 1:] @ weights, -np.inf).argmax(-1)

    return choose


def train(candidates: int, days: int) -> Any:
    """Train by random search: candidates meet the same days, and the best is the policy."""
    weights = np.random.default_rng(1).normal(size=(candidates, 2))
    contenders = {str(n): {"dispatcher_0": score_jobs(row)} for n, row in enumerate(weights)}
    evaluation = evaluate(MySimulation, contenders, seeds=range(days), batched=True)
    return contenders[evaluation.summary()["mean"].idxmax()]["dispatcher_0"]


if __name__ == "__main__":
    quick = "--quick" in sys.argv  # to try whether everything runs
    policy = train(5, 2) if quick else train(40, 20)
    policies = {"rule": {}, "trained": {"dispatcher_0": policy}}
    seeds = range(100_000, 100_010 if quick else 100_050)  # other days than in training
    evaluation = evaluate(MySimulation, policies, seeds=seeds, baseline="rule", batched=True)
    print("Minus the hours late in a day, of the same days:")
    print(evaluation)
