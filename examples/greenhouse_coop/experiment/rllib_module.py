"""RLlib's own module, which begins less wildly.

What RLlib saves of a module names its class, and the module that this class is in. So it is in none that is run as a
script, which is ``__main__`` there, or ``__mp_main__`` in a worker, and neither of both to those who load it.
"""

from __future__ import annotations

from typing import Final

import torch
from ray.rllib.algorithms.ppo.torch.default_ppo_torch_rl_module import DefaultPPOTorchRLModule

LOG_STD: Final = -1.0


class Module(DefaultPPOTorchRLModule):
    """The same, except for what its deviation begins with."""

    def setup(self) -> None:
        """Make the networks."""
        super().setup()
        torch.nn.init.constant_(self.pi.log_std, LOG_STD)
