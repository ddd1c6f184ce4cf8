"""Expert iteration: a network learns from a planner, and serves it as the base policy.

``python -m studies.imitation.plans`` does so in rounds (Anthony, Tian and Barber, 2017) until a
budget of simulated days is spent. Then the network runs the greenhouses of ``make demo`` without
planning. It needs ``pip install "simenv-marl[many]" torch``.

The planner uses the full state of the greenhouse, because it simulates branches. The network sees
six numbers. A network that imitates the planner's actions fails: the planner pours as late as each
plant can bear, and the network cannot see when that is. So the network learns the value of every
candidate, and pours what is best given its observation:

- The network acts, so that it learns in the states that it reaches itself (Ross, Gordon and
  Bagnell, 2011). In a tenth of its decisions, a random amount replaces its own.
- In a quarter of its decisions, ``action_values`` tries out all candidates, with the network as the
  base policy.
- The network gives each candidate a probability, and is trained to maximise the expected value. It
  pours the expected amount.

``--plainly`` is for comparison: the planner gives demonstrations for the same budget, and the
network imitates its actions by the behaviour cloning of the module ``rule``.

The budget counts all simulated days: the days of the episodes, and for the branches the number of
candidates times futures times the horizon, or the remaining days if they are fewer. Ventilation
runs at 100 %, as in question 5a of the experiment.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final
from unittest.mock import patch
from zlib import crc32

import numpy as np
from examples.greenhouse_coop.env import (
    DAYS,
    MOST_WATER,
    OBSERVED,
    VENTILATOR,
    WATERER,
    GreenhouseSim,
)
from examples.greenhouse_coop.plan import BEST, LITRES, days_left, keep, water_planner
from examples.greenhouse_coop.train import HELD_OUT, Constant
from numpy.typing import NDArray

from simenv_marl.data import collect_episodes, record_dataset
from simenv_marl.planning import action_values

CANDIDATES: Final = np.array(LITRES, np.float32) / np.float32(MOST_WATER)

HORIZON: Final = 4
"""The planner's horizon in days: as long as a healthy plant survives in a dry pot."""

EPISODES: Final = 4
"""The number of greenhouses (episodes) per round."""

ASKED: Final = 0.25
"""The share of decisions in which the planner values all candidates."""

DRAWN: Final = 0.1
"""The share of decisions in which a random amount replaces the network's."""

TAUGHT, KEPT = 4, 2
"""The numbers of networks that a round trains, each from another initialisation, and keeps.

The networks with the lowest loss are kept, and their mean decides. Some networks collapse to a
constant amount and stay there.
"""

