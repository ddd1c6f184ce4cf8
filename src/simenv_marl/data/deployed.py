"""Policies for all agents, made of a learner that was trained in a turn or a joint view."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from gymnasium import spaces

from ..core import (
    MASK,
    Action,
    Agent,
    Caller,
    Episode,
    EpisodePolicy,
    Info,
    Observation,
    Plan,
    Space,
    is_asked_alone,
    stacked,
    stacker,
    takes_state,
)
from ..envs import SimulationJointEnv, SimulationTurnEnv
from ..envs.agents import OneAgentView
from ..envs.joint import Joint
from ..envs.turn import Turn
from ..errors import OptionValueError, UnknownAgentError, name_of, short_repr
from ..many.batch import Answers, read_answers
from ..simulation import EVERYONE, RULE

Predict = Callable[..., Any]
"""Takes an observation, or an observation and an info. Returns an action, or that and extras."""

UNUSED = object()
"""The action of an agent that has none left in its round."""


def turn_policy(predict: Predict, *, like: Any, batched: bool = False) -> dict[Any, Any]:
    """Make policies for all agents of a learner that was trained in a turn view.

    Args:
        predict: A callable of the observation, or of the observation and the info: the agent's name
            as ``info["agent"]``, the mask as ``info["action_mask"]``, the time. It returns the
            action, or a tuple of the action and extras (``model.predict`` of Stable-Baselines3).
        like: The environment in which it was trained, or one with the same arguments.
        batched: Whether ``simulate_many``, ``collect_episodes`` and ``evaluate(batched=True)`` ask
            for many decisions at once, with stacks of observations and masks. ``info["agent"]`` is
            a list of names then.

    Returns:
        Policies for ``simulate``, ``evaluate``, ``run_experiment`` and ``policies=``. In an
        environment, ``agent=`` names the agent that the user answers.

    Raises:
        OptionValueError: ``like`` is no environment of a turn view.
    """
    return {EVERYONE: TurnPolicy(predict, _plan_of(like, SimulationTurnEnv), batched)}


def joint_policy(predict: Predict, *, like: Any) -> dict[Any, Any]:
    """Make policies for all agents of a learner that was trained in a joint view.

    Decisions are answered in rounds, as in the joint view: with the actions of the latest answer,
    until an agent has used its own. Then all agents are observed, and ``predict`` answers again.

    Args:
        predict: A callable of the joint observation, or of the observation and the info:
            ``"deciding"``, ``"acted"`` and ``"action_mask"``. It returns the joint action, or a
            tuple of the action and extras.
        like: The environment in which it was trained, or one with the same arguments.

    Returns:
        Policies, as ``turn_policy`` returns them.

    Raises:
        OptionValueError: ``like`` is no environment of a joint view.
    """
    return {EVERYONE: JointPolicy(predict, _plan_of(like, SimulationJointEnv))}


def _plan_of(like: Any, kind: type[OneAgentView]) -> Plan:
    """Return the plan of an environment. It may have wrappers, or be a vector environment."""
    view = getattr(like, "unwrapped", like)
    envs = getattr(view, "envs", None)
    if envs:
        view = envs[0].unwrapped
    if not isinstance(view, kind):
        raise OptionValueError(
            f"like= must be an environment of the view in which the policy was trained"
            f" ({kind.__name__}), not {short_repr(like)}"
        )
    return view.session.plan


class _Deployed(EpisodePolicy):
    """A learner's policy for all agents."""

    def __init__(self, predict: Predict, plan: Plan, batched: bool = False) -> None:
        if is_asked_alone(predict):
            raise OptionValueError(
                f"{short_repr(predict)} must answer at once, and can ask for _state alone, not for"
                " _environment or _decision"
            )
        self.policy = predict
        self.batched = batched
        self.takes_state = takes_state(predict)
        self._call = Caller(predict)
        self._plan = plan

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.policy, self._plan, self.batched)

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {name_of(self.policy)}>"  # also in provenance

    def _ask(
        self, observation: Observation, info: Info, space: Space, state: object
    ) -> tuple[Action, Any]:
        """Ask for an action in a space; return it, and the extras."""
        answer = self._call(observation, info, {"_state": state})
        has_extras = isinstance(answer, tuple) and not isinstance(space, spaces.Tuple)
        action, extras = answer if has_extras else (answer, {})
        return action, extras if isinstance(extras, Mapping) else {}

    def answer(self, episode: Any, agent: Any, observation: Observation, info: Info) -> Action:
        """Answer one decision at once."""
        action, _ = self.respond(episode, agent, observation, info)
        return action


