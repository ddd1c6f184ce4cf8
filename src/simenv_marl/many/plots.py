"""Pictures of what ``collect_episodes`` has found: one episode as it went, and what many have brought.

Matplotlib is only imported where something is drawn. Figures are made without pyplot, so that nothing of them is left
behind when their user lets them go, and no window opens that nobody has asked for.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from io import BytesIO
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import MissingExtraError, OptionValueError, UnknownAgentError
from .trajectories import Trajectories

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

__all__ = ["plot_returns", "plot_timeline"]

CHARTED: Final = 6
"""So many agents at most have a chart each; more of them have a row each, of colours."""

NAMED: Final = 12
"""So many different actions at most are told apart one by one; more of them are a scale."""

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


# -- one episode ----------------------------------------------------------------------------------


def plot_timeline(
    trajectories: Trajectories | Mapping[Any, Trajectories],
    episode: int = 0,
    *,
    agents: Sequence[str] | None = None,
    action_names: Any = None,
    component: str | None = None,
    figure: Figure | SubFigure | None = None,
) -> Figure | SubFigure:
    """Draw one episode: who decided when, what, with which reward, and who was born and ended when.

    From left to right runs the simulation's time where it has a clock, else the number of the decision among all that
    policies have answered in the episode.

    Up to six agents have charts of their own: dots at the height of the action, stems of the height of its reward. Dots
    are hollow where the decision was left to the model's rule. More agents have a row each, in the order of their
    births, once coloured by the action, once by its reward; a colour lasts until the agent's next decision, and is slim
    where the rule has decided, or grey where nobody knows what. A cross is where an agent terminated, an upright dash
    where it was truncated. Where an agent does not live, the ground is grey.

    Args:
        trajectories: What ``collect_episodes`` has returned, or what it has returned under one key.
        episode: The number of the episode, which is the place of its seed among the seeds.
        agents: The names of those who are to be drawn. None: everybody who has decided in this episode.
        action_names: What discrete actions are called: a sequence of names, or a dict from action to name; where
            policies differ in it, a dict from their keys to these. None: their numbers.
        component: Where actions have several components and agents a row each: by which one rows are coloured.
            Components are called as they are indexed: ``"[1]"`` of a vector, ``"litres"`` of a ``Dict``,
            ``"litres[1]"`` of a vector in it. None: by the first.
        figure: Where to draw: a figure or one of its subfigures, whose size stays what it is. None: a new figure.

    Returns:
        The figure. Notebooks show a new one where it is the last value of a cell; ``savefig`` saves it.

    Raises:
        OptionValueError: The episode does not exist, or nobody has decided in it; or an argument cannot have its value.
        UnknownAgentError: Somebody in ``agents`` has not decided in this episode.
        MissingExtraError: Matplotlib is missing.
    """
    parts = _parts(trajectories)
    number = _checked_episode(episode, parts)
    panels = _panels(parts, number, agents, action_names)
    timed = all(row.found.times is not None for panel in panels for row in panel.rows)
    title = f"Episode {number}, seed {next(iter(parts.values())).seeds[number]}"
    figures = _matplotlib("plot_timeline")
    if sum(len(panel.rows) for panel in panels) <= CHARTED:
        draw: Callable[..., None] = _draw_charts
        size = (9.5, 0.9 + sum(0.75 + 0.95 * len(panel.leaves[:DRAWN]) for panel in panels for _ in panel.rows))
    else:
        draw = partial(_draw_rows, component=component)
        size = 11.0, 1.0 + 0.3 * len(panels) + sum(_heights(panels))
    figure = _new_figure(figures, size) if figure is None else figure
    draw(panels, figure, timed)
    figure.suptitle(title, x=0.01, ha="left", fontsize=11, color=INK)
    return figure


@dataclass(frozen=True)
class _Leaf:
    """One array of the actions of a policy.

    Attributes:
        name: How it is indexed; empty where it is all there is.
        width: How many components it has.
        names: What its numbers are called, where they are told apart one by one.
        limits: The smallest and the largest of them, in all episodes.
    """

    name: str
    width: int
    names: Mapping[int, str] | None
    limits: tuple[float, float]


@dataclass(frozen=True)
class _Row:
    """What one agent has lived through in the episode.

    Attributes:
        key: Of its policy.
        name: Its own.
        found: Where its decisions stand.
        rows: Which of them are its own.
        actions: Of each leaf, ``(decisions, width)``.
        at: When it decided.
        end: When its trajectory ended.
    """

    key: Any
    name: str
    found: Trajectories
    rows: slice
    actions: Sequence[NDArray[Any]]
    at: NDArray[Any]
    end: float


@dataclass(frozen=True)
class _Panel:
    """Agents whose actions are alike: those of one policy, or of many."""

    title: str
    rows: list[_Row]
    leaves: list[_Leaf]


def _parts(trajectories: Any) -> dict[Any, Trajectories]:
    """What was given to be drawn, by the keys of the policies."""
    if isinstance(trajectories, Trajectories):
        return {None: trajectories}
    if not isinstance(trajectories, Mapping) or not all(isinstance(v, Trajectories) for v in trajectories.values()):
        raise OptionValueError(
            f"what is to be drawn is what collect_episodes has returned, a dict of Trajectories, not {trajectories!r}"
        )
    if not trajectories:
        raise OptionValueError("there is nothing to draw: no policy has answered for anybody")
    return dict(trajectories)


def _checked_episode(episode: Any, parts: Mapping[Any, Trajectories]) -> int:
    number = min(len(found.seeds) for found in parts.values())
    try:
        place = operator.index(episode)
    except TypeError:
        raise OptionValueError(f"episode must be the number of an episode, not {episode!r}") from None
    if not -number <= place < number:
        raise OptionValueError(f"there is no episode {place}, but {number} from 0 on")
    return place % number


def _panels(parts: Mapping[Any, Trajectories], episode: int, agents: Any, action_names: Any) -> list[_Panel]:
    """A panel for each policy; one for all of them where they are many and their actions alike."""
    leaves, arrays = {}, {}
    for key, found in parts.items():
        if (found.episodes == episode).any():
            taken_apart = _taken_apart(found.actions, found.known, _namer(key, action_names))
            leaves[key] = [leaf for leaf, _ in taken_apart]
            arrays[key] = [array for _, array in taken_apart]
    if not leaves:
        seed = next(iter(parts.values())).seeds[episode]
        raise OptionValueError(f"there is nothing to draw of episode {episode} (seed {seed}): nobody has decided in it")
    rows = _rows({key: parts[key] for key in leaves}, arrays, episode)
    if agents is not None:
        rows = _chosen(rows, agents, episode)
    keys = list(dict.fromkeys(row.key for row in rows))
    alike = len({tuple((leaf.name, leaf.width, leaf.names is None) for leaf in leaves[key]) for key in keys}) == 1
    if len(keys) <= CHARTED or not alike:
        return [_Panel(_title(key), [row for row in rows if row.key == key], leaves[key]) for key in keys]
    shared = [_together(same) for same in zip(*(leaves[key] for key in keys), strict=True)]
    return [_Panel("", sorted(rows, key=lambda row: int(row.found.turns[row.rows.start])), shared)]


def _rows(parts: Mapping[Any, Trajectories], arrays: Mapping[Any, Sequence[NDArray[Any]]], episode: int) -> list[_Row]:
    timed = all(found.times is not None for found in parts.values())
    rows = []
    for key, found in parts.items():
        for place in np.flatnonzero(found.episodes[found.starts] == episode):
            start = int(found.starts[place])
            own = slice(start, start + int(found.lengths[place]))
            at: NDArray[Any] = found.turns[own]
            end = float(found.last_turns[place])
            if timed:
                times, elapsed = _clock(found)
                at, end = times[own], float(times[own.stop - 1] + elapsed[own.stop - 1])
            actions = [array[own] for array in arrays[key]]
            rows.append(_Row(key, found.names[found.agents[start]], found, own, actions, at, end))
    # Of whom the model has let go before the last reward was known, nobody knows when that was: as usual, then.
    gaps = np.concatenate([np.diff(row.at) for row in rows])
    gap = float(np.median(gaps[gaps > 0])) if (gaps > 0).any() else 1.0
    return [row if row.end == row.end else replace(row, end=float(row.at[-1]) + gap) for row in rows]


def _clock(found: Trajectories) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    assert found.times is not None
    assert found.elapsed is not None
    return found.times, found.elapsed


def _chosen(rows: Sequence[_Row], agents: Any, episode: int) -> list[_Row]:
    if isinstance(agents, str) or not agents:
        raise OptionValueError(f"agents must be a sequence of names, not {agents!r}")
    by_name = {row.name: row for row in rows}
    for name in agents:
        if name not in by_name:
            raise UnknownAgentError(
                f"{name!r} has not decided in episode {episode}; those who have are {', '.join(list(by_name)[:20])}"
                f"{' and others' if len(by_name) > 20 else ''}"
            )
    return [by_name[name] for name in dict.fromkeys(agents)]


def _namer(key: Any, action_names: Any) -> Callable[[int], str]:
    if isinstance(action_names, Mapping) and not isinstance(action_names.get(key, ""), str):
        action_names = action_names[key]
    if action_names is None:
        return str
    if isinstance(action_names, (str, bytes)) or not isinstance(action_names, (Mapping, Sequence)):
        raise OptionValueError(f"action_names must be a sequence or a dict of names, not {action_names!r}")
    names = action_names if isinstance(action_names, Mapping) else dict(enumerate(action_names))
    return lambda action: str(names.get(action, action))


def _taken_apart(
    actions: Any, known: NDArray[np.bool_], name: Callable[[int], str], prefix: str = ""
) -> list[tuple[_Leaf, NDArray[Any]]]:
    """The leaves of actions, of which some are not known, each with its array."""
    if isinstance(actions, Mapping):
        parts = [(f"{prefix}[{key!r}]" if prefix else str(key), part) for key, part in actions.items()]
        return [found for index, part in parts for found in _taken_apart(part, known, name, index)]
    if isinstance(actions, tuple):
        places = enumerate(actions)
        return [found for place, part in places for found in _taken_apart(part, known, name, f"{prefix}[{place}]")]
    values = actions.reshape(len(actions), -1)
    if actions.dtype == object:  # what has no shape is told apart by its text
        texts = [str(action) for action in actions]
        codes = {text: code for code, text in enumerate(dict.fromkeys(texts))}
        values = np.array([codes[text] for text in texts], np.int64).reshape(-1, 1)
        name = [text if len(text) < 20 else f"{text[:18]}…" for text in codes].__getitem__
    different = np.unique(values[known]).tolist() if values.dtype.kind in "iub" else []
    names = {int(value): name(int(value)) for value in different} if 0 < len(different) <= NAMED else None
    finite = values[known][np.isfinite(values[known])]
    limits = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
    return [(_Leaf(prefix, values.shape[1], names, limits), values)]


def _together(leaves: Sequence[_Leaf]) -> _Leaf:
    """The same leaf of several policies."""
    names: dict[int, str] | None = None
    if leaves[0].names is not None:
        names = dict(sorted(item for leaf in leaves for item in (leaf.names or {}).items()))
    limits = min(leaf.limits[0] for leaf in leaves), max(leaf.limits[1] for leaf in leaves)
    return replace(leaves[0], names=names, limits=limits)


def _title(key: Any) -> str:
    """What a policy's key is called: of a dotted name, its last two parts."""
    return "" if key is None else ".".join(str(getattr(key, "__qualname__", key)).split(".")[-2:])


