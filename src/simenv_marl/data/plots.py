"""Plots of the trajectories from ``collect_episodes``: the style of all plots, intervals, and the returns of episodes.

Matplotlib is imported only when something is drawn. Figures are made without pyplot: no window
opens, and a figure is freed when its user drops it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from io import BytesIO
from math import nan
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import OptionValueError, short_repr
from ..many.parallel import import_extra
from .trajectories import Trajectories

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

LISTED: Final = 60
"""The largest number of rows of returns."""

COLOURS: Final = (
    "#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#332288", "#B5A900",
    "#882255", "#44AA99", "#999933", "#661100",
)  # fmt: skip
"""The colours of actions.

The first ones are those of Okabe and Ito, which colour-blind people can tell apart.
"""

INK, PALE, ABSENT = "#333333", "#C9C9C9", "#E9E9E9"

STYLE: Final[dict[Any, Any]] = {
    "text.color": INK, "axes.labelcolor": INK, "axes.labelsize": 9, "axes.titlesize": 10, "axes.titlelocation": "left",
    "axes.edgecolor": PALE, "axes.spines.top": False, "axes.spines.right": False, "figure.titlesize": 11,
    "xtick.color": PALE, "xtick.labelcolor": INK, "xtick.labelsize": 8,
    "ytick.color": PALE, "ytick.labelcolor": INK, "ytick.labelsize": 8,
    "legend.fontsize": 8.5, "legend.frameon": False, "legend.handlelength": 1.5, "legend.handletextpad": 0.4,
    "legend.columnspacing": 1.2,
}  # fmt: skip


@contextmanager
def style(what: str) -> Iterator[Any]:
    """Set the style of these plots.

    Yield a function that makes a new figure from its width and height in inches.
    """
    rc_context = import_extra("matplotlib", what).rc_context
    make = import_extra("matplotlib.figure", what).Figure

    def new_figure(width: float, height: float) -> Any:
        figure = make(figsize=(width, height), layout="constrained")

        def image() -> bytes:
            buffer = BytesIO()
            figure.savefig(buffer, format="png", dpi=100)
            return buffer.getvalue()

        figure._repr_png_ = image  # for notebooks in which Matplotlib has not registered figures
        return figure

    with rc_context(STYLE):
        yield new_figure


def by_key(trajectories: Any) -> Mapping[Any, Trajectories]:
    """Return the trajectories to draw by the key of their policy."""
    if isinstance(trajectories, Trajectories):
        return {None: trajectories}
    if not isinstance(trajectories, Mapping) or not all(
        isinstance(v, Trajectories) for v in trajectories.values()
    ):
        raise OptionValueError(
            "only the dict of Trajectories that collect_episodes returned can be drawn, not"
            f" {short_repr(trajectories)}"
        )
    if not trajectories:
        raise OptionValueError("there is nothing to draw: no policy has answered any decision")
    return trajectories


def title_of(key: Any) -> str:
    """Return the title for a policy's key: the last two parts of a dotted name."""
    return "" if key is None else ".".join(str(getattr(key, "__qualname__", key)).split(".")[-2:])


def write_beside(axes: Axes, text: str, height: float, at: Any) -> None:
    """Write text to the right of axes."""
    axes.annotate(
        text,
        (1.0, height),
        (6, 0),
        at,
        "offset points",
        va="center",
        fontsize=8.5,
        annotation_clip=False,
    )


# -- intervals ------------------------------------------------------------------------------------


def is_proportion(values: NDArray[Any]) -> bool:
    """Return whether values are bools, or 0 and 1 alone, of which both occur.

    None and nan do not count.
    """
    return values.dtype == np.bool_ or {v for v in values.ravel() if v is not None and v == v} == {
        0,
        1,
    }


def interval(
    values: NDArray[np.float64], confidence: float, *, proportion: bool = False
) -> tuple[float, float, str]:
    """Return a confidence interval of the mean: by Student's t or, of a proportion, by Wilson's score.

    Bounds of which nothing is known are nan. Then the third value says why; otherwise it is empty.
    """
    stats, number = import_extra("scipy.stats", "an interval"), len(values)
    if number < 2:
        return nan, nan, "a single value"
    if not np.isfinite(values).all():
        return nan, nan, "a value is missing or not finite"
    if proportion:
        bounds = stats.binomtest(round(values.sum()), number).proportion_ci(
            confidence, method="wilson"
        )
        return float(bounds.low), float(bounds.high), ""
    if np.ptp(values) <= 1e-12 * np.abs(values).max():  # they differ by rounding errors at most
        return nan, nan, "all are equal"
    low, high = stats.t.interval(confidence, number - 1, values.mean(), stats.sem(values))
    return float(low), float(high), ""


# -- many episodes --------------------------------------------------------------------------------


