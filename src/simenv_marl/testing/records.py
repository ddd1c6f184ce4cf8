"""Records of the decision points in episodes of random legal actions."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain

import numpy as np
from gymnasium.spaces import Discrete
from numpy.typing import NDArray

from ..core import MASK, Point, same
from ..envs.base import StepResult
from ..errors import short_repr
from ..simulation import Observation
from .fingerprint import fingerprint
from .report import PointStatistics, Range


class PointRecord:
    """The record of a decision point in episodes of random legal actions.

    Attributes:
        point: The decision point.
        decisions: The number of its decisions.
        outside: The first observation outside of its space, in words.
        seen: The first observation, and another one if they differ.
        tallies: The minimum, maximum, sum and number of "reward", "mask", and the parts of
            "observation".
    """

    def __init__(self, point: Point) -> None:
        self.point = point
        self.decisions = 0
        self.outside = ""
        self.seen: list[Observation] = []
        self.tallies: dict[str, NDArray[np.float64]] = {}

    def add(self, agent: str, answered: int, result: StepResult) -> None:
        """Add a result of ``last()`` to an agent that has ``answered`` so many decisions."""
        observation, reward, terminated, truncated, info = result
        if answered:
            self.tally("reward", reward)
        self.tally("observation", observation)
        if not (self.seen and same(self.seen[0], observation)):
            self.seen[1:] = [observation]
        space = self.point.definition.observation_space
        if not (self.outside or space.contains(observation)):
            text = short_repr(observation)
            self.outside = f"{agent} has observed {text}; the space is {space}"
        if not (terminated or truncated):
            self.decisions += 1
            self.tally("mask", info.get(MASK))

    def tally(self, name: str, value: Observation) -> None:
        """Add a number, an array, or a dict or tuple of these, to its tallies.

        Arrays of another shape than the first one are left out.
        """
        for path, part in fingerprint(name, value, follow=False).items():
            if MASK in path or not isinstance(part, (np.ndarray, np.generic, int, float)):
                continue
            array = np.array(part, float)
            new = np.array([array, array, array, np.ones_like(array)])
            old = self.tallies.setdefault(path.replace("['", ".").replace("']", ""), new)
            if old is not new and old.shape == new.shape:
                old[0] = np.minimum(old[0], array)
                old[1] = np.maximum(old[1], array)
                old[2:] += new[2:]

    def _ranges(self, name: str) -> list[Range]:
        """Return the range of each element of a tally."""
        low, high, total, number = self.tallies[name]
        return [
            Range(f"{name}{list(place) or ''}", low[place].item(), mean.item(), high[place].item())
            for place, mean in np.ndenumerate(total / number)
        ]

    def statistics(self) -> PointStatistics:
        """Return the statistics."""
        ranges = {name: self._ranges(name) for name in self.tallies}
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

    def findings(self) -> Iterator[tuple[str, str]]:
        """Yield the names and the evidence of findings."""
        statistics = self.statistics()
        # NaN makes sums NaN, infinite numbers make them infinite.
        infinite = [r for r in statistics.observations if not np.isfinite(r.minimum + r.maximum)]
        if infinite:
            yield "not_finite", "; ".join(map(str, infinite[:3]))
        elif self.outside:
            yield "outside", self.outside
        is_same = self.decisions > 1 and len(self.seen) == 1
        if is_same and self.point.definition.observation_space != Discrete(1):
            yield "same_observations", f"always {short_repr(self.seen[0])}"
        if statistics.never_legal:
            yield "never_legal", f"actions {', '.join(map(str, statistics.never_legal[:10]))}"
        rewards = statistics.rewards
        if self.decisions > 1 and rewards is not None and rewards.minimum == rewards.maximum:
            yield "same_rewards" if rewards.maximum else "zero_rewards", str(rewards)
