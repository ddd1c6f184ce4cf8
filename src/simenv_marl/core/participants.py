"""The agents that take part in an episode: those that live, those that have ended, those that policies answer for."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Mapping
from typing import Any

from ..errors import AgentError, shown
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
        ended: The agents of the environment whose episode has ended before the simulation's, by name.
        just_ended: Those of them whose end no view has entered yet.
        done: Whether the one agent of the environment has ended, and so nothing is left to ask for.
        script: The answers of another episode's tape that are yet to be given again; None where none are, or no more.
        consulted: The agent whose policy is asked just now, and is given the environment; None while none is.
        latest: The agent whose decision was the latest, for those who read an error's notes.
        clock: Returns the simulation's time; None where it has none.
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
        """Have the agents take part that are known beforehand."""
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
        """Note which agent an entity is at its point, for ``named_before``."""
        self._entities[agent.point, id(entity)] = agent

    def named_before(self, point: BoundPoint, entity: Any) -> str | None:
        """The name of the agent that an entity was when it decided last at a point; None where it was none."""
        agent = self._entities.get((point, id(entity)))
        args = None if agent is None else agent.arguments()  # of another one, whose memory this one has, it is gone
        return agent.name if agent is not None and args and args[0] is entity else None

    def agent_for(self, point: BoundPoint, name: Any) -> Agent:
        """Find the agent of a name that decides at a point, or let it join.

        Raises:
            AgentError: The name is none, or belongs to another point, or to an agent that has ended.
        """
        if not isinstance(name, str):
            raise AgentError(f"agent= of {point.point.name} must name a string or None, not {shown(name)}")
        agent = self.answered.get(name) or self.agents.get(name)
        if agent is None:
            if name in self.ended:
                raise AgentError(
                    f"the agent {name!r} decides at {point.point.name} after its end; let agent= give each entity"
                    " a name of its own, and removed_by= or end_agent() tell what really ends it"
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
        """An agent of the environment, whether it lives or has ended; None where there is no such agent."""
        return self.agents.get(name) or self.ended.get(name)

    def announced(self) -> list[tuple[Agent, tuple[Any, ...]]]:
        """The live agents that the simulation says are going to decide, with the arguments of their calls."""
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
        """Ask a policy that is to be given the environment, or answers many at once; or find what it has answered.

        Returns:
            ``WAIT`` where it is asked later, and where a replay has come to where the other episode stands.

        Raises:
            BaseException: What the policy raises.
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
        """Have one agent be the only one of the environment, in a branch.

        All others are left to their policies; those without one to their rule.
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
        """In a branch: have policies, by agent, answer for agents that are not its user's and have none."""
        led = {name: self.answered.get(name) for name, policy in others.items() if policy is not RULE}
        led = {name: agent for name, agent in led.items() if agent is None or agent.policy is RULE}
        self._plan = self._plan.led_by({name: two_arguments(others[name]) for name in led if name not in self.agents})
        for name, agent in led.items():
            if agent is not None:
                agent.follow(self._plan.policies[name])

    def may_be(self, name: Any) -> bool:
        """Whether there is an agent of that name, or may be one."""
        plan = self._plan
        declared = plan.options.possible_agents
        open_to_all = declared is None and any(point.agent is None for point in plan.points)
        known = (self.agents, self.answered, plan.roster, plan.policies, declared_agents(declared))
        return any(name in names for names in known) or (open_to_all and isinstance(name, str))

    @property
    def alone(self) -> bool:
        """Whether one agent is singled out."""
        return self._plan.alone

    def crossing(self) -> Mapping[Hook, Any]:
        """What crosses from the simulation, by hook; where a point has one agent, that agent itself.

        Of points that name an agent at each call it is the point, which finds the agent.
        """
        agents, decisions = self.agents, self._plan.decisions
        alone = {
            hook: agents[event.agent] for hook, event in decisions.items() if getattr(event, "agent", None) in agents
        }
        return {**decisions, **alone} if alone else decisions

    def names(self) -> str:
        """The names of the live agents, for messages."""
        return listed(self.agents)

    def finish_agent(self, agent: Agent) -> None:
        """End the episode of one agent, in the midst of the simulation's."""
        latest = self.latest
        self.conclude(agent)
        self.latest = latest  # after whose decision the model goes on
        agent.ended = agent.led = True
        self.ended[agent.name] = self.agents.pop(agent.name)
        self.just_ended.append(agent)
        self.done = agent.name == self._plan.one_agent

    def conclude(self, agent: Agent) -> None:
        """Give an agent its last reward and its last observation."""
        self.latest = agent
        args = agent.arguments()
        if args is None:  # it never decided, or the model has let it go
            agent.unsee()
        else:
            agent.settle(agent, args, agent.kwargs, last=True)
        agent.reward, agent.carried = agent.reward + agent.carried, 0.0
        agent.release()


def listed(names: Collection[str]) -> str:
    """The first of some names, and how many more there are, for messages."""
    first = ", ".join(list(names)[:10])
    return f"{first} and {len(names) - 10} more" if len(names) > 10 else first
