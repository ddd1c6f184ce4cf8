"""Players: the agents whose decisions are pending, one kind for each kind of view.

In a branch, a player takes a candidate, and then follows its base. The environment may have
wrappers: actions go through them, and observations and rewards come from them. Only the unwrapped
environment knows ``RULE``, so wrappers receive a legal sample in its place.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping
from typing import Any, TypeAlias

from gymnasium import Env, spaces
from pettingzoo import AECEnv, ParallelEnv

from ..core import (
    ILLEGAL,
    MASK,
    Agent,
    Episode,
    EpisodePolicy,
    Info,
    Mask,
    Policy,
    Space,
    Where,
    action_check,
    checked_actions,
    is_planner,
    pending_view,
    policy_for,
    split_extras,
    two_arguments,
)
from ..data.deployed import JointPolicy
from ..envs import (
    SimulationAECEnv,
    SimulationEnv,
    SimulationJointEnv,
    SimulationParallelEnv,
    SimulationTurnEnv,
)
from ..errors import (
    EpisodeOverError,
    InvalidActionError,
    OptionValueError,
    UnknownAgentError,
    did_you_mean,
    short_repr,
)
from ..simulation import EVERYONE, RULE, Action, Observation, Sentinel

Environment: TypeAlias = (
    Env[Observation, Action]
    | AECEnv[str, Observation, Action]
    | ParallelEnv[str, Observation, Action]
)
"""An environment of one simulation, in any view, with or without wrappers."""


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
    """

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
        self._policies: dict[str | Sentinel, Policy] = {}
        bases = base if isinstance(base, Mapping) else {self.name: base}
        for each in bases:
            policy = policy_for(bases, each, Where.PLAN)
            self._policies[each] = policy if policy is RULE else two_arguments(policy)
        self._everyone = self._policies.get(EVERYONE, RULE)

    # -- checks, before anything moves ------------------------------------------------------------

    @property
    def mask(self) -> Mask | None:
        """The mask of the pending decision. None if all actions are legal."""
        return self.agent.mask

    def candidates(
        self,
        actions: Iterable[Action] | None,
        *,
        legal: bool = False,
    ) -> list[Action]:
        """Check the candidates for the pending decision.

        Args:
            actions: A list of the candidates. None: all legal actions of a ``Discrete``.
            legal: Whether to leave out masked candidates. Otherwise they are refused.

        Returns:
            The candidates.

        Raises:
            OptionValueError: There is no list of candidates.
            InvalidActionError: A candidate is not legal, or all of them are masked.
        """
        space = self._space_of(self.name)
        if actions is None and isinstance(space, spaces.Discrete):
            legal = True
            first = int(space.start)
            actions = list(range(first, first + int(space.n)))
        if not isinstance(actions, list) or not actions:
            raise OptionValueError(
                "actions must be a list of candidates, or None for all legal actions of a"
                f" Discrete, not {short_repr(actions)}; the action space is {short_repr(space)}"
            )
        mask = self.mask
        for action in actions:
            self._check(action, None if legal else mask)
        candidates = [action for action in actions if not legal or self.allows(action)]
        if not candidates:
            raise InvalidActionError(
                f"all candidates of {self.name!r} are masked; its mask is {short_repr(mask)}"
            )
        return candidates

    def allows(self, action: Action) -> bool:
        """Return whether an action is legal now."""
        try:
            self._check(action, self.mask)
        except InvalidActionError:
            return False
        return True

    def _check(
        self,
        action: Action,
        mask: Mask | None,
    ) -> None:
        """Refuse an illegal action. The mask counts unless wrappers have replaced the space."""
        point = self.agent.point
        space = self._space_of(self.name)
        if action is RULE:
            return
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
        return self._decide_for(self.name)

    def replace_decision(self) -> None:
        """Let a candidate take the place of the base's action, which a round includes, too."""
        if isinstance(self._everyone, EpisodePolicy) and self._everyone.sees_all:
            self.decide()

    def _decide_for(self, name: str) -> Action:
        """Return an agent's action by its base."""
        policy = self._policies.get(name, self._everyone)
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


class JointPlayer(Player):
    """The one agent of a joint view. Its action holds the actions of all agents of the roster."""

    view: SimulationJointEnv

    def __init__(
        self,
        env: Environment,
        base: Policy,
    ) -> None:
        super().__init__(env, base, "all agents")
        observation = self.view.joint.read(self.episode, None)[0]
        self.latest = {self.name: (observation, {})}
        space = self.view.action_space
        policy = self._everyone
        self._learner: JointPolicy | None = None
        if isinstance(policy, JointPolicy) and policy.joint.action_space == space:
            self._learner = policy
        elif isinstance(base, Mapping) and not isinstance(space, spaces.Dict):
            raise OptionValueError(
                "a base by agent needs a joint view without flatten=True; pass one policy for all"
                " agents"
            )

    def _check(
        self,
        action: Action,
        mask: Mask | None,
    ) -> None:
        if self._space_of(self.name) == self.view.action_space:
            checked_actions(self.episode, self.view.joint.actions(self.episode.agents, action))
        elif action is not RULE:
            samples = self._samples(action, self.name)
            if samples:
                action = {**action, **samples}
            super()._check(action, mask)

    def decide(self) -> Action:
        """Return the actions of all agents by the base."""
        if self._learner is not None:
            return self._learner.answer_all(self.episode, self.episode.pending or self.agent)
        if not isinstance(self.base, Mapping):
            return super().decide()
        agents = self.episode.agents
        return {
            name: self._decide_for(name) if name in agents else RULE
            for name in self.view.joint.roster
        }


