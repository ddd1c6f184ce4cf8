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
                                   ``update``: reward of the previous action (the first of an episode is dropped),
                                     legal actions, info, observation
                                   if a policy answers (``Agent.ask_policy``), back to the simulation with its action
                                   else PENDING, until the user answers
                                   ``answer``: map the checked action to the reply
      returns            <------   ``advance``
    returns from ``run``
      ended              ------>   ``finish``: last reward and last observation of each agent; OVER

In AEC and single views an episode is played in turns: each agent is updated when its decision arises. In parallel and
joint views it is played in rounds: all live agents are updated when a step returns (``Rounds``). Where policies answer
all agents (``simulate``, ``simulate_many``), agents are observed when a policy is asked, and not rewarded. While an
episode is RESETTING or MOVING on the user's side, decision functions run their rule.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import inf
from threading import current_thread
from typing import TYPE_CHECKING, Any, Final

from greenlet import getcurrent

from ..errors import AgentError, InvalidActionError, NoDecisionError, UnknownAgentError, listed, short_repr, warn_user
from ..hooks.hook import Hook
from ..hooks.stacks import EVALUATING
from ..simulation import RULE
from .actions import ILLEGAL
from .agent import Agent
from .driver import WAIT
from .points import declared_agents, overrides
from .policies import policy_in_branch
from .run import Run
from .spaces import duplicate

if TYPE_CHECKING:
    from .point import Point

MANY_ROUNDS: Final = 100
"""The number of rounds in a row without an action for the pending agent after which the user is warned."""


