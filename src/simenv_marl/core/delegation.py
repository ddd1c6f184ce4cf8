"""Decisions that the environment's user does not take: those of policies, forced moves, and those after the last step.

In branches that wait for one agent only, policies or the rule answer for all others.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import inf
from typing import TYPE_CHECKING, Any

from ..errors import AgentError
from ..simulation import RULE
from .actions import only_choice
from .agent import Agent
from .driver import WAIT
from .roster import declared_agents, two_arguments
from .spaces import duplicate

if TYPE_CHECKING:
    from .episode import Episode


def decides_after_end(agent: Agent) -> AgentError:
    """Make the error for a decision of an agent whose episode has ended."""
    return AgentError(
        f"the agent {agent.name!r} decides at {agent.point.point.name} after its end; agent= must give each entity a"
        " name of its own, and removed_by= or end_agent() must end an agent only when its entity is gone"
    )


def consult(episode: Episode, agent: Agent, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """Let a policy answer a decision.

    Returns:
        The reply to the simulation; ``WAIT`` if the policy is asked later, for many decisions at once, or if a
        replay has reached the other episode's decision.

    Raises:
        InvalidActionError: The policy's action is not legal.
        BaseException: Any error of a mapping or the policy.
    """
    if agent.ended:
        raise decides_after_end(agent)
    if episode.is_complete:  # else the simulation might run for ever without a decision for the user
        episode.finish(truncated=False)
        return WAIT
    policy = agent.policy
    if policy is RULE:
        return RULE
    episode.latest = agent
    update = agent.point.updates[0]
    update(agent, args, kwargs, reward=False)
    forced = forced_action(episode, agent) if episode.skips else None
    if forced is not None:
        return answer_forced(episode, agent, forced)
    if agent.is_deferred and not episode.plan.solo:
        episode.pending = agent
        return WAIT
    if agent.is_planner:
        agent.consultations += 1
        agent.keep(episode, args, kwargs)
    if episode.script:
        action = episode.script.popleft()
    else:
        episode.consulted = agent
        if episode.script is not None:
            episode.pending = agent
            return WAIT
        try:
            action = policy.alone(episode, agent) if agent.is_deferred else policy(agent.observation, agent.info)
        finally:
            episode.consulted = None
    episode.record(duplicate(action))
    return episode.answer(agent, agent.checked(action), False)


def decide_too_late(episode: Episode, agent: Agent, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """Truncate the episode, because the user has taken the last step."""
    episode.finish(truncated=True)
    return WAIT


def decide_unless_forced(episode: Episode, agent: Agent, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """Update an agent. Its rewards add up until it has more than one legal action."""
    agent.update(agent, args, kwargs)
    agent.reward, agent.carried = agent.reward + agent.carried, 0.0
    forced = forced_action(episode, agent)
    if forced is not None or not agent.asked:  # ``reset`` returns no rewards either
        agent.reward, agent.carried = 0.0, agent.reward
    if forced is not None:
        return answer_forced(episode, agent, forced)
    agent.asked = True
    episode.pending = agent
    return WAIT


def answer_forced(episode: Episode, agent: Agent, action: Any) -> Any:
    """Answer with the only legal action. The elapsed time adds up until the agent is asked, as rewards do."""
    before = agent.answered_at
    reply = episode.answer(agent, action, False)
    if before is not None:
        agent.answered_at = before
    return reply


def forced_action(episode: Episode, agent: Agent) -> Any:
    """The only legal action of an agent; None if it has several."""
    return only_choice(agent.point.definition.action_space, agent.mask)


# -- branches that wait for one agent -------------------------------------------------------------


def single_out(episode: Episode, agent: Agent) -> None:
    """In a branch, make one agent the only agent of the environment, and wait for its pending decision.

    Policies answer for all other agents, or the rule where there is no policy.
    """
    if list(episode.agents.values()) != [agent]:
        episode.most_steps = episode.limit = inf  # ``max_steps`` counts the steps of other agents
    plan = episode.plan = episode.plan.for_one(agent.name)
    for name, other in episode.agents.items():
        if other is not agent:
            episode.others[name], other.delegated = other, True
            other.follow(plan.policy_of(name, other.point))
    episode.others.pop(agent.name, None)
    episode.agents, episode.just_ended, episode.is_complete = {agent.name: agent}, [], False
    agent.follow(None)
    agent.delegated, agent.own, agent.asked = False, True, True
    episode.rounds, episode.decide = None, decide_unless_forced if episode.skips else None
    episode.begun = True
    if not agent.decided:  # drop the first value of the reward mapping, which rewards no action
        with episode.context():
            agent.update(agent, agent.arguments(), agent.kwargs, observe=False)
    episode.consulted, episode.pending = None, agent


def delegate(episode: Episode, policies: Mapping[str, Any]) -> None:
    """In a branch, let policies, given by agent, answer for agents that neither the user nor a policy answers."""
    others = {name: episode.others.get(name) for name, policy in policies.items() if policy is not RULE}
    others = {name: agent for name, agent in others.items() if agent is None or agent.policy is RULE}
    found = {name: two_arguments(policies[name]) for name in others if name not in episode.agents}
    episode.plan = episode.plan.with_policies(found)
    for name, agent in others.items():
        if agent is not None:
            agent.follow(episode.plan.policies[name])


def may_be(episode: Episode, name: Any) -> bool:
    """Whether there is an agent with that name, or could be one later."""
    plan = episode.plan
    declared = plan.options.possible_agents
    open_to_all = declared is None and any(point.agent is None for point in plan.points)
    known = (episode.agents, episode.others, plan.roster, plan.policies, declared_agents(declared))
    return any(name in names for names in known) or (open_to_all and isinstance(name, str))