def _known(row: _Row) -> NDArray[np.bool_]:
    """Of which of its decisions it is known what they were."""
    return row.found.known[row.rows]


# -- few agents: charts ---------------------------------------------------------------------------


def _draw_charts(panels: Sequence[_Panel], figure: Any, timed: bool) -> None:
    charts = [(panel, row) for panel in panels for row in panel.rows]
    heights = [h for panel, _ in charts for h in [*[1.0] * len(panel.leaves[:DRAWN]), 0.6]]
    grid = figure.add_gridspec(len(heights), 1, height_ratios=heights)
    first, last = min(row.at[0] for _, row in charts), max(row.end for _, row in charts)
    drawn: list[Any] = []
    for panel, row in charts:
        label = f"{row.name}" if panel.title in ("", row.name) else f"{row.name}  ({panel.title})"
        for number, leaf in enumerate([*panel.leaves[:DRAWN], None]):
            axes = figure.add_subplot(grid[len(drawn), 0], sharex=drawn[0] if drawn else None)
            if leaf is None:
                _chart_rewards(axes, row)
            else:
                _chart_actions(axes, row, leaf, row.actions[number])
            if not number:
                axes.set_title(label, loc="left", fontsize=10, color=INK)
            _tidy(axes)
            _absences(axes, row, first, last)
            axes.tick_params(labelbottom=False)
            drawn.append(axes)
    figure.align_ylabels(drawn)
    drawn[-1].tick_params(labelbottom=True)
    drawn[-1].set_xlabel(_along(timed), fontsize=9, color=INK)
    margin = 0.02 * (last - first or 1.0)
    drawn[0].set_xlim(first - margin, last + margin)
    _legend(drawn[0], [row for _, row in charts], charts=True)