class Episode(Run):
    """One run of a simulation, from its reset to its end. It has no reference to the environment."""

    __slots__ = ()

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
                if not self.over and self.consulted is None and self.agents:
                    self.update_all()
            except BaseException as error:
                self.fail(error)
                raise
        self.unreported_end = self.over
        if self.pending is None and not self.plan.unattended:
            forced = self.skips and any(agent.decided for agent in (*self.agents.values(), *self.just_ended))
            if not forced:
                raise self._without_decision()

    def step(self, action: Any, entered: bool = False) -> None:
        """Answer the pending decision by an action or ``RULE``, and run to the user's next decision, or to the end.

        ``entered``: The environment's context is already entered.

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
        try:
            if action is not RULE:
                check = agent.point.check  # a local variable: calling the attribute directly is slower
                legal = check(action)
                if legal is ILLEGAL or agent.mask is not None:
                    legal = agent.point.checked(action, agent.name, agent.mask)
                action = legal
            self.advance(self.answer(agent, action))
        except BaseException as error:
            if self.pending is None:
                self.fail(error)
            else:
                self.annotate(error)
            raise

    def report_end(self) -> None:
        """Handle a step without a pending decision: report an end during the reset, or refuse."""
        if not (self.over and self.unreported_end):
            raise self.refusal()
        self.unreported_end = False

    def answer(self, agent: Agent, action: Any, turn: bool = True) -> Any:
        """Turn the checked action of an agent, or ``RULE``, into the reply for the driver's ``resume``.

        If a mapping raises, the decision stays pending. ``turn``: The user answers the pending decision.
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
                convert = agent.point.convert  # a local variable: calling the attribute directly is slower
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
                self.decide = Agent.decide_too_late
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

    def update_all(self, *, truncated: bool = False) -> None:
        """Reward and observe the live agents when a reset or a round returns. ``truncated``: The episode ends here.

        In turns, only agents that have not decided yet are observed, and none is rewarded.
        """
        following, self.pending = self.pending, None  # so that an action from inside a mapping is refused
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
        """Find the agent with a name that decides at a point, or let it join; raise ``AgentError`` if it cannot."""
        if not isinstance(name, str):
            raise AgentError(f"agent= of {point.point.name} must return a string or None, not {short_repr(name)}")
        agent = self.others.get(name) or self.agents.get(name) or self.ended.get(name)
        if agent is None:
            agent = Agent(name, point, self.plan, self.clock)
            (self.others if agent.delegated else self.agents)[name] = agent
        elif agent.point is not point:
            raise AgentError(
                f"the agent {name!r} decides at {agent.point.point.name} and at {point.point.name};"
                " an agent has one decision point: give each point's agents names of their own"
            )
        return agent

    def agent(self, name: str) -> Agent | None:
        """An agent of the environment, live or ended; None if there is no such agent."""
        return self.agents.get(name) or self.ended.get(name)

    def named_before(self, point: Point, entity: Any) -> str | None:
        """The name of the agent as which an entity last decided at a point; None if it was no agent."""
        agent = self.entities.get((point, id(entity)))
        args = None if agent is None else agent.arguments()  # to exclude a freed entity that had the same id
        return agent.name if agent is not None and args and args[0] is entity else None

    def announced(self, expected_calls: Any) -> dict[Agent, tuple[tuple[Any, ...], dict[str, Any]]]:
        """The live agents that ``expected_calls`` announces, with the bound arguments of the first call of each."""
        announced: dict[Agent, tuple[tuple[Any, ...], dict[str, Any]]] = {}
        for point in self.plan.active:
            for call in expected_calls(point.point.name):
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
        """In a branch, wait for one agent's decision alone. For all others answer their policies, else the rule."""
        others = {name: other for name, other in self.agents.items() if other is not agent}
        if others:
            self.most_steps = inf  # ``max_steps`` counts the steps of other agents
        self.plan = self.plan.for_one(agent.name)
        for name, other in others.items():
            other.policy, other.delegated = self.plan.policy_of(name, other.point), True
        self.others |= others
        self.agents, self.just_ended = {agent.name: agent}, []
        agent.policy, agent.delegated, agent.asked = None, False, True
        self.__class__ = Episode  # it is played in turns from now on
        self.decide = Agent.decide_unless_forced if self.skips else None
        if not agent.decided:  # drop the first value of the reward mapping, which rewards no action
            with self.context():
                agent.update(agent, agent.arguments(), agent.kwargs, observe=False)
        self.consulted, self.pending = None, agent

    def delegate(self, policies: Mapping[str, Any]) -> None:
        """In a branch, let policies, given by agent, answer for agents that neither the user nor a policy answers."""
        given = {name: policy for name, policy in policies.items() if policy is not RULE and name not in self.agents}
        self.plan = self.plan.with_policies(
            {name: policy_in_branch(policy, name, self) for name, policy in given.items()}
        )
        for name, agent in self.others.items():
            if name in given and agent.policy is RULE:
                agent.policy = self.plan.policies[name]

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
        unmatched = self.plan.unmatched_names
        if not unmatched:
            return
        present = [name for name, agent in self.agents.items() if agent.decided or agent.observation is not None]
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
        expected = ", ".join(point.point.name for point in self.plan.active)
        overriding = listed([name for point in self.plan.active for name in overrides(point.point)])
        hints: list[str] = []
        threads = {name for point in self.plan.active for name in point.point.threads} - {current_thread().name}
        if overriding:
            hints.append(f"these override it and are called instead: {overriding}; name them as decision points")
        if threads:
            hints.append(
                f"the rule has decided in threads that are not the simulation's: {listed(sorted(threads))}; call it"
                " where run() runs, and pass the decision on"
            )
        if self.others:
            expected = f"{self.plan.one_agent!r} at {expected}" if self.plan.one_agent else expected
            hints = [f"these have decided: {listed(self.others)}"]
        hint = "; ".join(hints) or "does the simulation call its decision functions as attributes of class or module?"
        return NoDecisionError(f"{type(self.simulation).__name__}.run() ended without a decision of {expected}; {hint}")


