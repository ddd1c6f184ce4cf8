"""The joint view: one agent that takes all decisions, and so a Gymnasium environment."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from typing import Any

import numpy as np
from gymnasium import spaces

from ..core.episode import Episode
from ..core.plan import Plan
from ..core.rounds import Rounds
from ..core.spaces import duplicate, open_mask
from ..errors import InvalidActionError, ViewError
from ..simulation import RULE
from .base import OneAgentView


class SimulationJointEnv(OneAgentView):
    """A simulation as a Gymnasium environment whose one agent takes all decisions. Made by ``joint_env``.

    A step is a round of the parallel view with an action for everybody; the reward is the sum. The agents are
    those that are known when it is made: those with names of their own, those in ``possible_agents``, and
    those that the simulation's ``expected_calls`` names after a reset.

    Attributes:
        observation_space, action_space: ``Dict`` spaces keyed by agent, or, flattened, the one-dimensional
            ``Box`` of all of them, one behind the other (the paper's two-dimensional action space); actions of
            ``Discrete`` and one-dimensional ``MultiDiscrete`` spaces come to a ``MultiDiscrete``.
    """

    _episode: Rounds | None
    _agent = "joint"

    def __init__(self, plan: Plan) -> None:
        """Make the environment of a plan.

        Raises:
            ViewError: No agent is known beforehand, or their spaces cannot be flattened.
            SimEnvError: Something else in the plan cannot work.
        """
        super().__init__(plan)
        roster = dict(plan.roster)
        if not plan.complete:
            with_seed = self._session.start(0, None, np.random.default_rng(0), Rounds)
            roster = {agent: record.binding for agent, record in with_seed.agents.items()}
            self._session.close()
            self._plan = self._made_of = self._session.plan = plan.declared(roster)
        self._agents = list(roster)
        observations = {agent: deepcopy(binding.definition.observation_space) for agent, binding in roster.items()}
        actions = {agent: deepcopy(binding.definition.action_space) for agent, binding in roster.items()}
        self._time: float | None = None
        self._flatten = plan.options.flatten
        if self._flatten:
            self.observation_space: spaces.Space[Any] = _concatenate(observations)
            self.action_space: spaces.Space[Any] = _concatenate_actions(actions)
            self._places = _places(actions)
        else:
            self.observation_space, self.action_space = spaces.Dict(observations), spaces.Dict(actions)

    @staticmethod
    def check(plan: Plan) -> None:
        """Make sure that a plan allows this view; every plan does."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the simulation and run it to its first decision.

        Args:
            seed: Seeds the environment's generator and its spaces, and is what the simulation's ``reset``
                gets. None: the simulation gets a seed drawn from the generator.
            options: Handed to the simulation's ``reset``, where that takes them.

        Returns:
            The observation and the info.

        Raises:
            NoDecisionError: The simulation ended without a decision.
            BaseException: Whatever the model, a mapping or a policy raises.
        """
        self._episode = self._begin(seed, options, Rounds)
        self._time = None
        if self._shows:
            self.render()
        return self._observe(), self._info()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Play a round with an action for everybody.

        Args:
            action: In the action space: an action for each agent (those of agents that have ended are not
                used). ``RULE``, or ``RULE`` in place of an agent's action, lets the rule decide.

        Returns:
            Observation, sum of the rewards (a python float), terminated, truncated, info. An agent that has
            ended keeps its last observation. ``info["deciding"]`` names the agent whose decision is pending,
            ``info["acted"]`` tells by agent whether its action was used, and ``info["time"]`` and ``["elapsed"]``,
            where the simulation has a clock, the time and how much has gone by since the step before.

        Raises:
            InvalidActionError: The action is not legal, or lacks an agent. The environment stands where it stood.
            ResetNeededError: There is no episode to go on with.
            BaseException: Whatever the model, a mapping or a policy raises.
        """
        episode = self._episode
        if episode is None:
            raise self._session.not_running()
        actions = self._split(action)
        episode.play({agent: actions[agent] for agent in self._agents if agent in episode.agents})
        reward = 0.0
        for record in (*episode.parting, *episode.agents.values()):
            reward += record.reward
        if self._shows:
            self.render()
        return self._observe(), reward, episode.terminated, episode.truncated, self._info()

    def _seen(self, episode: Episode) -> tuple[Any, ...]:
        return (self._observe(),)

    def _legal(self, episode: Episode) -> list[Any]:
        masks = []
        for agent in self._agents:
            record = episode.record(agent)
            mask = None if record is None else record.mask
            masks.append(open_mask(self._plan.roster[agent].definition.action_space) if mask is None else mask)
        return masks

    def _split(self, action: Any) -> Mapping[str, Any]:
        """The actions of the agents in a joint action."""
        if action is RULE:
            return dict.fromkeys(self._agents, RULE)
        if self._flatten:
            if not isinstance(action, np.ndarray) or action.shape != self.action_space.shape:
                raise InvalidActionError(f"the joint action {action!r} is not in {self.action_space}")
            return {agent: action[place] for agent, place in self._places.items()}
        if not isinstance(action, Mapping) or set(action) != set(self._agents):
            given = list(action) if isinstance(action, Mapping) else action
            raise InvalidActionError(
                f"a joint action is a dict with an action for each of {', '.join(self._agents)}; given: {given!r}"
            )
        return action

    def _observe(self) -> Any:
        episode = self._episode
        assert episode is not None
        observations = {}
        for agent in self._agents:
            record = episode.record(agent)
            if record is None or record.observation is None:
                observations[agent] = self._plan.roster[agent].blank()
            else:
                observations[agent] = duplicate(record.observation)
        if self._flatten:
            return np.concatenate(list(observations.values())).astype(self.observation_space.dtype)
        return observations

    def _info(self) -> dict[str, Any]:
        episode = self._episode
        assert episode is not None
        records = {agent: episode.record(agent) for agent in self._agents}
        info: dict[str, Any] = {
            "deciding": episode.pending.agent if episode.pending is not None else "",
            "acted": {agent: record is not None and record.acted for agent, record in records.items()},
        }
        masks = {
            agent: duplicate(record.mask) for agent, record in records.items() if record and record.mask is not None
        }
        if masks:
            info["action_mask"] = masks
        if episode.clock is not None:
            now = float(episode.clock())
            info["time"], info["elapsed"] = now, now - (now if self._time is None else self._time)
            self._time = now
        return info


def _length(space: spaces.Space[Any]) -> int:
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        raise ViewError(f"flatten=True needs one-dimensional Box spaces, not {space}")
    return space.shape[0]


def _concatenate_actions(parts: Mapping[str, spaces.Space[Any]]) -> spaces.Space[Any]:
    """Actions are one vector where they are all numbers of one kind: all continuous, or all discrete."""
    listed: list[Any] = list(parts.values())
    if not all(_counts(space) for space in listed):
        if any(_counts(space) for space in listed):
            kinds = ", ".join(map(str, listed))
            raise ViewError(f"flatten=True needs actions that are all continuous or all discrete, not {kinds}")
        return _concatenate(parts)
    numbers = [np.atleast_1d(space.nvec if isinstance(space, spaces.MultiDiscrete) else space.n) for space in listed]
    starts = [np.atleast_1d(space.start) for space in listed]
    return spaces.MultiDiscrete(np.concatenate(numbers), start=np.concatenate(starts))


def _counts(space: spaces.Space[Any]) -> bool:
    return isinstance(space, spaces.Discrete) or (isinstance(space, spaces.MultiDiscrete) and len(space.shape) == 1)


def _places(parts: Mapping[str, spaces.Space[Any]]) -> dict[str, int | slice]:
    """By agent, where its action stands in the flattened one."""
    places: dict[str, int | slice] = {}
    begin = 0
    for agent, space in parts.items():
        length = space.shape[0] if space.shape else 1
        places[agent] = slice(begin, begin + length) if space.shape else begin
        begin += length
    return places


def _concatenate(parts: Mapping[str, spaces.Space[Any]]) -> spaces.Box:
    for space in parts.values():
        _length(space)
    boxes: list[Any] = list(parts.values())
    dtype: Any = np.result_type(*(box.dtype for box in boxes))
    low, high = (np.concatenate([getattr(box, side) for box in boxes]).astype(dtype) for side in ("low", "high"))
    return spaces.Box(low, high, dtype=dtype)
