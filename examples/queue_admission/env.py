"""The queue as an environment: who admits a job decides at irregular times, and discounts by time.

The agent ``admission_0`` decides whether an arriving job comes in. It is not asked if the queue is
full.

**Observations.** The kind of the job and the kind in service, each as two indicators, and the
numbers of waiting jobs. All times are exponential, so nothing else helps to foresee the future.

**Rewards.** What the queue earns until the next decision, discounted to the decision: jobs that are
done pay somewhere within that interval, and holding costs run all along. The discount of the
interval itself, exp(-INTEREST * elapsed), is ``info["discount"]``.
"""

from __future__ import annotations

from math import exp
from typing import Any, ClassVar, Final

import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray

from simenv_marl import (
    TRUNCATED,
    SimulationInterface,
    difference,
    make_step,
    reseed_generators,
    single_env,
)

from .exact import Decision
from .model import INTEREST, KINDS, PLACES, Queue

HORIZON: Final = 150.0
"""The length of an episode: what comes later weighs exp(-15)."""

AGENT: Final = "admission_0"


def observation(decision: Decision) -> NDArray[np.float32]:
    """Return the observation of a decision: the kind of the job and the state of the queue."""
    kind, (a, b, serving) = decision
    return np.array([kind == 0, kind == 1, serving == 0, serving == 1, a, b], np.float32)


def look(queue: Queue, kind: int) -> NDArray[np.float32]:
    """Observe the decision that is pending."""
    return observation((kind, (queue.waiting(0), queue.waiting(1), queue.serving())))


def question(queue: Queue, kind: int) -> str:
    """Return what is asked about an arriving job."""
    job = KINDS[kind]
    return (
        f"A job of kind {job.name} arrives: it pays {job.reward:g} when it is done, and takes"
        f" {1 / job.services:g} on average. Does it come in?"
    )


def display(queue: Queue) -> dict[str, str | int]:
    """Return what people and language models read in place of the observation."""
    serving = queue.serving()
    waiting = {f"waiting, kind {job.name}": queue.waiting(kind) for kind, job in enumerate(KINDS)}
    return {
        "in service": "nothing" if serving is None else f"kind {KINDS[serving].name}",
        **waiting,
        "free places": PLACES - sum(waiting.values()),
    }


_gained = difference(lambda queue, kind: queue.present_value())
_elapsed = difference(lambda queue, kind: queue.clock.now)


def earn(queue: Queue, kind: int) -> float:
    """Reward the present value since the previous decision, as of the time of that decision."""
    before = queue.clock.now - _elapsed(queue, kind)
    return float(_gained(queue, kind) * exp(INTEREST * before))


admission = make_step(
    observation_space=Box(0, PLACES, (6,), np.float32),
    observation_space_mapping=look,
    action_space=Discrete(2),
    action_space_mapping=bool,
    reward_mapping=earn,
    rule_action_mapping=int,
    agent=AGENT,
    question=question,
    display_mapping=display,
    action_labels=["turn it away", "let it in"],
    observation_labels=[
        *(f"the job is of kind {job.name}" for job in KINDS),
        *(f"kind {job.name} is in service" for job in KINDS),
        *(f"waiting, kind {job.name}" for job in KINDS),
    ],
)


class QueueSimulation(SimulationInterface):
    """The queue for a limited time."""

    points: ClassVar[Any] = {Queue.admit: admission}

    def reset(self, seed: int | None = None) -> None:
        """Begin with an empty queue."""
        self.model: Any = Queue(seed)

    def run(self) -> Any:
        """Run SimPy's loop. The queue has no end, so the limit truncates."""
        self.model.clock.run(until=HORIZON)
        return TRUNCATED

    def time(self) -> float:
        """Return SimPy's clock."""
        return float(self.model.clock.now)

    def reseed(self, seed: int) -> None:
        """Draw another future."""
        reseed_generators(self, seed)


def env(**options: Any) -> Any:
    """Make the environment: a ``gymnasium.Env`` whose infos have the discount of each interval."""
    return single_env(QueueSimulation, **{"discount_rate": INTEREST, **options})
