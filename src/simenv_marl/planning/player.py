"""The agent whose decision is pending, in each view: it takes a candidate in a branch, and then follows its base.

The environment may have wrappers. The agent's actions go through them, and its observations and
rewards come from them. ``RULE``, which only the unwrapped environment knows, replaces the action
that the wrappers let through.
"""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from math import isfinite
from numbers import Real
from time import perf_counter
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np
from gymnasium import spaces

from ..core import (
    ILLEGAL,
    Agent,
    AskingPolicy,
    Where,
    action_check,
    checked_actions,
    is_planner,
    is_seed,
    pending_view,
    policy_for,
    two_arguments,
)
from ..envs import SimulationAECEnv, SimulationEnv, SimulationJointEnv, SimulationParallelEnv
from ..errors import (
    EpisodeOverError,
    InvalidActionError,
    OptionValueError,
    UnknownAgentError,
    annotate,
    did_you_mean,
    short_repr,
)
from ..simulation import RULE


class Player:
    """The agent whose decision is pending, in the single view.

    ``base`` decides after the candidate.

    Attributes:
        env, view: The environment, with or without wrappers, and the unwrapped one.
        may_be: Returns whether an agent of a name exists, or may appear.
        over: Whether the agent's episode has ended.
        seen: Observation and info, as the latest step has returned them, by agent.
    """

    def __init__(self, env: Any, base: Any) -> None:
        self.env, self.view, self.base = env, env.unwrapped, base
        self.episode = self.view.episode
        self.record: Agent = self.episode.deciding
        self.agent = self.record.name
        self.may_be: Callable[[Any], bool] = self.episode.may_have
        self.over = False
        self._policies: dict[str, Any] = {}  # the bases that were asked, by agent
        self.seen: dict[str, Any] = {}

    # -- checks, before anything moves ------------------------------------------------------------

    def candidates(self, actions: Any, *, legal: bool = False) -> list[Any]:
        """Check the candidates for the pending decision, and return them.

        Without masked ones if ``legal``.
        """
        if actions is None:
            space = self._space_of(self.agent)
            if not isinstance(space, spaces.Discrete):
                raise OptionValueError(
                    "actions=None needs a Discrete action space; list candidates of"
                    f" {short_repr(space)}"
                )
            actions, legal = list(range(int(space.start), int(space.start + space.n))), True
        listed = actions if isinstance(actions, list) else []
        if not listed:
            raise OptionValueError(
                f"actions must be a list of candidates, not {short_repr(actions)}"
            )
        for action in listed:
            self._check(action, None if legal else self.record.mask)
        found = [action for action in listed if self.allows(action)] if legal else listed
        if not found:
            raise InvalidActionError(
                f"all candidates of {self.agent!r} are masked; its mask is"
                f" {short_repr(self.record.mask)}"
            )
        return found

    def allows(self, action: Any) -> bool:
        """Return whether an action is legal now."""
        try:
            self._check(action, self.record.mask)
        except InvalidActionError:
            return False
        return True

    def _check(self, action: Any, mask: Any) -> None:
        """Refuse an action that is not legal.

        The mask does not apply if wrappers have replaced the action space.
        """
        point, space = self.record.point, self._space_of(self.agent)
        if action is RULE:
            return
        if space == point.definition.action_space:
            point.validate(action, self.agent, mask)
        elif action_check(space)(action) is ILLEGAL:
            raise InvalidActionError(
                f"the action {short_repr(action)} of {self.agent!r} is not in {short_repr(space)}"
            )

    def check_base(self) -> None:
        """Refuse a base that cannot decide in branches, or names an agent that does not exist."""
        bases = self.base if isinstance(self.base, Mapping) else {self.agent: self.base}
        for policy in bases.values():
            _check_policy(policy)
        for name in bases if bases is self.base else ():
            if not self.may_be(name):
                known = [*self.episode.agents, *self.episode.others]
                raise UnknownAgentError(
                    f"base names {short_repr(name)}, which is not an agent here; the agents are:"
                    f" {known}{did_you_mean(name, known)}"
                )

    # -- in a branch ------------------------------------------------------------------------------

    def start(self, seen: dict[str, Any]) -> None:
        """Prepare a branch, in which a step may already have returned something."""
        self.view._shows, self.seen = False, seen
        if isinstance(self.view, SimulationEnv) and isinstance(self.base, Mapping):
            self.episode.delegate(self.base)  # the simulation answers for all other agents

    def now(self) -> float:
        """Return the simulation's time."""
        return float(self.episode.clock.time())

    def step(self, action: Any) -> float:
        """Take an action, continue to the agent's next decision or its end, and return the reward."""
        observation, reward, terminated, truncated, info = self._step_env(action, self.agent)
        self.seen, self.over = {self.agent: (observation, info)}, terminated or truncated
        return float(reward)

    def decide(self) -> Any:
        """Return the agent's action by its base."""
        return self._decide_for(self.agent)

    def _decide_for(self, name: str) -> Any:
        """Return an agent's action by its base."""
        policy: Any = self._policies.get(name)
        if policy is None:
            base = self.base if name == self.agent or isinstance(self.base, Mapping) else RULE
            policy = policy_for(base, name, Where.PLAN)
            policy = policy if policy is RULE else two_arguments(policy)
            if isinstance(policy, AskingPolicy):
                record = self.record if name == self.agent else self.episode.agents[name]
                policy = partial(policy.ask, self.episode, record)
            self._policies[name] = policy
        return RULE if policy is RULE else policy(*self._observe(name))

    def _observe(self, name: str) -> Any:
        """Return the latest observation and info of an agent."""
        if name in self.seen:
            return self.seen[name]
        agent = self.record if name == self.agent else self.episode.agents[name]
        return agent.point.blank() if agent.observation is None else agent.observation, agent.info

    # -- through wrappers -------------------------------------------------------------------------

    def _space_of(self, name: str) -> Any:
        """Return the action space of an agent in the wrapped environment."""
        space: Any = self.env.action_space
        return space(name) if callable(space) else space

    def _step_env(self, action: Any, name: str) -> Any:
        """Step through the wrappers.

        ``RULE``, also as a part of a dict of actions, reaches the view unchanged.
        """
        view, parts = self.view, action if isinstance(action, Mapping) else {}
        rules = {agent: RULE for agent, part in parts.items() if part is RULE}
        if self.env is view or not (rules or action is RULE):
            return self.env.step(action)
        sample = (
            {**parts, **{agent: self._sample(agent) for agent in rules}}
            if rules
            else self._sample(name)
        )

        def step(through: Any) -> Any:
            return type(view).step(view, {**through, **rules} if rules else RULE)

        vars(view)["step"] = step  # wrappers call it with what they make of the sample
        try:
            return self.env.step(sample)
        finally:
            del vars(view)["step"]

    def _sample(self, name: str) -> Any:
        """Return a legal action of an agent, which wrappers see in place of ``RULE``."""
        # whose generator stays
        space, agent = copy.deepcopy(self._space_of(name)), self.episode.agents.get(name)
        masked = (
            agent is not None
            and agent.mask is not None
            and space == agent.point.definition.action_space
        )
        return space.sample(agent.mask) if masked else space.sample()


