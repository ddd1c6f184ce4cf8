"""The plot of one episode: the decisions of each agent and their rewards, over time."""

from __future__ import annotations

import operator
from collections import ChainMap
from collections.abc import (
    Callable,
    Hashable,
    Iterator,
    Mapping,
    Sequence,
)
from dataclasses import dataclass
from math import ceil
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from gymnasium.spaces import Discrete

from ..errors import OptionValueError, UnknownAgentError, short_repr
from .plots import (
    ABSENT,
    COLOURS,
    INK,
    Collection,
    by_key,
    style,
    title_of,
    write_beside,
)
from .trajectories import (
    Array,
    Bools,
    Floats,
    Trajectories,
    action_arrays,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import PolyCollection
    from matplotlib.figure import Figure, SubFigure

    NewFigure = Callable[[float, float], Any]

ActionNames = Sequence[Any] | Mapping[Any, Any] | None
"""The names of discrete actions: see ``plot_timeline``."""

MOST_CHARTS: Final = 6
"""The largest number of agents that have charts. More agents have a row of colours each."""

MOST_COLOURS: Final = 12
"""The largest number of different actions that have a colour each.

More actions share a colour scale.
"""

UNKNOWN: Final = "#BDBDBD"
"""The colour of decisions whose action is unknown."""

MARKS: Final[dict[str, dict[str, Any]]] = {
    "policy": {"marker": "o", "color": COLOURS[0], "linewidth": 0, "markersize": 4},
    "rule": {
        "marker": "o",
        "color": COLOURS[0],
        "markerfacecolor": "white",
        "linewidth": 0,
        "markersize": 4,
    },
    "by rule": {"color": INK, "linewidth": 2},
    "by rule, action unknown": {"color": UNKNOWN, "linewidth": 2},
    "terminated": {"marker": "x", "color": INK, "linewidth": 0, "markersize": 6},
    "truncated": {"marker": "|", "color": INK, "linewidth": 0, "markersize": 6},
}
"""The marks of decisions in charts, of decisions in rows of colours, and of ends."""

BESIDE: Final[dict[str, Any]] = {
    "loc": "upper left",
    "bbox_to_anchor": (1.0, 1.0),
    "handlelength": 0.9,
    "handleheight": 0.9,
}
"""The layout of a legend to the right of its axes."""

ABOVE: Final[dict[str, Any]] = {
    "loc": "lower right",
    "bbox_to_anchor": (1.0, 1.0),
    "ncols": 6,
    "borderaxespad": 0.2,
}
"""The layout of a legend above its axes."""


@dataclass(frozen=True)
class _Component:
    """One number of the actions of a policy.

    Attributes:
        part: The name of its array in the action; empty if the action is one array.
        values: ``(N,)``: the numbers, one for each decision of the policy.
        labels: The text of each value of the array, if it has few values; else empty.
    """

    part: str
    values: Array
    labels: dict[int, str]


@dataclass(frozen=True)
class TimelineRow:
    """The decisions of one agent in the episode.

    Attributes:
        key: The key of its policy.
        actions: The components of the policy's actions, by name.
        rows: The agent's rows of the policy's decisions.
        times: ``(n,)``: the float times of the agent's decisions, or without a clock their int
            numbers.
        end: The time of its end.
        ending: "terminated" or "truncated".
    """

    key: Hashable
    agent: str
    actions: dict[str, _Component]
    rows: slice
    times: Array
    rewards: Floats
    known: Bools
    by_rule: Bools
    end: float
    ending: str


def plot_timeline(
    trajectories: Collection,
    episode: int = 0,
    *,
    agents: Sequence[str] | None = None,
    action_names: ActionNames = None,
    component: str | None = None,
    figure: Figure | SubFigure | None = None,
) -> Figure | SubFigure:
    """Draw one episode: the decisions of each agent, their rewards, and the agent's birth and end.

    The horizontal axis is the simulation's time or, without a clock, the number of the decision
    among all decisions that policies answered in the episode.

    Up to six agents have separate charts: dots at the height of the action, stems at the height
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
        component: The component of the action that colours the rows, where actions have several
            components. The name of a component is its index: ``"[1]"`` in a vector,
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
    by_policy = by_key(trajectories)
    seeds = next(iter(by_policy.values())).seeds
    try:
        number = range(len(seeds))[operator.index(episode)]
    except (IndexError, TypeError):
        raise OptionValueError(
            f"episode must be the number of one of the {len(seeds)} episodes, counted from 0, not"
            f" {short_repr(episode)}"
        ) from None
    rows: list[TimelineRow] = []
    for key, group in by_policy.items():
        if number in group.episodes:
            actions = _components(group, _action_labels(key, group, action_names))
            rows += _rows(key, group, actions, number)
    if not rows:
        raise OptionValueError(
            f"there is nothing to draw of episode {number} (seed {seeds[number]}): no agent has"
            " decided in it"
        )
    if agents is not None:
        rows = _choose(rows, agents, number)
    begin = min(row.times[0] for row in rows)
    end = max(row.end for row in rows)
    margin = 0.015 * (end - begin or 1.0)
    with style(figure) as make:
        if len(rows) <= MOST_CHARTS:
            grid = _draw_charts(rows, make, begin, end)
        else:
            grid = _draw_panels(rows, make, component)
        unit = "time" if isinstance(begin, float) else "decision number in the episode"
        for axes in grid[-1]:
            axes.set_xlabel(unit)
            axes.set_xlim(begin - margin, end + margin)
        corner: Axes = grid[0, -1]
        corner.figure.suptitle(f"Episode {number}, seed {seeds[number]}", x=0.01, ha="left")
    return corner.figure


# -- rows -----------------------------------------------------------------------------------------


def _action_labels(
    key: Hashable,
    trajectories: Trajectories,
    action_names: ActionNames,
) -> Mapping[Any, Any]:
    """Return the names of the discrete actions of a policy, by action; some may have none."""
    start = 0
    if action_names is None and isinstance(trajectories.action_space, Discrete):
        action_names = trajectories.action_labels
        start = trajectories.action_space.start
    if isinstance(action_names, Mapping):
        action_names = action_names.get(key, action_names)
    if isinstance(action_names, Mapping):
        return action_names
    if isinstance(action_names, str) or not isinstance(action_names or (), Sequence):
        raise OptionValueError(
            f"action_names must be a sequence or a dict of names, not {short_repr(action_names)}"
        )
    return dict(enumerate(action_names or (), start))


def _components(
    trajectories: Trajectories,
    action_labels: Mapping[Any, Any],
) -> dict[str, _Component]:
    """Split the actions of a policy into their components, by name."""
    components = {}
    for part, array in action_arrays(trajectories.actions):
        names = action_labels
        if array.dtype == object:  # values without a shape are told apart by their text
            texts, array = np.unique([str(action) for action in array], return_inverse=True)
            names = {code: f"{text:.20}" for code, text in enumerate(texts)}
        columns = array.reshape(len(array), -1).T
        distinct = np.unique(columns[:, trajectories.known]).tolist()
        labels = {}
        if array.dtype.kind in "iub" and len(distinct) <= MOST_COLOURS:
            labels = {value: str(names.get(value, value)) for value in distinct}
        for place, values in enumerate(columns):
            name = part if len(columns) == 1 else f"{part}[{place}]"
            components[name] = _Component(part, values, labels)
    return components


def _rows(
    key: Hashable,
    trajectories: Trajectories,
    actions: dict[str, _Component],
    episode: int,
) -> Iterator[TimelineRow]:
    """Yield the row of each agent of a policy that decided in the episode."""
    for place in np.flatnonzero(trajectories.episodes[trajectories.starts] == episode):
        start = trajectories.starts[place]
        rows = slice(start, start + trajectories.lengths[place])
        times: Array = trajectories.turns[rows]
        end = trajectories.last_turns[place]
        if trajectories.times is not None and trajectories.elapsed is not None:
            times = trajectories.times[rows]
            end = times[-1] + trajectories.elapsed[rows][-1]
        yield TimelineRow(
            key=key,
            agent=trajectories.names[trajectories.agents[start]],
            actions=actions,
            rows=rows,
            times=times,
            rewards=trajectories.rewards[rows],
            known=trajectories.known[rows],
            by_rule=trajectories.by_rule[rows],
            end=end,
            ending="terminated" if trajectories.terminations[rows][-1] else "truncated",
        )


def _choose(rows: Sequence[TimelineRow], agents: Sequence[str], episode: int) -> list[TimelineRow]:
    """Return the rows of some agents, in the order of ``agents``."""
    if isinstance(agents, str) or not agents:
        raise OptionValueError(f"agents must be a sequence of names, not {short_repr(agents)}")
    by_name = {row.agent: row for row in rows}
    try:
        return [by_name[name] for name in dict.fromkeys(agents)]
    except KeyError as error:
        raise UnknownAgentError(
            f"the agent {error} did not decide in episode {episode}; these agents did:"
            f" {short_repr(list(by_name))}"
        ) from None


def _mark_legend(
    axes: Axes,
    rows: Sequence[TimelineRow],
    by_rule: list[str],
    unknown: list[str],
) -> None:
    """Explain the marks that occur, above axes that may have another legend.

    ``by_rule`` and ``unknown`` are the marks to explain where the rule has decided, and where its
    action is unknown.
    """
    from matplotlib.legend import Legend
    from matplotlib.lines import Line2D

    labels = sorted({row.ending for row in rows})
    if not all(row.known.all() for row in rows):
        labels = unknown + labels
    if any(row.by_rule.any() for row in rows):
        labels = by_rule + labels
    handles = [Line2D([], [], **MARKS[label]) for label in labels]
    axes.add_artist(Legend(axes, handles, labels, **ABOVE))


# -- few agents: charts ---------------------------------------------------------------------------


def _draw_charts(
    rows: Sequence[TimelineRow],
    make: NewFigure,
    begin: float,
    end: float,
) -> Array:
    """Draw charts of the actions and one of the rewards for each agent.

    Return the axes, ``(charts, 1)``.
    """
    charts: list[tuple[TimelineRow, str | None, str]] = []
    for row in rows:
        title = title_of(row.key)
        title = row.agent if title in ("", row.agent) else f"{row.agent}  ({title})"
        for part in dict.fromkeys(component.part for component in row.actions.values()):
            charts.append((row, part, title))
            title = ""  # the first chart of an agent has the title
        charts.append((row, None, ""))
    heights = [0.6 if part is None else 1.0 for _, part, _ in charts]
    figure = make(9.5, 0.9 + 0.18 * len(rows) + 0.95 * sum(heights))
    grid: Array = figure.subplots(
        len(charts),
        1,
        sharex=True,
        squeeze=False,
        height_ratios=heights,
    )
    for axes, (row, name, title) in zip(grid[:, 0], charts, strict=True):
        axes.set_title(title)
        if name is None:
            _chart_rewards(axes, row)
        else:
            _chart_actions(axes, row, name)
        _shade_absence(axes, row, begin, end)
    figure.align_ylabels()
    _mark_legend(grid[0, 0], rows, ["policy", "rule"], [])
    return grid


def _chart_actions(axes: Axes, row: TimelineRow, part: str) -> None:
    """Draw a line for each component of a part of the actions, with a dot for each decision."""
    components = {
        name: component for name, component in row.actions.items() if component.part == part
    }
    # Not strict: there are at most as many lines as colours.
    for (name, component), colour in zip(components.items(), COLOURS, strict=False):
        values = component.values[row.rows]
        line = np.where(row.known, values, np.nan)
        axes.step(
            row.times,
            line,
            where="post",
            color=colour,
            linewidth=0.8,
            label=name,
        )
        by_rule = row.known & row.by_rule
        for mask, fill in ((~row.by_rule, colour), (by_rule, "white")):
            axes.scatter(
                row.times[mask],
                values[mask],
                14,
                color=fill,
                edgecolors=colour,
                zorder=3,
            )
    unknown = row.times[~row.known]
    axes.scatter(
        unknown,
        np.full(len(unknown), 0.04),
        14,
        color="white",
        edgecolors=UNKNOWN,
        zorder=3,
        transform=axes.get_xaxis_transform(),
    )
    axes.set_ylabel(part or "action")
    labels = next(iter(components.values())).labels  # all of them have the same labels
    if labels:
        axes.set_yticks(list(labels), list(labels.values()))
        axes.set_ylim(min(labels) - 0.5, max(labels) + 0.5)
    if len(components) > 1:
        axes.legend(**BESIDE)


def _chart_rewards(axes: Axes, row: TimelineRow) -> None:
    """Draw a stem for the reward of each decision."""
    axes.vlines(row.times, 0.0, row.rewards, color=INK, linewidth=1.0)
    axes.set_ylabel("reward")
    write_beside(axes, f"sum {row.rewards.sum():.4g}", 0.5, axes.transAxes)


def _shade_absence(
    axes: Axes,
    row: TimelineRow,
    begin: float,
    end: float,
) -> None:
    """Shade the times when an agent does not live, and mark its end."""
    for left, right in ((begin, row.times[0]), (row.end, end)):
        if right > left:
            axes.axvspan(left, right, color=ABSENT, zorder=0)
    axes.plot(
        [row.end],
        [0.0],
        **MARKS[row.ending],
        transform=axes.get_xaxis_transform(),
        clip_on=False,
    )


# -- many agents: rows of colours -----------------------------------------------------------------


def _draw_panels(
    rows: list[TimelineRow],
    make: NewFigure,
    component: str | None,
) -> Array:
    """Draw a row for each agent, coloured by its actions and by its rewards.

    Return the axes, ``(panels, 2)``.
    """
    panels = _panels(rows)
    names = dict.fromkeys(name for row in rows for name in row.actions)
    if component not in (None, *names):
        raise OptionValueError(
            f"no action has a component {short_repr(component)}; there are"
            f" {', '.join(map(repr, names))}"
        )
    heights = [min(max(0.16 * len(panel), 1.2), 6.0) for panel in panels.values()]
    figure = make(11.0, 1.0 + 0.3 * len(panels) + sum(heights))
    grid: Array = figure.subplots(
        len(panels),
        2,
        sharex=True,
        sharey="row",
        squeeze=False,
        height_ratios=heights,
    )
    for (left, right), (key, panel) in zip(grid, panels.items(), strict=True):
        _draw_panel(left, right, key, panel, component)
    _mark_legend(grid[0, 1], rows, ["by rule"], ["by rule, action unknown"])
    return grid


def _panels(rows: list[TimelineRow]) -> dict[Hashable, list[TimelineRow]]:
    """Return the rows of each panel, by the key of its policy.

    Many policies with similar actions share one panel, whose key is None.
    """
    panels: dict[Hashable, list[TimelineRow]] = {}
    for row in rows:
        panels.setdefault(row.key, []).append(row)
    if len(panels) > MOST_CHARTS and len({tuple(row.actions) for row in rows}) == 1:
        return {None: sorted(rows, key=lambda row: row.times[0])}
    return panels


def _draw_panel(
    left: Axes,
    right: Axes,
    key: Hashable,
    rows: list[TimelineRow],
    component: str | None,
) -> None:
    """Draw the rows of a panel, on the left the actions and on the right the rewards."""
    names = list(rows[0].actions)
    name = component if component in names else names[0]
    _colour_actions(left, rows, name)
    _colour_rewards(right, rows)
    points = 72 * left.get_window_extent().height / left.figure.dpi / len(rows)
    for axes in (left, right):
        axes.set_facecolor(ABSENT)
        for ending in ("terminated", "truncated"):
            ends = {place: row.end for place, row in enumerate(rows) if row.ending == ending}
            mark = {**MARKS[ending], "markersize": min(points, 6.0)}
            axes.plot(list(ends.values()), list(ends), **mark)
    step = ceil(9.0 / points)
    left.set_yticks(range(0, len(rows), step), [row.agent for row in rows[::step]])
    left.set_ylim(len(rows) - 0.4, -0.6)
    title = f"{title_of(key)}, {len(rows)} agents: action"
    if len(names) > 1:
        title += f" {name}, one of {len(names)}"
    left.set_title(title.removeprefix(", "))
    right.set_title("reward")


def _cells(rows: Sequence[TimelineRow], *, slim: bool) -> Floats:
    """Return ``(decisions, 4, 2)``: the corners of each decision's coloured cell, row by row."""
    cells = []
    for place, row in enumerate(rows):
        number = len(row.times)
        # Decisions at the same time divide the time until the next one among them.
        times, first = np.unique(row.times, return_index=True)
        edges = np.interp(
            np.arange(number + 1),
            np.append(first, number),
            np.append(times, max(row.end, times[-1])),
        )
        half = np.full(number, 0.5 if len(rows) > 60 else 0.42)
        if slim:
            half[row.by_rule] *= 0.45
        left, right = edges[:-1], edges[1:]
        low, high = place - half, place + half
        corners = [[left, low], [right, low], [right, high], [left, high]]
        cells.append(np.transpose(corners, (2, 0, 1)))
    return np.concatenate(cells)


def _colour(
    axes: Axes,
    cells: Floats,
    **colours: Any,
) -> PolyCollection:
    """Draw cells in their colours."""
    from matplotlib.collections import PolyCollection

    # In vector graphics, many cells become one image.
    collection = PolyCollection(list(cells), linewidths=0, rasterized=len(cells) > 4000, **colours)
    axes.add_collection(collection)
    return collection


def _colour_by_scale(axes: Axes, cells: Floats, values: Array, **colours: Any) -> None:
    """Draw cells in the colours of their values, and the scale beside the axes."""
    collection = _colour(axes, cells, array=values, **colours)
    axes.figure.colorbar(collection, ax=axes, fraction=0.04, pad=0.01, aspect=30)


def _colour_actions(
    axes: Axes,
    rows: Sequence[TimelineRow],
    name: str,
) -> None:
    """Colour the decisions by a component of their actions."""
    from matplotlib.patches import Patch

    known = np.concatenate([row.known for row in rows])
    values = np.concatenate([row.actions[name].values[row.rows] for row in rows])[known]
    _colour(axes, _cells(rows, slim=False), facecolors="white")  # white while the agent lives
    cells = _cells(rows, slim=True)
    _colour(axes, cells[~known], facecolors=UNKNOWN)
    labels_of_rows = [row.actions[name].labels for row in rows]
    labels = dict(ChainMap(*labels_of_rows))
    if not all(labels_of_rows) or len(labels) > MOST_COLOURS:
        _colour_by_scale(axes, cells[known], values, cmap="viridis")
        return
    palette = dict(enumerate(COLOURS))
    if not labels.keys() <= palette.keys():
        palette = dict(zip(sorted(labels), COLOURS, strict=False))
    _colour(axes, cells[known], facecolors=[palette[value] for value in values.tolist()])
    patches = [Patch(color=palette[action], label=labels[action]) for action in sorted(labels)]
    axes.legend(handles=patches, **BESIDE)


def _colour_rewards(axes: Axes, rows: Sequence[TimelineRow]) -> None:
    """Colour the decisions by their rewards; zero is nearly white."""
    rewards = np.concatenate([row.rewards for row in rows])
    sizes = np.abs(rewards)
    # A quantile, so that a few large rewards do not make all others pale.
    most = np.quantile(sizes, 0.99) or sizes.max() or 1.0
    _colour_by_scale(axes, _cells(rows, slim=False), rewards, cmap="PuOr", clim=(-most, most))
