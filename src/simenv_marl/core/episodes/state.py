"""The state of an episode, as views and clones read it.

An episode::

    MOVING <--------> PENDING --------> OVER
    the simulation    a decision waits  terminated, truncated,
    runs, or          for the user      failed or closed
    mappings and
    policies do
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from copy import copy
from enum import Enum
from threading import current_thread
from typing import TYPE_CHECKING, Any, Final

from ...errors import (
    ClosedError,
    EpisodeOverError,
    InvalidActionError,
    NoDecisionError,
    NotResetError,
    ReentrancyError,
    SimEnvError,
    UnknownAgentError,
    listed,
    short_repr,
    warn_user,
)
from ...hooks.hook import Hook
from ...simulation import RULE, Action
from ..plans.plan import Plan
from ..plans.policies import Where
from ..values.actions import ILLEGAL
from .steps import Round

if TYPE_CHECKING:
    from ..values.clock import Clock
    from .agent import Agent
    from .decision import Decision


class Outcome(Enum):
    """How an episode has ended."""

    RUNNING = "running"
    """It has not ended."""

    TERMINATED = "terminated"
    """The simulation's ``run`` has returned."""

    TRUNCATED = "truncated"
    """The simulation, or ``max_steps``, has reached a limit of time."""

    STOPPED = "stopped"
    """An error has ended it, or it was closed."""


RUNNING: Final = Outcome.RUNNING
TERMINATED: Final = Outcome.TERMINATED
TRUNCATED: Final = Outcome.TRUNCATED
"""The outcomes as names of this module, because Python finds members of an enum slowly."""


class State(Enum):
    """The states of an episode, and of a session without an episode."""

    NEW = "new"
    """There was no episode yet."""

    COPIED = "copied"
    """This is a copy of an environment that had an episode."""

    MOVING = "moving"
    """The simulation, a mapping or a policy runs."""

    PENDING = "pending"
    """A decision waits for the user."""

    OVER = "over"
    """Nothing happens any more."""

    CLOSED = "closed"
    """The environment is closed."""

    def refusal(self) -> SimEnvError:
        """Make the error that says why no action can be taken in this state."""
        if self is State.NEW:
            return NotResetError("there is no episode yet; call reset() first")
        if self is State.COPIED:
            return NotResetError(
                "this is a copy of an environment, and has no episode yet; call reset() first, or"
                " use clone() to go on from where the original stands"
            )
        if self is State.OVER:
            return EpisodeOverError("the episode is over; call reset() to begin the next one")
        if self is State.CLOSED:
            return ClosedError("the environment is closed; call reset() to use it again")
        return ReentrancyError(
            "the environment was used from inside its own reset, simulation or mappings, or while"
            " another thread was using it"
        )


class UnmatchedNames:
    """The agents and functions that are named, and that no episode has had or called yet."""

    def __init__(self, names: frozenset[str]) -> None:
        self._names = names
        self._points: set[Hook] = set()  # whose removers were checked

    def check(self, episode: EpisodeState, called: Collection[Hook] | None) -> None:
        """Warn once of names that options and ``removed_by=`` have in vain, at an episode's end.

        Where an agent has joined or ended midway, a roster is an upper bound.

        ``called``: the functions that end agents and were called. None if the model has not ended.
        """
        if called is not None:
            self._check_removers(episode, called)
        if not self._names or episode.ended or episode.has_joined:
            return
        present = [
            name
            for name, agent in episode.agents.items()
            if agent.decided or agent.observation is not None
        ]
        present += [*episode.others, *episode.ended]
        absent = self._names.difference(present)
        if absent:
            self._names -= absent
            warn_user(
                "policies= or possible_agents= name agents that did not appear in the episode:"
                f" {listed(sorted(absent))}; these did: {listed(present)}"
            )

    def _check_removers(self, episode: EpisodeState, called: Collection[Hook]) -> None:
        for point in episode.plan.points:
            hooks = {each.hook for each in episode.plan.removers if each.point is point}
            if not hooks or point.hook in self._points:
                continue
            agents = [*episode.agents.values(), *episode.others.values(), *episode.ended.values()]
            counts = [agent.answered for agent in agents if agent.point.hook is point.hook]
            if not counts or max(counts) < min(counts) + 2:
                continue  # because agents that decide equally often were not removed
            self._points.add(point.hook)
            if hooks.isdisjoint(called):
                names = sorted(hook.name for hook in hooks)
                warn_user(
                    f"removed_by= of {point.hook.name} names {listed(names)}, which the model did"
                    f" not call in an episode in which agents decided {min(counts)} to"
                    f" {max(counts)} times. If agents were removed, name the function that the"
                    " model calls"
                )


