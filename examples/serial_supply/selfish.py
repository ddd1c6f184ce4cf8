"""Independent PPO of TorchRL, in which each stage minimises its own costs.

``python -m examples.serial_supply.selfish --seed 0`` trains it and prints the cost. It differs from
``independent`` in its rewards alone. Stages 2 and 3 pay nothing for late deliveries.
"""

from __future__ import annotations

from .command import Policies, command
from .torchrl_mappo import STEPS, learn, make


def train(seed: int, steps: int = STEPS) -> Policies:
    """Train with each stage's own reward and a critic for each stage."""
    return learn(make(), seed, steps, central=False)


if __name__ == "__main__":
    command(train, STEPS)
