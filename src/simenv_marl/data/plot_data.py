"""The data of plots: an episode as one row per agent, in panels of agents with like actions; and returns."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ..errors import OptionValueError, UnknownAgentError, did_you_mean, short_repr
from .trajectories import Trajectories

CHARTED: Final = 6
"""The largest number of agents that have a chart each. More agents have a row of colours each."""

NAMED: Final = 12
"""The largest number of different actions that have a colour each. More actions share a colour scale."""

ENDS: Final = {"x": "terminated", "|": "truncated"}
"""The marks of terminations and truncations."""


@dataclass(frozen=True)
class Leaf:
    """One array of a policy's actions.

    Attributes:
        name: Its index in the action; empty if the action is one array.
        width: The number of its components.
        names: The names of its numbers, where each number has a colour.
        limits: The smallest and the largest number, in all episodes.
    """

    name: str
    width: int
    names: Mapping[int, str] | None
    limits: tuple[float, float]

    def component(self, place: int) -> str:
        """Return the name of one of its components."""
        return f"{self.name}[{place}]" if self.width > 1 else self.name


@dataclass(frozen=True)
class Row:
    """One agent in the episode: the key of its policy, its name, and its decisions (``rows`` of ``found``).

    Attributes:
        actions: For each leaf, ``(decisions, width)``.
        at, end: The times of its decisions, and the end of its trajectory.
    """

    key: Any
    name: str
    found: Trajectories
    rows: slice
    actions: Sequence[NDArray[Any]]
    at: NDArray[Any]
    end: float

    @property
    def known(self) -> NDArray[np.bool_]:
        """Return, for each decision, whether its action is known."""
        return self.found.known[self.rows]

    @property
    def ruled(self) -> NDArray[np.bool_]:
        """Return, for each decision, whether it was left to the rule."""
        return self.found.by_rule[self.rows]

    @property
    def ends(self) -> list[str]:
        """Return the marks of the agent's end."""
        last = self.rows.stop - 1
        return [
            mark for mark, how in zip(ENDS, (self.found.terminations, self.found.truncations), strict=True) if how[last]
        ]


@dataclass(frozen=True)
class Panel:
    """Agents with like actions: those of one policy, or of several."""

    title: str
    rows: list[Row]
    leaves: list[Leaf]


def by_policy(trajectories: Any) -> Mapping[Any, Trajectories]:
    """Return the trajectories to draw as a dict by policy key."""
    if isinstance(trajectories, Trajectories):
        return {None: trajectories}
    if not isinstance(trajectories, Mapping) or not all(isinstance(v, Trajectories) for v in trajectories.values()):
        raise OptionValueError(
            f"only the dict of Trajectories that collect_episodes returned can be drawn, not {short_repr(trajectories)}"
        )
    if not trajectories:
        raise OptionValueError("there is nothing to draw: no policy has answered any decision")
    return trajectories


def checked_episode(episode: Any, parts: Mapping[Any, Trajectories]) -> int:
    """Return the number of an episode. Negative numbers count from the end.

    Raises:
        OptionValueError: The episode does not exist.
    """
    number = min(len(found.seeds) for found in parts.values())
    try:
        place = operator.index(episode)
    except TypeError:
        raise OptionValueError(f"episode must be the number of an episode, not {short_repr(episode)}") from None
    if not -number <= place < number:
        raise OptionValueError(f"there is no episode {place}; there are {number}, counted from 0")
    return place % number


