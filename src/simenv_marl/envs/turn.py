"""The turn view: a Gymnasium environment in which one learner takes each decision as it arises."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from operator import methodcaller
from typing import Any, NamedTuple, NoReturn

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

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
from .agents import UnitedView, add_costs, refuse_unknown_agents
from .base import StepResult

RULE_ACTION = "rule_action"
"""The key of the rule's action in infos."""


class Seat(NamedTuple):
    """The decision point of some agents, as the learner sees it.

    Attributes:
        kind: The number of the point. With ``flatten=True``, as the vector of its flattened form.
        encode: Encodes an observation of theirs. None: it is the learner's.
        code: Translates between their actions and the learner's.
        renew_mask: Makes the mask if all their actions are legal. None: nothing can be masked.
    """

    kind: Any
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
        hooks = [point.hook for point in plan.active]
        definitions = [point.definition for point in plan.active]
        seen = [each.observation_space for each in definitions]
        actions = [each.action_space for each in definitions]
        try:
            common, encoders = common_observations(seen)
            self.action_space, codes = common_actions(actions, clips=options.clip_actions)
        except ViewError as error:
            raise _explained(error, plan) from None
        self.translates = any(space != self.action_space for space in actions)
        names = [] if options.possible_agents is None else list(plan.roster)
        has_more = options.flatten or options.state_in_info or options.team_reward or names
        informs = any(each.rule_action_mapping is not None for each in definitions)
        self.is_plain = not (has_more or informs or any(encoders))
        parts: dict[str, Space] = {"kind": spaces.Discrete(len(hooks)), "observation": common}
        if names:
            parts["agent"] = spaces.Discrete(len(names))
        self.observation_space: Space = spaces.Dict(parts)
        kinds: NDArray[Any] = np.arange(len(hooks))
        agents: NDArray[Any] = np.arange(len(names))
        self._flatten = options.flatten
        if options.flatten:
            self.observation_space = spaces.flatten_space(self.observation_space)
            if not isinstance(self.observation_space, spaces.Box):
                problem = f"flatten=True needs observations that can be flattened, not {common}"
                raise _explained(ViewError(problem), plan)
            dtype = self.observation_space.dtype
            kinds = np.eye(len(hooks), dtype=dtype)
            agents = np.eye(len(names), dtype=dtype)
            is_box = isinstance(common, spaces.Box)
            flatten = methodcaller("ravel") if is_box else partial(spaces.flatten, common)
            encoders = [encode or flatten for encode in encoders]
        self._agents = dict(zip(names, agents, strict=True))
        masks = [code.widen(None) for code in codes]
        renewing = [None if mask is None else np.asarray(mask).copy for mask in masks]
        self.seats = _Seats(zip(hooks, map(Seat, kinds, encoders, codes, renewing), strict=True))

    def observe(self, agent: Agent) -> Observation:
        """Return an agent's latest observation as one of the learner."""
        seat = self.seats[agent.point.hook]
        shared = agent.hand_out()
        if seat.encode is not None:
            shared = seat.encode(shared)
        mark = self._agents[agent.name] if self._agents else None
        if self._flatten:
            parts = (seat.kind, shared)
            return np.concatenate(parts if mark is None else (mark, *parts))
        observation = {"kind": seat.kind, "observation": shared}
        if mark is not None:
            observation["agent"] = mark
        return observation

    def mask(self, agent: Agent) -> Mask | None:
        """Return the mask of the learner's actions. None: nothing can be masked."""
        seat = self.seats[agent.point.hook]
        if agent.mask is not None:
            return seat.code.widen(agent.mask)
        return None if seat.renew_mask is None else seat.renew_mask()

    def decode(self, agent: Agent, action: Action) -> Action:
        """Return an agent's own action for one of the learner, or ``RULE``."""
        if action is RULE:
            return RULE
        return self.seats[agent.point.hook].code.decode(action, agent.mask)


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


class SimulationTurnEnv(UnitedView):
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

    kind = "turn"
    own_seat: Seat
    _agent_name = "turn"
    _unite = Turn

    def set_up(self) -> None:
        """Unite the agents."""
        self.turn = self.session.plan.derive(Turn)
        episode = self.session.episode
        if episode is not None and episode.pending is not None:
            self._face(episode.pending)

    @classmethod
    def adapt(cls, plan: Plan) -> Plan:
        """Check that a plan allows this view, and let agents decide at points of any spaces."""
        refuse_unknown_agents(plan)
        return super().adapt(replace(plan, unites=True))

    def _face(self, agent: Agent) -> None:
        """Note the agent that decides."""
        self.own_agent = agent
        self.own_seat = self.turn.seats[agent.point.hook]

    def begin(self, episode: EpisodeState) -> tuple[Observation, Info]:
        """Return the observation and the info of a reset."""
        self._last_time = None
        agent = episode.pending
        if agent is None:  # all moves were forced
            agents = (*episode.agents.values(), *episode.ended.values())
            agent = next(agent for agent in agents if agent.decided)
        self._face(agent)
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
        if turn.translates and episode.pending is not None:
            action = turn.decode(episode.pending, action)
        episode.step(action)
        if self._shows:
            self.show_step()
        agent = episode.pending
        if agent is None or agent.info or episode.just_ended or not turn.is_plain:
            self._latest = results = self.read(episode)
            return results
        # The same as in ``read``, whose call and checks take a twentieth of a step.
        self.own_agent = agent
        seat = turn.seats[agent.point.hook]
        renew = seat.renew_mask
        info: Info = {"agent": agent.name}
        if renew is not None:
            info[MASK] = renew()
        observation = {"kind": seat.kind, "observation": agent.hand_out()}
        self._latest = quick = observation, agent.reward, False, False, info
        return quick

    def read(self, episode: EpisodeState, *, begins: bool = False) -> StepResult:
        """Return the results of a step, or of a reset, which leaves rewards to the first step."""
        turn = self.turn
        before = self.own_agent
        seat_before = self.own_seat
        agent = episode.pending
        ends = False, False
        if agent is None:
            agent = before
            ends = episode.terminated, episode.truncated
            paid = list(episode.agents.values())
        else:
            paid = [agent]
        if episode.just_ended and not begins:
            paid += episode.take_ended()
        reward = episode.earned
        if reward is None:
            reward = sum([each.reward for each in paid], 0.0)
        self.own_agent = agent
        self.own_seat = turn.seats[agent.point.hook]
        info = agent.info
        info["agent"] = agent.name
        add_costs(info, paid)
        if turn.translates or agent.mask is None:  # else the info has it
            mask = turn.mask(agent)
            if mask is not None:
                info[MASK] = mask
        noted = info.pop(RULE_ACTION, None)
        if agent is not before:  # else it is of an earlier step
            noted = before.noted_action
        if noted is not None:
            info[RULE_ACTION] = seat_before.code.encode(noted)
        self._add_to(info, episode)
        return turn.observe(agent), reward, *ends, info

    def validate(self, action: Action) -> Action:
        """Validate an action for the pending decision, before the simulation moves."""
        agent = self.episode.pending
        return action if agent is None else agent.validate(self.turn.decode(agent, action))

    def masks(self) -> list[Mask]:
        """Return the mask of the deciding agent."""
        agent = self.episode.pending or self.own_agent
        mask = self.turn.mask(agent)
        return [agent.point.open_mask() if mask is None else mask]
