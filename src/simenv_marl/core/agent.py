"""One agent of an episode: how its decisions are handled and answered, and how it is rewarded and observed."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from math import exp, isfinite
from numbers import Real
from typing import TYPE_CHECKING, Any
from weakref import ref

import numpy as np
from greenlet import getcurrent

from ..errors import AgentError, MaskError, RewardError, short_repr
from ..hooks.hook import BOUND
from ..hooks.stacks import DIFFERENCES, EVALUATING
from ..simulation import RULE
from .actions import MASK, only_choice
from .driver import WAIT
from .policies import AskingPolicy, DeferredPolicy, Where
from .spaces import duplicate

if TYPE_CHECKING:
    from .episode import Episode
    from .plan import Plan
    from .point import Point


class Agent:
    """One agent of an episode. If its decision point has no other agent, it is also the event of a decision there.

    Attributes:
        policy: The policy that answers the agent's decisions. None: the environment's user answers
            them.
        delegated: Whether its decisions do not wait for an answer from outside: a policy is asked,
            or it has ended.
        update: Rewards and observes the agent: see ``make_updates``.
        decided: Whether the reward mapping was called in this episode. Its first value is dropped.
        acted: Whether the latest round used an action that the user gave for the agent.
        present: Whether the latest info comes from an observation. False if there was nothing to
            observe.
        reward: The reward of the agent's previous action, as of its latest decision or its end.
        asked: Whether the user was asked for an action in this episode. Used where forced moves are
            skipped.
        carried: The sum of the rewards of forced moves. It is added to the agent's next reward.
        applying: How many of its actions are being applied, on the simulation's side. Meanwhile its
            calls run the rule.
        answered: How many of its decisions were answered: by the user, by a policy, or as forced
            moves.
        fallbacks: How many of them a fallback has answered.
        observation: The latest observation, cast to its space. None before the first one.
        handed_out: The observation that a view has returned and must not return a second time.
        mask, choices: The legal actions of the pending decision, if the decision point restricts
            them.
        offered: The choices of the latest decision, among which the rule's decision is looked up.
        rule_action: The action that corresponds to the rule's latest decision. None if it is not
            known.
        informs_rule_action: Whether the next info contains ``rule_action``.
        rate: The rate at which infos discount. None: they do not.
        read_clock: Notes the time, and returns an info: ``read_clock``, or ``read_discounted`` if
            there is a rate.
        now, answered_at: The times of the latest decision and of the one before.
        entity, rest, kwargs: The arguments of the latest decision: see ``keep``.
        group, notes: Used by runners of many episodes.
    """

    __slots__ = (
        "acted", "answered", "answered_at", "applying", "asked", "carried", "choices", "clock",
        "decided", "delegated", "deliver", "ended", "entity", "fallbacks", "group", "handed_out",
        "info", "informs_rule_action", "kwargs", "mask", "memory", "name", "notes", "now",
        "observation", "offered", "plugins", "point", "policy", "present", "rate", "read_clock",
        "report", "rest", "reward", "rule_action", "update",
    )  # fmt: skip

    def __init__(self, name: str, point: Point, plan: Plan, clock: Any) -> None:
        self.name, self.point, self.clock, self.plugins = name, point, clock, plan.plugins
        self.policy = policy = plan.policy_of(name, point)
        self.rate = plan.options.discount_rate
        self.read_clock: Callable[[Agent], dict[str, Any]] = (
            read_clock if self.rate is None else read_discounted
        )
        self.delegated = policy is not None and not (
            plan.rewarded and isinstance(policy, DeferredPolicy)
        )
        self.deliver, self.report = point.deliver, point.report
        self.update: Callable[..., None] = point.updates[0]
        self.decided = self.acted = self.ended = self.present = self.asked = (
            self.informs_rule_action
        ) = False
        self.reward = self.carried = 0.0
        self.answered = self.applying = self.fallbacks = 0
        nothing: Any = None
        self.observation = self.handed_out = self.mask = self.choices = self.offered = (
            self.rule_action
        ) = nothing
        self.entity = self.group = self.notes = nothing
        self.info: dict[str, Any] = {}
        self.memory: dict[Any, Any] = {}
        self.now: float | None = None
        self.answered_at: float | None = None
        self.rest: tuple[Any, ...] | None = None
        self.kwargs: dict[str, Any] = BOUND

    # -- decisions --------------------------------------------------------------------------------

    def handle(self, episode: Episode, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Handle a decision: update the agent and return ``WAIT``, or the reply if a policy or the episode has one."""
        if self.applying:
            return RULE
        if self.delegated:
            return self.ask_policy(episode, args, kwargs)
        point = self.point
        if point.agent is None:
            entity = self.entity
            if entity is not None and args and entity() is args[0]:
                self.rest, self.kwargs = args[1:], kwargs
            else:
                self.keep(episode, args, kwargs)
        else:
            if point.one_entity and args and self.rest and self.rest[0] is not args[0]:
                point.warn_of_several(self.name)
            # a strong reference: the first argument is no entity of the model
            self.rest, self.kwargs = args, kwargs
        episode.latest = self
        if not episode.plain:  # in a round, after the last step, or where forced moves are skipped
            return episode.decide(self, args, kwargs)
        update = self.update  # a local variable: calling the attribute directly is slower
        update(self, args, kwargs)
        episode.pending = self
        return WAIT

    def ask_policy(self, episode: Episode, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Let the policy answer a decision, or wait: for a policy of many decisions, or because a replay ends here."""
        if episode.ended:
            if self.ended:
                raise AgentError(
                    f"the agent {self.name!r} decides at {self.point.hook.name} after its end;"
                    " agent= must name each entity differently, and removed_by= or end_agent()"
                    " must end an agent only when its entity is gone"
                )
            # else the simulation might run for ever without its user
            if episode.plan.one_agent in episode.ended:
                episode.finish(truncated=False)
                return WAIT
        policy = self.policy
        if policy is RULE:
            return RULE
        episode.latest = self
        alone = isinstance(policy, AskingPolicy)
        rewarded = alone and policy.asks
        self.point.updates[0](self, args, kwargs, reward=rewarded)
        forced = self.only_action() if episode.skips else None
        if rewarded and episode.skips:
            self.add_carried_reward(carry_on=forced is not None or not self.asked)
        if forced is not None:
            return self.answer_forced(episode, forced)
        self.asked = True
        if alone:
            self.keep(episode, args, kwargs)
        deferred = isinstance(policy, DeferredPolicy)
        if deferred and episode.where < Where.BRANCH:
            episode.pending = self
            return WAIT
        if episode.script:
            action = episode.script.popleft()
        else:
            episode.consulted = self
            if episode.script is not None:
                episode.pending = self
                return WAIT
            try:
                seen = self.observation, self.info
                action = policy.answer(episode, self, *seen) if alone or deferred else policy(*seen)
            finally:
                episode.consulted = None
        if len(episode.tape) < episode.tape_size:
            episode.tape.append(duplicate(action))
        legal = action if action is RULE else self.point.validate(action, self.name, self.mask)
        return episode.answer(self, legal, False)

    def add_carried_reward(self, *, carry_on: bool) -> None:
        """Add the rewards of forced moves.

        Carry the sum on where no reward is returned, as at a reset.
        """
        reward = self.reward + self.carried
        self.reward, self.carried = (0.0, reward) if carry_on else (reward, 0.0)

    def answer_forced(self, episode: Episode, action: Any) -> Any:
        """Answer with the only legal action.

        The elapsed time adds up until the agent is asked, as rewards do.
        """
        if self.answered_at is not None:
            self.now = self.answered_at
        return episode.answer(self, action, False)

    def only_action(self) -> Any:
        """The only legal action of the pending decision; None if there are several."""
        return only_choice(self.point.definition.action_space, self.mask)

    def keep(self, episode: Episode, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        """Keep the arguments of a decision.

        Its entity, if any, by a weak reference, so that the model can free it.
        """
        self.entity, self.rest, self.kwargs = None, args, kwargs
        if args and self.point.agent is None:
            with suppress(TypeError):  # not every object supports weak references
                self.entity, self.rest = ref(args[0]), args[1:]
            episode.entities[self.point, id(args[0])] = self

    def arguments(self) -> tuple[Any, ...] | None:
        """The positional arguments of the latest decision.

        None if there was none, or if the entity is gone.
        """
        if self.entity is None:
            return self.rest
        first = self.entity()
        return None if first is None else (first, *self.rest)  # type: ignore[misc]

    def conclude(self, episode: Episode) -> None:
        """End the agent's episode: give it its last reward and its last observation, and release the arguments."""
        episode.latest = self
        args = self.arguments()
        if args is None:  # the agent never decided, or the model has freed its entity
            self.clear_observation()
        else:
            self.point.updates[0](self, args, self.kwargs, last=True)
        self.reward, self.carried = self.reward + self.carried, 0.0
        self.entity = self.rest = self.answered_at = None
        self.kwargs = BOUND

    # -- infos ------------------------------------------------------------------------------------

    def inform(self) -> dict[str, Any]:
        """Make the info of an observation: the time, the action mask and the rule's action."""
        info: dict[str, Any] = {} if self.clock is None else self.read_clock(self)
        mask = self.mask
        if mask is not None:
            info[MASK] = mask.copy() if type(mask) is np.ndarray else duplicate(mask)
        if self.informs_rule_action:
            info["rule_action"], self.informs_rule_action = self.rule_action, False
        return info

    def clear_observation(self) -> None:
        """Set the reward to 0.0, and the info to that of an agent with nothing to observe and all actions legal."""
        self.reward, self.present = 0.0, False
        self.info = {} if self.clock is None else self.read_clock(self)
        if self.point.legal is not None:
            self.info[MASK] = self.point.open_mask()


def read_clock(agent: Agent) -> dict[str, Any]:
    """Note the time.

    Return it, and the time elapsed since the agent's previous decision, as an info.
    """
    clock: Any = agent.clock
    time, before = clock(), agent.answered_at
    agent.now = now = time if type(time) is float else float(time)
    return {"time": now, "elapsed": 0.0 if before is None else now - before}


def read_discounted(agent: Agent) -> dict[str, Any]:
    """Read the clock, and add the discount of the elapsed time."""
    info, rate = read_clock(agent), agent.rate or 0.0
    return {**info, "discount": exp(-rate * info["elapsed"])}


def make_updates(point: Point) -> tuple[Callable[..., None], Callable[..., None]]:
    """Make the two functions that reward and observe the agents of a decision point for the arguments of a call.

    The first also takes whether to reward, whether to observe, and whether this is the agent's end.
    The second is for agents that have decided before, and skips what the point does not need.
    """
    reward_mapping, cast = point.definition.reward_mapping, point.cast
    observation_mapping = point.definition.observation_space_mapping
    legal, masked = point.legal, bool(point.masked_parts)
    plain = legal is None and not point.informs_rule_action and not masked

    def update(
        agent: Agent,
        args: Any,
        kwargs: Any,
        reward: bool = True,
        observe: bool = True,
        last: bool = False,
    ) -> None:
        here = getcurrent() if DIFFERENCES else None
        if here is not None:
            before, EVALUATING[here] = EVALUATING.get(here), agent
        try:
            if reward and agent.decided:
                agent.reward = checked_reward(agent, reward_mapping(*args, **kwargs))
            elif reward and not last:  # the agent has not acted yet, so this value rewards nothing
                reward_mapping(*args, **kwargs)
                agent.decided, agent.update = True, again
            if not observe:
                return
            agent.present = True
            if legal is not None:
                try:
                    agent.mask, agent.choices = legal(args, kwargs)
                except MaskError:
                    if not last:
                        raise
                    # it will not be asked again
                    agent.mask, agent.choices = point.open_mask(), None
            agent.info = agent.inform()
            if masked:
                agent.observation = point.observe(args, kwargs, agent.mask)
            else:
                agent.observation = cast(observation_mapping(*args, **kwargs))
        finally:
            if here is not None:
                # without a function call, which could fail at the recursion limit
                if before is None:
                    del EVALUATING[here]
                else:
                    EVALUATING[here] = before

    def update_plainly(agent: Agent, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        if DIFFERENCES:
            update(agent, args, kwargs)
            return
        reward = reward_mapping(*args, **kwargs) if kwargs else reward_mapping(*args)
        # spares nearly all rewards the call
        if type(reward) is not float or reward - reward != 0.0:
            reward = checked_reward(agent, reward)
        agent.reward = reward
        agent.info = {} if agent.clock is None else agent.read_clock(agent)
        agent.observation = cast(
            observation_mapping(*args, **kwargs) if kwargs else observation_mapping(*args)
        )

    again = update_plainly if plain else update
    return update, again


def checked_reward(agent: Agent, reward: Any) -> float:
    """Convert a reward to a Python float, or raise ``RewardError`` if it is not one finite number."""
    value = reward.item() if isinstance(reward, np.ndarray) and reward.size == 1 else reward
    if not isinstance(value, (Real, np.bool_)):
        raise RewardError(f"the reward {short_repr(reward)} is not one number")
    try:
        value = float(value)
    except OverflowError:
        raise RewardError(f"the reward {short_repr(reward)} is too large for a float") from None
    if not isfinite(value):
        raise RewardError(f"the reward of {agent.name!r} is {value}, which is not finite")
    return value