class EpisodeState:
    """The state of an episode, as views read it. A clone has the rest in its process.

    Attributes:
        plan: The plan.
        seed: The seed.
        clock: The clock. None if the simulation has no time.
        agents: The live agents of the environment, by name, in the order of joining.
        others: The agents whose policy or rule answers, by name.
        ended: The agents of the environment whose episodes ended before the simulation's, by name.
        just_ended: The ended agents that no view has reported yet.
        pending: The agent whose decision waits for an answer. None in all states but PENDING.
        consulted: The agent whose policy is being asked. In a replay, the one at whose decision
            the replay ends.
        outcome: How it has ended.
        has_joined: Whether an agent has decided for the first time when others had decided twice.
        unreported_end: Whether agents ended during the reset, which the first step reports.
        turns: The number of actions that the environment's user has given.
        round: The present round. None if the episode is played in turns.
        earned: The team's reward of the latest step. None if each agent has its own rewards.
        skips: Whether a decision with one legal action is answered with it.
        where: Where it is played, which determines the policies that are asked.
        memory: The values of planners, and of policies for all agents.
    """

    __slots__ = (
        "_deciders", "_fault", "agents", "clock", "consulted", "earned", "ended", "has_joined",
        "just_ended", "memory", "others", "outcome", "pending", "plan", "round", "seed", "skips",
        "turns", "unreported_end", "where",
    )  # fmt: skip

    def __init__(
        self, plan: Plan, seed: int, clock: Clock | None, where: Where, *, in_rounds: bool
    ) -> None:
        self.plan = plan
        self.seed = seed
        self.clock = clock
        self.round = Round() if in_rounds else None
        self.earned: float | None = None
        self.skips = plan.options.skip_forced
        self.where = where
        self.agents: dict[str, Agent] = {}
        self.others: dict[str, Agent] = {}
        self.ended: dict[str, Agent] = {}
        self.just_ended: list[Agent] = []
        self.pending: Agent | None = None
        self.consulted: Agent | None = None
        self.outcome = RUNNING
        self.has_joined = False
        self._deciders = 0
        self.unreported_end = False
        self.turns = 0
        self.memory: dict[object, Any] = {}
        self._fault = ""

    def remember(self, other: EpisodeState) -> None:
        """Take over the values of policies in an episode that this one continues."""
        self.memory = {policy: copy(value) for policy, value in other.memory.items()}

    @property
    def state(self) -> State:
        """The state."""
        if self.pending is not None:
            return State.PENDING
        return State.OVER if self.over else State.MOVING

    @property
    def over(self) -> bool:
        """Whether nothing happens any more."""
        return self.outcome is not RUNNING

    @property
    def terminated(self) -> bool:
        """Whether the simulation's ``run`` has returned."""
        return self.outcome is TERMINATED

    @property
    def truncated(self) -> bool:
        """Whether the episode has reached a limit of time."""
        return self.outcome is TRUNCATED

    @property
    def fault(self) -> str:
        """Why its results are wrong. Empty as far as is known."""
        faults = [agent.fault for agent in (*self.ended.values(), *self.agents.values())]
        return self._fault or max(faults, default="")

    @property
    def in_rounds(self) -> bool:
        """Whether all agents are updated when a step returns."""
        return self.round is not None

    @property
    def is_branch(self) -> bool:
        """Whether it is a branch that a policy has made of its environment."""
        return self.where >= Where.BRANCH

    @property
    def deciding(self) -> Agent | None:
        """The agent whose decision waits for the user, or for its policy."""
        return self.pending or self.consulted

    def agent(self, name: str) -> Agent | None:
        """Return an agent of the environment, live or ended. None if there is no such agent."""
        return self.agents.get(name) or self.ended.get(name)

    def may_have(self, name: object) -> bool:
        """Return whether there is an agent with that name, or could be one later."""
        plan = self.plan
        declared = plan.options.declared_agents
        groups = (self.agents, self.others, plan.roster, plan.policies, declared)
        if any(name in names for names in groups):
            return True
        is_open = plan.options.possible_agents is None and any(
            point.agent is None for point in plan.points
        )
        return is_open and isinstance(name, str)

    def find(self, name: str) -> Agent | None:
        """Return an agent that the user or a policy answers. None if it has not appeared."""
        return self.agent(name) or self.others.get(name)

    def note_first_decision(self) -> None:
        """Note that an agent decides for the first time."""
        self.has_joined = self.has_joined or self.turns > (1 if self.in_rounds else self._deciders)
        self._deciders += 1

    def move_to(self, where: Where) -> None:
        """Note that it is played in a clone or a branch from now on."""
        self.where = max(self.where, where)

    def decision_of(self, agent: Agent) -> Decision:
        """Describe the decision of an agent."""
        return agent.describe(self.seed, self.where)

    def stop(self) -> None:
        """Note that nothing happens any more."""
        self.pending = None
        if self.outcome is RUNNING:
            self.outcome = Outcome.STOPPED

    def step(self, action: Action) -> None:
        """Answer the pending decision: see ``Episode.step``."""
        raise NotImplementedError

    def single_out(self, agent: Agent) -> None:
        """In a branch, wait for one agent alone: see ``Episode.single_out``."""
        raise NotImplementedError

    # -- reports to views -------------------------------------------------------------------------

    @property
    def answered(self) -> int:
        """The number of decisions that the user has answered; without one, that of all agents."""
        if self.plan.has_user:
            return self.turns
        agents = (*self.agents.values(), *self.others.values(), *self.ended.values())
        return sum(agent.answered for agent in agents)

    def take_ended(self) -> list[Agent]:
        """Return the ended agents that no view has reported yet, and forget them."""
        ended, self.just_ended = self.just_ended, []
        return ended

    def mark_reported(self) -> None:
        """Note that the view has reported the ends during the reset."""
        self.unreported_end = False

    def refusal(self) -> SimEnvError:
        """Make the error that says why no action can be taken now."""
        return self.state.refusal()

    def report_end(self) -> None:
        """Handle a step without a pending decision: report an end during the reset, or refuse."""
        if not (self.over and self.unreported_end):
            raise self.refusal()
        self.unreported_end = False