def _chart_actions(axes: Axes, row: _Row, leaf: _Leaf, values: NDArray[Any]) -> None:
    known, ruled = _known(row), row.found.by_rule[row.rows]
    for component in range(min(leaf.width, DRAWN)):
        colour = COLOURS[component]
        heights = values[:, component].astype(float)
        line = np.where(known, heights, np.nan)
        axes.step(row.at, line, where="post", color=colour, linewidth=0.8, alpha=0.5, zorder=2)
        name = f"{leaf.name}[{component}]" if leaf.width > 1 else leaf.name
        size = 14 if len(row.at) <= 150 else 5
        for chosen, filled in ((known & ~ruled, True), (known & ruled, False)):
            axes.scatter(
                row.at[chosen],
                heights[chosen],
                s=size,
                color=colour if filled else "white",
                edgecolors=colour,
                linewidths=0.9,
                zorder=3,
                label=name if filled and leaf.width > 1 else None,
            )
    hidden = np.flatnonzero(~known)
    if len(hidden):  # nobody knows how high they would be
        axes.scatter(
            row.at[hidden],
            np.full(len(hidden), 0.04),
            s=12,
            color="white",
            edgecolors=UNKNOWN,
            linewidths=0.9,
            transform=axes.get_xaxis_transform(),
            zorder=3,
        )
    axes.set_ylabel(leaf.name or "action", fontsize=9, color=INK)
    low, high = leaf.limits
    if leaf.names is not None:
        axes.set_yticks(list(leaf.names), list(leaf.names.values()))
    margin = 0.12 * (high - low or 1.0)
    axes.set_ylim(low - margin, high + margin)
    if leaf.width > 1:
        more = f" and {leaf.width - DRAWN} more" if leaf.width > DRAWN else ""
        axes.legend(
            title=more or None,
            fontsize=8,
            title_fontsize=8,
            frameon=False,
            loc="upper left",
            bbox_to_anchor=(1.0, 1.05),
            handletextpad=0.1,
        )


