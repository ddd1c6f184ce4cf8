"""Designs of experiments: which combinations of factors to run."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from importlib.util import find_spec
from itertools import product
from math import ceil, prod
from numbers import Integral
from string import ascii_lowercase
from sys import float_info
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..core import checked_seed, same
from ..errors import OptionValueError, did_you_mean, short_repr
from ..many.parallel import import_extra
from .runner import EXACT, dtype_of

if TYPE_CHECKING:
    from pandas import DataFrame

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
"""A design in numbers, of shape ``(rows, factors)``."""

Columns = Iterable[Sequence[Any]]
"""The values of each factor, in the order of the rows."""


@dataclass(frozen=True)
class Factor:
    """A factor of an experiment.

    Attributes:
        values: The levels. Of a range: the lowest and the highest value.
        kind: The type of the values of a range, int or float. None: the factor has levels.
    """

    name: str
    values: tuple[Any, ...]
    kind: type[float] | None = None

    def sample(self, unit: Matrix) -> list[Any]:
        """Map numbers in [0, 1) to values of the factor, uniformly."""
        if self.kind is float:
            return self.scale(unit)
        low = 0
        high = len(self.values) - 1
        if self.kind is int:
            low, high = self.values
        exact = [int(u * EXACT) for u in unit.tolist()]
        numbers = [low + u * (high - low + 1) // EXACT for u in exact]
        if self.kind is int:
            return numbers
        return [self.values[number] for number in numbers]

    def scale(self, unit: Matrix) -> list[Any]:
        """Map numbers in [0, 1], inclusive, to values of a range."""
        low, high = self.values
        if self.kind is int and max(-low, high) >= EXACT:
            return [low + round(Fraction(u) * (high - low)) for u in unit.tolist()]
        # Not low + unit * (high - low), because the difference may overflow.
        values = np.clip(low * (1 - unit) + high * unit, low, high).tolist()
        if self.kind is int:
            return list(map(round, values))
        return list(values)

    def steps(self, number: int | None) -> Collection[Any]:
        """Return all levels, or ``number`` values (default 2) of a range from bound to bound."""
        if number == 1:
            raise OptionValueError("this method takes n values of each range; n must be at least 2")
        if self.kind is None:
            return self.values
        unit = np.linspace(0.0, 1.0, check_size(number or 2))
        return dict.fromkeys(self.scale(unit))

    def centre(self) -> Any:
        """Return the first of levels, or the middle of a range."""
        if self.kind is None:
            return self.values[0]
        return self.scale(np.array([0.5]))[0]

    def ends(self) -> tuple[Any, ...]:
        """Return the two values for a two-level design."""
        if len(self.values) != 2:
            raise OptionValueError(
                f"this method needs two levels of each factor, but {self.name!r} has"
                f" {len(self.values)}; give it two, or a range (low, high)"
            )
        return self.values


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
            - ``"central_composite"``: two or more ranges, for a quadratic response surface:
              corners, star points and the centre, all within the ranges; once for each combination
              of levels.
            - ``"latin_hypercube"``, ``"sobol"``, ``"halton"``: ``n`` rows that fill the space.
            - ``"one_at_a_time"``: the centre of ranges and the first of levels; then each factor
              alone at its other values, for a range ``n`` (default 2) values from bound to bound.
            - ``"saltelli"``: ``n`` samples (a power of two) for ``sobol_indices``, in
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
        MissingExtraError: pandas, pyDOE or SALib is missing.
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
    is_integer = isinstance(n, Integral) and not isinstance(n, bool)
    if n is not None and not (is_integer and n > 0):
        raise OptionValueError(f"n must be a positive integer, not {short_repr(n)}")
    builder = Builder(parsed_factors, None if n is None else int(n), checked_seed(seed) or 0)
    columns = getattr(builder, method)()
    return pandas.DataFrame(
        {
            factor.name: pandas.Series(column, dtype=dtype_of(factor.values, missing=False))
            for factor, column in zip(parsed_factors, columns, strict=True)
        }
    )


def _parse_factor(name: str, values: Iterable[Any]) -> Factor:
    if not isinstance(name, str) or not name:
        raise OptionValueError(f"the name of a factor must be a string, not {short_repr(name)}")
    if isinstance(values, (set, frozenset)):
        raise OptionValueError(
            f"the levels of {name!r} must have an order, as in a list: {short_repr(values)} has"
            " none"
        )
    if isinstance(values, (str, bytes, Mapping)) or not isinstance(values, Iterable):
        raise OptionValueError(
            f"the factor {name!r} must be a range (low, high) or a list of levels, not"
            f" {short_repr(values)}"
        )
    plain = tuple(value.item() if isinstance(value, np.generic) else value for value in values)
    if isinstance(values, tuple):
        bounds = _parse_bounds(name, plain)
        return Factor(name, bounds, type(bounds[0]))
    if not plain:
        raise OptionValueError(f"the factor {name!r} has no levels")
    groups: dict[tuple[type, Any], list[Any]] = {}  # so that few pairs of levels are compared
    for level in plain:
        key = level if isinstance(level, (str, int, float)) else None
        others = groups.setdefault((type(level), key), [])
        if any(same(level, other) for other in others):  # arrays, too
            raise OptionValueError(f"the factor {name!r} has the level {short_repr(level)} twice")
        others.append(level)
    return Factor(name, plain)


def _parse_bounds(name: str, bounds: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return the bounds of a range as two integers or two floats."""
    kinds = set(map(type, bounds))
    are_numbers = len(bounds) == 2 and kinds <= {int, float}
    if not are_numbers or not all(abs(bound) <= float_info.max for bound in bounds):
        raise OptionValueError(
            f"the factor {name!r} is {short_repr(bounds)}: a tuple is a range (low, high) of"
            " two finite numbers that a float can hold; levels come as a list"
        )
    if not bounds[0] < bounds[1]:
        raise OptionValueError(
            f"the range of {name!r} is empty: in {short_repr(bounds)}, low must be less than high"
        )
    return bounds if kinds == {int} else tuple(map(float, bounds))


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


