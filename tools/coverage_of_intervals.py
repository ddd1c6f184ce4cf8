"""Measure the intervals of ``evaluate``: their coverage, and how often equal contenders differ.

From the repository's root:

    python -m tools.coverage_of_intervals --repetitions 20000

It prints a table of percentages: for each distribution and number of seeds, how often a 95 %
interval contains the true mean; how often the interval is unknown; how often the paired interval of
two equal contenders excludes 0. Repetitions whose interval is unknown do not count for the other
two.
"""

import argparse
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from simenv_marl.data.plots import interval, is_proportion

Draw = Callable[[np.random.Generator, int], NDArray[np.float64]]

DISTRIBUTIONS: dict[str, tuple[float, Draw]] = {
    "normal": (0.0, lambda generator, number: generator.normal(size=number)),
    "lognormal": (float(np.exp(0.5)), lambda generator, number: generator.lognormal(size=number)),
    "0/1, p=0.5": (0.5, lambda generator, number: (generator.random(number) < 0.5).astype(float)),
    "0/1, p=0.1": (0.1, lambda generator, number: (generator.random(number) < 0.1).astype(float)),
}
"""The true mean of each distribution, and a function that draws a sample."""

CONFIDENCE = 0.95


def measure(name: str, number: int, repetitions: int) -> tuple[float, float, float]:
    """Return the coverage of the mean and the shares of unknown intervals and false differences."""
    generator, (mean, draw) = np.random.default_rng(number), DISTRIBUTIONS[name]
    covered, unknown, different, known = 0, 0, 0, 0
    for _ in range(repetitions):
        one, other = draw(generator, number), draw(generator, number)
        proportion = is_proportion(np.concatenate([one, other]))
        low, high, note = interval(one, CONFIDENCE, proportion=proportion)
        unknown += bool(note)
        covered += low <= mean <= high
        low, high, note = interval(other - one, CONFIDENCE)
        known += not note
        different += low > 0 or high < 0
    return covered / max(repetitions - unknown, 1), unknown / repetitions, different / max(known, 1)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--repetitions", type=int, default=20_000)
    repetitions = parser.parse_args().repetitions
    print("|values, seeds|covered|unknown|false differences|")
    print("|---|---|---|---|")
    for name in DISTRIBUTIONS:
        for number in (5, 8, 16, 32):
            shares = measure(name, number, repetitions)
            print(
                f"|{name}, {number}|{'|'.join(f'{100 * share:.1f}' for share in shares)}|",
                flush=True,
            )


if __name__ == "__main__":
    main()
