"""Policies for the fund's decisions, all of which choose among ordered levels: of equities, indexation, premiums."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import exp, log
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from .observations import OBSERVED, OF_A_CLIENT

USUAL: Final = np.array([1.2, 1.2, 1.0, 0.4, 0.25, 0.2, 0.9, 0.45, 0.4, 0.5, 0.1, 0.22, 0.15], np.float32)
"""Values in the middle of what is usually observed, in the order of ``OBSERVED`` and ``OF_A_CLIENT``."""

SPREAD: Final = np.array([0.3, 0.3, 3.0, 0.2, 0.15, 0.15, 0.2, 0.12, 0.15, 0.3, 0.2, 0.1, 0.1], np.float32)
"""How far what is usually observed lies apart."""

assert len(USUAL) == len(SPREAD) == len(OBSERVED) + len(OF_A_CLIENT)


def nearest_lawful(level: int, mask: NDArray[np.int8]) -> int:
    """The lawful level that is nearest to another; of two, the lower one.

    Args:
        level: The level that is wanted.
        mask: ``(levels,)``: which levels are lawful.
    """
    if mask[level]:
        return level
    lawful = np.flatnonzero(mask)
    return int(lawful[np.argmin(abs(lawful - level))])


@dataclass(frozen=True)
class Constant:
    """Chooses the same level always, or the nearest lawful one."""

    level: int

    def __call__(self, observation: NDArray[np.float32], info: Mapping[str, Any]) -> int:
        """Choose a level."""
        return nearest_lawful(self.level, info["action_mask"])


@dataclass(frozen=True)
class Linear:
    """Weighs what it observes; the logistic function makes a level of the sum.

    Attributes:
        weights: One for each number observed, in units of ``SPREAD``, and a constant.
    """

    weights: tuple[float, ...]

    @classmethod
    def start(cls, share: float, observed: int) -> Linear:
        """A policy that does not look at what it observes.

        Args:
            share: Which level it chooses, from 0 for the lowest to 1 for the highest.
            observed: How many numbers are observed.
        """
        return cls((0.0,) * observed + (log(share / (1 - share)),))

    def share(self, observation: NDArray[np.float32]) -> float:
        """Which level is wanted, from 0 for the lowest to 1 for the highest."""
        *weights, constant = self.weights
        observed = len(weights)
        total = float(np.dot((observation - USUAL[:observed]) / SPREAD[:observed], weights)) + constant
        return 1 / (1 + exp(-min(max(total, -50.0), 50.0)))

    def __call__(self, observation: NDArray[np.float32], info: Mapping[str, Any]) -> int:
        """Choose a level."""
        mask = info["action_mask"]
        return nearest_lawful(round(self.share(observation) * (len(mask) - 1)), mask)
