"""Statistics of observations and rewards during episodes, and the findings that follow from them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import reduce, wraps
from operator import getitem
from statistics import fmean
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ..decision import Definition
from ..errors import short_repr
from .internals import MASK, Plan, redefined
from .report import ComponentStatistics, Finding, PointStatistics, finding
from .runs import Step

_ENOUGH: Final = 30
"""The number of observations that findings about ranges need."""

_MOST_NUMBERS: Final = 5_000_000
"""The number of values that are stored of the observations at one point."""

_LARGE: Final = 1e3
_NARROW: Final = 0.01


def _leaves(space: Any, name: str = "", path: tuple[Any, ...] = ()) -> Iterator[tuple[str, tuple[Any, ...], Any]]:
    """Yield the parts of a space that are arrays of numbers: name, path in an observation, and space."""
    if isinstance(space, spaces.Dict):
        for key, part in space.spaces.items():
            if key != MASK:
                yield from _leaves(part, f"{name}.{key}" if name else str(key), (*path, key))
    elif isinstance(space, spaces.Tuple):
        for number, part in enumerate(space.spaces):
            yield from _leaves(part, f"{name}({number})", (*path, number))
    elif isinstance(space, (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)):
        yield name, path, space


def _bounds(space: Any) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the lower and the upper bounds of a leaf."""
    if isinstance(space, spaces.Box):
        return space.low, space.high
    if isinstance(space, spaces.MultiBinary):
        return np.zeros(space.shape), np.ones(space.shape)
    return np.asarray(space.start), np.asarray(space.start + getattr(space, "nvec", getattr(space, "n", 0)) - 1)


class PointCollector:
    """Collects the statistics of one decision point."""

    def __init__(self, bound: Any) -> None:
        self.name, self.agents = bound.point.name, bound.agent or "agents named by each call"
        self.definition: Definition = bound.definition
        self._leaves = list(_leaves(self.definition.observation_space))
        self._values: list[list[NDArray[Any]]] = [[] for _ in self._leaves]  # of each leaf, as mappings returned them
        self._numbers = sum(int(np.prod(space.shape)) for _, _, space in self._leaves)
        self._observations = self._decisions = 0
        self._unfit = ""
        self._legal: Any = None
        self._rewards: list[float] = []
        self._members = {bound.agent}

    def recording(self) -> Definition:
        """Return the definition of the point that also records observations and the names of agents."""
        observe, name_agent = self.definition.observation_space_mapping, self.definition.agent

        @wraps(observe)
        def observing(*args: Any, **kwargs: Any) -> Any:
            value = observe(*args, **kwargs)
            self._add_observation(value)
            return value

        if not callable(name_agent):
            return replace(self.definition, observation_space_mapping=observing)

        @wraps(name_agent)
        def naming(*args: Any, **kwargs: Any) -> Any:
            agent = name_agent(*args, **kwargs)
            if isinstance(agent, str):
                self._members.add(agent)
            return agent

        return replace(self.definition, observation_space_mapping=observing, agent=naming)

    def _add_observation(self, observation: Any) -> None:
        """Record what a mapping returned. What the environment refuses is not counted."""
        parts = []
        for _, path, space in self._leaves:
            try:
                part = np.array(reduce(getitem, path, observation))
            except (LookupError, TypeError, ValueError):
                return
            if part.dtype.kind not in "biuf" or part.shape != space.shape:
                return
            if space.dtype.kind in "iub" and not (np.abs(part - part.astype(space.dtype).astype(float)) < 1).all():
                return
            parts.append(part)
        self._observations += 1
        if self._observations * self._numbers <= _MOST_NUMBERS:
            for values, part in zip(self._values, parts, strict=True):
                values.append(part)

    def add_episode(self, steps: Sequence[tuple[str, Step]]) -> None:
        """Record the steps of an episode. Before its first action an agent gets no reward."""
        met = set()
        for agent, step in steps:
            if agent not in self._members:
                continue
            if not self._unfit and not self.definition.observation_space.contains(step.observation):
                self._unfit = short_repr(step.observation)
            if agent in met:
                self._rewards.append(step.reward)
            met.add(agent)
            if step.terminated or step.truncated:
                continue
            self._decisions += 1
            mask = step.info.get(MASK)
            if isinstance(mask, np.ndarray):
                self._legal = mask.astype(bool) if self._legal is None else self._legal | mask.astype(bool)

    def results(self) -> tuple[PointStatistics, list[Finding]]:
        """Return the statistics, and what is wrong or worth knowing."""
        components: list[ComponentStatistics] = []
        noted: dict[str, list[str]] = {"outside": []}
        for part, notes in self._components():
            components.append(part)
            for name, text in notes:
                noted.setdefault(name, []).append(text)
        if self._unfit and not noted["outside"]:
            noted["outside"].append(f"the observation {self._unfit}")
        start = int(getattr(self.definition.action_space, "start", 0))
        never = () if self._legal is None else tuple((np.flatnonzero(~self._legal) + start).tolist())
        if never:
            noted["never_legal"] = [f"action {action}" for action in never]
        rewards = self._rewards or [np.nan]
        least, most, what = min(rewards), max(rewards), "Observations"
        statistics = PointStatistics(
            point=self.name,
            agents=self.agents,
            observation_space=str(self.definition.observation_space),
            action_space=str(self.definition.action_space),
            observations=self._observations,
            components=tuple(components),
            decisions=self._decisions,
            never_legal=never,
            rewards=len(self._rewards),
            reward_minimum=least,
            reward_maximum=most,
            reward_mean=fmean(rewards),
        )
        point = ".".join(self.name.split(".")[-2:])
        if not self._decisions:
            return statistics, [finding("never_called", point=point)]
        findings = [finding(name, _listed(texts), point=point, what=what) for name, texts in noted.items() if texts]
        if len(rewards) > 1 and least == most:
            name = "same_rewards" if least else "zero_rewards"
            findings.append(finding(name, f"{len(rewards)} rewards of {least:.6g}", point=point))
        elif max(abs(least), abs(most)) > _LARGE:
            findings.append(finding("large", f"{least:.4g} to {most:.4g}", point=point, what="Rewards"))
        return statistics, findings

    def _components(self) -> Iterator[tuple[ComponentStatistics, list[tuple[str, str]]]]:
        """Yield the components of observations, and what is remarkable: names of findings, with evidence."""
        for (leaf, _, space), values in zip(self._leaves, self._values, strict=True):
            low, high = _bounds(space)
            for place in np.ndindex(*space.shape) if values else ():
                raw = np.array([value[place] for value in values], float)
                cast = raw.astype(space.dtype).astype(float)
                part = ComponentStatistics(
                    name=f"{leaf}{list(place)}" if place else leaf,
                    low=float(low[place]),
                    high=float(high[place]),
                    minimum=float(cast.min()),
                    maximum=float(cast.max()),
                    mean=float(cast.mean()),
                    at_bounds=float(((cast == low[place]) | (cast == high[place])).mean()),
                    beyond=float((~((cast >= low[place]) & (cast <= high[place]))).mean()),
                )
                yield part, [*_losses(part.name, space.dtype, raw, cast), *_ranges(part, space, len(cast))]


