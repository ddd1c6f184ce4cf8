"""Trajectories of many episodes, data sets, comparisons with the rule, and plots."""

from .collect import (
    Comparison,
    Mixture,
    collect_episodes,
    compare_with_rule,
)
from .demonstrations import record_dataset, save_dataset
from .deployed import joint_policy, turn_policy
from .plots import plot_returns
from .pool import OpponentPool
from .timeline import plot_timeline
from .trajectories import Trajectories

__all__ = [
    "Comparison",
    "Mixture",
    "OpponentPool",
    "Trajectories",
    "collect_episodes",
    "compare_with_rule",
    "joint_policy",
    "plot_returns",
    "plot_timeline",
    "record_dataset",
    "save_dataset",
    "turn_policy",
]