def panels_of(parts: Mapping[Any, Trajectories], episode: int, agents: Any, action_names: Any) -> list[Panel]:
    """Return one panel per policy, or a single panel if there are many policies with like actions.

    Raises:
        OptionValueError: No agent decided in the episode, or an argument has an invalid value.
        UnknownAgentError: One of the agents did not decide in the episode.
    """
    leaves: dict[Any, list[Leaf]] = {}
    rows: list[Row] = []
    timed = all(found.times is not None for found in parts.values() if (found.episodes == episode).any())
    for key, found in parts.items():
        if (found.episodes == episode).any():
            pairs = _taken_apart(found.actions, found.known, _namer(key, action_names))
            leaves[key] = [leaf for leaf, _ in pairs]
            rows += _rows(key, found, [array for _, array in pairs], episode, timed)
    if not leaves:
        seed = next(iter(parts.values())).seeds[episode]
        raise OptionValueError(
            f"there is nothing to draw of episode {episode} (seed {seed}): no agent has decided in it"
        )
    if agents is not None:
        rows = _chosen(rows, agents, episode)
    keys = dict.fromkeys(row.key for row in rows)
    alike = len({tuple((leaf.name, leaf.width, leaf.names is None) for leaf in leaves[key]) for key in keys}) == 1
    if len(keys) <= CHARTED or not alike:
        return [Panel(title_of(key), [row for row in rows if row.key == key], leaves[key]) for key in keys]
    shared = [_shared(same) for same in zip(*(leaves[key] for key in keys), strict=True)]
    return [Panel("", sorted(rows, key=lambda row: int(row.found.turns[row.rows.start])), shared)]


def _rows(key: Any, found: Trajectories, arrays: Sequence[NDArray[Any]], episode: int, timed: bool) -> Iterator[Row]:
    for place in np.flatnonzero(found.episodes[found.starts] == episode):
        start = int(found.starts[place])
        own = slice(start, start + int(found.lengths[place]))
        at: NDArray[Any] = found.turns[own]
        end = float(found.last_turns[place])
        if timed and found.times is not None and found.elapsed is not None:
            at, end = found.times[own], float(found.times[own.stop - 1] + found.elapsed[own.stop - 1])
        yield Row(key, found.names[found.agents[start]], found, own, [array[own] for array in arrays], at, end)


def _chosen(rows: Sequence[Row], agents: Any, episode: int) -> list[Row]:
    if isinstance(agents, str) or not agents:
        raise OptionValueError(f"agents must be a sequence of names, not {short_repr(agents)}")
    by_name = {row.name: row for row in rows}
    for name in agents:
        if name not in by_name:
            raise UnknownAgentError(
                f"{short_repr(name)} did not decide in episode {episode}; these agents did:"
                f" {', '.join(list(by_name)[:20])}{' and others' if len(by_name) > 20 else ''}"
            )
    return [by_name[name] for name in dict.fromkeys(agents)]


def _namer(key: Any, action_names: Any) -> Callable[[int], str]:
    if isinstance(action_names, Mapping) and not isinstance(action_names.get(key, ""), str):
        action_names = action_names[key]
    if action_names is None:
        return str
    if isinstance(action_names, (str, bytes)) or not isinstance(action_names, (Mapping, Sequence)):
        raise OptionValueError(f"action_names must be a sequence or a dict of names, not {short_repr(action_names)}")
    names = action_names if isinstance(action_names, Mapping) else dict(enumerate(action_names))
    return lambda action: str(names.get(action, action))


def _taken_apart(
    actions: Any, known: NDArray[np.bool_], name: Callable[[int], str], prefix: str = ""
) -> list[tuple[Leaf, NDArray[Any]]]:
    """Split actions into leaves, each with its array. Some actions may be unknown."""
    if isinstance(actions, Mapping):
        parts = [(f"{prefix}[{key!r}]" if prefix else str(key), part) for key, part in actions.items()]
        return [found for index, part in parts for found in _taken_apart(part, known, name, index)]
    if isinstance(actions, tuple):
        places = enumerate(actions)
        return [found for place, part in places for found in _taken_apart(part, known, name, f"{prefix}[{place}]")]
    values = actions.reshape(len(actions), -1)
    if actions.dtype == object:  # values without a shape are distinguished by their text
        texts, codes = np.unique([str(action) for action in actions], return_inverse=True)
        values = codes.reshape(-1, 1)
        name = [text if len(text) < 20 else f"{text[:18]}…" for text in texts.tolist()].__getitem__
    different = np.unique(values[known]).tolist() if values.dtype.kind in "iub" else []
    names = {int(value): name(int(value)) for value in different} if 0 < len(different) <= NAMED else None
    finite = values[known][np.isfinite(values[known])]
    limits = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
    return [(Leaf(prefix, values.shape[1], names, limits), values)]


