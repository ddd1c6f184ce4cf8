"""Views: an episode as a PettingZoo or Gymnasium environment."""

from .aec import SimulationAECEnv
from .joint import SimulationJointEnv
from .padding import pad_agents
from .parallel import SimulationParallelEnv
from .single import SimulationEnv
from .vector import SimulationVectorEnv

__all__ = [
    "SimulationAECEnv",
    "SimulationEnv",
    "SimulationJointEnv",
    "SimulationParallelEnv",
    "SimulationVectorEnv",
    "pad_agents",
]
