"""The turn view: a Gymnasium environment in which one learner takes each decision as it arises."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import exp
from typing import Any, NamedTuple, NoReturn

import numpy as np
from gymnasium import spaces

from ..core import (
    MASK,
    Action,
    ActionCode,
    Agent,
    Encode,
    EpisodeState,
    Info,
    Mask,
    Observation,
    Plan,
    Space,
    common_actions,
    common_observations,
)
from ..decision import DecisionPoint
from ..errors import ViewError, listed
from ..simulation import RULE
from .agents import refuse_unknown_agents
from .base import OneAgentView, StepResult

RULE_ACTION = "rule_action"
"""The key of the rule's action in infos."""


class Seat(NamedTuple):
    """The decision point of some agents, as the learner sees it.

    Attributes:
        kind: The number of the point.
        encode: Encodes an observation of theirs. None: their space is the common one.
        code: Translates between their actions and the learner's.
        renew_mask: Makes the mask if all their actions are legal. None: nothing can be masked.
    """

    kind: np.int64
    encode: Encode | None
    code: ActionCode
    renew_mask: Callable[[], Mask] | None


class _Seats(dict[DecisionPoint, Seat]):
    """The seats of a view, by decision point."""

    def __missing__(self, hook: DecisionPoint) -> NoReturn:
        known = ", ".join(each.name for each in self)
        raise ViewError(f"{hook.name} is no decision point of this view, which has {known}")


class Turn:
    """The agents of a plan, as one learner that decides for each of them in turn.

    Attributes:
        observation_space, action_space: The spaces of the learner.
        translates: Whether the learner's actions differ from those of the agents.
        is_plain: Whether results are the agents' own ones, with the kind, the name and the mask.
        seats: The seats by decision point.
    """

    def __init__(self, plan: Plan) -> None:
        """Unite the spaces of the active points, or raise ``ViewError`` if that is not possible."""
        options = plan.options
        definitions = [point.definition for point in plan.active]
        seen = [each.observation_space for each in definitions]
        actions = [each.action_space for each in definitions]
        try:
            common, encoders = common_observations(seen)
            self.action_space, codes = common_actions(actions, clips=options.clip_actions)
        except ViewError as error:
            raise _explained(error, plan) from None
        self.translates = any(space != self.action_space for space in actions)
        hooks = [point.hook for point in plan.active]
        kinds = map(np.int64, range(len(hooks)))
        masks = [code.widen(None) for code in codes]
        renewing = [None if mask is None else np.asarray(mask).copy for mask in masks]
        self.seats = _Seats(zip(hooks, map(Seat, kinds, encoders, codes, renewing), strict=True))
        parts: dict[str, Space] = {"kind": spaces.Discrete(len(hooks)), "observation": common}
        self._indices: dict[str, np.int64] = {}
        if options.possible_agents is not None:
            parts["agent"] = spaces.Discrete(len(plan.roster))
            self._indices = {name: np.int64(index) for index, name in enumerate(plan.roster)}
        self._whole = spaces.Dict(parts)
        self._common = common
        self.observation_space: Space = self._whole
        self._flatten = options.flatten
        has_more = options.flatten or options.state_in_info or options.team_reward
        informs = any(each.rule_action_mapping is not None for each in definitions)
        self.is_plain = not (has_more or informs or self._indices or any(encoders))
        self._beginnings: dict[tuple[np.int64, str], Any] = {}
        if options.flatten:
            self.observation_space = spaces.flatten_space(self._whole)
            if not isinstance(self.observation_space, spaces.Box):
                problem = f"flatten=True needs observations that can be flattened, not {common}"
                raise _explained(ViewError(problem), plan)

    def observe(self, agent: Agent) -> Observation:
        """Return an agent's latest observation as one of the learner."""
        seat = self.seats[agent.point.hook]
        shared: Any = agent.hand_out()
        if seat.encode is not None:
            shared = seat.encode(shared)
        if self._flatten:
            is_box = isinstance(self._common, spaces.Box)
            flat: Any = shared.ravel() if is_box else spaces.flatten(self._common, shared)
            return np.concatenate((self._beginning(agent, seat), flat))
        observation = {"kind": seat.kind, "observation": shared}
        if self._indices:
            observation["agent"] = self._indices[agent.name]
        return observation

    def mask(self, agent: Agent) -> Mask | None:
        """Return the mask of the learner's actions. None: nothing can be masked."""
        return self.seats[agent.point.hook].code.widen(agent.mask)

    def decode(self, agent: Agent, action: Action) -> Action:
        """Return an agent's own action for one of the learner."""
        return self.seats[agent.point.hook].code.decode(action, agent.mask)

    def _beginning(self, agent: Agent, seat: Seat) -> Any:
        """Return the flattened agent and kind, which come before the observation."""
        key = seat.kind, agent.name if self._indices else ""
        if key not in self._beginnings:
            numbers = {"kind": seat.kind}
            if self._indices:
                numbers["agent"] = self._indices[agent.name]
            parts: list[Any] = [
                spaces.flatten(self._whole[name], numbers[name]) for name in sorted(numbers)
            ]
            self._beginnings[key] = np.concatenate(parts).astype(self.observation_space.dtype)
        return self._beginnings[key]


