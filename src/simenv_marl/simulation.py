"""What a simulation is to this library, and the two words that it and its user may say."""

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
    """A value that is equal to itself alone, and stays itself through copies and pickles."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __repr__(self) -> str:
        return f"simenv_marl.{self._name}"

    def __reduce__(self) -> str:
        return self._name


RULE: Final = Sentinel("RULE")
"""As an action: let the model's own rule decide (accepted by every view's ``step``)."""

TRUNCATED: Final = Sentinel("TRUNCATED")
"""As the result of ``run()``: the episode ended at a limit of time, not at an end of the task."""


class SimulationInterface(ABC):
    """A simulation that is in the lead of its own main loop (paper, section 3.3).

    Deriving from this class is a convenience: any object with ``run`` and ``reset`` serves. What
    a simulation may define beside the methods below:

    - ``reset(self, seed=None)`` or ``reset(self, seed=None, options=None)`` instead of ``reset(self)``:
      it then always gets an integer seed, and the ``options`` of the environment's ``reset``.
    - ``points``: the decision points that environments use unless they are told otherwise (a dotted
      name, a decision function, a list of these, or a dict from these to definitions).
    - ``expected_calls(self, point)``: the argument tuples with which the decision point of that dotted
      name is going to be called, so that agents can be observed before their first decision.
    - ``close(self)``: lets go of what must stay open until the last observations were made (files, connections,
      licences). Called once for each ``reset`` that has succeeded: before the next one, when the environment is
      closed, or when it is gone. ``close(self, last)`` is told whether it is one of the latter two, for what it keeps
      from one episode to the next (a process, a connection).
    - ``time(self)``: its clock, from which ``info["time"]`` and ``info["elapsed"]`` come.
    - ``reseed(self, seed)``: seeds its generators in place, so that the chance that lies ahead is drawn anew: for
      ``branch`` with ``seeds``. ``reseed_generators(self, seed)`` does it for the usual cases.
    - ``state(self)``: all that a centralised critic may see, as an array.
    - ``render(self, mode)``: a picture of the present state, for a ``mode`` out of ``render_modes``; with
      ``render_fps``, how many of them make a second of a film (4).
    """

    @abstractmethod
    def reset(self) -> None:
        """Return the simulation to the initial state of an episode."""

    @abstractmethod
    def run(self) -> Any:
        """Run the main loop of one episode; its return ends the episode.

        Returns:
            ``TRUNCATED`` where the end is a limit of time; anything else is an end of the task.
        """

    def end_agent(self, name: str) -> None:  # noqa: B027 - nothing is to be done outside of an environment
        """Say that an agent's episode ends here: it gets its last reward and observation, and takes no part any more.

        To be called from the model while it runs, for agents that end without a call that ``removed_by=`` could name.
        For what is no live agent of the environment, and outside of one, nothing comes of it.

        Args:
            name: The agent, by the name that ``agent=`` gives it.
        """

    def stop(self) -> None:  # noqa: B027 - leaving it out is allowed, and then nothing is to be done
        """Ask the main loop to end; called before a simulation is unwound in mid-episode."""


def make_simulation(source: Any) -> Any:
    """Make one simulation of an environment's own.

    Args:
        source: An instance (which is copied), a class or a zero-argument factory.

    Returns:
        The new simulation.

    Raises:
        SimulationError: ``source`` is none of these, cannot be copied, or makes no simulation.
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
    """Find out what the simulation's ``reset`` takes.

    Args:
        simulation: The simulation.

    Returns:
        A function of seed and options that resets the simulation with as much of them as it takes. Its
        attribute of the signature is looked at once, here.
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
    """Find out whether a simulation has a ``close``, and what that takes.

    Returns:
        A function of whether no reset follows; None where there is nothing to close.
    """
    close = getattr(simulation, "close", None)
    if close is None:
        return None
    return (lambda last: close(last=last)) if _taken(close, "last") else lambda last: close()


_TAKEN: WeakKeyDictionary[Any, dict[str, bool]] = WeakKeyDictionary()
"""By function: what it takes. To find that out takes longer than all else that a simulation is made ready by."""


def _taken(method: Any, name: str) -> bool:
    """Whether a method of a simulation takes a keyword argument of that name."""
    function = method.__func__ if type(method) is MethodType and type(method.__func__) is FunctionType else None
    if function is None:
        return takes(method, name)
    known = _TAKEN.setdefault(function, {})
    if name not in known:
        known[name] = takes(method, name)
    return known[name]


def takes(function: Callable[..., Any], name: str) -> bool:
    """Whether a function can be called with a keyword argument of that name."""
    try:
        parameters = inspect.signature(function).parameters
    except (TypeError, ValueError):
        return False
    parameter = parameters.get(name)
    if parameter is not None:
        return parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY)
    return any(p.kind is p.VAR_KEYWORD for p in parameters.values())


def positional(function: Callable[..., Any]) -> list[inspect.Parameter]:
    """The parameters of a function that can be passed by position; none where its signature is not known."""
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):
        return []
    return [p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
