"""The plot of one episode: when each agent decided what, and with which reward."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from gymnasium.spaces import Discrete
from numpy.typing import NDArray

from ..errors import OptionValueError, UnknownAgentError, did_you_mean, short_repr
from .plots import ABSENT, COLOURS, INK, PALE, by_key, style, title_of, write_beside
from .trajectories import Trajectories, action_arrays

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

CHARTED: Final = 6
"""The largest number of agents that have charts. More agents have a row of colours each."""

DRAWN: Final = 4
"""The largest number of parts of an action that are charted, and of lines in each chart."""

NAMED: Final = 12
"""The largest number of different actions that have a colour each.

More actions share a colour scale.
"""

UNKNOWN: Final = "#BDBDBD"
"""The colour of decisions whose action is unknown."""

ENDS: Final = {"x": "terminated", "|": "truncated"}
"""The marks of terminations and truncations."""


@dataclass(frozen=True)
class _Component:
    """One number of the actions of a policy or of one of its agents."""

    part: str  # the place of its array in the action; empty if the action is one array
    values: NDArray[Any]  # of the decisions
    # of the policy's values in all episodes, where each has a colour
    labels: Mapping[int, str] | None
    limits: tuple[float, float]  # of the array's values in all episodes


@dataclass(frozen=True)
class TimelineRow:
    """The decisions of one agent in the episode."""

    key: Any  # of its policy
    agent: str
    times: NDArray[Any]  # of its decisions
    end: float  # the time of its end
    actions: dict[str, _Component]  # by the name of the component
    rewards: NDArray[np.float64]
    known: NDArray[np.bool_]
    by_rule: NDArray[np.bool_]
    marks: list[str]  # of its end


def plot_timeline(
    trajectories: Trajectories | Mapping[Any, Trajectories],
    episode: int = 0,
    *,
    agents: Sequence[str] | None = None,
    action_names: Any = None,
    component: str | None = None,
    figure: Figure | SubFigure | None = None,
) -> Figure | SubFigure:
    """Draw one episode: when each agent decided what, with which reward, and when it was born and ended.

    The horizontal axis is the simulation's time or, without a clock, the number of the decision
    among all decisions that policies answered in the episode.

    Up to six agents have charts of their own: dots at the height of the action, stems at the height
    of its reward. A dot is hollow where the decision was left to the model's rule. More agents have
    one row each, in the order of their births, once coloured by action and once by reward. A colour
    lasts until the agent's next decision. It is a slim bar where the rule decided, and grey where
    the rule's action is unknown. A cross marks a termination, a vertical dash a truncation. The
    background is grey where an agent does not live.

    Args:
        trajectories: The result of ``collect_episodes``, or its value for one key.
        episode: The number of the episode, which is the index of its seed.
        agents: The names of the agents to draw. None: all agents that decided in this episode.
        action_names: The names of discrete actions: a sequence of names, or a dict from action to
            name; where policies differ in them, a dict from their keys to these. None: the
            ``action_labels`` of ``make_step``, else the numbers of the actions.
        component: The component of the action by which rows are coloured, where actions have
            several components. The name of a component is its index: ``"[1]"`` in a vector,
            ``"litres"`` in a ``Dict``, ``"litres[1]"`` in a vector of the dict. None: the first
            component.
        figure: The figure or subfigure to draw in; its size does not change. None: a new figure.

    Returns:
        The figure. A notebook shows a new figure that is the last value of a cell; ``savefig``
        saves it.

    Raises:
        OptionValueError: The episode does not exist or has no decision, or an argument has an
            invalid value.
        UnknownAgentError: One of ``agents`` did not decide in this episode.
        MissingExtraError: Matplotlib is missing.
    """
    found_by_key = by_key(trajectories)
    seeds = next(iter(found_by_key.values())).seeds
    try:
        number = range(len(seeds))[operator.index(episode)]
    except (IndexError, TypeError):
        raise OptionValueError(
            f"episode must be the number of one of the {len(seeds)} episodes, counted from 0, not"
            f" {short_repr(episode)}"
        ) from None
    deciding = {
        key: found for key, found in found_by_key.items() if (found.episodes == number).any()
    }
    if not deciding:
        raise OptionValueError(
            f"there is nothing to draw of episode {number} (seed {seeds[number]}): no agent has"
            " decided in it"
        )
    rows = [
        row for key, found in deciding.items() for row in _rows(key, found, action_names, number)
    ]
    if agents is not None:
        rows = _choose(rows, agents, number)
    begin, end = min(row.times[0] for row in rows), max(row.end for row in rows)
    with style("plot_timeline") as new_figure:
        make = new_figure if figure is None else lambda width, height: figure
        charts = len(rows) <= CHARTED
        columns = (
            _draw_charts(rows, make, begin, end) if charts else _draw_panels(rows, make, component)
        )
        margin = (0.02 if charts else 0.01) * (end - begin or 1.0)
        clock = all(found.times is not None for found in deciding.values())
        for column in columns:
            column[-1].set_xlabel("time" if clock else "decision number in the episode")
            column[-1].set_xlim(begin - margin, end + margin)
        _mark_legend(columns[-1][0], rows, charts=charts)
        drawn: Figure | SubFigure = columns[0][0].figure
        drawn.suptitle(f"Episode {number}, seed {seeds[number]}", x=0.01, ha="left")
    return drawn


# -- what is drawn --------------------------------------------------------------------------------


def _components(key: Any, found: Trajectories, action_names: Any) -> dict[str, _Component]:
    """Split the actions of a policy into their components, by name. Some actions may be unknown."""
    if isinstance(action_names, Mapping) and not isinstance(action_names.get(key, ""), str):
        action_names = action_names[key]
    if isinstance(action_names, (str, bytes)) or not isinstance(
        action_names, (Mapping, Sequence, type(None))
    ):
        raise OptionValueError(
            f"action_names must be a sequence or a dict of names, not {short_repr(action_names)}"
        )
    if action_names is None and isinstance(found.action_space, Discrete):
        action_names = found.action_labels
    start = (
        int(getattr(found.action_space, "start", 0)) if action_names is found.action_labels else 0
    )
    given = (
        action_names
        if isinstance(action_names, Mapping)
        else dict(enumerate(action_names or (), start))
    )
    components = {}
    for part, array in action_arrays(found.actions):
        names = given
        if array.dtype == object:  # values without a shape are distinguished by their text
            texts, array = np.unique([str(action) for action in array], return_inverse=True)
            names = {
                code: text if len(text) < 20 else f"{text[:18]}…" for code, text in enumerate(texts)
            }
        values = array.reshape(len(array), -1)
        known = values[found.known]
        distinct = np.unique(known).tolist() if values.dtype.kind in "iub" else []
        labels = {int(value): str(names.get(value, int(value))) for value in distinct}
        finite = known[np.isfinite(known)]
        limits = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
        for place, column in enumerate(values.T):
            name = f"{part}[{place}]" if values.shape[1] > 1 else part
            components[name] = _Component(
                part, column, labels if 0 < len(labels) <= NAMED else None, limits
            )
    return components


def _rows(key: Any, found: Trajectories, action_names: Any, episode: int) -> Iterator[TimelineRow]:
    """Yield the row of each agent that a policy answered for in the episode."""
    actions = _components(key, found, action_names)
    for place in np.flatnonzero(found.episodes[found.starts] == episode):
        start, last = int(found.starts[place]), int(found.starts[place] + found.lengths[place]) - 1
        rows = slice(start, last + 1)
        times: NDArray[Any] = found.turns[rows]
        end = float(found.last_turns[place])
        if found.times is not None and found.elapsed is not None:
            times, end = found.times[rows], float(found.times[last] + found.elapsed[last])
        ends = zip(ENDS, (found.terminations[last], found.truncations[last]), strict=True)
        yield TimelineRow(
            key=key,
            agent=found.names[found.agents[start]],
            times=times,
            end=end,
            actions={name: replace(own, values=own.values[rows]) for name, own in actions.items()},
            rewards=found.rewards[rows],
            known=found.known[rows],
            by_rule=found.by_rule[rows],
            marks=[mark for mark, ended in ends if ended],
        )


def _choose(rows: Sequence[TimelineRow], agents: Any, episode: int) -> list[TimelineRow]:
    """Return the rows of some agents, in the order of ``agents``."""
    if isinstance(agents, str) or not agents:
        raise OptionValueError(f"agents must be a sequence of names, not {short_repr(agents)}")
    by_name = {row.agent: row for row in rows}
    for name in agents:
        if name not in by_name:
            raise UnknownAgentError(
                f"{short_repr(name)} did not decide in episode {episode}; these agents did:"
                f" {', '.join(list(by_name)[:20])}{' and others' if len(by_name) > 20 else ''}"
            )
    return [by_name[name] for name in dict.fromkeys(agents)]


def _mark_legend(axes: Axes, rows: Sequence[TimelineRow], *, charts: bool) -> None:
    """Explain the marks that occur, above axes that may have another legend."""
    from matplotlib.legend import Legend
    from matplotlib.lines import Line2D

    by_rule, known = any(row.by_rule.any() for row in rows), all(row.known.all() for row in rows)
    dot: dict[str, Any] = {"marker": "o", "linewidth": 0, "markersize": 4}
    marks: dict[str, dict[str, Any]] = {}
    if by_rule and charts:
        marks["policy"] = dot | {"color": COLOURS[0]}
        marks["rule"] = dot | {
            "color": COLOURS[0] if known else UNKNOWN,
            "markerfacecolor": "white",
        }
    elif by_rule:
        marks["by rule"] = {"color": INK, "linewidth": 2}
        if not known:
            marks["by rule, action unknown"] = {"color": UNKNOWN, "linewidth": 2}
    for mark, text in ENDS.items():
        if any(mark in row.marks for row in rows):
            marks[text] = {"marker": mark, "color": INK, "linewidth": 0, "markersize": 6}
    above: dict[str, Any] = {
        "loc": "lower right",
        "bbox_to_anchor": (1.0, 1.0),
        "bbox_transform": axes.transAxes,
    }
    handles = [Line2D([], [], **look) for look in marks.values()]
    axes.add_artist(Legend(axes, handles, list(marks), ncols=6, borderaxespad=0.2, **above))


# -- few agents: charts ---------------------------------------------------------------------------


def _draw_charts(
    rows: Sequence[TimelineRow], make: Callable[..., Any], begin: float, end: float
) -> list[list[Any]]:
    """Draw charts of the actions and one of the rewards for each agent.

    Return them as one column.
    """
    parts = [list(dict.fromkeys(own.part for own in row.actions.values()))[:DRAWN] for row in rows]
    heights = [height for own in parts for height in [1.0] * len(own) + [0.6]]
    figure = make(9.5, 0.9 + sum(0.75 + 0.95 * len(own) for own in parts))
    column = figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights)[
        :, 0
    ].tolist()
    remaining = iter(column)
    for row, own in zip(rows, parts, strict=True):
        *charts, rewards = islice(remaining, len(own) + 1)
        for axes, part in zip(charts, own, strict=True):
            _chart_actions(axes, row, part)
        title = title_of(row.key)
        charts[0].set_title(row.agent if title in ("", row.agent) else f"{row.agent}  ({title})")
        rewards.vlines(
            row.times, 0.0, row.rewards, color=INK, linewidth=1.4 if len(row.times) <= 150 else 0.7
        )
        rewards.axhline(0.0, color=PALE, linewidth=0.8, zorder=1)
        rewards.set_ylabel("reward")
        write_beside(rewards, f"sum {row.rewards.sum():.4g}", 0.5, rewards.transAxes)
        for axes in (*charts, rewards):
            for left, right in ((begin, row.times[0]), (row.end, end)):
                if right > left:  # where the agent does not live
                    axes.axvspan(left, right, color=ABSENT, linewidth=0, zorder=0)
            ground = {"transform": axes.get_xaxis_transform(), "clip_on": False}
            for mark in row.marks:
                axes.plot([row.end], [0.0], mark, color=INK, markersize=7, zorder=4, **ground)
    figure.align_ylabels(column)
    return [column]


def _chart_actions(axes: Axes, row: TimelineRow, part: str) -> None:
    """Draw a line for each component of a part of the actions, with a dot for each decision."""
    hollow: dict[str, Any] = {"color": "white", "linewidths": 0.9, "zorder": 3}
    size = 14 if len(row.times) <= 150 else 5
    by_policy, by_rule = row.known & ~row.by_rule, row.known & row.by_rule
    components = {name: own for name, own in row.actions.items() if own.part == part}
    for (name, component), colour in zip(list(components.items())[:DRAWN], COLOURS, strict=False):
        heights = component.values.astype(float)
        line = np.where(row.known, heights, np.nan)
        axes.step(row.times, line, where="post", color=colour, linewidth=0.8, alpha=0.5, zorder=2)
        axes.scatter(
            row.times[by_policy], heights[by_policy], size, **hollow | {"color": colour}, label=name
        )
        axes.scatter(row.times[by_rule], heights[by_rule], size, edgecolors=colour, **hollow)
    if not row.known.all():  # their heights are unknown
        times, ground = row.times[~row.known], axes.get_xaxis_transform()
        axes.scatter(
            times, np.full(len(times), 0.04), 12, edgecolors=UNKNOWN, transform=ground, **hollow
        )
    axes.set_ylabel(part or "action")
    first = next(iter(components.values()))  # all of them have the same labels and limits
    low, high = first.limits
    margin = 0.12 * (high - low or 1.0)
    axes.set_ylim(low - margin, high + margin)
    if first.labels is not None:
        axes.set_yticks(list(first.labels), list(first.labels.values()))
    if len(components) > 1:
        more = len(components) - DRAWN
        beside: dict[str, Any] = {
            "loc": "upper left",
            "bbox_to_anchor": (1.0, 1.05),
            "handletextpad": 0.1,
        }
        axes.legend(
            title=f"and {more} more" if more > 0 else None, fontsize=8, title_fontsize=8, **beside
        )


# -- many agents: rows of colours -----------------------------------------------------------------


def _draw_panels(
    agents: list[TimelineRow], make: Callable[..., Any], component: str | None
) -> list[list[Any]]:
    """Draw a row for each agent, coloured by its actions and by its rewards.

    Return the axes in two columns.
    """
    keys = list(dict.fromkeys(row.key for row in agents))
    kinds = {
        tuple((name, own.labels is None) for name, own in row.actions.items()) for row in agents
    }
    panels = [[row for row in agents if row.key == key] for key in keys]
    if len(keys) > CHARTED and len(kinds) == 1:  # many policies with like actions share a panel
        panels = [sorted(agents, key=lambda row: row.times[0])]
    every = dict.fromkeys(name for rows in panels for name in rows[0].actions)
    if component is not None and component not in every:
        raise OptionValueError(
            f"no action has a component {short_repr(component)}; there are"
            f" {', '.join(map(repr, every))}{did_you_mean(component, every)}"
        )
    heights = np.clip([0.16 * len(rows) for rows in panels], 1.2, 6.0)
    heights = np.maximum(1.2, heights * min(1.0, 9.0 / heights.sum()))
    figure = make(11.0, 1.0 + 0.3 * len(panels) + heights.sum())
    grid = figure.subplots(
        len(panels), 2, sharex=True, sharey="row", squeeze=False, height_ratios=heights
    )
    for (left, right), rows in zip(grid, panels, strict=True):
        names = list(rows[0].actions)
        name = component if component in names else names[0]
        _colour_actions(left, rows, name)
        _colour_rewards(right, rows)
        # the height of a row
        points = 72 * left.get_window_extent().height / figure.dpi / len(rows)
        size = float(np.clip(0.8 * points, 1.5, 6.0))
        for axes in (left, right):
            axes.set_facecolor(ABSENT)
            for mark in ENDS:
                ends = {at: row.end for at, row in enumerate(rows) if mark in row.marks}
                if ends:
                    axes.plot(
                        list(ends.values()),
                        list(ends),
                        mark,
                        color=INK,
                        markersize=size,
                        mew=size / 6,
                        zorder=4,
                    )
        step = max(1, int(np.ceil(9.0 / points)))
        left.set_yticks(range(0, len(rows), step), [row.agent for row in rows[::step]])
        left.set_ylim(len(rows) - 0.4, -0.6)
        title = title_of(rows[0].key) if len({row.key for row in rows}) == 1 else ""
        what = f"action {name}, one of {len(names)}" if len(names) > 1 else "action"
        left.set_title(f"{title}, {len(rows)} agents: {what}".removeprefix(", "))
        right.set_title("reward")
    columns: list[list[Any]] = grid.T.tolist()
    return columns


def _cells(rows: Sequence[TimelineRow], *, slim: bool) -> NDArray[np.float64]:
    """Return ``(decisions, 4, 2)``: the corners of each decision's coloured cell, row by row."""
    cells = []
    for number, row in enumerate(rows):
        # Decisions at the same time divide the time until the next one among them.
        times, which, same = np.unique(
            row.times.astype(float), return_inverse=True, return_counts=True
        )
        width = (np.diff(times, append=max(row.end, times[-1])) / same)[which]
        left = times[which] + width * (
            np.arange(len(row.times)) - np.searchsorted(row.times, row.times)
        )
        half = np.full(len(left), 0.5 if len(rows) > 60 else 0.42)
        if slim:
            half[row.by_rule] *= 0.45
        x = np.stack([left, left + width, left + width, left], axis=1)
        cells.append(np.stack([x, number + np.stack([-half, -half, half, half], axis=1)], axis=2))
    return np.concatenate(cells)


