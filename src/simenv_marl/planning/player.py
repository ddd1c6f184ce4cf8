"""The player: the agent whose decision is pending, in the single view.

In a branch, a player takes a candidate, and then follows its base. The environment may have
wrappers: actions go through them, and observations and rewards come from them. Only the unwrapped
environment knows ``RULE``, so wrappers receive a legal sample in its place.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Mapping
from math import isfinite
from typing import Any, TypeAlias, TypeGuard

import numpy as np
from gymnasium import Env, spaces
from pettingzoo import AECEnv, ParallelEnv

from ..core import (
    ILLEGAL,
    Agent,
    Episode,
    EpisodePolicy,
    Info,
    Mask,
    Policy,
    Space,
    Where,
    action_check,
    is_planner,
    pending_view,
    policy_for,
    split_extras,
    takes_info,
    two_arguments,
)
from ..envs import SimulationEnv
from ..errors import (
    InvalidActionError,
    OptionValueError,
    UnknownAgentError,
    did_you_mean,
    short_repr,
)
from ..simulation import EVERYONE, RULE, Action, Observation, Sentinel, asks_for, is_number
from .candidates import Candidate, First, Metric, Propose, is_policy

Environment: TypeAlias = (
    Env[Observation, Action]
    | AECEnv[str, Observation, Action]
    | ParallelEnv[str, Observation, Action]
)
"""An environment of one simulation, in any view, with or without wrappers."""

Policies: TypeAlias = dict[str | Sentinel, Policy]
"""Policies by agent, which are asked as those of a planner's branch."""


