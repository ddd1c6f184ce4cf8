"""One agent of an episode: its reward, observation, mask and info."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from greenlet import getcurrent

from ...errors import AgentError, InvalidActionError, MaskError
from ...hooks.hook import Hook
from ...hooks.stacks import DIFFERENCES, EVALUATING
from ...plugins import Plugins
from ...simulation import RULE, Action, Model, Observation
from ..plans.point import Args, Kwargs, Point, Policy
from ..plans.policies import Info, Where
from ..switching.driver import AnyHandler
from ..values.actions import MASK, Mask, only_choice
from ..values.clock import Clock
from ..values.rewards import checked_reward
from ..values.spaces import duplicate
from .arguments import Arguments, freed, weaken
from .decision import Decision


class DecisionHandler(AnyHandler, Protocol):
    """The handler of the decisions at a point, as its agents use it."""

    @property
    def point(self) -> Point:
        """The decision point."""

    def warn_of_several(self, agent: str) -> str:
        """Warn once that several objects decide under the name of one agent. Return the text."""

    def warn_of_gone(self, gone: set[int | str], effect: str) -> str:
        """Warn once that the model has freed arguments that mappings take. Return the text."""


class RunningEpisode(Protocol):
    """The episode, as its agents and the handlers of its events use it."""

    is_plain: bool
    agents: dict[str, Agent]
    others: dict[str, Agent]
    ended: dict[str, Agent]
    called: set[Hook]
    moved: set[str]

    def decide(self, agent: Agent, args: Args, kwargs: Kwargs) -> Model:
        """Handle a decision where more than an update is due."""

    def ask(self, agent: Agent, args: Args, kwargs: Kwargs) -> Model:
        """Let the policy of an agent answer a decision."""

    def agent_for(self, handler: DecisionHandler, name: Model) -> Agent:
        """Return the agent with a name that decides at a point."""

    def end_agent(self, agent: Agent) -> None:
        """End the episode of one agent."""

    def note_first_decision(self) -> None:
        """Note that an agent decides for the first time."""

    def finish(self, *, truncated: bool) -> None:
        """End the episode of all live agents."""

    def blame(self, agent: Agent) -> None:
        """Note the agent that notes of errors name."""


@dataclass(eq=False, repr=False, slots=True)
class Agent:
    """One agent of an episode.

    It handles the decisions at its point if the point has no other agent.

    Attributes:
        name: The name.
        handler: The handler of the decisions at its point.
        point: The decision point.
        policy: The policy that answers its decisions. None: the environment's user answers them.
        delegated: Whether its decisions do not wait for the user, because a policy answers them or
            because the agent has ended.
        arguments: The arguments of its latest decision.
        clock: The clock of the episode. None if the simulation has no time.
        plugins: The handlers that take part in its mappings.
        memory: Values of this agent in this episode: of differences, and of policies.
        reward: The reward of its previous action, as of its latest decision or its end.
        cost: The cost of its previous action, in the same way. None without ``cost_mapping``.
        raw_observation: The latest observation, unless the user may have changed it.
        info: The latest info.
        mask: The mask of the pending decision. None if all actions are legal.
        choices: The choices of the pending decision. None without ``choices=``.
        offered: The choices of the latest decision, held weakly, until the rule has chosen.
        rule_action: The action that corresponds to the rule's latest decision. None if unknown.
        noted_action: The same until an info contains it. None where infos do not.
        decided: Whether the reward mapping was called in this episode. Its first value is dropped.
        ended: Whether its episode has ended before the simulation's.
        present: Whether the latest info comes from an observation.
        asked: Whether the user or a policy was asked for an action, where forced moves are skipped.
        answered: The number of its decisions that were answered.
        answered_at: The time of the latest answered decision.
        now: The time of the latest decision.
        counts: The numbers that policies have counted in its decisions, by name.
        fault: Why its rewards are wrong. Empty as far as is known.
        applying: How many of its calls of ``apply`` run, on the simulation's side.
    """

    name: str
    handler: DecisionHandler
    policy: Policy
    delegated: bool
    clock: Clock | None
    plugins: Plugins | None
    point: Point = field(init=False)
    arguments: Arguments = field(init=False)
    memory: dict[Any, Any] = field(default_factory=dict)
    reward: float = 0.0
    cost: float | None = None
    _carried: float = 0.0  # the sum of the rewards of forced moves
    _carried_cost: float = 0.0
    raw_observation: Observation = None
    # The numbers of an array that the user has. Empty once the library has read it.
    _numbers: bytes | None = None
    info: Info = field(default_factory=dict)
    mask: Mask | None = None
    choices: list[Model] | None = None
    offered: list[Model] | None = None
    rule_action: Action = None
    noted_action: Action = None
    decided: bool = False
    _is_quick: bool = False  # an update needs no more than an observation and a reward
    ended: bool = False
    present: bool = False
    asked: bool = False
    answered: int = 0
    answered_at: float | None = None
    now: float | None = None
    counts: dict[str, float] = field(default_factory=dict)
    fault: str = ""
    applying: int = 0

    def __post_init__(self) -> None:
        self.point = self.handler.point
        self.arguments = Arguments(self.point)

    # -- decisions --------------------------------------------------------------------------------

    reports_itself = False

    @property
    def deliver(self) -> Callable[..., Model] | None:
        """Turns a reply into the value of a call, on the simulation's side."""
        return self.point.deliver

    @property
    def report(self) -> AnyHandler | None:
        """Handles the decisions of the rule."""
        return self.handler.report

    def handle(self, episode: RunningEpisode, args: Args, kwargs: Kwargs) -> Model:
        """Handle a decision. Return this agent if it waits for the user, else the reply."""
        if self.applying:
            return RULE
        if self.delegated:
            return episode.ask(self, args, kwargs)
        arguments = self.arguments
        first = arguments.first  # a variable, because calling an attribute is slower
        if not (arguments.is_single and args and first() is args[0]):
            self.keep(args, kwargs)
        if not episode.is_plain:
            return episode.decide(self, args, kwargs)
        try:
            if DIFFERENCES or not self._is_quick:
                if not self.decided:
                    episode.note_first_decision()
                self.update(args, kwargs)
                return self
            # The same as in ``update``, because its calls take 5 % of a decision.
            point = self.point
            pay = point.reward_mapping
            observe = point.observation_mapping
            cast = point.cast
            reward = pay(*args, **kwargs) if kwargs else pay(*args)
            if type(reward) is not float or reward - reward != 0.0:
                reward = checked_reward(self.name, reward)
            self.reward = reward
            if self.clock is None:
                self.info = {}
            else:
                self.read_clock()
            self.raw_observation = cast(observe(*args, **kwargs) if kwargs else observe(*args))
            self._numbers = None
        except BaseException:
            episode.blame(self)
            raise
        return self

    def move_to(self, handler: DecisionHandler) -> None:
        """Let it decide at another point from now on."""
        self.raw_observation = self.observation  # read in the space of the point so far
        self.handler = handler
        self.point = point = handler.point
        self.arguments = Arguments(point)
        self.mask = None
        self.choices = None
        self._is_quick = self.decided and point.is_quick

    def refusal(self) -> AgentError:
        """Make the error for a decision after the end of its episode."""
        return AgentError(
            f"the agent {self.name!r} decides at {self.point.hook.name} after its end; agent= must"
            " name each entity differently, and removed_by= or end_agent() must end an agent only"
            " when its entity is gone"
        )

    @property
    def place(self) -> str:
        """Its name and its decision point, for the notes of errors."""
        return f"of {self.name!r} at {self.point.hook.name}"

    def validate(self, action: Action) -> Action:
        """Validate an action for the pending decision: see ``Point.validate``."""
        return self.point.validate(action, self.name, self.mask)

    def allows(self, action: Action) -> bool:
        """Return whether an action is legal for the pending decision."""
        try:
            self.validate(action)
        except InvalidActionError:
            return False
        return True

    def only_action(self) -> Action:
        """Return the only legal action of the pending decision. None if there are several."""
        return only_choice(self.point.definition.action_space, self.mask)

    def reply_to(self, action: Action, forced: bool = False) -> Model:
        """Turn a checked action, or ``RULE``, into the reply to the pending decision.

        ``forced``: it is the only legal action, so elapsed times add up to the next decision.
        """
        point = self.point
        reply: Model = action
        choices = self.choices
        if choices is not None:
            self.choices = None  # the others are forgotten
            if point.reports_rule:
                self.offered = [weaken(choice) for choice in choices]
            if action is not RULE:
                reply = [choices[action]]
        elif action is not RULE:
            convert = point.convert
            reply = convert(action)
        self.answered += 1
        if not forced:
            self.asked = True
            self.answered_at = self.now
        elif self.answered_at is None:
            self.answered_at = self.now
        return (self, reply) if point.applies and reply is not RULE else reply

    def reply_if_forced(self) -> Model:
        """Return the reply to a decision with one legal action, and carry its reward on.

        Return this agent if there are several.
        """
        forced = self.only_action()
        self.carry_reward(forced is not None or not self.asked)
        return self if forced is None else self.reply_to(forced, forced=True)

    def begin_apply(self) -> None:
        """Let the agent's calls run the rule, on the simulation's side."""
        self.applying += 1

    def end_apply(self) -> None:
        """Undo ``begin_apply``."""
        self.applying -= 1

    def count(self, **numbers: float) -> None:
        """Add numbers to its counts."""
        for name, number in numbers.items():
            self.counts[name] = self.counts.get(name, 0) + number

    def delegate(self, policy: Policy) -> None:
        """Let a policy answer from now on."""
        self.policy = policy
        self.delegated = True

    def take_over(self) -> None:
        """Let the environment's user answer from now on."""
        self.policy = None
        self.delegated = False
        self.asked = True

    def describe(self, seed: int, where: Where) -> Decision:
        """Describe the decision of the agent."""
        point = self.point
        args, kwargs = self.arguments.recall()
        return Decision(
            agent=self.name,
            point=point.hook.name,
            seed=seed,
            number=self.answered + 1,
            time=self.now,
            observation=duplicate(self.observation),
            action_space=point.definition.action_space,
            mask=None if self.mask is None else duplicate(self.mask),
            choices=None if self.choices is None else list(self.choices),
            action_labels=point.action_labels(self.choices, args, kwargs),
            observation_labels=point.observation_labels(args, kwargs),
            reward=self.reward,
            doc=point.hook.function.__doc__,
            question=point.question(args, kwargs),
            in_clone=where is not Where.USER,
            memory=self.memory,
            _agent=self,
            _display=lambda: point.display(*self.arguments.recall()),
        )

    # -- arguments --------------------------------------------------------------------------------

    def keep(self, args: Args, kwargs: Kwargs) -> None:
        """Hold the arguments of a decision."""
        arguments = self.arguments
        if args:
            before = arguments.first()
            if arguments.is_single and before is args[0]:
                return
            if self.point.expects_one and before is not None and before is not args[0]:
                self.note_several()
        arguments.store(args, kwargs)

    def note_several(self) -> None:
        """Note that it decides for several objects."""
        self.fault = self.handler.warn_of_several(self.name)

    # -- rewards and observations -----------------------------------------------------------------

    def update(
        self,
        args: Args,
        kwargs: Kwargs,
        *,
        reward: bool = True,
        observe: bool = True,
        asked: bool = True,
        last: bool = False,
    ) -> None:
        """Reward and observe the agent for the arguments of a call.

        Args:
            args: The positional arguments.
            kwargs: The keyword arguments.
            reward: Whether to reward the agent.
            observe: Whether to observe it.
            asked: Whether it must decide now.
            last: Whether its episode ends here.
        """
        here = getcurrent() if DIFFERENCES else None  # differences must know the agent
        before = None
        if here is not None:
            before = EVALUATING.get(here)
            EVALUATING[here] = self
        try:
            point = self.point
            rewards = self.decided
            if reward and rewards:
                self.reward = checked_reward(self.name, point.reward_mapping(*args, **kwargs))
            elif reward and not last:  # it has not acted yet, so this value rewards nothing
                point.reward_mapping(*args, **kwargs)
                self.decided = True
                self._is_quick = point.is_quick
            charge = point.cost_mapping
            if reward and self.decided and charge is not None:
                cost = checked_reward(self.name, charge(*args, **kwargs), "cost")
                self.cost = cost if rewards else 0.0
            if observe:
                self._observe(args, kwargs, asked)
            if self.cost is not None:
                self.info["cost"] = self.cost
        finally:
            if here is not None:
                # Without a function call, which fails at the recursion limit.
                if before is None:
                    del EVALUATING[here]
                else:
                    EVALUATING[here] = before

    def _observe(self, args: Args, kwargs: Kwargs, asked: bool) -> None:
        """Set the mask, the info and the observation for the arguments of a call."""
        point = self.point
        self.present = True
        if point.legal is not None:
            self._restrict(args, kwargs, asked)
        if self.clock is None:
            self.info = {}
        else:
            self.read_clock()
        mask = self.mask
        if mask is not None:
            self.info[MASK] = mask.copy() if type(mask) is np.ndarray else duplicate(mask)
        if self.noted_action is not None:
            self.info["rule_action"] = self.noted_action
            self.noted_action = None
        if point.masked_parts and mask is not None:
            self.observation = point.observe(args, kwargs, mask)
        else:
            self.observation = point.cast(point.observation_mapping(*args, **kwargs))

    def _restrict(self, args: Args, kwargs: Kwargs, asked: bool = True) -> None:
        """Set the mask and the choices. If it must not decide now, there may be no legal action."""
        legal: Any = self.point.legal
        try:
            self.mask, self.choices = legal(args, kwargs)
        except MaskError:
            if asked:
                raise
            self.mask = self.point.open_mask()
            self.choices = None

    def observe_again(self, args: Args, kwargs: Kwargs) -> None:
        """Set the mask, the choices and the time at a decision in a round, and nothing else."""
        if self.point.legal is not None:
            self._restrict(args, kwargs)
        if self.clock is not None:
            self.now = self.clock.read(None)["time"]

    def forget_choices(self) -> None:
        """Forget the choices of an agent that was observed before its decision."""
        self.choices = None

    def refresh(self, *, reward: bool = True, asked: bool = False, last: bool = False) -> None:
        """Reward and observe the agent for the arguments of its latest decision, at any later time.

        If a mapping takes an argument that the model has freed, 0.0 and the last observation stay.
        """
        arguments = self.arguments
        if arguments.is_single and self._is_quick and reward and not DIFFERENCES:
            entity = arguments.first()
            if entity is not None:
                # The same as in ``handle``, for the one argument that most mappings take.
                point = self.point
                pay = point.reward_mapping
                observe = point.observation_mapping
                cast = point.cast
                value = pay(entity)
                if type(value) is not float or value - value != 0.0:
                    value = checked_reward(self.name, value)
                self.reward = value
                if self.clock is None:
                    self.info = {}
                else:
                    self.read_clock()
                self.raw_observation = cast(observe(entity))
                self._numbers = None
                return
        if arguments.is_empty:
            self.clear_observation()
            return
        args, kwargs = arguments.recall()
        gone = freed(args, kwargs)
        unseen = gone | arguments.emptied(args, kwargs)
        if not unseen:
            self.update(args, kwargs, reward=reward, asked=asked, last=last)
            return
        point = self.point
        observes = not any(mapping.takes_any(unseen) for mapping in point.takes_for_observation)
        pays = not any(mapping.takes_any(gone) for mapping in point.takes_for_reward)
        if not observes:
            self.clear_observation()
        self.reward = 0.0
        if reward and not pays and self.decided:
            self.fault = self.handler.warn_of_gone(gone, "the reward is 0.0")
        elif gone and not observes and self.decided:
            self.handler.warn_of_gone(gone, "the last observation stays")
        if pays or observes:
            pays = reward and pays
            self.update(args, kwargs, reward=pays, observe=observes, asked=asked, last=last)

    def conclude(self) -> None:
        """End the agent's episode: give it its last reward and observation."""
        self.refresh(last=True)
        self.carry_reward(False)
        self.arguments = Arguments(self.point)
        self.answered_at = None

    def end(self) -> None:
        """Note that its episode has ended before the simulation's."""
        self.ended = True
        self.delegated = True

    def carry_reward(self, carry_on: bool) -> None:
        """Add the rewards and costs of forced moves. Carry them on where none are returned."""
        total = self.reward + self._carried
        self.reward = 0.0 if carry_on else total
        self._carried = total if carry_on else 0.0
        if self.cost is not None:
            total = self.cost + self._carried_cost
            self.cost = self.info["cost"] = 0.0 if carry_on else total
            self._carried_cost = total if carry_on else 0.0

    def reward_so_far(self) -> float:
        """In a branch, return the reward of its latest action by now."""
        self.refresh()
        return self.reward + self._carried

    def pay(self, reward: float) -> None:
        """Set the reward to the team's."""
        self.reward = reward

    # -- infos ------------------------------------------------------------------------------------

    def read_clock(self) -> None:
        """Note the time, in the info, too."""
        clock: Any = self.clock
        self.info = info = clock.read(self.answered_at)
        self.now = info["time"]

    def note_rule_action(self, action: Action, informs: bool) -> None:
        """Note the action that corresponds to the rule's decision."""
        self.rule_action = action
        self.noted_action = action if informs else None
        self.offered = None

    def take_rule_action(self) -> Action:
        """Return the action that corresponds to the rule's latest decision, and forget it."""
        action, self.rule_action = self.rule_action, None
        return action

    def clear_observation(self, *, forget: bool = False) -> None:
        """Set the reward and the cost to 0.0, and the info to one without an observation.

        ``forget``: whether the last observation goes. Else it stays.
        """
        if forget:
            self.observation = None
        self.reward = 0.0
        self.present = False
        if self.clock is None:
            self.info = {}
        else:
            self.read_clock()
        if self.cost is not None:
            self.cost = self.info["cost"] = 0.0
        if self.point.legal is not None:
            self.info[MASK] = self.point.open_mask()

    def load(self, fields: dict[str, Any]) -> None:
        """Take over fields of the agent in the process of a clone."""
        for name, value in fields.items():
            setattr(self, name, value)

    def take_info(self) -> Info:
        """Return the info, which a policy may change, and forget it."""
        info, self.info = self.info, {}
        return info

    # -- observations -----------------------------------------------------------------------------

    @property
    def observation(self) -> Observation:
        """The latest observation, cast to its space. None before the first one."""
        numbers = self._numbers
        self._numbers = b""
        if numbers:  # the user may have changed the array
            space: Any = self.point.definition.observation_space
            self.raw_observation = np.ndarray(space.shape, space.dtype, numbers).copy()
        return self.raw_observation

    @observation.setter
    def observation(self, observation: Observation) -> None:
        self.raw_observation = observation
        self._numbers = None

    def hand_out(self) -> Observation:
        """Return the latest observation to the user, who may change it. A blank before the first.

        An array is handed out once without a copy. The bytes of its numbers take a third of the
        time.
        """
        observation = self.raw_observation
        if observation is None:
            return self.point.blank()
        if self._numbers is None and self.point.observes_arrays:
            self._numbers = observation.tobytes()
            return observation
        return duplicate(self.observation)
