"""MAPPO of TorchRL: each stage has its own network, and one critic sees all stages.

``python -m examples.serial_supply.torchrl_mappo --seed 0`` trains it and prints the cost.
"""

from __future__ import annotations

from typing import Any, Final

import torch
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.envs import ExplorationType, PettingZooWrapper, set_exploration_type
from torchrl.modules import MultiAgentMLP, ProbabilisticActor, TanhNormal
from torchrl.objectives import ClipPPOLoss

from simenv_marl import parallel_env

from .command import Policies, command
from .env import OPTIONS, STAGES, SerialSupply, profit

STEPS: Final = 64_000
"""The number of periods."""

BATCH, MINIBATCH, EPOCHS = 1600, 100, 10


def train(seed: int, steps: int = STEPS) -> Policies:
    """Train with the team's reward and a central critic."""
    return learn(make(team_reward=profit), seed, steps, central=True)


# -- glue: begin ----------------------------------------------------------------------------------


def make(**options: Any) -> PettingZooWrapper:
    """Make the environment, with all stages as one group."""
    env = parallel_env(SerialSupply, **OPTIONS, **options)
    return PettingZooWrapper(env, group_map={"stages": list(STAGES)})


def learn(env: Any, seed: int, steps: int, *, central: bool) -> Policies:
    """Train with PPO; the critics see all stages or only their own."""
    torch.manual_seed(seed)
    env.set_seed(seed)
    inputs = env.observation_spec["stages", "observation"].shape[-1]
    shape = {"n_agents": len(STAGES), "depth": 2, "num_cells": 64}
    actor = MultiAgentMLP(inputs, 2, centralized=False, share_params=False, **shape)
    critic = MultiAgentMLP(inputs, 1, centralized=central, share_params=central, **shape)
    parameters = NormalParamExtractor("biased_softplus_0.3")
    bounds = env.full_action_spec_unbatched["stages", "action"].space
    policy = ProbabilisticActor(
        TensorDictSequential(
            TensorDictModule(actor, [("stages", "observation")], [("stages", "parameters")]),
            TensorDictModule(parameters, [("stages", "parameters")], ["loc", "scale"]),
        ),
        in_keys=["loc", "scale"],
        out_keys=[("stages", "action")],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": bounds.low, "high": bounds.high},
        return_log_prob=True,
    )
    value = TensorDictModule(critic, [("stages", "observation")], [("stages", "state_value")])
    loss = ClipPPOLoss(policy, value, entropy_coeff=0.0, normalize_advantage=True)
    names = ("action", "reward", "done", "terminated")
    loss.set_keys(value=("stages", "state_value"), **{name: ("stages", name) for name in names})
    loss.make_value_estimator(gamma=0.95, lmbda=0.9)  # GAE
    optimizer = torch.optim.Adam(loss.parameters(), lr=2e-3)
    decay = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, max(1, steps // BATCH))
    for data in Collector(env, policy, frames_per_batch=BATCH, total_frames=steps):
        with torch.no_grad():
            loss.value_estimator(data)
        for _ in range(EPOCHS):
            for rows in torch.randperm(data.numel()).split(MINIBATCH):
                losses = loss(data.reshape(-1)[rows])
                optimizer.zero_grad()
                (losses["loss_objective"] + losses["loss_critic"]).backward()
                torch.nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
                optimizer.step()
        decay.step()
    return {name: single(policy, number) for number, name in enumerate(STAGES)}


def single(policy: Any, stage: int) -> Any:
    """Make a policy of one stage, which takes one observation or a stack of them."""

    def decide(observation: Any) -> Any:
        rows = torch.as_tensor(observation).unsqueeze(-2)
        rows = rows.expand(*rows.shape[:-2], len(STAGES), -1)  # the network takes all stages
        seen = TensorDict({"stages": {"observation": rows}}, rows.shape[:-2])
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            return policy(seen)["stages", "action"][..., stage, :].numpy()

    return decide


# -- glue: end ------------------------------------------------------------------------------------

if __name__ == "__main__":
    command(train, STEPS)
