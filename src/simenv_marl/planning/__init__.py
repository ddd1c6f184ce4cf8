"""Planning: estimates the values of actions on possible futures of an episode; policies that decide by these values.

Each module imports only from those below it::

    tree            a policy that looks several decisions ahead
    policy          a policy that looks one decision ahead
    values          the values of candidate actions
    futures         tries candidates on common futures, in branches
    lookahead       the horizon and discount of a try, and its return
    players         the deciding agent in a branch, in each view
"""

from .policy import RolloutPolicy
from .tree import TreeSearchPolicy
from .values import ActionValues, action_values

__all__ = [
    "ActionValues",
    "RolloutPolicy",
    "TreeSearchPolicy",
    "action_values",
]
