"""Statistics over seeds: confidence intervals of means, and the number of seeds that detects a difference."""

from __future__ import annotations

import warnings
from math import ceil, inf, isfinite, nan
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ..errors import OptionValueError, short_repr
from ..many.parallel import import_extra

RESAMPLES: Final = 5_000
"""The number of bootstrap samples for an interval; always the same samples, for reproducible intervals."""

CORRECTED: Final = 10_000
"""The largest number of values with bias correction: it needs one mean per value, and has no effect on more values."""

AT_ONCE: Final = 4_000_000
"""The number of values that are drawn at once."""

MOST_SEEDS: Final = 10_000_000
"""A difference that needs more seeds than this counts as none."""


def check_number(name: str, value: Any) -> None:
    """Check that an argument is a finite number.

    Raises:
        OptionValueError: It is not.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)) or not isfinite(value):
        raise OptionValueError(f"{name} must be a finite number, not {short_repr(value)}")


def check_confidence(confidence: Any) -> None:
    """Check that a confidence level is between 0 and 1.

    Raises:
        OptionValueError: It is not.
    """
    check_number("confidence", confidence)
    if not 0 < confidence < 1:
        raise OptionValueError(f"confidence must lie between 0 and 1, such as 0.95, not {short_repr(confidence)}")


def numbers(values: Any, of: str) -> Any:
    """Return values of a table as floats; nan where a value is missing.

    Args:
        values: A ``DataFrame`` or a ``Series``.
        of: The name of the column, for the message.

    Raises:
        OptionValueError: The values are not numbers.
    """
    try:
        return values.astype(np.float64)
    except (TypeError, ValueError):
        raise OptionValueError(f"of={short_repr(of)} is not a column of numbers") from None


def interval(values: NDArray[np.float64], confidence: float) -> tuple[float, float]:
    """Return a confidence interval of the mean, by SciPy's bootstrap (BCa, or percentile for very many values).

    Args:
        values: ``(n,)``, one for each seed.
        confidence: The confidence level, such as 0.95.

    Returns:
        The bounds; nan if there are fewer than two values, or one that is not finite.
    """
    stats = import_extra("scipy.stats", "an interval")
    values = np.asarray(values, np.float64)
    if len(values) < 2 or not np.isfinite(values).all():
        return nan, nan
    if (values == values[0]).all():
        return float(values[0]), float(values[0])
    batch = max(1, min(500, AT_ONCE // len(values)))
    for method in ("BCa", "percentile")[len(values) > CORRECTED :]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about degenerate samples, which the other method handles
            found = stats.bootstrap(
                (values,), np.mean, confidence_level=confidence, n_resamples=RESAMPLES, batch=batch, method=method,
                vectorized=True, rng=np.random.default_rng(0),
            ).confidence_interval  # fmt: skip
        low, high = float(found.low), float(found.high)
        if isfinite(low) and isfinite(high):
            break
    return low, high


def improvement(differences: NDArray[np.float64], confidence: float) -> tuple[float, float, float]:
    """Return the share of seeds with a positive difference, where ties count half, and its interval."""
    better = np.where(np.isnan(differences), nan, (np.sign(differences) + 1) / 2)
    return float(better.mean()) if len(better) else nan, *interval(better, confidence)


def seeds_needed(differences: NDArray[np.float64], difference: float, confidence: float, power: float) -> float:
    """Return the number of seeds that detects a mean difference, by the paired t-test.

    Args:
        differences: ``(n,)``, the differences on the present seeds, for their variance.
        difference: The mean difference to detect.
        confidence: One minus the probability of a false positive: 0.95 is one in 20.
        power: The probability of detecting the difference.

    Returns:
        The number, at least 2; infinity if it is too large, nan if there are fewer than two differences.
    """
    stats = import_extra("scipy.stats", "the number of seeds")
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