def _losses(name: str, dtype: Any, raw: NDArray[Any], cast: NDArray[Any]) -> Iterator[tuple[str, str]]:
    """Yield the first number that a dtype cannot hold. Fractions that are only rounded are not reported."""
    unexpected = (raw == np.trunc(raw)) | ~np.isfinite(cast) if dtype.kind == "f" else True
    places = np.flatnonzero((raw != cast) & np.isfinite(raw) & unexpected)
    if len(places):
        text = f"{name} was {raw[places[0]]:.10g} and became {cast[places[0]]:.10g} ({dtype})"
        yield "rounded" if dtype.kind == "f" else "lost_fractions", text.strip()


def _ranges(part: ComponentStatistics, space: Any, number: int) -> Iterator[tuple[str, str]]:
    """Yield what is remarkable in the range of a component."""
    name, width = part.name or "the value", part.high - part.low
    text = f"{name}: {part.minimum:.4g} to {part.maximum:.4g} (bounds {part.low:.4g} to {part.high:.4g})"
    if part.beyond:
        yield "outside", f"{text}, outside for {part.beyond:.0%} of the time"
    if number < _ENOUGH:
        return
    if part.constant:
        yield "constant", f"{name} = {part.minimum:.4g}"
    elif isinstance(space, spaces.Box) and not part.beyond:
        if np.isfinite(width) and part.maximum - part.minimum < _NARROW * width:
            yield "narrow", text
        if max(abs(part.minimum), abs(part.maximum)) > _LARGE:
            yield "large", text
    if isinstance(space, spaces.Box) and not np.isfinite(width):
        yield "unbounded", text


def _listed(texts: Sequence[str]) -> str:
    return "; ".join(texts[:5]) + (f" and {len(texts) - 5} more" if len(texts) > 5 else "")


def collecting(plan: Plan) -> tuple[Plan, list[PointCollector]]:
    """Return a plan whose environments also record observations, and the collectors of its points."""
    collectors = []

    def change(bound: Any) -> Definition:
        collectors.append(PointCollector(bound))
        return collectors[-1].recording()

    return redefined(plan, change), collectors
