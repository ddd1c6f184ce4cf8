"""The deciding agent in a branch, in each view: it takes its candidate first, and then follows its base.

The environment may have wrappers. The agent's actions go through them, and its observations and rewards come from them.
``RULE``, which only the unwrapped environment knows, replaces the action that the wrappers let through.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any
from zlib import crc32

from gymnasium import spaces

from ..core.actions import ILLEGAL, action_check, mask_allows
from ..core.agent import Agent
from ..core.asking import AskingPolicy, base_of
from ..core.roster import two_arguments
from ..core.spaces import duplicate
from ..envs import SimulationAECEnv, SimulationEnv, SimulationJointEnv, SimulationParallelEnv
from ..envs.base import View
from ..errors import (
    EpisodeOverError,
    InvalidActionError,
    OptionValueError,
    UnknownAgentError,
    ViewError,
    did_you_mean,
    short_repr,
)
from ..simulation import RULE


class Player:
    """The agent whose decision is pending.

    Attributes:
        env: The environment, with or without wrappers.
        view: The unwrapped environment.
        episode: Its episode.
        agent: The name of the agent.
        own: The episode's record of the agent.
        over: Whether the agent's episode has ended.
    """

    def __init__(self, env: Any, base: Any) -> None:
        """Take the agent's place in an environment whose decision is pending.

        Args:
            env: The environment.
            base: What decides after the candidate: ``RULE``, a policy of the agent, or a dict of policies by agent.
        """
        self.env, self.view, self.base = env, env.unwrapped, base
        self.episode = self.view.episode
        self.own: Agent = self.episode.pending or self.episode.consulted
        self.agent = self.own.name
        self.over = False
        self._policies: dict[str, Any] = {}
        self._seen: Any = None  # the observation and the info of the latest step

    # -- before anything moves --------------------------------------------------------------------

    @property
    def space(self) -> spaces.Space[Any]:
        """The action space of the wrapped environment."""
        space: spaces.Space[Any] = self.env.action_space
        return space

    def candidates(self, actions: Any, *, legal: bool = False) -> list[Any]:
        """Return the candidates for the pending decision.

        Args:
            actions: The candidates. None: all legal actions of a ``Discrete``.
            legal: Whether masked candidates are left out. Otherwise they are an error.

        Raises:
            OptionValueError: These are not candidates.
            InvalidActionError: A candidate is not legal.
        """
        if actions is None:
            space = self.space
            if not isinstance(space, spaces.Discrete):
                raise OptionValueError(
                    f"actions=None needs a Discrete action space; list candidates of {short_repr(space)}"
                )
            actions, legal = range(int(space.start), int(space.start + space.n)), True
        try:
            listed = [] if isinstance(actions, (str, Mapping)) else list(actions)
        except TypeError:
            listed = []
        if not listed:
            raise OptionValueError(f"actions must be a list of candidates, not {short_repr(actions)}")
        found = [action for action in listed if not (legal and self._is_masked(action))]
        if not found:
            raise InvalidActionError(
                f"all candidates of {self.agent!r} are masked; its mask is {short_repr(self.own.mask)}"
            )
        for action in found:
            if action is not RULE:
                self._check(action)
        return found

    def _check(self, action: Any) -> None:
        if self.env is self.view:
            self.own.point.checked(action, self.agent, self.own.mask)
        elif (
            self.own.point.check if self.space == self.own.point.definition.action_space else action_check(self.space)
        )(action) is ILLEGAL:
            raise InvalidActionError(
                f"the action {short_repr(action)} of {self.agent!r} is not in {short_repr(self.space)}"
            )
        elif self._is_masked(action):
            raise InvalidActionError(
                f"the action {short_repr(action)} is masked; the mask is {short_repr(self.own.mask)}"
            )

    def _is_masked(self, action: Any) -> bool:
        """Return whether the mask forbids an action; wrappers may have replaced the space of the mask."""
        space, mask = self.own.point.definition.action_space, self.own.mask
        if mask is None or action is RULE or self.space != space:
            return False
        known = action_check(space)(action)
        return known is not ILLEGAL and not mask_allows(space, mask, known)

    def check_base(self) -> None:
        """Check that the base can answer.

        Raises:
            OptionValueError: It is not a policy.
            UnknownAgentError: It names an agent that does not exist.
        """
        base = self.base
        for policy in base.values() if isinstance(base, Mapping) else [base]:
            if policy is not RULE and not callable(policy):
                raise OptionValueError(f"base must be RULE, a policy, or policies by agent, not {short_repr(base)}")
        for name in base if isinstance(base, Mapping) else ():
            if not self._may_be(name):
                known = [*self.episode.agents, *self.episode.others]
                raise UnknownAgentError(
                    f"base names {short_repr(name)}, which is not an agent here; the agents are:"
                    f" {known}{did_you_mean(name, known)}"
                )

    def _may_be(self, name: Any) -> bool:
        """Return whether an agent of that name exists, or may appear."""
        found: bool = self.episode.may_be(name)
        return found

    @property
    def entropy(self) -> list[int]:
        """Return numbers that distinguish this decision from all others, however the episode is played."""
        episode = self.episode
        number = self.own.consultations - 1 if self.own.consultations else episode.turns
        return [episode.seed, number, crc32(self.agent.encode(errors="surrogatepass"))]

    # -- in a branch ------------------------------------------------------------------------------

    def now(self) -> float:
        """Return the simulation's time."""
        return float(self.episode.clock())

    def begin(self) -> None:
        """Prepare a branch."""
        self.view.stop_showing()

    def step(self, action: Any) -> float:
        """Take an action, go on to the agent's next decision or its end, and return the reward."""
        observation, reward, terminated, truncated, info = self._through(action)
        self._seen, self.over = (observation, info), terminated or truncated
        return float(reward)

    def allows(self, action: Any) -> bool:
        """Return whether an action that was legal at another decision is legal now."""
        return not self._is_masked(action)

    def decide(self) -> Any:
        """Return the agent's action by its base."""
        return self._ask(self.agent, *(self._seen or self._observed(self.own)))

    def _observed(self, agent: Agent) -> tuple[Any, dict[str, Any]]:
        """Return the latest observation and info of an agent."""
        seen = agent.point.blank() if agent.observation is None else duplicate(agent.observation)
        return seen, dict(agent.info)

    def _ask(self, name: str, observation: Any, info: Any) -> Any:
        """Return the answer of an agent's base."""
        policy: Any = self._policies.get(name)
        if policy is None:
            own: Any = self.base if name == self.agent or isinstance(self.base, Mapping) else RULE
            base = base_of(own, name)
            policy = self._policies[name] = base if base is RULE else two_arguments(base)
        if policy is RULE:
            return RULE
        if isinstance(policy, AskingPolicy):
            return policy.answer(observation, info, self.env)
        return policy(observation, info)

    def _through(self, action: Any) -> Any:
        """Step through the wrappers; ``RULE`` reaches the unwrapped environment unchanged."""
        if self.env is self.view or action is not RULE:
            return self.env.step(action)
        return self._replacing(lambda given: action, self._placeholder(self.space, self.episode.pending))

    @staticmethod
    def _placeholder(space: spaces.Space[Any], agent: Agent) -> Any:
        """Return a legal action that wrappers see in place of another one."""
        mask = agent.mask if space == agent.point.definition.action_space else None
        return space.sample() if mask is None else space.sample(mask)

    def _replacing(self, replace: Callable[[Any], Any], placeholder: Any) -> Any:
        """Step through the wrappers with a placeholder, and replace it behind them."""
        view, step = self.view, type(self.view).step
        vars(view)["step"] = lambda given: step(view, replace(given))
        try:
            return self.env.step(placeholder)
        finally:
            del vars(view)["step"]