def _chart_rewards(axes: Axes, row: _Row) -> None:
    rewards = row.found.rewards[row.rows]
    axes.vlines(row.at, 0.0, rewards, color=INK, linewidth=1.4 if len(rewards) <= 150 else 0.7)
    axes.axhline(0.0, color=PALE, linewidth=0.8, zorder=1)
    axes.set_ylabel("reward", fontsize=9, color=INK)
    axes.annotate(
        f"sum {rewards.sum():.4g}",
        (1.0, 0.5),
        (6, 0),
        xycoords="axes fraction",
        textcoords="offset points",
        va="center",
        fontsize=8.5,
        color=INK,
    )


def _absences(axes: Axes, row: _Row, first: float, last: float) -> None:
    """Shade where an agent does not live, and mark how it ended."""
    for begin, end in ((first, float(row.at[0])), (row.end, last)):
        if end > begin:
            axes.axvspan(begin, end, color=ABSENT, linewidth=0, zorder=0)
    for marker, ended in _ends(row):
        if ended:
            at = axes.get_xaxis_transform()
            axes.plot([row.end], [0.0], marker=marker, color=INK, markersize=7, transform=at, clip_on=False, zorder=4)


def _ends(row: _Row) -> tuple[tuple[Any, bool], ...]:
    last = row.rows.stop - 1
    return ("x", bool(row.found.terminations[last])), ("|", bool(row.found.truncations[last]))


