"""Statistics of episodes of random actions, by decision point, and the findings that follow from them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import short_repr
from .internals import MASK, Plan, point_of
from .report import Finding, PointStatistics, Range, finding


@dataclass
class _Spread:
    """The smallest, largest and mean values of an array, element by element."""

    low: NDArray[Any]
    high: NDArray[Any]
    total: NDArray[Any]
    number: int = 1

    def add(self, array: NDArray[Any]) -> None:
        if array.shape == self.total.shape:
            self.low, self.high = np.minimum(self.low, array), np.maximum(self.high, array)
            self.total, self.number = self.total + array, self.number + 1

    def ranges(self, name: str) -> Iterator[Range]:
        for place in np.ndindex(self.total.shape):
            values = self.low[place], self.total[place] / self.number, self.high[place]
            yield Range(f"{name}{list(place)}" if place else name, *map(float, values))


@dataclass
class _Collected:
    """What was collected at one decision point."""

    point: Any
    decisions: int = 0
    spreads: dict[str, _Spread] = field(default_factory=dict)  # of the reward and the components of observations
    legal: Any = False  # for each action of a masked space, whether it was legal at least once
    unfit: str = ""  # an observation outside of its space

    def record(self, name: str, value: Any) -> None:
        """Add a number, an array, or a dict or tuple of these."""
        if isinstance(value, Mapping):
            for key in value:
                if key != MASK:
                    self.record(f"{name}.{key}", value[key])
        elif isinstance(value, tuple):
            for number, part in enumerate(value):
                self.record(f"{name}.{number}", part)
        elif isinstance(value, (np.ndarray, np.generic, int, float)):
            array = np.asarray(value, float)
            if name in self.spreads:
                self.spreads[name].add(array)
            else:
                self.spreads[name] = _Spread(array, array, array)

    def results(self) -> tuple[PointStatistics, list[Finding]]:
        """Return the statistics, and what is wrong or worth knowing."""
        name = self.point.point.name
        start = int(getattr(self.point.definition.action_space, "start", 0))
        never = tuple((np.flatnonzero(~self.legal) + start).tolist()) if isinstance(self.legal, np.ndarray) else ()
        ranges = {spread: tuple(self.spreads[spread].ranges(spread)) for spread in self.spreads}
        rewards = ranges.pop("reward", (None,))[0]
        components = tuple(part for parts in ranges.values() for part in parts)
        agents = self.point.agent or "agents named by each call"
        statistics = PointStatistics(name, agents, self.decisions, components, rewards, never)
        if not self.decisions:
            return statistics, [finding("never_called", point=name)]
        findings = []
        if self.unfit:
            findings.append(finding("outside", self.unfit, point=name))
        if never:
            findings.append(finding("never_legal", f"actions {', '.join(map(str, never[:10]))}", point=name))
        if rewards and self.spreads["reward"].number > 1 and rewards.minimum == rewards.maximum:
            kind = "same_rewards" if rewards.minimum else "zero_rewards"
            findings.append(finding(kind, f"{self.spreads['reward'].number} rewards of {rewards.mean:.6g}", point=name))
        return statistics, findings


class Statistics:
    """Collects the statistics of all active decision points of a plan."""

    def __init__(self, plan: Plan) -> None:
        self._points = {(bound.point.name, bound.agent): _Collected(bound) for bound in plan.active}

    def collector(self) -> Callable[[Any, str, Any], None]:
        """Return a function that collects one episode: it is called with environment, agent and ``last()``."""
        acted: set[str] = set()  # only their rewards count

        def collect(env: Any, agent: str, step: Any) -> None:
            bound = point_of(env, agent)
            collected = self._points[bound.point.name, bound.agent]
            observation, reward, terminated, truncated, info = step
            collected.record("observation", observation)
            space = env.observation_space(agent)
            if not collected.unfit and not space.contains(observation):
                collected.unfit = f"{agent} has observed {short_repr(observation)}; the space is {space}"
            if agent in acted:
                collected.record("reward", reward)
            acted.add(agent)
            if not (terminated or truncated):
                collected.decisions += 1
                if isinstance(info.get(MASK), np.ndarray):
                    collected.legal = collected.legal | info[MASK].astype(bool)

        return collect

    def results(self) -> tuple[tuple[PointStatistics, ...], list[Finding]]:
        """Return the statistics of all points, and what is wrong or worth knowing."""
        results = [collected.results() for collected in self._points.values()]
        return tuple(statistics for statistics, _ in results), [one for _, found in results for one in found]