def _check_policy(policy: Any) -> None:
    """Refuse a base that cannot decide in branches: no policy, or a planner without a base."""
    if isinstance(policy, Mapping):
        for part in policy.values():
            _check_policy(part)
    elif policy is not RULE and not callable(policy):
        raise OptionValueError(
            f"base must be RULE, a policy, or policies by agent, not {short_repr(policy)}"
        )
    elif is_planner(policy):
        if not hasattr(policy, "base"):
            raise OptionValueError(
                f"the base {short_repr(policy)} asks for _environment, which no policy receives in"
                " a branch; set its attribute base to the policy that decides there, or to RULE"
            )
        _check_policy(policy.base)


class JointPlayer(Player):
    """The one agent of a joint view, whose action holds the actions of the roster's agents."""

    def __init__(self, env: Any, base: Any) -> None:
        super().__init__(env, base)
        self.agent = "all agents"
        self.may_be = self.view.joint.roster.__contains__
        if isinstance(base, Mapping) and not isinstance(self.view.action_space, spaces.Dict):
            raise OptionValueError(
                "a base by agent needs a joint view without flatten=True; pass one policy for all"
                " agents"
            )

    def _space_of(self, name: str) -> Any:
        space: Any = self.env.action_space
        return space if name == self.agent else space[name]

    def _check(self, action: Any, mask: Any) -> None:
        if self._space_of(self.agent) == self.view.action_space:
            checked_actions(self.episode, self.view.joint.actions(self.episode, action))
        elif isinstance(action, Mapping):
            super()._check(
                {
                    name: self._sample(name) if part is RULE else part
                    for name, part in action.items()
                },
                mask,
            )
        else:
            super()._check(action, mask)

    def decide(self) -> Any:
        """Return the actions of all agents by the base."""
        if not isinstance(self.base, Mapping):
            return super().decide()
        agents = self.episode.agents
        return {
            name: self._decide_for(name) if name in agents else RULE
            for name in self.view.joint.roster
        }

    def _observe(self, name: str) -> Any:
        if name == self.agent and not self.seen:
            return self.view.joint.observe(self.episode), {}
        return super()._observe(name)


