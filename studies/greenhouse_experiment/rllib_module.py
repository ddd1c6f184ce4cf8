"""RLlib's default module with less initial exploration.

A checkpoint of RLlib contains the name of the module's class and of its Python module. So the class
is not in a script, whose name is ``__main__``, or ``__mp_main__`` in a worker, and something else
where the checkpoint is loaded.
"""

from __future__ import annotations

from typing import Final

import torch
from ray.rllib.algorithms.ppo.torch.default_ppo_torch_rl_module import DefaultPPOTorchRLModule

LOG_STD: Final = -1.0


class Module(DefaultPPOTorchRLModule):
    """RLlib's default PPO module with another initial standard deviation of actions."""

    def setup(self) -> None:
        """Make the networks."""
        super().setup()
        torch.nn.init.constant_(self.pi.log_std, LOG_STD)