def _explained(error: ViewError, plan: Plan) -> ViewError:
    """Add the decision points whose space an error names."""
    names = [
        point.hook.name
        for point in plan.active
        for space in (point.definition.observation_space, point.definition.action_space)
        if f" {space}" in str(error)
    ]
    return ViewError(
        f"{error}; it is the space of {listed(names)}, which needs another one, or an answer by"
        " policies="
    )


class SimulationTurnEnv(OneAgentView):
    """A simulation as a Gymnasium environment of one learner that takes each decision in turn.

    ``turn_env`` makes it. A step answers the pending decision, and runs to the next one of any
    agent, in the order of the AEC view.

    Attributes:
        observation_space: A ``Dict`` of the deciding agent's ``observation``, its ``kind`` (the
            decision point, in the order of ``points``), and its ``agent`` (the index in
            ``possible_agents``, if that option was given). With ``flatten=True``, the same as one
            ``Box``. If the agents' observation spaces differ, each is flattened, and padded with
            zeros.
        action_space: The action space of all agents, if they have the same. Otherwise: the largest
            ``Discrete``; for ``Box`` spaces, one in [-1, 1], which is scaled to each agent's own
            bounds; for both, one whose first n parts are preferences for the actions of a
            ``Discrete`` (the largest legal one is taken).
        turn: The agents, united into one learner.
        own_seat: The seat of the agent whose decision is pending, or was the last one.
    """

    own_seat: Seat
    _own_options = ("flatten", "state_in_info")
    _agent_name = "turn"
    _last_time: float | None = None  # the time of the previous reset or step

    def set_up(self) -> None:
        """Unite the agents."""
        self.turn: Turn = self.session.plan.derive(Turn)
        episode = self.session.episode
        if episode is not None and episode.pending is not None:
            self.own_agent = episode.pending
            self.own_seat = self.turn.seats[episode.pending.point.hook]

    @classmethod
    def adapt(cls, plan: Plan) -> Plan:
        """Check that a plan allows this view, and let agents decide at points of any spaces."""
        refuse_unknown_agents(plan)
        return super().adapt(replace(plan, unites=True))

    @classmethod
    def spaces_of(cls, plan: Plan) -> tuple[Space, Space]:
        """Return the spaces of the learner."""
        turn: Turn = plan.derive(Turn)
        return turn.observation_space, turn.action_space

    def _original_spaces(self, agent: str) -> tuple[Space, Space]:
        return self.spaces_of(self.session.plan)

    def begin(self, episode: EpisodeState) -> tuple[Observation, Info]:
        """Return the observation and the info of a reset."""
        self._last_time = None
        agent = episode.pending
        if agent is None:  # all moves were forced
            agents = (*episode.agents.values(), *episode.ended.values())
            agent = next(agent for agent in agents if agent.decided)
        self.own_agent = agent
        self.own_seat = self.turn.seats[agent.point.hook]
        observation, *_, info = self.read(episode, begins=True)
        return observation, info

    def step(self, action: Action) -> StepResult:
        """Answer the pending decision with an action, or ``RULE``, and run to the next one.

        Returns:
            Observation; reward: the sum of the rewards of all agents since the last step (a Python
            float); terminated; truncated; info. The last observation is that of the agent that
            decided last. ``info["agent"]`` is the name of the deciding agent.
            ``info["action_mask"]`` exists if an agent has a ``Discrete`` action space.
            ``info["elapsed"]`` and ``info["discount"]`` count from the last step.

        Raises:
            InvalidActionError: The action is not legal. The environment does not change.
            BaseException: Any other error of ``SimulationAECEnv.step``.
        """
        episode = self.session.episode
        if episode is None or (self._lock and not self._lock.held):
            return self._step_in_lock(SimulationTurnEnv.step, action)
        turn = self.turn
        if turn.translates:
            action = self._translate(episode, action)
        episode.step(action)
        if self._shows:
            self.show_step()
        agent = episode.pending
        if agent is None or agent.info or episode.just_ended or not turn.is_plain:
            return self.read(episode)
        # The same as in ``read``, whose call and checks take a twentieth of a step.
        self.own_agent = agent
        self.own_seat = seat = turn.seats[agent.point.hook]
        renew = seat.renew_mask
        info: Info = {"agent": agent.name}
        if renew is not None:
            info[MASK] = renew()
        observation = {"kind": seat.kind, "observation": agent.hand_out()}
        return observation, agent.reward, False, False, info

    def _translate(self, episode: EpisodeState, action: Action) -> Action:
        """Return the deciding agent's own action for one of the learner."""
        agent = episode.pending
        if agent is None or action is RULE:
            return action
        return self.turn.decode(agent, action)

    def read(self, episode: EpisodeState, *, begins: bool = False) -> StepResult:
        """Return the results of a step, or of a reset, which leaves rewards to the first step."""
        turn = self.turn
        before = self.own_agent
        seat_before = self.own_seat
        agent = episode.pending
        if agent is None:
            agent = before
            reward = sum([each.reward for each in episode.agents.values()], 0.0)
        else:
            reward = agent.reward
            self.own_agent = agent
        if episode.just_ended and not begins:
            reward += sum([each.reward for each in episode.take_ended()])
        if episode.earned is not None:
            reward = episode.earned
        self.own_seat = seat = turn.seats[agent.point.hook]
        info = {**agent.info, "agent": agent.name}
        if agent.mask is None:
            if seat.renew_mask is not None:
                info[MASK] = seat.renew_mask()
        elif turn.translates:  # else the info has it
            info[MASK] = seat.code.widen(agent.mask)
        noted = info.pop(RULE_ACTION, None)
        if agent is not before:  # else it is of an earlier step
            noted = before.noted_action
        if noted is not None:
            info[RULE_ACTION] = seat_before.code.encode(noted)
        if episode.clock is not None:
            self._add_times(episode, agent, info)
        if episode.plan.options.state_in_info:
            info["state"] = self.state()
        terminated, truncated = self.read_end(episode)
        return turn.observe(agent), reward, terminated, truncated, info

    def _add_times(self, episode: EpisodeState, agent: Agent, info: Info) -> None:
        """Add the times since the last step to an agent's info."""
        if agent is not episode.pending and episode.clock is not None:  # it may have ended earlier
            info |= episode.clock.read(None)
        now = info["time"]
        info["elapsed"] = elapsed = 0.0 if self._last_time is None else now - self._last_time
        self._last_time = now
        rate = episode.plan.options.discount_rate
        if rate is not None:
            info["discount"] = exp(-rate * elapsed)

    def validate(self, action: Action) -> Action:
        """Validate an action for the pending decision, before the simulation moves."""
        episode = self.episode
        action = self._translate(episode, action)
        return action if episode.pending is None else episode.pending.validate(action)

    def masks(self) -> list[Mask]:
        """Return the mask of the deciding agent."""
        agent = self.episode.pending or self.own_agent
        mask = self.turn.mask(agent)
        return [agent.point.open_mask() if mask is None else mask]
