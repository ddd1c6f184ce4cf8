"""MyModel: a paint shop in SimPy, and an agent that learns which job comes next.

``python -m simenv_marl.testing.templates.simpy`` trains the agent and compares it with the model's own rule. It needs
``pip install "simenv-marl[experiments]" simpy cma``. ``--quick`` only shows that everything runs.

Replace the model by yours, section by section. Section 1 knows nothing of reinforcement learning and stays that way.
"""

import random
import sys
from collections.abc import Generator
from dataclasses import dataclass
from typing import Any

import cma
import numpy as np
import simpy
from gymnasium.spaces import Box, Discrete

from simenv_marl import TRUNCATED, SimulationInterface, difference, evaluate, make_step, single_env
from simenv_marl.data import collect_episodes

# -- 1. The model: SimPy's processes, and a rule of its own ---------------------------------------


@dataclass(eq=False)
class Job:
    """An order: how many minutes it takes, and when it is due."""

    minutes: float
    due: float


class MyModel:
    """A paint shop. Jobs come at random, wait, and are painted one by one."""

    def __init__(self, seed: int | None = None) -> None:
        self.random = random.Random(seed)  # the model's own generator: the same seed brings the same run
        self.clock = simpy.Environment()
        self.waiting: list[Job] = []
        self.late = 0.0  # of the finished jobs, in minutes
        self.clock.process(self.receive_orders())
        self.clock.process(self.paint())

    def receive_orders(self) -> Generator[simpy.Event, Any, None]:
        """Let jobs come in: one in four is urgent."""
        while True:
            due = self.clock.now + self.random.choice([20.0, 120.0, 120.0, 120.0])
            self.waiting.append(Job(self.random.choice([4.0, 8.0, 20.0]), due))
            yield self.clock.timeout(self.random.expovariate(1 / 11.0))

    def paint(self) -> Generator[simpy.Event, Any, None]:
        """Paint one job after the other, as long as there are any."""
        while True:
            if self.waiting:
                job = self.choose_job()
                self.waiting.remove(job)
                yield self.clock.timeout(job.minutes)
                self.late += max(0.0, self.clock.now - job.due)
            else:
                yield self.clock.timeout(1.0)

    def choose_job(self) -> Job:
        """The rule: first come, first served."""
        return self.waiting[0]

    def minutes_late(self) -> float:
        """Add up how late all jobs are by now, finished or waiting."""
        return self.late + sum(max(0.0, self.clock.now - job.due) for job in self.waiting)


# -- 2. The decision: what the agent sees, what it can do, and what it is rewarded for ------------

SLOTS = 8  # among how many jobs the agent can choose; those that come after them wait until there is room


def observe(shop: MyModel) -> np.ndarray[Any, Any]:
    """See a row for each job: that it is there, its minutes, and the time that is left for it."""
    rows = np.zeros((SLOTS, 3), np.float32)
    for row, job in zip(rows, shop.waiting, strict=False):
        row[:] = 1, job.minutes / 20, (job.due - shop.clock.now - job.minutes) / 60
    return rows.clip(-10, 10)


dispatch = make_step(
    observation_space=Box(-10, 10, (SLOTS, 3), np.float32),
    observation_space_mapping=observe,  # gets the arguments of the decision call
    action_space=Discrete(SLOTS),
    choices=lambda shop: shop.waiting[:SLOTS],  # the action is an index
    reward_mapping=difference(lambda shop: -shop.minutes_late() / 60),  # since the last decision
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
        """Run SimPy's own loop. It is suspended at each decision; nothing here has to be stepped."""
        self.model.clock.run(until=8 * 60)
        return TRUNCATED  # time is up, but the shop goes on: no end of the task

    def time(self) -> float:
        """The clock, for ``info["time"]`` and ``info["elapsed"]``: decisions are not equally far apart."""
        return float(self.model.clock.now)


# -- 4. The environment, training, and what it is worth -------------------------------------------

OPTIONS: dict[str, Any] = {"skip_forced": True}  # one waiting job is no choice, and is not asked for


def env(**options: Any) -> Any:
    """Make the environment: a ``gymnasium.Env``, with ``action_masks()`` for learners that know masks."""
    return single_env(MySimulation, **(OPTIONS | options))


def policy_of(weights: Any) -> Any:
    """Make a policy that gives points to each job, and takes the job with the most; for one observation or many."""
    return lambda seen: np.where(seen[..., 0] > 0, seen[..., 1:] @ np.asarray(weights), -np.inf).argmax(-1)


def train(rounds: int, days: int) -> Any:
    """Train by evolution (CMA-ES), and return a policy. Every candidate meets the same days."""
    search = cma.CMAEvolutionStrategy(np.zeros(2), 1.0, {"seed": 1, "verbose": -9})
    for number in range(rounds):
        seeds = range(number * days, (number + 1) * days)
        weights, costs = search.ask(), []
        for candidate in weights:
            found = collect_episodes(MySimulation, {"dispatcher_0": policy_of(candidate)}, seeds=seeds, **OPTIONS)
            rewards, times = found["dispatcher_0"].rewards, np.asarray(found["dispatcher_0"].times)
            costs.append(-float(np.sum(rewards * 0.9995**times)))  # discounted by the minute, not by the decision
        search.tell(weights, costs)
    return policy_of(search.result.xfavorite)


if __name__ == "__main__":
    quick = "--quick" in sys.argv
    trained = train(*(2, 2) if quick else (12, 10))
    policies: dict[str, Any] = {
        "rule": {},  # the model as it is
        "shortest first": {"dispatcher_0": policy_of([-1, 0])},  # a rule of thumb
        "trained": {"dispatcher_0": trained},
    }
    seeds = range(100_000, 100_005 if quick else 100_050)  # days that it was not trained on
    found = evaluate(MySimulation, policies, seeds=seeds, baseline="rule", batched=True, **OPTIONS)
    print("Minus the hours late in a day; differences are paired by seed, with 95 % intervals:")
    print(found.summary().round(1).to_string())
    print("Next: put your model into section 1, and run pytest. For a full report:")
    print("python -m simenv_marl check simenv_marl.testing.templates.simpy:MySimulation")
