"""What a number of seeds tells: intervals of means, and how many seeds would tell a difference."""

from __future__ import annotations

import warnings
from math import ceil, inf, isfinite, nan
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ..errors import OptionValueError, shown
from .extras import needed

RESAMPLES: Final = 5_000
"""How often values are drawn anew for an interval; always the same ones, so that it is always the same interval."""

CORRECTED: Final = 10_000
"""Of up to so many values: the correction takes as many means as there are values, and of more it corrects nothing."""

AT_ONCE: Final = 4_000_000
"""So many values are drawn at once."""

MOST_SEEDS: Final = 10_000_000
"""A difference that needs more seeds than these is as good as none."""


def check_number(name: str, value: Any) -> None:
    """Make sure that something is a finite number.

    Raises:
        OptionValueError: It is not.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)) or not isfinite(value):
        raise OptionValueError(f"{name} must be a finite number, not {shown(value)}")


def check_confidence(confidence: Any) -> None:
    """Make sure that an interval can be so sure.

    Raises:
        OptionValueError: It cannot.
    """
    check_number("confidence", confidence)
    if not 0 < confidence < 1:
        raise OptionValueError(f"confidence must lie between 0 and 1, such as 0.95, not {shown(confidence)}")


def numbers(values: Any, of: str) -> Any:
    """Values of a table as floats; nan where there is none.

    Args:
        values: A ``DataFrame`` or a ``Series``.
        of: What they are.

    Raises:
        OptionValueError: They are no numbers.
    """
    try:
        return values.astype(np.float64)
    except (TypeError, ValueError):
        raise OptionValueError(f"of={shown(of)} is a column of other values than numbers") from None


def interval(values: NDArray[np.float64], confidence: float) -> tuple[float, float]:
    """A confidence interval of the mean, by SciPy's bootstrap (bias-corrected and accelerated, unless of very many).

    Args:
        values: ``(n,)``, one for each seed.
        confidence: How sure it is to be, such as 0.95.

    Returns:
        Its bounds; nan where there are fewer than two values, or one that is not finite.
    """
    stats = needed("scipy.stats", "an interval")
    values = np.asarray(values, np.float64)
    if len(values) < 2 or not np.isfinite(values).all():
        return nan, nan
    if (values == values[0]).all():
        return float(values[0]), float(values[0])
    batch = max(1, min(500, AT_ONCE // len(values)))
    for method in ("BCa", "percentile")[len(values) > CORRECTED :]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of degenerate samples, for which there is the other method
            found = stats.bootstrap(
                (values,), np.mean, confidence_level=confidence, n_resamples=RESAMPLES, batch=batch, method=method,
                vectorized=True, rng=np.random.default_rng(0),
            ).confidence_interval  # fmt: skip
        low, high = float(found.low), float(found.high)
        if isfinite(low) and isfinite(high):
            break
    return low, high


def improvement(differences: NDArray[np.float64], confidence: float) -> tuple[float, float, float]:
    """The probability that a seed goes better, where half of those count that go as well; and its interval."""
    better = np.where(np.isnan(differences), nan, (np.sign(differences) + 1) / 2)
    return float(better.mean()) if len(better) else nan, *interval(better, confidence)


def seeds_needed(differences: NDArray[np.float64], difference: float, confidence: float, power: float) -> float:
    """How many seeds tell a mean difference from none, by the paired t-test.

    Args:
        differences: ``(n,)``, of the seeds that there are: how much they vary.
        difference: The mean difference that is to be told.
        confidence: How seldom none is taken for one: in one case of 20 with 0.95.
        power: How often one is told.

    Returns:
        The number, at least 2; infinity where it is beyond all bounds, nan where there are fewer than two differences.
    """
    stats = needed("scipy.stats", "the number of seeds")
    if len(differences) < 2 or not np.isfinite(differences).all():
        return nan
    ratio = float(np.std(differences, ddof=1)) / abs(difference)

    def enough(number: int) -> bool:
        quantiles: Any = stats.t.ppf([1 - (1 - confidence) / 2, power], number - 1)
        return bool(number >= (quantiles.sum() * ratio) ** 2)

    if not enough(MOST_SEEDS):
        return inf
    low, high = 1, MOST_SEEDS  # too few, and enough
    while high - low > 1:
        middle = ceil((low + high) / 2)
        low, high = (low, middle) if enough(middle) else (middle, high)
    return float(high)
