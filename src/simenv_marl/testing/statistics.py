"""Statistics of episodes of random actions, by decision point, and the findings that follow from them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from ..errors import short_repr
from .internals import MASK, Plan, point_of
from .report import Finding, PointStatistics, Range, finding

_MOST: Final = 5_000_000
"""The largest number of numbers that are stored of an array."""


@dataclass
class _Collected:
    """What was collected at one decision point."""

    point: Any
    decisions: int = 0
    values: dict[str, list[Any]] = field(default_factory=dict)  # the rewards, and the arrays of observations
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
            array, known = np.array(value), self.values.setdefault(name, [])
            if not known or (array.shape == known[0].shape and len(known) * array.size < _MOST):
                known.append(array)

    def results(self, called: set[str]) -> tuple[PointStatistics, list[Finding]]:
        """Return the statistics, and what is wrong or worth knowing."""
        name = self.point.point.name
        start = int(getattr(self.point.definition.action_space, "start", 0))
        never = tuple((np.flatnonzero(~self.legal) + start).tolist()) if isinstance(self.legal, np.ndarray) else ()
        rewards = next(_ranges("reward", self.values.get("reward", [])), None)
        components = tuple(part for key in self.values if key != "reward" for part in _ranges(key, self.values[key]))
        agents = self.point.agent or "agents named by each call"
        statistics = PointStatistics(name, agents, self.decisions, components, rewards, never)
        if not self.decisions:
            return statistics, [] if name in called else [finding("never_called", point=name)]
        findings = []
        if self.unfit:
            findings.append(finding("outside", self.unfit, point=name))
        if never:
            findings.append(finding("never_legal", f"actions {', '.join(map(str, never[:10]))}", point=name))
        number = len(self.values.get("reward", ()))
        if rewards and number > 1 and rewards.minimum == rewards.maximum:
            kind = "same_rewards" if rewards.minimum else "zero_rewards"
            findings.append(finding(kind, f"{number} rewards of {rewards.mean:.6g}", point=name))
        return statistics, findings


def _ranges(name: str, values: list[Any]) -> Iterator[Range]:
    """Yield the ranges of all elements of arrays of the same shape."""
    array = np.array(values, float)
    for place in np.ndindex(array.shape[1:]) if values else ():
        part = array[(slice(None), *place)]
        yield Range(f"{name}{list(place)}" if place else name, float(part.min()), float(part.mean()), float(part.max()))


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

    def results(self, called: set[str]) -> tuple[tuple[PointStatistics, ...], list[Finding]]:
        """Return the statistics of all points, of which some were called in plain runs, and what is wrong."""
        results = [collected.results(called) for collected in self._points.values()]
        return tuple(statistics for statistics, _ in results), [one for _, found in results for one in found]
