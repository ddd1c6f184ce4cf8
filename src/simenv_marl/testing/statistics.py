"""Statistics of observations and rewards during episodes, and the findings that follow from them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
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

_Leaf = tuple[str, tuple[Any, ...], Any]
"""A part of a space that is an array of numbers: its name, its path in an observation, and its space."""


def _leaves(space: Any, name: str = "", path: tuple[Any, ...] = ()) -> Iterator[_Leaf]:
    if isinstance(space, spaces.Dict):
        for key, part in space.spaces.items():
            if key != MASK:
                yield from _leaves(part, f"{name}.{key}" if name else str(key), (*path, key))
    elif isinstance(space, spaces.Tuple):
        for number, part in enumerate(space.spaces):
            yield from _leaves(part, f"{name}({number})", (*path, number))
    elif isinstance(space, (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)):
        yield name, path, space


def _bounds(space: Any) -> tuple[Any, Any]:
    """Return the lower and the upper bounds of a leaf."""
    if isinstance(space, spaces.Box):
        return space.low, space.high
    if isinstance(space, spaces.MultiBinary):
        return np.zeros(space.shape), np.ones(space.shape)
    return space.start, space.start + getattr(space, "nvec", getattr(space, "n", 0)) - 1


def _flat(arrays: Iterable[Any]) -> NDArray[np.float64]:
    return np.concatenate([np.zeros(0), *(np.asarray(array, np.float64).ravel() for array in arrays)])


class PointCollector:
    """Collects the statistics of one decision point. Its arrays have a column for each component of an observation."""

    def __init__(self, bound: Any) -> None:
        self.name, self.agents = bound.point.name, bound.agent or "agents named by each call"
        self.definition: Definition = bound.definition
        self._leaves = list(_leaves(self.definition.observation_space))
        self._names, self._spaces = [], []  # of the components
        for name, _, space in self._leaves:
            for place in np.ndindex(*space.shape):
                self._names.append(f"{name}{list(place)}" if place else name)
                self._spaces.append(space)
        self._low, self._high = (_flat(_bounds(space)[side] for _, _, space in self._leaves) for side in (0, 1))
        self._raw: list[NDArray[np.float64]] = []  # as mappings returned them ...
        self._cast: list[NDArray[np.float64]] = []  # ... and as their dtypes hold them
        self.observations = self.decisions = 0
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
        try:
            parts = [np.asarray(reduce(getitem, path, observation)) for _, path, _ in self._leaves]
        except (LookupError, TypeError, ValueError):
            return
        raw, cast = [], []
        for part, (_, _, space) in zip(parts, self._leaves, strict=True):
            if part.dtype.kind not in "biuf" or part.shape != space.shape:
                return
            raw.append(part)
            cast.append(part.astype(space.dtype))
            if space.dtype.kind in "iub" and not (np.abs(part - cast[-1].astype(float)) < 1).all():
                return
        self.observations += 1
        if len(self._cast) * len(self._names) < _MOST_NUMBERS:
            self._raw.append(_flat(raw))
            self._cast.append(_flat(cast))

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
            self.decisions += 1
            mask = step.info.get(MASK)
            if isinstance(mask, np.ndarray):
                self._legal = mask.astype(bool) if self._legal is None else self._legal | mask.astype(bool)

    def statistics(self) -> PointStatistics:
        """Return the statistics."""
        return PointStatistics(
            point=self.name,
            agents=self.agents,
            observation_space=str(self.definition.observation_space),
            action_space=str(self.definition.action_space),
            observations=self.observations,
            components=tuple(self._components()),
            decisions=self.decisions,
            never_legal=self._never_legal(),
            rewards=len(self._rewards),
            reward_minimum=min(self._rewards, default=np.nan),
            reward_maximum=max(self._rewards, default=np.nan),
            reward_mean=fmean(self._rewards) if self._rewards else np.nan,
        )

    def _components(self) -> Iterator[ComponentStatistics]:
        if not self._cast:
            return
        values, low, high = np.array(self._cast), self._low, self._high
        at_bounds = (values == low) | (values == high)
        beyond = ~((values >= low) & (values <= high))
        columns = [low, high, values.min(0), values.max(0), values.mean(0), at_bounds.mean(0), beyond.mean(0)]
        for name, row in zip(self._names, np.stack(columns, axis=1).tolist(), strict=True):
            yield ComponentStatistics(name, *row)

    def _never_legal(self) -> tuple[int, ...]:
        if self._legal is None:
            return ()
        start = int(getattr(self.definition.action_space, "start", 0))
        return tuple((np.flatnonzero(~self._legal) + start).tolist())

    def findings(self) -> Iterator[Finding]:
        """Yield what is wrong or worth knowing."""
        point = ".".join(self.name.split(".")[-2:])
        if not self.decisions:
            yield finding("never_called", point=point)
            return
        for name, texts in self._remarkable_components().items():
            if name == "outside" and self._unfit:
                texts = texts or [f"the observation {self._unfit}"]
            if texts:
                yield finding(name, _listed(texts), point=point, what="Observations")
        if never := self._never_legal():
            yield finding("never_legal", _listed([f"action {action}" for action in never]), point=point)
        if len(self._rewards) > 1:
            least, most = min(self._rewards), max(self._rewards)
            if least == most:
                name = "same_rewards" if least else "zero_rewards"
                yield finding(name, f"{len(self._rewards)} rewards of {least:.6g}", point=point)
            elif max(abs(least), abs(most)) > _LARGE:
                yield finding("large", f"{least:.4g} to {most:.4g}", point=point, what="Rewards")

    def _remarkable_components(self) -> dict[str, list[str]]:
        """Describe components by the name of the finding."""
        names = ("outside", "lost_fractions", "rounded", "constant", "narrow", "large", "unbounded")
        found: dict[str, list[str]] = {name: [] for name in names}
        for column, part in enumerate(self._components()):
            name, space, width = part.name or "the value", self._spaces[column], part.high - part.low
            text = f"{name}: {part.minimum:.4g} to {part.maximum:.4g} (bounds {part.low:.4g} to {part.high:.4g})"
            if part.beyond:
                found["outside"].append(f"{text}, outside for {part.beyond:.0%} of the time")
            loss = self._loss(column, space.dtype)
            if loss:
                found["rounded" if space.dtype.kind == "f" else "lost_fractions"].append(
                    f"{name} {loss} ({space.dtype})"
                )
            if len(self._cast) < _ENOUGH:
                continue
            if part.constant:
                found["constant"].append(f"{name} = {part.minimum:.4g}")
            elif isinstance(space, spaces.Box) and not part.beyond:
                if np.isfinite(width) and part.maximum - part.minimum < _NARROW * width:
                    found["narrow"].append(text)
                if max(abs(part.minimum), abs(part.maximum)) > _LARGE:
                    found["large"].append(text)
            if isinstance(space, spaces.Box) and not np.isfinite(width):
                found["unbounded"].append(text)
        return found

    def _loss(self, column: int, dtype: Any) -> str:
        """Describe how a cast has changed a number that the dtype cannot hold; empty if none has."""
        raw, cast = (np.array([row[column] for row in rows]) for rows in (self._raw, self._cast))
        unexpected = (raw == np.trunc(raw)) | ~np.isfinite(cast) if dtype.kind == "f" else True
        places = np.flatnonzero((raw != cast) & np.isfinite(raw) & unexpected)
        return f"was {raw[places[0]]:.10g} and became {cast[places[0]]:.10g}" if len(places) else ""


def _listed(texts: Sequence[str]) -> str:
    return "; ".join(texts[:5]) + (f" and {len(texts) - 5} more" if len(texts) > 5 else "")


def collecting(plan: Plan) -> tuple[Plan, list[PointCollector]]:
    """Return a plan whose environments also record observations, and the collectors of its points."""
    collectors = []

    def change(bound: Any) -> Definition:
        collectors.append(PointCollector(bound))
        return collectors[-1].recording()

    return redefined(plan, change), collectors
