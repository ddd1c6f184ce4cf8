"""Designs of experiments: which combinations of factors to run."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from importlib.util import find_spec
from itertools import product
from math import ceil, prod
from string import ascii_lowercase
from sys import float_info
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from ..core import is_seed
from ..errors import OptionValueError, did_you_mean, short_repr
from ..many.parallel import import_extra
from .runner import dtype_of

if TYPE_CHECKING:
    from pandas import DataFrame

MOST_ROWS: Final = 10_000_000
"""The largest number of rows. A larger design is considered a mistake."""

EXACT: Final = 2**53
"""The integers below this are exact as floats. Larger ones are computed as integers."""


@dataclass(frozen=True)
class Factor:
    """A factor of an experiment: a list of levels or a range, whose bounds are inclusive."""

    name: str
    levels: tuple[Any, ...] | None = None
    low: Any = None
    high: Any = None

    @property
    def is_whole(self) -> bool:
        """Whether it is a range of integers."""
        return self.levels is None and isinstance(self.low, int)

    def spread(self, unit: NDArray[np.float64]) -> list[Any]:
        """Map numbers in [0, 1) to values of the factor, uniformly."""
        if self.levels is None and not self.is_whole:
            return self.scale(unit)
        number = self.high - self.low + 1 if self.levels is None else len(self.levels)
        places = [int(u * EXACT) * number // EXACT for u in unit.tolist()]
        return [self.low + place if self.levels is None else self.levels[place] for place in places]

    def scale(self, unit: NDArray[np.float64]) -> list[Any]:
        """Map numbers in [0, 1], inclusive, to values of a range."""
        if self.is_whole and max(-self.low, self.high) >= EXACT:
            return [self.low + round(Fraction(u) * (self.high - self.low)) for u in unit.tolist()]
        # this form cannot overflow
        values = [self.low * (1 - u) + self.high * u for u in unit.tolist()]
        values = [float(min(max(value, self.low), self.high)) for value in values]
        return [round(value) for value in values] if self.is_whole else values

    def steps(self, number: int | None) -> Collection[Any]:
        """Return ``number`` values (default 2) of a range from bound to bound, or all levels of a list."""
        if number == 1:
            raise OptionValueError("this method takes n values of each range; n must be at least 2")
        if self.levels is not None:
            return self.levels
        return dict.fromkeys(self.scale(np.linspace(0.0, 1.0, _rows(number or 2))))

    def ends(self) -> tuple[Any, ...]:
        """Return the two values for a two-level design."""
        values = (self.low, self.high) if self.levels is None else self.levels
        if len(values) != 2:
            raise OptionValueError(
                f"this method needs two levels of each factor, but {self.name!r} has"
                f" {len(values)}; give it two, or a range (low, high)"
            )
        return values


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
    parsed = [_factor(name, values) for name, values in factors.items()]
    if method not in list(METHODS):
        raise OptionValueError(
            f"method must be one of {', '.join(METHODS)}, not"
            f" {short_repr(method)}{did_you_mean(method, METHODS)}"
        )
    if n is not None and (isinstance(n, bool) or not isinstance(n, (int, np.integer)) or n < 1):
        raise OptionValueError(f"n must be a positive integer, not {short_repr(n)}")
    if seed is not None and not is_seed(seed):
        raise OptionValueError(
            f"seed must be a non-negative integer or None, not {short_repr(seed)}"
        )
    columns = METHODS[method](parsed, None if n is None else int(n), int(seed or 0))
    table: DataFrame = pandas.DataFrame(
        {
            factor.name: pandas.Series(
                values, dtype=dtype_of(factor.levels or (factor.low, factor.high), missing=False)
            )
            for factor, values in zip(parsed, columns, strict=True)
        }
    )
    return table


def _factor(name: Any, values: Any) -> Factor:
    if not isinstance(name, str) or not name:
        raise OptionValueError(f"the name of a factor must be a string, not {short_repr(name)}")
    if isinstance(values, tuple):
        numbers = [value.item() if isinstance(value, np.generic) else value for value in values]
        finite = (type(value) in (int, float) and abs(value) <= float_info.max for value in numbers)
        if len(numbers) != 2 or not all(finite):
            raise OptionValueError(
                f"the factor {name!r} is {short_repr(values)}: a tuple is a range (low, high) of"
                " two finite numbers that a float can hold; levels come as a list"
            )
        low, high = numbers
        if not low < high:
            raise OptionValueError(
                f"the range of {name!r} is empty: in {short_repr(values)}, low must be less than"
                " high"
            )
        kind = int if type(low) is type(high) is int else float
        return Factor(name, low=kind(low), high=kind(high))
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
    levels = tuple(value.item() if isinstance(value, np.generic) else value for value in values)
    if not levels:
        raise OptionValueError(f"the factor {name!r} has no levels")
    alike: dict[Any, list[Any]] = {}  # so that only few levels are compared
    for level in levels:
        others = alike.setdefault(
            (type(level), level if isinstance(level, (str, int, float)) else None), []
        )
        if any(_is_same(level, other) for other in others):
            raise OptionValueError(f"the factor {name!r} has the level {short_repr(level)} twice")
        others.append(level)
    return Factor(name, levels)


def _is_same(one: Any, other: Any) -> bool:
    try:
        return one is other or (type(one) is type(other) and bool(one == other))
    except Exception:  # for example of arrays
        return False


# -- methods: the columns of a design -------------------------------------------------------------

Columns = Iterable[Sequence[Any]]


def _pydoe() -> Any:
    """Return pyDOE. Its releases for NumPy before 2.2 have another name."""
    return import_extra("pydoe" if find_spec("pydoe") else "pyDOE", "design")


def _full_factorial(factors: Sequence[Factor], n: int | None, seed: int) -> Columns:
    steps = [factor.steps(n) for factor in factors]
    _rows(prod(map(len, steps)))
    return zip(*product(*steps), strict=True)


def _of_two_levels(factors: Sequence[Factor], matrix: Any) -> Columns:
    """Return the columns of a design from its matrix of -1 and 1."""
    return [
        [factor.ends()[int(sign > 0)] for sign in column]
        for factor, column in zip(factors, np.asarray(matrix).T, strict=True)
    ]


def _fractional_factorial(factors: Sequence[Factor], n: int | None, seed: int) -> Columns:
    pydoe, number = _pydoe(), len(factors)
    least = 2 ** ceil(np.log2(number + 1))
    if n is None:
        n = least
    if n & (n - 1) or not least <= n <= min(2**number, MOST_ROWS):
        raise OptionValueError(
            f"a fractional design of {number} factors cannot have {n} runs: n must be a power of"
            f" two, from {least} to {2**number}"
        )
    if n == 2**number:
        return _of_two_levels(factors, pydoe.ff2n(number))
    return _of_two_levels(factors, pydoe.fracfact(_generators(n.bit_length() - 1, number)))


def _generators(basic: int, number: int) -> str:
    """Return the generators of a fractional design, chosen so that low-order effects are confounded least.

    ``basic`` of the ``number`` factors have all their combinations. Columns are bits: the product
    of two columns is their exclusive or.
    """
    for resolution in range(min(basic + 1, 8), 2, -1):
        columns: list[int] = []
        # the sums of 0, 1, 2, ... columns
        sums: list[set[int]] = [{0}, *(set() for _ in range(resolution - 2))]
        # First the basic factors; then greedily in this order: a lexicographic code, which is
        # large.
        for word in [*(1 << place for place in range(basic)), *range(3, 2**basic)]:
            if len(columns) < number and not any(word in own for own in sums):
                columns.append(word)
                for fewer, own in zip(sums[-2::-1], sums[:0:-1], strict=True):
                    own |= {other ^ word for other in fewer}
        if len(columns) == number:
            break
    letters = ascii_lowercase
    return " ".join(
        "".join(letters[place] for place in range(basic) if column >> place & 1)
        for column in columns
    )


def _plackett_burman(factors: Sequence[Factor], n: int | None, seed: int) -> Columns:
    pydoe, number = _pydoe(), len(factors)
    for columns in range(number, number + 8):  # pyDOE lacks some sizes; the next one may exist
        with suppress(ValueError):
            matrix = pydoe.pbdesign(columns)[:, :number]
            break
    else:
        raise OptionValueError(f"no Plackett-Burman design of {number} factors is known")
    if n is not None and n != len(matrix):
        raise OptionValueError(
            f"a Plackett-Burman design of {number} factors has {len(matrix)} runs, not {n}"
        )
    return _of_two_levels(factors, matrix)


def _central_composite(factors: Sequence[Factor], n: int | None, seed: int) -> Columns:
    ranges = [factor for factor in factors if factor.levels is None]
    lists = [factor for factor in factors if factor.levels is not None]
    if len(ranges) < 2:
        raise OptionValueError(
            f"a central composite design needs at least two ranges (low, high), not {len(ranges)}"
        )
    levels = [factor.steps(None) for factor in lists]
    number = _rows((2 ** len(ranges) + 2 * len(ranges) + 1) * prod(map(len, levels)))
    if n is not None and n != number:
        raise OptionValueError(
            f"a central composite design of these {len(factors)} factors has {number} runs, not {n}"
        )
    # The centre occurs once: a simulation with the same seed would have the same result.
    matrix = (
        _pydoe().ccdesign(len(ranges), center=(0, 1), alpha="rotatable", face="inscribed").T + 1
    ) / 2
    surface = list(zip(*map(Factor.scale, ranges, matrix), strict=True))
    names = [factor.name for factor in (*lists, *ranges)]
    rows = [
        dict(zip(names, (*own, *values), strict=True))
        for own in product(*levels)
        for values in surface
    ]
    return [[row[factor.name] for row in rows] for factor in factors]


def _latin_hypercube(factors: Sequence[Factor], n: int | None, seed: int) -> Columns:
    return _spread(factors, _pydoe().lhs(len(factors), samples=_rows(n), seed=seed))


def _sobol(factors: Sequence[Factor], n: int | None, seed: int) -> Columns:
    points = _pydoe().sobol_sequence(
        _rows(n), len(factors), scramble=True, seed=seed, use_pow_of_2=False
    )
    return _spread(factors, points)


def _halton(factors: Sequence[Factor], n: int | None, seed: int) -> Columns:
    pydoe = _pydoe()
    return _spread(
        factors,
        pydoe.cranley_patterson_shift(pydoe.halton_sequence(_rows(n), len(factors)), seed=seed),
    )


def _saltelli(factors: Sequence[Factor], n: int | None, seed: int) -> Columns:
    rows, names = _rows(n), [factor.name for factor in factors]
    if rows & (rows - 1):
        raise OptionValueError(
            f"the number of samples of a Saltelli design must be a power of two, not {rows}"
        )
    _rows(rows * (2 * len(names) + 2))
    problem = {"num_vars": len(names), "names": names, "bounds": [[0.0, 1.0]] * len(names)}
    return _spread(
        factors, import_extra("SALib.sample.sobol", "design").sample(problem, rows, seed=seed)
    )


def _one_at_a_time(factors: Sequence[Factor], n: int | None, seed: int) -> Columns:
    middle = [f.levels[0] if f.levels is not None else f.scale(np.array([0.5]))[0] for f in factors]
    rows = [middle]
    for place, factor in enumerate(factors):
        for value in factor.steps(n):
            if not _is_same(value, middle[place]):
                rows.append([*middle[:place], value, *middle[place + 1 :]])
    return zip(*rows, strict=True)


def _rows(number: int | None) -> int:
    """Return the number of rows, which must be known and not too large."""
    if number is None:
        raise OptionValueError("this method needs n, the number of rows")
    if number > MOST_ROWS:
        raise OptionValueError(
            f"the design would have {number:,} rows, more than {MOST_ROWS:,}; choose another"
            " method or a smaller n"
        )
    return number


def _spread(factors: Sequence[Factor], points: Any) -> Columns:
    return [
        factor.spread(column) for factor, column in zip(factors, np.asarray(points).T, strict=True)
    ]


METHODS: Final[Mapping[str, Callable[[Sequence[Factor], int | None, int], Columns]]] = {
    method.__name__[1:]: method
    for method in (
        _full_factorial, _fractional_factorial, _latin_hypercube, _sobol, _halton, _plackett_burman,
        _central_composite, _one_at_a_time, _saltelli,
    )
}  # fmt: skip
