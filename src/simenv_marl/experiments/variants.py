"""Variants: one model, many experiments, each with a name for all of its changes.

A variant holds the differences between experiments on a model: parameters of the model, plugins, definitions of
decision points, and policies that decide instead of agents. A variant can be given wherever a simulation is expected.
Further arguments there add to those of the variant.
"""

import inspect
from collections.abc import Iterable, Mapping
from dataclasses import KW_ONLY, dataclass, field
from functools import partial
from types import MappingProxyType
from typing import Any

from ..core.points import Points, portable
from ..errors import OptionValueError, SimEnvError, SimulationError, short_repr


@dataclass(frozen=True, eq=False)
class Variant:
    """A simulation with all changes of an experiment, under one name. Immutable.

    Use ``dataclasses.replace`` to derive another variant.

    Attributes:
        name: Its name in results.
        simulation: A simulation (which is copied), its class, or a factory.
        parameters: The keyword arguments of the class or factory.
        points: The decision points and their definitions, as ``generate_env`` takes them.
        plugins: Handlers for its simulations alone, as the option ``plugins`` takes them. Handlers that are given where
            the variant is used run after these.
        policies: Policies that decide without being agents, as the option ``policies`` takes them.
        options: All other options of its environments.
    """

    name: str
    simulation: Any
    _: KW_ONLY
    parameters: Mapping[str, Any] = field(default_factory=dict)
    points: Points = None
    plugins: Iterable[Any] = ()
    policies: Mapping[Any, Any] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise OptionValueError(f"a variant needs a name, not {short_repr(self.name)}")
        source = self.simulation
        if isinstance(source, Variant):
            raise SimulationError(
                f"the variant {self.name!r} needs a simulation, not the variant {source.name!r}; derive one"
                " variant from another with dataclasses.replace"
            )
        for name in ("parameters", "policies", "options"):
            value = getattr(self, name)
            if not isinstance(value, Mapping):
                raise OptionValueError(f"{name} of the variant {self.name!r} must be a dict, not {short_repr(value)}")
            # Copied, so that later changes of the arguments do not change the variant.
            object.__setattr__(self, name, MappingProxyType(dict(value)))
        object.__setattr__(self, "plugins", tuple(self.plugins))
        twice = [name for name in ("plugins", "policies") if name in self.options]
        if twice:
            raise OptionValueError(
                f"{' and '.join(twice)} must be arguments of the variant {self.name!r} itself, not among its options"
            )
        if self.parameters:
            what = f"the variant {self.name!r} has parameters, so its simulation must be a class or a factory"
            check_call(source, self.parameters, SimulationError, what, f"the parameters of the variant {self.name!r}")

    def __reduce__(self) -> Any:
        # Functions are pickled by name: while environments are in use, hooks may stand in their places.
        points = self.points
        if isinstance(points, Mapping):
            points = {portable(key): definition for key, definition in points.items()}
        elif points is not None and not isinstance(points, str):
            points = [portable(key) for key in (points if isinstance(points, Iterable) else [points])]
        return partial(
            Variant,
            self.name,
            self.simulation,
            parameters=dict(self.parameters),
            points=points,
            plugins=[(handler, portable(target), *rest) for handler, target, *rest in self.plugins],
            policies={portable(key): policy for key, policy in self.policies.items()},
            options=dict(self.options),
        ), ()

    def environment_arguments(self, points: Any, options: Mapping[str, Any]) -> tuple[Any, Any, dict[str, Any]]:
        """Return simulation, points and options of an environment of this variant, with those that are given to it."""
        source = partial(self.simulation, **self.parameters) if self.parameters else self.simulation
        merged = {**self.options, **options}
        policies = {**self.policies, **(options.get("policies") or {})}
        plugins = (*self.plugins, *options.get("plugins", ()))
        if policies:
            merged["policies"] = policies
        if plugins:
            merged["plugins"] = plugins
        return source, self.points if points is None else points, merged


def check_call(
    source: Any, arguments: Mapping[str, Any], error: type[SimEnvError], requirement: str, described: str
) -> None:
    """Check that something is a class or a factory, as ``requirement`` says, and takes the described arguments."""
    if not callable(source) or (hasattr(source, "run") and not isinstance(source, type)):
        raise error(f"{requirement}, not {short_repr(source)}")
    try:
        inspect.signature(source).bind(**arguments)
    except TypeError as problem:
        name = getattr(source, "__qualname__", None) or short_repr(source)
        raise error(f"{name} cannot be called with {described}: {problem}") from problem
    except ValueError:  # a builtin without a signature
        pass
