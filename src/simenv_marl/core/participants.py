"""The agents of an episode: live agents, ended agents, and agents for which policies answer."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Mapping
from typing import Any

from ..errors import AgentError, short_repr
from ..hooks.hook import Hook
from ..simulation import RULE
from .agent import WAIT, Agent
from .bound import BoundPoint
from .plan import Plan
from .roster import declared_agents, two_arguments


class Participants:
    """The agents of one episode.

    Attributes:
        agents: The live agents of the environment, by name, in the order in which they joined.
        answered: The agents for which policies answer, by name.
        ended: The agents of the environment whose episodes ended before the simulation's, by name.
        just_ended: The ended agents whose end no view has reported yet.
        done: Whether the only agent of the environment has ended, so that nothing is left to ask the user.
        script: During a replay, the answers on the other episode's tape that are still to be given. Else None.
        consulted: The agent whose policy is being asked and gets the environment. None if there is none.
        latest: The agent that decided last, for the notes of errors.
        clock: Returns the simulation's time. None if the simulation has no time.
    """

    __slots__ = (
        "_entities",
        "_plan",
        "_simulation",
        "agents",
        "answered",
        "clock",
        "consulted",
        "done",
        "ended",
        "just_ended",
        "latest",
        "script",
    )

    def __init__(self, plan: Plan, simulation: Any, clock: Callable[[], float] | None) -> None:
        """Make the agents that the plan knows beforehand."""
        self._plan, self._simulation, self.clock = plan, simulation, clock
        self.agents: dict[str, Agent] = {
            name: self._agent_of(name, point, plan.policy_of(name, point)) for name, point in plan.roster.items()
        }
        self.answered: dict[str, Agent] = {}
        self.ended: dict[str, Agent] = {}
        self.just_ended: list[Agent] = []
        self.latest: Agent | None = None
        self.script: deque[Any] | None = None
        self.consulted: Agent | None = None
        self.done = False
        self._entities: dict[tuple[BoundPoint, int], Agent] = {}

    def remember(self, agent: Agent, entity: Any) -> None:
        """Note the agent of an entity at its decision point, for ``named_before``."""
        self._entities[agent.point, id(entity)] = agent

    def named_before(self, point: BoundPoint, entity: Any) -> str | None:
        """The name of the agent as which an entity last decided at a point; None if it was no agent."""
        agent = self._entities.get((point, id(entity)))
        args = None if agent is None else agent.arguments()  # to exclude a freed entity that had the same id
        return agent.name if agent is not None and args and args[0] is entity else None

    def agent_for(self, point: BoundPoint, name: Any) -> Agent:
        """Find the agent with a name that decides at a point, or let it join.

        Raises:
            AgentError: The name is not a string, or belongs to another point, or to an agent that has ended.
        """
        if not isinstance(name, str):
            raise AgentError(f"agent= of {point.point.name} must return a string or None, not {short_repr(name)}")
        agent = self.answered.get(name) or self.agents.get(name)
        if agent is None:
            if name in self.ended:
                raise AgentError(
                    f"the agent {name!r} decides at {point.point.name} after its end; agent= must give each entity a"
                    " name of its own, and removed_by= or end_agent() must end an agent only when its entity is gone"
                )
            policy = self._plan.policy_of(name, point)
            agent = self._agent_of(name, point, policy)
            (self.agents if self._plan.is_active(policy) else self.answered)[name] = agent
        elif agent.point is not point:
            raise AgentError(
                f"the agent {name!r} decides at {agent.point.point.name} and at {point.point.name};"
                " an agent has one decision point: give each point's agents names of their own"
            )
        return agent

    def _agent_of(self, name: str, point: BoundPoint, policy: Any) -> Agent:
        return Agent(name, point, policy, self.clock, self._plan.plugins)

    def agent(self, name: str) -> Agent | None:
        """An agent of the environment, live or ended; None if there is no such agent."""
        return self.agents.get(name) or self.ended.get(name)

    def announced(self) -> list[tuple[Agent, tuple[Any, ...]]]:
        """The live agents that ``expected_calls`` announces, with the arguments of their calls."""
        expected = getattr(self._simulation, "expected_calls", None)
        announced: list[tuple[Agent, tuple[Any, ...]]] = []  # a generator could not pass on a StopIteration
        if expected is None:
            return announced
        for point in self._plan.active:
            for call in expected(point.point.name):
                args = call if type(call) is tuple else tuple(call)
                name = point.agent or point.name_agent(*args)
                agent = self.agents.get(name) if type(name) is str else None
                if agent is None or agent.point is not point:
                    if name is None or name in self.ended or name in self.answered:
                        continue
                    agent = self.agent_for(point, name)
                    if name in self.answered:
                        continue
                announced.append((agent, args))
        return announced

    def ask(self, agent: Agent, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Ask a policy that gets the environment, or that answers many decisions at once. In a replay, use the script.

        Returns:
            The action. ``WAIT`` if the policy is asked later, or if a replay has reached the other episode's decision.

        Raises:
            BaseException: Any error that the policy raises.
        """
        if agent.deferred and not self.alone:
            return WAIT
        if agent.looks:
            agent.consultations += 1
            if agent.keep(args, kwargs):
                self.remember(agent, args[0])
        if self.script:
            return self.script.popleft()
        self.consulted = agent
        if self.script is not None:
            return WAIT
        try:
            if agent.deferred:
                return agent.policy.alone(self, agent)
            return agent.policy(agent.observation, agent.info)
        finally:
            self.consulted = None

    def single_out(self, agent: Agent) -> None:
        """In a branch, make one agent the only agent of the environment.

        Policies answer for all other agents, or the rule where there is no policy.
        """
        plan = self._plan = self._plan.for_one(agent.name)
        for name, other in self.agents.items():
            if other is not agent:
                self.answered[name], other.led = other, True
                other.follow(plan.policy_of(name, other.point))
        self.answered.pop(agent.name, None)
        self.agents, self.just_ended, self.done = {agent.name: agent}, [], False
        agent.follow(None)

    def leave_to(self, others: Mapping[str, Any]) -> None:
        """In a branch, let policies, given by agent, answer for agents that neither the user nor a policy answers."""
        led = {name: self.answered.get(name) for name, policy in others.items() if policy is not RULE}
        led = {name: agent for name, agent in led.items() if agent is None or agent.policy is RULE}
        self._plan = self._plan.led_by({name: two_arguments(others[name]) for name in led if name not in self.agents})
        for name, agent in led.items():
            if agent is not None:
                agent.follow(self._plan.policies[name])

    def may_be(self, name: Any) -> bool:
        """Whether there is an agent with that name, or could be one later."""
        plan = self._plan
        declared = plan.options.possible_agents
        open_to_all = declared is None and any(point.agent is None for point in plan.points)
        known = (self.agents, self.answered, plan.roster, plan.policies, declared_agents(declared))
        return any(name in names for names in known) or (open_to_all and isinstance(name, str))

    @property
    def alone(self) -> bool:
        """Whether this is a branch with one agent singled out."""
        return self._plan.alone

    def crossing(self) -> Mapping[Hook, Any]:
        """The events that the simulation sends, by hook.

        The event of a point with one agent is that agent. The event of a point that names an agent at each call is the
        bound point, which finds the agent.
        """
        agents, decisions = self.agents, self._plan.decisions
        alone = {
            hook: agents[event.agent] for hook, event in decisions.items() if getattr(event, "agent", None) in agents
        }
        return {**decisions, **alone} if alone else decisions

    def names(self) -> str:
        """List the names of the live agents, for messages."""
        return listed(self.agents)

    def finish_agent(self, agent: Agent) -> None:
        """End the episode of one agent while the simulation's goes on."""
        latest = self.latest
        self.conclude(agent)
        self.latest = latest  # the model continues after this agent's decision
        agent.ended = agent.led = True
        self.ended[agent.name] = self.agents.pop(agent.name)
        self.just_ended.append(agent)
        self.done = agent.name == self._plan.one_agent

    def conclude(self, agent: Agent) -> None:
        """Give an agent its last reward and its last observation."""
        self.latest = agent
        args = agent.arguments()
        if args is None:  # the agent never decided, or the model has freed its entity
            agent.unsee()
        else:
            agent.settle(agent, args, agent.kwargs, last=True)
        agent.reward, agent.carried = agent.reward + agent.carried, 0.0
        agent.release()


def listed(names: Collection[str]) -> str:
    """List the first ten of some names, and the number of the others, for messages."""
    first = ", ".join(list(names)[:10])
    return f"{first} and {len(names) - 10} more" if len(names) > 10 else first
