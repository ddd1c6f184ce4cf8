"""One episode of one simulation. This module determines what happens when.

An episode::

    RESETTING ----> MOVING <----> PENDING ----> OVER  (terminated, truncated, failed or closed)
                    the simulation runs,        nothing happens any more
                    or mappings and policies do

A decision::

    simulation                     episode, on its user's stack
    ----------                     ----------------------------
    calls a decision function
      suspended          ------>   ``handle``: find the agent; if the rule decides, back to the simulation
                                   ``update``: reward of the previous action (the first of an
                                   episode is dropped),
                                     legal actions, info, observation
                                   if a policy answers (``Agent.ask_policy``), back to the
                                   simulation with its action else PENDING, until the user answers
                                   ``answer``: map the checked action to the reply
      returns            <------   ``advance``
    returns from ``run``
      ended              ------>   ``finish``: last reward and last observation of each agent; OVER

In AEC and single views an episode is played in turns: each agent is updated when its decision
arises. In parallel and joint views it is played in rounds: all live agents are updated when a step
returns (``Round``). Where policies answer all agents (``simulate``, ``simulate_many``), agents are
observed when a policy is asked, and not rewarded. While an episode is RESETTING or MOVING on the
user's side, decision functions run their rule.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from math import inf
from threading import current_thread
from typing import TYPE_CHECKING, Any, Final

from greenlet import getcurrent

from ..errors import (
    AgentError,
    ClosedError,
    EpisodeOverError,
    NoDecisionError,
    NotResetError,
    OptionValueError,
    ReentrancyError,
    annotate,
    clear_frames,
    listed,
    short_repr,
    warn_user,
)
from ..hooks.hook import Hook
from ..hooks.stacks import EVALUATING
from ..simulation import RULE
from .actions import ILLEGAL
from .agent import Agent
from .context import GlobalRandom, environment_context
from .driver import WAIT, Driver
from .points import declared_agents, overrides
from .policies import Where, policy_for, two_arguments
from .rounds import Round
from .spaces import duplicate

if TYPE_CHECKING:
    from .plan import Plan
    from .point import Point

LONGEST_TAPE: Final = 200_000
"""How many answers are kept for a replay.

