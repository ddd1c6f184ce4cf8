"""What observations and rewards range over while episodes are played, and what there is to say about that."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ..core.bindings import Binding
from ..core.plan import Plan
from ..core.spaces import MASK
from .fingerprint import shown
from .report import ComponentStatistics, Finding, PointStatistics
from .runs import Step

_ENOUGH: Final = 30
"""Of how many observations something can be said."""

_HUGE: Final = 1e3
_HARDLY: Final = 0.01


class _Leaf:
    """The values of one part of an observation, of a ``Box`` or of another kind of numbers."""

    def __init__(self, path: str, space: spaces.Space[Any]) -> None:
        self.path, self.space = path, space
        low, high = _bounds(space)
        self.low, self.high = low.ravel().astype(np.float64), high.ravel().astype(np.float64)
        size = self.low.size
        self.names = _names(path, low.shape)
        self.number = 0
        self.minimum, self.maximum = np.full(size, np.inf), np.full(size, -np.inf)
        self.total, self.at_bounds, self.beyond = np.zeros(size), np.zeros(size), np.zeros(size)
        self.outside: dict[int, float] = {}
        self.wrapped = self.cut_off = self.rounded = ""

    def add(self, raw: Any, value: Any) -> None:
        values = np.asarray(value, np.float64).ravel()
        self.number += 1
        np.fmin(self.minimum, values, out=self.minimum)
        np.fmax(self.maximum, values, out=self.maximum)
        self.total += values
        self.at_bounds += (values == self.low) | (values == self.high)
        beyond = ~((values >= self.low) & (values <= self.high))
        if beyond.any():
            self.beyond += beyond
            for place in np.flatnonzero(beyond)[:3]:
                self.outside.setdefault(int(place), float(values[place]))
        self._compare(raw, values)

    def _compare(self, raw: Any, values: NDArray[np.float64]) -> None:
        """See what the cast to the space's dtype has done."""
        dtype = self.space.dtype
        if dtype is None or isinstance(self.space, spaces.Discrete):
            return
        given = np.asarray(raw).ravel()
        if given.dtype == dtype or given.dtype.kind not in "iuf" or given.size != values.size:
            return
        changed = given.astype(np.float64) != values
        if not changed.any():
            return
        place = int(np.flatnonzero(changed)[0])
        before, after = float(given[place]), float(values[place])
        text = f"{self.names[place]} was {before:.10g} and became {after:.10g}".strip()
        if dtype.kind in "iub":
            if abs(before - after) >= 1:
                self.wrapped = self.wrapped or text
            else:
                self.cut_off = self.cut_off or text
        elif given.dtype.kind in "iu" or not np.isfinite(after):
            self.rounded = self.rounded or text

    def components(self) -> Iterator[ComponentStatistics]:
        number = max(1, self.number)
        for place, name in enumerate(self.names):
            yield ComponentStatistics(
                name=name,
                low=float(self.low[place]),
                high=float(self.high[place]),
                minimum=float(self.minimum[place]),
                maximum=float(self.maximum[place]),
                mean=float(self.total[place]) / number,
                at_bounds=float(self.at_bounds[place]) / number,
                beyond=float(self.beyond[place]) / number,
            )


