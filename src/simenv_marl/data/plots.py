"""The style of all plots, confidence intervals, and the plot of returns.

Matplotlib is imported only when something is drawn. Figures are made without pyplot: no window
opens, and a figure is freed when its user drops it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import (
    Callable,
    Hashable,
    Iterator,
    Mapping,
)
from contextlib import contextmanager
from io import BytesIO
from itertools import chain
from math import nan
from statistics import fmean
from typing import (
    TYPE_CHECKING,
    Any,
    Final,
    Literal,
)

import numpy as np

from ..errors import OptionValueError, short_repr
from ..many.parallel import import_extra
from .trajectories import Array, Floats, Trajectories

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure
    from matplotlib.transforms import Transform

Collection = Trajectories | Mapping[Any, Trajectories]
"""The result of ``collect_episodes``, or its value for one key."""

MOST_ROWS: Final = 60
"""The largest number of rows of returns."""

AGGREGATES: Final = {
    "policy": ", mean of its agents",
    "agent": "",
    "team": ", sum of all agents",
}
"""The texts that say how a point aggregates the returns of agents."""

COLOURS: Final = (
    "#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#332288", "#B5A900",
    "#882255", "#44AA99", "#999933", "#661100",
)  # fmt: skip
"""The colours of actions.

The first ones are by Okabe and Ito, for colour-blind people.
"""

INK = "#333333"
PALE = "#C9C9C9"
ABSENT = "#E9E9E9"

STYLE: Final[dict[Any, Any]] = {
    "axes.axisbelow": True,
    "axes.edgecolor": PALE,
    "axes.labelcolor": INK,
    "axes.labelsize": 9,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 10,
    "figure.titlesize": 11,
    "grid.color": ABSENT,
    "grid.linewidth": 0.7,
    "legend.columnspacing": 1.2,
    "legend.fontsize": 8.5,
    "legend.frameon": False,
    "legend.handlelength": 1.5,
    "legend.handletextpad": 0.4,
    "lines.markersize": 4,
    "text.color": INK,
    "xtick.color": PALE,
    "xtick.labelcolor": INK,
    "xtick.labelsize": 8,
    "ytick.color": PALE,
    "ytick.labelcolor": INK,
    "ytick.labelsize": 8,
}
"""The settings of Matplotlib for all plots."""

LOOKS: Final[dict[str, dict[str, Any]]] = {
    "quartiles": {"height": 0.62, "alpha": 0.16},
    "episodes": {"s": 10, "alpha": 0.45, "linewidths": 0},
    "interval": {"color": INK, "linewidth": 1.6},
    "mean": {"marker": "o", "color": INK, "markersize": 4},
    "grid": {"color": ABSENT, "linewidth": 0.7},
    "beside": {
        "textcoords": "offset points",
        "va": "center",
        "fontsize": 8.5,
        "annotation_clip": False,
    },
}
"""The options of the parts of the plot of returns."""


@contextmanager
def style(figure: Figure | SubFigure | None = None) -> Iterator[Callable[[float, float], Any]]:
    """Set the style of all plots.

    Yield a function that returns the figure, or makes one of a width and a height in inches.
    """
    make = import_extra("matplotlib.figure", "a plot").Figure
    from matplotlib import rc_context

    def make_figure(width: float, height: float) -> Any:
        if figure is not None:
            return figure
        fresh = make(figsize=(width, height), layout="constrained")

        def image() -> bytes:
            buffer = BytesIO()
            fresh.savefig(buffer, format="png", dpi=100)
            return buffer.getvalue()

        # IPython calls this method where Matplotlib has not registered its figures.
        fresh._repr_png_ = image
        return fresh

    with rc_context(STYLE):
        yield make_figure


def by_key(trajectories: Collection) -> Mapping[Any, Trajectories]:
    """Return the trajectories to draw, by the key of their policy."""
    if isinstance(trajectories, Trajectories):
        return {None: trajectories}
    if (
        not isinstance(trajectories, Mapping)
        or not trajectories
        or not all(isinstance(value, Trajectories) for value in trajectories.values())
    ):
        raise OptionValueError(
            "only the dict of Trajectories that collect_episodes returned for some policies can be"
            f" drawn, not {short_repr(trajectories)}"
        )
    return trajectories


def title_of(key: Hashable) -> str:
    """Return the title for a policy's key: the last two parts of a dotted name."""
    name = str(getattr(key, "__qualname__", key or ""))
    return ".".join(name.split(".")[-2:])


def write_beside(
    axes: Axes,
    text: str,
    height: float,
    transform: Transform,
) -> None:
    """Write text to the right of axes, at a height in the coordinates of a transform."""
    axes.annotate(text, (1.0, height), (6, 0), transform, **LOOKS["beside"])


# -- intervals ------------------------------------------------------------------------------------


def is_proportion(values: Array) -> bool:
    """Return whether values are bools, or zeros and ones with at least one of both.

    None and nan do not count.
    """
    if values.dtype == np.bool_:
        return True
    return {value for value in values.ravel() if value is not None and value == value} == {0, 1}


def interval(
    values: Floats,
    confidence: float,
    *,
    proportion: bool = False,
) -> tuple[float, float, str]:
    """Return a confidence interval of the mean, and a note.

    The interval is by Student's t or, for a proportion, by Wilson's score. Where it is unknown, its
    bounds are nan and the note says why; otherwise the note is empty.
    """
    stats = import_extra("scipy.stats", "an interval")
    number = len(values)
    if number < 2:
        return nan, nan, "a single value"
    if not np.isfinite(values).all():
        return nan, nan, "a value is missing or not finite"
    if proportion:
        test = stats.binomtest(round(values.sum()), number)
        low, high = test.proportion_ci(confidence, method="wilson")
    elif np.ptp(values) <= 1e-12 * np.abs(values).max():  # they differ by rounding errors at most
        return nan, nan, "all are equal"
    else:
        low, high = stats.t.interval(confidence, number - 1, values.mean(), stats.sem(values))
    return float(low), float(high), ""


