"""Plots of the trajectories from ``collect_episodes``: the timeline of one episode, and the returns of many.

Matplotlib is imported only when something is drawn. Figures are made without pyplot: no window opens, and a figure is
freed when its user drops it.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import BytesIO
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import OptionValueError, short_repr
from ..many.parallel import import_extra
from .plot_data import (
    CHARTED,
    ENDS,
    Leaf,
    Panel,
    Row,
    by_policy,
    cells_of,
    checked_episode,
    coloured_by,
    groups_of,
    panels_of,
)
from .trajectories import Trajectories

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

__all__ = ["plot_returns", "plot_timeline"]

DRAWN: Final = 4
"""The largest number of parts of an action that are charted, and of lines in each chart."""

LISTED: Final = 60
"""The largest number of rows of returns."""

COLOURS: Final = (
    "#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#332288", "#B5A900",
    "#882255", "#44AA99", "#999933", "#661100",
)  # fmt: skip
"""The colours of actions. The first ones are those of Okabe and Ito, which colour-blind people can tell apart."""

INK, PALE, ABSENT, UNKNOWN = "#333333", "#C9C9C9", "#E9E9E9", "#BDBDBD"
REWARDS: Final = ("#7F3B08", "#E08214", "#FFFFFF", "#8073AC", "#2D004B")

STYLE: Final[dict[Any, Any]] = {
    "text.color": INK, "axes.labelcolor": INK, "axes.labelsize": 9, "axes.titlesize": 10, "axes.titlelocation": "left",
    "axes.edgecolor": PALE, "axes.spines.top": False, "axes.spines.right": False, "figure.titlesize": 11,
    "legend.fontsize": 8.5, "legend.frameon": False,
}  # fmt: skip


@contextmanager
def style(what: str) -> Iterator[Any]:
    """Set the style of these plots; yield a function that makes a new figure from its width and height in inches.

    Raises:
        MissingExtraError: Matplotlib is missing.
    """
    rc_context = import_extra("matplotlib", what).rc_context
    make = import_extra("matplotlib.figure", what).Figure

    def new_figure(width: float, height: float) -> Any:
        figure: Any = make(figsize=(width, height), layout="constrained")
        figure._repr_png_ = lambda: _png(figure)  # for notebooks in which Matplotlib has not registered figures
        return figure

    with rc_context(STYLE):
        yield new_figure


def _png(figure: "Figure") -> bytes:
    """Return the image of a figure for a notebook."""
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=100)
    return buffer.getvalue()


# -- one episode ----------------------------------------------------------------------------------


def plot_timeline(
    trajectories: Trajectories | Mapping[Any, Trajectories],
    episode: int = 0,
    *,
    agents: Sequence[str] | None = None,
    action_names: Any = None,
    component: str | None = None,
    figure: "Figure | SubFigure | None" = None,
) -> "Figure | SubFigure":
    """Draw one episode: when each agent decided what, with which reward, and when it was born and ended.

    The horizontal axis is the simulation's time or, without a clock, the number of the decision among all decisions
    that policies answered in the episode.

    Up to six agents have charts of their own: dots at the height of the action, stems at the height of its reward. A
    dot is hollow where the decision was left to the model's rule. More agents have one row each, in the order of their
    births, once coloured by action and once by reward. A colour lasts until the agent's next decision. It is a slim bar
    where the rule decided, and grey where the rule's action is unknown. A cross marks a termination, a vertical dash a
    truncation. The background is grey where an agent does not live.

    Args:
        trajectories: The result of ``collect_episodes``, or its value for one key.
        episode: The number of the episode, which is the index of its seed.
        agents: The names of the agents to draw. None: all agents that decided in this episode.
        action_names: The names of discrete actions: a sequence of names, or a dict from action to name; where policies
            differ in them, a dict from their keys to these. None: the numbers of the actions.
        component: The component of the action by which rows are coloured, where actions have several components. The
            name of a component is its index: ``"[1]"`` in a vector, ``"litres"`` in a ``Dict``, ``"litres[1]"`` in a
            vector of the dict. None: the first component.
        figure: The figure or subfigure to draw in; its size does not change. None: a new figure.

    Returns:
        The figure. A notebook shows a new figure that is the last value of a cell; ``savefig`` saves it.

    Raises:
        OptionValueError: The episode does not exist or has no decision, or an argument has an invalid value.
        UnknownAgentError: One of ``agents`` did not decide in this episode.
        MissingExtraError: Matplotlib is missing.
    """
    parts = by_policy(trajectories)
    number = checked_episode(episode, parts)
    panels = panels_of(parts, number, agents, action_names)
    rows = [row for panel in panels for row in panel.rows]
    begin, end = min(row.at[0] for row in rows), max(row.end for row in rows)
    with style("plot_timeline") as new_figure:
        if len(rows) <= CHARTED:
            size = 9.5, 0.9 + sum(0.75 + 0.95 * len(panel.leaves[:DRAWN]) for panel in panels for _ in panel.rows)
            figure = new_figure(*size) if figure is None else figure
            columns = [_draw_charts(panels, figure, begin, end)]
        else:
            size = 11.0, 1.0 + 0.3 * len(panels) + sum(_heights(panels))
            figure = new_figure(*size) if figure is None else figure
            columns = _draw_rows(panels, figure, component)
        margin = (0.02 if len(columns) == 1 else 0.01) * (end - begin or 1.0)
        for column in columns:
            for axes in column:
                axes.tick_params(labelsize=8, colors=INK, color=PALE, labelbottom=axes is column[-1])
            timed = all(row.found.times is not None for row in rows)
            column[-1].set_xlabel("time" if timed else "decision number in the episode")
            column[-1].set_xlim(begin - margin, end + margin)
        _mark_legend(columns[-1][0], rows, charts=len(columns) == 1)
        figure.suptitle(f"Episode {number}, seed {next(iter(parts.values())).seeds[number]}", x=0.01, ha="left")
    return figure


# -- few agents: charts ---------------------------------------------------------------------------


def _draw_charts(panels: Sequence[Panel], figure: Any, begin: float, end: float) -> list[Any]:
    """Draw a chart of the actions and one of the rewards for each agent; return the charts, from top to bottom."""
    charts = [
        (panel, row, number)
        for panel in panels
        for row in panel.rows
        for number in [*range(len(panel.leaves[:DRAWN])), -1]
    ]
    heights = [1.0 if number >= 0 else 0.6 for *_, number in charts]
    drawn = figure.subplots(len(charts), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0].tolist()
    for axes, (panel, row, number) in zip(drawn, charts, strict=True):
        if number < 0:
            _chart_rewards(axes, row)
        else:
            _chart_actions(axes, row, panel.leaves[number], row.actions[number])
        if not number:
            axes.set_title(row.name if panel.title in ("", row.name) else f"{row.name}  ({panel.title})")
        for left, right in ((begin, float(row.at[0])), (row.end, end)):
            if right > left:  # where the agent does not live
                axes.axvspan(left, right, color=ABSENT, linewidth=0, zorder=0)
        for mark in row.ends:
            place = axes.get_xaxis_transform()
            axes.plot([row.end], [0.0], mark, color=INK, markersize=7, transform=place, clip_on=False, zorder=4)
    figure.align_ylabels(drawn)
    return list(drawn)


def _chart_actions(axes: "Axes", row: Row, leaf: Leaf, values: NDArray[Any]) -> None:
    hollow: dict[str, Any] = {"color": "white", "linewidths": 0.9, "zorder": 3}
    for place, colour in enumerate(COLOURS[: min(leaf.width, DRAWN)]):
        heights, size = values[:, place].astype(float), 14 if len(row.at) <= 150 else 5
        line = np.where(row.known, heights, np.nan)
        axes.step(row.at, line, where="post", color=colour, linewidth=0.8, alpha=0.5, zorder=2)
        own, ruled = row.known & ~row.ruled, row.known & row.ruled
        label = leaf.component(place) if leaf.width > 1 else None
        axes.scatter(row.at[own], heights[own], size, **{**hollow, "color": colour}, label=label)
        axes.scatter(row.at[ruled], heights[ruled], size, edgecolors=colour, **hollow)
    if not row.known.all():  # their heights are unknown
        hidden = row.at[~row.known]
        ground = axes.get_xaxis_transform()
        axes.scatter(hidden, np.full(len(hidden), 0.04), 12, edgecolors=UNKNOWN, transform=ground, **hollow)
    axes.set_ylabel(leaf.name or "action")
    low, high = leaf.limits
    if leaf.names is not None:
        axes.set_yticks(list(leaf.names), list(leaf.names.values()))
    margin = 0.12 * (high - low or 1.0)
    axes.set_ylim(low - margin, high + margin)
    if leaf.width > 1:
        more = f" and {leaf.width - DRAWN} more" if leaf.width > DRAWN else None
        beside: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.05), "handletextpad": 0.1}
        axes.legend(title=more, fontsize=8, title_fontsize=8, **beside)


def _chart_rewards(axes: "Axes", row: Row) -> None:
    rewards = row.found.rewards[row.rows]
    axes.vlines(row.at, 0.0, rewards, color=INK, linewidth=1.4 if len(rewards) <= 150 else 0.7)
    axes.axhline(0.0, color=PALE, linewidth=0.8, zorder=1)
    axes.set_ylabel("reward")
    beside(axes, f"sum {rewards.sum():.4g}", 0.5, axes.transAxes)


def beside(axes: "Axes", text: str, height: float, at: Any) -> None:
    """Write text to the right of axes."""
    axes.annotate(text, (1.0, height), (6, 0), at, "offset points", va="center", fontsize=8.5, annotation_clip=False)


# -- many agents: rows ----------------------------------------------------------------------------


def _heights(panels: Sequence[Panel]) -> list[float]:
    """Return the height of each panel's rows, in inches."""
    heights = [float(np.clip(0.16 * len(panel.rows), 1.2, 6.0)) for panel in panels]
    return [max(1.2, height * min(1.0, 9.0 / sum(heights))) for height in heights]


