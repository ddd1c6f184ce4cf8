"""The joint view: a Gymnasium environment with one agent that takes all decisions."""

from collections.abc import Collection, Mapping
from copy import deepcopy
from typing import Any

import numpy as np
from gymnasium import spaces

from ..core import Agent, EpisodeState, Point, checked_actions, duplicate
from ..errors import InvalidActionError, ViewError, short_repr
from ..simulation import RULE
from .base import OneAgentView


class Joint:
    """The agents of a roster, combined into one: its spaces, and its actions and results in an episode."""

    def __init__(self, roster: Mapping[str, Point], *, flatten: bool) -> None:
        """Combine the spaces, or raise ``ViewError`` if they cannot be flattened."""
        self.roster, self._flatten = roster, flatten
        observations = {
            name: deepcopy(point.definition.observation_space) for name, point in roster.items()
        }
        actions = {name: deepcopy(point.definition.action_space) for name, point in roster.items()}
        self.observation_space: spaces.Space[Any] = spaces.Dict(observations)
        self.action_space: spaces.Space[Any] = spaces.Dict(actions)
        if flatten:
            self.observation_space = _concatenate(observations.values())
            self.action_space = _concatenate(actions.values(), discrete=True)
            self._places: dict[str, int | slice] = {}  # of each agent's action in the flattened one
            begin = 0
            for name, space in actions.items():
                length = space.shape[0] if space.shape else 1
                self._places[name] = slice(begin, begin + length) if space.shape else begin
                begin += length

    def actions(self, episode: EpisodeState, action: Any) -> dict[str, Any]:
        """Return the actions of the live agents, or raise ``InvalidActionError`` if one is missing."""
        actions = action
        if action is RULE:
            actions = dict.fromkeys(self.roster, RULE)
        elif self._flatten:
            if not isinstance(action, np.ndarray) or action.shape != self.action_space.shape:
                raise InvalidActionError(
                    f"the joint action {short_repr(action)} is not in"
                    f" {short_repr(self.action_space)}; with flatten=True, it is a NumPy array"
                )
            actions = {name: action[place] for name, place in self._places.items()}
        elif not isinstance(action, Mapping) or set(action) != set(self.roster):
            given = list(action) if isinstance(action, Mapping) else action
            raise InvalidActionError(
                f"a joint action is a dict with an action for each of {', '.join(self.roster)};"
                f" given: {short_repr(given)}"
            )
        return {name: actions[name] for name in self.roster if name in episode.agents}

    def check(self, episode: EpisodeState, action: Any) -> None:
        """Check the joint action of a vector environment, as far as possible before the simulation moves."""
        actions = self.actions(episode, action)
        if any(part is RULE for part in actions.values()):
            raise InvalidActionError(
                "RULE is not an action in vector environments; use joint_env, or policies="
            )
        checked_actions(episode, actions)

    def observe(self, episode: EpisodeState) -> Any:
        """Return the observations of all agents.

        An agent that has ended keeps its last observation.
        """
        observations = {}
        for name, agent in self.agents(episode).items():
            observation = agent.observation
            observations[name] = (
                agent.point.blank() if observation is None else duplicate(observation)
            )
        if self._flatten:
            return np.concatenate(list(observations.values())).astype(self.observation_space.dtype)
        return observations

    def reward(self, episode: EpisodeState) -> float:
        """Return the sum of the rewards of a step."""
        reward = 0.0
        for agent in (*episode.just_ended, *episode.agents.values()):
            reward += agent.reward
        return reward

    def agents(self, episode: EpisodeState) -> dict[str, Agent]:
        """The agents of an episode, live or ended, in the order of the roster."""
        return {name: episode.agents.get(name) or episode.ended[name] for name in self.roster}

    def inform(self, episode: EpisodeState, before: float | None) -> dict[str, Any]:
        """Return the info of a step or a reset. ``before``: the time of the previous one."""
        agents = self.agents(episode)
        acted = () if episode.round is None else episode.round.acted
        info: dict[str, Any] = {
            "deciding": episode.pending.name if episode.pending is not None else "",
            "acted": {name: name in acted for name in agents},
        }
        masks = {
            name: duplicate(agent.mask) for name, agent in agents.items() if agent.mask is not None
        }
        if masks:
            info["action_mask"] = masks
        if episode.clock is not None:
            info |= episode.clock.read(before)
        return info


