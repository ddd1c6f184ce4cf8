"""Simulations of models that are made with a seed and then stepped, as Mesa's are."""

from collections.abc import Callable
from typing import Any

from .errors import OptionValueError, SimulationError, shown
from .simulation import TRUNCATED, SimulationInterface, takes


class SteppedSimulation(SimulationInterface):
    """A simulation of a model that is seeded where it is made, and has a method ``step``.

    ::

        prison = SteppedSimulation(PdGrid, 200, width=30)
        env = aec_env(prison, {"mesa.examples.advanced.pd_grid.agents.PDAgent.step": make_step(...)})

    Each ``reset`` makes a new model, with its seed as the argument ``seed``, or ``rng`` where it takes no ``seed``. For
    a model that takes a scenario, give a function::

        SteppedSimulation(lambda seed, **given: WolfSheep(WolfSheepScenario(rng=seed, **given)), 200, width=30)

    The loop ends when the attribute ``running`` of the model is false, or is truncated.

    Attributes:
        model: The model of the episode; None before the first.
        parameters: With what it is made.
    """

    points: Any = ()
    """The decision points of the model are named where environments are made."""

    def __init__(self, model: Callable[..., Any], steps: int | None = None, /, **parameters: Any) -> None:
        """Say what is stepped.

        Args:
            model: The model's class, or a function that makes one.
            steps: After how many steps an episode is truncated. None: only the model ends it.
            **parameters: With what the model is made besides.

        Raises:
            SimulationError: ``model`` cannot be called, or takes a scenario that would hold its seed.
            OptionValueError: ``steps`` is no positive integer.
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
        """Step the model.

        Returns:
            ``TRUNCATED`` after the last step that was allowed.
        """
        model = self.model
        while getattr(model, "running", True):
            if self._done == self._steps:
                return TRUNCATED
            model.step()
            self._done += 1
        return None

    def time(self) -> float:
        """How many steps were made."""
        return float(self._done)
