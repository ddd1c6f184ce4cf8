"""One episode of one simulation: the order of events.

A decision::

    simulation                     episode, on its user's stack
    ----------                     ----------------------------
    calls a decision function
      suspended          ------>   ``handle``: find the agent; or the rule decides
                                   ``Agent.update``: reward of the previous action (the first of an
                                     episode is dropped), legal actions, info, observation
                                   ``ask``: a policy answers at once, or a task of the model waits
                                   else PENDING, until the user answers
                                   ``answer``: map the checked action to the reply
      returns            <------   ``advance``
    returns from ``run``
      ended              ------>   ``finish``: last reward and observation of each agent; OVER

In AEC, single and turn views an episode is played in turns: each agent is updated when its decision
arises. In parallel and joint views it is played in rounds: all live agents are updated when a step
returns. Where policies answer all agents (``simulate``, ``simulate_many``), agents are observed
when a policy is asked, and not rewarded. While an episode is MOVING on the user's side, decision
functions run their rule.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from sys import maxsize
from typing import Any
from weakref import ref

from greenlet import getcurrent

from ...errors import AgentError, annotate, clear_frames, short_repr, warn_user
from ...hooks.hook import Hook
from ...hooks.stacks import EVALUATING
from ...simulation import EVERYONE, RULE, TRUNCATED, Action, Model, Sentinel, optional_method
from ..plans.point import Args, Kwargs, Policy
from ..plans.policies import (
    EpisodePolicy,
    Where,
    policy_for,
    split_extras,
    two_arguments,
)
from ..switching.driver import WAIT, Driver, Event
from ..values.actions import ILLEGAL
from ..values.spaces import duplicate
from .agent import Agent, DecisionHandler
from .base import GO_ON, LONGEST_TAPE, Branched, EpisodeOwner, Replay, Tape
from .split import Gathered, SplitCall, TaskQuestion, has_waiting, question_of
from .state import RUNNING, EpisodeState, Outcome, checked_actions, missing_decision
from .steps import Round, Team


class Episode(EpisodeState):
    """One run of a simulation, from its reset to its end. It does not refer to the environment.

    Attributes:
        session: Returns the session. None if that is gone.
        simulation: The simulation.
        context: Makes the context that the environment's code needs.
        driver: The driver of its stack.
        team: The team, with ``team_reward=``. None without.
        latest: The agent that decided last, for the notes of errors.
        called: The functions that end agents and were called.
        running: Whether the simulation's ``run`` has not ended yet.
        is_plain: Whether a decision of the user's agents is just updated, and waits.
        moved: The names of agents that have decided at several points.
        end_states: The states at the ends of agents midway. None if no learner has asked for any.
        tape: The answers so far. If it is full, later ones are lost.
        replay: The answers of the episode that this one repeats. None in ordinary episodes.
    """

    __slots__ = (
        "_expected_calls", "_failed_in_model", "_handlers", "_latest_state", "_most_steps",
        "_notice", "_observes", "_plugins", "_split", "_tape_size", "called", "context", "driver",
        "end_states", "is_plain", "latest", "moved", "replay", "running", "session", "simulation",
        "tape", "team",
    )  # fmt: skip

    def __init__(
        self,
        session: EpisodeOwner,
        simulation: Model,
        driver: Driver,
        seed: int,
        replay: Replay | None,
        *,
        in_rounds: bool,
    ) -> None:
        """Prepare the run of a simulation that has been reset. The next ``resume`` begins it."""
        plan = session.plan
        super().__init__(plan, seed, session.new_clock(), session.where, in_rounds=in_rounds)
        self.session: Callable[[], EpisodeOwner | None] = ref(session)
        self.simulation = simulation
        self.driver = driver
        self._expected_calls = optional_method(simulation, "expected_calls", "point")
        self.context = partial(session.context, driver)
        self._handlers = session.handlers
        self._plugins = plan.plugins
        self.latest: Agent | None = None
        self.called: set[Hook] = set()
        self.running = True
        self._notice: Callable[[], None] | None = None
        self._failed_in_model = False
        self._most_steps = plan.options.max_steps or maxsize
        self.moved: set[str] = set()
        self.team: Team | None = None
        if plan.options.team_reward is not None:
            self.team = Team(partial(plan.options.team_reward, simulation), self._plugins)
        self.is_plain = not (in_rounds or self.skips or self.team or plan.derive(has_waiting))
        self.tape = session.new_tape()
        self._tape_size = LONGEST_TAPE + 1 if plan.has_planner or plan.has_user else 0
        self.replay = replay
        self._split: SplitCall | Gathered | None = None
        self._observes = isinstance(plan.options.state_space, str)  # observations are states
        self.end_states: dict[Agent, Model] | None = None
        self._latest_state: tuple[int, Model] = (-1, None)  # the turn, and the state
        for name, prepared in self._handlers.roster.items():
            self.agents[name] = Agent(name, *prepared, self.clock, self._plugins)

    # -- steps ------------------------------------------------------------------------------------

    def begin(self, events: list[Event], find_fault: Callable[[], str] | None) -> None:
        """Go on from the simulation's first event, and a look for a fault, to its first decision.

        Raises:
            NoDecisionError: There is no decision for the environment's user.
        """
        try:
            if find_fault is not None:
                self._fault = find_fault()
            self.receive(events)
            is_over = self.outcome is not RUNNING
            if not is_over and self.consulted is None and self.agents:
                self.update_all()
        except BaseException as error:
            self.fail(error)
            raise
        self.unreported_end = is_over or (self.round is not None and bool(self.just_ended))
        if self.pending is None and self.plan.has_user:
            agents = (*self.agents.values(), *self.just_ended)
            if not (self.skips and any(agent.decided for agent in agents)):  # no forced moves
                raise missing_decision(self, type(self.simulation).__name__)

    def step(self, action: Action, entered: bool = False) -> None:
        """Answer the pending decision, and run to the user's next decision, or to the end.

        Args:
            action: An action or ``RULE``. In rounds, a dict of these by agent.
            entered: Whether the environment's context is already entered.

        Raises:
            InvalidActionError: The action is not legal. Nothing has moved.
            EpisodeOverError, ReentrancyError: No decision is pending.
        """
        agent = self.pending
        if agent is None:
            self.report_end()
            return
        if not entered and (
            getcurrent() is not self.driver.caller or EVALUATING or self._plugins is not None
        ):
            self._enter_and_step(action)
            return
        if self.round is not None:
            self._play(self.round, agent, action)
            return
        try:
            if action is not RULE:
                check = agent.point.check  # a variable, because calling an attribute is slower
                legal = check(action)
                if legal is ILLEGAL or agent.mask is not None:
                    legal = agent.validate(action)
                action = legal
            reply = self.answer(agent, action)
            self.advance(reply)
        except BaseException as error:
            refuse = self.fail if self.pending is None else self.annotate
            refuse(error)
            raise

    def _enter_and_step(self, action: Action) -> None:
        """Take a step in the environment's context."""
        if getcurrent() is not self.driver.caller or EVALUATING:
            with self.context():
                self.step(action, True)
            return
        # The context would do the same in five times the time: here only plugins need it.
        here = getcurrent()
        EVALUATING[here] = self._plugins
        try:
            self.step(action, True)
        finally:
            # No call, because an interrupt could come in its place; and no variable, because
            # tracebacks keep those, and a root must not outlive its thread.
            del EVALUATING[here]
            del here

    def _play(self, played: Round, pending: Agent, actions: Mapping[str, Action]) -> None:
        """Play a round with an action, or ``RULE``, for each agent's name."""
        checked = checked_actions(self, actions)
        self.pending = None
        try:
            if len(self.tape) < self._tape_size:
                recorded = checked.copy()
                for name, action in checked.items():
                    if type(action) is not int:
                        recorded[name] = duplicate(action)
                self.tape.append(recorded)
            self.turns += bool(checked)
            is_last = bool(checked) and self.turns == self._most_steps
            played.begin(checked, pending.name)
            if self.unreported_end:
                self.unreported_end = False
            else:
                self.just_ended = []
            reply = self._use_action(played, pending)
            if reply is pending:
                self.pending = pending
                played.note_stalled(pending)
            else:
                self.advance(reply)
            if played.actions and not self.skips:  # else forced moves have used none
                played.count_unused()
            # ``consulted`` is set where a replay ends.
            if self.outcome is RUNNING and self.consulted is None:
                self.update_all(truncated=is_last)
        except BaseException as error:
            self.fail(error)
            raise

    def advance(self, reply: Model) -> None:
        """Resume the simulation with a reply, and run to the user's next decision, or to the end.

        If the model, a mapping or a policy raises, the caller must call ``fail``.
        """
        while True:
            if self._split is None:
                resume = self.driver.resume
                handler, args, kwargs = resume(reply)
            else:
                handler, args, kwargs = self._next_item(self._split, reply)
            reply = handler.handle(self, args, kwargs)
            if type(reply) is Agent:
                self.latest = self.pending = reply
                return
            if reply is WAIT:
                return
            del handler, args, kwargs  # they must keep nothing alive that the model frees

    def receive(self, events: list[Event]) -> None:
        """Handle the last event of a list, and go on to the user's next decision, or to the end.

        The event leaves the list, because a caller must not keep arguments that the model may free.
        """
        handler, args, kwargs = events.pop()
        reply = handler.handle(self, args, kwargs)
        if type(reply) is Agent:
            self.latest = self.pending = reply
        elif reply is not WAIT:
            del handler, args, kwargs
            self.advance(reply)

    # -- decisions --------------------------------------------------------------------------------

    def decide(self, agent: Agent, args: Args, kwargs: Kwargs) -> Model:
        """Handle a decision in a round, with skipped forced moves, or after the last step."""
        self.latest = agent
        if self.round is not None:
            if agent.point.legal is not None or agent.clock is not None:
                agent.observe_again(args, kwargs)
            return self._use_action(self.round, agent)
        if self.turns >= self._most_steps:  # the user has taken the last step
            self.finish(truncated=True)
            return WAIT
        if not agent.decided:
            self.note_first_decision()
        agent.update(args, kwargs)
        if self.skips:
            reply = agent.reply_if_forced()
            if reply is not agent:
                if self.team is not None:
                    self.team.join(agent)
                return reply
        if self.team is not None:
            self.earned = self.team.settle([agent])
        return self._question(agent, agent.policy) or agent

    def _use_action(self, played: Round, agent: Agent) -> Model:
        """Answer a decision with the action of this round. Return the agent if it has none."""
        forced = agent.only_action() if self.skips else None
        action = played.take(agent) if forced is None else forced
        if action is WAIT:
            return agent
        self.latest = agent
        if not agent.decided:  # it acts before it was ever updated
            self.note_first_decision()
            args, kwargs = agent.arguments.recall()
            agent.update(args, kwargs, observe=False)
            if self.team is not None:
                self.team.join(agent)
        return agent.reply_to(action, forced is not None)

    def answer(self, agent: Agent, action: Action) -> Model:
        """Turn the user's checked action, or ``RULE``, into the reply to the pending decision.

        If a mapping raises, the decision stays pending.
        """
        try:
            self.pending = None  # so that an action from inside a mapping is refused
            recorded = action
            if type(action) is not int and action is not RULE:
                recorded = duplicate(action)  # before a mapping can change it
            reply = agent.reply_to(action)
        except BaseException:
            self.pending = agent
            raise
        self.turns = turns = self.turns + 1
        if len(self.tape) < self._tape_size:
            self.tape.append(recorded)
        if turns == self._most_steps:
            self.is_plain = False
        return reply

    def ask(self, agent: Agent, args: Args, kwargs: Kwargs) -> Model:
        """Let a policy answer. Return the reply, or the agent if the policy is asked later."""
        if agent.ended:
            raise agent.refusal()
        if self.plan.one_agent in self.ended:  # else it might run for ever without a user
            self.finish(truncated=False)
            return WAIT
        if self._notice is not None:
            self._notice()
        policy = agent.policy
        if policy is RULE:
            return RULE
        self.latest = agent
        is_rewarded = isinstance(policy, EpisodePolicy) and policy.asks
        agent.update(args, kwargs, reward=is_rewarded)
        if self.skips:
            reply = agent.reply_if_forced()
            if reply is not agent:
                return reply
        if self._observes or (isinstance(policy, EpisodePolicy) and policy.looks_back):
            agent.keep(args, kwargs)
        return self._question(agent, policy) or self.answer_by(policy, agent)

    def _question(self, agent: Agent, policy: Policy) -> TaskQuestion | None:
        """Make the question for which a task of the model waits. None if it is asked at once."""
        return None if self._split else question_of(self, self.driver, agent, policy)

    def answer_by(self, policy: Policy, agent: Agent) -> Model:
        """Let a policy answer. Return the reply, the agent if it is asked later, or ``WAIT``."""
        self.latest = agent
        if not agent.delegated and self.turns >= self._most_steps:
            self.finish(truncated=True)
            return WAIT
        if isinstance(policy, EpisodePolicy) and policy.deferred and not self.is_branch:
            return agent
        if self.replay and self.replay[0] is GO_ON:
            self.replay = None
        if self.replay is not None:
            if not self.replay or isinstance(self.replay[0], Branched):  # the other one stands here
                self.consulted = self.pending = agent
                return WAIT
            action = self.replay.popleft()
        else:
            self.consulted = agent
            observation = duplicate(agent.raw_observation)  # which the policy may change
            try:
                if isinstance(policy, EpisodePolicy):
                    action = policy.answer(self, agent, observation, agent.info)
                else:
                    action = policy(observation, agent.info)
            finally:
                self.consulted = None
            if type(action) is tuple:
                action, _ = split_extras(action, agent.point.definition.action_space)
        self.record(action)
        return agent.reply_to(action if action is RULE else agent.validate(action))

    def record(self, action: Action) -> None:
        """Keep a copy of an answer for replays."""
        if len(self.tape) < self._tape_size:
            self.tape.append(duplicate(action))

    @property
    def questions(self) -> Sequence[TaskQuestion]:
        """The questions that wait together, while the first of them is pending."""
        return self._split.questions if isinstance(self._split, Gathered) else ()

    @property
    def is_recorded(self) -> bool:
        """Whether all answers of the episode are on its tape."""
        return len(self.tape) < self._tape_size

    def end_replay(self) -> None:
        """Go on as an ordinary episode, whose ends another view has reported."""
        self.replay = None
        self.just_ended = []

    def planner_view(self) -> object:
        """Make the environment that a planner gets."""
        return self.plan.subject.planner_view(self.session())

    def begin_split(self, call: SplitCall | Gathered) -> None:
        """Decide the items of a call, before the simulation moves."""
        self._split = call

    def _next_item(self, call: SplitCall | Gathered, reply: Model) -> Event:
        """Return the event of a call's next item. After the last one, resume the simulation."""
        event = call.next_event(reply, self.latest)
        if event is not None:
            return event
        self._split = None
        reply = call.reply()
        del call  # it has the items, which the model may free
        return self.driver.resume(reply)

    # -- agents -----------------------------------------------------------------------------------

    def agent_for(self, handler: DecisionHandler, name: Model) -> Agent:
        """Return the agent with a name that decides at a point. Let a new one join.

        Raises:
            AgentError: The name is no string, or its agent decides at another point.
        """
        here = handler.point.hook.name
        if not isinstance(name, str):
            raise AgentError(
                f"agent= of {here} must return a string or None, not {short_repr(name)}"
            )
        agent = self.find(name)
        if agent is None:
            policy = self.plan.policy_of(name, handler.point)
            delegated = self.plan.is_delegated(policy)
            agent = Agent(name, handler, policy, delegated, self.clock, self._plugins)
            (self.others if delegated else self.agents)[name] = agent
        elif agent.handler is not handler:
            policy = self.plan.policy_of(name, handler.point)
            if policy is not agent.policy or not self.plan.can_share(agent.point, handler.point):
                raise AgentError(
                    f"the agent {name!r} decides at {agent.point.hook.name} and at {here}, whose"
                    " spaces or policies differ: give each point's agents names of their own, or"
                    " use turn_env, which unites spaces"
                )
            agent.move_to(handler)
            self.moved.add(name)
        return agent

    def blame(self, agent: Agent) -> None:
        """Note the agent that notes of errors name."""
        self.latest = agent

    def restore_pending(self) -> None:
        """Let the decision wait again that was answered last, so that the episode can be closed."""
        if self.pending is None and not self.over:
            self.pending = self.latest

    def observe_others(self, agent: Agent) -> None:
        """Observe all live agents but one, as when a round returns. Reward none."""
        self._keep_announced(agent, everyone=True)
        for other in (*self.agents.values(), *self.others.values()):
            if other is not agent:
                other.refresh(reward=False)

    def update_all(self, *, truncated: bool = False) -> None:
        """Reward and observe the live agents when a reset or a round returns.

        In turns, only agents that have not decided yet are observed, and none is rewarded.
        ``truncated``: the episode ends here.
        """
        pending, self.pending = self.pending, None  # so that an action from a mapping is refused
        in_rounds = self.round is not None
        self._keep_announced(pending)
        if truncated:
            self.finish(truncated=True)
            return
        for agent in self.agents.values():
            if agent.decided and not in_rounds:
                continue
            if not agent.arguments.is_empty:
                self.latest = agent
            agent.refresh(reward=in_rounds, asked=agent is pending)
            if in_rounds and self.skips and agent.present:
                agent.carry_reward(not self.turns)
            if agent.choices is not None and agent is not pending:
                agent.forget_choices()  # ``legal`` returns them again when it decides
        if in_rounds and self.team is not None:
            self.earned = self.team.settle(self.agents.values())
        self.pending = pending
        self.latest = pending or self.latest

    def _keep_announced(self, deciding: Agent | None, *, everyone: bool = False) -> None:
        """Hold the arguments of announced calls, of ``everyone`` or of the user's agents."""
        expected_calls = self._expected_calls
        if expected_calls is None:
            return
        known = {deciding}
        points = self.plan.points if everyone else self.plan.active
        for handler, name, args, kwargs in self._handlers.announced(expected_calls, points):
            agent = self.find(name) if isinstance(name, str) else None
            if agent is not None:
                is_asked = not agent.delegated and (self.in_rounds or not agent.decided)
                if agent in known or agent.ended or not (everyone or is_asked):
                    continue  # it stays at its point
            agent = self.agent_for(handler, name)
            known.add(agent)
            if everyone or not agent.delegated:
                agent.keep(args, kwargs)

    def end_agent(self, agent: Agent) -> None:
        """End the episode of one agent while the simulation's goes on.

        An agent that a policy answers is observed for the last time, if others see that.
        """
        is_other = agent.name not in self.agents  # a branch may have delegated the user's agents
        is_seen = self._observes or getattr(agent.policy, "sees_all", False)
        if is_other and not is_seen:
            return
        latest = self.latest
        self.latest = agent
        agent.conclude()
        if self.end_states is not None:
            self.end_states[agent] = self.read_state()
        self.latest = latest  # the model continues after the decision of this agent
        if is_other:
            return
        agent.end()
        self.ended[agent.name] = self.agents.pop(agent.name)
        self.just_ended.append(agent)
        if self.team is not None:
            self.team.note_end(agent)

    def note_state(self) -> Model:
        """Return the state, which is read once a turn. Note it at ends of agents from now on."""
        if self.end_states is None:
            self.end_states = {}
        if self.is_branch:  # policies answer here, and ``turns`` stays
            return self.read_state()
        if self._latest_state[0] != self.turns:
            try:
                self._latest_state = self.turns, self.read_state()
            except BaseException as error:
                self.annotate(error)
                raise
        return self._latest_state[1]

    def read_state(self) -> Model:
        """Return the state of the simulation: see ``StateReader``."""
        session: Any = self.session()
        return session.read_state()

    # -- branches that wait for one agent ---------------------------------------------------------

    def single_out(self, agent: Agent) -> None:
        """In a branch, wait for one agent alone. Policies answer for the others, else the rule."""
        self.plan = self.plan.for_one(agent.name)
        self.move_to(Where.BRANCH)
        self.record(Branched(agent.name))
        for name, other in self.agents.items():
            if other is not agent:
                self._most_steps = maxsize  # ``max_steps`` counts the steps of other agents
                other.delegate(self.plan.policy_of(name, other.point))
                self.others[name] = other
        self.agents = {agent.name: agent}
        self.just_ended = []
        agent.take_over()
        self.round = None  # it is played in turns from now on
        self.is_plain = not (self.skips or self.team)
        if not agent.decided:  # drop the first value of the reward mapping, which rewards no action
            with self.context():
                agent.update(*agent.arguments.recall(), observe=False)
        self.consulted = None
        self.pending = agent

    def watch(self, notice: Callable[[], None]) -> None:
        """In a branch, call a function at each decision that no user answers."""
        self._notice = notice

    def delegate(self, policies: Mapping[str, Policy]) -> None:
        """In a branch, let policies answer for the agents that follow the rule."""
        names = policies.keys() - self.agents.keys()
        substitutes: dict[Any, Policy] = {
            name: two_arguments(policy_for(policies, name, self.where)) for name in names
        }
        self.plan = self.plan.with_policies(substitutes)
        self.tape = Tape()  # it cannot be replayed, because these are not on the tape
        self._tape_size = 0
        for name, agent in self.others.items():
            substitute = substitutes.get(name, substitutes.get(EVERYONE, RULE))
            if agent.policy is RULE and substitute is not RULE:
                agent.delegate(substitute)

    # -- ends -------------------------------------------------------------------------------------

    def receive_end(self) -> Sentinel:
        """Handle the end of ``run``: end the agents' episodes, or raise the error of ``run``.

        After a refused decision, raise the error of that.
        """
        self.running = not self.driver.idle  # it still runs after a refused decision
        self._failed_in_model = True  # where the next line raises
        result = self.driver.take_outcome()
        self._failed_in_model = False
        self.finish(truncated=result is TRUNCATED)
        return WAIT

    def finish(self, *, truncated: bool) -> None:
        """End the episode of all live agents."""
        self.pending = None
        for agent in self.agents.values():
            self.latest = agent
            agent.conclude()
        if self.team is not None:
            self.earned = self.team.settle(self.agents.values())
        self.outcome = Outcome.TRUNCATED if truncated else Outcome.TERMINATED
        self.tape.end()
        session = self.session()
        if session is not None and (self.plan.named_agents or self.plan.removers):
            session.unmatched_names.check(self, None if self.running else self.called)

    # -- errors, and the end by a close -----------------------------------------------------------

    def annotate(self, error: BaseException, hint: str = "") -> None:
        """Add a note to an error: the decision and the agent where it arose."""
        agent = self.latest
        if agent is None:
            where = "before the first decision"
        elif self._failed_in_model:
            where = f"in the model, after decision {self.answered}, {agent.place}"
        else:
            where = f"at decision {self.answered + 1}, {agent.place}"
        annotate(error, f"simenv_marl: {where}; seed {self.seed}{hint}")

    def fail(self, error: BaseException) -> None:
        """End the episode because of an error, and note in the error where it arose."""
        self.pending = None  # first, because the next call may come to the end of the stack
        if self.outcome is RUNNING:
            self.outcome = Outcome.STOPPED
        self.annotate(error, self.tape.end(error))
        try:
            problems = self._unwind()
        except Warning as warning:  # warnings may be errors; this one must not replace the error
            problems = [warning]
        for problem in problems:
            also = f"simenv_marl: unwinding the simulation raised {short_repr(problem)} as well"
            annotate(error, also)
        clear_frames(error)

    def is_suspended(self) -> bool:
        """Return whether the simulation must be unwound before the episode ends.

        Raises:
            ReentrancyError: The simulation is moving.
        """
        if self.running and (self.driver.lost or self.driver.given_up is not None):
            self.running = False
            self.stop()
        if self.pending is None and not self.over:
            raise self.refusal()
        return self.running

    def close(self) -> None:
        """Unwind the simulation if it is suspended, in its context. Answer no decision."""
        if self.running:
            for problem in self._unwind():
                self.annotate(problem)
                raise problem
        self.stop()

    def _unwind(self) -> list[BaseException]:
        """Unwind the simulation if it is suspended. Return the errors that it raised."""
        if self.driver.given_up is not None:  # a fork has inherited it
            self.running = False
        if not self.running:
            self.stop()
            return []
        before = self.outcome
        self.pending = None
        self.outcome = RUNNING  # it moves until it is unwound
        problems: list[BaseException] = []
        try:
            stop = optional_method(self.simulation, "stop")
            try:
                if stop is not None:
                    stop()
            except BaseException as error:
                problems.append(error)
            problems += self.driver.unwind()
            self.running = False
        finally:
            self.outcome = Outcome.STOPPED if before is RUNNING else before
        if self.driver.given_up is not None:
            self._fault = f"{type(self.simulation).__name__} {self.driver.given_up}."
            warn_user(self._fault, ResourceWarning)
        return problems
