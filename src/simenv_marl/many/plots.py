"""Pictures of what ``collect_episodes`` has found: one episode as it went, and what many have brought.

Matplotlib is only imported where something is drawn. Figures are made without pyplot, so that nothing of them is left
behind when their user lets them go, and no window opens.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import BytesIO
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import OptionValueError, shown
from .extras import needed
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
"""So many parts of an action at most are charted, and so many lines are drawn in each chart."""

LISTED: Final = 60
"""So many rows of returns at most are drawn."""

COLOURS: Final = (
    "#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#332288", "#B5A900",
    "#882255", "#44AA99", "#999933", "#661100",
)  # fmt: skip
"""Of actions. The first ones are Okabe's and Ito's, which people of all kinds of sight can tell apart."""

INK, PALE, ABSENT, UNKNOWN = "#333333", "#C9C9C9", "#E9E9E9", "#BDBDBD"
REWARDS: Final = ("#7F3B08", "#E08214", "#FFFFFF", "#8073AC", "#2D004B")

STYLE: Final[dict[Any, Any]] = {
    "text.color": INK, "axes.labelcolor": INK, "axes.labelsize": 9, "axes.titlesize": 10, "axes.titlelocation": "left",
    "axes.edgecolor": PALE, "axes.spines.top": False, "axes.spines.right": False, "figure.titlesize": 11,
    "legend.fontsize": 8.5, "legend.frameon": False,
}  # fmt: skip


@contextmanager
def style(what: str) -> Iterator[Any]:
    """Draw in the style of these pictures; yields what makes a new figure of some inches.

    Raises:
        MissingExtraError: Matplotlib is missing.
    """
    rc_context = needed("matplotlib", what, extra="plots").rc_context
    make = needed("matplotlib.figure", what, extra="plots").Figure

    def new_figure(width: float, height: float) -> Any:
        figure: Any = make(figsize=(width, height), layout="constrained")
        figure._repr_png_ = lambda: _png(figure)  # of notebooks that have not been told what figures are
        return figure

    with rc_context(STYLE):
        yield new_figure


def _png(figure: "Figure") -> bytes:
    """What a notebook shows of a figure."""
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
    """Draw one episode: who decided when, what, with which reward, and who was born and ended when.

    From left to right runs the simulation's time where it has a clock, else the number of the decision among all that
    policies have answered in the episode.

    Up to six agents have charts of their own: dots at the height of the action, stems of the height of its reward. Dots
    are hollow where the decision was left to the model's rule. More agents have a row each, in the order of their
    births, once coloured by the action, once by its reward; a colour lasts until the agent's next decision, and is slim
    where the rule has decided, or grey where it is not known what. A cross is where an agent terminated, an upright
    dash where it was truncated. Where an agent does not live, the ground is grey.

    Args:
        trajectories: What ``collect_episodes`` has returned, or what it has returned under one key.
        episode: The number of the episode, which is the place of its seed among the seeds.
        agents: The names of those who are to be drawn. None: all who have decided in this episode.
        action_names: What discrete actions are called: a sequence of names, or a dict from action to name; where
            policies differ in it, a dict from their keys to these. None: their numbers.
        component: Where actions have several components and agents a row each: by which one rows are coloured.
            Components are called as they are indexed: ``"[1]"`` of a vector, ``"litres"`` of a ``Dict``,
            ``"litres[1]"`` of a vector in it. None: by the first.
        figure: Where to draw: a figure or one of its subfigures, whose size stays what it is. None: a new figure.

    Returns:
        The figure. Notebooks show a new one where it is the last value of a cell; ``savefig`` saves it.

    Raises:
        OptionValueError: There is no such episode, or no decision in it; or an argument cannot have its value.
        UnknownAgentError: One of ``agents`` has not decided in this episode.
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
            column[-1].set_xlabel("time" if timed else "number of the decision in the episode")
            column[-1].set_xlim(begin - margin, end + margin)
        _mark_legend(columns[-1][0], rows, charts=len(columns) == 1)
        figure.suptitle(f"Episode {number}, seed {next(iter(parts.values())).seeds[number]}", x=0.01, ha="left")
    return figure


# -- few agents: charts ---------------------------------------------------------------------------