class SinglePlayer(Player):
    """The agent of a single view. The simulation answers for all other agents."""

    def begin(self) -> None:
        """Prepare a branch."""
        super().begin()
        if isinstance(self.base, Mapping):
            self.episode.leave_to(self.base)


class JointPlayer(Player):
    """The one agent of a joint view, whose action holds the actions of the roster's agents."""

    def __init__(self, env: Any, base: Any) -> None:
        super().__init__(env, base)
        self.agent = "all agents"

    def _check(self, action: Any) -> None:
        if self.env is self.view:
            self.episode.check(self.view.joint.actions(self.episode, action))
        else:
            super()._check(self._without_rules(action))

    def _without_rules(self, action: Any) -> Any:
        """Return a joint action in which legal actions replace the parts that are ``RULE``."""
        if not isinstance(action, Mapping):
            return action
        space: Any = self.space
        return {name: space[name].sample() if part is RULE else part for name, part in action.items()}

    def _is_masked(self, action: Any) -> bool:
        return False

    def allows(self, action: Any) -> bool:
        """Return whether an action that was legal at another decision is legal now."""
        try:
            self._check(action)
        except InvalidActionError:
            return False
        return True

    def check_base(self) -> None:
        """Check that the base can answer.

        Raises:
            OptionValueError, UnknownAgentError: It cannot.
        """
        super().check_base()
        if isinstance(self.base, Mapping) and not isinstance(self.view.action_space, spaces.Dict):
            raise OptionValueError(
                "a base by agent needs a joint view without flatten=True; pass one policy for all agents"
            )

    def _may_be(self, name: Any) -> bool:
        return name in self.view.joint.roster

    def decide(self) -> Any:
        """Return the actions of all agents by the base."""
        if not isinstance(self.base, Mapping):
            seen: Any = self._seen or (self.view.joint.observe(self.episode), {})
            return self._ask(self.agent, *seen)
        agents = self.episode.agents
        return {
            name: self._ask(name, *self._observed(agents[name])) if name in agents else RULE
            for name in self.view.joint.roster
        }

    def step(self, action: Any) -> float:
        """Play a round."""
        ruled = {name: RULE for name, part in action.items() if part is RULE} if isinstance(action, Mapping) else {}
        if ruled and self.env is not self.view:
            results = self._replacing(lambda given: {**given, **ruled}, self._without_rules(action))
        else:
            results = self._through(action)
        observation, reward, terminated, truncated, info = results
        self._seen, self.over = (observation, info), terminated or truncated
        return float(reward)


