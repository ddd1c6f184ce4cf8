"""The run of a simulation: the state of an episode, its errors, and how the simulation is unwound."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from math import inf
from typing import TYPE_CHECKING, Any, ClassVar, Final

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
from .agent import Agent
from .context import GlobalRandom, environment_context
from .driver import Driver

if TYPE_CHECKING:
    from .plan import Plan
    from .point import Point

LONGEST_TAPE: Final = 200_000
"""How many answers are kept for a replay. The limit keeps a simulation that never ends from filling the memory."""


class Run:
    """The run of a simulation and the agents that decide in it: the state that an ``Episode`` moves.

    Attributes:
        in_rounds: Whether all agents are updated when a step returns.
        clock: Returns the simulation's time. None if the simulation has no time.
        agents: The live agents of the environment, by name, in the order in which they joined.
        others: The agents for which policies answer, by name.
        ended: The agents of the environment whose episodes ended before the simulation's, by name.
        just_ended: The ended agents whose end no view has reported yet.
        entities: The agent as which an entity last decided, by its point and its id.
        pending: The agent whose decision waits for an answer. None while the episode moves, and when it is over.
        latest: The agent that decided last, for the notes of errors.
        consulted: The agent whose policy is being asked. In a replay, the one at whose decision the replay ends.
        running: Whether the simulation's ``run`` has not ended yet.
        over: Whether the episode is over, and nothing moves any more.
        terminated, truncated: How the episode ended. Both are False before its end, and if an error ended it.
        failed_in_model: Whether the error that ended the episode came from the simulation.
        unreported_end: Whether there were ends during the reset, which the first step reports.
        turns: How many actions the environment's user has given.
        most_steps: The number of turns after which the episode is truncated; infinity without ``max_steps``.
        skips: Whether a decision with one legal action is answered with it.
        decide: What is done with a decision of the user's instead of updating the agent and waiting.
        tape: The answers of the user and of policies, in order. If it is full, later ones are not kept.
        script: During a replay, the answers on the other episode's tape that are still to be given. Else None.
        items: The items of a call that was split, until the rule has decided or another call is split.
        last_time: The time at the latest step of a joint view.
        actions: In rounds, the unused actions of the current round, by agent.
        given, unused: The numbers of actions in rounds, other than ``RULE``, and of those that no decision has used.
        stalled: The number of rounds without an action for the pending agent since the simulation last moved.
    """

    __slots__ = (
        "_lock", "_rng", "actions", "agents", "clock", "consulted", "decide", "driver", "ended", "entities",
        "failed_in_model", "given", "items", "just_ended", "last_time", "latest", "most_steps", "others", "over",
        "pending", "plan", "running", "script", "seed", "simulation", "skips", "stalled", "tape", "tape_size",
        "terminated", "truncated", "turns", "unreported_end", "unused",
    )  # fmt: skip

    in_rounds: ClassVar[bool] = False
    actions: dict[str, Any]
    given: int
    unused: int
    stalled: int

    def __init__(
        self, plan: Plan, simulation: Any, driver: Driver, seed: int, rng: GlobalRandom | None, lock: Any
    ) -> None:
        """Prepare the run of a simulation that has been reset. The driver's next ``resume`` begins it."""
        self.plan, self.simulation, self.driver, self.seed = plan, simulation, driver, seed
        self._rng, self._lock = rng, lock
        clock = getattr(simulation, "time", None)
        if clock is not None and (plan.plugins is not None or rng is not None):
            clock = _in_context(plan.plugins, rng, clock)  # views call it, too, outside of the context
        self.clock: Callable[[], float] | None = clock
        self.agents = {name: Agent(name, point, plan, clock) for name, point in plan.roster.items()}
        self.others: dict[str, Agent] = {}
        self.ended: dict[str, Agent] = {}
        self.just_ended: list[Agent] = []
        self.entities: dict[tuple[Point, int], Agent] = {}
        self.pending: Agent | None = None
        self.latest: Agent | None = None
        self.consulted: Agent | None = None
        self.running = True
        self.over = self.terminated = self.truncated = self.failed_in_model = self.unreported_end = False
        self.turns = 0
        self.most_steps = plan.options.max_steps or inf
        self.skips = plan.options.skip_forced
        self.decide: Callable[..., Any] | None = Agent.decide_unless_forced if self.skips else None
        replayable = plan.has_planner or not plan.unattended
        self.tape: list[Any] = []  # not a deque, which takes 600 bytes
        self.tape_size = LONGEST_TAPE + 1 if replayable else 0
        self.script: deque[Any] | None = None
        self.last_time: float | None = None
        self.items: list[Any] | None = None

    def context(self) -> environment_context:
        """The context in which the environment's code must run."""
        return environment_context(self.plan.plugins, self._rng, self._lock, self.driver)

    def refusal(self) -> Exception:
        """Make the error that says why no action can be taken now."""
        return refusal("over" if self.over else "moving")

    def annotate(self, error: BaseException) -> None:
        """Add a note to an error: at which decision of which agent it arose."""
        agent, where = self.latest, "before the first decision"
        if agent is not None:
            number, when = self.turns + 1, "at"
            if self.failed_in_model:
                number, when = self.turns, "in the model, after"
            where = f"{when} decision {number}, of {agent.name!r} at {agent.point.point.name}"
        annotate(error, f"simenv_marl: {where}; seed {self.seed}")

    def fail(self, error: BaseException) -> None:
        """End the episode because of an error, and add a note to the error that says where it arose."""
        self.pending, self.over = None, True  # first, because the next call may come to the end of the stack
        self.annotate(error)
        try:
            problems = self._unwind()
        except Warning as warning:  # warnings may be errors; this one must not replace the original error
            problems = [warning]
        for problem in problems:
            annotate(error, f"simenv_marl: unwinding the simulation raised {short_repr(problem)} as well")
        clear_frames(error)

    def close(self) -> None:
        """Unwind the simulation if it is suspended, without answering its decisions.

        Raises:
            ReentrancyError, WrongThreadError: The simulation is moving, or suspended in another thread.
        """
        if self.running and (self.driver.lost or self.driver.given_up is not None):
            self.running, self.over = False, True
        if self.pending is None and not self.over:
            raise self.refusal()
        if self.running:
            with self.context():
                for problem in self._unwind():
                    self.annotate(problem)
                    raise problem
        self.pending, self.over = None, True

    def _unwind(self) -> list[BaseException]:
        """Unwind the simulation if it is suspended; then the episode is over. Return the errors that it raised."""
        problems: list[BaseException] = []
        if self.driver.given_up is not None:  # it was inherited by a fork
            self.running = False
        self.pending, self.over = None, not self.running  # until then it moves
        if self.over:
            return problems
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
            self.over = True
        if self.driver.given_up is not None:
            warn_user(f"{type(self.simulation).__name__} {self.driver.given_up}.", ResourceWarning)
        return problems


def refusal(state: str) -> Exception:
    """Make the error that says why no action can be taken in a state of an environment."""
    return {
        "new": NotResetError("there is no episode yet; call reset() first"),
        "copied": NotResetError(
            "this is a copy of an environment, and has no episode yet; call reset() first, or use clone() to go on from"
            " where the original stands"
        ),
        "moving": ReentrancyError(
            "the environment was used from inside its own reset, simulation or mappings, or while another thread was"
            " using it"
        ),
        "over": EpisodeOverError("the episode is over; call reset() to begin the next one"),
        "closed": ClosedError("the environment is closed; call reset() to use it again"),
    }[state]


def _in_context(plugins: Any, rng: GlobalRandom | None, function: Callable[[], Any]) -> Callable[[], Any]:
    def call() -> Any:
        with environment_context(plugins, rng):
            return function()

    return call
