"""Independent PPO of TorchRL: each stage has its own network and its own critic.

``python -m examples.serial_supply.independent --seed 0`` trains it and prints the cost. It differs
from ``torchrl_mappo`` in its critics alone: each sees what its own stage sees.
"""

from __future__ import annotations

from .command import Policies, command
from .env import profit
from .torchrl_mappo import STEPS, learn, make


def train(seed: int, steps: int = STEPS) -> Policies:
    """Train with the team's reward and a critic for each stage."""
    return learn(make(team_reward=profit), seed, steps, central=False)


if __name__ == "__main__":
    command(train, STEPS)