def _draw_charts(panels: Sequence[Panel], figure: Any, begin: float, end: float) -> list[Any]:
    """Draw a chart of the actions and one of the rewards for each agent. Returns them, from top to bottom."""
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
    if not row.known.all():  # how high these would be is not known
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
    """Write something to the right of axes."""
    axes.annotate(text, (1.0, height), (6, 0), at, "offset points", va="center", fontsize=8.5, annotation_clip=False)


# -- many agents: rows ----------------------------------------------------------------------------


def _heights(panels: Sequence[Panel]) -> list[float]:
    """How many inches the rows of each panel take."""
    heights = [float(np.clip(0.16 * len(panel.rows), 1.2, 6.0)) for panel in panels]
    return [max(1.2, height * min(1.0, 9.0 / sum(heights))) for height in heights]


def _draw_rows(panels: Sequence[Panel], figure: Any, component: str | None) -> list[list[Any]]:
    """Draw a row for each agent, coloured by its actions and by its rewards. Returns the axes, by column."""
    shown, heights = coloured_by(panels, component), _heights(panels)
    share = 0.85 * figure.bbox.height / figure.dpi / sum(heights)  # of an inch that is left of one, in this figure
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

    # In files of vectors, many cells are an image.
    return axes.add_collection(PolyCollection(list(cells), linewidths=0, rasterized=len(cells) > 4000, **colours))


def _colour_actions(figure: Any, axes: "Axes", rows: Sequence[Row], leaf: Leaf, values: NDArray[Any]) -> None:
    from matplotlib.patches import Patch

    known = np.concatenate([row.known for row in rows])
    _coloured(axes, cells_of(rows, slim=False), facecolors="white")  # they live, however slim what they do is
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
    # So that a few large ones do not make all others pale.
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
    """Say what marks mean, above the first axes, as far as there are such."""
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
                marks["by rule, unknown"] = {"color": UNKNOWN, "linewidth": 2}
    for mark, text in ENDS.items():
        if any(mark in row.ends for row in rows):
            marks[text] = {"marker": mark, "color": INK, "linewidth": 0, "markersize": 6}
    if marks:
        handles = [Line2D([], [], **mark) for mark in marks.values()]
        spaces: dict[str, Any] = {"handlelength": 1.5, "handletextpad": 0.4, "columnspacing": 1.2, "borderaxespad": 0.2}
        above: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "bbox_transform": axes.transAxes}
        axes.add_artist(Legend(axes, handles, list(marks), ncols=len(marks), **spaces, **above))  # there may be another


# -- many episodes --------------------------------------------------------------------------------


def plot_returns(
    collected: Trajectories | Mapping[Any, Trajectories | Mapping[Any, Trajectories]],
    *,
    per: Literal["policy", "agent", "team"] = "policy",
    ax: "Axes | None" = None,
) -> "Figure | SubFigure":
    """Draw the returns of many episodes, of one collection or of several side by side.

    The return of an agent is the sum of its rewards in an episode, undiscounted. Each point is an episode. The bar is
    from the lower to the upper quartile, its notch the median; the dot is the mean, the line through it its 95 %
    interval (of 2000 bootstrapped samples of the episodes, always the same ones). Both are written beside it.

    Args:
        collected: What ``collect_episodes`` has returned, what it has returned under one key, or a dict of such from
            what they are to be called: ``{"rule": ..., "trained": ...}``.
        per: What the point of an episode is. ``"policy"``: for each policy, the mean of the returns of the agents for
            whom it has answered in the episode; of one agent, its return. ``"agent"``: for each agent, its return.
            ``"team"``: the sum of the returns of all agents of all policies of a collection.
        ax: Where to draw. None: in a new figure.

    Returns:
        The figure. Notebooks show a new one where it is the last value of a cell; ``savefig`` saves it.

    Raises:
        OptionValueError: There is nothing to draw, or an argument cannot have its value; more than 60 rows, such as
            those of hundreds of agents, are too many.
        MissingExtraError: Matplotlib is missing.
    """
    if per not in ("policy", "agent", "team"):
        raise OptionValueError(f'per must be "policy", "agent" or "team", not {shown(per)}')
    groups = groups_of(collected, per)
    number = sum(len(rows) for rows in groups.values())
    if not number:
        raise OptionValueError("there is nothing to draw: nobody has decided in any episode")
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
    heights = height + 0.26 * (2 * (np.arange(number) * 0.618034 % 1) - 1)  # spread evenly, in no order
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
