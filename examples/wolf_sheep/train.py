"""Train one shared policy for all sheep, by PPO on the trajectories of ``collect_episodes``.

The losses are TorchRL's. ``python -m examples.wolf_sheep.train`` trains it with several seeds, for
sheep with the sight of the model's rule and for sheep that see one step farther. It writes the
policies to ``out/`` beside this file and the learning curves to
``docs/figures/shared-policy-training.csv``. It needs TorchRL (the extra ``clients``).

Hundreds of sheep, most of them born during the episode, need no more code than one: each call of
the policy answers all waiting decisions, and each sheep's life is one trajectory. The same seed
gives the same policy, on the same machine with the same versions.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from tqdm import tqdm  # type: ignore[import-untyped]

from simenv_marl.data import Trajectories, collect_episodes

from .env import DIRECTIONS, MOVE, Meadow, cells, sheep_points

HELD_OUT: Final = 1_000_000
"""Seeds from this number on are for the final comparison; those below it are for learning."""

SIGHTS: Final = (1, 2)
"""The ranges of sight, in steps: that of the model's rule, and one step farther."""

TICKS: Final = 100
"""The length of training episodes, half of that in the comparison."""

OUT: Final = Path(__file__).parent / "out"
CURVES: Final = Path(__file__).parents[2] / "docs" / "figures" / "shared-policy-training.csv"

DISCOUNT: Final = 0.98
EPOCHS: Final = 4
MINIBATCH: Final = 2048


# -- the policy -----------------------------------------------------------------------------------


class Compressed(nn.Module):
    """A layer that compresses the range of the observations: energies and flocks may be large."""

    def forward(self, observations: Any) -> Any:
        """Compress the observations."""
        return observations.clamp(min=0).log1p()


def network(sight: int, outputs: int) -> Any:
    """Make a network from sheep's observations to a number of outputs."""
    inputs = 1 + 3 * len(cells(sight))
    return nn.Sequential(
        Compressed(),
        nn.Linear(inputs, 64),
        nn.Tanh(),
        nn.Linear(64, 64),
        nn.Tanh(),
        nn.Linear(64, outputs),
    )


class Herd:
    """The shared networks of all sheep: a policy and a value function.

    Attributes:
        sight: The range of sight, in steps.
        logits: The policy's network.
        values: The value network.
    """

    def __init__(self, sight: int, seed: int) -> None:
        """Make untrained networks.

        Args:
            sight: The range of sight, in steps.
            seed: The seed of the weights and of exploration.
        """
        self.sight = sight
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self.logits = network(sight, len(DIRECTIONS))
            self.values = network(sight, 1)
            with torch.no_grad():
                self.logits[-1].weight *= 0.01  # equal probabilities at first
        self._generator = torch.Generator().manual_seed(seed)

    def explore(self, observations: NDArray[np.float32]) -> tuple[Any, dict[str, Any]]:
        """Draw the actions of many sheep; also return the log-probability of each."""
        with torch.no_grad():
            likely = self.logits(torch.from_numpy(observations)).log_softmax(-1)
            actions = torch.multinomial(likely.exp(), 1, generator=self._generator)
            return actions[:, 0], {"log_prob": likely.gather(1, actions)[:, 0]}

    def decide(self, observations: NDArray[np.float32]) -> Any:
        """Return the most likely actions of many sheep."""
        with torch.no_grad():
            return self.logits(torch.from_numpy(observations)).argmax(-1)

    def save(self, path: Path) -> None:
        """Write the networks to a file."""
        path.parent.mkdir(parents=True, exist_ok=True)
        torch.save({"logits": self.logits.state_dict(), "values": self.values.state_dict()}, path)

    @classmethod
    def load(cls, path: Path, sight: int) -> Self:
        """Read the networks from a file."""
        herd = cls(sight, 0)
        saved = torch.load(path, weights_only=True)
        herd.logits.load_state_dict(saved["logits"])
        herd.values.load_state_dict(saved["values"])
        return herd


# -- learning -------------------------------------------------------------------------------------


def tensors(found: Trajectories) -> Any:
    """Convert trajectories for TorchRL: ``done`` marks every end, ``terminated`` an end by death.

    Rewards are scaled so that the value of an endless life is 1.
    """

    def column(values: NDArray[Any]) -> Any:
        return torch.from_numpy(values)[:, None]

    return TensorDict(
        {
            "observation": torch.from_numpy(found.observations),
            "action": torch.from_numpy(found.actions),
            "log_prob": torch.from_numpy(found.extras["log_prob"]),
            "next": {
                "observation": torch.from_numpy(found.next_observations),
                "reward": column((1 - DISCOUNT) * found.rewards).float(),
                "terminated": column(found.terminations),
                "done": column(found.terminations | found.truncations),
            },
        },
        [len(found)],
    )


