"""One episode of one simulation. This module and ``rounds`` determine what happens when.

An episode::

    RESETTING ----> MOVING <----> PENDING ----> OVER  (terminated, truncated, failed or closed)
                    the simulation runs,        nothing happens any more
                    or mappings and policies do

A decision::

    simulation                     episode, on its user's stack
    ----------                     ----------------------------
    calls a decision function
      suspended          ------>   ``handle``: find the agent; if the rule decides, back to the simulation
                                   ``update``: reward of the previous action (the first of an episode is dropped),
                                     legal actions, info, observation
                                   if a policy answers (``Agent.ask_policy``), back to the simulation with its action
                                   else PENDING, until the user answers
                                   ``answer``: map the checked action to the reply
      returns            <------   ``advance``
    returns from ``run``
      ended              ------>   ``finish``: last reward and last observation of each agent; OVER

In AEC and single views an episode is played in turns: each agent is updated when its decision arises. In parallel and
joint views it is played in rounds: all live agents are updated when a step returns (``rounds``). Where policies answer
all agents (``simulate``, ``simulate_many``), agents are observed when a policy is asked, and not rewarded. While an
episode is RESETTING or MOVING on the user's side, decision functions run their rule.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping
from math import inf
from typing import TYPE_CHECKING, Any, Final

from greenlet import getcurrent

from ..errors import AgentError, NoDecisionError, short_repr, warn_user
from ..hooks.hook import Hook
from ..hooks.stacks import EVALUATING
from ..simulation import RULE
from .actions import ILLEGAL
from .agent import Agent
from .context import ExclusiveLock, GlobalRandom
from .driver import WAIT, Driver
from .planner import two_arguments
from .points import declared_agents
from .rounds import Rounds
from .run import Run
from .spaces import duplicate

if TYPE_CHECKING:
    from .plan import Plan
    from .point import Point

LONGEST_TAPE: Final = 200_000
"""How many answers are kept for a replay. The limit keeps a simulation that never ends from filling the memory."""

LOST: Final[deque[Any]] = deque(maxlen=0)
"""The tape of an episode that has more answers or is never replayed. It keeps nothing."""


class Episode(Run):
    """One run of a simulation, from its reset to its end. It has no reference to the environment.

    Attributes:
        agents: The live agents of the environment, by name, in the order in which they joined.
        others: The agents for which policies answer, by name.
        ended: The agents of the environment whose episodes ended before the simulation's, by name.
        just_ended: The ended agents whose end no view has reported yet.
        entities: The agent as which an entity last decided, by its point and its id.
        consulted: The agent whose policy is being asked. In a replay, the one at whose decision the replay ends.
        decide: What is done with a decision of the user's instead of updating the agent and waiting.
        rounds: The state of the present round. None if the episode is played in turns.
        terminated, truncated: How the episode ended. Both are False before its end, and if an error ended it.
        unreported_end: Whether the episode ended before the user was asked, because all decisions were forced. The
            first step reports this end.
        is_complete: Whether the only agent of the environment has ended, so that nothing is left to ask the user.
        most_steps: The number of turns after which the episode is truncated; infinity without ``max_steps``.
        limit: The next number of turns at which ``_reach_limit`` is called.
        tape: The answers of the user and of policies, in order. ``LOST`` if they are not kept.
        script: During a replay, the answers on the other episode's tape that are still to be given. Else None.
        skips: Whether a decision with one legal action is answered with it.
        last_time: The time at the latest step of a joint view.
    """

    __slots__ = (
        "agents", "consulted", "decide", "ended", "entities", "is_complete", "just_ended", "last_time", "limit",
        "most_steps", "others", "rounds", "script", "skips", "tape", "terminated", "truncated", "unreported_end",
    )  # fmt: skip

    def __init__(
        self,
        plan: Plan,
        simulation: Any,
        driver: Driver,
        seed: int,
        *,
        in_rounds: bool = False,
        rng: GlobalRandom | None = None,
        lock: ExclusiveLock | None = None,
        script: Iterable[Any] | None = None,
    ) -> None:
        """Prepare an episode of a simulation that has been reset. The driver's next ``resume`` begins ``run``.

        An episode ``in_rounds`` updates all agents when a step returns. ``script`` is the tape of another episode to
        replay; ordinary episodes have none. For the other arguments, see ``Run``.
        """
        super().__init__(plan, simulation, driver, seed, rng, lock)
        self.agents = {name: Agent(name, point, plan, self.clock) for name, point in plan.roster.items()}
        self.others: dict[str, Agent] = {}
        self.ended: dict[str, Agent] = {}
        self.just_ended: list[Agent] = []
        self.entities: dict[tuple[Point, int], Agent] = {}
        self.consulted: Agent | None = None
        self.terminated = self.truncated = self.unreported_end = self.is_complete = False
        self.most_steps = plan.options.max_steps or inf
        self.limit = min(self.most_steps, LONGEST_TAPE + 1)
        self.tape: Any = LOST if plan.unattended and not plan.has_planner else []
        self.script = None if script is None else deque(script)
        self.skips = plan.options.skip_forced
        self.last_time: float | None = None
        self.rounds = Rounds() if in_rounds else None
        self.decide: Callable[..., Any] | None = None
        if self.rounds is not None:
            self.decide = self.rounds.decide
        elif self.skips:
            self.decide = Agent.decide_unless_forced

    def events_by_hook(self) -> dict[Hook, Any]:
        """The events that the simulation sends: an agent where it is the only one of a point, else the plan's event."""
        agents = self.agents
        return {hook: agents.get(getattr(event, "agent", None), event) for hook, event in self.plan.events.items()}  # type: ignore[arg-type]

    # -- steps ------------------------------------------------------------------------------------

    def begin(self, at_first_event: Callable[[], None] | None = None) -> None:
        """Run the simulation to its first decision; when it has sent its first event, call a function.

        Raises:
            NoDecisionError: There is no decision for the environment's user.
        """
        with self.context():
            try:
                event, args, kwargs = self.driver.resume(None)
                if at_first_event is not None:
                    at_first_event()
                reply = event.handle(self, args, kwargs)
                event = args = kwargs = None
                if reply is not WAIT:
                    self.advance(reply)
                if not self.over and self.consulted is None:
                    if self.rounds is not None:
                        self.rounds.update_all(self)
                    elif not self.plan.unattended or self.plan.rewarded:
                        self._observe_announced()
                    for agent in self.agents.values() if self.skips else ():
                        agent.reward, agent.carried = 0.0, agent.carried + agent.reward  # ``reset`` returns no rewards
                if self.rounds is not None:
                    self.rounds.ended_at_reset = self.just_ended if self.skips else []
                self.begun = True
            except BaseException as error:
                self.fail(error)
                raise
        if self.pending is None and not self.plan.unattended:
            self.unreported_end = self.skips and any(a.decided for a in (*self.agents.values(), *self.just_ended))
            if not self.unreported_end:
                raise NoDecisionError(self._without_decision())

    def play(self, action: Any) -> None:
        """Play a round if the episode is played in rounds, else a step."""
        if self.rounds is None:
            self.step(action)
        else:
            self.rounds.play(self, action)

    def step(self, action: Any, entered: bool = False) -> None:
        """Answer the pending decision and run to the user's next decision, or to the end.

        Args:
            action: An action of the pending agent, or ``RULE``.
            entered: Whether the environment's context is already entered.

        Raises:
            InvalidActionError: The action is not legal. Nothing has moved.
            EpisodeOverError, ReentrancyError: No decision is pending.
        """
        agent = self.pending
        if agent is None:
            self.report_end()
            return
        if not entered and (getcurrent() is not self.driver.caller or EVALUATING or self.plugins is not None):
            with self.context():
                self.step(action, True)
            return
        try:
            if action is not RULE:
                check = agent.point.check  # a local variable: calling the attribute directly is slower
                legal = check(action)
                if legal is ILLEGAL or agent.mask is not None:
                    legal = agent.checked(action)
                action = legal
            self.advance(self.answer(agent, action))
        except BaseException as error:
            if self.pending is None:
                self.fail(error)
            else:
                self.annotate(error)
            raise

    def answer(self, agent: Agent, action: Any, turn: bool = True) -> Any:
        """Turn the checked action of an agent, or ``RULE``, into the reply for the driver's ``resume``.

        If a mapping raises, the decision stays pending. ``turn``: The user answers the pending decision.
        """
        try:
            self.pending = None  # so that an action from inside a mapping is refused
            recorded = action
            if agent.choices is not None:
                choices, agent.choices = agent.choices, None
                if agent.report is not None:
                    agent.offered = choices
                reply = action if action is RULE else [choices[action]]
            elif action is RULE:
                reply = action
            else:
                if type(action) is not int and turn:
                    recorded = duplicate(action)  # before a mapping can change it
                convert = agent.point.convert  # a local variable: calling the attribute directly is slower
                reply = convert(action)
        except BaseException:
            if turn:
                self.pending = agent
            raise
        agent.answered_at = agent.now
        if turn:
            self.turns = turns = self.turns + 1
            self.tape.append(recorded)
            if turns == self.limit:
                self._reach_limit()
        return reply

    def advance(self, reply: Any) -> None:
        """Resume the simulation with a reply, and run to the user's next decision, or to the end.

        If the model, a mapping or a policy raises, the caller must call ``fail``.
        """
        while True:
            resume = self.driver.resume  # a local variable: calling the attribute directly is slower
            event, args, kwargs = resume(reply)
            reply = event.handle(self, args, kwargs)
            if reply is WAIT:
                return
            event = args = kwargs = None  # so that they keep nothing alive that the model frees meanwhile

    def record(self, answer: Any) -> None:
        """Keep an answer for a replay."""
        if len(self.tape) >= LONGEST_TAPE:
            self.tape = LOST
        self.tape.append(answer)

    def _reach_limit(self) -> None:
        """Drop a tape that has grown too long, and prepare the truncation if this was the last step."""
        if len(self.tape) > LONGEST_TAPE:
            self.tape = LOST
        self.limit = self.most_steps
        if self.turns == self.limit:
            self.decide = Agent.decide_too_late

    def _observe_announced(self) -> None:
        """After a reset, observe the agents that ``expected_calls`` announces and that have not decided."""
        following, self.pending = self.pending, None  # so that an action from inside a mapping is refused
        for agent, args in self.announced().items():
            if agent is not following and not agent.decided:
                agent.keep(self, args, {})
                self.latest = agent
                agent.update(agent, args, agent.kwargs, reward=False)
                agent.choices = None  # ``legal`` returns them again when the agent decides
        self.pending = following

    # -- agents -----------------------------------------------------------------------------------

    def agent_for(self, point: Point, name: Any) -> Agent:
        """Find the agent with a name that decides at a point, or let it join.

        Raises:
            AgentError: The name is not a string, or belongs to another point, or to an agent that has ended.
        """
        if not isinstance(name, str):
            raise AgentError(f"agent= of {point.point.name} must return a string or None, not {short_repr(name)}")
        agent = self.others.get(name) or self.agents.get(name)
        if agent is None:
            if name in self.ended:
                raise self.ended[name].decides_after_end()
            agent = Agent(name, point, self.plan, self.clock)
            (self.agents if agent.own else self.others)[name] = agent
        elif agent.point is not point:
            raise AgentError(
                f"the agent {name!r} decides at {agent.point.point.name} and at {point.point.name};"
                " an agent has one decision point: give each point's agents names of their own"
            )
        return agent

    def agent_names(self) -> str:
        """List the names of the live agents, for messages."""
        return listed(self.agents)

    def agent(self, name: str) -> Agent | None:
        """An agent of the environment, live or ended; None if there is no such agent."""
        return self.agents.get(name) or self.ended.get(name)

    def named_before(self, point: Point, entity: Any) -> str | None:
        """The name of the agent as which an entity last decided at a point; None if it was no agent."""
        agent = self.entities.get((point, id(entity)))
        args = None if agent is None else agent.arguments()  # to exclude a freed entity that had the same id
        return agent.name if agent is not None and args and args[0] is entity else None

    def announced(self) -> dict[Agent, tuple[Any, ...]]:
        """The live agents that ``expected_calls`` announces, with the arguments of the first call of each."""
        expected: Any = getattr(self.simulation, "expected_calls", None)
        announced: dict[Agent, tuple[Any, ...]] = {}
        for point in self.plan.active if expected is not None else ():
            for call in expected(point.point.name):
                args = call if type(call) is tuple else tuple(call)
                name = point.agent or point.name_agent(*args)
                if name is None or name in self.ended:
                    continue
                agent = self.agent_for(point, name)
                if agent.own:
                    announced.setdefault(agent, args)
        return announced

    def end_agent(self, agent: Agent) -> None:
        """End the episode of one agent while the simulation's goes on."""
        latest = self.latest
        agent.conclude(self)
        self.latest = latest  # the model continues after this agent's decision
        agent.ended = agent.delegated = True
        self.ended[agent.name] = self.agents.pop(agent.name)
        self.just_ended.append(agent)
        self.is_complete = agent.name == self.plan.one_agent

    # -- branches that wait for one agent ---------------------------------------------------------

    def single_out(self, agent: Agent) -> None:
        """In a branch, make one agent the only agent of the environment, and wait for its pending decision.

        Policies answer for all other agents, or the rule where there is no policy.
        """
        if list(self.agents.values()) != [agent]:
            self.most_steps = self.limit = inf  # ``max_steps`` counts the steps of other agents
        plan = self.plan = self.plan.for_one(agent.name)
        for name, other in self.agents.items():
            if other is not agent:
                self.others[name], other.delegated = other, True
                other.follow(plan.policy_of(name, other.point))
        self.others.pop(agent.name, None)
        self.agents, self.just_ended, self.is_complete = {agent.name: agent}, [], False
        agent.follow(None)
        agent.delegated, agent.own, agent.asked = False, True, True
        self.rounds, self.decide = None, Agent.decide_unless_forced if self.skips else None
        self.begun = True
        if not agent.decided:  # drop the first value of the reward mapping, which rewards no action
            with self.context():
                agent.update(agent, agent.arguments(), agent.kwargs, observe=False)
        self.consulted, self.pending = None, agent

    def delegate(self, policies: Mapping[str, Any]) -> None:
        """In a branch, let policies, given by agent, answer for agents that neither the user nor a policy answers."""
        others = {name: self.others.get(name) for name, policy in policies.items() if policy is not RULE}
        others = {name: agent for name, agent in others.items() if agent is None or agent.policy is RULE}
        found = {name: two_arguments(policies[name]) for name in others if name not in self.agents}
        self.plan = self.plan.with_policies(found)
        for name, agent in others.items():
            if agent is not None:
                agent.follow(self.plan.policies[name])

    def may_have(self, name: Any) -> bool:
        """Whether there is an agent with that name, or could be one later."""
        declared = self.plan.options.possible_agents
        open_to_all = declared is None and any(point.agent is None for point in self.plan.points)
        known = (self.agents, self.others, self.plan.roster, self.plan.policies, declared_agents(declared))
        return any(name in names for names in known) or (open_to_all and isinstance(name, str))

    # -- ends -------------------------------------------------------------------------------------

    def finish(self, *, truncated: bool) -> None:
        """End the episode of all live agents."""
        self.pending = None
        for agent in self.agents.values():
            agent.conclude(self)
        self.over, self.truncated, self.terminated = True, truncated, not truncated
        if self.plan.unmatched_names:
            self._warn_of_unmatched_names()

    def _warn_of_unmatched_names(self) -> None:
        """Warn of agents that the environment's options name and that have not appeared, once for each agent."""
        unmatched = self.plan.unmatched_names
        present = [name for name, agent in self.agents.items() if agent.decided or agent.observation is not None]
        present += [*self.others, *self.ended]
        absent = unmatched.difference(present)
        if absent:
            unmatched -= absent
            warn_user(
                f"policies= or possible_agents= name agents that did not appear in the episode:"
                f" {listed(sorted(absent))}; these did: {listed(present)}"
            )

    def report_end(self) -> None:
        """Handle a step without a pending decision: report an end that the user does not know of, or refuse."""
        if not self.unreported_end:
            raise self.refusal()
        self.unreported_end = False

    def _without_decision(self) -> str:
        """Make the message for an episode that ended without a decision for the environment's user."""
        points = ", ".join(point.point.name for point in self.plan.active)
        ended = f"{type(self.simulation).__name__}.run() ended without a decision of"
        if self.others:
            expected = f"{self.plan.one_agent!r} at {points}" if self.plan.one_agent else points
            return f"{ended} {expected}; these have decided: {listed(self.others)}"
        return (
            f"{ended} {points}; does the simulation call the decision functions as attributes of their class or module?"
        )


def listed(names: Collection[str]) -> str:
    """List the first ten of some names, and the number of the others, for messages."""
    first = ", ".join(list(names)[:10])
    return f"{first} and {len(names) - 10} more" if len(names) > 10 else first