def _shared(leaves: Sequence[Leaf]) -> Leaf:
    """Return one leaf for the same leaf of several policies."""
    named = [item for leaf in leaves for item in (leaf.names or {}).items()]
    names = None if leaves[0].names is None else dict(sorted(named))
    limits = min(leaf.limits[0] for leaf in leaves), max(leaf.limits[1] for leaf in leaves)
    return replace(leaves[0], names=names, limits=limits)


def title_of(key: Any) -> str:
    """Return the title for a policy's key: the last two parts of a dotted name."""
    return "" if key is None else ".".join(str(getattr(key, "__qualname__", key)).split(".")[-2:])


# -- rows of colours ------------------------------------------------------------------------------


def coloured_by(panels: Sequence[Panel], component: str | None) -> list[tuple[Leaf, int]]:
    """Return, for each panel, the leaf and the component by which its rows are coloured.

    Raises:
        OptionValueError: There is no such component.
    """
    known = [
        {leaf.component(place): (leaf, place) for leaf in panel.leaves for place in range(leaf.width)}
        for panel in panels
    ]
    if component is not None and not any(component in own for own in known):
        components = dict.fromkeys(name for own in known for name in own)
        names = ", ".join(map(repr, components))
        raise OptionValueError(
            f"no action has a component {short_repr(component)}; there are {names}{did_you_mean(component, components)}"
        )
    return [own.get(component or "", next(iter(own.values()))) for own in known]


def cells_of(rows: Sequence[Row], *, slim: bool) -> NDArray[np.float64]:
    """Return ``(decisions, 4, 2)``: the corners of each decision's coloured cell, row by row."""
    cells = []
    for number, row in enumerate(rows):
        # Decisions at the same time divide the time until the next one among them.
        times, which, same = np.unique(row.at.astype(float), return_inverse=True, return_counts=True)
        each = (np.diff(times, append=max(row.end, times[-1])) / same)[which]
        begin = times[which] + each * (np.arange(len(row.at)) - np.searchsorted(row.at, row.at))
        half = np.full(len(begin), 0.5 if len(rows) > 60 else 0.42)
        if slim:
            half[row.ruled] *= 0.45
        x = np.stack([begin, begin + each, begin + each, begin], axis=1)
        cells.append(np.stack([x, number + np.stack([-half, -half, half, half], axis=1)], axis=2))
    return np.concatenate(cells)


# -- many episodes --------------------------------------------------------------------------------


def _collections(collected: Any) -> dict[str, Mapping[Any, Trajectories]]:
    """Return the collections to draw, by their labels."""
    if isinstance(collected, Mapping) and any(isinstance(value, Mapping) for value in collected.values()):
        return {str(label): by_policy(value) for label, value in collected.items()}
    return {"": by_policy(collected)}


def groups_of(collected: Any, per: str) -> dict[str, dict[str, NDArray[Any]]]:
    """Return the returns of episodes, by label of the row, and by collection."""
    groups: dict[str, dict[str, NDArray[Any]]] = {}
    for label, parts in _collections(collected).items():
        of_policies = [(title_of(key), found.episodes[found.starts], found) for key, found in parts.items()]
        named = [(title, episodes, found.returns) for title, episodes, found in of_policies]
        if per == "team":
            _, episodes, returns = zip(*named, strict=True)
            named = [("", np.concatenate(episodes), np.concatenate(returns))]
        if per == "agent":
            masks = [
                (name, episodes, found, found.agents[found.starts] == agent)
                for _, episodes, found in of_policies
                for agent, name in enumerate(found.names)
            ]
            named = [(name, episodes[own], found.returns[own]) for name, episodes, found, own in masks]
        for title, places, values in named:
            numbers = np.bincount(places)
            if len(values):
                sums = np.bincount(places, values) / (numbers.clip(1) if per == "policy" else 1)
                groups.setdefault(title, {})[label] = sums[numbers > 0]
    return groups
