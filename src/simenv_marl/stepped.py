"""Simulations of models that are made with a seed and then stepped, such as Mesa's models."""

from collections.abc import Callable
from typing import Any

from .errors import OptionValueError, SimulationError, shown
from .simulation import TRUNCATED, SimulationInterface, takes


class SteppedSimulation(SimulationInterface):
    """A simulation of a model that gets its seed when it is made and has a method ``step``.

    ::

        prison = SteppedSimulation(PdGrid, 200, width=30)
        env = aec_env(prison, {"mesa.examples.advanced.pd_grid.agents.PDAgent.step": make_step(...)})

    Each ``reset`` makes a new model. The seed is passed as the argument ``seed``, or as ``rng`` if the model does not
    take ``seed``. For a model that takes a scenario, give a function::

        def meadow(seed, **given):
            return WolfSheep(WolfSheepScenario(rng=seed, **given))

        SteppedSimulation(meadow, 200, width=30)

    The loop ends when the model's attribute ``running`` is false, or when it is truncated.

    Attributes:
        model: The model of the episode; None before the first episode.
        parameters: The keyword arguments of the model.
    """

    points: Any = ()
    """The decision points of the model are named where environments are made."""

    def __init__(self, model: Callable[..., Any], steps: int | None = None, /, **parameters: Any) -> None:
        """Define the model and its arguments.

        Args:
            model: The model's class, or a function that returns a model.
            steps: The number of steps after which an episode is truncated. None: only the model ends it.
            **parameters: Further keyword arguments for the model.

        Raises:
            SimulationError: ``model`` cannot be called, or takes a scenario that would hold its seed.
            OptionValueError: ``steps`` is not a positive integer.
        """
        if not callable(model):
            raise SimulationError(f"a stepped simulation needs the class of a model, not {shown(model)}")
        if steps is not None and (isinstance(steps, bool) or not isinstance(steps, int) or steps < 1):
            raise OptionValueError(f"steps must be a positive integer or None, not {shown(steps)}")
        self._make, self._steps, self.parameters = model, steps, parameters
        self._seed = next((name for name in ("seed", "rng") if takes(model, name) and name not in parameters), None)
        if self._seed is None and takes(model, "scenario") and "scenario" not in parameters:
            raise SimulationError(
                f"{shown(model)} takes a scenario, and that holds the seed; give a function that makes both:"
                " lambda seed, **parameters: Model(Scenario(rng=seed, **parameters))"
            )
        self._done = 0
        self.model: Any = None

    def reset(self, seed: int | None = None) -> None:
        """Make the model of an episode."""
        seeded = {} if self._seed is None else {self._seed: seed}
        self._done, self.model = 0, self._make(**self.parameters, **seeded)
        if not callable(getattr(self.model, "step", None)):
            raise SimulationError(f"{shown(self.model)} has no method step(), by which a stepped simulation goes on")

    def run(self) -> Any:
        """Step the model until it ends.

        Returns:
            ``TRUNCATED`` if the number of steps reached its limit.
        """
        model = self.model
        while getattr(model, "running", True):
            if self._done == self._steps:
                return TRUNCATED
            model.step()
            self._done += 1
        return None

    def time(self) -> float:
        """Return the number of steps so far."""
        return float(self._done)