def _draw_rows(panels: Sequence[Panel], figure: Any, component: str | None) -> list[list[Any]]:
    """Draw a row for each agent, coloured by its actions and by its rewards; return the axes, by column."""
    shown, heights = coloured_by(panels, component), _heights(panels)
    share = 0.85 * figure.bbox.height / figure.dpi / sum(heights)  # scales inches to the figure
    grid = figure.subplots(len(panels), 2, sharex=True, sharey="row", squeeze=False, height_ratios=heights)
    for (left, right), panel, (leaf, place), height in zip(grid, panels, shown, heights, strict=True):
        values = np.concatenate([row.actions[panel.leaves.index(leaf)][:, place] for row in panel.rows])
        _colour_actions(figure, left, panel.rows, leaf, values)
        _colour_rewards(figure, right, panel.rows)
        points = 72 * share * height / len(panel.rows)
        size = float(np.clip(0.8 * points, 1.5, 6.0))
        for axes in (left, right):
            axes.set_facecolor(ABSENT)
            for mark in ENDS:
                ended = {at: row.end for at, row in enumerate(panel.rows) if mark in row.ends}
                if ended:
                    x, y = list(ended.values()), list(ended)
                    axes.plot(x, y, mark, color=INK, markersize=size, mew=min(1.0, size / 3), zorder=4)
        step = max(1, int(np.ceil(9.0 / points)))
        left.set_yticks(range(0, len(panel.rows), step), [row.name for row in panel.rows[::step]])
        left.set_ylim(len(panel.rows) - 0.4, -0.6)
        components = sum(leaf.width for leaf in panel.leaves)
        what = f"action {leaf.component(place)}, one of {components}" if components > 1 else "action"
        left.set_title(f"{panel.title}, {len(panel.rows)} agents: {what}".removeprefix(", "))
        right.set_title("reward")
    columns: list[list[Any]] = grid.T.tolist()
    return columns