def _bounds(space: spaces.Space[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    if isinstance(space, spaces.Box):
        return space.low, space.high
    if isinstance(space, spaces.Discrete):
        return np.array(int(space.start)), np.array(int(space.start + space.n - 1))
    if isinstance(space, spaces.MultiDiscrete):
        return np.asarray(space.start), np.asarray(space.start + space.nvec - 1)
    return np.zeros(space.shape or ()), np.ones(space.shape or ())


def _names(path: str, shape: tuple[int, ...]) -> list[str]:
    if not shape:
        return [path]
    return [f"{path}[{', '.join(map(str, place))}]" for place in np.ndindex(*shape)]


def _leaves(path: str, space: spaces.Space[Any]) -> Iterator[_Leaf]:
    if isinstance(space, spaces.Dict):
        for key, part in space.spaces.items():
            if key != MASK:
                yield from _leaves(f"{path}.{key}" if path else str(key), part)
    elif isinstance(space, spaces.Tuple):
        for number, part in enumerate(space.spaces):
            yield from _leaves(f"{path}({number})", part)
    elif isinstance(space, (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)):
        yield _Leaf(path, space)


def _values(space: spaces.Space[Any], raw: Any, value: Any) -> Iterator[tuple[Any, Any]]:
    if isinstance(space, spaces.Dict):
        for key, part in space.spaces.items():
            if key != MASK:
                yield from _values(part, raw[key], value[key])
    elif isinstance(space, spaces.Tuple):
        for part, one, other in zip(space.spaces, raw, value, strict=True):
            yield from _values(part, one, other)
    elif isinstance(space, (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)):
        yield raw, value


class PointCollector:
    """Collects what is to be known of one decision point."""

    def __init__(self, binding: Binding) -> None:
        self.binding = binding
        space = binding.definition.observation_space
        self._space, self._leaves = space, list(_leaves("", space))
        self.observations = self.decisions = self.rewards = 0
        self.unfit = ""
        self._legal: Any = None
        self._total, self._least, self._most = 0.0, np.inf, -np.inf

    def observed(self, raw: Any, value: Any) -> None:
        """Note an observation, as its mapping has returned it and as it was cast."""
        self.observations += 1
        for leaf, (one, other) in zip(self._leaves, _values(self._space, raw, value), strict=True):
            leaf.add(one, other)
        if not self.unfit and not self._space.contains(value):
            self.unfit = shown(value, 200)

    def stepped(self, step: Step, *, first: bool) -> None:
        """Note a step of an agent; the reward before its first action is none."""
        _, reward, terminated, truncated, info = step.told
        if not first:
            self.rewards += 1
            self._total += reward
            self._least, self._most = min(self._least, reward), max(self._most, reward)
        if terminated or truncated:
            return
        self.decisions += 1
        mask = info.get(MASK)
        if isinstance(mask, np.ndarray):
            legal = mask.astype(bool)
            self._legal = legal if self._legal is None else self._legal | legal

    def statistics(self) -> PointStatistics:
        """What was collected."""
        definition = self.binding.definition
        return PointStatistics(
            point=self.binding.point.name,
            agents=agents_in_words(self.binding),
            observation_space=str(definition.observation_space),
            action_space=str(definition.action_space),
            observations=self.observations,
            components=tuple(part for leaf in self._leaves for part in leaf.components()) if self.observations else (),
            decisions=self.decisions,
            never_legal=() if self._legal is None else tuple(int(place) for place in np.flatnonzero(~self._legal)),
            rewards=self.rewards,
            reward_minimum=float(self._least) if self.rewards else 0.0,
            reward_maximum=float(self._most) if self.rewards else 0.0,
            reward_mean=self._total / max(1, self.rewards),
        )

    # -- what there is to say ---------------------------------------------------------------------

    def findings(self) -> Iterator[Finding]:
        """What is wrong or worth knowing about what was collected."""
        name = short(self.binding.point.name)
        if not self.decisions:
            yield Finding(
                "warning",
                f"{name} was never called",
                "No episode asked for this decision, so that its agent cannot learn anything. Does the simulation"
                " call the function as an attribute of its class or module, and do episodes last long enough?",
            )
            return
        yield from self._about_fit(name)
        yield from self._about_casts(name)
        if self.observations >= _ENOUGH:
            yield from self._about_ranges(name)
        yield from self._about_actions(name)
        yield from self._about_rewards(name)

    def _about_fit(self, name: str) -> Iterator[Finding]:
        outside = [
            (leaf.names[place], value, leaf.low[place], leaf.high[place], leaf.beyond[place] / leaf.number)
            for leaf in self._leaves
            for place, value in leaf.outside.items()
        ]
        if not outside and not self.unfit:
            return
        seen = "; ".join(
            f"{part or 'the value'} was {value:.6g}, its bounds are {low:.6g} to {high:.6g} ({share:.0%} of the time)"
            for part, value, low, high, share in outside[:5]
        )
        yield Finding(
            "error",
            f"Observations at {name} lie outside their space",
            "Learning code relies on the bounds (to normalise, or to size its networks). Widen the observation_space,"
            " or clip in the observation_space_mapping.",
            seen or f"the observation {self.unfit}",
        )

    def _about_casts(self, name: str) -> Iterator[Finding]:
        for leaf in self._leaves:
            dtype = leaf.space.dtype
            if leaf.wrapped:
                yield Finding(
                    "error",
                    f"Observations at {name} are turned into other numbers by their dtype {dtype}",
                    f"{dtype} cannot hold what the mapping returns, and wraps it around. Choose a dtype that can.",
                    leaf.wrapped,
                )
            if leaf.cut_off:
                yield Finding(
                    "warning",
                    f"Observations at {name} lose their fractions to their dtype {dtype}",
                    "Choose a floating dtype for the observation_space, or round in the mapping if that is meant.",
                    leaf.cut_off,
                )
            if leaf.rounded:
                yield Finding(
                    "warning",
                    f"Observations at {name} are too large for their dtype {dtype}",
                    f"Different numbers become the same in {dtype}. Scale them down in the mapping, or choose a wider"
                    " dtype.",
                    leaf.rounded,
                )

    def _about_ranges(self, name: str) -> Iterator[Finding]:
        parts = [part for leaf in self._leaves for part in leaf.components()]
        constant = [part for part in parts if part.constant]
        if constant:
            yield Finding(
                "note",
                f"Parts of the observations at {name} never change",
                "What is always the same tells an agent nothing. Leave it out, unless it differs between set-ups.",
                _listed(f"{part.name or 'the value'} = {part.minimum:.4g}" for part in constant),
            )
        boxes = [part for leaf in self._leaves if isinstance(leaf.space, spaces.Box) for part in leaf.components()]
        moving = [part for part in boxes if not part.constant and not part.beyond]
        hardly = [
            part
            for part in moving
            if np.isfinite(width := part.high - part.low) and part.maximum - part.minimum < _HARDLY * width
        ]
        if hardly:
            yield Finding(
                "note",
                f"Observations at {name} use hardly any of their bounds",
                "Less than a hundredth of the room between the bounds was used. Learning code that normalises by the"
                " bounds sees almost the same number all the time. Bounds nearer to what occurs help.",
                _listed(
                    f"{part.name or 'the value'}: {part.minimum:.4g} to {part.maximum:.4g} of {part.low:.4g} to"
                    f" {part.high:.4g}"
                    for part in hardly
                ),
            )
        huge = [part for part in moving if max(abs(part.minimum), abs(part.maximum)) > _HUGE]
        if huge:
            yield Finding(
                "note",
                f"Observations at {name} are large numbers",
                "Neural networks learn best from numbers of about -1 to 1. Scale these in the mapping, or normalise"
                " observations in the training code.",
                _listed(f"{part.name or 'the value'}: {part.minimum:.4g} to {part.maximum:.4g}" for part in huge),
            )
        endless = [part for part in boxes if not (np.isfinite(part.low) and np.isfinite(part.high))]
        if endless:
            yield Finding(
                "note",
                f"Observations at {name} have infinite bounds",
                "That is allowed, and leaves nothing to normalise by. Where you know bounds, give them.",
                _listed(
                    f"{part.name or 'the value'}: seen {part.minimum:.4g} to {part.maximum:.4g}" for part in endless
                ),
            )

    def _about_actions(self, name: str) -> Iterator[Finding]:
        never = self.statistics().never_legal
        if never:
            yield Finding(
                "note",
                f"Some actions at {name} were never legal",
                "Either the episodes were too few to see them legal, or the action space is larger than it need be.",
                _listed(f"action {action + _start(self.binding)}" for action in never),
            )

    def _about_rewards(self, name: str) -> Iterator[Finding]:
        if self.rewards < 2:
            return
        if self._least == self._most == 0:
            yield Finding(
                "warning",
                f"Rewards at {name} are always zero",
                "Random actions were never rewarded. If the reward is rare, that makes learning hard; if it is not,"
                " look at the reward_mapping.",
                f"{self.rewards} rewards",
            )
        elif self._least == self._most:
            yield Finding(
                "note",
                f"Rewards at {name} are always the same",
                "Whatever random actions did, it was paid alike. Look at the reward_mapping, unless only the length"
                " of the episode is to count.",
                f"{self.rewards} rewards of {self._least:.6g}",
            )
        elif max(abs(self._least), abs(self._most)) > _HUGE:
            yield Finding(
                "note",
                f"Rewards at {name} are large numbers",
                "Many learning algorithms are set up for rewards of about -1 to 1. Scale them in the reward_mapping,"
                " or normalise them in the training code.",
                f"{self._least:.4g} to {self._most:.4g}",
            )


def _start(binding: Binding) -> int:
    space = binding.definition.action_space
    return int(space.start) if isinstance(space, spaces.Discrete) else 0


def _listed(texts: Iterator[str], most: int = 5) -> str:
    listed = list(texts)
    more = f" and {len(listed) - most} more" if len(listed) > most else ""
    return "; ".join(listed[:most]) + more


def short(name: str) -> str:
    """The last two parts of a dotted name."""
    return ".".join(name.split(".")[-2:])


def agents_in_words(binding: Binding) -> str:
    """Who decides at a point: its agent, or that each call names one."""
    return binding.agent if binding.agent is not None else "agents named by each call"


def collectors(plan: Plan) -> Mapping[str, PointCollector]:
    """Have the observations of a plan collected, by point. Environments of that plan must be for nothing else."""
    made = {}
    for binding in plan.active:
        made[binding.point.name] = collector = PointCollector(binding)
        _tap(binding, collector)
    return made


def _tap(binding: Binding, collector: PointCollector) -> None:
    cast = binding.cast

    def collecting(value: Any) -> Any:
        result = cast(value)
        collector.observed(value, result)
        return result

    binding.cast = collecting
