"""Planning: estimates the values of actions on possible futures of an episode; policies that decide by these values."""

from .rollouts import RolloutPolicy, TreeSearchPolicy, action_values
from .values import ActionValues

__all__ = [
    "ActionValues",
    "RolloutPolicy",
    "TreeSearchPolicy",
    "action_values",
]
