"""Records of the decision points in episodes of random legal actions."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from itertools import chain
from typing import NamedTuple

import numpy as np
from gymnasium.spaces import Discrete
from numpy.typing import NDArray

from ..core import MASK, Point, same
from ..envs.base import StepResult
from ..errors import short_repr
from ..simulation import Observation
from .report import PointStatistics, Range


class Tally(NamedTuple):
    """The number, the minimum, the maximum and the sum of arrays of one shape."""

    number: int
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    total: NDArray[np.float64]

    def ranges(self, name: str) -> list[Range]:
        """Return the range of each element."""
        return [
            Range(
                f"{name}{list(place) or ''}",
                self.low[place].item(),
                mean.item(),
                self.high[place].item(),
            )
            for place, mean in np.ndenumerate(self.total / self.number)
        ]


class PointRecord:
    """The record of a decision point in episodes of random legal actions.

    Attributes:
        point: The decision point.
        decisions: The number of its decisions.
        outside: The first observation outside of its space, in words.
        first: The first observation.
        varies: Whether observations differ.
        tallies: The tallies of "reward", "mask", and the parts of "observation".
    """

    def __init__(self, point: Point) -> None:
        self.point = point
        self.decisions = 0
        self.outside = ""
        self.first: Observation = None
        self.varies = False
        self.tallies: dict[str, Tally] = {}

    def add(self, agent: str, result: StepResult) -> None:
        """Add a result of ``last()``, without its reward."""
        observation, _, terminated, truncated, info = result
        self.tally("observation", observation)
        self.first = observation if self.first is None else self.first
        self.varies = self.varies or not same(self.first, observation)
        space = self.point.definition.observation_space
        if not (self.outside or space.contains(observation)):
            text = short_repr(observation)
            self.outside = f"{agent} has observed {text}; the space is {space}"
        if not (terminated or truncated):
            self.decisions += 1
            self.tally("mask", info.get(MASK))

    def is_blind(self) -> bool:
        """Return whether all observations were the same, in a space that has others."""
        space = deepcopy(self.point.definition.observation_space)  # it keeps its generator
        return not (self.varies or all(same(self.first, space.sample()) for _ in range(9)))

    def tally(self, name: str, value: Observation) -> None:
        """Add a number, an array, or a dict or tuple of these, to its tallies.

        Arrays of another shape than the first one are left out.
        """
        if isinstance(value, Mapping):
            for key, part in value.items():
                if key != MASK:
                    self.tally(f"{name}.{key}", part)
        elif isinstance(value, tuple):
            for number, part in enumerate(value):
                self.tally(f"{name}.{number}", part)
        elif isinstance(value, (np.ndarray, np.generic, int, float)):
            array = np.array(value, float)
            number, low, high, total = self.tallies.get(name) or (
                0,
                array,
                array,
                np.zeros_like(array),
            )
            if array.shape == total.shape:
                self.tallies[name] = Tally(
                    number + 1,
                    np.minimum(low, array),
                    np.maximum(high, array),
                    total + array,
                )

    def statistics(self) -> PointStatistics:
        """Return the statistics."""
        ranges = {name: tally.ranges(name) for name, tally in self.tallies.items()}
        rewards = ranges.pop("reward", [None])
        space = self.point.definition.action_space
        first = int(space.start) if isinstance(space, Discrete) else 0
        never = [
            first + action for action, part in enumerate(ranges.get("mask", [])) if not part.maximum
        ]
        observations = [ranges[name] for name in ranges if name.startswith("observation")]
        return PointStatistics(
            self.point.hook.name,
            self.point.agent or "agents named by each call",
            self.decisions,
            tuple(chain(*observations)),
            rewards[0],
            tuple(never),
        )