class TurnPlayer(Player):
    """The learner of a turn view, which decides for each agent. ``agent`` decides now."""

    view: SimulationTurnEnv

    def __init__(
        self,
        env: Environment,
        base: Policy,
    ) -> None:
        super().__init__(env, base, "all agents")
        info: Info = {"agent": self.agent.name}
        if self.mask is not None:
            info[MASK] = self.mask
        self.latest = {self.name: (self.view.turn.observe(self.agent), info)}
        if isinstance(base, Mapping) and self._space_of(self.name) != self.view.action_space:
            raise OptionValueError(
                "a base by agent needs a turn view whose action space no wrapper has replaced; pass"
                " one policy for all agents"
            )

    @property
    def mask(self) -> Mask | None:
        """The mask of the learner's actions. None: nothing can be masked."""
        return self.view.turn.mask(self.agent)

    def _check(
        self,
        action: Action,
        mask: Mask | None,
    ) -> None:
        space = self._space_of(self.name)
        # Where masks do not count, an action of the largest ``Discrete`` may be another agent's.
        is_open = mask is None and not isinstance(space, spaces.Box)
        if action is RULE or is_open or space != self.view.action_space:
            super()._check(action, mask)
        else:
            self.view.validate(action)

    def step(self, action: Action) -> float:
        """Take an action, run to the next decision of any agent, and return the reward."""
        reward = super().step(action)
        self.agent = self.view.own_agent
        return reward

    def decide(self) -> Action:
        """Return the learner's action by the base."""
        if not isinstance(self.base, Mapping):
            return super().decide()
        action = self._decide_for(self.agent.name)
        if action is not RULE:
            code = self.view.turn.seats[self.agent.point.hook].code
            action = code.encode(self.agent.validate(action))
        return action


class AECPlayer(Player):
    """An agent of an AEC view."""

    view: SimulationAECEnv

    def check(self) -> None:
        """Refuse a base as in other views, and a decision whose agent is not selected."""
        super().check()
        selected = self.view.agent_selection
        if selected != self.name:
            raise EpisodeOverError(
                f"{selected!r} is selected, but its episode has ended: call step(None) before you"
                f" plan the decision of {self.name!r}"
            )

    def step(self, action: Action) -> float:
        """Take an action; all other agents decide until this agent is selected again."""
        env = self.env
        self._step_env(action, self.name)
        while env.agents:
            name = env.agent_selection
            _, reward, terminated, truncated, _ = env.last(observe=False)
            ended = terminated or truncated
            if name == self.name:
                self.over = ended
                return float(reward)
            if ended:
                self._step_env(None, name)
            else:
                self._step_env(self._decide_for(name), name)
        self.over = True
        return 0.0

    def _observe(self, name: str) -> tuple[Observation, Info]:
        observation, _, _, _, info = self.env.last()
        return observation, info


class ParallelPlayer(Player):
    """An agent of a parallel view. Its actions are parts of rounds."""

    def step(self, action: Action) -> float:
        """Play a round, and further ones without the agent until its decision is pending again."""
        reward = self._play({self.name: action})
        while not self.over and self.episode.pending is not self.agent:
            reward += self._play({})
        return reward

    def _play(self, actions: dict[str, Action]) -> float:
        """Play a round. The other agents follow their bases. Return the agent's reward."""
        for name in self.episode.agents:
            if name != self.name:
                actions[name] = self._decide_for(name)
        observations, rewards, terminations, truncations, infos = self._step_env(actions, self.name)
        self.latest = {name: (observations[name], infos[name]) for name in observations}
        self.episode.memory.clear()  # policies for all agents answer each round anew
        over = terminations.get(self.name, True) or truncations[self.name]
        self.over = over or self.agent.ended  # pad_agents keeps ended agents
        return float(rewards.get(self.name, 0.0))


def player_of(
    env: Environment,
    base: Policy,
) -> Player:
    """Make the player of the agent whose decision is pending.

    Raises:
        ViewError: ``env`` is not an environment of one simulation.
        ResetNeededError: No decision is pending.
    """
    match pending_view(env, "planning"):
        case SimulationAECEnv():
            return AECPlayer(env, base)
        case SimulationParallelEnv():
            return ParallelPlayer(env, base)
        case SimulationJointEnv():
            return JointPlayer(env, base)
        case SimulationTurnEnv():
            return TurnPlayer(env, base)
    return Player(env, base)