class Learner:
    """PPO for a herd."""

    def __init__(self, herd: Herd, seed: int) -> None:
        """Make the losses.

        Args:
            herd: The networks to train.
            seed: The seed of the order of minibatches.
        """
        actor = ProbabilisticActor(
            TensorDictModule(herd.logits, ["observation"], ["logits"]),
            in_keys=["logits"],
            distribution_class=torch.distributions.Categorical,
            return_log_prob=True,
        )
        critic = ValueOperator(herd.values, ["observation"])
        self._advantage = GAE(gamma=DISCOUNT, lmbda=0.95, value_network=critic)
        self._loss = ClipPPOLoss(
            actor,
            critic,
            entropy_coeff=0.005,
            critic_coeff=1.0,
            normalize_advantage=True,
            loss_critic_type="l2",
        )
        self._loss.set_keys(sample_log_prob="log_prob")
        self._optimizer = torch.optim.Adam(self._loss.parameters(), lr=1e-3, eps=1e-5)
        self._generator = torch.Generator().manual_seed(seed)

    def learn(self, found: Trajectories) -> None:
        """Update the policy from trajectories that ``Herd.explore`` has collected."""
        rows = tensors(found)
        with torch.no_grad():
            self._advantage(rows)
        for _ in range(EPOCHS):
            for part in torch.randperm(len(rows), generator=self._generator).split(MINIBATCH):
                losses = self._loss(rows[part])
                total = losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]
                self._optimizer.zero_grad()
                total.backward()
                nn.utils.clip_grad_norm_(self._loss.parameters(), 0.5)
                self._optimizer.step()


@dataclass(frozen=True)
class Progress:
    """The statistics of the episodes of one update, with exploration.

    Attributes:
        sight: The range of sight, in steps.
        seed: The seed of the training run.
        update: The number of the update.
        decisions: The number of decisions in earlier updates.
        sheep: The mean number of sheep over all ticks.
        life: The number of turns per death: the life expectancy of a sheep.
        survived: The share of episodes with sheep at the end.
    """

    sight: int
    seed: int
    update: int
    decisions: int
    sheep: float
    life: float
    survived: float


def train(
    sight: int,
    seed: int,
    *,
    decisions: int,
    each: int = 20_000,
    ticks: int = TICKS,
    tell: Callable[[Progress], None] = lambda progress: None,
    **parameters: Any,
) -> tuple[Herd, list[Progress]]:
    """Train a policy.

    Args:
        sight: The range of sight, in steps.
        seed: The seed of the training run.
        decisions: The number of decisions after which training stops.
        each: The approximate number of decisions per update.
        ticks: The length of an episode.
        tell: A function that is called after each update.
        **parameters: The parameters that differ from the defaults of Mesa's model.
    """
    herd = Herd(sight, seed)
    learner = Learner(herd, seed)
    meadow = partial(Meadow, ticks, only_with_sheep=True, **parameters)
    drawn = np.random.default_rng(seed)
    lived = 0
    course: list[Progress] = []
    number = 32
    while lived < decisions:
        seeds = drawn.integers(HELD_OUT, size=number)
        found = collect_episodes(
            meadow, {MOVE: herd.explore}, points=sheep_points(sight), seeds=seeds
        )[MOVE]
        learner.learn(found)
        survivors = np.unique(found.episodes[found.truncations])
        course.append(
            Progress(
                sight=sight,
                seed=seed,
                update=len(course),
                decisions=lived,
                sheep=len(found) / (number * ticks),
                life=len(found) / max(1, int(found.terminations.sum())),
                survived=len(survivors) / number,
            )
        )
        tell(course[-1])
        lived += len(found)
        # longer lives need fewer episodes per update; the minimum keeps some variety
        number = int(np.clip(each * number / len(found), 8, 64))
    return herd, course


# -- command line ---------------------------------------------------------------------------------


def path_of(sight: int, seed: int, folder: Path = OUT) -> Path:
    """Return the file of a policy."""
    return folder / f"sight-{sight}-seed-{seed}.pt"


def policies_of(sight: int, folder: Path = OUT) -> list[Path]:
    """Return the files of all policies for a range of sight, in the order of their seeds."""
    return sorted(
        folder.glob(f"sight-{sight}-seed-*.pt"), key=lambda path: int(path.stem.rpartition("-")[2])
    )


def write(course: Iterable[Progress], path: Path = CURVES) -> None:
    """Write the learning curves as CSV."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(
            file, [field.name for field in fields(Progress)], lineterminator="\n"
        )
        writer.writeheader()
        for progress in course:
            row = asdict(progress)
            writer.writerow(
                {
                    name: f"{value:.4g}" if isinstance(value, float) else value
                    for name, value in row.items()
                }
            )


def main(arguments: Sequence[str] | None = None) -> None:
    """Train all policies."""
    parser = argparse.ArgumentParser(description="Train one shared policy for all sheep.")
    parser.add_argument(
        "--seeds", type=int, default=3, help="number of training runs (default: %(default)s)"
    )
    parser.add_argument(
        "--decisions",
        type=int,
        default=300_000,
        help="decisions per training (default: %(default)s)",
    )
    parser.add_argument(
        "--ticks", type=int, default=TICKS, help="ticks per episode (default: %(default)s)"
    )
    parser.add_argument(
        "--sight", type=int, nargs="+", default=SIGHTS, help="ranges of sight (default: 1 2)"
    )
    parser.add_argument(
        "--out", type=Path, default=OUT, help="folder for the policies (default: beside this file)"
    )
    parser.add_argument(
        "--curves",
        type=Path,
        default=CURVES,
        help="file for learning curves (default: %(default)s)",
    )
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    course: list[Progress] = []
    for seed in range(options.seeds):
        for sight in options.sight:
            with tqdm(
                total=options.decisions, unit="decision", desc=f"sight {sight}, seed {seed}"
            ) as bar:

                def tell(progress: Progress, bar: Any = bar) -> None:
                    bar.set_postfix(sheep=f"{progress.sheep:.1f}", life=f"{progress.life:.1f}")
                    bar.update(progress.decisions - bar.n)

                herd, own = train(
                    sight, seed, decisions=options.decisions, ticks=options.ticks, tell=tell
                )
            herd.save(path_of(sight, seed, options.out))
            course += own
            write(course, options.curves)


if __name__ == "__main__":
    main()
