"""Planning: estimates the values of actions on possible futures of an episode; policies that decide by these values."""

from .policies import RolloutPolicy, TreeSearchPolicy
from .values import ActionValues, action_values

__all__ = [
    "ActionValues",
    "RolloutPolicy",
    "TreeSearchPolicy",
    "action_values",
]
