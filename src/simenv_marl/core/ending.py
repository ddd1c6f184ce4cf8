"""The end of an episode: by the end of the simulation, by a truncation, by an error, or by closing it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final

from greenlet import getcurrent

from ..errors import (
    ClosedError,
    EpisodeOverError,
    InvalidActionError,
    NotResetError,
    ReentrancyError,
    UnknownAgentError,
    annotate,
    clear_frames,
    short_repr,
    warn_user,
)
from ..hooks.stacks import EVALUATING
from ..simulation import RULE
from .actions import ILLEGAL
from .agent import Agent
from .contexts import Claim, at_work
from .participants import Participants, listed
from .plan import Plan
from .rng import GlobalRandom
from .switch import BaseDriver

MANY_ROUNDS: Final = 100
"""The number of rounds in a row without an action for the pending agent after which the user is warned."""

REFUSALS: Final[Mapping[str, tuple[type[Exception], str]]] = {
    "new": (NotResetError, "there is no episode yet; call reset() first"),
    "copied": (
        NotResetError,
        "this is a copy of an environment, and has no episode yet; call reset() first, or use branch() to continue the"
        " episode of the original",
    ),
    "resetting": (
        ReentrancyError,
        "the environment was used from inside its own reset or its simulation's close, or while another thread was"
        " resetting or closing it",
    ),
    "moving": (
        ReentrancyError,
        "the environment was used from inside its own simulation or mappings, or while another thread was using it",
    ),
    "over": (EpisodeOverError, "the episode is over; call reset() to begin the next one"),
    "closed": (ClosedError, "the environment is closed; call reset() to use it again"),
}
"""For each state of an environment in which no action can be taken: the class and the message of the error."""


def refusal(state: str) -> Exception:
    """Make the error that says why no action can be taken in a state."""
    kind, text = REFUSALS[state]
    return kind(text)


class Ending(Participants):
    """The part of an episode that handles its state and its end.

    Attributes:
        pending: The agent whose decision waits for an answer. None while the episode moves, and when it is over.
        begun: Whether the reset of the environment is over.
        over: Whether the episode is over.
        running: Whether the simulation's ``run`` has not ended yet.
        unwinding: Whether the simulation is being unwound.
        failed_in_model: Whether the error that ended the episode came from the simulation.
        terminated, truncated: How the episode ended. Both are False before its end, and if an error ended it.
        unheard: Whether the episode ended before the user was asked, because all decisions were forced. The first
            step reports this end.
        untold: Agents whose episode ended at a forced move during the reset. The first round reports their rewards
            and ends.
        turns: How many actions the environment's user has given.
        seed: The seed of the simulation's reset.
        driver: The driver of the simulation.
        plugins: The plugins of the environment. None if it has none.
    """

    __slots__ = (
        "_around", "begun", "driver", "failed_in_model", "over", "pending", "plugins", "running", "seed", "terminated",
        "truncated", "turns", "unheard", "untold", "unwinding",
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
            clock = partial(_within, plan.plugins, around, clock)  # views call it, too, outside of ``at_work``
        super().__init__(plan, simulation, clock)
        self.driver, self.seed, self.plugins, self._around = driver, seed, plan.plugins, around
        self.pending: Agent | None = None
        self.over = self.terminated = self.truncated = self.failed_in_model = self.begun = self.unwinding = (
            self.unheard
        ) = False
        self.running = True
        self.turns = 0
        self.untold: list[Agent] = []

    def at_work(self) -> at_work:
        """The context in which the environment's code must run."""
        return at_work(self.plugins, *self._around, self.driver)

    def _hear(self) -> None:
        """Handle a step without a pending decision: report an end that the user has not heard of, or refuse."""
        if not self.unheard:
            raise self.refusal()
        self.unheard = False

    def _enter(self, move: Callable[[Any, Any, bool], None], given: Any) -> None:
        """Make a move in the environment's context."""
        here = getcurrent()
        if here is not self.driver.caller or EVALUATING:
            with self.at_work():
                move(self, given, True)
            return
        assert self.plugins is not None
        EVALUATING[here] = self.plugins  # the only part of ``at_work`` that is needed here
        try:
            move(self, given, True)
        finally:
            del EVALUATING[here]

    def finish(self, *, truncated: bool) -> None:
        """End the episode of all live agents."""
        self.pending = None
        for agent in self.agents.values():
            self.conclude(agent)
        self.over, self.truncated, self.terminated = True, truncated, not truncated
        if self._plan.wanted:
            self._look_for_absent()

    def _look_for_absent(self) -> None:
        """Warn of agents that the environment's options name and that have not appeared, once for each agent."""
        wanted = self._plan.wanted
        present = [name for name, agent in self.agents.items() if agent.decided or agent.observation is not None]
        present += [*self.answered, *self.ended]
        absent = wanted.difference(present)
        if absent:
            wanted -= absent
            warn_user(
                f"policies= or possible_agents= name agents that did not appear in the episode:"
                f" {listed(sorted(absent))}; these did: {listed(present)}"
            )

    def refusal(self) -> Exception:
        """Make the error that says why no action can be taken now."""
        if self.unwinding:
            return refusal("moving")
        return refusal("over" if self.over else "moving" if self.begun else "resetting")

    def without_decision(self) -> str:
        """Make the message for an episode that ended without a decision for the environment's user."""
        points = ", ".join(point.point.name for point in self._plan.active)
        ended = f"{type(self._simulation).__name__}.run() ended without a decision of"
        if self.answered:
            wanted = f"{self._plan.one_agent!r} at {points}" if self._plan.one_agent else points
            return f"{ended} {wanted}; these have decided: {listed(self.answered)}"
        return (
            f"{ended} {points}; does the simulation call the decision functions as attributes of their class or module?"
        )

    def warn_of_standstill(self) -> None:
        """Warn that many rounds had no action for the agent whose decision is pending."""
        assert self.pending is not None
        warn_user(
            f"the simulation stands still: {short_repr(self.pending.name)} must decide, but"
            f" {MANY_ROUNDS} rounds in a row"
            ' had no action for it; the info of the agent that must decide has "deciding": True'
        )

    def check(self, actions: Mapping[str, Any]) -> dict[str, Any]:
        """Check the actions of a round, as far as this is possible before the simulation moves.

        Returns:
            The actions in the form that mappings take.

        Raises:
            UnknownAgentError, InvalidActionError, EpisodeOverError, ReentrancyError: See ``play``.
        """
        pending, agents, checked = self.pending, self.agents, {}
        if pending is None:
            raise self.refusal()
        if type(actions) is not dict and not isinstance(actions, Mapping):
            raise InvalidActionError(f"a round takes a dict of actions by agent, not {short_repr(actions)}")
        for name, action in actions.items():
            agent = agents.get(name)
            if agent is None and name in self.ended and self.ended[name] in self.untold:
                continue
            if agent is None:
                raise UnknownAgentError(
                    f"there is an action for {short_repr(name)}, which is not a live agent; live agents: {self.names()}"
                )
            if action is not RULE:
                check = agent.point.check
                legal = check(action)
                mask = agent.mask if agent is pending else None
                if legal is ILLEGAL or mask is not None:
                    legal = agent.point.checked(action, name, mask)
                action = legal
            checked[name] = action
        return checked

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
            BaseException: Any error that the simulation raises in its ``stop`` or while it unwinds.
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
        """Unwind the simulation of an environment that was garbage-collected. Any thread may call this."""
        if self.pending is None and not self.over:
            return  # the process is exiting, and the other thread in which the simulation moves ends with it
        self.pending, self.over = None, True
        if not self.running or not self.driver.reachable():
            return  # the simulation's own thread unwinds it at its next switch
        with self.at_work():
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
        """Whether the episode is over and the simulation is unwound."""
        return self.over and not self.running


def _within(plugins: Any, around: Any, function: Callable[[], Any]) -> Any:
    """Call a function in the environment's context."""
    with at_work(plugins, *around):
        return function()
