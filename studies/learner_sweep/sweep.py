"""Hyperparameters as factors: a sweep that resumes, and a search with Optuna.

Both cover the same hyperparameters.

A training run is a simulation like any other: its factors are the learner's hyperparameters, its
seed is the seed of the training, and a metric evaluates it after its end. So ``run_experiment`` can
sweep learners without changes. Here Stable-Baselines3's PPO learns to water the greenhouse.

``python -m studies.learner_sweep.sweep`` needs the extra ``clients``. It runs the sweep, then the
search, and then trains anew with the best hyperparameters and with PPO's defaults, on new seeds. A
folder keeps all results, so that a second call runs only what is missing.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import optuna
from examples.greenhouse_coop.env import WATERING, GreenhouseSim, watering_env
from gymnasium.wrappers import RescaleAction
from optuna.trial import TrialState
from stable_baselines3 import PPO

from simenv_marl import evaluate, simulate
from simenv_marl.experiments import design, effects, run_experiment

if TYPE_CHECKING:
    from pandas import DataFrame

OUT: Final = Path(__file__).parent / "out"

LEVELS: Final = {"learning_rate": [3e-4, 1e-3, 3e-3], "gamma": [0.8, 0.9, 0.99]}
"""The levels of the sweep.

PPO's defaults are the first learning rate and the last discount factor.
"""

SEEDS: Final = range(3)
"""The seeds of training runs."""

HELD_OUT: Final = 1000
"""The first of the seeds for the evaluation."""


class Training:
    """A training run, as a simulation.

    Attributes:
        found: A row of ``Evaluation.summary``: the trained waterer compared with the model's rule.
    """

    def __init__(self, days: int, held_out: int = HELD_OUT, **settings: Any) -> None:
        """Store the factors.

        Args:
            days: The length of the training.
            held_out: The first of the 16 seeds of the evaluation.
            **settings: Settings of PPO.
        """
        self.days, self.held_out, self.settings = days, held_out, settings

    def reset(self, seed: int | None = None) -> None:
        """Make an untrained learner."""
        env = RescaleAction(watering_env(), np.float32(-1), np.float32(1))
        self.model = PPO("MlpPolicy", env, n_steps=250, batch_size=125, seed=seed, **self.settings)

    def run(self) -> None:
        """Train the learner, and compare it with the rule in the same weather."""
        self.model.learn(self.days)
        contenders = {"rule": {}, "trained": {"waterer_0": self.decide}}
        seeds = range(self.held_out, self.held_out + 16)
        judged = evaluate(GreenhouseSim, contenders, seeds=seeds, points=WATERING, baseline="rule")
        self.found = judged.summary().loc["trained"]

    def decide(self, observation: Any) -> Any:
        """Return the learned action."""
        return (self.model.predict(observation, deterministic=True)[0] + 1) / 2


GAIN: Final = {
    "gain": lambda training: training.found["difference"],
    "gain_low": lambda training: training.found["difference_low"],
    "gain_high": lambda training: training.found["difference_high"],
}
"""The gain over the rule, with its interval over the seeds of the evaluation."""

# Learners seed the process's global generators; global_rng=True separates those of each training.
experiment = partial(run_experiment, Training, metric=GAIN, global_rng=True)


def sweep(folder: Path, days: int, seeds: Sequence[int] = SEEDS, workers: int = 0) -> DataFrame:
    """Train with all combinations of the hyperparameters, on all seeds."""
    rows = design({**LEVELS, "days": [days]})
    return experiment(rows, seeds=seeds, store=folder / "sweep", workers=workers, progress=True)


def search(folder: Path, days: int, trials: int, seeds: Sequence[int] = SEEDS) -> optuna.Study:
    """Let Optuna search for better settings within the range of the sweep."""

    def objective(trial: optuna.Trial) -> float:
        rate = trial.suggest_float("learning_rate", 3e-4, 1e-2, log=True)
        gamma = trial.suggest_float("gamma", 0.5, 0.99)
        found = []
        for step, seed in enumerate(seeds):  # a single training may be lucky
            training = Training(days, learning_rate=rate, gamma=gamma)
            found.append(simulate(training, seed=seed, global_rng=True).found)
            mean = float(np.mean([own["difference"] for own in found]))
            intervals = [[own["difference_low"], own["difference_high"]] for own in found]
            trial.set_user_attr("intervals", intervals)
            trial.report(mean, step)
            if trial.should_prune():  # do not train again with settings that are worse than most
                raise optuna.TrialPruned
        return mean

    storage = f"sqlite:///{folder / 'search.db'}"
    name = f"{days} days, {len(seeds)} seeds"
    study = optuna.create_study(
        storage=storage,
        study_name=name,
        load_if_exists=True,
        direction="maximize",
    )
    # a resumed search draws other settings
    study.sampler = optuna.samplers.TPESampler(seed=len(study.trials))
    done = len(study.get_trials(states=(TrialState.COMPLETE, TrialState.PRUNED)))
    study.optimize(objective, n_trials=max(0, trials - done))
    return study


def confirm(
    folder: Path, days: int, settings: dict[str, float], seeds: Sequence[int], workers: int = 0
) -> DataFrame:
    """Train and evaluate on new seeds, because the best of many trials is partly best by chance."""
    rows = [{"learning_rate": 3e-4, "gamma": 0.99}, settings]
    fresh = [{**row, "days": days, "held_out": 2 * HELD_OUT} for row in rows]
    return experiment(fresh, seeds=seeds, store=folder / "confirmed", workers=workers)


def main(arguments: Sequence[str] | None = None) -> None:
    """Sweep, search, and confirm."""
    parser = argparse.ArgumentParser(description="Search for the hyperparameters of a learner.")
    parser.add_argument(
        "--out", type=Path, default=OUT, help="folder for results (default: %(default)s)"
    )
    parser.add_argument(
        "--days", type=int, default=3000, help="days per training (default: %(default)s)"
    )
    parser.add_argument(
        "--seeds", type=int, default=3, help="trainings per setting (default: %(default)s)"
    )
    parser.add_argument(
        "--trials", type=int, default=12, help="trials of Optuna (default: %(default)s)"
    )
    parser.add_argument(
        "--workers", type=int, default=0, help="worker processes of the sweep (default: none)"
    )
    options = parser.parse_args(arguments)
    folder, days, seeds = options.out, options.days, range(options.seeds)
    folder.mkdir(parents=True, exist_ok=True)
    table = sweep(folder, days, seeds, options.workers)
    found = effects(table, "gain")
    print(found.main.round(1), found.cells("learning_rate", "gamma").round(1), sep="\n\n")
    study = search(folder, days, options.trials, seeds)
    print(f"\nfound by Optuna: {study.best_params}, worth {study.best_value:.1f}")
    fresh = confirm(
        folder, days, study.best_params, range(100, 100 + options.seeds), options.workers
    )
    print(fresh.groupby(list(LEVELS))["gain"].agg(["mean", "min", "max"]).round(1))


if __name__ == "__main__":
    main()
