"""The run of a simulation on its stack: its state, its errors, and how it is unwound."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from ..errors import (
    ClosedError,
    EpisodeOverError,
    NotResetError,
    ReentrancyError,
    annotate,
    clear_frames,
    short_repr,
    warn_user,
)
from .context import ExclusiveLock, GlobalRandom, environment_context
from .driver import Driver

if TYPE_CHECKING:
    from .agent import Agent
    from .plan import Plan


class Run:
    """The run of a simulation on its stack: the part of an episode that does not depend on who decides.

    Attributes:
        plan, simulation, driver: The plan of the environment, the simulation, and the simulation's driver.
        seed: The seed of the simulation's reset.
        plugins: The plugins of the environment. None if it has none.
        clock: Returns the simulation's time. None if the simulation has no time.
        pending: The agent whose decision waits for an answer. None while the episode moves, and when it is over.
        latest: The agent that decided last, for the notes of errors.
        begun: Whether the reset of the environment is over.
        running: Whether the simulation's ``run`` has not ended yet.
        over: Whether the episode is over.
        unwinding: Whether the simulation is being unwound.
        failed_in_model: Whether the error that ended the episode came from the simulation.
        turns: How many actions the environment's user has given.
    """

    __slots__ = (
        "_lock", "_rng", "begun", "clock", "driver", "failed_in_model", "latest", "over", "pending", "plan", "plugins",
        "running", "seed", "simulation", "turns", "unwinding",
    )  # fmt: skip

    def __init__(
        self,
        plan: Plan,
        simulation: Any,
        driver: Driver,
        seed: int,
        rng: GlobalRandom | None,
        lock: ExclusiveLock | None,
    ) -> None:
        """Prepare the run, with the environment's own global generators and its lock, if it has these."""
        self.plan, self.simulation, self.driver, self.seed, self.plugins = plan, simulation, driver, seed, plan.plugins
        self._rng, self._lock = rng, lock
        clock = getattr(simulation, "time", None)
        if clock is not None and (plan.plugins is not None or rng is not None):
            clock = partial(_in_context, plan.plugins, rng, clock)  # views call it, too, outside of the context
        self.clock: Callable[[], float] | None = clock
        self.pending: Agent | None = None
        self.latest: Agent | None = None
        self.over = self.failed_in_model = self.begun = self.unwinding = False
        self.running = True
        self.turns = 0

    def refusal(self) -> Exception:
        """Make the error that says why no action can be taken now."""
        if self.unwinding:
            return refusal("moving")
        return refusal("over" if self.over else "moving" if self.begun else "resetting")

    def fail(self, error: BaseException) -> None:
        """End the episode because of an error, and add a note to the error that says where it arose."""
        self.pending, self.over = None, True
        self.annotate(error)
        try:
            problems = self._unwind()
        except Warning as warning:  # warnings may be errors; this one must not replace the original error
            problems = [warning]
        for problem in problems:
            annotate(error, f"simenv_marl: unwinding the simulation raised {short_repr(problem)} as well")
        clear_frames(error)

    def annotate(self, error: BaseException) -> None:
        """Add a note to an error: at which decision of which agent it arose."""
        agent = self.latest
        if agent is None:
            where = "before the first decision"
        else:
            number = self.turns if self.failed_in_model else self.turns + 1
            where = "in the model, after" if self.failed_in_model else "at"
            where += f" decision {number}, of {agent.name!r} at {agent.point.point.name}"
        annotate(error, f"simenv_marl: {where}; seed {self.seed}")

    def close(self) -> None:
        """Unwind the simulation if it is suspended, without answering its decisions.

        Raises:
            ReentrancyError: The simulation is moving or is being unwound.
            WrongThreadError: The simulation is suspended in another thread.
        """
        if self.running and self.driver.lost:
            self.running, self.over = False, True
        if self.unwinding or (self.pending is None and not self.over):
            raise self.refusal()
        if self.running:
            with self.context():
                self.pending, self.over = None, True
                for problem in self._unwind():
                    self.annotate(problem)
                    raise problem
        self.pending, self.over = None, True

    def abandon(self) -> None:
        """Unwind the simulation of an environment that was garbage-collected. Any thread may call this."""
        if self.pending is None and not self.over:
            return  # the process is exiting, and the other thread in which the simulation moves ends with it
        self.pending, self.over = None, True
        if not self.running or not self.driver.reachable:
            return  # the simulation's own thread unwinds it at its next switch
        with self.context():
            for problem in self._unwind():
                warn_user(f"a simulation that was abandoned raised {short_repr(problem)}", ResourceWarning)

    def _unwind(self) -> list[BaseException]:
        """Unwind the simulation if it is suspended. Return the errors that it raised."""
        if not self.running:
            return []
        self.unwinding = True
        problems: list[BaseException] = []
        try:
            try:
                stop = getattr(self.simulation, "stop", None)
                if stop is not None:
                    stop()
            except BaseException as error:
                problems.append(error)
            problems += self.driver.unwind()
            self.running = False
        finally:
            self.unwinding = False
        if self.driver.given_up is not None:
            warn_user(f"{type(self.simulation).__name__} {self.driver.given_up}.", ResourceWarning)
        return problems

    @property
    def unwound(self) -> bool:
        """Whether the episode is over and the simulation is unwound."""
        return self.over and not self.running

    def context(self) -> environment_context:
        """The context in which the environment's code must run."""
        return environment_context(self.plugins, self._rng, self._lock, self.driver)


def refusal(state: str) -> Exception:
    """Make the error that says why no action can be taken in a state of an environment."""
    used = "the environment was used from inside its own"
    return {
        "new": NotResetError("there is no episode yet; call reset() first"),
        "copied": NotResetError(
            "this is a copy of an environment, and has no episode yet; call reset() first, or use branch() to continue"
            " the episode of the original"
        ),
        "resetting": ReentrancyError(
            f"{used} reset or its simulation's close, or while another thread was resetting or closing it"
        ),
        "moving": ReentrancyError(f"{used} simulation or mappings, or while another thread was using it"),
        "over": EpisodeOverError("the episode is over; call reset() to begin the next one"),
        "closed": ClosedError("the environment is closed; call reset() to use it again"),
    }[state]


def _in_context(plugins: Any, rng: Any, function: Callable[[], Any]) -> Any:
    """Call a function in an environment's context."""
    with environment_context(plugins, rng):
        return function()