def _coloured(axes: "Axes", cells: NDArray[np.float64], **colours: Any) -> Any:
    from matplotlib.collections import PolyCollection

    # In vector graphics, many cells become one image.
    return axes.add_collection(PolyCollection(list(cells), linewidths=0, rasterized=len(cells) > 4000, **colours))


def _colour_actions(figure: Any, axes: "Axes", rows: Sequence[Row], leaf: Leaf, values: NDArray[Any]) -> None:
    from matplotlib.patches import Patch

    known = np.concatenate([row.known for row in rows])
    _coloured(axes, cells_of(rows, slim=False), facecolors="white")  # white while the agent lives
    cells = cells_of(rows, slim=True)
    if not known.all():
        _coloured(axes, cells[~known], facecolors=UNKNOWN)
    if leaf.names is None:
        scale = _coloured(axes, cells[known], array=values[known].astype(float), cmap="viridis", clim=leaf.limits)
        _bar(figure, axes, scale, "neither")
        return
    inside = all(0 <= action < len(COLOURS) for action in leaf.names)
    colours = {action: COLOURS[action if inside else rank] for rank, action in enumerate(leaf.names)}
    _coloured(axes, cells[known], facecolors=[colours[int(value)] for value in values[known]])
    patches = [Patch(color=colours[action], label=name) for action, name in leaf.names.items()]
    axes.legend(handles=patches, loc="upper left", bbox_to_anchor=(1.0, 1.0), handlelength=0.9, handleheight=0.9)


