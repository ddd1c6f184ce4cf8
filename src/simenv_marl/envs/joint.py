"""The joint view: a Gymnasium environment with one agent that takes all decisions."""

from collections.abc import Collection, Mapping, Sequence
from copy import deepcopy
from typing import Any, Self

import numpy as np
from gymnasium import spaces

from ..core import (
    Action,
    EpisodeState,
    Info,
    Observation,
    Plan,
    Space,
    checked_actions,
    duplicate,
)
from ..errors import InvalidActionError, ViewError, short_repr
from ..simulation import RULE, optional_method
from .base import OneAgentView, StepResult


class Joint:
    """The agents of a plan, combined into one agent.

    Attributes:
        roster: The decision points of the agents, by agent.
        observation_space, action_space: The combined spaces.
    """

    def __init__(self, plan: Plan) -> None:
        """Combine the spaces, or raise ``ViewError`` if they cannot be flattened."""
        self.roster = plan.roster
        observations = {}
        actions = {}
        for name, point in self.roster.items():
            # Copies, because agents may share a space, and each draws from its own generator.
            observations[name] = deepcopy(point.definition.observation_space)
            actions[name] = deepcopy(point.definition.action_space)
        self.observation_space: Space = spaces.Dict(observations)
        self.action_space: Space = spaces.Dict(actions)
        self._flatten = plan.options.flatten
        if not self._flatten:
            return
        self.observation_space = _concatenate(observations.values())
        self.action_space = _concatenate(actions.values(), discrete=True)
        # The index of each agent's action in the flattened one.
        self._places: dict[str, int | slice] = {}
        begin = 0
        for name, space in actions.items():
            end = begin + (space.shape[0] if space.shape else 1)
            self._places[name] = slice(begin, end) if space.shape else begin
            begin = end

    def actions(
        self,
        episode: EpisodeState,
        action: Action,
    ) -> dict[str, Action]:
        """Return the actions of the live agents.

        Raises:
            InvalidActionError: The action lacks one, or has another form.
        """
        live = [name for name in self.roster if name in episode.agents]
        if action is RULE:
            return dict.fromkeys(live, RULE)
        if self._flatten:
            if not isinstance(action, np.ndarray) or action.shape != self.action_space.shape:
                raise InvalidActionError(
                    f"the joint action {short_repr(action)} is not in"
                    f" {short_repr(self.action_space)}; with flatten=True, it is a NumPy array"
                )
            return {name: action[self._places[name]] for name in live}
        if not isinstance(action, Mapping) or set(action) != set(self.roster):
            keys = list(action) if isinstance(action, Mapping) else action
            raise InvalidActionError(
                f"a joint action is a dict with an action for each of {', '.join(self.roster)};"
                f" given: {short_repr(keys)}"
            )
        return {name: action[name] for name in live}

    def read(self, episode: EpisodeState, before: float | None) -> StepResult:
        """Return the results of a reset or a step. ``before``: the time of the previous one.

        An agent that has ended keeps its last observation. The reward is the sum of all rewards.
        """
        observations = {}
        acted = {}
        masks = {}
        used = () if episode.round is None else episode.round.acted
        for name in self.roster:
            agent = episode.agents.get(name) or episode.ended[name]
            observations[name] = agent.hand_out()
            acted[name] = name in used
            if agent.mask is not None:
                masks[name] = duplicate(agent.mask)
        pending = episode.pending
        info: Info = {"deciding": "" if pending is None else pending.name, "acted": acted}
        if masks:
            info["action_mask"] = masks
        if episode.clock is not None:
            info |= episode.clock.read(before)
        reward = 0.0
        for agent in (*episode.just_ended, *episode.agents.values()):
            reward += agent.reward
        joined: Observation = observations
        if self._flatten:
            parts = list(observations.values())
            joined = np.concatenate(parts).astype(self.observation_space.dtype)
        return joined, reward, episode.terminated, episode.truncated, info


