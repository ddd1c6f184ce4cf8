"""Question 4, answered by IPPO and MAPPO with TorchRL.

``python -m studies.greenhouse_experiment.torchrl``

Two agents, each with its own network, decide in rounds in the PettingZoo parallel environment. In
4a each agent has its own critic, which sees the agent's observation (IPPO). In 4b there is one
centralised critic (MAPPO), which sees the simulation's ``state()``; a subclass defines it here,
outside of the model. The concatenated observations would not do as a state: in a round both agents
observe the same, so they contain no more than each agent knows.

Networks, advantages and losses are TorchRL's. TorchRL also has a wrapper for PettingZoo
environments and a collector, but as the greenhouse is fast, they would take most of the time.
Instead, sixteen environments run in parallel here, and one call of the networks decides for all of
them.

Learning is, as far as the libraries allow, the same as in ``sb3``:

- Actions are normally distributed, clipped to [-1, 1] and rescaled; their standard deviation starts
  at 0.37.
- Rewards are divided by 20, about the standard deviation of returns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from examples.greenhouse_coop.env import DAYS, OBSERVED, GreenhouseSim
from examples.greenhouse_coop.model import HIGHEST_TEMPERATURE, LOWEST_TEMPERATURE, POT_CAPACITY
from examples.greenhouse_coop.train import Team
from gymnasium.spaces import Box
from numpy.typing import NDArray
from tensordict import TensorDict
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl.envs import ExplorationType
from torchrl.modules import MLP, IndependentNormal, MultiAgentMLP, ProbabilisticActor
from torchrl.objectives import ClipPPOLoss, ValueEstimators

from simenv_marl import parallel_env
from simenv_marl.envs import SimulationParallelEnv

from .questions import BOTH, Verdict, team_of
from .runs import Log, Run, carry_out, parser

LIBRARY: Final = "torchrl"

GREENHOUSES: Final = 16
"""The number of parallel environments for training."""

SETTINGS: Final[dict[str, Any]] = {
    "learning_rate": 3e-4,
    "days": 64,
    "minibatch": 128,
    "epochs": 10,
    "gamma": 0.99,
    "lmbda": 0.95,
    "clip": 0.2,
    "most_gradient": 0.5,
    "reward_scale": 1 / 20,
    "log_std": -1.0,
    "cells": [64, 64],
}

BATCHES_A_POINT: Final = 5
"""The number of batches between two points of the learning curve."""


# -- environments ---------------------------------------------------------------------------------

LEVELS: Final = np.linspace(0, 1, 11)
STATE: Final = Box(-np.inf, np.inf, (3 + 3 * len(LEVELS),), np.float32)


class WholeGreenhouse(GreenhouseSim):
    """The same simulation with a global state for training, which no agent observes."""

    def state(self) -> NDArray[np.float64]:
        """Weather and day, and the deciles of water, health and thirst of all plants: ``(36,)``."""
        greenhouse = self.greenhouse
        plants = np.array(
            [
                (plant.water / POT_CAPACITY, plant.health, plant.req_water)
                for plant in greenhouse.pots
            ]
        )
        warmth = (greenhouse.temp - LOWEST_TEMPERATURE) / (HIGHEST_TEMPERATURE - LOWEST_TEMPERATURE)
        weather = (warmth, min(greenhouse.humidity, 2.0), greenhouse.day / DAYS)
        return np.concatenate(
            [weather, np.quantile(np.minimum(plants, 2.0), LEVELS, axis=0).ravel()]
        )


class Greenhouses:
    """Sixteen PettingZoo parallel environments that run side by side."""

    def __init__(self, question: str, seed: int) -> None:
        """Create the environments.

        Args:
            question: The key of the question: the environments have a state for a centralised
                critic alone.
            seed: The seed of the greenhouses.
        """
        self._central = question == "4b"
        self._environments = [self._furnished() for _ in range(GREENHOUSES)]
        seeds = np.random.SeedSequence(seed).generate_state(GREENHOUSES) % 2**31
        self._seen = [
            self._reset(each, int(own)) for each, own in zip(self._environments, seeds, strict=True)
        ]

    def _furnished(self) -> SimulationParallelEnv:
        return (
            parallel_env(WholeGreenhouse, state_space=STATE)
            if self._central
            else parallel_env(GreenhouseSim)
        )

    def collect(self, actor: ProbabilisticActor) -> TensorDict:
        """Collect a batch with an actor that explores.

        Returns:
            A batch of shape ``(greenhouses, days)``, with the keys that TorchRL's losses and value
            estimators expect.
        """
        days = []
        for _ in range(SETTINGS["days"]):
            day = self._stacked(self._seen)
            with torch.no_grad():
                actor(day)
            actions = rescaled(day["agents", "action"])
            played = [
                self._play(each, own) for each, own in zip(self._environments, actions, strict=True)
            ]
            day["next"] = self._stacked([seen for seen, *_ in played])
            for number, name in enumerate(("reward", "terminated", "done"), 1):
                values = np.array([row[number] for row in played])
                day["next", "agents", name] = torch.from_numpy(values)[..., None]
            days.append(day)
            self._seen = [
                self._reset(each) if row[3].any() else row[0]
                for each, row in zip(self._environments, played, strict=True)
            ]
        return torch.stack(days, dim=1)

    def _play(
        self, environment: SimulationParallelEnv, actions: NDArray[np.float32]
    ) -> tuple[Any, ...]:
        observations, rewards, terminations, truncations, _ = environment.step(
            dict(zip(BOTH, actions, strict=True))
        )
        terminated = np.array([terminations[agent] for agent in BOTH])
        truncated = np.array([truncations[agent] for agent in BOTH])
        scaled = np.array([rewards[agent] for agent in BOTH], np.float32) * SETTINGS["reward_scale"]
        return self._look(environment, observations), scaled, terminated, terminated | truncated

    def _reset(self, environment: SimulationParallelEnv, seed: int | None = None) -> Any:
        observations, _ = environment.reset(seed=seed)
        return self._look(environment, observations)

    def _look(self, environment: SimulationParallelEnv, observations: dict[str, Any]) -> Any:
        """Return the agents' observations, ``(2, 6)``, and the state, ``(36,)`` or empty."""
        state = environment.state() if self._central else np.zeros(0, np.float32)
        return np.stack([observations[agent] for agent in BOTH]), state

    def _stacked(self, seen: Sequence[Any]) -> TensorDict:
        observations, states = (
            torch.from_numpy(np.stack(parts)) for parts in zip(*seen, strict=True)
        )
        agents = TensorDict({"observation": observations}, [len(seen), 2])
        return TensorDict({"agents": agents, "state": states}, [len(seen)])