# -- many agents: rows ----------------------------------------------------------------------------


def _heights(panels: Sequence[_Panel]) -> list[float]:
    """How many inches the rows of each panel take."""
    heights = [float(np.clip(0.16 * len(panel.rows), 1.2, 6.0)) for panel in panels]
    return [max(1.2, height * min(1.0, 9.0 / sum(heights))) for height in heights]


def _draw_rows(panels: Sequence[_Panel], figure: Any, timed: bool, component: str | None) -> None:
    shown = _shown(panels, component)
    heights = _heights(panels)
    share = 0.85 * figure.bbox.height / figure.dpi / sum(heights)  # of an inch that is left of one, in this figure
    grid = figure.add_gridspec(len(panels), 2, height_ratios=heights)
    every = [row for panel in panels for row in panel.rows]
    first, last = min(row.at[0] for row in every), max(row.end for row in every)
    top: Any = None
    for number, (panel, (leaf, place), height) in enumerate(zip(panels, shown, heights, strict=True)):
        left = figure.add_subplot(grid[number, 0], sharex=top)
        top = left if top is None else top
        right = figure.add_subplot(grid[number, 1], sharex=top, sharey=left)
        points = 72 * share * height / len(panel.rows)
        _colour_actions(figure, left, panel.rows, panel.leaves.index(leaf), leaf, place)
        _colour_rewards(figure, right, panel.rows)
        for axes in (left, right):
            axes.set_facecolor(ABSENT)
            _mark_ends(axes, panel.rows, float(np.clip(0.8 * points, 1.5, 6.0)))
            _tidy(axes)
            axes.tick_params(labelbottom=number == len(panels) - 1)
        right.tick_params(labelleft=False)
        step = max(1, int(np.ceil(9.0 / points)))
        left.set_yticks(range(0, len(panel.rows), step), [row.name for row in panel.rows[::step]])
        left.set_ylim(len(panel.rows) - 0.4, -0.6)
        title = f"{panel.title}, {len(panel.rows)} agents" if panel.title else f"{len(panel.rows)} agents"
        what = _component(leaf, place)
        others = sum(leaf.width for leaf in panel.leaves) - 1
        left.set_title(
            f"{title}: action {what}, one of {others + 1}" if others else f"{title}: action",
            loc="left",
            fontsize=10,
            color=INK,
        )
        right.set_title("reward", loc="left", fontsize=10, color=INK)
        if number == len(panels) - 1:
            left.set_xlabel(_along(timed), fontsize=9, color=INK)
            right.set_xlabel(_along(timed), fontsize=9, color=INK)
        if not number:
            _legend(right, every, charts=False)
    margin = 0.01 * (last - first or 1.0)
    top.set_xlim(first - margin, last + margin)


def _shown(panels: Sequence[_Panel], component: str | None) -> list[tuple[_Leaf, int]]:
    """The leaf of each panel, and its component, by which rows are coloured."""
    known = [
        {_component(leaf, place): (leaf, place) for leaf in panel.leaves for place in range(leaf.width)}
        for panel in panels
    ]
    if component is not None and not any(component in own for own in known):
        names = ", ".join(repr(name) for name in dict.fromkeys(name for own in known for name in own))
        raise OptionValueError(f"no action has a component {component!r}; there are {names}")
    return [own.get(component or "", next(iter(own.values()))) for own in known]


def _component(leaf: _Leaf, place: int) -> str:
    return f"{leaf.name}[{place}]" if leaf.width > 1 else leaf.name


