"""Question 4, answered by IPPO and MAPPO of TorchRL; and question 3, to compare the libraries.

``python -m examples.greenhouse_coop.experiment.torchrl``

Two agents with a network each decide in rounds, in the PettingZoo parallel environment. In 4a each has a critic of its
own, which sees what its agent sees (IPPO). In 4b there is one critic, which sees the greenhouse itself (MAPPO): the
simulation's ``state()``, which a subclass defines here, outside of the model. As both agents observe the same in a
round, what they observe taken together would be no more than what each of them knows.

Learning is the same for all of it, and as far as the libraries allow, the same as in ``sb3``:

- Actions are normal variables squashed by the hyperbolic tangent (``TanhNormal``); their deviation begins with 0.37.
- Rewards are divided by 20, about the deviation of returns.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from gymnasium.spaces import Box
from numpy.typing import NDArray
from tensordict import TensorDict
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, GymWrapper, MarlGroupMapType, PettingZooWrapper, RewardScaling, TransformedEnv
from torchrl.modules import MLP, MultiAgentMLP, ProbabilisticActor, TanhNormal
from torchrl.objectives import ClipPPOLoss, ValueEstimators

from simenv_marl import parallel_env

from ..env import DAYS, OBSERVED, GreenhouseSim, joint_env
from ..model import HIGHEST_TEMPERATURE, LOWEST_TEMPERATURE, POT_CAPACITY
from ..train import Team
from .questions import Verdict, team_of
from .runs import Log, Run, carry_out, parser

LIBRARY: Final = "torchrl"

SETTINGS: Final[dict[str, Any]] = {
    "learning_rate": 3e-4,
    "days_a_batch": 1024,
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
"""After how many batches there is a point of the learning curve."""


# -- environments ---------------------------------------------------------------------------------

LEVELS: Final = np.linspace(0, 1, 11)
STATE: Final = Box(-np.inf, np.inf, (3 + 3 * len(LEVELS),), np.float32)


class WholeGreenhouse(GreenhouseSim):
    """The same simulation, which also tells those who train what no agent observes."""

    def state(self) -> NDArray[np.float64]:
        """Weather and day, and the deciles of water, health and thirst of all plants: ``(36,)``."""
        greenhouse = self.greenhouse
        plants = np.array([(plant.water / POT_CAPACITY, plant.health, plant.req_water) for plant in greenhouse.pots])
        warmth = (greenhouse.temp - LOWEST_TEMPERATURE) / (HIGHEST_TEMPERATURE - LOWEST_TEMPERATURE)
        weather = (warmth, min(greenhouse.humidity, 2.0), greenhouse.day / DAYS)
        return np.concatenate([weather, np.quantile(np.minimum(plants, 2.0), LEVELS, axis=0).ravel()])


def environment(run: Run) -> EnvBase:
    """The environment in which a question is answered."""
    if run.question == "3":
        made = GymWrapper(joint_env(flatten=True))
        return TransformedEnv(made, RewardScaling(0.0, SETTINGS["reward_scale"]))
    central = run.question == "4b"
    rounds = parallel_env(WholeGreenhouse, state_space=STATE) if central else parallel_env(GreenhouseSim)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "PettingZoo in TorchRL is tested", UserWarning)
        made = PettingZooWrapper(rounds, return_state=central, group_map=MarlGroupMapType.ALL_IN_ONE_GROUP)
    return TransformedEnv(made, RewardScaling(0.0, SETTINGS["reward_scale"], in_keys=[("agents", "reward")]))


# -- networks -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Networks:
    """What learns.

    Attributes:
        means: From observations, ``(2, 6)`` or of the joint agent ``(12,)``, to what becomes an action by squashing:
            ``(2, 1)`` or ``(2,)``.
        actor: The same as a distribution of actions, in TorchRL's terms.
        critic: What it is going to be worth.
        group: The keys of TorchRL's under which observations, actions and rewards stand begin with these.
    """

    means: nn.Module
    actor: ProbabilisticActor
    critic: TensorDictModule
    group: tuple[str, ...]

    @classmethod
    def of(cls, question: str) -> Networks:
        """Make the networks that answer a question."""
        cells: dict[str, Any] = {"num_cells": SETTINGS["cells"], "activation_class": nn.Tanh}
        sizes = {"n_agents": 2, "share_params": False, **cells}
        seen = len(OBSERVED)
        group = () if question == "3" else ("agents",)
        observation: Any = (*group, "observation")
        judged = observation
        means: nn.Module
        critic: nn.Module
        if question == "3":
            means, critic = MLP(2 * seen, 2, **cells), MLP(2 * seen, 1, **cells)
        else:
            means = MultiAgentMLP(seen, 1, centralized=False, **sizes)
            critic = MultiAgentMLP(seen, 1, centralized=False, **sizes)
        if question == "4b":
            judged = "state"
            critic = nn.Sequential(MLP(STATE.shape[0], 2, **cells), nn.Unflatten(-1, (2, 1)))
        deviation = AddStateIndependentNormalScale((2,) if question == "3" else (2, 1))
        nn.init.constant_(deviation.state_independent_scale, SETTINGS["log_std"])
        loc, scale, action, value = ((*group, name) for name in ("loc", "scale", "action", "state_value"))
        actor = ProbabilisticActor(
            TensorDictModule(nn.Sequential(means, deviation), [observation], [loc, scale]),
            in_keys={"loc": loc, "scale": scale},
            out_keys=[action],
            distribution_class=TanhNormal,
            distribution_kwargs={"low": 0.0, "high": 1.0},
            return_log_prob=True,
            log_prob_key=(*group, "log_prob"),
        )
        return cls(means, actor, TensorDictModule(critic, [judged], [value]), group)

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """What the agents do, without exploring: both are asked when the day begins, and observe the same."""
        with torch.no_grad():
            seen = torch.from_numpy(observation).expand(2, -1)
            means = self.means(seen if self.group else seen.reshape(-1))
        # The waterer is the first in the joint agent, and in the roster.
        return np.asarray((torch.tanh(means.reshape(2)) + 1) / 2, np.float32)


# -- learning -------------------------------------------------------------------------------------


def learn(run: Run) -> Verdict:
    """Carry out a run."""
    torch.set_num_threads(1)
    torch.manual_seed(run.seed)
    networks = Networks.of(run.question)
    greenhouse = environment(run)
    greenhouse.set_seed(run.seed)
    team = team_of(run.asked, networks.act)
    log = Log(run, SETTINGS)
    log.judge(0, team)
    size = SETTINGS["days_a_batch"]
    batches = -(-run.budget // size)  # whole ones: the last may go beyond the budget
    collector = Collector(
        greenhouse,
        networks.actor,
        frames_per_batch=size,
        total_frames=batches * size,
        auto_register_policy_transforms=False,  # networks without a memory need none
    )
    teach = Teacher(networks)
    for number, batch in enumerate(collector, 1):
        teach(batch)
        if number % BATCHES_A_POINT == 0 or number == batches:
            log.judge(number * size, team)
    collector.shutdown()
    torch.save(networks.means.state_dict(), run.stem.with_suffix(".pt"))
    return log.close(batches * size, team)


class Teacher:
    """Teaches networks by PPO."""

    def __init__(self, networks: Networks) -> None:
        """Make the loss and its optimiser."""
        group = networks.group
        self._group = group
        self._loss = ClipPPOLoss(
            networks.actor,
            networks.critic,
            clip_epsilon=SETTINGS["clip"],
            entropy_bonus=False,
            critic_coeff=0.5,
            loss_critic_type="l2",
            normalize_advantage=True,
            normalize_advantage_exclude_dims=(-2,) if group else (),  # by itself for each agent
        )
        names = ("reward", "action", "value", "done", "terminated", "advantage", "value_target", "sample_log_prob")
        own = {"value": "state_value", "sample_log_prob": "log_prob"}
        self._loss.set_keys(**{name: (*group, own.get(name, name)) for name in names})
        self._loss.make_value_estimator(ValueEstimators.GAE, gamma=SETTINGS["gamma"], lmbda=SETTINGS["lmbda"])
        self._optimiser = torch.optim.Adam(self._loss.parameters(), SETTINGS["learning_rate"], eps=1e-5)

    def __call__(self, batch: TensorDict) -> None:
        """Learn from a batch of days that follow each other."""
        with torch.no_grad():
            self._loss.value_estimator(
                batch,
                params=self._loss.critic_network_params,
                target_params=self._loss.target_critic_network_params,
            )
        for _ in range(SETTINGS["epochs"]):
            for rows in torch.randperm(len(batch)).split(SETTINGS["minibatch"]):
                losses = self._loss(batch[rows])
                self._optimiser.zero_grad()
                (losses["loss_objective"] + losses["loss_critic"]).backward()
                nn.utils.clip_grad_norm_(self._loss.parameters(), SETTINGS["most_gradient"])
                self._optimiser.step()


def load(run: Run) -> Team:
    """The team that a run has brought about."""
    path = run.stem.with_suffix(".pt")
    if not path.exists():
        raise SystemExit(f"{path} is missing: question {run.question} of seed {run.seed} has to be answered first")
    networks = Networks.of(run.question)
    networks.means.load_state_dict(torch.load(path))
    return team_of(run.asked, networks.act)


def main(arguments: Sequence[str] | None = None) -> None:
    """Carry out what has not been carried out before."""
    options = parser(__doc__ or "", budget=60_000, questions=("4a", "4b", "3")).parse_args(arguments)
    carry_out(LIBRARY, learn, options)


if __name__ == "__main__":
    main()
