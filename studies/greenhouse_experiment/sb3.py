"""Questions 1, 2, 3 and 5, answered by Stable-Baselines3's PPO.

``python -m studies.greenhouse_experiment.sb3``

Questions differ in their environment alone. Learning is the same for all of them:

- Gymnasium's wrapper rescales actions from [-1, 1], as the library recommends.
- The library's ``VecNormalize`` divides rewards by the standard deviation of returns. Observations
  stay as they are, between 0 and 1.
- The standard deviation of actions starts at 0.37 instead of 1 (``log_std_init``). With 1, nearly a
  third of all actions would lie outside the space and be clipped to its bounds.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, Final

import gymnasium
import numpy as np
import torch
from examples.greenhouse_coop.env import (
    VENTILATION,
    WATERING,
    GreenhouseSim,
    joint_env,
    ventilation_env,
    watering_env,
)
from examples.greenhouse_coop.train import Team
from gymnasium.wrappers import RescaleAction
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from simenv_marl import single_env

from .questions import Act, Verdict, team_of
from .runs import Log, Run, carry_out, parser

LIBRARY: Final = "sb3"

GREENHOUSES: Final = 16
"""The number of parallel environments for training."""

SETTINGS: Final[dict[str, Any]] = {
    "learning_rate": 3e-4,
    "n_steps": 64,
    "batch_size": 128,
    "n_epochs": 10,
    "gamma": 0.99,
    "gae_lambda": 0.95,
    "clip_range": 0.2,
    "ent_coef": 0.0,
    "policy_kwargs": {"net_arch": [64, 64], "log_std_init": -1.0},
}

DAYS_A_POINT: Final = 5 * GREENHOUSES * SETTINGS["n_steps"]
"""The number of days between two points of the learning curve."""

POINTS: Final = WATERING | VENTILATION


def environment(run: Run, fixed: Team) -> gymnasium.Env[Any, Any]:
    """Make the environment of a question: a view of the same simulation.

    Args:
        run: The run.
        fixed: The fixed policies, by agent.
    """
    match run.question:
        case "1":
            return watering_env()
        case "2":
            return ventilation_env()
        case "3":
            return joint_env(flatten=True)
        case _:
            return single_env(GreenhouseSim, POINTS, policies=fixed)


def fixed_in(run: Run) -> Team:
    """Return the fixed policies of a run: constants, or the policy that another run has trained."""
    return load(run.of(run.asked.needs)) if run.asked.needs else run.asked.fixed


def learn(run: Run) -> Verdict:
    """Train for a run, and evaluate the result."""
    torch.set_num_threads(1)
    fixed = fixed_in(run)

    def make() -> gymnasium.Env[Any, Any]:
        return RescaleAction(environment(run, fixed), np.float32(-1), np.float32(1))

    greenhouses = VecNormalize(
        DummyVecEnv([make] * GREENHOUSES), norm_obs=False, gamma=SETTINGS["gamma"]
    )
    model = PPO("MlpPolicy", greenhouses, seed=run.seed, device="cpu", **SETTINGS)
    team = {**fixed, **team_of(run.asked, partial(act, model))}
    log = Log(run, {"greenhouses": GREENHOUSES, **SETTINGS})
    log.judge(0, team)
    while model.num_timesteps < run.budget:
        days = min(DAYS_A_POINT, run.budget - model.num_timesteps)
        # in whole rollouts: the last one may exceed the budget
        model.learn(days, reset_num_timesteps=False)
        log.judge(model.num_timesteps, team)
    model.save(run.stem.with_suffix(".zip"))
    greenhouses.close()
    return log.close(model.num_timesteps, team)


def act(model: PPO, observation: NDArray[np.float32]) -> NDArray[np.float32]:
    """Compute a model's actions without exploration.

    Args:
        model: The model.
        observation: The observation of one agent, float32 ``(6,)``. The joint agent decides at the
            beginning of a day, when both of its parts observe the same.
    """
    (size,) = model.observation_space.shape
    actions, _ = model.predict(np.tile(observation, size // len(observation)), deterministic=True)
    return np.asarray(np.clip((actions + 1) / 2, 0, 1), np.float32)


def load(run: Run) -> Team:
    """Load the team that a run has trained."""
    path = run.stem.with_suffix(".zip")
    if not path.exists():
        raise SystemExit(
            f"{path} is missing: question {run.question} of seed {run.seed} has to be answered"
            " first"
        )
    learnt: Act = partial(act, PPO.load(path, device="cpu"))
    return {**fixed_in(run), **team_of(run.asked, learnt)}


def main(arguments: Sequence[str] | None = None) -> None:
    """Carry out the missing runs."""
    questions = ("1", "2", "3", "5a", "5b", "5c")
    options = parser(__doc__ or "", budget=60_000, questions=questions).parse_args(arguments)
    carry_out(LIBRARY, learn, options)


if __name__ == "__main__":
    main()