# -- networks -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Networks:
    """The networks that learn.

    Attributes:
        means: Maps observations, ``(..., 2, 6)``, to the means of actions before rescaling,
            ``(..., 2, 1)``.
        actor: TorchRL's actor on top of these means: distributions of actions.
        critic: The estimate of the value, ``(..., 2, 1)``.
    """

    means: nn.Module
    actor: ProbabilisticActor
    critic: TensorDictModule

    @classmethod
    def of(cls, question: str) -> Networks:
        """Make the networks for a question."""
        cells: dict[str, Any] = {"num_cells": SETTINGS["cells"], "activation_class": nn.Tanh}
        own: dict[str, Any] = {"n_agents": 2, "centralized": False, "share_params": False, **cells}
        observation, loc, scale, action, log_prob, value = (
            ("agents", name)
            for name in ("observation", "loc", "scale", "action", "log_prob", "state_value")
        )
        means = MultiAgentMLP(len(OBSERVED), 1, **own)
        if question == "4b":
            whole = nn.Sequential(MLP(STATE.shape[0], 2, **cells), nn.Unflatten(-1, (2, 1)))
            critic = TensorDictModule(whole, ["state"], [value])
        else:
            critic = TensorDictModule(
                MultiAgentMLP(len(OBSERVED), 1, **own), [observation], [value]
            )
        deviation = AddStateIndependentNormalScale((2, 1))
        nn.init.constant_(deviation.state_independent_scale, SETTINGS["log_std"])
        actor = ProbabilisticActor(
            TensorDictModule(nn.Sequential(means, deviation), [observation], [loc, scale]),
            in_keys={"loc": loc, "scale": scale},
            out_keys=[action],
            distribution_class=IndependentNormal,
            # outside TorchRL's collectors, the default is the mean
            default_interaction_type=ExplorationType.RANDOM,
            return_log_prob=True,
            log_prob_key=log_prob,
        )
        return cls(means, actor, critic)

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Compute the agents' actions without exploration.

        At the beginning of a day, both observe the same.
        """
        with torch.no_grad():
            means = self.means(torch.from_numpy(observation).expand(2, -1)).reshape(2)
        return rescaled(means)


def rescaled(actions: torch.Tensor) -> NDArray[np.float32]:
    """Clip actions to [-1, 1], and rescale them to [0, 1]."""
    return np.asarray((actions.clamp(-1, 1) + 1) / 2, np.float32)


# -- learning -------------------------------------------------------------------------------------


def learn(run: Run) -> Verdict:
    """Train for a run, and evaluate the result."""
    torch.set_num_threads(1)
    torch.manual_seed(run.seed)
    networks = Networks.of(run.question)
    greenhouses = Greenhouses(run.question, run.seed)
    teach = Teacher(networks)
    team = team_of(run.asked, networks.act)
    log = Log(run, {"greenhouses": GREENHOUSES, **SETTINGS})
    log.judge(0, team)
    days = GREENHOUSES * SETTINGS["days"]
    batches = -(-run.budget // days)  # whole batches: the last one may exceed the budget
    for number in range(1, batches + 1):
        teach(greenhouses.collect(networks.actor))
        if number % BATCHES_A_POINT == 0 or number == batches:
            log.judge(number * days, team)
    torch.save(networks.means.state_dict(), run.stem.with_suffix(".pt"))
    return log.close(batches * days, team)


class Teacher:
    """PPO for the networks."""

    def __init__(self, networks: Networks) -> None:
        """Make the loss and its optimiser."""
        self._loss = ClipPPOLoss(
            networks.actor,
            networks.critic,
            clip_epsilon=SETTINGS["clip"],
            entropy_bonus=False,
            critic_coeff=0.5,
            loss_critic_type="l2",
            normalize_advantage=True,
            normalize_advantage_exclude_dims=(-2,),  # separately for each agent
        )
        names = (
            "reward",
            "action",
            "value",
            "done",
            "terminated",
            "advantage",
            "value_target",
            "sample_log_prob",
        )
        own = {"value": "state_value", "sample_log_prob": "log_prob"}
        self._loss.set_keys(**{name: ("agents", own.get(name, name)) for name in names})
        self._loss.make_value_estimator(
            ValueEstimators.GAE, gamma=SETTINGS["gamma"], lmbda=SETTINGS["lmbda"]
        )
        self._optimiser = torch.optim.Adam(
            self._loss.parameters(), SETTINGS["learning_rate"], eps=1e-5
        )

    def __call__(self, batch: TensorDict) -> None:
        """Learn from a batch, ``(greenhouses, days)``."""
        with torch.no_grad():
            self._loss.value_estimator(
                batch,
                params=self._loss.critic_network_params,
                target_params=self._loss.target_critic_network_params,
            )
        rows = batch.reshape(-1)
        for _ in range(SETTINGS["epochs"]):
            for chosen in torch.randperm(len(rows)).split(SETTINGS["minibatch"]):
                losses = self._loss(rows[chosen])
                self._optimiser.zero_grad()
                (losses["loss_objective"] + losses["loss_critic"]).backward()
                nn.utils.clip_grad_norm_(self._loss.parameters(), SETTINGS["most_gradient"])
                self._optimiser.step()


def load(run: Run) -> Team:
    """Load the team that a run has trained."""
    path = run.stem.with_suffix(".pt")
    if not path.exists():
        raise SystemExit(
            f"{path} is missing: question {run.question} of seed {run.seed} has to be answered"
            " first"
        )
    networks = Networks.of(run.question)
    networks.means.load_state_dict(torch.load(path))
    return team_of(run.asked, networks.act)


def main(arguments: Sequence[str] | None = None) -> None:
    """Carry out the missing runs."""
    options = parser(__doc__ or "", budget=60_000, questions=("4a", "4b")).parse_args(arguments)
    carry_out(LIBRARY, learn, options)


if __name__ == "__main__":
    main()
