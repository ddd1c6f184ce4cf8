"""Planning: estimates the values of actions on possible futures of an episode.

Policies that decide by these values.
"""

from .candidates import first
from .rollouts import RolloutPolicy, action_values
from .tree import TreeSearchPolicy
from .values import ActionValues

__all__ = [
    "ActionValues",
    "RolloutPolicy",
    "TreeSearchPolicy",
    "action_values",
    "first",
]