def _colour(axes: Axes, cells: NDArray[np.float64], **colours: Any) -> Any:
    """Draw cells in their colours."""
    from matplotlib.collections import PolyCollection

    # In vector graphics, many cells become one image.
    return axes.add_collection(
        PolyCollection(list(cells), linewidths=0, rasterized=len(cells) > 4000, **colours)
    )


def _colour_by_scale(
    axes: Axes, cells: Any, values: Any, scale: Any, limits: tuple[float, float], extend: str
) -> None:
    """Draw cells in the colours of their values, and the scale beside the axes."""
    drawn = _colour(axes, cells, array=values, cmap=scale, clim=limits)
    bar = axes.figure.colorbar(drawn, ax=axes, extend=extend, fraction=0.04, pad=0.01, aspect=30)
    bar.outline.set_visible(False)


def _colour_actions(axes: Axes, rows: Sequence[TimelineRow], name: str) -> None:
    """Colour the decisions by a component of their actions."""
    from matplotlib.patches import Patch

    components = [row.actions[name] for row in rows]
    values = np.concatenate([own.values for own in components])
    known = np.concatenate([row.known for row in rows])
    _colour(axes, _cells(rows, slim=False), facecolors="white")  # white while the agent lives
    cells = _cells(rows, slim=True)
    if not known.all():
        _colour(axes, cells[~known], facecolors=UNKNOWN)
    labels = {value: label for own in components for value, label in (own.labels or {}).items()}
    if not 0 < len(labels) <= NAMED:
        limits = min(own.limits[0] for own in components), max(own.limits[1] for own in components)
        _colour_by_scale(
            axes, cells[known], values[known].astype(float), "viridis", limits, "neither"
        )
        return
    inside = all(0 <= action < len(COLOURS) for action in labels)
    colours = {
        action: COLOURS[action if inside else rank] for rank, action in enumerate(sorted(labels))
    }
    _colour(axes, cells[known], facecolors=[colours[int(value)] for value in values[known]])
    patches = [Patch(color=colour, label=labels[action]) for action, colour in colours.items()]
    axes.legend(
        handles=patches,
        loc="upper left",
        bbox_to_anchor=(1.0, 1.0),
        handlelength=0.9,
        handleheight=0.9,
    )


def _colour_rewards(axes: Axes, rows: Sequence[TimelineRow]) -> None:
    """Colour the decisions by their rewards; zero is white."""
    from matplotlib.colors import LinearSegmentedColormap

    rewards = np.concatenate([row.rewards for row in rows])
    # So that a few large rewards do not make all others pale.
    most = float(np.quantile(np.abs(rewards), 0.99)) or float(np.abs(rewards).max()) or 1.0
    extend = ("neither", "min", "max", "both")[
        int(rewards.min() < -most) + 2 * int(rewards.max() > most)
    ]
    colours = LinearSegmentedColormap.from_list(
        "reward", ["#7F3B08", "#E08214", "#FFFFFF", "#8073AC", "#2D004B"]
    )
    _colour_by_scale(axes, _cells(rows, slim=False), rewards, colours, (-most, most), extend)
