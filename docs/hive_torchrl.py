"""PPO of TorchRL for the bees of a hive, which share one network and are born and die."""

import torch
from hive import BEES, MEADOWS, Bee, HiveSim, points
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import ExplorationType, PettingZooWrapper, set_exploration_type
from torchrl.modules import MaskedCategorical, MultiAgentMLP, ProbabilisticActor
from torchrl.objectives import ClipPPOLoss

from simenv_marl import parallel_env, simulate
from simenv_marl.envs import pad_agents


def make(view):
    """Make the environment, with all bees as one group; view is parallel_env or aec_env."""
    env = pad_agents(view(HiveSim, points(), possible_agents=BEES))
    return PettingZooWrapper(env, use_mask=True, group_map={"bees": BEES})


def network(env, outputs):
    """Make one network for all agents."""
    inputs = env.observation_spec["bees", "observation"].shape[-1]
    shared = {"centralized": False, "share_params": True, "depth": 2, "num_cells": 32}
    return MultiAgentMLP(inputs, outputs, len(BEES), **shared)


def learner(env):
    """Make a policy and its PPO loss."""
    actor = network(env, MEADOWS)
    logits = TensorDictModule(actor, [("bees", "observation")], [("bees", "logits")])
    policy = ProbabilisticActor(
        logits,
        in_keys={"logits": ("bees", "logits"), "mask": ("bees", "action_mask")},
        out_keys=[("bees", "action")],
        distribution_class=MaskedCategorical,
        return_log_prob=True,
        log_prob_key=("bees", "log_prob"),
    )
    critic = TensorDictModule(network(env, 1), [("bees", "observation")], [("bees", "value")])
    loss = ClipPPOLoss(policy, critic, entropy_coeff=0.01, critic_coeff=1.0, reduction="none")
    loss.set_keys(
        action=("bees", "action"),
        sample_log_prob=("bees", "log_prob"),
        value=("bees", "value"),
        reward=("bees", "reward"),
        done=("bees", "done"),
        terminated=("bees", "terminated"),
    )
    loss.make_value_estimator(gamma=0.9, lmbda=0.9)  # GAE
    return policy, loss


def train(env, policy, loss, frames=3072):
    """Train with PPO."""
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-3)
    for data in Collector(env, policy, frames_per_batch=512, total_frames=frames):
        bees, later = data["bees"], data["next", "bees"]
        died = (bees["info", "present"] > later["info", "present"]).unsqueeze(-1)
        later["done"] |= died
        later["terminated"] |= died
        with torch.no_grad():
            loss.value_estimator(data)
        # In the AEC view, the mask is true for the selected agent only.
        decided = bees["mask"] & (bees["info", "present"] > 0)
        for _ in range(10):
            losses = loss(data)
            optimizer.zero_grad()
            sum(
                losses[f"loss_{part}"].reshape(decided.shape)[decided].mean()
                for part in ("objective", "critic", "entropy")
            ).backward()
            optimizer.step()


def single(policy):
    """Make a policy for one bee, which takes the most likely action in the model's own loop."""

    def decide(observation, info):
        mask = torch.from_numpy(info["action_mask"]).bool()
        seen = {"observation": torch.from_numpy(observation), "action_mask": mask}
        row = TensorDict(seen).expand(len(BEES))  # the network takes one row for each bee
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            return int(policy(TensorDict({"bees": row}))["bees", "action"][0])

    return decide


if __name__ == "__main__":
    env = make(parallel_env)
    policy, loss = learner(env)
    train(env, policy, loss)
    hive = simulate(HiveSim, {Bee.choose_meadow: single(policy)}, points=points(), seed=1).hive
    print(f"The bees lived for {hive.day} days.")
