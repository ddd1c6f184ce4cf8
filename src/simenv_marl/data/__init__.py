"""Trajectories of many episodes, data sets, comparisons with the rule, and plots."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ..many.parallel import import_extra
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

if TYPE_CHECKING:
    from .timed import TimedReplayBuffer as TimedReplayBuffer
    from .timed import TimedRolloutBuffer as TimedRolloutBuffer

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


def __getattr__(name: str) -> Any:
    """Import the buffers when they are used, because they need Stable-Baselines3."""
    if name not in ("TimedReplayBuffer", "TimedRolloutBuffer"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import_extra("stable_baselines3", name)
    from . import timed

    return getattr(timed, name)
