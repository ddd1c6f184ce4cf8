"""The plot of one episode: the decisions of each agent and their rewards, over time."""

from __future__ import annotations

import operator
from collections import ChainMap
from collections.abc import (
    Callable,
    Hashable,
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
    "terminated": {"marker": "x", "color": INK, "linewidth": 0, "markersize": 6, "clip_on": False},
    "truncated": {"marker": "|", "color": INK, "linewidth": 0, "markersize": 6, "clip_on": False},
}
"""The marks of decisions in charts, of decisions in rows of colours, and of ends."""

LOOKS: Final[dict[str, dict[str, Any]]] = {
    "charts": {"sharex": True, "squeeze": False},
    "panels": {"ncols": 2, "sharex": True, "sharey": "row", "squeeze": False},
    "line": {"where": "post", "linewidth": 0.8},
    "dots": {"s": 14, "zorder": 3},
    "unknown": {"s": 14, "color": "white", "edgecolors": UNKNOWN, "zorder": 3},
    "reward": {"color": INK, "linewidth": 1.0},
    "absent": {"color": ABSENT, "zorder": 0},
    "scale": {"fraction": 0.04, "pad": 0.01, "aspect": 30},
    "marks": {"loc": "outside upper right", "ncols": 6},
    "names": {  # to the right of the axes
        "loc": "upper left",
        "bbox_to_anchor": (1.0, 1.0),
        "handlelength": 0.9,
        "handleheight": 0.9,
    },
}
"""The options of the parts of a picture."""


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


class TimelineRow:
    """The decisions of one agent in the episode.

    Attributes:
        key: The key of its policy.
        actions: The components of the policy's actions, by name.
        values: ``(n,)`` for each component: its numbers, nan where the action is unknown.
        times: ``(n,)``: the float times of the agent's decisions, or without a clock their int
            numbers.
        end: The time of its end.
        ending: "terminated" or "truncated".
    """

    def __init__(
        self,
        key: Hashable,
        group: Trajectories,
        place: int,
        actions: dict[str, _Component],
    ) -> None:
        """Take the trajectory of a place from the group of its policy."""
        start = group.starts[place]
        rows = slice(start, start + group.lengths[place])
        known = group.known[rows]
        self.key = key
        self.actions = actions
        self.values = {
            name: np.where(known, own.values[rows], np.nan) for name, own in actions.items()
        }
        self.agent = group.names[group.agents[start]]
        self.times: Array = group.turns[rows]
        self.end: float = group.last_turns[place]
        if group.times is not None and group.elapsed is not None:
            self.times = group.times[rows]
            self.end = self.times[-1] + group.elapsed[rows][-1]
        self.rewards = group.rewards[rows]
        self.unknown = ~known
        self.by_rule = group.by_rule[rows]
        self.ending = "terminated" if group.terminations[rows][-1] else "truncated"


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
            places = np.flatnonzero(group.episodes[group.starts] == number)
            rows += [TimelineRow(key, group, place, actions) for place in places.tolist()]
    if not rows:
        raise OptionValueError(
            f"there is nothing to draw of episode {number} (seed {seeds[number]}): no agent has"
            " decided in it"
        )
    if agents is not None:
        if isinstance(agents, str) or not agents:
            raise OptionValueError(f"agents must be a sequence of names, not {short_repr(agents)}")
        by_name = {row.agent: row for row in rows}
        try:
            rows = [by_name[name] for name in dict.fromkeys(agents)]
        except KeyError as error:
            raise UnknownAgentError(
                f"the agent {error} did not decide in episode {number}; these agents did:"
                f" {short_repr(list(by_name))}"
            ) from None
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


