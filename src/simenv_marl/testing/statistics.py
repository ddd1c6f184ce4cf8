"""Statistics of observations and rewards during episodes, and the findings that follow from them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import reduce, wraps
from operator import getitem
from typing import Any, Final, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ..decision import Definition
from .fingerprint import shown
from .inside import MASK, ActivePoint, Plan, redefined
from .report import ComponentStatistics, Finding, PointStatistics, finding
from .runs import Step

_ENOUGH: Final = 30
"""The number of observations that findings need."""

_HUGE: Final = 1e3
_HARDLY: Final = 0.01


class _Leaf(NamedTuple):
    """One part of an observation: a ``Box`` or another space of numbers, and its path."""

    name: str
    path: tuple[Any, ...]
    space: Any

    def bounds(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the lower and the upper bounds."""
        space = self.space
        if isinstance(space, spaces.Box):
            return space.low, space.high
        if isinstance(space, spaces.Discrete):
            return np.array(int(space.start)), np.array(int(space.start + space.n - 1))
        if isinstance(space, spaces.MultiDiscrete):
            return np.asarray(space.start), np.asarray(space.start + space.nvec - 1)
        return np.zeros(space.shape), np.ones(space.shape)

    def names(self) -> list[str]:
        """Return the names of its components."""
        shape = self.space.shape
        return [f"{self.name}{list(place)}" for place in np.ndindex(*shape)] if shape else [self.name]


def _leaves(space: spaces.Space[Any], name: str = "", path: tuple[Any, ...] = ()) -> Iterator[_Leaf]:
    if isinstance(space, spaces.Dict):
        for key, part in space.spaces.items():
            if key != MASK:
                yield from _leaves(part, f"{name}.{key}" if name else str(key), (*path, key))
    elif isinstance(space, spaces.Tuple):
        for number, part in enumerate(space.spaces):
            yield from _leaves(part, f"{name}({number})", (*path, number))
    elif isinstance(space, (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)):
        yield _Leaf(name, path, space)


def _flat(arrays: Iterable[NDArray[Any]]) -> NDArray[np.float64]:
    return np.concatenate([np.zeros(0), *(array.ravel().astype(np.float64) for array in arrays)])