The limit keeps a simulation that never ends from filling the memory.
"""


class EpisodeState:
    """What views read of an episode. A clone has no more of it than this: the rest is in its process.

    Attributes:
        agents: The live agents of the environment, by name, in the order in which they joined.
        others: The agents for which policies answer, by name.
        ended: The agents of the environment whose episodes ended before the simulation's, by name.
        just_ended: The ended agents whose end no view has reported yet.
        pending: The agent whose decision waits for an answer. None while the episode moves, and
            when it is over.
        consulted: The agent whose policy is being asked. In a replay, the one at whose decision the
            replay ends.
        over: Whether the episode is over, and nothing moves any more.
        terminated, truncated: How the episode ended. Both are False before its end, and if an error
            ended it.
        unreported_end: Whether there were ends during the reset, which the first step reports.
        turns: How many actions the environment's user has given.
        round: The round that is played; None if the episode is played in turns.
        skips: Whether a decision with one legal action is answered with it.
        where: Where it is played, from which follows which policies are asked themselves.
        clock: Returns the simulation's time. None if the simulation has no time.
        last_time: The time at the latest step of a joint view.
    """

    __slots__ = (
        "agents", "clock", "consulted", "ended", "just_ended", "last_time", "others", "over",
        "pending", "plan", "round", "seed", "skips", "terminated", "truncated", "turns",
        "unreported_end", "where",
    )  # fmt: skip

    def __init__(
        self, plan: Plan, seed: int, clock: Callable[[], float] | None, *, in_rounds: bool
    ) -> None:
        self.plan, self.seed, self.clock = plan, seed, clock
        self.round = Round() if in_rounds else None
        self.skips, self.where = plan.options.skip_forced, Where.USER
        self.agents: dict[str, Agent] = {}
        self.others: dict[str, Agent] = {}
        self.ended: dict[str, Agent] = {}
        self.just_ended: list[Agent] = []
        self.pending: Agent | None = None
        self.consulted: Agent | None = None
        self.over = self.terminated = self.truncated = self.unreported_end = False
        self.turns = 0
        self.last_time: float | None = None

    @property
    def in_rounds(self) -> bool:
        """Whether all agents are updated when a step returns."""
        return self.round is not None

    @property
    def deciding(self) -> Agent | None:
        """The agent whose decision waits for the user, or for its policy."""
        return self.pending or self.consulted

    def agent(self, name: str) -> Agent | None:
        """An agent of the environment, live or ended; None if there is no such agent."""
        return self.agents.get(name) or self.ended.get(name)

    def may_have(self, name: Any) -> bool:
        """Whether there is an agent with that name, or could be one later."""
        declared = self.plan.options.possible_agents
        open_to_all = declared is None and any(point.agent is None for point in self.plan.points)
        known = (
            self.agents,
            self.others,
            self.plan.roster,
            self.plan.policies,
            declared_agents(declared),
        )
        return any(name in names for names in known) or (open_to_all and isinstance(name, str))

    def refusal(self) -> Exception:
        """Make the error that says why no action can be taken now."""
        return refusal("over" if self.over else "moving")

    def report_end(self) -> None:
        """Handle a step without a pending decision: report an end during the reset, or refuse."""
        if not (self.over and self.unreported_end):
            raise self.refusal()
        self.unreported_end = False


class Episode(EpisodeState):
    """One run of a simulation, from its reset to its end. It has no reference to the environment.

    Attributes:
        entities: The agent as which an entity last decided, by its point and its id.
        latest: The agent that decided last, for the notes of errors.
        running: Whether the simulation's ``run`` has not ended yet.
        failed_in_model: Whether the error that ended the episode came from the simulation.
        most_steps: The number of turns after which the episode is truncated; infinity without
            ``max_steps``.
        plain: Whether a decision of the user's agents is just updated, and waits. If not, see
            ``decide``.
        tape: The answers of the user and of policies, in order. If it is full, later ones are not
            kept.
        session: Returns its session, for the environment that planners get.
        script: During a replay, the answers on the other episode's tape that are still to be given.
            Else None.
        items: The items of a call that was split, until the rule has decided or another call is
            split.
    """

    __slots__ = (
        "_lock", "_rng", "driver", "entities", "failed_in_model", "items", "latest", "most_steps",
        "plain", "running", "script", "session", "simulation", "tape", "tape_size",
    )  # fmt: skip

    def __init__(
        self, plan: Plan, simulation: Any, driver: Driver, seed: int, rng: GlobalRandom | None, lock: Any,
        *, in_rounds: bool = False,
    ) -> None:  # fmt: skip
        """Prepare the run of a simulation that has been reset.

        The driver's next ``resume`` begins it.
        """
        clock = getattr(simulation, "time", None)
        if clock is None and plan.options.discount_rate is not None:
            raise OptionValueError(
                f"discount_rate needs the times of decisions, but {short_repr(simulation)} has no"
                " method time(); add one that returns its clock, or leave out discount_rate"
            )
        if clock is not None and (plan.plugins is not None or rng is not None):
            # views call it, too, outside of the context
            clock = _in_context(plan.plugins, rng, clock)
        super().__init__(plan, seed, clock, in_rounds=in_rounds)
        self.simulation, self.driver, self._rng, self._lock = simulation, driver, rng, lock
        self.agents = {name: Agent(name, point, plan, clock) for name, point in plan.roster.items()}
        self.entities: dict[tuple[Point, int], Agent] = {}
        self.latest: Agent | None = None
        self.running, self.failed_in_model = True, False
        self.most_steps = plan.options.max_steps or inf
        self.plain = not (in_rounds or self.skips)
        self.tape: list[Any] = []  # not a deque, which takes 600 bytes
        self.tape_size = LONGEST_TAPE + 1 if plan.has_planner or not plan.unattended else 0
        self.script: deque[Any] | None = None
        self.session: Callable[[], Any] = lambda: None
        self.items: list[Any] | None = None

    def context(self) -> environment_context:
        """The context in which the environment's code must run."""
        return environment_context(self.plan.plugins, self._rng, self._lock, self.driver)

    def events_by_hook(self) -> dict[Hook, Any]:
        """The events that the simulation sends: an agent where it is the only one of a point, else the plan's event."""
        agents = self.agents
        return {
            hook: agents.get(getattr(event, "agent", None) or "", event)
            for hook, event in self.plan.events.items()
        }

    # -- steps ------------------------------------------------------------------------------------

    def begin(self, at_first_event: Callable[[], None] | None = None) -> None:
        """Run the simulation to its first decision.

        When it has sent its first event, call a function.

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
                if not self.over and self.consulted is None and self.agents:
                    self.update_all()
            except BaseException as error:
                self.fail(error)
                raise
        self.unreported_end = self.over or (self.in_rounds and bool(self.just_ended))
        if self.pending is None and not self.plan.unattended:
            forced = self.skips and any(
                agent.decided for agent in (*self.agents.values(), *self.just_ended)
            )
            if not forced:
                raise self._without_decision()

    def step(self, action: Any, entered: bool = False) -> None:
        """Answer the pending decision by an action or ``RULE``, and run to the user's next decision, or to the end.

        In rounds, the action is a dict of actions by agent: see ``Round.play``. ``entered``: The
        environment's context is already entered.

        Raises:
            InvalidActionError: The action is not legal. Nothing has moved.
            EpisodeOverError, ReentrancyError: No decision is pending.
        """
        agent = self.pending
        if agent is None:
            self.report_end()
            return
        if not entered and (getcurrent() is not self.driver.caller or EVALUATING):
            with self.context():
                self.step(action, True)
            return
        if self.round is not None:
            self.round.play(self, action)
            return
        try:
            if action is not RULE:
                # a local variable: calling the attribute directly is slower
                check = agent.point.check
                legal = check(action)
                if legal is ILLEGAL or agent.mask is not None:
                    legal = agent.point.validate(action, agent.name, agent.mask)
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

        If a mapping raises, the decision stays pending. ``turn``: The user answers the pending
        decision.
        """
        try:
            self.pending = None  # so that an action from inside a mapping is refused
            reply: Any
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
                # a local variable: calling the attribute directly is slower
                convert = agent.point.convert
                reply = convert(action)
            if agent.point.applies and reply is not RULE:
                reply = agent, reply
        except BaseException:
            if turn:
                self.pending = agent
            raise
        agent.answered_at = agent.now
        agent.answered += 1
        if turn:
            self.turns = turns = self.turns + 1
            if len(self.tape) < self.tape_size:
                self.tape.append(recorded)
            if turns == self.most_steps:
                self.plain = False
        return reply

    def decide(self, agent: Agent, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Handle a decision of a user's agent where more than an update is due.

        Return ``WAIT`` or the reply.
        """
        if self.round is not None:
            return self.round.decide(self, agent, args, kwargs)
        if self.turns >= self.most_steps:  # the user has taken the last step
            self.finish(truncated=True)
            return WAIT
        agent.update(agent, args, kwargs)
        if self.skips:
            forced = agent.only_action()
            agent.add_carried_reward(carry_on=forced is not None or not agent.asked)
            if forced is not None:
                return agent.answer_forced(self, forced)
            agent.asked = True
        self.pending = agent
        return WAIT

    def advance(self, reply: Any) -> None:
        """Resume the simulation with a reply, and run to the user's next decision, or to the end.

        If the model, a mapping or a policy raises, the caller must call ``fail``.
        """
        while True:
            # a local variable: calling the attribute directly is slower
            resume = self.driver.resume
            event, args, kwargs = resume(reply)
            reply = event.handle(self, args, kwargs)
            if reply is WAIT:
                return
            # so that they keep nothing alive that the model frees meanwhile
            event = args = kwargs = None

    def update_all(self, *, truncated: bool = False) -> None:
        """Reward and observe the live agents when a reset or a round returns. ``truncated``: The episode ends here.

        In turns, only agents that have not decided yet are observed, and none is rewarded.
        """
        # so that an action from inside a mapping is refused
        following, self.pending = self.pending, None
        in_rounds, expected = self.in_rounds, getattr(self.simulation, "expected_calls", None)
        for agent, call in () if expected is None else self.announced(expected).items():
            if agent is not following and (in_rounds or not agent.decided):
                agent.keep(self, *call)
        if truncated:
            self.finish(truncated=True)
            return
        for agent in self.agents.values():
            if agent.decided and not in_rounds:
                continue
            args = agent.arguments()
            if args is None:
                agent.clear_observation()
                continue
            self.latest = agent
            update = agent.update  # a local variable: calling the attribute directly is slower
            if in_rounds:
                update(agent, args, agent.kwargs)
                if self.skips:
                    agent.add_carried_reward(carry_on=not self.turns)
            else:
                update(agent, args, agent.kwargs, reward=False)
            if agent is not following:
                agent.choices = None  # ``legal`` returns them again when the agent decides
        self.pending = following

    # -- agents -----------------------------------------------------------------------------------

    def agent_for(self, point: Point, name: Any) -> Agent:
        """Find the agent with a name that decides at a point, or let it join.

        Raise ``AgentError`` if it cannot.
        """
        if not isinstance(name, str):
            raise AgentError(
                f"agent= of {point.hook.name} must return a string or None, not {short_repr(name)}"
            )
        agent = self.others.get(name) or self.agents.get(name) or self.ended.get(name)
        if agent is None:
            agent = Agent(name, point, self.plan, self.clock)
            (self.others if agent.delegated else self.agents)[name] = agent
        elif agent.point is not point:
            raise AgentError(
                f"the agent {name!r} decides at {agent.point.hook.name} and at {point.hook.name};"
                " an agent has one decision point: give each point's agents names of their own"
            )
        return agent

    def named_before(self, point: Point, entity: Any) -> str | None:
        """The name of the agent as which an entity last decided at a point.

        None if it was no agent.
        """
        agent = self.entities.get((point, id(entity)))
        # to exclude a freed entity that had the same id
        args = None if agent is None else agent.arguments()
        return agent.name if agent is not None and args and args[0] is entity else None

    def announced(self, expected_calls: Any) -> dict[Agent, tuple[tuple[Any, ...], dict[str, Any]]]:
        """The live agents that ``expected_calls`` announces, with the bound arguments of the first call of each."""
        announced: dict[Agent, tuple[tuple[Any, ...], dict[str, Any]]] = {}
        for point in self.plan.active:
            for call in expected_calls(point.hook.name):
                for args, kwargs in point.decisions_of(call):
                    name = point.agent or point.name_agent(*args, **kwargs)
                    agent = None if name is None else self.agent_for(point, name)
                    if agent is not None and not agent.delegated:
                        announced.setdefault(agent, (args, kwargs))
        return announced

    def end_agent(self, agent: Agent) -> None:
        """End the episode of one agent while the simulation's goes on."""
        latest = self.latest
        agent.conclude(self)
        self.latest = latest  # the model continues after this agent's decision
        agent.ended = agent.delegated = True
        self.ended[agent.name] = self.agents.pop(agent.name)
        self.just_ended.append(agent)

    # -- branches that wait for one agent ---------------------------------------------------------

    def single_out(self, agent: Agent) -> None:
        """In a branch, wait for one agent's decision alone.

        For all others answer their policies, else the rule.
        """
        others = {name: other for name, other in self.agents.items() if other is not agent}
        if others:
            self.most_steps = inf  # ``max_steps`` counts the steps of other agents
        self.plan, self.where = self.plan.for_one(agent.name), max(self.where, Where.BRANCH)
        self.tape, self.tape_size = [], 0  # it cannot be replayed, because this is not on the tape
        for name, other in others.items():
            other.policy, other.delegated = self.plan.policy_of(name, other.point), True
        self.others |= others
        self.agents, self.just_ended = {agent.name: agent}, []
        agent.policy, agent.delegated, agent.asked = None, False, True
        self.round, self.plain = None, not self.skips  # it is played in turns from now on
        if not agent.decided:  # drop the first value of the reward mapping, which rewards no action
            with self.context():
                agent.update(agent, agent.arguments(), agent.kwargs, observe=False)
        self.consulted, self.pending = None, agent

    def delegate(self, policies: Mapping[str, Any]) -> None:
        """In a branch, let policies, given by agent, answer for agents that neither the user nor a policy answers."""
        given: dict[str, Any] = {}
        for name in policies.keys() - self.agents.keys():
            policy = policy_for(policies, name, self.where)
            if policy is not RULE:
                given[name] = two_arguments(policy)
        self.plan = self.plan.with_policies(given)
        for name, agent in self.others.items():
            if name in given and agent.policy is RULE:
                agent.policy = given[name]

    # -- ends -------------------------------------------------------------------------------------

    def finish(self, *, truncated: bool) -> None:
        """End the episode of all live agents."""
        self.pending = None
        for agent in self.agents.values():
            agent.conclude(self)
        self.over, self.truncated, self.terminated = True, truncated, not truncated
        unmatched = self.plan.unmatched_names
        if not unmatched:
            return
        present = [
            name
            for name, agent in self.agents.items()
            if agent.decided or agent.observation is not None
        ]
        present += [*self.others, *self.ended]
        absent = unmatched.difference(present)
        if absent:
            unmatched -= absent  # each is warned of once
            warn_user(
                f"policies= or possible_agents= name agents that did not appear in the episode:"
                f" {listed(sorted(absent))}; these did: {listed(present)}"
            )

    def _without_decision(self) -> NoDecisionError:
        """Make the error for an episode that ended without a decision for the environment's user."""
        expected = ", ".join(point.hook.name for point in self.plan.active)
        overriding = listed([name for point in self.plan.active for name in overrides(point.hook)])
        hints: list[str] = []
        threads = {name for point in self.plan.active for name in point.hook.threads} - {
            current_thread().name
        }
        if overriding:
            hints.append(
                f"these override it and are called instead: {overriding}; name them as decision"
                " points"
            )
        if threads:
            hints.append(
                "the rule has decided in threads that are not the simulation's:"
                f" {listed(sorted(threads))}; call it where run() runs, and pass the decision on"
            )
        if self.others:
            expected = f"{self.plan.one_agent!r} at {expected}" if self.plan.one_agent else expected
            hints = [f"these have decided: {listed(self.others)}"]
        hint = (
            "; ".join(hints)
            or "does the simulation call its decision functions as attributes of class or module?"
        )
        return NoDecisionError(
            f"{type(self.simulation).__name__}.run() ended without a decision of {expected}; {hint}"
        )

    # -- errors, and the end by a close ------------------------------------------------------------

    def annotate(self, error: BaseException) -> None:
        """Add a note to an error: at which decision of which agent it arose."""
        agent, where = self.latest, "before the first decision"
        if agent is not None:
            number, when = self.turns + 1, "at"
            if self.failed_in_model:
                number, when = self.turns, "in the model, after"
            where = f"{when} decision {number}, of {agent.name!r} at {agent.point.hook.name}"
        annotate(error, f"simenv_marl: {where}; seed {self.seed}")

    def fail(self, error: BaseException) -> None:
        """End the episode because of an error, and add a note to the error that says where it arose."""
        # first, because the next call may come to the end of the stack
        self.pending, self.over = None, True
        self.annotate(error)
        try:
            problems = self._unwind()
        # warnings may be errors; this one must not replace the original error
        except Warning as warning:
            problems = [warning]
        for problem in problems:
            annotate(
                error, f"simenv_marl: unwinding the simulation raised {short_repr(problem)} as well"
            )
        clear_frames(error)

    def close(self) -> None:
        """Unwind the simulation if it is suspended, without answering its decisions.

        Raises:
            ReentrancyError, WrongThreadError: The simulation is moving, or suspended in another
                thread.
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
        """Unwind the simulation if it is suspended; then the episode is over.

        Return the errors that it raised.
        """
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
            "this is a copy of an environment, and has no episode yet; call reset() first, or use"
            " clone() to go on from where the original stands"
        ),
        "moving": ReentrancyError(
            "the environment was used from inside its own reset, simulation or mappings, or while"
            " another thread was using it"
        ),
        "over": EpisodeOverError("the episode is over; call reset() to begin the next one"),
        "closed": ClosedError("the environment is closed; call reset() to use it again"),
    }[state]


def _in_context(
    plugins: Any, rng: GlobalRandom | None, function: Callable[[], Any]
) -> Callable[[], Any]:
    def call() -> Any:
        with environment_context(plugins, rng):
            return function()

    return call