# -- many episodes --------------------------------------------------------------------------------


def plot_returns(
    collected: Collection | Mapping[Any, Collection],
    *,
    per: Literal["policy", "agent", "team"] = "policy",
    ax: Axes | None = None,
) -> Figure | SubFigure:
    """Draw the returns of many episodes, of one collection or of several side by side.

    The return of an agent is the undiscounted sum of its rewards in an episode. Each point is an
    episode. The bar goes from the lower to the upper quartile, and its notch is the median. The dot
    is the mean, and the line through it is its 95 % confidence interval, as in
    ``Evaluation.summary``. The numbers of both stand beside the bar.

    Args:
        collected: The result of ``collect_episodes``, its value for one key, or a dict from labels
            to such values: ``{"rule": ..., "trained": ...}``.
        per: The meaning of a point. ``"policy"``: for each policy, the mean return of its agents
            in the episode. ``"agent"``: for each agent, its return. ``"team"``: the sum of the
            returns of all agents of all policies of a collection.
        ax: The axes to draw in. None: a new figure.

    Returns:
        The figure. A notebook shows a new figure that is the last value of a cell; ``savefig``
        saves it.

    Raises:
        OptionValueError: There is nothing to draw, an argument has an invalid value, or there would
            be more than 60 rows, as with hundreds of agents.
        MissingExtraError: Matplotlib or SciPy is missing.
    """
    if per not in tuple(AGGREGATES):
        raise OptionValueError(f'per must be "policy", "agent" or "team", not {short_repr(per)}')
    groups = _returns(collected, per)
    number = sum(map(len, groups.values()))
    if not number:
        raise OptionValueError("there is nothing to draw: no agent has decided in any episode")
    if number > MOST_ROWS:
        raise OptionValueError(
            f"per={per!r} would draw {number} rows, more than {MOST_ROWS}; per='policy' draws fewer"
        )
    labels = list(dict.fromkeys(chain.from_iterable(groups.values())))
    proportion = is_proportion(
        np.concatenate([returns for rows in groups.values() for returns in rows.values()])
    )
    with style() as make_figure:
        if ax is None:
            ax = make_figure(8.0, 0.8 + 0.34 * number + 0.3 * len(groups)).subplots()
        height = 0.0
        ticks: list[tuple[float, str, str]] = []
        for title, rows in groups.items():
            if title and list(rows) != [""]:
                height += 0.45 if height else -0.3
                ticks.append((height, title, "bold"))
                height += 0.8
            for label, returns in rows.items():
                colour = COLOURS[labels.index(label) % len(COLOURS)]
                low, median, high = np.quantile(returns, (0.25, 0.5, 0.75))
                ax.barh(height, high - low, left=low, color=colour, **LOOKS["quartiles"])
                places = height + 0.26 * scatter(len(returns))
                ax.scatter(returns, places, color=colour, **LOOKS["episodes"])
                ax.vlines(median, height - 0.31, height + 0.31, color=colour, linewidth=1.4)
                mean = returns.mean()
                text = f"{mean:.4g}"
                below, above, note = interval(returns, 0.95, proportion=proportion)
                if not note:
                    text += f"  [{below:.4g}, {above:.4g}]"
                    ax.hlines(height, below, above, **LOOKS["interval"])
                ax.plot([mean], [height], **LOOKS["mean"])
                write_beside(ax, text, height, ax.get_yaxis_transform())
                ticks.append((height, label or title, "normal"))
                height += 1.0
        heights, texts, weights = zip(*ticks, strict=True)
        ax.set_yticks(heights, texts)
        for text, weight in zip(ax.get_yticklabels(), weights, strict=True):
            text.set_fontweight(weight)
        ax.set_ylim(height - 0.3, -0.7)
        ax.tick_params(axis="y", length=0)
        ax.spines["left"].set_visible(False)
        ax.grid(axis="x", **LOOKS["grid"])
        ax.set_axisbelow(True)
        ax.set_xlabel(f"return of an episode{AGGREGATES[per]}")
    return ax.figure


def _returns(
    collected: Collection | Mapping[Any, Collection],
    per: str,
) -> dict[str, dict[str, Floats]]:
    """Return the returns of episodes, by policy or agent, and by the label of their collection."""
    collections: dict[str, Any] = {"": collected}
    if isinstance(collected, Mapping) and any(
        isinstance(value, Mapping) for value in collected.values()
    ):
        collections = {str(label): value for label, value in collected.items()}
    combine = fmean if per == "policy" else sum
    groups: dict[str, dict[str, Floats]] = defaultdict(dict)
    for label, trajectories in collections.items():
        paid: dict[str, dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
        for key, group in by_key(trajectories).items():
            title = title_of(key) if per == "policy" else ""
            for start, value in zip(group.starts, group.returns.tolist(), strict=True):
                if per == "agent":
                    title = group.names[group.agents[start]]
                paid[title][group.episodes[start]].append(value)
        for title, episodes in paid.items():
            returns = [combine(values) for _, values in sorted(episodes.items())]
            groups[title][label] = np.array(returns)
    return groups


def scatter(number: int) -> Array:
    """Return numbers from -1 to 1, at even distances in an irregular order."""
    return 2 * (np.arange(number) * 0.618034 % 1) - 1