class PointCollector:
    """Collects the statistics of one decision point."""

    def __init__(self, point: ActivePoint) -> None:
        self.point, self._space = point, point.definition.observation_space
        self._leaves = list(_leaves(self._space))
        # For all components of an observation, one after the other.
        self._names = [name for leaf in self._leaves for name in leaf.names()]
        self._dtypes = [leaf.space.dtype for leaf in self._leaves for _ in leaf.names()]
        self._boxes = [isinstance(leaf.space, spaces.Box) for leaf in self._leaves for _ in leaf.names()]
        self._whole = np.array([dtype.kind in "iub" for dtype in self._dtypes], np.bool_)
        self._low = _flat(leaf.bounds()[0] for leaf in self._leaves)
        self._high = _flat(leaf.bounds()[1] for leaf in self._leaves)
        size = len(self._names)
        self._least, self._most = np.full(size, np.inf), np.full(size, -np.inf)
        self._total, self._at_bounds, self._beyond = np.zeros(size), np.zeros(size), np.zeros(size)
        self._outside: dict[int, float] = {}
        self._lost: dict[tuple[str, Any], str] = {}  # what casts changed, by finding and dtype
        self.observations = self.decisions = 0
        self._unfit = ""
        self._legal: Any = None
        self._rewards: list[float] = []

    def observed(self, raw: Any) -> None:
        """Record an observation, as its mapping returned it."""
        try:
            parts = [np.asarray(reduce(getitem, leaf.path, raw)) for leaf in self._leaves]
        except (LookupError, TypeError, ValueError):
            return  # it does not fit its space at all, which the environment says
        pairs = list(zip(self._leaves, parts, strict=True))
        if any(part.dtype.kind not in "biuf" or part.shape != (leaf.space.shape or ()) for leaf, part in pairs):
            return
        given, values = _flat(parts), _flat(part.astype(leaf.space.dtype) for leaf, part in pairs)
        if (self._whole & ~(np.abs(given - values) < 1)).any():
            return  # numbers that the dtype cannot hold, which the environment refuses
        self.observations += 1
        np.fmin(self._least, values, out=self._least)
        np.fmax(self._most, values, out=self._most)
        self._total += values
        self._at_bounds += (values == self._low) | (values == self._high)
        beyond = ~((values >= self._low) & (values <= self._high))
        self._beyond += beyond
        for place in np.flatnonzero(beyond)[:3].tolist():
            self._outside.setdefault(place, float(values[place]))
        whole = _flat(np.full(part.shape, part.dtype.kind in "iu") for part in parts).astype(np.bool_)
        lost = (given != values) & np.isfinite(given) & (self._whole | whole | ~np.isfinite(values))
        for place in np.flatnonzero(lost)[:3].tolist():
            text = f"{self._names[place]} was {given[place]:.10g} and became {values[place]:.10g}".strip()
            self._lost.setdefault(("lost_fractions" if self._whole[place] else "rounded", self._dtypes[place]), text)

    def stepped(self, step: Step, *, first: bool) -> None:
        """Record a step of an agent; before its first action there is no reward."""
        observation, reward, terminated, truncated, info = step.told
        if not self._unfit and not self._space.contains(observation):
            self._unfit = shown(observation, 200)
        if not first:
            self._rewards.append(reward)
        if terminated or truncated:
            return
        self.decisions += 1
        mask = info.get(MASK)
        if isinstance(mask, np.ndarray):
            legal = mask.astype(bool)
            self._legal = legal if self._legal is None else self._legal | legal

    def _components(self) -> list[ComponentStatistics]:
        number = max(1, self.observations)
        columns = (self._low, self._high, self._least, self._most)
        shares = (self._total / number, self._at_bounds / number, self._beyond / number)
        rows = np.stack([*columns, *shares], axis=1).tolist()
        return [ComponentStatistics(name, *row) for name, row in zip(self._names, rows, strict=True)]

    def statistics(self) -> PointStatistics:
        """Return the statistics."""
        definition, rewards = self.point.definition, self._rewards
        return PointStatistics(
            point=self.point.name,
            agents=self.point.agents,
            observation_space=str(definition.observation_space),
            action_space=str(definition.action_space),
            observations=self.observations,
            components=tuple(self._components()) if self.observations else (),
            decisions=self.decisions,
            never_legal=() if self._legal is None else tuple(np.flatnonzero(~self._legal).tolist()),
            rewards=len(rewards),
            reward_minimum=min(rewards, default=0.0),
            reward_maximum=max(rewards, default=0.0),
            reward_mean=sum(rewards) / max(1, len(rewards)),
        )

    # -- what there is to say ---------------------------------------------------------------------

    def findings(self) -> Iterator[Finding]:
        """Yield what is wrong or worth knowing."""
        for name, evidence, dtype in self._found():
            yield finding(name, evidence, point=".".join(self.point.name.split(".")[-2:]), dtype=dtype)

    def _found(self) -> Iterator[tuple[str, str, Any]]:
        """Yield findings: the name, the evidence, and the dtype if it concerns one."""
        if not self.decisions:
            yield "never_called", "", None
            return
        outside = [
            f"{self._names[place] or 'the value'} was {value:.6g}, its bounds are {self._low[place]:.6g} to"
            f" {self._high[place]:.6g} ({self._beyond[place] / self.observations:.0%} of the time)"
            for place, value in self._outside.items()
        ]
        if outside or self._unfit:
            yield "outside", "; ".join(outside[:5]) or f"the observation {self._unfit}", None
        for (name, dtype), text in self._lost.items():
            yield name, text, dtype
        if self.observations >= _ENOUGH:
            yield from self._about_ranges()
        if self._legal is not None and not self._legal.all():
            start = int(getattr(self.point.definition.action_space, "start", 0))
            never = (np.flatnonzero(~self._legal) + start).tolist()
            yield "never_legal", _listed([f"action {action}" for action in never]), None
        if len(self._rewards) > 1:
            number, least, most = len(self._rewards), min(self._rewards), max(self._rewards)
            if least == most == 0:
                yield "zero_rewards", f"{number} rewards", None
            elif least == most:
                yield "same_rewards", f"{number} rewards of {least:.6g}", None
            elif max(abs(least), abs(most)) > _HUGE:
                yield "large_rewards", f"{least:.4g} to {most:.4g}", None

    def _about_ranges(self) -> Iterator[tuple[str, str, Any]]:
        """Yield findings about the ranges of components."""
        told: dict[str, list[str]] = {"constant": [], "narrow": [], "large": [], "unbounded": []}
        for part, box in zip(self._components(), self._boxes, strict=True):
            name = part.name or "the value"
            seen, width = f"{part.minimum:.4g} to {part.maximum:.4g}", part.high - part.low
            if part.constant:
                told["constant"].append(f"{name} = {part.minimum:.4g}")
            elif box and not part.beyond:
                if np.isfinite(width) and part.maximum - part.minimum < _HARDLY * width:
                    told["narrow"].append(f"{name}: {seen} of {part.low:.4g} to {part.high:.4g}")
                if max(abs(part.minimum), abs(part.maximum)) > _HUGE:
                    told["large"].append(f"{name}: {seen}")
            if box and not (np.isfinite(part.low) and np.isfinite(part.high)):
                told["unbounded"].append(f"{name}: seen {seen}")
        return ((name, _listed(texts), None) for name, texts in told.items() if texts)


def _listed(texts: Sequence[str], most: int = 5) -> str:
    more = f" and {len(texts) - most} more" if len(texts) > most else ""
    return "; ".join(texts[:most]) + more


class Collectors:
    """Collects the statistics of all decision points of a plan.

    Attributes:
        plan: The plan for the environment whose episodes are played.
        points: The collectors, in the order of the points.
    """

    def __init__(self, plan: Plan) -> None:
        self.points: list[PointCollector] = []
        self._by_agent: dict[str, PointCollector] = {}
        self.plan = redefined(plan, self._tapped)

    def _tapped(self, point: ActivePoint) -> Definition:
        """Return the definition of a point that also records observations and agents."""
        of, definition = PointCollector(point), point.definition
        self.points.append(of)
        if point.agent is not None:
            self._by_agent[point.agent] = of
        observe, name_agent = definition.observation_space_mapping, definition.agent

        @wraps(observe)
        def observing(*args: Any, **kwargs: Any) -> Any:
            value = observe(*args, **kwargs)
            of.observed(value)
            return value

        if not callable(name_agent):
            return replace(definition, observation_space_mapping=observing)

        @wraps(name_agent)
        def naming(*args: Any, **kwargs: Any) -> Any:
            agent = name_agent(*args, **kwargs)
            if isinstance(agent, str):
                self._by_agent[agent] = of
            return agent

        return replace(definition, observation_space_mapping=observing, agent=naming)

    def played(self, steps: Sequence[Step]) -> None:
        """Record the steps of an episode. Declared agents that never decided are left out."""
        met: set[str] = set()
        for step in steps:
            if step.agent in self._by_agent:
                self._by_agent[step.agent].stepped(step, first=step.agent not in met)
            met.add(step.agent)
