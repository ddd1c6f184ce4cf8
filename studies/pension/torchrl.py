"""One network for the pension fund's two agents for rights, trained with TorchRL's PPO.

``python -m studies.pension.torchrl`` needs the extra ``clients``. It trains for 7,000 years, and
compares the network with the model's rule on seeds that the training has not seen.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

import torch
from examples.fin_base.env import TEAM, FundSim
from examples.fin_base.pension import Parameters
from examples.fin_base.train import SPREAD, USUAL
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import ExplorationType, PettingZooWrapper, set_exploration_type
from torchrl.modules import MaskedCategorical, ProbabilisticActor
from torchrl.objectives import ClipPPOLoss

from simenv_marl import evaluate, parallel_env

AGENTS: Final = ["indexer_0", "planner_0"]

POINTS: Final = {
    point: definition for point, definition in TEAM.items() if definition.agent in AGENTS
}
# TorchRL requires masks for all agents of a group, or for none
for point, definition in POINTS.items():
    if definition.action_mask_mapping is None:
        POINTS[point] = replace(definition, action_mask_mapping=lambda *_: [1] * 5)


def fund() -> FundSim:
    """Make a small fund."""
    return FundSim(20, Parameters(clients=50, coverage=1.25))


class Network(nn.Sequential):
    """One network for both agents; it scales what they observe."""

    def __init__(self, outputs: int) -> None:
        """Make the layers."""
        super().__init__(nn.Linear(7, 32), nn.Tanh(), nn.Linear(32, outputs))

    def forward(self, observation: Any) -> Any:
        """Compute logits, or a value."""
        return super().forward((observation - torch.tensor(USUAL[:7])) / torch.tensor(SPREAD[:7]))


def learner() -> tuple[Any, Any]:
    """Make a policy, and the loss by which it learns."""
    key = {
        name: ("company", name)
        for name in ("action", "reward", "value", "done", "terminated", "advantage", "value_target")
    }
    log_prob = ("company", "log_prob")
    policy = ProbabilisticActor(
        TensorDictModule(Network(5), [("company", "observation")], [("company", "logits")]),
        in_keys={"logits": ("company", "logits"), "mask": ("company", "action_mask")},
        out_keys=[key["action"]],
        distribution_class=MaskedCategorical,
        return_log_prob=True,
        log_prob_key=log_prob,
    )
    critic = TensorDictModule(Network(1), [("company", "observation")], [key["value"]])
    loss = ClipPPOLoss(policy, critic, entropy_bonus=False, normalize_advantage=True)
    loss.set_keys(**key, sample_log_prob=log_prob)
    loss.make_value_estimator(gamma=0.5, lmbda=0.9)  # GAE
    return policy, loss


def train(policy: Any, loss: Any, years: int = 7000, seed: int = 0) -> None:
    """Train by PPO."""
    groups = {"company": AGENTS}
    env = PettingZooWrapper(parallel_env(fund, POINTS), use_mask=True, group_map=groups)
    env.set_seed(seed)
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-3)
    for data in Collector(env, policy, frames_per_batch=1000, total_frames=years):
        data["next", "company", "reward"] /= 20
        with torch.no_grad():
            loss.value_estimator(data)
        # one of the two agents decides in each year
        decided = data["next", "company", "info", "acted"] > 0
        rows = TensorDict({"company": data["company"][decided]}, [int(decided.sum())])
        for _ in range(10):
            for chosen in torch.randperm(len(rows)).split(125):
                losses = loss(rows[chosen])
                optimizer.zero_grad()
                (losses["loss_objective"] + losses["loss_critic"]).backward()
                optimizer.step()


def compare(policy: Any) -> Any:
    """Compare the network, which decides for one agent at a time, with the model's rule."""

    def decide(observation: Any, info: Mapping[str, Any]) -> int:
        mask = torch.from_numpy(info["action_mask"]).bool()
        seen = {"observation": torch.from_numpy(observation), "action_mask": mask}
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            return int(policy(TensorDict({"company": TensorDict(seen)}))["company", "action"])

    return evaluate(
        fund,
        {"rule": {}, "trained": dict.fromkeys(AGENTS, decide)},
        seeds=range(2_000_000, 2_000_128),
        points=POINTS,
        metric=FundSim.welfare,
        baseline="rule",
    )


def main() -> None:
    """Train, and compare."""
    torch.manual_seed(0)
    policy, loss = learner()
    train(policy, loss)
    print(compare(policy).summary("metric"))


if __name__ == "__main__":
    main()
