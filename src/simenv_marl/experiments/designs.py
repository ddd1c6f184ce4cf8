"""Designs of experiments: which combinations of factors to run."""

from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import combinations, product
from math import ceil, prod
from sys import float_info
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..core import checked_seed, same
from ..errors import OptionValueError, did_you_mean, short_repr
from ..many.parallel import import_extra
from ..simulation import is_integer

if TYPE_CHECKING:
    from pandas import DataFrame, Series

EXACT = 2**53
"""The integers up to this are exact as floats."""

MOST_ROWS = 10_000_000
"""The largest number of rows. A larger design is considered a mistake."""

METHODS = (
    "full_factorial",
    "fractional_factorial",
    "latin_hypercube",
    "sobol",
    "halton",
    "plackett_burman",
    "central_composite",
    "one_at_a_time",
    "saltelli",
)
"""The methods of ``design``, each a method of ``Builder``."""

Matrix = NDArray[np.float64]
"""Numbers of a design, of shape ``(rows, factors)``."""


@dataclass(frozen=True)
class Factor:
    """A factor. Designs consist of its numbers: values of a range, or indices of levels.

    Attributes:
        low, high: The lowest and the highest number.
        kind: The type of the numbers.
        levels: The levels. None: the factor is a range.
    """

    name: str
    low: float
    high: float
    kind: type[float]
    levels: tuple[Any, ...] | None = None

    def spread(self, unit: Matrix) -> Matrix:
        """Map numbers from 0 to 1 to numbers of the factor, uniformly."""
        if self.kind is int:
            steps = self.high - self.low
            return self.low + np.floor(unit * (steps + 1)).clip(max=steps)
        # Not low + unit * (high - low), because the difference may overflow.
        return np.clip(self.low * (1 - unit) + self.high * unit, self.low, self.high)

    def steps(self, number: int | None) -> Matrix:
        """Return all levels, or ``number`` values (default 2) of a range from bound to bound."""
        if number == 1:
            raise OptionValueError("this method takes n values of each range; n must be at least 2")
        if self.levels is not None:
            number = len(self.levels)
        return np.unique(self.spread(np.linspace(0.0, 1.0, check_size(number or 2))))

    def column(self, numbers: Matrix) -> "Series[Any]":
        """Return the values of the factor that numbers stand for, in their own type."""
        from pandas import Series

        values = Series(numbers.astype(self.kind))
        if self.levels is None:
            return values
        is_mixed = len(set(map(type, self.levels))) > 1
        levels = [self.levels[place] for place in values]
        return Series(levels, dtype=object if is_mixed else None)


def design(
    factors: Mapping[str, Any],
    method: str = "full_factorial",
    n: int | None = None,
    *,
    seed: int | None = None,
) -> "DataFrame":
    """Return a design: a table of the combinations of factors to run.

    Args:
        factors: A dict from the name of a factor to its values: a range, given as the tuple
            ``(low, high)`` (a range of integers if both are integers), or a list of levels of any
            type.
        method: How combinations are chosen:

            - ``"full_factorial"``: all combinations. A range has ``n`` values (default 2) from
              bound to bound.
            - ``"fractional_factorial"``: two levels per factor, a fraction of all combinations in
              ``n`` runs. ``n`` is a power of two (default: as many as main effects need). Effects
              are confounded as little as possible.
            - ``"plackett_burman"``: two levels per factor, main effects in a multiple of four runs.
            - ``"central_composite"``: ranges alone, two or more, for a quadratic response surface:
              corners, star points and the centre, all within the ranges.
            - ``"latin_hypercube"``, ``"sobol"``, ``"halton"``: ``n`` rows that fill the space. For
              ``"sobol"``, ``n`` should be a power of two; SciPy warns if it is not.
            - ``"one_at_a_time"``: the centre of ranges and the first of levels; then each factor
              alone at its other values, for a range ``n`` (default 2) values from bound to bound.
            - ``"saltelli"``: ``n`` samples, a power of two, for ``sobol_indices``, in
              ``n * (2 * factors + 2)`` rows.
        n: The number of samples, runs or values per range, for methods that use it.
        seed: The seed of random designs. None: always the same design, so that a script that runs
            again continues its experiment.

    Returns:
        A ``DataFrame`` with one row for each run and one column for each factor, in the factor's
        own type.

    Raises:
        OptionValueError: A factor has no levels, the method does not exist, or it does not fit
            these factors and ``n``.
        MissingExtraError: pandas, SciPy or pyDOE is missing.
    """
    pandas = import_extra("pandas", "design")
    if not isinstance(factors, Mapping) or not factors:
        raise OptionValueError(
            "factors must be a dict from names to ranges or lists of levels, not"
            f" {short_repr(factors)}"
        )
    parsed_factors = [_parse_factor(name, values) for name, values in factors.items()]
    if method not in METHODS:
        raise OptionValueError(
            f"method must be one of {', '.join(METHODS)}, not"
            f" {short_repr(method)}{did_you_mean(method, METHODS)}"
        )
    if n is not None and not (is_integer(n) and n > 0):
        raise OptionValueError(f"n must be a positive integer, not {short_repr(n)}")
    builder = Builder(parsed_factors, None if n is None else int(n), checked_seed(seed) or 0)
    matrix = getattr(builder, method)()
    columns = zip(parsed_factors, matrix.T, strict=True)
    return pandas.DataFrame({factor.name: factor.column(numbers) for factor, numbers in columns})