class TurnPolicy(_Deployed):
    """A policy for all agents of a learner of the turn view: see ``turn_policy``."""

    @cached_property
    def _turn(self) -> Turn:
        return self._plan.derive(Turn)

    def respond(self, episode: Any, agent: Any, observation: Observation, info: Info) -> Any:
        """Answer one decision with the action and the extras."""
        turn = self._turn
        told: Info = {"agent": agent.name}
        mask = turn.mask(agent)
        if mask is not None:
            told[MASK] = mask
        if "time" in info:  # times since the last step are not known here
            told["time"] = info["time"]
        state = episode.read_state() if self.takes_state else None
        action, extras = self._ask(turn.observe(agent), told, turn.action_space, state)
        return turn.decode(agent, action), extras

    def respond_to_many(
        self, agents: Sequence[Agent], infos: Sequence[Info], states: object
    ) -> Answers:
        """Answer many decisions at once with the actions and the extras."""
        turn = self._turn
        stack = stacker(turn.observation_space, cast=True)
        told: Info = {"agent": [agent.name for agent in agents]}
        if all("time" in info for info in infos):
            told["time"] = np.array([info["time"] for info in infos])
        masks = list(map(turn.mask, agents))
        if not any(mask is None for mask in masks):
            told[MASK] = stacked(masks)
        seen = stack(list(map(turn.observe, agents)))
        answers = self._ask(seen, told, turn.action_space, states)
        actions, extras = read_answers(answers, self.policy, len(agents))
        return list(map(turn.decode, agents, actions)), extras


class JointPolicy(_Deployed):
    """A policy for all agents of a learner of the joint view: see ``joint_policy``."""

    looks_back = True
    sees_all = True

    @cached_property
    def joint(self) -> Joint:
        """The joint view's spaces."""
        return self._plan.derive(Joint)

    def respond(self, episode: Any, agent: Any, observation: Observation, info: Info) -> Any:
        """Answer one decision with the agent's action of the round. Begin another without one."""
        if agent.name not in self.joint.roster:
            raise UnknownAgentError(
                f"{agent.name!r} is no agent of the joint view in which the policy was trained"
            )
        unused = episode.memory.get(self, {})
        action = unused.pop(agent.name, UNUSED)
        if action is UNUSED or not (action is RULE or agent.allows(action)):
            unused = self._begin_round(episode, agent)
            action = unused.pop(agent.name)
        return action, {}

    def _begin_round(self, episode: Episode, deciding: Agent) -> dict[str, Action]:
        """Ask for the actions of all live agents, and return them."""
        answer = self.answer_all(episode, deciding)
        found = {name: episode.find(name) for name in self.joint.roster}
        live = {name: agent for name, agent in found.items() if agent is None or not agent.ended}
        actions = self.joint.actions(live, answer)
        episode.memory[self] = actions
        return actions

    def answer_all(self, episode: Episode, deciding: Agent) -> Action:
        """Answer with the joint action. ``deciding``: the agent whose decision is pending."""
        episode.observe_others(deciding)
        found = {name: episode.find(name) for name in self.joint.roster}
        unused = episode.memory.get(self, found)
        seen, told = self.joint.see(list(found.values()), deciding, found.keys() - unused)
        state = episode.read_state() if self.takes_state else None
        answer, _ = self._ask(seen, told, self.joint.action_space, state)
        return answer
