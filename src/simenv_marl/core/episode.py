"""One episode of one simulation. This module alone determines the order of events.

An episode::

    RESETTING ----> MOVING <----> PENDING ----> OVER  (terminated, truncated, failed or closed)
                    the simulation runs,        nothing happens any more
                    or mappings and policies do

A decision::

    simulation                     episode, on its user's stack
    ----------                     ----------------------------
    calls a decision function
      suspended          ------>   ``arise``: if the rule decides, back to the simulation
                                   ``settle``: reward of the previous action (the first of an episode is dropped),
                                     legal actions, info, observation
                                   if a policy answers, back to the simulation with its action
                                   else PENDING, until the user answers
                                   ``answer``: check the action and map it to the decision
      returns            <------   ``resume``
    returns from ``run``
      ended              ------>   last reward and last observation of each agent; OVER

Views differ in who answers, and in when agents are settled (``When``). They share the code of all steps above.
While an episode is RESETTING or MOVING on the user's side, decision functions run their rule.
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
"""How many actions are kept for a replay. The limit keeps a simulation that never ends from filling the memory."""

LOST: Final[deque[Any]] = deque(maxlen=0)
"""The tape of an episode that has more actions or is never replayed. It keeps nothing."""

MISSING: Final = Sentinel("MISSING")


class When(Enum):
    """When the agents of an episode are rewarded and observed.

    Attributes:
        DECISION: Each agent when its decision arises (AEC and single views).
        RETURN: All live agents when a step returns (parallel and joint views).
        NEVER: Agents are not rewarded, and are observed only when a policy is asked (``simulate``, ``simulate_many``).
    """

    DECISION = "decision"
    RETURN = "return"
    NEVER = "never"


class Episode(Ending):
    """One run of a simulation, from its reset to its end. It has no reference to the environment.

    Attributes:
        tape: The answers of the user and of policies, in order. ``LOST`` if they are not kept.
        most_steps: The number of steps after which the episode is truncated; infinity without ``max_steps``.
        limit: The next number of turns at which ``_come_to_limit`` is called.
        last_time: The time at the latest step of a joint view.
        skips: Whether a decision with one legal action is answered with it.
        stalled: The number of rounds without an action for the pending agent since the simulation last moved.
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
            plan: The plan of the environment.
            simulation: The simulation.
            driver: The simulation's driver. Its next ``resume`` begins ``run``.
            seed: The seed of the simulation's reset.
            when: When agents are settled.
            around: The generators and the claim of the environment's context: see ``at_work``.
            script: The tape of another episode to replay. None: this is an ordinary episode.
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
        self._left: dict[str, Any] = {}  # the unused actions of the current round

    def begin(self) -> None:
        """Run the simulation to its first decision.

        Raises:
            NoDecisionError: There is no decision for the environment's user.
            BaseException: Any error of the model, a mapping or a policy.
        """
        with self.at_work():
            try:
                self.go_on(None)
                if not self.over and self.when is not When.NEVER and self.consulted is None:
                    self._return(settle=self.when is When.RETURN)
                    for agent in self.agents.values() if self.skips else ():
                        agent.reward, agent.carried = 0.0, agent.carried + agent.reward  # ``reset`` returns no rewards
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
        """Answer the pending decision and run to the user's next decision, or to the end.

        Args:
            action: An action of the pending agent, or ``RULE``.
            entered: Whether the environment's context is already entered.

        Raises:
            InvalidActionError: The action is not legal. Nothing has moved.
            EpisodeOverError, ReentrancyError: No decision is pending.
            BaseException: Any error of the model, a mapping or a policy.
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
                check = agent.point.check  # a local variable: calling the attribute directly is slower
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
        """Turn an agent's action into the reply to the simulation, and release what only this decision needed.

        Args:
            agent: The agent whose decision has arisen.
            action: A checked action, or ``RULE``, which is its own reply.
            turn: Whether the user answers the pending decision.

        Returns:
            The reply, for the driver's ``resume``.

        Raises:
            BaseException: Any error of a mapping. The decision stays pending.
        """
        try:
            self.pending = None  # so that an action from inside a mapping is refused
            kept = action
            if agent.choices is not None:
                reply = agent.choose(action)
            elif action is RULE:
                reply = action
            else:
                if type(action) is not int and turn:
                    kept = duplicate(action)  # before a mapping can change it
                convert = agent.point.convert  # a local variable: calling the attribute directly is slower
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
        """Drop a tape that has grown too long, and prepare the truncation if this was the last step."""
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
        """Resume the simulation with a reply, and run to the user's next decision, or to the end.

        Raises:
            BaseException: Any error of the model, a mapping or a policy. The caller must then call ``fail``.
        """
        while True:
            resume = self.driver.resume  # a local variable: calling the attribute directly is slower
            event, args, kwargs = resume(reply)
            reply = event.arise(self, args, kwargs)
            if reply is WAIT:
                return
            event = args = kwargs = None  # so that they keep nothing alive that the model frees meanwhile

    def play(self, actions: Mapping[str, Any], entered: bool = False) -> None:
        """Play a round: use each agent's action once, up to the first decision without an action, or to the end.

        Then settle all live agents.

        Args:
            actions: An action, or ``RULE``, for each agent's name.
            entered: Whether the environment's context is already entered.

        Raises:
            UnknownAgentError: An action is for an agent that is not live. Nothing has moved.
            InvalidActionError: An action is not legal. Nothing has moved. An action that is legal now and illegal at
                its turn counts as missing.
            EpisodeOverError, ReentrancyError: No decision is pending.
            BaseException: Any error of the model, a mapping or a policy.
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
            if not self.over and self.consulted is None:  # ``consulted`` is set where a replay ends
                self._return(truncate=bool(actions) and self.turns == self.most_steps)
        except BaseException as error:
            self.fail(error)
            raise
        if self.stalled == MANY_ROUNDS:
            self.warn_of_standstill()

    def dispatch(self, point: BoundPoint, name: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Handle a decision of an agent that is not yet known at this point as an agent of the user's.

        Returns:
            The reply to the simulation, or ``WAIT``.

        Raises:
            AgentError: The name is not a string, or belongs to another point, or to an agent that has ended.
            BaseException: Any error of a mapping or a policy.
        """
        if name is None:
            return RULE
        self.latest = agent = self.agent_for(point, name)
        if agent.name in self.answered:
            return self.consult(agent, args, kwargs)
        return agent.arise(self, args, kwargs)

    def consult(self, agent: Agent, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Let a policy answer a decision.

        Returns:
            The reply to the simulation; ``WAIT`` if the policy is asked later, for many decisions at once.

        Raises:
            InvalidActionError: The policy's action is not legal.
            BaseException: Any error of a mapping or the policy.
        """
        if self.done:  # else the simulation might run for ever without a decision for the user
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
        """Turn a branch into a single view of the consulted agent: reward it from now on, and wait for it only."""
        if list(self.agents.values()) != [agent]:
            self.most_steps = self.limit = inf  # ``max_steps`` counts the steps of other agents
        super().single_out(agent)
        self.when, self.decide = When.DECISION, Episode._decide_unless_forced if self.skips else None
        self.begun, self.untold, self._left, agent.asked = True, [], {}, True
        if not agent.decided:  # drop the first value of the reward mapping, which rewards no action
            with self.at_work():
                agent.settle(agent, agent.arguments(), agent.kwargs, observe=False)
        self.consulted, self.pending = None, agent

    # -- decisions --------------------------------------------------------------------------------

    def _decide_too_late(self, agent: Agent, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Truncate the episode, because the user has taken the last step."""
        self.finish(truncated=True)
        return WAIT

    def _decide_unless_forced(self, agent: Agent, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Settle an agent. Its rewards add up until it has more than one legal action."""
        agent.settle_again(agent, args, kwargs)
        agent.reward, agent.carried = agent.reward + agent.carried, 0.0
        forced = self._forced(agent)
        if forced is not None or not agent.asked:  # ``reset`` returns no rewards either
            agent.reward, agent.carried = 0.0, agent.reward
        if forced is not None:
            return self._answer_forced(agent, forced)
        agent.asked = True
        self.pending = agent
        return WAIT

    def _answer_forced(self, agent: Agent, action: Any) -> Any:
        """Answer with the only legal action. The elapsed time adds up until the agent is asked, as rewards do."""
        before = agent.answered_at
        reply = self.answer(agent, action, False)
        if before is not None:
            agent.answered_at = before
        return reply

    def _forced(self, agent: Agent) -> Any:
        """The only legal action of an agent; None if it has several."""
        return only_choice(agent.point.definition.action_space, agent.mask)

    def _decide_in_round(self, agent: Agent, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Answer a decision with the agent's action of this round, or wait for the next round."""
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
        if not agent.decided:  # it acts before it was ever settled
            agent.settle(agent, agent.arguments(), agent.kwargs, observe=False)
        return self.answer(agent, action, False)

    def _return(self, *, settle: bool = True, truncate: bool = False) -> None:
        """Reward and observe the agents when a step or a reset returns.

        Args:
            settle: Whether all live agents are rewarded and observed. If False, only agents that ``expected_calls``
                announces, and that have not decided, are observed.
            truncate: Whether the episode ends here.
        """
        following, self.pending = self.pending, None  # so that an action from inside a mapping is refused
        announced = {}
        for agent, call in self.announced():
            if agent is not following and agent not in announced:  # the first of several calls counts
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
                agent.choices = None  # ``legal`` returns them again when the agent decides
        self.pending = following
