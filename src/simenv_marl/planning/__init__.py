"""Planning: estimates the values of actions on possible futures of an episode; policies that decide by these values.

Each module imports only from those below it::

    policies        policies that try candidates before they decide
    values          the values of candidate actions: rollouts on common futures, in branches
    player          the deciding agent in a branch, in each view
"""

from .policies import RolloutPolicy, TreeSearchPolicy
from .values import ActionValues, action_values

__all__ = [
    "ActionValues",
    "RolloutPolicy",
    "TreeSearchPolicy",
    "action_values",
]