def _cells(rows: Sequence[_Row], *, slim: bool) -> NDArray[np.float64]:
    """``(decisions, 4, 2)``: the corners of what is to be coloured of each decision, row by row."""
    cells = []
    for number, row in enumerate(rows):
        # Decisions of the same time share what goes by until the next one.
        times, which, same = np.unique(row.at.astype(float), return_inverse=True, return_counts=True)
        lasting = np.diff(times, append=max(row.end, times[-1]))
        nth = np.arange(len(row.at)) - np.searchsorted(row.at, row.at)
        begin = times[which] + lasting[which] * nth / same[which]
        end = begin + lasting[which] / same[which]
        half = np.full(len(begin), 0.5 if len(rows) > 60 else 0.42)
        if slim:
            half[row.found.by_rule[row.rows]] *= 0.45
        x = np.stack([begin, end, end, begin], axis=1)
        y = number + np.stack([-half, -half, half, half], axis=1)
        cells.append(np.stack([x, y], axis=2))
    return np.concatenate(cells)


def _coloured(axes: Axes, cells: NDArray[np.float64], **colours: Any) -> Any:
    from matplotlib.collections import PolyCollection

    # In files of vectors, many cells are an image.
    drawn = PolyCollection(list(cells), linewidths=0, rasterized=len(cells) > 4000, **colours)
    axes.add_collection(drawn)
    return drawn


def _colour_actions(figure: Any, axes: Axes, rows: Sequence[_Row], which: int, leaf: _Leaf, place: int) -> None:
    from matplotlib.patches import Patch

    values = np.concatenate([row.actions[which][:, place] for row in rows])
    known = np.concatenate([_known(row) for row in rows])
    _coloured(axes, _cells(rows, slim=False), facecolors="white")  # they live, however slim what they do is
    cells = _cells(rows, slim=True)
    if not known.all():
        _coloured(axes, cells[~known], facecolors=UNKNOWN)
    legend = []
    if leaf.names is None:
        scale = _coloured(axes, cells[known], array=values[known].astype(float), cmap="viridis", clim=leaf.limits)
        _bar(figure, axes, scale, "neither")
    else:
        inside = all(0 <= action < len(COLOURS) for action in leaf.names)
        colours = {action: COLOURS[action if inside else rank] for rank, action in enumerate(leaf.names)}
        _coloured(axes, cells[known], facecolors=[colours[int(value)] for value in values[known]])
        legend = [Patch(color=colours[action], label=name) for action, name in leaf.names.items()]
    if legend:
        axes.legend(
            handles=legend,
            loc="upper left",
            bbox_to_anchor=(1.0, 1.0),
            fontsize=8.5,
            frameon=False,
            handlelength=0.9,
            handleheight=0.9,
        )


def _colour_rewards(figure: Any, axes: Axes, rows: Sequence[_Row]) -> None:
    from matplotlib.colors import LinearSegmentedColormap

    rewards = np.concatenate([row.found.rewards[row.rows] for row in rows])
    shades = ["#7F3B08", "#E08214", "#FFFFFF", "#8073AC", "#2D004B"]
    # So that a few large ones do not make all others pale.
    most = float(np.quantile(np.abs(rewards), 0.99)) or float(np.abs(rewards).max()) or 1.0
    low, high = -most if rewards.min() < 0 else 0.0, most if rewards.max() > 0 else 0.0
    shades = shades[0 if low else 2 : None if high or not low else 3]
    cells = _cells(rows, slim=False)
    colours = LinearSegmentedColormap.from_list("reward", shades)
    scale = _coloured(axes, cells, array=rewards, cmap=colours, clim=(low, high or (0.0 if low else 1.0)))
    beyond = rewards.min() < low, rewards.max() > high
    _bar(figure, axes, scale, {(True, True): "both", (True, False): "min", (False, True): "max"}.get(beyond, "neither"))


def _bar(figure: Any, axes: Axes, scale: Any, extend: str) -> None:
    bar = figure.colorbar(scale, ax=axes, extend=extend, fraction=0.04, pad=0.01, aspect=30)
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=8, colors=INK, color=PALE)


