"""Questions 1, 2, 3 and 5, answered by PPO of stable-baselines3.

``python -m examples.greenhouse_coop.experiment.sb3``

What its environments are is all there is to a question. Learning is the same for all of them:

- Actions are rescaled from [-1, 1] by Gymnasium's wrapper, as the library wants them.
- Rewards are divided by the deviation of returns, by the library's ``VecNormalize``. Observations are what they are:
  all of them lie between 0 and 1.
- The deviation of actions begins with 0.37 instead of 1 (``log_std_init``): at 1 nearly a third of all actions would
  lie outside of the space, and be clipped to one of its ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, Final

import gymnasium
import numpy as np
import torch
from gymnasium.wrappers import RescaleAction
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from simenv_marl import single_env

from ..env import VENTILATION, WATERING, GreenhouseSim, joint_env, ventilation_env, watering_env
from ..train import Team
from .questions import Act, Verdict, team_of
from .runs import Log, Run, carry_out, parser

LIBRARY: Final = "sb3"

GREENHOUSES: Final = 16
"""How many are kept side by side, to learn from."""

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
"""After how many days there is a point of the learning curve."""

POINTS: Final = WATERING | VENTILATION


def environment(run: Run, fixed: Team) -> gymnasium.Env[Any, Any]:
    """The environment in which a question is answered: another view of the same simulation for each.

    Args:
        run: The run.
        fixed: Who is answered by a fixed policy.
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
    """Who is answered by a fixed policy: a constant, or what another run has brought about."""
    return load(run.of(run.asked.needs)) if run.asked.needs else run.asked.fixed


def learn(run: Run) -> Verdict:
    """Carry out a run."""
    torch.set_num_threads(1)
    fixed = fixed_in(run)

    def make() -> gymnasium.Env[Any, Any]:
        return RescaleAction(environment(run, fixed), np.float32(-1), np.float32(1))

    greenhouses = VecNormalize(DummyVecEnv([make] * GREENHOUSES), norm_obs=False, gamma=SETTINGS["gamma"])
    model = PPO("MlpPolicy", greenhouses, seed=run.seed, device="cpu", **SETTINGS)
    team = {**fixed, **team_of(run.asked, partial(act, model))}
    log = Log(run, {"greenhouses": GREENHOUSES, **SETTINGS})
    log.judge(0, team)
    while model.num_timesteps < run.budget:
        days = min(DAYS_A_POINT, run.budget - model.num_timesteps)
        model.learn(days, reset_num_timesteps=False)  # in whole rollouts: the last one may go beyond the budget
        log.judge(model.num_timesteps, team)
    model.save(run.stem.with_suffix(".zip"))
    greenhouses.close()
    return log.close(model.num_timesteps, team)


def act(model: PPO, observation: NDArray[np.float32]) -> NDArray[np.float32]:
    """What a model does, without exploring.

    Args:
        model: The model.
        observation: Of one agent, float32 ``(6,)``. The joint agent is asked when the day begins, and both of its parts
            observe the same.
    """
    (size,) = model.observation_space.shape
    actions, _ = model.predict(np.tile(observation, size // len(observation)), deterministic=True)
    return np.asarray(np.clip((actions + 1) / 2, 0, 1), np.float32)


def load(run: Run) -> Team:
    """The team that a run has brought about."""
    path = run.stem.with_suffix(".zip")
    if not path.exists():
        raise SystemExit(f"{path} is missing: question {run.question} of seed {run.seed} has to be answered first")
    learnt: Act = partial(act, PPO.load(path, device="cpu"))
    return {**fixed_in(run), **team_of(run.asked, learnt)}


def main(arguments: Sequence[str] | None = None) -> None:
    """Carry out what has not been carried out before."""
    questions = ("1", "2", "3", "5a", "5b", "5c")
    options = parser(__doc__ or "", budget=60_000, questions=questions).parse_args(arguments)
    carry_out(LIBRARY, learn, options)


if __name__ == "__main__":
    main()