def _parse_factor(name: str, values: Iterable[Any]) -> Factor:
    if isinstance(values, (str, bytes, Mapping, Set)) or not isinstance(values, Iterable):
        raise OptionValueError(
            f"the factor {name!r} must be a range (low, high) or a list of levels, not"
            f" {short_repr(values)}"
        )
    plain = tuple(value.item() if isinstance(value, np.generic) else value for value in values)
    if isinstance(values, tuple):
        return _parse_range(name, plain)
    if not plain:
        raise OptionValueError(f"the factor {name!r} has no levels")
    for one, other in combinations(plain, 2):
        if type(one) is type(other) and same(one, other):  # arrays, too
            raise OptionValueError(f"the factor {name!r} has the level {short_repr(one)} twice")
    return Factor(name, 0, len(plain) - 1, int, plain)


def _parse_range(name: str, bounds: tuple[Any, ...]) -> Factor:
    """Return the factor of a range, of integers if both bounds are."""
    kinds = set(map(type, bounds))
    kind: type[float] = int if kinds == {int} else float
    most = EXACT if kind is int else float_info.max
    are_numbers = len(bounds) == 2 and kinds <= {int, float}
    if not are_numbers or not all(abs(bound) <= most for bound in bounds):
        raise OptionValueError(
            f"the factor {name!r} is {short_repr(bounds)}: a tuple is a range (low, high) of"
            " two finite floats, or of two integers that a float can hold exactly (up to 2**53);"
            " levels come as a list"
        )
    low, high = map(kind, bounds)
    if low >= high:
        raise OptionValueError(
            f"the range of {name!r} is empty: in {short_repr(bounds)}, low must be less than high"
        )
    return Factor(name, low, high, kind)


def check_size(number: int | None) -> int:
    """Return a number of rows, or raise an error if it is None or too large."""
    if number is None:
        raise OptionValueError("this method needs n, the number of rows")
    if number > MOST_ROWS:
        raise OptionValueError(
            f"the design would have {number:,} rows, more than {MOST_ROWS:,}; choose another"
            " method or a smaller n"
        )
    return number


# -- methods --------------------------------------------------------------------------------------


def _import_qmc() -> Any:
    """Return the quasi-random sequences of SciPy."""
    return import_extra("scipy.stats.qmc", "design")


def _import_pydoe() -> Any:
    """Return pyDOE. Its releases for NumPy before 2.2 have another name."""
    return import_extra("pydoe" if find_spec("pydoe") else "pyDOE", "design")


