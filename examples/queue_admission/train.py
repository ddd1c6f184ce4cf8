"""Train job admission with Stable-Baselines3's DQN and PPO, discounted by time and by decision.

``python -m examples.queue_admission.train`` trains each learner three times by time, and DQN once
for each discount by decision. It evaluates each trained table of decisions exactly, and by
simulation, and writes ``out/results.csv`` beside this file, and
``docs/figures/queue-admission.png``. It needs Stable-Baselines3 2.7 or newer and SimPy (the extra
``clients``), and ten to thirty minutes.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
import torch
from gymnasium.wrappers import TransformReward
from matplotlib.figure import Figure
from stable_baselines3 import DQN, PPO

from simenv_marl import evaluate
from simenv_marl.data import TimedReplayBuffer, TimedRolloutBuffer

from .env import AGENT, QueueSimulation, env, observation
from .exact import ADMIT_ALL, DECISIONS, Table, best_table, worth

OUT: Final = Path(__file__).parent / "out" / "results.csv"
FIGURE: Final = Path(__file__).parents[2] / "docs" / "figures" / "queue-admission.png"

SCALE: Final = 0.1
"""A factor of the rewards: the Huber loss of DQN is the mean squared error only below 1."""

GAMMAS: Final = (0.5, 0.9, 0.99)
"""The discounts for each decision that are compared with the discount for the elapsed time."""

# -- training --------------------------------------------------------------------------------------


def _world() -> Any:
    return TransformReward(env(), lambda reward: SCALE * float(reward))


def train_dqn(seed: int, steps: int = 60_000, gamma: float | None = None) -> Any:
    """Train DQN.

    ``gamma`` is a discount for each decision; None: the discount of the elapsed time.
    """
    timed: dict[str, Any] = (
        {"replay_buffer_class": TimedReplayBuffer} if gamma is None else {"gamma": gamma}
    )
    learner = DQN(
        "MlpPolicy",
        _world(),
        learning_rate=lambda left: 1e-3 * left,
        batch_size=256,
        target_update_interval=1_000,
        exploration_fraction=0.3,
        exploration_final_eps=0.2,
        seed=seed,
        **timed,
    )
    return learner.learn(steps)


def train_ppo(seed: int, steps: int = 120_000) -> Any:
    """Train PPO with the discount of the elapsed time."""
    learner = PPO(
        "MlpPolicy",
        _world(),
        learning_rate=lambda left: 1e-3 * left,
        batch_size=256,
        gae_lambda=0.9,
        ent_coef=0.003,
        seed=seed,
        rollout_buffer_class=TimedRolloutBuffer,
    )
    return learner.learn(steps)


def policy_of(learner: Any) -> Callable[[Any], Any]:
    """Return the trained policy without exploration, for one observation or many."""
    return lambda observations: learner.predict(observations, deterministic=True)[0]


def table_of(learner: Any) -> Table:
    """Return what a trained policy decides, for each decision that there is."""
    actions = policy_of(learner)(np.stack([observation(decision) for decision in DECISIONS]))
    return dict(zip(DECISIONS, map(bool, actions), strict=True))


# -- results ---------------------------------------------------------------------------------------


def simulated(policies: dict[str, Any], runs: int) -> Any:
    """Return each policy's mean present value on the same seeds, its interval, and its gain.

    The gain is the difference to the rule.
    """
    found = evaluate(
        QueueSimulation,
        {"rule": {}, **{name: {AGENT: policy} for name, policy in policies.items()}},
        seeds=range(1_000_000, 1_000_000 + runs),
        metric={"present value": lambda simulation: simulation.model.present_value()},
        baseline="rule",
        batched=True,
    )
    return found.summary(metric="present value")


def draw(tables: dict[str, Table], path: Path) -> None:
    """Draw which jobs are admitted in which state, a row for each table."""
    figure = Figure(figsize=(9, 0.35 * len(tables) + 1.2), layout="constrained")
    axes = figure.subplots()
    rows = [[table[decision] for decision in DECISIONS] for table in tables.values()]
    axes.pcolormesh(rows, cmap="Blues", vmin=-0.2, vmax=1.4, edgecolors="white", linewidth=2)
    axes.invert_yaxis()
    axes.set_yticks(
        np.arange(len(tables)) + 0.5,
        [f"{name}: {worth(table):.2f}" for name, table in tables.items()],
    )
    labels = [
        f"{'AB'[kind]} comes\n{'idle' if serving is None else 'AB'[serving] + ' served'}\n"
        + " ".join([*["A waits"] * a, *["B waits"] * b])
        for kind, (a, b, serving) in DECISIONS
    ]
    axes.set_xticks(np.arange(len(DECISIONS)) + 0.5, labels, fontsize=7)
    axes.set_title("Dark: admitted; light: rejected", fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)


def main(arguments: Sequence[str] | None = None) -> None:
    """Train, evaluate, and write the results."""
    parser = argparse.ArgumentParser(description="Train the admission of jobs.")
    parser.add_argument(
        "--seeds", type=int, default=3, help="trainings of each learner (default: %(default)s)"
    )
    parser.add_argument(
        "--steps", type=int, help="decisions of a training (default: 60,000 of DQN, 120,000 of PPO)"
    )
    parser.add_argument(
        "--runs", type=int, default=200, help="paired simulations of each (default: %(default)s)"
    )
    parser.add_argument(
        "--out", type=Path, default=OUT, help="file for the results (default: %(default)s)"
    )
    parser.add_argument(
        "--figure", type=Path, default=FIGURE, help="file for the figure (default: %(default)s)"
    )
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    steps = {} if options.steps is None else {"steps": options.steps}
    trainings: list[tuple[str, Callable[[int], Any], int]] = [
        ("DQN, by time", partial(train_dqn, **steps), options.seeds),
        ("PPO, by time", partial(train_ppo, **steps), options.seeds),
    ]
    for gamma in GAMMAS:
        trainings.append((f"DQN, {gamma} a decision", partial(train_dqn, gamma=gamma, **steps), 1))
    rows, tables, optimum = [], {"optimum": best_table()}, worth(best_table())
    print(
        f"optimum {optimum:.3f}; all admitted {worth(ADMIT_ALL):.3f},"
        f" {worth(ADMIT_ALL) / optimum:.3f} of it"
    )
    for name, train, number in trainings:
        learners = [train(seed) for seed in range(number)]
        found = simulated(
            {str(seed): policy_of(learner) for seed, learner in enumerate(learners)}, options.runs
        )
        made = [table_of(learner) for learner in learners]
        for seed, table in enumerate(made):
            exact = {"exact": round(worth(table), 4), "share": round(worth(table) / optimum, 4)}
            admitted = "".join(str(int(answer)) for answer in table.values())
            paired = found.loc[
                str(seed), ["mean", "difference", "difference_low", "difference_high"]
            ].astype(float)
            rows.append(
                {"training": name, "seed": seed, **exact, "admitted": admitted, **paired.round(3)}
            )
            print(rows[-1], flush=True)
        tables[name] = sorted(made, key=worth)[len(made) // 2]
    options.out.parent.mkdir(parents=True, exist_ok=True)
    pd.DataFrame(rows).to_csv(options.out, index=False)
    draw(tables, options.figure)


if __name__ == "__main__":
    main()