def _mark_ends(axes: Axes, rows: Sequence[_Row], size: float) -> None:
    for place, marker in enumerate(("x", "|")):
        ended = [(row.end, number) for number, row in enumerate(rows) if _ends(row)[place][1]]
        if ended:
            at, which = zip(*ended, strict=True)
            axes.plot(at, which, marker, color=INK, markersize=size, markeredgewidth=min(1.0, size / 3), zorder=4)


# -- what all pictures have -----------------------------------------------------------------------


def _along(timed: bool) -> str:
    return "time" if timed else "number of the decision in the episode"


def _legend(axes: Axes, rows: Sequence[_Row], *, charts: bool) -> None:
    """Say what marks mean, above the first axes, as far as there are such."""
    from matplotlib.legend import Legend
    from matplotlib.lines import Line2D

    ruled = any(row.found.by_rule[row.rows].any() for row in rows)
    known = all(_known(row).all() for row in rows)
    marks = []
    if charts and ruled:
        marks.append(Line2D([], [], marker="o", color=COLOURS[0], linewidth=0, markersize=4, label="policy"))
        colour = COLOURS[0] if known else UNKNOWN
        marks.append(
            Line2D([], [], marker="o", color=colour, markerfacecolor="white", linewidth=0, markersize=4, label="rule")
        )
    if ruled and not charts:
        marks.append(Line2D([], [], color=INK, linewidth=2, label="by rule"))
        if not known:
            marks.append(Line2D([], [], color=UNKNOWN, linewidth=2, label="by rule, unknown"))
    for place, (marker, text) in enumerate((("x", "terminated"), ("|", "truncated"))):
        if any(_ends(row)[place][1] for row in rows):
            marks.append(Line2D([], [], marker=marker, color=INK, linewidth=0, markersize=6, label=text))
    if marks:
        legend = Legend(  # beside one that the axes may have
            axes,
            marks,
            [str(mark.get_label()) for mark in marks],
            loc="lower right",
            bbox_to_anchor=(1.0, 1.0),
            bbox_transform=axes.transAxes,
            ncols=len(marks),
            fontsize=8.5,
            frameon=False,
            handlelength=1.5,
            handletextpad=0.4,
            columnspacing=1.2,
            borderaxespad=0.2,
        )
        axes.add_artist(legend)


def _tidy(axes: Any) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(PALE)
    axes.tick_params(labelsize=8, colors=INK, color=PALE)


def _matplotlib(what: str) -> Any:
    try:
        import matplotlib.figure
    except ImportError:
        raise MissingExtraError(f"{what} needs matplotlib: install simenv-marl[plots]") from None
    return matplotlib.figure


def _new_figure(figures: Any, size: tuple[float, float]) -> Any:
    figure = figures.Figure(figsize=size, layout="constrained")
    figure._repr_png_ = partial(_png, figure)  # where nobody has told a notebook what figures are
    return figure


def _png(figure: Any) -> bytes:
    """What a notebook shows of a figure."""
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=100)
    return buffer.getvalue()


# -- many episodes --------------------------------------------------------------------------------


def plot_returns(
    collected: Trajectories | Mapping[Any, Trajectories | Mapping[Any, Trajectories]],
    *,
    per: Literal["policy", "agent", "team"] = "policy",
    ax: Axes | None = None,
) -> Figure | SubFigure:
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
        raise OptionValueError(f'per must be "policy", "agent" or "team", not {per!r}')
    groups = _groups(_collections(collected), per)
    number = sum(len(rows) for rows in groups.values())
    if not number:
        raise OptionValueError("there is nothing to draw: nobody has decided in any episode")
    if number > LISTED:
        raise OptionValueError(f"per={per!r} would draw {number} rows, more than {LISTED}; per='policy' draws fewer")
    figures = _matplotlib("plot_returns")
    if ax is None:
        ax = _new_figure(figures, (8.0, 0.8 + 0.34 * number + 0.3 * len(groups))).subplots()
    titles = list(dict.fromkeys(title for rows in groups.values() for title in rows))
    height, ticks = 0.0, {}
    for group, rows in groups.items():
        if group and list(rows) != [""]:
            height += 0.45 if height else -0.3
            ticks[height] = (group, True)
            height += 0.8
        for title, returns in rows.items():
            _draw_row(ax, height, returns, COLOURS[titles.index(title) % len(COLOURS)])
            ticks[height] = (title or group, False)
            height += 1.0
    ax.set_yticks(list(ticks), [text for text, _ in ticks.values()])
    for label, (_, is_group) in zip(ax.get_yticklabels(), ticks.values(), strict=True):
        label.set_fontweight("bold" if is_group else "normal")
    _tidy(ax)
    ax.tick_params(axis="y", length=0)
    ax.spines["left"].set_visible(False)
    ax.grid(axis="x", color=ABSENT, linewidth=0.7)
    ax.set_axisbelow(True)
    ax.set_ylim(height - 0.3, -0.7)
    of = {"policy": ", mean of its agents", "agent": "", "team": ", sum of all agents"}
    ax.set_xlabel(f"return of an episode{of[per]}", fontsize=9, color=INK)
    return ax.figure


