"""How an episode ends: by the end of the simulation, by a truncation, by an error, or because it is closed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final

from ..errors import (
    ClosedError,
    EpisodeOverError,
    NotResetError,
    ReentrancyError,
    annotate,
    clear_frames,
    warn_user,
)
from .agent import Agent
from .contexts import Claim, at_work
from .participants import Participants
from .plan import Plan
from .rng import GlobalRandom
from .switch import BaseDriver

REFUSALS: Final[Mapping[str, tuple[type[Exception], str]]] = {
    "new": (NotResetError, "there is no episode yet; call reset() first"),
    "resetting": (
        ReentrancyError,
        "the environment was used from inside its own reset, or while another thread was resetting it",
    ),
    "moving": (
        ReentrancyError,
        "the environment was used from inside its own simulation or mappings, or while another thread was using it",
    ),
    "over": (EpisodeOverError, "the episode is over; call reset() to begin the next one"),
    "closed": (ClosedError, "the environment is closed; call reset() to use it again"),
}
"""By the state of an environment: why no action can be taken."""


def refusal(state: str) -> Exception:
    """The error that says why no action can be taken in a state."""
    kind, text = REFUSALS[state]
    return kind(text)


class Ending(Participants):
    """An episode, as far as its state and its end are concerned.

    Attributes:
        pending: The agent whose decision waits for an answer; None while the episode moves, and when it is over.
        begun: Whether the reset of the environment is over.
        over: Whether the episode is over.
        running: Whether the simulation's ``run`` has not ended yet.
        unwinding: Whether it is being ended.
        failed_in_model: Whether the error that has ended the episode came from the simulation.
        terminated, truncated: How it ended; both False until then, and where an error has ended it.
        turns: How many actions the environment's user has given.
        seed: What the simulation was reset with.
        driver: Its stack.
        plugins: The plugins of the environment; None if it has none.
    """

    __slots__ = (
        "_around", "begun", "driver", "failed_in_model", "over", "pending", "plugins", "running", "seed", "terminated",
        "truncated", "turns", "unwinding",
    )  # fmt: skip

    def __init__(
        self,
        plan: Plan,
        simulation: Any,
        driver: BaseDriver,
        seed: int,
        around: tuple[GlobalRandom | None, Claim | None],
    ) -> None:
        """Prepare an episode: see ``Episode``."""
        clock = getattr(simulation, "time", None)
        if clock is not None and (plan.plugins is not None or plan.options.global_rng):
            clock = partial(_within, plan.plugins, around, clock)  # views read it, too
        super().__init__(plan, simulation, clock)
        self.driver, self.seed, self.plugins, self._around = driver, seed, plan.plugins, around
        self.pending: Agent | None = None
        self.over = self.terminated = self.truncated = self.failed_in_model = self.begun = self.unwinding = False
        self.running = True
        self.turns = 0

    def at_work(self) -> at_work:
        """What is to be around all that runs for the environment."""
        return at_work(self.plugins, *self._around, self.driver)

    def finish(self, *, truncated: bool) -> None:
        """End the episode of all agents that are left."""
        self.pending = None
        for agent in self.agents.values():
            self.conclude(agent)
        self.over, self.truncated, self.terminated = True, truncated, not truncated

    def refusal(self) -> Exception:
        """The error that says why no action can be taken now."""
        if self.unwinding:
            return refusal("moving")
        return refusal("over" if self.over else "moving" if self.begun else "resetting")

    def fail(self, error: BaseException) -> None:
        """End the episode for an error, which gets a note that says where it came from."""
        self.pending, self.over = None, True
        self.annotate(error)
        try:
            problems = self._unwind()
        except Warning as warning:  # where these are errors; another one must not take its place
            problems = [warning]
        for problem in problems:
            annotate(error, f"simenv_marl: and the simulation, when it was unwound, raised {problem!r}")
        clear_frames(error)

    def annotate(self, error: BaseException) -> None:
        """Add a note to an error that says at which decision of which agent it arose."""
        agent = self.latest
        if agent is None:
            where = "before the first decision"
        else:
            number = self.turns if self.failed_in_model else self.turns + 1
            where = "in the model, after" if self.failed_in_model else "at"
            where += f" decision {number}, of {agent.name!r} at {agent.point.point.name}"
        annotate(error, f"simenv_marl: {where}; seed {self.seed}")

    def close(self) -> None:
        """Unwind the simulation, if it is suspended; answer none of its decisions.

        Raises:
            ReentrancyError: The simulation is moving, or is being unwound.
            WrongThreadError: It is suspended in another thread.
            BaseException: What the simulation raises in its ``stop`` or while it unwinds.
        """
        if self.running and self.driver.lost():
            self.running, self.over = False, True
        if self.unwinding or (self.pending is None and not self.over):
            raise self.refusal()
        if self.running:
            with self.at_work():
                self.pending, self.over = None, True
                for problem in self._unwind():
                    self.annotate(problem)
                    raise problem
        self.pending, self.over = None, True

    def abandon(self) -> None:
        """Unwind the simulation when its environment is gone, from wherever that is noticed."""
        if self.pending is None and not self.over:
            return  # the process ends while it is moving in another thread, which ends with it
        self.pending, self.over = None, True
        if not self.running or not self.driver.reachable():
            return  # else its own thread unwinds it, as soon as that switches again
        with self.at_work():
            for problem in self._unwind():
                warn_user(f"a simulation that was abandoned raised {problem!r}", ResourceWarning)

    def _unwind(self) -> list[BaseException]:
        """Unwind the simulation, if it is suspended. Returns what it has raised."""
        if not self.running:
            return []
        self.unwinding = True
        problems: list[BaseException] = []
        try:
            try:
                stop = getattr(self._simulation, "stop", None)
                if stop is not None:
                    stop()
            except BaseException as error:
                problems.append(error)
            problems += self.driver.unwind()
            self.running = False
        finally:
            self.unwinding = False
        if self.driver.given_up is not None:
            warn_user(f"{type(self._simulation).__name__} {self.driver.given_up}.", ResourceWarning)
        return problems

    @property
    def unwound(self) -> bool:
        """Whether the episode is over, and nothing is left of it in the simulation."""
        return self.over and not self.running


def _within(plugins: Any, around: Any, function: Callable[[], Any]) -> Any:
    """Call a function at work."""
    with at_work(plugins, *around):
        return function()