def plot_returns(
    collected: Trajectories | Mapping[Any, Trajectories | Mapping[Any, Trajectories]],
    *,
    per: Literal["policy", "agent", "team"] = "policy",
    ax: Axes | None = None,
) -> Figure | SubFigure:
    """Draw the returns of many episodes, of one collection or of several side by side.

    The return of an agent is the undiscounted sum of its rewards in an episode. Each point is an
    episode. The bar goes from the lower to the upper quartile, and its notch is the median. The dot
    is the mean, and the line through it is its 95 % confidence interval, by the rule of
    ``Evaluation.summary``. The numbers of both stand beside the bar.

    Args:
        collected: The result of ``collect_episodes``, its value for one key, or a dict from labels
            to such values: ``{"rule": ..., "trained": ...}``.
        per: What one point shows. ``"policy"``: for each policy, the mean return of the agents it
            answered for in the episode. ``"agent"``: for each agent, its return. ``"team"``: the
            sum of the returns of all agents of all policies of a collection.
        ax: The axes to draw in. None: a new figure.

    Returns:
        The figure. A notebook shows a new figure that is the last value of a cell; ``savefig``
        saves it.

    Raises:
        OptionValueError: There is nothing to draw, an argument has an invalid value, or there would
            be more than 60 rows, as with hundreds of agents.
        MissingExtraError: Matplotlib or SciPy is missing.
    """
    if per not in ("policy", "agent", "team"):
        raise OptionValueError(f'per must be "policy", "agent" or "team", not {short_repr(per)}')
    groups = _returns(collected, per)
    number = sum(len(rows) for rows in groups.values())
    if not number:
        raise OptionValueError("there is nothing to draw: no agent has decided in any episode")
    if number > LISTED:
        raise OptionValueError(
            f"per={per!r} would draw {number} rows, more than {LISTED}; per='policy' draws fewer"
        )
    labels = list(dict.fromkeys(label for rows in groups.values() for label in rows))
    proportion = is_proportion(
        np.concatenate([returns for rows in groups.values() for returns in rows.values()])
    )
    with style("plot_returns") as new_figure:
        if ax is None:
            ax = new_figure(8.0, 0.8 + 0.34 * number + 0.3 * len(groups)).subplots()
        height, ticks = 0.0, {}
        for title, rows in groups.items():
            if title and list(rows) != [""]:
                height += 0.45 if height else -0.3
                ticks[height] = (title, "bold")
                height += 0.8
            for label, returns in rows.items():
                colour = COLOURS[labels.index(label) % len(COLOURS)]
                _draw_returns(ax, height, returns, colour, proportion=proportion)
                ticks[height] = (label or title, "normal")
                height += 1.0
        ax.set_yticks(list(ticks), [text for text, _ in ticks.values()])
        for text, (_, weight) in zip(ax.get_yticklabels(), ticks.values(), strict=True):
            text.set_fontweight(weight)
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


def _returns(collected: Any, per: str) -> dict[str, dict[str, NDArray[Any]]]:
    """Return the returns of episodes, by policy or agent, and by the label of their collection."""
    collections = {"": collected}
    if isinstance(collected, Mapping) and any(
        isinstance(value, Mapping) for value in collected.values()
    ):
        collections = {str(label): value for label, value in collected.items()}
    groups: dict[str, dict[str, NDArray[Any]]] = {}
    for label, trajectories in collections.items():
        own: dict[str, list[tuple[NDArray[np.int64], NDArray[np.float64]]]] = {}
        for key, found in by_key(trajectories).items():
            episodes, agents = found.episodes[found.starts], found.agents[found.starts]
            if per == "agent":
                for agent, name in enumerate(found.names):
                    own.setdefault(name, []).append(
                        (episodes[agents == agent], found.returns[agents == agent])
                    )
            else:
                own.setdefault(title_of(key) if per == "policy" else "", []).append(
                    (episodes, found.returns)
                )
        for title, pairs in own.items():
            episodes, returns = (np.concatenate(column) for column in zip(*pairs, strict=True))
            if len(returns):
                numbers = np.bincount(episodes)
                sums = np.bincount(episodes, returns) / (numbers.clip(1) if per == "policy" else 1)
                groups.setdefault(title, {})[label] = sums[numbers > 0]
    return groups


def _draw_returns(
    axes: Axes, height: float, returns: NDArray[np.float64], colour: str, *, proportion: bool
) -> None:
    """Draw the episodes of a row, their quartiles and median, and their mean with its interval."""
    number, mean = len(returns), float(returns.mean())
    low, median, high = np.quantile(returns, (0.25, 0.5, 0.75))
    # spread evenly, in irregular order
    heights = height + 0.26 * (2 * (np.arange(number) * 0.618034 % 1) - 1)
    size = float(np.clip(900 / number, 2, 12))
    axes.scatter(returns, heights, size, color=colour, alpha=0.45, linewidths=0, zorder=2)
    axes.barh(height, high - low, left=low, height=0.62, color=colour, alpha=0.16, zorder=1)
    axes.vlines(median, height - 0.31, height + 0.31, color=colour, linewidth=1.4, zorder=3)
    below, above, _ = interval(returns, 0.95, proportion=proportion)
    text, bars = f"{mean:.4g}", None
    if below == below:  # otherwise nothing is known of the interval
        text, bars = f"{mean:.4g}  [{below:.4g}, {above:.4g}]", [[mean - below], [above - mean]]
    axes.errorbar(
        [mean], [height], xerr=bars, fmt="o", color=INK, markersize=4, elinewidth=1.6, zorder=5
    )
    write_beside(axes, text, height, axes.get_yaxis_transform())