class SimulationJointEnv(OneAgentView):
    """A simulation as a Gymnasium environment with one agent that takes all decisions. Made by ``joint_env``.

    A step is a round of the parallel view with an action for each agent. The reward is the sum of
    their rewards. The agents are those that are known when the environment is made: those whose
    names are strings, those in ``possible_agents``, and those that the simulation's
    ``expected_calls`` announces after a reset.

    Attributes:
        observation_space, action_space: ``Dict`` spaces by agent. With ``flatten=True``:
            one-dimensional ``Box`` spaces, the concatenation of those of the agents (the paper's
            two-dimensional action space). ``Discrete`` and one-dimensional ``MultiDiscrete`` action
            spaces become one ``MultiDiscrete``.
    """

    _option = "flatten"
    _in_rounds = True
    _agent = "joint"
    _last_time: float | None = None  # the time of the previous reset or step

    def set_up(self) -> None:
        session = self.session
        if not self._plan.complete:
            if not hasattr(session.simulation, "expected_calls"):
                points = ", ".join(
                    point.hook.name for point in self._plan.active if point.agent is None
                )
                raise ViewError(
                    "all agents must be known when the environment is made, and a callable names"
                    f" those of {points}; declare them with possible_agents=, let the simulation"
                    " announce them (expected_calls), or name the one agent of a single view with"
                    " agent="
                )
            agents = session.start(0, None, in_rounds=True).agents
            roster = {name: agent.point for name, agent in agents.items()}
            self._plan = self._plan.declared(roster)
            session.declare(self._plan)
        self._roster = self._plan.roster
        self.joint = self._definition = Joint(self._roster, flatten=self._plan.options.flatten)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Play a round with an action for each agent.

        Args:
            action: An action in the action space, with an action for each agent (those of ended
                agents are not used). ``RULE``, or ``RULE`` instead of an agent's action, lets the
                rule decide.

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
        session = self.session
        episode = session.episode
        if episode is None or (session.lock is not None and not session.lock.held):
            return self._step_alone(SimulationJointEnv.step, action)  # type: ignore[no-any-return]
        joint = self.joint
        episode.step(joint.actions(episode, action))
        if self._shows:
            self._show()
        info = self._inform(episode)
        return (
            joint.observe(episode),
            joint.reward(episode),
            episode.terminated,
            episode.truncated,
            info,
        )

    def _begin(self, episode: EpisodeState) -> tuple[Any, dict[str, Any]]:
        self._last_time = None
        return self.joint.observe(episode), self._inform(episode)

    def _inform(self, episode: EpisodeState) -> dict[str, Any]:
        info = self.joint.inform(episode, self._last_time)
        self._last_time = info.get("time")
        return info


def _concatenate(parts: Collection[Any], *, discrete: bool = False) -> spaces.Space[Any]:
    """Return the space of concatenated vectors. ``discrete``: they may all be discrete, too."""
    kinds = (spaces.Discrete, spaces.MultiDiscrete)
    if discrete and all(isinstance(space, kinds) and np.ndim(space.start) < 2 for space in parts):
        numbers = [
            np.atleast_1d(space.nvec if isinstance(space, kinds[1]) else space.n) for space in parts
        ]
        starts = [np.atleast_1d(space.start) for space in parts]
        return spaces.MultiDiscrete(np.concatenate(numbers), start=np.concatenate(starts))
    for space in parts:
        if not isinstance(space, spaces.Box) or len(space.shape) != 1:
            raise ViewError(
                "flatten=True needs one-dimensional Box spaces, and actions that are all"
                f" continuous or all discrete, not {space}"
            )
    return spaces.flatten_space(spaces.Tuple(parts))