def _colour_rewards(figure: Any, axes: "Axes", rows: Sequence[Row]) -> None:
    from matplotlib.colors import LinearSegmentedColormap

    rewards = np.concatenate([row.found.rewards[row.rows] for row in rows])
    # So that a few large rewards do not make all others pale.
    most = float(np.quantile(np.abs(rewards), 0.99)) or float(np.abs(rewards).max()) or 1.0
    low, high = -most if rewards.min() < 0 else 0.0, most if rewards.max() > 0 else 0.0
    shades = REWARDS[0 if low else 2 : None if high or not low else 3]
    colours = LinearSegmentedColormap.from_list("reward", shades)
    limits = low, high or (0.0 if low else 1.0)
    scale = _coloured(axes, cells_of(rows, slim=False), array=rewards, cmap=colours, clim=limits)
    beyond = ("neither", "min", "max", "both")[int(rewards.min() < low) + 2 * int(rewards.max() > high)]
    _bar(figure, axes, scale, beyond)


def _bar(figure: Any, axes: "Axes", scale: Any, extend: str) -> None:
    bar = figure.colorbar(scale, ax=axes, extend=extend, fraction=0.04, pad=0.01, aspect=30)
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=8, colors=INK, color=PALE)


def _mark_legend(axes: "Axes", rows: Sequence[Row], *, charts: bool) -> None:
    """Explain the marks that occur, above the first axes."""
    from matplotlib.legend import Legend
    from matplotlib.lines import Line2D

    dot: dict[str, Any] = {"marker": "o", "linewidth": 0, "markersize": 4}
    known = all(row.known.all() for row in rows)
    marks: dict[str, dict[str, Any]] = {}
    if any(row.ruled.any() for row in rows):
        if charts:
            marks["policy"] = dot | {"color": COLOURS[0]}
            marks["rule"] = dot | {"color": COLOURS[0] if known else UNKNOWN, "markerfacecolor": "white"}
        else:
            marks["by rule"] = {"color": INK, "linewidth": 2}
            if not known:
                marks["by rule, action unknown"] = {"color": UNKNOWN, "linewidth": 2}
    for mark, text in ENDS.items():
        if any(mark in row.ends for row in rows):
            marks[text] = {"marker": mark, "color": INK, "linewidth": 0, "markersize": 6}
    if marks:
        handles = [Line2D([], [], **mark) for mark in marks.values()]
        spaces: dict[str, Any] = {"handlelength": 1.5, "handletextpad": 0.4, "columnspacing": 1.2, "borderaxespad": 0.2}
        above: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "bbox_transform": axes.transAxes}
        axes.add_artist(Legend(axes, handles, list(marks), ncols=len(marks), **spaces, **above))  # there may be two


# -- many episodes --------------------------------------------------------------------------------


