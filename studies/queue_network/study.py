"""Two queues in a row: the admission to each learns alone, from the times between decisions.

``python -m studies.queue_network.study`` trains both by semi-Markov Q-learning with a table, in one
AEC environment, and compares them with the rule, which admits all.

Jobs that the first queue has finished go on to the second one, which also has arrivals of its own.
Each queue earns for itself. The first one is the queue of ``examples/queue_admission``, so that its
optimum is known.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Final

import numpy as np
import simpy
from examples.queue_admission.env import QueueSimulation, admission, observation
from examples.queue_admission.exact import ADMIT_ALL, DECISIONS, Table, best_table, worth
from examples.queue_admission.model import INTEREST, KINDS, Queue

from simenv_marl import aec_env, evaluate

# -- the model ------------------------------------------------------------------------------------


class Station(Queue):
    """A queue of a network.

    Attributes:
        name: Its name.
        following: The queue to which its finished jobs go on. None: they leave.
        onward: The random generator of the work that is left for these jobs, so that its own
            arrivals do not depend on them.
    """

    def __init__(self, name: str, seed: int, clock: simpy.Environment, following: Any) -> None:
        super().__init__(seed, clock)
        self.name, self.following, self.onward = name, following, np.random.default_rng([seed, 1])

    def _serve(self, kind: int, work: float) -> Generator[Any, Any, Any]:
        yield from super()._serve(kind, work)
        if self.following is not None:
            self.following.take(kind, self.onward.exponential(1 / KINDS[kind].services))


class Network:
    """Two queues in a row.

    Attributes:
        clock: SimPy's environment, of both.
        first, second: The queues.
    """

    def __init__(self, seed: int | None = None) -> None:
        self.clock = simpy.Environment()
        one, other = np.random.SeedSequence(seed).generate_state(2).tolist()
        self.second = Station("second", other, self.clock, None)
        self.first = Station("first", one, self.clock, self.second)


# -- the environment ------------------------------------------------------------------------------

AGENTS: Final = ("first", "second")


class NetworkSimulation(QueueSimulation):
    """The network for a limited time.

    An agent for each queue decides at the times of its own arrivals.
    """

    points: ClassVar[Any] = {
        Queue.admit: replace(admission, agent=lambda station, kind: station.name)
    }

    def reset(self, seed: int | None = None) -> None:
        """Begin with empty queues."""
        self.model = Network(seed)


# -- learning -------------------------------------------------------------------------------------


class Learner:
    """Semi-Markov Q-learning with a table, which knows nothing of other agents.

    Attributes:
        values: The values of both actions, by observation.
    """

    def __init__(self, seed: int) -> None:
        self.values: dict[bytes, Any] = defaultdict(lambda: np.zeros(2))
        self._visits: dict[bytes, Any] = defaultdict(lambda: np.zeros(2))
        self._random = np.random.default_rng(seed)
        self._before: tuple[bytes, int] | None = None

    def decide(self, observation: Any, reward: float, discount: float, over: bool) -> int | None:
        """Learn from the interval since the previous decision, and decide.

        The decision is None at the end of an episode. Episodes are truncated, so that their last
        observation still has a value.
        """
        seen = observation.tobytes()
        if self._before is not None:
            before, action = self._before
            self._visits[before][action] += 1
            rate = self._visits[before][action] ** -0.6
            target = reward + discount * self.values[seen].max()
            self.values[before][action] += rate * (target - self.values[before][action])
        explores = self._random.random() < 0.3
        action = int(self._random.integers(2) if explores else self.values[seen].argmax())
        self._before = None if over else (seen, action)
        return None if over else action

    def table(self) -> Table:
        """Return what it has learned, without exploration."""
        return {one: bool(self.values[observation(one).tobytes()].argmax()) for one in DECISIONS}


def train(episodes: int, seed: int = 0, gamma: float | None = None) -> dict[str, Learner]:
    """Train a learner for each queue.

    Args:
        episodes: The number of episodes.
        seed: The seed of exploration and of the first episode.
        gamma: A discount for each decision. None: each interval is discounted by its time.
    """
    learners = {agent: Learner(seed + number) for number, agent in enumerate(AGENTS)}
    env = aec_env(NetworkSimulation, possible_agents=AGENTS, discount_rate=INTEREST)
    for episode in range(episodes):
        env.reset(seed=seed + episode)
        for agent in env.agent_iter():
            seen, reward, terminated, truncated, info = env.last()
            discount = info["discount"] if gamma is None else gamma  # of this agent's own interval
            env.step(learners[agent].decide(seen, reward, discount, terminated or truncated))
    env.close()
    return learners


# -- comparison -----------------------------------------------------------------------------------


def policy_of(table: Table) -> Callable[[Any], Any]:
    """Return a policy that decides by a table, for many observations."""
    answers = {observation(decision).tobytes(): int(answer) for decision, answer in table.items()}
    return lambda observations: [answers[seen.tobytes()] for seen in observations]


def compare(tables: dict[str, Table], by_decision: dict[str, Table], seeds: Iterable[int]) -> Any:
    """Compare both learners, and each beside the other's rule, with both rules."""
    policies = {agent: policy_of(table) for agent, table in tables.items()}
    return evaluate(
        NetworkSimulation,
        {
            "both rules": {},
            **{f"{agent} learned": {agent: policy} for agent, policy in policies.items()},
            "both learned": policies,
            "both, by decision": {agent: policy_of(table) for agent, table in by_decision.items()},
        },
        seeds=seeds,
        metric={
            "first": lambda simulation: simulation.model.first.present_value(),
            "second": lambda simulation: simulation.model.second.present_value(),
            "both": lambda simulation: (
                simulation.model.first.present_value() + simulation.model.second.present_value()
            ),
        },
        baseline="both rules",
        batched=True,
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Train, and print what the learners are worth."""
    parser = argparse.ArgumentParser(description="Train a learner for each of two queues.")
    parser.add_argument(
        "--episodes", type=int, default=2_000, help="episodes of training (default: %(default)s)"
    )
    parser.add_argument(
        "--trainings", type=int, default=3, help="number of trainings (default: %(default)s)"
    )
    parser.add_argument(
        "--runs", type=int, default=400, help="simulations of each policy (default: %(default)s)"
    )
    options = parser.parse_args(arguments)
    optimum = worth(best_table())
    print(
        f"The first queue alone: optimum {optimum:.3f}, rule {worth(ADMIT_ALL) / optimum:.3f} of it"
    )
    for training in range(options.trainings):
        seed = training * options.episodes
        tables = {
            agent: learner.table() for agent, learner in train(options.episodes, seed).items()
        }
        by_decision = {
            agent: learner.table()
            for agent, learner in train(options.episodes, seed, gamma=0.9).items()
        }
        print(
            f"\nTraining {training}: the first learner has {worth(tables['first']) / optimum:.3f}"
            " of its optimum;"
        )
        print(
            "with a discount of 0.9 for each decision,"
            f" {worth(by_decision['first']) / optimum:.3f}."
        )
        found = compare(tables, by_decision, range(1_000_000, 1_000_000 + options.runs))
        for metric in ("first", "second", "both"):
            print(f"Present value, {metric}:\n{found.summary(metric=metric).round(2).to_string()}")


if __name__ == "__main__":
    main()
