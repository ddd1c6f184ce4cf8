"""Branches that wait for one agent only: policies or the rule answer for all others."""

from __future__ import annotations

from collections.abc import Mapping
from math import inf
from typing import Any

from ..simulation import RULE
from .agent import Agent
from .episode import Episode
from .roster import declared_agents, two_arguments


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
            other.policy = plan.policy_of(name, other.point)
    episode.others.pop(agent.name, None)
    episode.agents, episode.just_ended, episode.is_complete = {agent.name: agent}, [], False
    agent.policy, agent.delegated, agent.own, agent.asked = None, False, True, True
    episode.rounds, episode.decide = None, Episode.decide_unless_forced if episode.skips else None
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
            agent.policy = episode.plan.policies[name]


def may_be(episode: Episode, name: Any) -> bool:
    """Whether there is an agent with that name, or could be one later."""
    plan = episode.plan
    declared = plan.options.possible_agents
    open_to_all = declared is None and any(point.agent is None for point in plan.points)
    known = (episode.agents, episode.others, plan.roster, plan.policies, declared_agents(declared))
    return any(name in names for names in known) or (open_to_all and isinstance(name, str))