def _collections(collected: Any) -> dict[str, dict[Any, Trajectories]]:
    """What was given to be drawn, by what it is called."""
    if isinstance(collected, Mapping) and any(isinstance(value, Mapping) for value in collected.values()):
        return {str(label): _parts(value) for label, value in collected.items()}
    return {"": _parts(collected)}


def _groups(collections: Mapping[str, Mapping[Any, Trajectories]], per: str) -> dict[str, dict[str, NDArray[Any]]]:
    """Returns of episodes, by what they are the returns of, and by the collection."""
    groups: dict[str, dict[str, NDArray[Any]]] = {}
    for label, parts in collections.items():
        if per == "team":
            sums: dict[int, float] = {}
            for found in parts.values():
                for episode, value in zip(found.episodes[found.starts].tolist(), found.returns.tolist(), strict=True):
                    sums[episode] = sums.get(episode, 0.0) + value
            groups.setdefault("", {})[label] = np.array([sums[episode] for episode in sorted(sums)])
            continue
        for key, found in parts.items():
            episodes = found.episodes[found.starts]
            if per == "policy":
                numbers = np.bincount(episodes)
                sums_of = np.bincount(episodes, found.returns)
                groups.setdefault(_title(key), {})[label] = sums_of[numbers > 0] / numbers[numbers > 0]
                continue
            agents = found.agents[found.starts]
            for agent, name in enumerate(found.names):
                groups.setdefault(name, {})[label] = found.returns[agents == agent]
    kept = {group: {label: own for label, own in rows.items() if len(own)} for group, rows in groups.items()}
    return {group: rows for group, rows in kept.items() if rows}


def _draw_row(axes: Axes, height: float, returns: NDArray[np.float64], colour: str) -> None:
    generator = np.random.default_rng(0)
    number = len(returns)
    heights = height + 0.26 * (2 * (np.arange(number) * 0.618034 % 1) - 1)  # spread evenly, in no order
    low, median, high = np.quantile(returns, (0.25, 0.5, 0.75))
    mean = float(returns.mean())
    axes.scatter(
        returns, heights, s=float(np.clip(900 / number, 2, 12)), color=colour, alpha=0.45, linewidths=0, zorder=2
    )
    axes.barh(height, high - low, left=low, height=0.62, color=colour, alpha=0.16, zorder=1)
    axes.vlines(median, height - 0.31, height + 0.31, color=colour, linewidth=1.4, zorder=3)
    text = f"{mean:.4g}"
    if number > 1:
        draws = np.array([returns[generator.integers(number, size=number)].mean() for _ in range(2000)])
        below, above = np.quantile(draws, (0.025, 0.975))
        axes.hlines(height, below, above, color=INK, linewidth=1.6, zorder=4)
        text = f"{mean:.4g}  [{below:.4g}, {above:.4g}]"
    axes.plot([mean], [height], "o", color=INK, markersize=4, zorder=5)
    axes.annotate(
        text,
        (1.0, height),
        (6, 0),
        xycoords=axes.get_yaxis_transform(),
        textcoords="offset points",
        va="center",
        fontsize=8.5,
        color=INK,
        annotation_clip=False,
    )
