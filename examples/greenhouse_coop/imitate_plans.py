"""From plans to a policy that decides at once: a network learns from a planner, which plans over the network.

``python -m examples.greenhouse_coop.imitate_plans`` does so in rounds (expert iteration; Anthony, Tian and Barber,
2017), until a budget of simulated days is spent, and lets the network keep the greenhouses of ``make demo`` without
planning. It needs ``pip install "simenv-marl[many]" torch``.

The planner knows all of the greenhouse, since it tries out. The network sees six numbers of it. A network that imitates
what the planner has poured goes to ruin: the planner pours as late as each plant can bear, and the network cannot tell
when that is. So it learns what every candidate was worth, and pours what is worth most by what it sees:

- The network acts, and in a tenth of its decisions an amount is drawn in its place, so that it is in greenhouses as it
  is going to have them (Ross, Gordon and Bagnell, 2011).
- In a quarter of its decisions, ``action_values`` tries out all candidates, with the network as the base.
- The network gives each candidate a probability, and is taught to make the expected worth as great as possible. What it
  pours is the expected amount.

``--plainly`` has the planner demonstrate at the same price, and imitates what it has poured, by the cloning of the
module ``imitate``, for comparison.

All simulated days are counted: those of the episodes, as many as they had, and those of the branches, which are
candidates times futures times the horizon, or the days that are left. Ventilation is at full, as in question 5a of the
experiment.
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
from numpy.typing import NDArray

from simenv_marl import action_values, collect_episodes, record_dataset

from .env import DAYS, MOST_WATER, OBSERVED, GreenhouseSim
from .plan import BEST, HELD_OUT, LITRES, VENTILATOR, WATERER, Constant, days_left, keep, water_planner

CANDIDATES: Final = np.array(LITRES, np.float32) / np.float32(MOST_WATER)

HORIZON: Final = 4
"""For how many days candidates are tried out: as many as a healthy plant survives in a dry pot."""

EPISODES: Final = 4
"""How many greenhouses are kept in a round."""

ASKED: Final = 0.25
"""In which share of its decisions it is found out what candidates are worth."""

DRAWN: Final = 0.1
"""In which share of its decisions another amount is poured than the network would."""

TAUGHT, KEPT = 4, 2
"""How many are taught in each round, each from other beginnings, and how many of them decide, by their mean: those
that have learnt best what they were taught. Some come to pour the same whatever they see, and stay with that."""

FIRST: Final = Constant(LITRES[len(LITRES) // 2] / MOST_WATER)
"""Who waters before anything was learnt: the candidate in the middle."""


# -- policies -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Network:
    """Pours the expected amount, for one observation or for many, without the library that has taught it.

    It is a base in branches, and a process that has imported a large library is forked slowly.

    Attributes:
        layers: By network, the weights and biases of each layer.
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
    """Waters as it has learnt, at times as it is drawn, and finds out at times what candidates are worth.

    Its extras are what they are worth, ``values``, whether that was found out, ``asked``, and the ``days`` of branches.

    Attributes:
        base: How it waters, and how branches go on.
        seed: With the observation, determines what is drawn.
        horizon: For how many days candidates are tried out.
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
                _environment, candidates, base=self.base, futures=1, horizon=self.horizon, terminal_value=days_left
            )
            values = found.means
            day = _environment.simulation.greenhouse.day
            days = int(found.counts.sum()) * min(self.horizon, DAYS - day)
        return action, {"values": values, "asked": asked, "days": days}


# -- learning -------------------------------------------------------------------------------------


def teach(observations: NDArray[np.float32], values: NDArray[np.float64], steps: int, seed: int) -> Network:
    """Teach networks to prefer what is worth most.

    Args:
        observations: ``(decisions, 6)``.
        values: ``(decisions, candidates)``: what each candidate was worth.
        steps: For how many batches.
        seed: Determines how they begin, and the batches.
    """
    import torch  # here, and not in the processes that fork

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
        layers = tuple((layer.weight.detach().numpy().T, layer.bias.detach().numpy()) for layer in linear)
        found.append((left, layers))
    return Network(tuple(layers for _, layers in sorted(found, key=lambda pair: pair[0])[:KEPT]))


@dataclass
class Course:
    """How learning has gone.

    Attributes:
        policy: What was learnt.
        days: How many were simulated.
        rounds: After each round, the days so far and the mean return with the policy, where that was asked for.
    """

    policy: Any
    days: int
    rounds: list[tuple[int, float]]


def iterate(budget: int, seed: int, *, steps: int = 1500, workers: int = 2, watched: Sequence[int] = ()) -> Course:
    """Learn from plans over what was learnt.

    Args:
        budget: How many days may be simulated. There is no round more that would go beyond it if it was as long as
            the longest so far.
        seed: Determines everything.
        steps: For how many batches networks are taught in each round.
        workers: How many processes plan.
        watched: Seeds of greenhouses on which each round is judged. Nothing is learnt from them.
    """
    rng = np.random.default_rng(seed)
    course = Course(FIRST, 0, [])
    observations: list[NDArray[np.float32]] = []
    values: list[NDArray[np.float64]] = []
    longest = 0
    while course.days + longest <= budget:
        drawn = [int(number) for number in rng.integers(HELD_OUT, size=EPISODES)]
        team = {WATERER: Learner(course.policy, int(rng.integers(2**31)), HORIZON), VENTILATOR: BEST[VENTILATOR]}
        found = collect_episodes(GreenhouseSim, team, seeds=drawn, workers=workers)[WATERER]
        asked = found.extras["asked"]
        observations.append(found.observations[asked])
        values.append(found.extras["values"][asked])
        spent = len(found) + int(found.extras["days"].sum())
        course.days += spent
        longest = max(longest, spent)
        course.policy = teach(np.concatenate(observations), np.concatenate(values), steps, int(rng.integers(2**31)))
        if watched:
            course.rounds.append((course.days, worth(course.policy, watched)))
    return course


def imitate_plainly(budget: int, seed: int, *, steps: int = 3000, workers: int = 2) -> Course:
    """Have the planner demonstrate, and imitate what it has poured: for comparison.

    Args:
        budget: How many days may be simulated.
        seed: Determines everything.
        steps: For how many batches the network is taught.
        workers: How many processes plan.
    """
    import minari
    import torch

    from .imitate import clone

    torch.manual_seed(seed)
    torch.set_num_threads(1)
    planner = water_planner(FIRST, 3, 1)
    episodes = budget // (DAYS * (1 + 3 * len(CANDIDATES)))
    drawn = np.random.default_rng(seed).integers(HELD_OUT, size=episodes).tolist()
    name = "greenhouse/waterer-plan-v0"
    with tempfile.TemporaryDirectory() as folder, patch.dict(os.environ, MINARI_DATASETS_PATH=folder):
        team = {WATERER: planner, VENTILATOR: BEST[VENTILATOR]}
        record_dataset({WATERER: name}, GreenhouseSim, team, seeds=drawn, workers=workers)
        dataset = minari.load_dataset(name)
        days = sum(int(episode.infos["days"].sum()) for episode in dataset) + int(dataset.total_steps)
        return Course(clone(dataset, steps), days, [])


def worth(policy: Any, seeds: Sequence[int]) -> float:
    """The mean return with a policy that does not plan."""
    return float(keep({WATERER: policy, VENTILATOR: BEST[VENTILATOR]}, seeds).returns.mean())


def main(arguments: Sequence[str] | None = None) -> list[float]:
    """Learn, and tell what the policies are worth without planning.

    Returns:
        What each was worth in the end.
    """
    parser = argparse.ArgumentParser(description="Learn from plans.")
    parser.add_argument("--budget", type=int, default=60_000, help="days to simulate (default: %(default)s)")
    parser.add_argument("--learners", type=int, nargs="+", default=[0, 1, 2], help="their seeds (default: 0 1 2)")
    parser.add_argument("--steps", type=int, default=1500, help="batches in each round (default: %(default)s)")
    parser.add_argument("--seeds", type=int, default=32, help="greenhouses to compare on (default: %(default)s)")
    parser.add_argument("--workers", type=int, default=2, help="processes (default: %(default)s)")
    parser.add_argument("--watch", action="store_true", help="judge each round, on other greenhouses")
    parser.add_argument("--plainly", action="store_true", help="imitate what was poured, for comparison")
    options = parser.parse_args(arguments)
    watched = range(HELD_OUT + 10_000, HELD_OUT + 10_008) if options.watch else ()
    found = []
    for seed in options.learners:
        if options.plainly:
            course = imitate_plainly(options.budget, seed, steps=options.steps, workers=options.workers)
        else:
            course = iterate(options.budget, seed, steps=options.steps, workers=options.workers, watched=watched)
        found.append(worth(course.policy, range(HELD_OUT, HELD_OUT + options.seeds)))
        rounds = "".join(f" {days:,}: {value:.1f}" for days, value in course.rounds)
        print(
            f"learner {seed}: {course.days:,} days, return {found[-1]:.1f}{';' if rounds else ''}{rounds}", flush=True
        )
    return found


if __name__ == "__main__":
    main()