def plot_returns(
    collected: Trajectories | Mapping[Any, Trajectories | Mapping[Any, Trajectories]],
    *,
    per: Literal["policy", "agent", "team"] = "policy",
    ax: "Axes | None" = None,
) -> "Figure | SubFigure":
    """Draw the returns of many episodes, of one collection or of several side by side.

    The return of an agent is the undiscounted sum of its rewards in an episode. Each point is an episode. The bar goes
    from the lower to the upper quartile, and its notch is the median. The dot is the mean, and the line through it is
    its 95 % confidence interval (of 2000 bootstrap samples of the episodes, always the same ones). The numbers of both
    stand beside the bar.

    Args:
        collected: The result of ``collect_episodes``, its value for one key, or a dict from labels to such values:
            ``{"rule": ..., "trained": ...}``.
        per: What one point shows. ``"policy"``: for each policy, the mean return of the agents it answered for in the
            episode. ``"agent"``: for each agent, its return. ``"team"``: the sum of the returns of all agents of all
            policies of a collection.
        ax: The axes to draw in. None: a new figure.

    Returns:
        The figure. A notebook shows a new figure that is the last value of a cell; ``savefig`` saves it.

    Raises:
        OptionValueError: There is nothing to draw, an argument has an invalid value, or there would be more than 60
            rows, as with hundreds of agents.
        MissingExtraError: Matplotlib is missing.
    """
    if per not in ("policy", "agent", "team"):
        raise OptionValueError(f'per must be "policy", "agent" or "team", not {short_repr(per)}')
    groups = groups_of(collected, per)
    number = sum(len(rows) for rows in groups.values())
    if not number:
        raise OptionValueError("there is nothing to draw: no agent has decided in any episode")
    if number > LISTED:
        raise OptionValueError(f"per={per!r} would draw {number} rows, more than {LISTED}; per='policy' draws fewer")
    titles = list(dict.fromkeys(title for rows in groups.values() for title in rows))
    with style("plot_returns") as new_figure:
        if ax is None:
            ax = new_figure(8.0, 0.8 + 0.34 * number + 0.3 * len(groups)).subplots()
        height, ticks = 0.0, {}
        for group, rows in groups.items():
            if group and list(rows) != [""]:
                height += 0.45 if height else -0.3
                ticks[height] = (group, "bold")
                height += 0.8
            for title, returns in rows.items():
                _draw_returns(ax, height, returns, COLOURS[titles.index(title) % len(COLOURS)])
                ticks[height] = (title or group, "normal")
                height += 1.0
        ax.set_yticks(list(ticks), [text for text, _ in ticks.values()])
        for label, (_, weight) in zip(ax.get_yticklabels(), ticks.values(), strict=True):
            label.set_fontweight(weight)
        ax.tick_params(labelsize=8, colors=INK, color=PALE)
        ax.tick_params(axis="y", length=0)
        ax.spines[["left", "top", "right"]].set_visible(False)
        ax.spines["bottom"].set_color(PALE)
        ax.grid(axis="x", color=ABSENT, linewidth=0.7)
        ax.set_axisbelow(True)
        ax.set_ylim(height - 0.3, -0.7)
        of = {"policy": ", mean of its agents", "agent": "", "team": ", sum of all agents"}
        ax.set_xlabel(f"return of an episode{of[per]}")
    return ax.figure


def _draw_returns(axes: "Axes", height: float, returns: NDArray[np.float64], colour: str) -> None:
    number, mean = len(returns), float(returns.mean())
    low, median, high = np.quantile(returns, (0.25, 0.5, 0.75))
    heights = height + 0.26 * (2 * (np.arange(number) * 0.618034 % 1) - 1)  # spread evenly, in irregular order
    size = float(np.clip(900 / number, 2, 12))
    axes.scatter(returns, heights, size, color=colour, alpha=0.45, linewidths=0, zorder=2)
    axes.barh(height, high - low, left=low, height=0.62, color=colour, alpha=0.16, zorder=1)
    axes.vlines(median, height - 0.31, height + 0.31, color=colour, linewidth=1.4, zorder=3)
    text, interval = f"{mean:.4g}", None
    if number > 1:
        generator = np.random.default_rng(0)
        draws = [returns[generator.integers(number, size=number)].mean() for _ in range(2000)]
        below, above = np.quantile(draws, (0.025, 0.975))
        text, interval = f"{mean:.4g}  [{below:.4g}, {above:.4g}]", [[mean - below], [above - mean]]
    axes.errorbar([mean], [height], xerr=interval, fmt="o", color=INK, markersize=4, elinewidth=1.6, zorder=5)
    beside(axes, text, height, axes.get_yaxis_transform())