class AECPlayer(Player):
    """An agent of an AEC view."""

    def __init__(self, env: Any, base: Any) -> None:
        super().__init__(env, base)
        if self.view.agent_selection != self.agent:
            raise EpisodeOverError(
                f"{self.view.agent_selection!r} is selected, but its episode has ended: call"
                f" step(None) before you plan the decision of {self.agent!r}"
            )

    def step(self, action: Any) -> float:
        """Take an action; all other agents decide until this agent is selected again."""
        env, name = self.env, self.agent
        self._step_env(action, name)
        while env.agents:
            name = env.agent_selection
            if name == self.agent:
                _, reward, terminated, truncated, _ = env.last(observe=False)
                self.over = terminated or truncated
                return float(reward)
            ended = env.terminations[name] or env.truncations[name]
            self._step_env(None if ended else self._decide_for(name), name)
        self.over = True
        return 0.0

    def _observe(self, name: str) -> Any:
        observation, _, _, _, info = self.env.last()
        return observation, info


class ParallelPlayer(Player):
    """An agent of a parallel view, whose actions are part of rounds."""

    def step(self, action: Any) -> float:
        """Play a round, and further rounds without an action of the agent until its decision is pending again."""
        reward = self._play({self.agent: action})
        while not self.over and self.episode.pending is not self.record:
            reward += self._play({})
        return reward

    def _play(self, actions: dict[str, Any]) -> float:
        """Play a round in which the other agents follow their bases."""
        others = {
            name: self._decide_for(name) for name in self.episode.agents if name != self.agent
        }
        observations, rewards, terminations, truncations, infos = self._step_env(
            actions | others, self.agent
        )
        self.seen = {name: (observations[name], infos.get(name, {})) for name in observations}
        over = terminations.get(self.agent, True) or truncations[self.agent]
        self.over = bool(over or self.record.ended)  # pad_agents keeps ended agents
        return float(rewards.get(self.agent, 0.0))


def player_of(env: Any, base: Any) -> Player:
    """Return the player of the agent whose decision is pending in an environment of one simulation."""
    view = pending_view(env, "planning")
    players = {
        SimulationAECEnv: AECPlayer,
        SimulationParallelEnv: ParallelPlayer,
        SimulationJointEnv: JointPlayer,
    }
    return next((player for kind, player in players.items() if isinstance(view, kind)), Player)(
        env, base
    )


