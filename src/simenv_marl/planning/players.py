"""The players of the views of several agents."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeGuard

from gymnasium import spaces

from ..core import MASK, Info, Mask, Policy, checked_actions, pending_view
from ..data.deployed import JointPolicy
from ..envs import (
    SimulationAECEnv,
    SimulationJointEnv,
    SimulationParallelEnv,
    SimulationTurnEnv,
)
from ..errors import EpisodeOverError, OptionValueError
from ..simulation import EVERYONE, RULE, Action, Observation, Sentinel
from .player import Environment, Player, Policies


class UnitedPlayer(Player):
    """The one learner of a view that unites all agents."""

    sees_rewards = False

    def __init__(
        self,
        env: Environment,
        base: Policy,
    ) -> None:
        super().__init__(env, base, "all agents")

    @property
    def number(self) -> int:
        """The number of its steps."""
        return self.episode.turns

    def _decide_by(self, policies: Policies) -> Action:
        """Return the learner's action, by its policy or those of the agents."""
        if self.name in policies:
            return super()._decide_by(policies)
        return self._unite(policies)

    def _unite(self, policies: Policies) -> Action:
        """Return the learner's action by policies of the agents."""
        raise NotImplementedError


class JointPlayer(UnitedPlayer):
    """The one agent of a joint view. Its action holds the actions of all agents of the roster."""

    view: SimulationJointEnv

    def __init__(
        self,
        env: Environment,
        base: Policy,
    ) -> None:
        super().__init__(env, base)
        observation = self.view.joint.read(self.episode)[0]
        self.latest = {self.name: (observation, {})}
        space = self.view.action_space
        is_by_agent = isinstance(base, Mapping) and not self._learns(self._bases)
        if is_by_agent and not isinstance(space, spaces.Dict):
            raise OptionValueError(
                "a base by agent needs a joint view without flatten=True; pass one policy for all"
                " agents"
            )

    def _learns(self, policies: Policies) -> TypeGuard[dict[Sentinel, JointPolicy]]:
        """Return whether policies are those of a learner of this view."""
        policy = policies.get(EVERYONE)
        space = self.view.action_space
        return isinstance(policy, JointPolicy) and policy.joint.action_space == space

    def _check(
        self,
        action: Action,
        mask: Mask | None,
    ) -> None:
        if self._space_of(self.name) == self.view.action_space:
            checked_actions(self.episode, self.view.joint.actions(self.episode.agents, action))
        else:
            samples = self._samples(action, self.name)
            if samples:
                action = {**action, **samples}
            super()._check(action, mask)

    def _unite(self, policies: Policies) -> Action:
        if self._learns(policies):
            pending = self.episode.pending or self.agent
            return policies[EVERYONE].answer_all(self.episode, pending)
        agents = self.episode.agents
        return {
            name: self._decide_for(name, policies) if name in agents else RULE
            for name in self.view.joint.roster
        }


class TurnPlayer(UnitedPlayer):
    """The learner of a turn view, which decides for each agent. ``agent`` decides now."""

    view: SimulationTurnEnv

    def __init__(
        self,
        env: Environment,
        base: Policy,
    ) -> None:
        super().__init__(env, base)
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
        if is_open or space != self.view.action_space:
            super()._check(action, mask)
        else:
            self.view.validate(action)

    def step(self, action: Action) -> float:
        """Take an action, run to the next decision of any agent, and return the reward."""
        reward = super().step(action)
        self.agent = self.view.own_agent
        return reward

    def _unite(self, policies: Policies) -> Action:
        action = self._decide_for(self.agent.name, policies)
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
                self.note()
                self._step_env(self._decide_for(name), name)
        self.over = True
        return 0.0

    def _observe(self, name: str) -> tuple[Observation, Info]:
        observation, _, _, _, info = self.env.last()
        return observation, info


class ParallelPlayer(Player):
    """An agent of a parallel view. Its actions are parts of rounds."""

    _total = 0.0

    def reward_so_far(self) -> float:
        """Return the agent's rewards of the rounds since its latest decision."""
        return self._total

    def step(self, action: Action) -> float:
        """Play a round, and further ones without the agent until its decision is pending again."""
        self._total = 0.0
        self._play({self.name: action})
        while not self.over and self.episode.pending is not self.agent:
            self.note()
            self._play({})
        return self._total

    def _play(self, actions: dict[str, Action]) -> None:
        """Play a round. The other agents follow their bases. Add the agent's reward."""
        for name in self.episode.agents:
            if name != self.name:
                actions[name] = self._decide_for(name)
        observations, rewards, terminations, truncations, infos = self._step_env(actions, self.name)
        self.latest = {name: (observations[name], infos[name]) for name in observations}
        self.episode.memory.clear()  # policies for all agents answer each round anew
        over = terminations.get(self.name, True) or truncations[self.name]
        self.over = over or self.agent.ended  # pad_agents keeps ended agents
        self._total += float(rewards.get(self.name, 0.0))


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