def missing_decision(episode: EpisodeState, simulation: str) -> NoDecisionError:
    """Make the error for an episode without a decision for the environment's user.

    ``simulation``: the name of its class.
    """
    plan = episode.plan
    hooks = [point.hook for point in plan.active]
    expected = ", ".join(hook.name for hook in hooks)
    overriding = listed([hook.name for point in plan.active for hook in plan.overrides[point]])
    threads = {name for hook in hooks for name in hook.threads} - {current_thread().name}
    hints: list[str] = []
    if overriding:
        hints.append(
            f"these override it and are called instead: {overriding}; name them as decision points"
        )
    if threads:
        hints.append(
            "the rule has decided in threads that are not the simulation's:"
            f" {listed(sorted(threads))}; call it where run() runs, and pass the decision on"
        )
    if episode.others:
        if plan.one_agent:
            expected = f"{plan.one_agent!r} at {expected}"
        hints = [f"these have decided: {listed(episode.others)}"]
    hint = "; ".join(hints) or (
        "does the simulation call its decision functions as attributes of class or module?"
    )
    return NoDecisionError(f"{simulation}.run() ended without a decision of {expected}; {hint}")


def checked_actions(episode: EpisodeState, actions: Mapping[str, Action]) -> dict[str, Action]:
    """Check the actions of a round; return them in the form that mappings take.

    Raises:
        InvalidActionError: An action is not legal, or the actions are no dict.
        UnknownAgentError: An action is for an agent that is not live.
    """
    if type(actions) is not dict and not isinstance(actions, Mapping):
        raise InvalidActionError(
            f"a round takes a dict of actions by agent, not {short_repr(actions)}"
        )
    pending = episode.pending
    agents = episode.agents
    checked: dict[str, Action] = {}
    for name, action in actions.items():
        agent = agents.get(name)
        if agent is None:
            if episode.unreported_end and name in episode.ended:
                continue
            raise UnknownAgentError(
                f"there is an action for {short_repr(name)}, which is not a live agent; live"
                f" agents: {listed(agents)}"
            )
        if action is not RULE:
            check = agent.point.check
            legal = check(action)
            mask = agent.mask if agent is pending else None
            if legal is ILLEGAL or mask is not None:
                legal = agent.point.validate(action, name, mask)
            action = legal
        checked[name] = action
    return checked
