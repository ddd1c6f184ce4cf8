"""Planning: estimates the values of actions on possible futures of an episode; policies that decide by these values."""

from .rollouts import ActionValues, RolloutPolicy, TreeSearchPolicy, action_values

__all__ = [
    "ActionValues",
    "RolloutPolicy",
    "TreeSearchPolicy",
    "action_values",
]