def _explain_marks(
    figure: Figure | SubFigure,
    rows: Sequence[TimelineRow],
    by_rule: set[str],
    unknown: set[str],
) -> None:
    """Explain the marks that occur.

    ``by_rule`` and ``unknown`` are the marks to explain where the rule has decided, and where its
    action is unknown.
    """
    from matplotlib.lines import Line2D

    labels = {row.ending for row in rows}
    if any(row.by_rule.any() for row in rows):
        labels |= by_rule
    if any(row.unknown.any() for row in rows):
        labels |= unknown
    handles = [Line2D([], [], label=label, **MARKS[label]) for label in MARKS if label in labels]
    figure.legend(handles=handles, **LOOKS["marks"])


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
    parts = [dict.fromkeys(own.part for own in row.actions.values()) for row in rows]
    heights = [height for own in parts for height in (*[1.0] * len(own), 0.6)]
    figure = make(9.5, 0.9 + 0.18 * len(rows) + 0.95 * sum(heights))
    grid: Array = figure.subplots(len(heights), **LOOKS["charts"], height_ratios=heights)
    charts = iter(grid[:, 0])
    for row, own in zip(rows, parts, strict=True):
        title = title_of(row.key)
        title = row.agent if title in ("", row.agent) else f"{row.agent}  ({title})"
        for part, axes in zip([*own, None], charts, strict=False):
            axes.set_title(title)
            title = ""  # the first chart of an agent has the title
            if part is None:
                axes.vlines(row.times, 0.0, row.rewards, **LOOKS["reward"])
                axes.set_ylabel("reward")
                write_beside(axes, f"sum {row.rewards.sum():.4g}", 0.5, axes.transAxes)
            else:
                _chart_actions(axes, row, part)
            for left, right in ((begin, row.times[0]), (row.end, end)):
                if right > left:
                    axes.axvspan(left, right, **LOOKS["absent"])
            below = axes.get_xaxis_transform()
            axes.plot([row.end], [0.0], **MARKS[row.ending], transform=below)
    figure.align_ylabels()
    _explain_marks(figure, rows, {"policy", "rule"}, set())
    return grid


def _chart_actions(axes: Axes, row: TimelineRow, part: str) -> None:
    """Draw a line for each component of a part of the actions, with a dot for each decision."""
    names = [name for name, own in row.actions.items() if own.part == part]
    # Not strict: there are at most as many lines as colours.
    for name, colour in zip(names, COLOURS, strict=False):
        axes.step(row.times, row.values[name], **LOOKS["line"], color=colour, label=name)
        fill = np.where(row.by_rule, "white", colour)
        axes.scatter(row.times, row.values[name], **LOOKS["dots"], color=fill, edgecolors=colour)
    unknown = row.times[row.unknown]
    heights = np.full(len(unknown), 0.04)
    below = axes.get_xaxis_transform()
    axes.scatter(unknown, heights, **LOOKS["unknown"], transform=below)
    axes.set_ylabel(part or "action")
    labels = row.actions[names[0]].labels  # all of them have the same labels
    if labels:
        axes.set_yticks(list(labels), list(labels.values()))
        axes.set_ylim(min(labels) - 0.5, max(labels) + 0.5)
    if len(names) > 1:
        axes.legend(**LOOKS["names"])


# -- many agents: rows of colours -----------------------------------------------------------------