class Rounds(Episode):
    """An episode that is played in rounds.

    A round uses each action once, up to the first decision without one. Then all live agents are updated.
    """

    __slots__ = ()
    in_rounds = True

    def begin(self, at_first_event: Callable[[], None] | None = None) -> None:
        """Run the simulation to its first decision: see ``Episode``. The first round reports the ends until then."""
        self.decide, self.actions, self.stalled, self.given, self.unused = decide, {}, 0, 0, 0
        super().begin(at_first_event)
        self.unreported_end = self.over or bool(self.just_ended)

    def step(self, action: Mapping[str, Any], entered: bool = False) -> None:
        """Play a round with an action, or ``RULE``, for each agent's name: see ``Episode``.

        An action that is legal now and illegal at its turn counts as missing.

        Raises:
            UnknownAgentError: An action is for an agent that is not live. Nothing has moved.
        """
        pending = self.pending
        if pending is None:
            self.report_end()
            return
        if not entered and (getcurrent() is not self.driver.caller or EVALUATING):
            with self.context():
                self.step(action, True)
            return
        self.actions = actions = self.check(action)
        self.pending = None
        try:
            if len(self.tape) < self.tape_size:
                answers = {name: part if type(part) is int else duplicate(part) for name, part in actions.items()}
                self.tape.append(answers)
            self.turns += bool(action)
            for agent in (*self.agents.values(), *self.just_ended):
                agent.acted = False
            if self.unreported_end:
                self.unreported_end = False
            else:
                self.just_ended = []
            reply = self.use_action(pending)
            self.stalled = self.stalled + 1 if reply is WAIT else 0
            if reply is not WAIT:
                self.advance(reply)
            if not self.skips:  # else forced moves are not asked for
                self.unused += sum(part is not RULE for part in actions.values())
            if not self.over and self.consulted is None:  # it is set where a replay ends
                self.update_all(truncated=bool(action) and self.turns == self.most_steps)
        except BaseException as error:
            self.fail(error)
            raise
        if self.stalled == MANY_ROUNDS:
            warn_user(
                f"the simulation stands still: {short_repr(pending.name)} must decide, but {MANY_ROUNDS} rounds in a"
                ' row had no action for it; the info of the agent that must decide has "deciding": True'
            )

    def check(self, actions: Mapping[str, Any]) -> dict[str, Any]:
        """Check the actions of a round before the simulation moves; return them in the form that mappings take."""
        pending, agents, checked = self.pending, self.agents, {}
        if type(actions) is not dict and not isinstance(actions, Mapping):
            raise InvalidActionError(f"a round takes a dict of actions by agent, not {short_repr(actions)}")
        for name, action in actions.items():
            agent = agents.get(name)
            if agent is None:
                if self.unreported_end and name in self.ended:
                    continue
                raise UnknownAgentError(
                    f"there is an action for {short_repr(name)}, which is not a live agent; live agents:"
                    f" {listed(agents)}"
                )
            if action is not RULE:
                check = agent.point.check
                legal = check(action)
                mask = agent.mask if agent is pending else None
                if legal is ILLEGAL or mask is not None:
                    legal = agent.point.checked(action, name, mask)
                action = legal
                self.given += 1
            checked[name] = action
        return checked

    def use_action(self, agent: Agent) -> Any:
        """Answer a decision with the agent's action of this round, or wait for the next round."""
        action = agent.only_action() if self.skips else None
        if action is None:
            action = self.actions.pop(agent.name, WAIT)
            mask = agent.mask
            if action is WAIT or (mask is not None and action is not RULE and not agent.point.allows(mask, action)):
                self.pending = agent
                return WAIT
            agent.acted = True
        self.latest = agent
        if not agent.decided:  # it acts before it was ever updated
            agent.update(agent, agent.arguments(), agent.kwargs, observe=False)
        return self.answer(agent, action, False)


def decide(agent: Agent, episode: Rounds, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """Handle a decision in a round: the agent was observed when the latest step returned."""
    if agent.point.legal is not None:
        agent.mask, agent.choices = agent.point.legal(args, kwargs)
    if agent.clock is not None:
        agent.read_clock(agent)
    return episode.use_action(agent)
