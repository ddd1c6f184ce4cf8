"""One episode of one simulation: the one place that knows what happens when.

An episode::

    RESETTING ----> MOVING <----> PENDING ----> OVER  (terminated, truncated, failed or closed)
                    the simulation runs,        nothing happens any more
                    or mappings and policies do

A decision::

    simulation                     episode, on its user's stack
    ----------                     ----------------------------
    calls a decision function
      suspended          ------>   ``arise``: who decides? the rule: back to the simulation
                                   ``settle``: reward of the action before (the first of an episode is dropped),
                                     legal actions, info, observation
                                   a policy answers: back to the simulation with its action
                                   else PENDING, until the user answers
                                   ``answer``: the action checked, mapped to the decision
      returns            <------   ``resume``
    returns from ``run``
      ended              ------>   of each agent: last reward, last observation; OVER

Views differ in who answers, and in when agents are settled (``When``); each of the steps above is written once.
While an episode is RESETTING or MOVING on its user's side, decision functions that are called run their rule.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from enum import Enum
from math import inf
from typing import Any, Final

from greenlet import getcurrent

from ..errors import (
    NoDecisionError,
)
from ..hooks.stacks import EVALUATING
from ..simulation import RULE, Sentinel
from .actions import ILLEGAL, only_choice
from .agent import WAIT, Agent
from .bound import BoundPoint
from .contexts import Claim
from .ending import MANY_ROUNDS, Ending
from .plan import Plan
from .rng import GlobalRandom
from .spaces import duplicate
from .switch import BaseDriver

LONGEST_TAPE: Final = 200_000
"""How many actions are kept for a replay. A simulation that never ends is not to fill the memory."""

LOST: Final[deque[Any]] = deque(maxlen=0)
"""The tape of an episode with more actions, and of one that is not going to be replayed: it keeps nothing."""

MISSING: Final = Sentinel("MISSING")


class When(Enum):
    """When the agents of an episode are rewarded and observed.

    Attributes:
        DECISION: The one that decides, as its decision arises (AEC and single views).
        RETURN: All that live, when a step returns (parallel and joint views).
        NEVER: Agents are only observed, as a policy is asked (``simulate``, ``simulate_many``).
    """

    DECISION = "decision"
    RETURN = "return"
    NEVER = "never"


class Episode(Ending):
    """One run of a simulation, from its reset to its end. Holds nothing of the environment.

    Attributes:
        tape: What the user and policies have answered, in that order; ``LOST`` where that is not kept.
        most_steps: The step with which the episode is truncated; infinity where none is.
        limit: The next number of turns at which something is to be seen to: see ``_come_to_limit``.
        last_time: The time at the latest step of a joint view.
        skips: Whether decisions with one legal action are answered with it.
        stalled: How many rounds have had no action for the pending agent since the simulation last moved.
    """

    __slots__ = (
        "_left", "decide", "last_time", "limit", "most_steps", "skips", "stalled", "tape", "when",
    )  # fmt: skip

    def __init__(
        self,
        plan: Plan,
        simulation: Any,
        driver: BaseDriver,
        seed: int,
        when: When,
        around: tuple[GlobalRandom | None, Claim | None],
        script: Iterable[Any] | None = None,
    ) -> None:
        """Prepare an episode of a simulation that has been reset.

        Args:
            plan: What the environment is made of.
            simulation: The simulation.
            driver: Its stack, on which the next ``resume`` begins its ``run``.
            seed: What it was reset with.
            when: When agents are settled.
            around: What ``at_work`` is to put around all that runs for the environment.
            script: The tape of another episode, which is to be replayed; None: it is an episode of its own.
        """
        super().__init__(plan, simulation, driver, seed, around)
        self.when = when
        self.most_steps = plan.options.max_steps or inf
        self.limit = min(self.most_steps, LONGEST_TAPE + 1)
        self.skips, self.stalled = plan.options.skip_forced, 0
        self.decide: Callable[..., Any] | None = None
        if when is When.RETURN:
            self.decide = Episode._decide_in_round
        elif self.skips:
            self.decide = Episode._decide_unless_forced
        self.last_time: float | None = None
        self.tape: Any = LOST if plan.unanswered and not plan.looked_into else []
        self.script = None if script is None else deque(script)
        self._left: dict[str, Any] = {}  # the actions of a round that are not used yet

    def begin(self) -> None:
        """Run the simulation to its first decision.

        Raises:
            NoDecisionError: There is no decision for the environment's user.
            BaseException: Whatever the model, a mapping or a policy raises.
        """
        with self.at_work():
            try:
                self.go_on(None)
                if not self.over and self.when is not When.NEVER and self.consulted is None:
                    self._return(settle=self.when is When.RETURN)
                    for agent in self.agents.values() if self.skips else ():
                        agent.reward, agent.carried = 0.0, agent.carried + agent.reward  # a reset tells no rewards
                    self.untold = self.just_ended if self.skips else []
                self.begun = True
            except BaseException as error:
                self.fail(error)
                raise
        if self.pending is None and not self._plan.unanswered:
            self.unheard = self.skips and any(agent.decided for agent in (*self.agents.values(), *self.just_ended))
            if self.unheard:
                return
            raise NoDecisionError(self.without_decision())

    # -- answers ----------------------------------------------------------------------------------

    def step(self, action: Any, entered: bool = False) -> None:
        """Answer the pending decision and run to the next one that the user is to answer, or to the end.

        Args:
            action: An action of the pending agent, or ``RULE``.
            entered: Whether it is made at work already.

        Raises:
            InvalidActionError: The action is not legal. Nothing has moved.
            EpisodeOverError, ReentrancyError: No decision is pending.
            BaseException: Whatever the model, a mapping or a policy raises.
        """
        agent = self.pending
        if agent is None:
            self._hear()
            return
        if not entered and (getcurrent() is not self.driver.caller or EVALUATING or self.plugins is not None):
            self._enter(Episode.step, action)
            return
        try:
            if action is not RULE:
                check = agent.point.check  # fetched before it is called: calling it at its attribute is slower
                legal = check(action)
                if legal is ILLEGAL or agent.mask is not None:
                    legal = agent.point.checked(action, agent.name, agent.mask)
                action = legal
            self.go_on(self.answer(agent, action))
        except BaseException as error:
            if self.pending is None:
                self.fail(error)
            else:  # nothing has moved
                self.annotate(error)
            raise

    def answer(self, agent: Agent, action: Any, turn: bool = True) -> Any:
        """Turn an agent's action into the reply that the simulation gets, and let go of what only the decision needed.

        Args:
            agent: The agent, whose decision has arisen.
            action: An action that was checked, or ``RULE``, which is its own reply.
            turn: Whether it answers the pending decision.

        Returns:
            The reply, for the driver's ``resume``.

        Raises:
            BaseException: Whatever a mapping raises. The decision stays pending.
        """
        try:
            self.pending = None  # while mappings run, an action of theirs is refused
            kept = action
            if agent.choices is not None:
                reply = agent.choose(action)
            elif action is RULE:
                reply = action
            else:
                if type(action) is not int and turn:
                    kept = duplicate(action)  # before a mapping can change it
                convert = agent.point.convert  # fetched before it is called: calling it at its attribute is slower
                reply = convert(action)
        except BaseException:
            if turn:
                self.pending = agent
            raise
        agent.answered_at = agent.now
        if turn:
            self.turns = turns = self.turns + 1
            self.tape.append(kept)
            if turns == self.limit:
                self._come_to_limit()
        return reply

    def _come_to_limit(self) -> None:
        """See to the tape, which is not to grow for ever, and to the last step."""
        if len(self.tape) > LONGEST_TAPE:
            self.tape = LOST
        self.limit = self.most_steps
        if self.turns == self.limit:
            self.decide = Episode._decide_too_late

    def _keep(self, answer: Any) -> None:
        """Keep an answer for a replay."""
        tape = self.tape
        if len(tape) >= LONGEST_TAPE:
            tape = self.tape = LOST
        tape.append(answer)

    def go_on(self, reply: Any) -> None:
        """Let the simulation go on with a reply, up to the next decision that the user is to answer, or to the end.

        Raises:
            BaseException: Whatever the model, a mapping or a policy raises. The episode is then to ``fail``.
        """
        while True:
            resume = self.driver.resume  # fetched before it is called: calling it at its attribute is slower
            event, args, kwargs = resume(reply)
            reply = event.arise(self, args, kwargs)
            if reply is WAIT:
                return
            event = args = kwargs = None  # else they would keep alive what the model lets go meanwhile

    def play(self, actions: Mapping[str, Any], entered: bool = False) -> None:
        """Play a round: answer decisions, each agent's once, up to the first whose action is missing, or to the end.

        Then all live agents are settled.

        Args:
            actions: By agent: an action, or ``RULE``.
            entered: Whether it is made at work already.

        Raises:
            UnknownAgentError: An action is for an agent that does not live. Nothing has moved.
            InvalidActionError: An action is not legal. Nothing has moved. One that only becomes illegal by
                its turn counts as missing.
            EpisodeOverError, ReentrancyError: No decision is pending.
            BaseException: Whatever the model, a mapping or a policy raises.
        """
        if self.pending is None:
            self._hear()
            return
        if not entered and (getcurrent() is not self.driver.caller or EVALUATING or self.plugins is not None):
            self._enter(Episode.play, actions)
            return
        left = self.check(actions)
        pending, self.pending = self.pending, None
        assert pending is not None
        try:
            self._keep({name: part if type(part) is int else duplicate(part) for name, part in left.items()})
            self.turns += bool(actions)
            for agent in (*self.agents.values(), *self.just_ended):
                agent.acted = False
            self.just_ended = self.untold
            self.untold = []
            self._left = left
            reply = self._answer_in_round(pending)
            if reply is WAIT:
                self.stalled += 1
            else:
                self.stalled = 0
                self.go_on(reply)
            if not self.over and self.consulted is None:  # else a replay has come to where the other episode stands
                self._return(truncate=bool(actions) and self.turns == self.most_steps)
        except BaseException as error:
            self.fail(error)
            raise
        if self.stalled == MANY_ROUNDS:
            self.warn_of_standstill()

    def dispatch(self, point: BoundPoint, name: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """See to a decision of an agent that was not met at this point as one of the user's.

        Returns:
            The reply to the simulation, or ``WAIT``.

        Raises:
            AgentError: The name is none, or belongs to another point, or to an agent that has ended.
            BaseException: Whatever a mapping or a policy raises.
        """
        if name is None:
            return RULE
        self.latest = agent = self.agent_for(point, name)
        if agent.name in self.answered:
            return self.consult(agent, args, kwargs)
        return agent.arise(self, args, kwargs)

    def consult(self, agent: Agent, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Have a policy answer.

        Returns:
            The reply to the simulation; ``WAIT`` where the policy is asked later, for many decisions at once.

        Raises:
            InvalidActionError: The policy's action is not legal.
            BaseException: Whatever a mapping or the policy raises.
        """
        if self.done:  # the simulation may go on for ever without a decision of its user's
            self.finish(truncated=False)
            return WAIT
        if agent.policy is RULE:
            return RULE
        agent.settle(agent, args, kwargs, False)
        forced = self._forced(agent) if self.skips else None
        if forced is not None:
            return self._answer_forced(agent, forced)
        if self.script is None and not (agent.deferred or agent.looks):
            action = agent.policy(agent.observation, agent.info)
        else:
            action = self.ask(agent, args, kwargs)
            if action is WAIT:
                self.pending = agent
                return WAIT
        self._keep(duplicate(action))
        if action is not RULE:
            action = agent.point.checked(action, agent.name, agent.mask)
        return self.answer(agent, action, False)

    def single_out(self, agent: Agent) -> None:
        """Wait for the agent alone that is consulted; it is rewarded from now on, and ends as in a single view."""
        if list(self.agents.values()) != [agent]:
            self.most_steps = self.limit = inf  # what counts are the steps of others
        super().single_out(agent)
        self.when, self.decide = When.DECISION, Episode._decide_unless_forced if self.skips else None
        self.begun, self.untold, self._left, agent.asked = True, [], {}, True
        if not agent.decided:  # nothing was done yet that could be rewarded
            with self.at_work():
                agent.settle(agent, agent.arguments(), agent.kwargs, observe=False)
        self.consulted, self.pending = None, agent

    # -- decisions --------------------------------------------------------------------------------

    def _decide_too_late(self, agent: Agent, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Truncate the episode: the user has taken the last step."""
        self.finish(truncated=True)
        return WAIT

    def _decide_unless_forced(self, agent: Agent, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Settle an agent, whose rewards add up until it has a choice."""
        agent.settle_again(agent, args, kwargs)
        agent.reward, agent.carried = agent.reward + agent.carried, 0.0
        forced = self._forced(agent)
        if forced is not None or not agent.asked:  # a reset, too, tells no rewards
            agent.reward, agent.carried = 0.0, agent.reward
        if forced is not None:
            return self._answer_forced(agent, forced)
        agent.asked = True
        self.pending = agent
        return WAIT

    def _answer_forced(self, agent: Agent, action: Any) -> Any:
        """Answer with the one legal action; as rewards do, the elapsed time adds up until the agent is asked."""
        before = agent.answered_at
        reply = self.answer(agent, action, False)
        if before is not None:
            agent.answered_at = before
        return reply

    def _forced(self, agent: Agent) -> Any:
        """The one legal action of an agent; None where it has a choice."""
        return only_choice(agent.point.definition.action_space, agent.mask)

    def _decide_in_round(self, agent: Agent, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Answer a decision of an agent of the user's with its action of the round, or wait for the next round."""
        if agent.point.legal is not None:
            agent.mask, agent.choices = agent.point.legal(args, kwargs)
        if self.clock is not None:
            agent.now = float(self.clock())
        return self._answer_in_round(agent)

    def _answer_in_round(self, agent: Agent) -> Any:
        action = self._forced(agent) if self.skips else None
        if action is None:
            action = self._left.pop(agent.name, MISSING)
            mask = agent.mask
            if action is MISSING or (mask is not None and action is not RULE and not agent.point.allows(mask, action)):
                self.pending = agent
                return WAIT
            agent.acted = True
        self.latest = agent
        if not agent.decided:  # it was never settled, and acts at once
            agent.settle(agent, agent.arguments(), agent.kwargs, observe=False)
        return self.answer(agent, action, False)

    def _return(self, *, settle: bool = True, truncate: bool = False) -> None:
        """See to the agents that wait for their turns, as a step or a reset returns.

        Args:
            settle: Whether live agents are rewarded and observed; else those that are announced are observed.
            truncate: Whether the episode ends here.
        """
        following, self.pending = self.pending, None  # while mappings run, an action of theirs is refused
        announced = {}
        for agent, call in self.announced():
            if agent is not following and agent not in announced:  # of several calls the next one counts
                announced[agent] = call
                if (settle or not agent.decided) and agent.keep(call, {}):
                    self.remember(agent, call[0])
        if truncate:
            self.finish(truncated=True)
            return
        for agent in self.agents.values():
            args = agent.arguments()
            if args is None:
                agent.unsee()
                continue
            self.latest = agent
            if settle:
                agent.settle_again(agent, args, agent.kwargs)
                if self.skips:
                    agent.reward, agent.carried = agent.reward + agent.carried, 0.0
            elif agent in announced and not agent.decided:
                agent.settle(agent, args, agent.kwargs, reward=False)
            if agent.choices is not None and agent is not following:
                agent.choices = None  # they are asked for again when it decides
        self.pending = following
