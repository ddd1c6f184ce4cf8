"""The interface of simulations, and the sentinels ``RULE`` and ``TRUNCATED``."""

import copy
import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable
from types import FunctionType, MethodType
from typing import Any, Final, final
from weakref import WeakKeyDictionary

from .errors import SimulationError, shown, told


@final
class Sentinel:
    """A value that equals only itself and survives copies and pickles."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __repr__(self) -> str:
        return f"simenv_marl.{self._name}"

    def __reduce__(self) -> str:
        return self._name


RULE: Final = Sentinel("RULE")
"""An action that lets the model's own rule decide (accepted by every view's ``step``)."""

TRUNCATED: Final = Sentinel("TRUNCATED")
"""The result of a ``run()`` that ended at a time limit, not at an end of the task."""


class SimulationInterface(ABC):
    """A simulation that runs its own main loop (paper, section 3.3).

    Deriving from this class is optional: any object with ``run`` and ``reset`` works. Besides the methods below, a
    simulation may define:

    - ``reset(self, seed=None)`` or ``reset(self, seed=None, options=None)`` instead of ``reset(self)``: it then always
      gets an integer seed, and the ``options`` of the environment's ``reset``.
    - ``points``: the default decision points of its environments (a dotted name, a decision function, a list of these,
      or a dict from these to definitions).
    - ``expected_calls(self, point)``: the argument tuples of the next calls of the decision point with that dotted
      name, so that agents can be observed before their first decision.
    - ``close(self)``: releases what must stay open until the last observations were made (files, connections,
      licences). It is called once for each successful ``reset``: before the next ``reset``, when the environment is
      closed, or when it is garbage-collected. ``close(self, last)`` gets True in the latter two cases, to release what
      it keeps between episodes (a process, a connection).
    - ``time(self)``: its clock, the source of ``info["time"]`` and ``info["elapsed"]``.
    - ``reseed(self, seed)``: seeds its generators in place, so that future random numbers are drawn anew: for
      ``branch`` with ``seeds``. ``reseed_generators(self, seed)`` does this in the usual cases.
    - ``state(self)``: all that a centralised critic may see, as an array.
    - ``render(self, mode)``: an image of the present state, for a ``mode`` out of ``render_modes``; ``render_fps`` is
      the number of images per second of a video (default 4).
    """

    @abstractmethod
    def reset(self) -> None:
        """Reset the simulation to the initial state of an episode."""

    @abstractmethod
    def run(self) -> Any:
        """Run the main loop of one episode. When it returns, the episode ends.

        Returns:
            ``TRUNCATED`` if the episode ends at a time limit; anything else means an end of the task.
        """

    def end_agent(self, name: str) -> None:  # noqa: B027 - outside an environment it has no effect
        """End an agent's episode: it gets its last reward and observation, and takes no further part.

        Call this from the running model for agents that end without a call that ``removed_by=`` could name. It has no
        effect outside an environment, or if no live agent has this name.

        Args:
            name: The name of the agent, as ``agent=`` gives it.
        """

    def stop(self) -> None:  # noqa: B027 - optional; the default does nothing
        """Ask the main loop to end. It is called before a simulation is unwound in mid-episode."""


def make_simulation(source: Any) -> Any:
    """Make a new simulation for an environment.

    Args:
        source: An instance (which is copied), a class or a zero-argument factory.

    Returns:
        The new simulation.

    Raises:
        SimulationError: ``source`` is none of these, cannot be copied, or does not make a simulation.
    """
    if not isinstance(source, type) and hasattr(source, "run"):
        try:
            simulation = copy.deepcopy(source)
        except Exception as error:
            raise SimulationError(
                f"the simulation {shown(source)} cannot be copied ({told(error)}); give its class"
                " or a zero-argument factory instead of an instance"
            ) from error
    elif callable(source):
        simulation = source()
    else:
        raise SimulationError(
            f"{shown(source)} is no simulation: give an object with run() and reset(), its class, or a factory"
        )
    for name in ("run", "reset"):
        if not callable(getattr(simulation, name, None)):
            raise SimulationError(f"{shown(simulation)} has no method {name}(), which every simulation needs")
    return simulation


def resetter(simulation: Any) -> Callable[[int | None, dict[str, Any] | None], None]:
    """Find out which arguments the simulation's ``reset`` takes.

    Args:
        simulation: The simulation.

    Returns:
        A function of seed and options that resets the simulation and passes on the arguments that ``reset`` takes. The
        signature is inspected once, here.
    """
    seeded, optioned = _taken(simulation.reset, "seed"), _taken(simulation.reset, "options")

    def reset(seed: int | None, options: dict[str, Any] | None) -> None:
        arguments: dict[str, Any] = {}
        if seeded:
            arguments["seed"] = seed
        if optioned:
            arguments["options"] = options
        simulation.reset(**arguments)

    return reset


def closer(simulation: Any) -> Callable[[bool], None] | None:
    """Find out whether a simulation has a ``close``, and what it takes.

    Returns:
        A function of a bool: whether no reset follows. None if there is no ``close``.
    """
    close = getattr(simulation, "close", None)
    if close is None:
        return None
    return (lambda last: close(last=last)) if _taken(close, "last") else lambda last: close()


_TAKEN: WeakKeyDictionary[Any, dict[str, bool]] = WeakKeyDictionary()
"""The keyword arguments of functions. Inspecting a signature takes longer than all other preparation."""


def _taken(method: Any, name: str) -> bool:
    """Return whether a method of a simulation takes a keyword argument of that name."""
    function = method.__func__ if type(method) is MethodType and type(method.__func__) is FunctionType else None
    if function is None:
        return takes(method, name)
    known = _TAKEN.setdefault(function, {})
    if name not in known:
        known[name] = takes(method, name)
    return known[name]


def takes(function: Callable[..., Any], name: str) -> bool:
    """Return whether a function takes a keyword argument of that name."""
    try:
        parameters = inspect.signature(function).parameters
    except (TypeError, ValueError):
        return False
    parameter = parameters.get(name)
    if parameter is not None:
        return parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY)
    return any(p.kind is p.VAR_KEYWORD for p in parameters.values())


def positional(function: Callable[..., Any]) -> list[inspect.Parameter]:
    """Return the positional parameters of a function; none if its signature is unknown."""
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):
        return []
    return [p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