class SimulationJointEnv(OneAgentView):
    """A simulation as a Gymnasium environment with one agent that takes all decisions.

    ``joint_env`` makes it. A step is a round of the parallel view with an action for each agent.
    The reward is the sum of their rewards. All agents must be known when the environment is made:
    agents with strings as names, agents in ``possible_agents``, and agents that the simulation's
    ``expected_calls`` announces after a reset.

    Attributes:
        observation_space, action_space: ``Dict`` spaces by agent. With ``flatten=True``:
            one-dimensional ``Box`` spaces, which concatenate the spaces of the agents (the paper's
            two-dimensional action space). ``Discrete`` and one-dimensional ``MultiDiscrete`` action
            spaces become one ``MultiDiscrete``.
        joint: The agents, combined into one.
    """

    in_rounds = True
    _option = "flatten"
    _agent_name = "joint"
    _last_time: float | None = None  # the time of the previous reset or step

    def set_up(self) -> None:
        """Combine the agents. If a simulation announces them, reset one to find them."""
        session = self.session
        if not session.plan.complete:
            if optional_method(session.simulation, "expected_calls", "point") is None:
                points = ", ".join(
                    point.hook.name for point in session.plan.active if point.agent is None
                )
                raise ViewError(
                    "all agents must be known when the environment is made, and a callable names"
                    f" those of {points}; declare them with possible_agents=, let the simulation"
                    " announce them (expected_calls), or name the one agent of a single view with"
                    " agent="
                )
            agents = session.start(0, None, in_rounds=True).agents
            roster = {name: agent.point for name, agent in agents.items()}
            session.declare(session.plan.declared(roster))
        self._roster = session.plan.roster
        self.joint: Joint = session.plan.derive(Joint)

    @classmethod
    def spaces_of(cls, plan: Plan) -> tuple[Space, Space]:
        """Return the combined spaces of a plan's agents."""
        joint: Joint = plan.derive(Joint)
        return joint.observation_space, joint.action_space

    def _original_spaces(self, agent: str) -> tuple[Space, Space]:
        return self.spaces_of(self.session.plan)

    def step(self, action: Action) -> StepResult:
        """Play a round with an action for each agent.

        Args:
            action: An action in the action space, with an action for each agent (actions of
                ended agents are not used). ``RULE``, or ``RULE`` instead of an agent's action, lets
                the rule decide.

        Returns:
            Observation, sum of the rewards (a Python float), terminated, truncated, info. An agent
            that has ended keeps its last observation. ``info["deciding"]`` is the name of the agent
            whose decision is pending. ``info["acted"]`` tells for each agent whether its action was
            used. If the simulation has a clock, ``info["time"]`` is its time, and
            ``info["elapsed"]`` the time since the previous step.

        Raises:
            InvalidActionError: The action is not legal, or lacks an agent. The environment does not
                change.
            BaseException: Any other error of ``SimulationAECEnv.step``.
        """
        episode = self.session.episode
        if episode is None or (self._lock and not self._lock.held):
            return self._step_in_lock(SimulationJointEnv.step, action)
        episode.step(self.joint.actions(episode, action))
        if self._shows:
            self.show_step()
        return self.read(episode)

    def begin(self, episode: EpisodeState) -> tuple[Observation, Info]:
        """Return the observation and the info of a reset."""
        self._last_time = None
        observation, *_, info = self.read(episode)
        return observation, info

    def read(self, episode: EpisodeState) -> StepResult:
        """Return the results of a step."""
        results = self.joint.read(episode, self._last_time)
        self._last_time = results[-1].get("time")
        return results

    @classmethod
    def read_all(cls, views: Sequence[Self]) -> tuple[list[Observation], list[float], list[Info]]:
        """Return the observations, rewards and infos of the latest step of several views."""
        results = [view.read(view.episode) for view in views]
        observations, rewards, _, _, infos = map(list, zip(*results, strict=True))
        return observations, rewards, infos

    def validate(self, action: Action) -> Action:
        """Validate a joint action, as far as possible before the simulation moves."""
        episode = self.episode
        if episode.pending is None:
            return {}
        actions = self.joint.actions(episode, action)
        if any(part is RULE for part in actions.values()):
            raise InvalidActionError(
                "RULE is not an action in vector environments; use joint_env, or policies="
            )
        checked_actions(episode, actions)
        return actions


def _concatenate(parts: Collection[Any], *, discrete: bool = False) -> Space:
    """Return the space of concatenated vectors. ``discrete``: they may all be discrete, too."""
    kinds = (spaces.Discrete, spaces.MultiDiscrete)
    if discrete and all(isinstance(space, kinds) and np.ndim(space.start) < 2 for space in parts):
        sizes = [
            np.atleast_1d(space.nvec if isinstance(space, kinds[1]) else space.n) for space in parts
        ]
        starts = [np.atleast_1d(space.start) for space in parts]
        return spaces.MultiDiscrete(np.concatenate(sizes), start=np.concatenate(starts))
    for space in parts:
        if not isinstance(space, spaces.Box) or len(space.shape) != 1:
            raise ViewError(
                "flatten=True needs one-dimensional Box spaces, and actions that are all"
                f" continuous or all discrete, not {space}"
            )
    return spaces.flatten_space(spaces.Tuple(parts))