class Player:
    """The agent whose decision is pending, in the single view.

    Attributes:
        env: The environment.
        view: The same without wrappers.
        episode: The episode. Of a clone in another process, its mirror, until it is branched.
        agent: The agent.
        name: Its name.
        base: The policy after the candidate, or policies by agent.
        over: Whether the agent's episode has ended.
        latest: The observations and infos of the latest step, by agent. Empty before a step.
        noted: The time of the first decision of another agent after a horizon, and the metric or
            the reward then. None: there was none.
    """

    sees_rewards = True

    def __init__(
        self,
        env: Environment,
        base: Policy,
        name: str | None = None,
    ) -> None:
        self.env: Any = env
        self.view: Any = pending_view(env, "planning")
        self.episode: Episode = self.view.episode
        self.agent: Agent = self.view.episode.deciding
        self.name = name or self.agent.name
        self.base = base
        self.over = False
        self.latest: dict[str, tuple[Observation, Info]] = {}
        self.noted: tuple[float, float] | None = None
        self._horizon: float | None = None
        self._measure: Callable[[], float] = self.reward_so_far
        self._bases = self._prepare(base)
        self._known: dict[int, Policies] = {}

    @property
    def number(self) -> int:
        """The number of its decisions that were answered."""
        return self.agent.answered

    def _prepare(self, policy: Policy) -> Policies:
        """Prepare a policy, or policies by agent, to decide in a branch."""
        policies = policy if isinstance(policy, Mapping) else {self.name: policy}
        return {each: two_arguments(policy_for(policies, each, Where.PLAN)) for each in policies}

    # -- checks, before anything moves ------------------------------------------------------------

    @property
    def mask(self) -> Mask | None:
        """The mask of the pending decision. None if all actions are legal."""
        return self.agent.mask

    def candidates(
        self,
        actions: Iterable[Candidate] | Propose | None,
        *,
        legal: bool = False,
        incumbent: Candidate = None,
    ) -> list[Candidate]:
        """Check the candidates for the pending decision.

        Args:
            actions: A list of the candidates, or a callable that proposes them. None: all legal
                actions of a ``Discrete``.
            legal: Whether to leave out masked candidates. Otherwise they are refused.
            incumbent: The latest choice of a planner, for the callable. None: there is none.

        Returns:
            The candidates.

        Raises:
            OptionValueError: There is no list of candidates.
            InvalidActionError: A candidate is not legal, or all of them are masked.
        """
        space = self._space_of(self.name)
        mask = self.mask
        if callable(actions):
            actions = self._propose(actions, incumbent)
        if actions is None and isinstance(space, spaces.Discrete):
            legal = True
            actions = list(range(space.n))
            if self.env is self.view and mask is not None:
                actions = np.flatnonzero(mask).tolist()
            actions = [int(space.start) + index for index in actions]
        if not isinstance(actions, list) or not actions:
            raise OptionValueError(
                "actions must be a list of candidates, or None for all legal actions of a"
                f" Discrete, not {short_repr(actions)}; the action space is {short_repr(space)}"
            )
        for action in actions:
            self.check_candidate(action, None if legal else mask)
        candidates = [action for action in actions if not legal or self.allows(action)]
        if not candidates:
            raise InvalidActionError(
                f"all candidates of {self.name!r} are masked; its mask is {short_repr(mask)}"
            )
        return candidates

    def _propose(self, function: Propose, incumbent: Candidate) -> list[Candidate]:
        """Ask a callable for candidates."""
        observation, info = self._observe(self.name)
        asked: dict[str, object] = {}
        if asks_for(function, "_incumbent"):
            asked["_incumbent"] = incumbent
        if asks_for(function, "_simulation"):
            asked["_simulation"] = self.episode.simulation
        if asks_for(function, "_decision"):
            asked["_decision"] = self.agent.describe(self.episode.seed, self.episode.where)
        seen = (observation, info) if takes_info(function) else (observation,)
        return list(function(*seen, **asked))

    def allows(self, candidate: Candidate) -> bool:
        """Return whether a candidate is legal now."""
        try:
            self.check_candidate(candidate, self.mask)
        except InvalidActionError:
            return False
        return True

    def check_candidate(self, candidate: Candidate, mask: Mask | None) -> None:
        """Refuse an illegal action, and a policy that cannot decide in branches."""
        if isinstance(candidate, First):
            _check_policy(candidate.then)
            candidate = candidate.action
        if is_policy(candidate):
            _check_policy(candidate)
        else:
            self._check(candidate, mask)

    def _check(
        self,
        action: Action,
        mask: Mask | None,
    ) -> None:
        """Refuse an illegal action. The mask counts unless wrappers have replaced the space."""
        point = self.agent.point
        space = self._space_of(self.name)
        if space == point.definition.action_space:
            point.validate(action, self.name, mask)
        elif action_check(space)(action) is ILLEGAL:
            raise InvalidActionError(
                f"the action {short_repr(action)} of {self.name!r} is not in {short_repr(space)}"
            )

    def check(self) -> None:
        """Refuse a base that cannot decide in branches, or names an agent that does not exist."""
        _check_policy(self.base)
        if not isinstance(self.base, Mapping):
            return
        for name in self.base:
            if name is not EVERYONE and not self.episode.may_have(name):
                known = [
                    *self.episode.agents,
                    *self.episode.others,
                ]
                raise UnknownAgentError(
                    f"base names {short_repr(name)}, which is not an agent here; the agents are:"
                    f" {known}{did_you_mean(name, known)}"
                )

    # -- in a branch ------------------------------------------------------------------------------

    @property
    def is_planned(self) -> bool:
        """Whether a planner already tries a candidate in the environment."""
        return self.episode.where is Where.PLAN

    def start(self) -> None:
        """Prepare a branch."""
        self.view.session.move_to(Where.PLAN)
        self.view.stop_showing()
        if isinstance(self.view, SimulationEnv) and isinstance(self.base, Mapping):
            self.episode.delegate(self.base)  # the simulation answers for all other agents

    def time(self) -> float:
        """Return the simulation's time. 0.0 if it has no clock."""
        clock = self.episode.clock
        if clock is None:
            return 0.0
        return float(clock.time())

    def step(self, action: Action) -> float:
        """Take an action, run to the agent's next decision or its end, and return the reward."""
        observation, reward, terminated, truncated, info = self._step_env(action, self.name)
        self.latest = {self.name: (observation, info)}
        self.over = terminated or truncated
        return float(reward)

    def decide(self) -> Action:
        """Return the agent's action by its base."""
        return self._decide_by(self._bases)

    def answer(self, part: Candidate) -> Action:
        """Return the action of a part of a candidate. The base answers for an illegal one."""
        if part is not RULE and is_policy(part):
            policies = self._known.get(id(part))
            if policies is None:
                policies = self._known[id(part)] = self._prepare(part)
            return self._decide_by(policies)
        if not self.allows(part):
            return self.decide()
        everyone = self._bases.get(EVERYONE)
        if self.is_planned and isinstance(everyone, EpisodePolicy) and everyone.sees_all:
            self.decide()  # the candidate takes the place of one action of its round
        return part

    def _decide_by(self, policies: Policies) -> Action:
        """Return the agent's action by some policies."""
        return self._decide_for(self.name, policies)

    def _decide_for(self, name: str, policies: Policies | None = None) -> Action:
        """Return an agent's action by some policies, or by the bases."""
        policies = self._bases if policies is None else policies
        policy = policies.get(name, policies.get(EVERYONE, RULE))
        if policy is RULE:
            return RULE
        observation, info = self._observe(name)
        agent = self.episode.agents.get(name, self.agent)
        if isinstance(policy, EpisodePolicy):
            answer = policy.answer(self.episode, agent, observation, info)
        else:
            answer = policy(observation, info)
        action, _ = split_extras(answer, agent.point.definition.action_space)
        return action

    def _observe(self, name: str) -> tuple[Observation, Info]:
        """Return the latest observation and info of an agent."""
        if name in self.latest:
            return self.latest[name]
        agent = self.episode.agents.get(name, self.agent)
        return agent.hand_out(), agent.info

    # -- metrics and horizons ---------------------------------------------------------------------

    def read(self, metric: Metric) -> float:
        """Return the metric of the simulation."""
        with self.episode.context():
            return number_of(metric(self.episode.simulation), "metric")

    def reward_so_far(self) -> float:
        """Return the reward that the agent has earned by now, since its latest decision."""
        return self.agent.reward_so_far()

    def watch(self, horizon: float, metric: Metric | None) -> None:
        """Note the metric, or the reward, at the first decision of another agent from a time on.

        Rewards that wrappers change, and those of a team or a round, are not known there.
        """
        if metric is not None:
            self._measure = lambda: self.read(metric)
        elif not self.sees_rewards or self.env is not self.view or self.episode.team is not None:
            return
        self._horizon = horizon
        self.episode.watch(self.note)

    def note(self) -> None:
        """Note the metric, or the reward, at the first decision after the horizon."""
        if self._horizon is None or self.noted is not None:
            return
        now = self.time()
        if now >= self._horizon:
            self.noted = now, self._measure()

    def can_run_out(self) -> bool:
        """Return whether the rule can decide to the end, and nothing is observed."""
        is_free = self.env is self.view and self.base is RULE
        plan = self.episode.plan
        ends_alone = plan.one_agent is not None or not plan.removers
        return is_free and ends_alone and plan.options.max_steps is None

    def run_out(self) -> None:
        """Let the rule decide to the end of the simulation. Observe nothing before that."""
        episode = self.episode
        while episode.pending is not None:
            agents = episode.agents.values()
            for agent in agents:
                agent.delegate(RULE)
            rules = {agent.name: RULE for agent in agents}
            episode.step(RULE if episode.round is None else rules)
        self.over = True

    # -- through wrappers -------------------------------------------------------------------------

    def _space_of(self, name: str) -> Space:
        """Return the action space of an agent, or of all together, in the wrapped environment."""
        space: Any = self.env.action_space
        if callable(space):
            space = space(name)
        elif name != self.name:
            space = space[name]
        return space  # type: ignore[no-any-return]

    def _step_env(
        self,
        action: Action,
        name: str,
    ) -> Any:
        """Step the environment with an agent's action, or with actions by agent.

        ``RULE`` reaches the view, also as a part of a dict. Wrappers receive a sample instead.
        """
        view = self.view
        samples = {} if self.env is view else self._samples(action, name)
        if not samples:
            return self.env.step(action)

        def step(filtered: Action) -> Any:
            if action is RULE:
                return type(view).step(view, RULE)
            rules = dict.fromkeys(samples, RULE)
            return type(view).step(view, {**filtered, **rules})

        sample = samples[name] if action is RULE else {**action, **samples}
        vars(view)["step"] = step  # because the innermost wrapper calls it with a legal action
        try:
            return self.env.step(sample)
        finally:
            del vars(view)["step"]

    def _samples(
        self,
        action: Action,
        name: str,
    ) -> dict[str, Action]:
        """Sample legal actions in place of ``RULE``, by agent."""
        parts = action if isinstance(action, Mapping) else {name: action}
        return {agent: self._sample(agent) for agent, part in parts.items() if part is RULE}

    def _sample(self, name: str) -> Action:
        """Sample a legal action of an agent."""
        space = copy.deepcopy(self._space_of(name))  # so that its generator stays as it is
        agent = self.episode.agents.get(name)
        if agent is None or agent.mask is None:
            return space.sample()
        if space != agent.point.definition.action_space:  # wrappers have replaced it
            return space.sample()
        return space.sample(agent.mask)


def _check_policy(policy: Policy) -> None:
    """Refuse a base that cannot decide in branches: no policy, or a planner without a base."""
    if isinstance(policy, Mapping):
        for part in policy.values():
            _check_policy(part)
    elif policy is not RULE and not callable(policy):
        raise OptionValueError(
            f"base must be RULE, a policy, or policies by agent, not {short_repr(policy)}"
        )
    elif is_planner(policy):
        base = getattr(policy, "base", None)
        if base is None:
            raise OptionValueError(
                f"the base {short_repr(policy)} asks for _environment, which no policy receives in"
                " a branch; set its attribute base to the policy that decides there, or to RULE"
            )
        _check_policy(base)


def number_of(value: Any, name: str) -> float:
    """Return a finite number that a callable has returned. ``name``: its option."""
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.item()
    if not is_finite(value):
        raise OptionValueError(f"{name} must return a finite number, not {short_repr(value)}")
    return float(value)


def is_finite(value: object) -> TypeGuard[float]:
    """Return whether a value is one finite number."""
    return is_number(value) and isfinite(value)
