"""Makes the simulations of an experiment, row by row, and the plans of their episodes."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from operator import is_
from typing import Any, Final, NamedTuple

from ..core.plan import Plan
from ..core.prototype import Prototype as Spare
from ..core.provenance import describe, written_plainly
from ..errors import OptionValueError, short_repr
from .playing import Policies, contender_plan, telling
from .store import written
from .variants import Variant

Row = Mapping[str, Any]

LOOKED_AT: Final = ("points", "render_modes", "render_fps")
"""The attributes of a simulation that its plan depends on, besides the class."""

KEPT: Final = 8
"""The number of plans that are kept for each contender, for rows that need different ones."""


def checked_make(make: Any, row: Row) -> None:
    """Check that ``make`` takes the factors.

    Raises:
        OptionValueError, SimulationError: It does not.
    """
    if isinstance(make, Variant):
        _varied(make, row)
        return
    if not callable(make) or (hasattr(make, "run") and not isinstance(make, type)):
        raise OptionValueError(
            f"make must be a callable of the factors, such as a class, or a Variant, not {short_repr(make)}"
        )
    try:
        inspect.signature(make).bind(**row)
    except TypeError as error:
        name = getattr(make, "__qualname__", None) or short_repr(make)
        raise OptionValueError(
            f"{name} cannot be called with the factors {', '.join(row) or '(none)'}: {error}"
        ) from error
    except ValueError:  # a builtin without a signature
        pass


def _varied(variant: Variant, row: Row) -> Variant:
    return replace(variant, parameters={**variant.parameters, **row}) if row else variant


class _Supply:
    """A factory of the simulations of a row. The first simulation exists already."""

    def __init__(self, make: Callable[..., Any], row: Row, first: Any) -> None:
        self._make, self._row, self._first = make, row, first
        kind = type(first)  # provenance names it after the class that it makes
        self.__name__, self.__qualname__, self.__module__ = kind.__name__, kind.__qualname__, kind.__module__

    def __call__(self) -> Any:
        first, self._first = self._first, None
        return self._make(**self._row) if first is None else first


class _Drawn(NamedTuple):
    """A plan that may be used for other rows.

    Attributes:
        plan: The plan.
        of: The objects that the plan depends on, compared by identity.
        provenance: The provenance of an episode, as JSON, without the parts in which rows differ.
    """

    plan: Plan
    of: tuple[Any, ...]
    provenance: str


class Workshop:
    """Makes the plans of runs. Rows share a plan if their simulations are alike in all that a plan depends on."""

    def __init__(
        self,
        make: Any,
        contenders: Mapping[str, Policies],
        points: Any,
        options: Mapping[str, Any],
        named: Sequence[Any],
    ) -> None:
        self._make, self._contenders = make, contenders
        self._points, self._options, self._named = points, options, named
        self._drawn: dict[str, list[_Drawn]] = {}

    def forget(self) -> None:
        """Forget all plans, since an error may have changed something in them."""
        self._drawn.clear()

    def plan(self, row: Row, contender: str) -> tuple[Plan, Callable[[int], str]]:
        """Return the plan of a row's episodes.

        Returns:
            The plan, and a function from seed to the provenance of the episode, as JSON.

        Raises:
            BaseException: Any exception of making a simulation or its plan.
        """
        source = self._source(row)
        variant = source if isinstance(source, Variant) else None
        drawn = self._drawn.setdefault(contender, [])
        plan, base = self._used_again(drawn, source, variant) or self._draw(drawn, source, variant, contender)
        own: dict[str, Any] = {"variant": None, "parameters": {}}
        if variant is not None:
            own = {"variant": variant.name, "parameters": written_plainly(variant.parameters)}
        return plan, partial(_provenance, f"{base[:-1]},{written(own)[1:-1]}")

    def _used_again(self, drawn: list[_Drawn], source: Any, variant: Variant | None) -> tuple[Plan, str] | None:
        if not drawn:
            return None
        factory = source if variant is None else variant.environment_arguments(None, {})[0]
        spare = Spare(factory, drawn[0].plan.options.driver)
        of = _depended_on(spare.simulation, variant)
        for plan, known, base in drawn:
            if len(of) == len(known) and all(map(is_, of, known)) and plan.options.driver == spare.kind:
                return (plan.with_source(factory, variant, spare), base) if not plan.stale else None
        return None

    def _draw(self, drawn: list[_Drawn], source: Any, variant: Variant | None, contender: str) -> tuple[Plan, str]:
        policies = self._contenders[contender]
        with telling(contender):
            plan = contender_plan(source, policies, self._points, self._options, self._named)
        own = {} if variant is None else variant.policies
        described = describe(plan, None) | {
            "make": _name_of(self._make),
            "policies": written_plainly({**own, **policies}),
        }
        for name in ("variant", "parameters", "seed"):
            del described[name]
        base = written(described)
        if plan.inspected is not None:
            drawn.insert(0, _Drawn(plan, _depended_on(plan.inspected, variant), base))
            del drawn[KEPT:]
        return plan, base

    def _source(self, row: Row) -> Any:
        """Return the source of a row's simulations: a variant or a factory."""
        make = self._make
        if isinstance(make, Variant):
            return _varied(make, row)
        if isinstance(make, type):
            return partial(make, **row)
        thing = make(**row)
        if isinstance(thing, (Variant, type)) or not hasattr(thing, "run"):
            return partial(thing) if isinstance(thing, type) else thing
        return _Supply(make, row, thing)


def _depended_on(simulation: Any, variant: Variant | None) -> tuple[Any, ...]:
    """Return the objects that a plan depends on, to be compared by identity."""
    own = type(simulation), *(getattr(simulation, name, None) for name in LOOKED_AT)
    if variant is None:
        return own
    pairs = (*variant.policies.items(), *variant.options.items())
    return (
        *own,
        variant.points,
        *(part for plugin in variant.plugins for part in plugin),
        *(x for p in pairs for x in p),
    )


def _provenance(base: str, seed: int) -> str:
    return f'{base},"seed":{seed}}}'


def _name_of(make: Any) -> str:
    """Return the dotted name of ``make``, or the name of a variant."""
    if isinstance(make, Variant):
        return make.name
    while isinstance(make, partial):
        make = make.func
    named = make if hasattr(make, "__qualname__") else type(make)
    return f"{named.__module__}.{named.__qualname__}"