def _import_pydoe() -> Any:
    """Return pyDOE. Its releases for NumPy before 2.2 have another name."""
    return import_extra("pydoe" if find_spec("pydoe") else "pyDOE", "design")


@dataclass(frozen=True)
class Builder:
    """Builds the columns of a design, with one method for each method of ``design``."""

    factors: Sequence[Factor]
    n: int | None
    seed: int

    def full_factorial(self) -> Columns:
        """Combine all levels, and ``n`` values of each range."""
        steps = [factor.steps(self.n) for factor in self.factors]
        check_size(prod(map(len, steps)))
        return zip(*product(*steps), strict=True)

    def fractional_factorial(self) -> Columns:
        """Take a regular fraction of all combinations, of ``n`` rows."""
        number = len(self.factors)
        least = 2 ** ceil(np.log2(number + 1))
        n = self.n or least
        if n & (n - 1) or not least <= n <= min(2**number, MOST_ROWS):
            raise OptionValueError(
                f"a fractional design of {number} factors cannot have {n} runs: n must be a power"
                f" of two, from {least} to {2**number}"
            )
        generators = make_generators(n.bit_length() - 1, number)
        return self._choose_ends(_import_pydoe().fracfact(generators))

    def plackett_burman(self) -> Columns:
        """Take a Plackett-Burman design of as few rows as possible."""
        number = len(self.factors)
        pydoe = _import_pydoe()
        for columns in range(number, number + 8):  # pyDOE lacks some sizes; the next one may exist
            with suppress(ValueError):
                matrix = pydoe.pbdesign(columns)[:, :number]
                break
        else:
            raise OptionValueError(f"no Plackett-Burman design of {number} factors is known")
        if self.n not in (None, len(matrix)):
            raise OptionValueError(
                f"a Plackett-Burman design of {number} factors has {len(matrix)} runs, not {self.n}"
            )
        return self._choose_ends(matrix)

    def central_composite(self) -> Columns:
        """Repeat a central composite design of the ranges for each combination of levels."""
        ranges = [factor for factor in self.factors if factor.kind]
        levels = [factor.values for factor in self.factors if not factor.kind]
        number = len(ranges)
        if number < 2:
            raise OptionValueError(
                f"a central composite design needs at least two ranges (low, high), not {number}"
            )
        size = check_size((2**number + 2 * number + 1) * prod(map(len, levels)))
        if self.n not in (None, size):
            raise OptionValueError(
                f"a central composite design of these {len(self.factors)} factors has {size} runs,"
                f" not {self.n}"
            )
        # The centre occurs once: a simulation with the same seed would have the same result.
        matrix = _import_pydoe().ccdesign(
            number,
            center=(0, 1),
            alpha="rotatable",
            face="inscribed",
        )
        points = zip(*map(Factor.scale, ranges, (matrix.T + 1) / 2), strict=True)
        rows = product(*levels, points)
        *of_lists, surface = zip(*rows, strict=True)
        list_columns = iter(of_lists)
        range_columns = zip(*surface, strict=True)
        return [next(range_columns if f.kind else list_columns) for f in self.factors]

    def latin_hypercube(self) -> Columns:
        """Draw one sample from each slice of each factor."""
        size = check_size(self.n)
        points = _import_pydoe().lhs(len(self.factors), samples=size, seed=self.seed)
        return self._sample(points)

    def sobol(self) -> Columns:
        """Take the first points of a scrambled Sobol sequence."""
        size = check_size(self.n)
        points = _import_pydoe().sobol_sequence(
            size,
            len(self.factors),
            scramble=True,
            seed=self.seed,
            use_pow_of_2=False,
        )
        return self._sample(points)

    def halton(self) -> Columns:
        """Take the first points of a shifted Halton sequence."""
        size = check_size(self.n)
        pydoe = _import_pydoe()
        points = pydoe.halton_sequence(size, len(self.factors))
        return self._sample(pydoe.cranley_patterson_shift(points, seed=self.seed))

    def saltelli(self) -> Columns:
        """Take the rows that Sobol indices need, of ``n`` samples."""
        samples = check_size(self.n)
        number = len(self.factors)
        if samples & (samples - 1):
            raise OptionValueError(
                f"the number of samples of a Saltelli design must be a power of two, not {samples}"
            )
        check_size(samples * (2 * number + 2))
        names = [factor.name for factor in self.factors]
        problem = {"num_vars": number, "names": names, "bounds": [[0.0, 1.0]] * number}
        sampler = import_extra("SALib.sample.sobol", "design")
        return self._sample(sampler.sample(problem, samples, seed=self.seed))

    def one_at_a_time(self) -> Columns:
        """Change one factor at a time from the centre of ranges and the first of levels."""
        centre = [factor.centre() for factor in self.factors]
        rows = [centre]
        for place, factor in enumerate(self.factors):
            for value in factor.steps(self.n):
                # Two levels may be equal, such as 1 and True.
                is_centre = value is centre[place] or (factor.kind and value == centre[place])
                if not is_centre:
                    rows.append([*centre[:place], value, *centre[place + 1 :]])
        return zip(*rows, strict=True)

    def _choose_ends(self, matrix: Matrix) -> Columns:
        """Return the columns of a two-level design from its matrix of -1 and 1."""
        return [
            [factor.ends()[int(sign > 0)] for sign in column]
            for factor, column in zip(self.factors, matrix.T, strict=True)
        ]

    def _sample(self, points: Matrix) -> Columns:
        """Return the columns of a design from points in [0, 1)."""
        return list(map(Factor.sample, self.factors, points.T))


def make_generators(basic: int, number: int) -> str:
    """Return pyDOE's generators of a fractional design that confounds low-order effects least.

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
    return " ".join(
        "".join(
            letter for place, letter in enumerate(ascii_lowercase[:basic]) if column >> place & 1
        )
        for column in columns
    )
