"""Policies for the fund's decisions. Each decision chooses among ordered levels: of equities, indexation, premiums."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import exp, log
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from .observations import OBSERVED, OF_A_CLIENT

USUAL: Final = np.array([1.2, 1.2, 1.0, 0.4, 0.25, 0.2, 0.9, 0.45, 0.4, 0.5, 0.1, 0.22, 0.15], np.float32)
"""Typical values of the observations, in the order of ``OBSERVED`` and ``OF_A_CLIENT``."""

SPREAD: Final = np.array([0.3, 0.3, 3.0, 0.2, 0.15, 0.15, 0.2, 0.12, 0.15, 0.3, 0.2, 0.1, 0.1], np.float32)
"""The typical spread of each observation around ``USUAL``."""

assert len(USUAL) == len(SPREAD) == len(OBSERVED) + len(OF_A_CLIENT)


def nearest_lawful(level: int, mask: NDArray[np.int8]) -> int:
    """Find the lawful level nearest to another one; of two, the lower one.

    Args:
        level: The wanted level.
        mask: ``(levels,)``: which levels are lawful.
    """
    if mask[level]:
        return level
    lawful = np.flatnonzero(mask)
    return int(lawful[np.argmin(abs(lawful - level))])


@dataclass(frozen=True)
class Constant:
    """A constant policy: it chooses the same level each time, or the nearest lawful one."""

    level: int

    def __call__(self, observation: NDArray[np.float32], info: Mapping[str, Any]) -> int:
        """Choose a level."""
        return nearest_lawful(self.level, info["action_mask"])


@dataclass(frozen=True)
class Linear:
    """A linear policy: the logistic function turns a weighted sum of the observations into a level.

    Attributes:
        weights: One weight for each observed number, in units of ``SPREAD``, then a constant.
    """

    weights: tuple[float, ...]

    @classmethod
    def start(cls, share: float, observed: int) -> Linear:
        """Make a policy that ignores its observations.

        Args:
            share: The level that it chooses, from 0 for the lowest to 1 for the highest.
            observed: The number of observed numbers.
        """
        return cls((0.0,) * observed + (log(share / (1 - share)),))

    def share(self, observation: NDArray[np.float32]) -> float:
        """Compute the wanted level, from 0 for the lowest to 1 for the highest."""
        *weights, constant = self.weights
        observed = len(weights)
        total = float(np.dot((observation - USUAL[:observed]) / SPREAD[:observed], weights)) + constant
        return 1 / (1 + exp(-min(max(total, -50.0), 50.0)))

    def __call__(self, observation: NDArray[np.float32], info: Mapping[str, Any]) -> int:
        """Choose a level."""
        mask = info["action_mask"]
        return nearest_lawful(round(self.share(observation) * (len(mask) - 1)), mask)