@dataclass
class Progress:
    """How far a rollout has come.

    Attributes:
        rewards: The discounted reward of each decision of the agent.
        start: The time at its begin; None if time does not matter.
        seen: What the latest step has returned, by agent.
        over: Whether the agent's episode has ended.
        times: The simulation's times between the agent's decisions, if it has a time.
        seconds: The real time that it took.
    """

    rewards: list[float] = field(default_factory=list)
    start: float | None = None
    seen: dict[str, Any] = field(default_factory=dict)
    over: bool = False
    times: list[float] = field(default_factory=list)
    seconds: float = 0.0


class Outcome(NamedTuple):
    """What comes of a rollout.

    Attributes:
        rewards: The discounted reward of each decision.
        seen: A digest of what the agent saw at its end.
        times: The simulation's times between decisions.
        seconds: The real seconds for each decision.
    """

    rewards: list[float]
    seen: int
    times: list[float]
    seconds: float


def try_out(env: Any, number: int, tries: Sequence[tuple[list[Any], int]], policy: Any) -> Outcome:
    """In a branch, make one of the rollouts, each given by its actions and the number of the future."""
    actions, future = tries[number]
    return rollout_from(env, actions, policy, Progress(), future=future)[1]


def rollout_from(
    env: Any,
    actions: Sequence[Any],
    policy: Any,
    progress: Progress,
    *,
    stop: int | None = None,
    future: int = 0,
) -> tuple[Progress, Outcome]:
    """In a branch, continue a rollout up to its end, or before decision number ``stop``.

    Return it and its outcome.

    Take actions, one after the other, and continue with the base. If an action is illegal when its
    decision arises, the base decides. The terminal value is added to the last reward. ``policy`` is
    a ``RolloutPolicy``.
    """
    began = perf_counter()
    env.unwrapped.session.move_to(Where.PLAN)
    try:
        player = player_of(env, policy.base)
        player.start(progress.seen)
        made = copy.deepcopy(progress)
        _continue(made, player, actions, policy, stop)
        made.seen, made.over = player.seen, player.over
        made.seconds += perf_counter() - began
        digest = _digest((player.record.observation, player.record.info))
        return made, Outcome(
            made.rewards, digest, made.times, made.seconds / max(1, len(made.rewards))
        )
    except BaseException as error:
        tried = ", ".join(map(short_repr, actions))
        annotate(error, f"simenv_marl: while {tried} was tried out in future {future}")
        raise


def _digest(seen: Any) -> int:
    try:
        return crc32(pickle.dumps(seen, 5))  # in a fork, much faster than a text
    except Exception:
        return crc32(repr(seen).encode(errors="replace"))


def _continue(
    made: Progress, player: Player, actions: Sequence[Any], options: Any, stop: int | None
) -> None:
    """Take steps, and add their rewards."""
    rewards, timed = made.rewards, player.episode.clock is not None
    now = player.now() if timed else 0.0
    if made.start is None:
        made.start = now
    while not player.over and len(rewards) != stop:
        number, elapsed = len(rewards), now - made.start
        weight = options.discount ** (elapsed if options.discount_by == "time" else number)
        reached = elapsed if options.horizon_by == "time" else number
        if number and options.horizon is not None and reached >= options.horizon:
            if options.terminal_value is not None and stop is None:
                rewards[-1] += weight * _terminal_value(options.terminal_value, player.env)
            return
        planned = number == 0 or (number < len(actions) and player.allows(actions[number]))
        rewards.append(weight * player.step(actions[number] if planned else player.decide()))
        if timed and not player.over:
            before, now = now, player.now()
            made.times.append(now - before)


def _terminal_value(function: Callable[[Any], Any], env: Any) -> float:
    value: Any = function(env)
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.item()
    if not is_number(value):
        raise OptionValueError(
            f"terminal_value must return a finite number, not {short_repr(value)}"
        )
    return float(value)


def is_number(value: Any) -> bool:
    """Return whether a value is one finite number."""
    return isinstance(value, Real) and not isinstance(value, bool) and isfinite(value)


def is_count(value: Any) -> bool:
    """Return whether a value is a positive integer."""
    return is_seed(value) and value > 0
