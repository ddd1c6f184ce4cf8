"""Rewards and costs: checks of the values that mappings return."""

from __future__ import annotations

from math import isfinite
from numbers import Real

import numpy as np

from ...errors import RewardError, short_repr
from ...simulation import Model


def checked_reward(name: str, reward: Model, kind: str = "reward") -> float:
    """Return a reward, or a cost, as a float.

    Raises:
        RewardError: It is not one finite number.
    """
    value = reward.item() if isinstance(reward, np.ndarray) and reward.size == 1 else reward
    if not isinstance(value, (Real, np.bool_)):
        raise RewardError(f"the {kind} {short_repr(reward)} of {name!r} is not one number")
    try:
        number = float(value)
    except OverflowError:
        raise RewardError(f"the {kind} {short_repr(reward)} is too large for a float") from None
    if not isfinite(number):
        raise RewardError(f"the {kind} of {name!r} is {number}, which is not finite")
    return number