@dataclass(frozen=True)
class Builder:
    """Builds the numbers of a design, with one method for each method of ``design``."""

    factors: Sequence[Factor]
    n: int | None
    seed: int

    def full_factorial(self) -> Matrix:
        """Combine all levels, and ``n`` values of each range."""
        steps = [factor.steps(self.n) for factor in self.factors]
        check_size(prod(map(len, steps)))
        return np.array(list(product(*steps)))

    def fractional_factorial(self) -> Matrix:
        """Take a regular fraction of all combinations, of ``n`` rows."""
        number = len(self.factors)
        least = 2 ** ceil(np.log2(number + 1))
        n = self.n or least
        if n & (n - 1) or not least <= n <= min(2**number, MOST_ROWS):
            raise OptionValueError(
                f"a fractional design of {number} factors cannot have {n} runs: n must be a power"
                f" of two, from {least} to {2**number}"
            )
        columns = choose_columns(n.bit_length() - 1, number)
        bits = [[(row & column).bit_count() % 2 for column in columns] for row in range(n)]
        return self._choose_ends(np.array(bits))

    def plackett_burman(self) -> Matrix:
        """Take a Plackett-Burman design of as few rows as possible."""
        number = len(self.factors)
        pydoe = _import_pydoe()
        for columns in range(number, number + 8):  # pyDOE lacks some sizes; the next one may exist
            with suppress(ValueError):
                matrix = pydoe.pbdesign(columns)[:, :number]
                break
        else:
            raise OptionValueError(f"no Plackett-Burman design of {number} factors is known")
        return self._choose_ends(matrix)

    def central_composite(self) -> Matrix:
        """Take a central composite design."""
        number = len(self.factors)
        if number < 2 or any(factor.levels for factor in self.factors):
            raise OptionValueError(
                "a central composite design needs at least two ranges (low, high), and no levels;"
                " combine it with a design of the levels by merge(..., how='cross')"
            )
        check_size(2**number)
        # The centre occurs once: a simulation with the same seed would have the same result.
        matrix = _import_pydoe().ccdesign(
            number,
            center=(0, 1),
            alpha="rotatable",
            face="inscribed",
        )
        self._check_runs(matrix)
        return self._spread((matrix + 1) / 2)

    def latin_hypercube(self) -> Matrix:
        """Draw one sample from each slice of each factor."""
        return self._fill(_import_qmc().LatinHypercube)

    def sobol(self) -> Matrix:
        """Take the first points of a scrambled Sobol sequence."""
        return self._fill(_import_qmc().Sobol)

    def halton(self) -> Matrix:
        """Take the first points of a scrambled Halton sequence."""
        return self._fill(_import_qmc().Halton)

    def saltelli(self) -> Matrix:
        """Take the rows that Sobol indices need, of ``n`` samples."""
        samples = check_size(self.n)
        number = len(self.factors)
        check_size(samples * (2 * number + 2))
        points = _import_qmc().Sobol(2 * number, seed=self.seed).random(samples)
        first, last = np.split(points[:, None], 2, axis=2)
        return self._spread(saltelli_blocks(first, last).reshape(-1, number))

    def one_at_a_time(self) -> Matrix:
        """Change one factor at a time from the centre of ranges and the first of levels."""
        centre = [0.5 if factor.levels is None else 0.0 for factor in self.factors]
        rows = [*self._spread(np.array([centre]))]
        for place, factor in enumerate(self.factors):
            for number in factor.steps(self.n):
                if number != rows[0][place]:
                    row = rows[0].copy()
                    row[place] = number
                    rows.append(row)
        return np.array(rows)

    def _check_runs(self, matrix: NDArray[Any]) -> None:
        """Check ``n`` for a design whose size is fixed."""
        if self.n not in (None, len(matrix)):
            raise OptionValueError(
                f"this design of {len(self.factors)} factors has {len(matrix)} runs, not {self.n}"
            )

    def _choose_ends(self, matrix: NDArray[Any]) -> Matrix:
        """Return a two-level design, with the second level where the matrix is positive."""
        self._check_runs(matrix)
        for factor in self.factors:
            if factor.levels is not None and len(factor.levels) != 2:
                raise OptionValueError(
                    f"this method needs two levels of each factor, but {factor.name!r} has"
                    f" {len(factor.levels)}; give it two, or a range (low, high)"
                )
        return self._spread((matrix > 0).astype(float))

    def _fill(self, make_engine: Callable[..., Any]) -> Matrix:
        """Return ``n`` points of a sequence of SciPy."""
        engine = make_engine(len(self.factors), seed=self.seed)
        return self._spread(engine.random(check_size(self.n)))

    def _spread(self, units: Matrix) -> Matrix:
        """Map numbers from 0 to 1 to the numbers of the factors."""
        return np.stack(list(map(Factor.spread, self.factors, units.T)), axis=1)


def saltelli_blocks(first: NDArray[Any], last: NDArray[Any]) -> NDArray[Any]:
    """Return the rows of a Saltelli design, of shape ``(samples, 2 * factors + 2, factors)``.

    Each sample is a block: the first row; this with each factor of the last row in turn; the last
    row with each factor of the first in turn; the last row.

    Args:
        first: The first row of each block, ``(samples, 1, factors)``.
        last: The last row of each block, in the same shape.
    """
    own = np.eye(first.shape[-1], dtype=bool)
    mixed = [np.where(own, last, first), np.where(own, first, last)]
    return np.concatenate([first, *mixed, last], axis=1)


def choose_columns(basic: int, number: int) -> list[int]:
    """Return the columns of a fractional design that confounds low-order effects least.

    Columns are sets of bits: the product of two columns is their exclusive or.

    Args:
        basic: The number of factors with all their combinations. The others are their products.
        number: The number of factors.
    """
    for resolution in range(8, 2, -1):
        columns: list[int] = []
        # products[k]: the products of k columns
        products: list[set[int]] = [{0}, *(set() for _ in range(resolution - 2))]
        # The basic factors come first, then others greedily in ascending order, because this
        # lexicographic code is large.
        for word in [*(1 << place for place in range(basic)), *range(3, 2**basic)]:
            if len(columns) < number and not any(word in known for known in products):
                columns.append(word)
                for order in range(resolution - 2, 0, -1):
                    products[order] |= {other ^ word for other in products[order - 1]}
        if len(columns) == number:
            break
    return columns