def _draw_panels(
    rows: list[TimelineRow],
    make: NewFigure,
    component: str | None,
) -> Array:
    """Draw a row for each agent, on the left coloured by its actions, on the right by its rewards.

    Each policy has a panel. Many policies with similar actions share one. Return the axes,
    ``(panels, 2)``.
    """
    panels: dict[Hashable, list[TimelineRow]] = {}
    for row in rows:
        panels.setdefault(row.key, []).append(row)
    if len(panels) > MOST_CHARTS and len({tuple(row.actions) for row in rows}) == 1:
        panels = {None: sorted(rows, key=lambda row: row.times[0])}
    names = dict.fromkeys(name for row in rows for name in row.actions)
    if component not in (None, *names):
        raise OptionValueError(
            f"no action has a component {short_repr(component)}; there are"
            f" {', '.join(map(repr, names))}"
        )
    heights = [min(max(0.16 * len(panel), 1.2), 6.0) for panel in panels.values()]
    figure = make(11.0, 1.0 + 0.3 * len(panels) + sum(heights))
    grid: Array = figure.subplots(len(panels), **LOOKS["panels"], height_ratios=heights)
    for pair, (key, panel) in zip(grid, panels.items(), strict=True):
        left, right = pair
        own = list(panel[0].actions)
        name = component if component in own else own[0]
        _colour_actions(left, panel, name)
        _colour_rewards(right, panel)
        points = 72 * left.get_window_extent().height / figure.dpi / len(panel)
        for axes in pair:
            axes.set_facecolor(ABSENT)
            for place, row in enumerate(panel):
                mark = {**MARKS[row.ending], "markersize": min(points, 6.0)}
                axes.plot([row.end], [place], **mark)
        step = ceil(9.0 / points)
        left.set_yticks(range(0, len(panel), step), [row.agent for row in panel[::step]])
        left.set_ylim(len(panel) - 0.4, -0.6)
        title = f"{title_of(key)}, {len(panel)} agents: action"
        if len(own) > 1:
            title += f" {name}, one of {len(own)}"
        left.set_title(title.removeprefix(", "))
        right.set_title("reward")
    _explain_marks(figure, rows, {"by rule"}, {"by rule, action unknown"})
    return grid


def _colour(
    axes: Axes,
    rows: Sequence[TimelineRow],
    by_rule: float,
    values: Array | None,
    **colours: Any,
) -> PolyCollection:
    """Colour the decisions by values. ``by_rule`` is the height of decisions by the rule."""
    from matplotlib.collections import PolyCollection

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
        across = np.stack([edges[:-1], edges[1:], edges[1:], edges[:-1]], axis=1)
        half = np.where(row.by_rule, by_rule, 1.0) * (0.5 if len(rows) > 60 else 0.42)
        upwards = place + np.outer(half, [-1, -1, 1, 1])
        cells += list(np.stack([across, upwards], axis=2))
    # In vector graphics, many cells become one image.
    many = len(cells) > 4000
    collection = PolyCollection(cells, array=values, linewidths=0, rasterized=many, **colours)
    axes.add_collection(collection)
    return collection


def _colour_actions(
    axes: Axes,
    rows: Sequence[TimelineRow],
    name: str,
) -> None:
    """Colour the decisions by a component of their actions."""
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    _colour(axes, rows, 1.0, None, facecolors="white")  # white while the agent lives
    values = np.concatenate([row.values[name] for row in rows])
    labels_of_rows = [row.actions[name].labels for row in rows]
    labels = dict(ChainMap(*labels_of_rows))
    if not all(labels_of_rows) or len(labels) > MOST_COLOURS:
        scale = colormaps["viridis"].with_extremes(bad=UNKNOWN)
        cells = _colour(axes, rows, 0.45, values, cmap=scale)
        axes.figure.colorbar(cells, ax=axes, **LOOKS["scale"])
        return
    actions: Sequence[int] = range(MOST_COLOURS)
    if not labels.keys() <= set(actions):
        actions = sorted(labels)
    codes = np.where(np.isnan(values), values, np.searchsorted(actions, values))
    palette = ListedColormap(COLOURS).with_extremes(bad=UNKNOWN)
    _colour(axes, rows, 0.45, codes, cmap=palette, clim=(0, MOST_COLOURS - 1))
    patches = [
        Patch(color=colour, label=labels[action])
        for action, colour in zip(actions, COLOURS, strict=False)
        if action in labels
    ]
    axes.legend(handles=patches, **LOOKS["names"])


def _colour_rewards(axes: Axes, rows: Sequence[TimelineRow]) -> None:
    """Colour the decisions by their rewards; zero is nearly white."""
    rewards = np.concatenate([row.rewards for row in rows])
    sizes = np.abs(rewards)
    # A quantile, so that a few large rewards do not make all others pale.
    most = np.quantile(sizes, 0.99) or sizes.max() or 1.0
    cells = _colour(axes, rows, 1.0, rewards, cmap="PuOr", clim=(-most, most))
    axes.figure.colorbar(cells, ax=axes, **LOOKS["scale"])