FIRST: Final = Constant(LITRES[len(LITRES) // 2] / MOST_WATER)
"""The waterer before any learning: the middle candidate."""


# -- policies -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Network:
    """A network that pours the expected amount, for one observation or a batch.

    It does without the library that trained it. Branches use it as the base policy, and forks are
    slow in a process that has imported a large library.

    Attributes:
        layers: For each network, the weights and biases of each layer.
    """

    layers: tuple[tuple[tuple[NDArray[np.float32], NDArray[np.float32]], ...], ...]

    def __call__(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Choose an action."""
        amounts = [self._probabilities(own, observation) @ CANDIDATES for own in self.layers]
        amount: NDArray[np.float32] = np.mean(amounts, axis=0)[..., None].astype(np.float32)
        return amount

    @staticmethod
    def _probabilities(layers: Any, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        hidden = observation
        for weights, biases in layers[:-1]:
            hidden = np.tanh(hidden @ weights + biases)
        weights, biases = layers[-1]
        scores = hidden @ weights + biases
        powers = np.exp(scores - scores.max(axis=-1, keepdims=True))
        shares: NDArray[np.float32] = powers / powers.sum(axis=-1, keepdims=True)
        return shares


@dataclass(frozen=True)
class Learner:
    """A waterer that acts by its base policy or at random, and sometimes values all candidates.

    Its extras are the candidates' ``values``, whether it has computed them (``asked``), and the
    ``days`` in branches.

    Attributes:
        base: The policy that acts, also in branches.
        seed: With the observation, the seed of the random draws.
        horizon: The number of days for which candidates are tried out.
    """

    base: Any
    seed: int
    horizon: int

    def __call__(self, observation: NDArray[np.float32], info: Any, *, _environment: Any) -> Any:
        """Choose an action."""
        rng = np.random.default_rng([self.seed, crc32(observation.tobytes())])
        action = self.base(observation)
        if rng.random() < DRAWN:
            action = np.array([rng.choice(CANDIDATES)], np.float32)
        asked, days, values = bool(rng.random() < ASKED), 0, np.zeros(len(CANDIDATES))
        if asked:
            candidates = [np.array([amount], np.float32) for amount in CANDIDATES]
            found = action_values(
                _environment,
                candidates,
                base=self.base,
                futures=1,
                horizon=self.horizon,
                terminal_value=days_left,
            )
            values = found.means
            day = _environment.simulation.greenhouse.day
            days = int(found.counts.sum()) * min(self.horizon, DAYS - day)
        return action, {"values": values, "asked": asked, "days": days}


# -- learning -------------------------------------------------------------------------------------


def teach(
    observations: NDArray[np.float32], values: NDArray[np.float64], steps: int, seed: int
) -> Network:
    """Train networks to prefer the candidates with the highest value.

    Args:
        observations: ``(decisions, 6)``.
        values: ``(decisions, candidates)``: the value of each candidate.
        steps: The number of training batches.
        seed: The seed of the initial weights and the batches.
    """
    import torch  # imported here, because processes that fork should not load it

    torch.set_num_threads(1)
    seen = torch.as_tensor(observations)
    losses = torch.as_tensor((values.max(axis=1, keepdims=True) - values).astype(np.float32))
    losses /= losses.mean()
    found = []
    for number in range(TAUGHT):
        torch.manual_seed(seed + number)
        network = torch.nn.Sequential(
            torch.nn.Linear(len(OBSERVED), 64), torch.nn.Tanh(),
            torch.nn.Linear(64, 64), torch.nn.Tanh(),
            torch.nn.Linear(64, len(CANDIDATES)),
        )  # fmt: skip
        optimizer = torch.optim.Adam(network.parameters(), 1e-3, weight_decay=1e-4)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
        for _ in range(steps):
            batch = torch.randint(len(seen), (256,))
            optimizer.zero_grad()
            (network(seen[batch]).softmax(dim=1) * losses[batch]).sum(dim=1).mean().backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 0.5)
            optimizer.step()
            schedule.step()
        with torch.no_grad():
            left = float((network(seen).softmax(dim=1) * losses).sum(dim=1).mean())
        linear = [layer for layer in network if isinstance(layer, torch.nn.Linear)]
        layers = tuple(
            (layer.weight.detach().numpy().T, layer.bias.detach().numpy()) for layer in linear
        )
        found.append((left, layers))
    return Network(tuple(layers for _, layers in sorted(found, key=lambda pair: pair[0])[:KEPT]))


@dataclass
class Course:
    """The result of a training run.

    Attributes:
        policy: The trained policy.
        days: The number of simulated days.
        rounds: After each round, the days so far and the mean return of the policy; empty unless
            requested.
    """

    policy: Any
    days: int
    rounds: list[tuple[int, float]]


def iterate(
    budget: int, seed: int, *, steps: int = 1500, workers: int = 2, watched: Sequence[int] = ()
) -> Course:
    """Run expert iteration.

    Args:
        budget: The number of days to simulate at most. The last round is the one after which
            another round, as long as the longest so far, would exceed the budget.
        seed: The seed of the run.
        steps: The number of training batches in each round.
        workers: The number of processes that plan.
        watched: Seeds of greenhouses for the evaluation after each round; they are not used for
            training.
    """
    rng = np.random.default_rng(seed)
    course = Course(FIRST, 0, [])
    observations: list[NDArray[np.float32]] = []
    values: list[NDArray[np.float64]] = []
    longest = 0
    while course.days + longest <= budget:
        drawn = [int(number) for number in rng.integers(HELD_OUT, size=EPISODES)]
        team = {
            WATERER: Learner(course.policy, int(rng.integers(2**31)), HORIZON),
            VENTILATOR: BEST[VENTILATOR],
        }
        found = collect_episodes(GreenhouseSim, team, seeds=drawn, workers=workers)[WATERER]
        asked = found.extras["asked"]
        observations.append(found.observations[asked])
        values.append(found.extras["values"][asked])
        spent = len(found) + int(found.extras["days"].sum())
        course.days += spent
        longest = max(longest, spent)
        course.policy = teach(
            np.concatenate(observations), np.concatenate(values), steps, int(rng.integers(2**31))
        )
        if watched:
            course.rounds.append((course.days, worth(course.policy, watched)))
    return course


def imitate_plainly(budget: int, seed: int, *, steps: int = 3000, workers: int = 2) -> Course:
    """Imitate the actions of a planner's demonstrations, for comparison.

    Args:
        budget: The number of days to simulate at most.
        seed: The seed of the run.
        steps: The number of training batches.
        workers: The number of processes that plan.
    """
    import minari
    import torch

    from .rule import clone

    torch.manual_seed(seed)
    torch.set_num_threads(1)
    planner = water_planner(FIRST, 3, 1)
    episodes = budget // (DAYS * (1 + 3 * len(CANDIDATES)))
    drawn = np.random.default_rng(seed).integers(HELD_OUT, size=episodes).tolist()
    name = "greenhouse/waterer-plan-v0"
    with (
        tempfile.TemporaryDirectory() as folder,
        patch.dict(os.environ, MINARI_DATASETS_PATH=folder),
    ):
        team = {WATERER: planner, VENTILATOR: BEST[VENTILATOR]}
        record_dataset({WATERER: name}, GreenhouseSim, team, seeds=drawn, workers=workers)
        dataset = minari.load_dataset(name)
        days = sum(int(episode.infos["days"].sum()) for episode in dataset) + int(
            dataset.total_steps
        )
        return Course(clone(dataset, steps), days, [])


def worth(policy: Any, seeds: Sequence[int]) -> float:
    """Compute the mean return of a policy that does not plan."""
    return float(keep({WATERER: policy, VENTILATOR: BEST[VENTILATOR]}, seeds).returns.mean())


def main(arguments: Sequence[str] | None = None) -> list[float]:
    """Train policies, and print their returns without planning.

    Returns:
        The final mean return of each policy.
    """
    parser = argparse.ArgumentParser(description="Train a network from plans by expert iteration.")
    parser.add_argument(
        "--budget", type=int, default=60_000, help="days to simulate (default: %(default)s)"
    )
    parser.add_argument(
        "--learners",
        type=int,
        nargs="+",
        default=[0, 1, 2],
        help="seeds of learners (default: 0 1 2)",
    )
    parser.add_argument(
        "--steps", type=int, default=1500, help="batches in each round (default: %(default)s)"
    )
    parser.add_argument(
        "--seeds", type=int, default=32, help="greenhouses to compare on (default: %(default)s)"
    )
    parser.add_argument("--workers", type=int, default=2, help="processes (default: %(default)s)")
    parser.add_argument(
        "--watch", action="store_true", help="evaluate each round, on other greenhouses"
    )
    parser.add_argument(
        "--plainly", action="store_true", help="imitate the planner's actions, for comparison"
    )
    options = parser.parse_args(arguments)
    watched = range(HELD_OUT + 10_000, HELD_OUT + 10_008) if options.watch else ()
    found = []
    for seed in options.learners:
        if options.plainly:
            course = imitate_plainly(
                options.budget, seed, steps=options.steps, workers=options.workers
            )
        else:
            course = iterate(
                options.budget, seed, steps=options.steps, workers=options.workers, watched=watched
            )
        found.append(worth(course.policy, range(HELD_OUT, HELD_OUT + options.seeds)))
        rounds = "".join(f" {days:,}: {value:.1f}" for days, value in course.rounds)
        print(
            (
                f"learner {seed}: {course.days:,} days, return"
                f" {found[-1]:.1f}{';' if rounds else ''}{rounds}"
            ),
            flush=True,
        )
    return found


if __name__ == "__main__":
    main()