class AECPlayer(Player):
    """An agent of an AEC view."""

    def __init__(self, env: Any, base: Any) -> None:
        super().__init__(env, base)
        if self.view.agent_selection != self.agent:
            raise EpisodeOverError(
                f"{self.view.agent_selection!r} is selected, but its episode has ended: call step(None) before you"
                f" plan the decision of {self.agent!r}"
            )

    @property
    def space(self) -> spaces.Space[Any]:
        """The action space of the wrapped environment."""
        space: spaces.Space[Any] = self.env.action_space(self.env.agent_selection)
        return space

    def step(self, action: Any) -> float:
        """Take an action; all other agents decide until this agent is selected again."""
        env = self.env
        self._through(action)
        while env.agents:
            name = env.agent_selection
            if name == self.agent:
                _, reward, terminated, truncated, _ = env.last(observe=False)
                self._seen, self.over = None, terminated or truncated
                return float(reward)
            ended = env.terminations[name] or env.truncations[name]
            self._through(None if ended else self._decision_of(name))
        self.over = True
        return 0.0

    def decide(self) -> Any:
        """Return the agent's action by its base."""
        return self._decision_of(self.agent)

    def _decision_of(self, name: str) -> Any:
        """Return the answer of the selected agent's base."""
        if self.base is RULE or (name != self.agent and not isinstance(self.base, Mapping)):
            return RULE
        observation, _, _, _, info = self.env.last()
        return self._ask(name, observation, info)


class ParallelPlayer(Player):
    """An agent of a parallel view, whose actions are part of rounds."""

    def __init__(self, env: Any, base: Any) -> None:
        super().__init__(env, base)
        self._seen = {}

    @property
    def space(self) -> spaces.Space[Any]:
        """The action space of the wrapped environment."""
        space: spaces.Space[Any] = self.env.action_space(self.agent)
        return space

    def step(self, action: Any) -> float:
        """Play a round, and further rounds without an action of the agent until its decision is pending again."""
        reward = self._round({self.agent: action})
        while not self.over and self.episode.pending is not self.own:
            reward += self._round({})
        return reward

    def _round(self, own: dict[str, Any]) -> float:
        agents = self.episode.agents
        answers = own | {name: self._decision_of(name) for name in agents if name != self.agent}
        ruled = {name: answer for name, answer in answers.items() if answer is RULE}
        if ruled and self.env is not self.view:
            placeholders = answers | {
                name: self._placeholder(self.env.action_space(name), agents[name]) for name in ruled
            }
            results = self._replacing(lambda given: {**given, **ruled}, placeholders)
        else:
            results = self.env.step(answers)
        observations, rewards, terminations, truncations, infos = results
        self._seen = {name: (observations[name], infos.get(name, {})) for name in observations}
        over = terminations.get(self.agent, True) or truncations.get(self.agent, True)
        self.over = bool(over or self.own.ended)  # with padded=True, ended agents stay
        return float(rewards.get(self.agent, 0.0))

    def decide(self) -> Any:
        """Return the agent's action by its base."""
        return self._decision_of(self.agent)

    def _decision_of(self, name: str) -> Any:
        return self._ask(name, *(self._seen.get(name) or self._observed(self.episode.agents[name])))


PLAYERS: dict[type, type[Player]] = {
    SimulationAECEnv: AECPlayer,
    SimulationParallelEnv: ParallelPlayer,
    SimulationJointEnv: JointPlayer,
    SimulationEnv: SinglePlayer,
}
"""The players, by the class of the view."""


def player_of(env: Any, base: Any) -> Player:
    """Return the player of the agent whose decision is pending.

    Raises:
        ViewError: ``env`` is not an environment of one simulation.
        ResetNeededError, ReentrancyError: No decision is pending.
    """
    view = getattr(env, "unwrapped", env)
    if not isinstance(view, View):
        raise ViewError(f"planning needs an environment of one simulation, not {short_repr(env)}")
    view.check_pending()
    return next(made for kind, made in PLAYERS.items() if isinstance(view, kind))(env, base)
