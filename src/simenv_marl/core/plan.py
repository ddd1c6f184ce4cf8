"""The plan of an environment: a complete description that is checked before anything runs.

A plan names the decision points of an environment, the names of their agents, the policies and the options. It holds no
state of any episode, so that one plan serves any number of environments.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from functools import partial
from types import MappingProxyType
from typing import Any

from ..decision import DecisionPoint, Definition
from ..errors import (
    AgentError,
    DefinitionError,
    OptionValueError,
    UnknownOptionError,
    UnknownPointError,
    did_you_mean,
    short_repr,
    warn_user,
)
from ..hooks.hook import Hook
from ..hooks.plugins import Plugins
from ..hooks.stacks import outside_simulation
from ..simulation import RULE, SimulationInterface
from .agent import settling
from .bound import BoundPoint, DeferredPolicy, given_simulation
from .drivers import Spare
from .events import Answered, Decision, Ended, Removed, Told
from .options import Options
from .planner import PlannerPolicy, bind_session
from .points import (
    NamedPoint,
    by_name,
    find_points,
    have_instances,
    locate,
    own_points,
    owner_class,
    portable,
    stand_ins,
)
from .roster import assign, call_the_roll, declared_agents, name_agents, names_agents

RENDER_MODES = ("ansi", "human", "rgb_array")
"""The render modes of a simulation with a method ``render`` that does not define ``render_modes``."""

END_AGENT = f"{SimulationInterface.__module__}.{SimulationInterface.end_agent.__qualname__}"
"""The dotted name of the method by which a simulation ends an agent's episode."""

RENDER_FPS = 4
"""The frames per second of a simulation that does not define ``render_fps``."""


class Plan:
    """The plan of an environment.

    Attributes:
        source: The simulation, class or factory from which the environment makes its simulation.
        variant: The variant from which the environment is made. None if it is not made from a variant.
        options: The options.
        render_modes: The render modes of the simulation.
        render_fps: The frames per second of its rendering.
        points: The decision points that do not run their rule.
        active: The decision points that the environment's user answers.
        events: For each decision point, the event that the simulation sends when the point is called.
        decisions: The same events by the point's hook, for drivers.
        policies: By agent name, the policies of agents that are not agents of the environment.
        asks: Whether a mapping asks for the simulation, or a policy asks for the environment.
        looked_into: Whether a policy asks for the environment, and so may branch it.
        alone: Whether this is the plan of a branch that waits for one agent only.
        wanted: The agents that ``policies`` and ``possible_agents`` name. Agents that do not appear in an episode are
            removed from this set, with one warning.
        one_agent: The name of the only agent that the environment's user answers for. None if there may be several.
        roster: By agent name, the decision points of the agents that are known beforehand, in the order of the points.
        complete: Whether ``roster`` contains all possible agents.
        unanswered: Whether the environment has no user, so that the rule decides wherever no policy answers.
        rewarded: Whether agents with deferred policies are agents of the environment, with rewards and ends.
        plugins: The handlers for this environment's simulation only. None if there are none.
        hooks: The hooks that must be set in the model while the environment is in use.
    """

    def __init__(
        self,
        source: Any,
        named: list[NamedPoint],
        options: Options,
        render_modes: list[str],
        *,
        unanswered: bool = False,
        rewarded: bool = False,
        others: Any = None,
        render_fps: float = RENDER_FPS,
        ends_agents: bool = False,
        spare: list[Spare] | None = None,
        variant: Any = None,
        own: Mapping[DecisionPoint, Definition] = MappingProxyType({}),
    ) -> None:
        self.source, self.options, self._named, self._own = source, options, named, own
        self.variant = variant
        self._spare = [] if spare is None else spare  # a simulation for inspection, until an environment takes it
        self.render_modes, self.render_fps = render_modes, render_fps
        if options.render_mode is not None and options.render_mode not in render_modes:
            raise OptionValueError(
                f"render_mode {short_repr(options.render_mode)} is not one of the simulation's:"
                f" {render_modes or 'it has none'}{did_you_mean(options.render_mode, render_modes)}"
            )
        self.unanswered, self.rewarded, self._ends_agents = unanswered, rewarded, ends_agents
        self._others = others
        agents = name_agents(named)
        if options.agent is not None and options.agent not in agents and None not in agents:
            raise AgentError(
                f"agent={short_repr(options.agent)} names no agent; the agents are {', '.join(filter(None, agents))}"
                f"{did_you_mean(options.agent, filter(None, agents))}"
            )
        by_point, self.policies, extra = assign(options.policies or {}, named, agents, own)
        self._everything, self._by_point = [*named, *extra], by_point
        self.hooks: list[Hook] = [point.point.hook for point in self._everything]
        named_here = {name: point.hook for name, point in by_name(own).items()}
        self.plugins = Plugins(options.plugins, named_here) if options.plugins else None
        self.wanted = {*self.policies, *declared_agents(options.possible_agents)}
        mappings = any(given_simulation(point.definition, None) is not point.definition for point in self._everything)
        self.looked_into = any(isinstance(p, PlannerPolicy) for p in (*by_point.values(), *self.policies.values()))
        self.asks, self.alone = mappings or self.looked_into, False
        self._bind_points(first=True)

    def _bind_points(self, *, first: bool) -> None:
        """Bind the decision points, and find out who decides at each."""
        options, unanswered = self.options, self.unanswered
        agents = name_agents(self._everything)
        known = agents[: len(self._named)]
        self.points: list[Any] = []
        self.active: list[BoundPoint] = []
        for point, agent in zip(self._everything, agents, strict=True):
            policy = self._by_point.get(point.point, self._others)
            if options.agent is not None and agent != (options.agent if options.agent in known else None):
                policy = policy or RULE
            excepted = self.policies if agent is None else self.policies.get(agent, RULE) is not RULE
            if policy is not RULE or excepted:  # otherwise the rule decides
                self._bind(point, agent, policy)
            else:
                self.wanted.discard(agent)
        self.events: dict[Any, Any] = {}
        for bound in self.points:
            self.events[bound.point] = bound
        for bound in self.points:
            for other in stand_ins(bound.point):
                self.events.setdefault(other, bound)
        self._find_removals(warns=first)
        if self._ends_agents and self.points:
            self._cross(locate(END_AGENT)[0], Ended())
        self.decisions = {point.hook: event for point, event in self.events.items()}
        if not self.active and not unanswered:
            raise UnknownPointError("no decision point is left to the environment: policies answer all of them")
        self.roster: dict[str, BoundPoint] = {}
        self.complete = False
        if self.rewarded:
            self.roster = {point.agent: point for point in self.active if point.agent is not None}
        else:
            roster, self.complete = call_the_roll(self.active, options.possible_agents, agents)
            if not unanswered:
                self.roster = {name: point for name, point in roster.items() if name not in self.policies}
        if options.agent is not None:
            self._single_out(options.agent)
        self.one_agent = self.active[0].agent or options.agent if len(self.active) == 1 else None

    def with_simulation(self, simulation: Any, session: Any) -> Plan:
        """Copy the plan, and give the simulation and its session to the mappings and policies that ask for them."""
        made = self._copied()
        made._everything = [
            replace(point, definition=given_simulation(point.definition, simulation)) for point in self._everything
        ]
        made._by_point = {key: bind_session(policy, session) for key, policy in self._by_point.items()}
        made.policies = {key: bind_session(policy, session) for key, policy in self.policies.items()}
        made._bind_points(first=False)
        return made

    def with_source(self, source: Any, variant: Any, spare: Spare) -> Plan:
        """Copy the plan for simulations from another source, of which one is already made."""
        made = self._copied()
        made.source, made.variant, made._spare = source, variant, [spare]
        return made

    @property
    def looked_at(self) -> Any:
        """The simulation that was made for inspection; None if there is none, or if an environment has taken it."""
        return self._spare[-1].simulation if self._spare else None

    def for_one(self, agent: str) -> Plan:
        """Copy the plan for a branch that waits for one agent only. The rule decides for agents without a policy."""
        made = self._copied()
        made.unanswered, made.rewarded, made.alone = True, False, True
        made.one_agent, made.wanted = agent, set()
        return made

    def led_by(self, policies: Mapping[str, Any]) -> Plan:
        """Copy the plan for a branch in which policies, given by agent, answer for agents that have none."""
        made = self._copied()
        made.policies = {**policies, **self.policies}
        return made

    def _copied(self) -> Plan:
        made = Plan.__new__(Plan)
        vars(made).update(vars(self))
        return made

    def _bind(self, named: NamedPoint, agent: str | None, policy: Any) -> None:
        """Bind a decision point that does not run its rule."""
        policies = [policy, *self.policies.values()] if agent is None else [self.policies.get(agent, policy)]
        if self.rewarded:
            active = any(isinstance(policy, DeferredPolicy) for policy in policies)
        else:
            active = policy is None and agent not in self.policies
        kind: Any = Answered if policy is not None and not active else Decision
        bound = kind(named, agent, policy, recorded=self.rewarded, clips=self.options.clip_actions)
        bound.settle, _ = settling(bound)
        bound.told = Told(bound) if bound.recorded else None
        self.points.append(bound)
        if active:
            self.active.append(bound)

    def _single_out(self, agent: str) -> None:
        """Let policies or the rule answer for all agents except one.

        Raises:
            AgentError: The agent is not declared, or its decision point is not known.
            OptionValueError: A policy answers for the agent.
        """
        if agent in self.policies:
            raise OptionValueError(
                f"agent={short_repr(agent)} is answered by policies, and no decision is left to the environment"
            )
        if self.complete and agent not in self.roster:
            raise AgentError(
                f"agent={short_repr(agent)} names no agent of the environment; its agents are {', '.join(self.roster)}"
                f"{did_you_mean(agent, self.roster)}"
            )
        points = [self.roster[agent]] if self.complete else self.active
        if len(points) > 1:
            raise AgentError(
                f"the agent {short_repr(agent)} may decide at"
                f" {', '.join(point.point.name for point in points)}; name its"
                " decision point in points=, or declare the agents of each with possible_agents="
            )
        self.active, self.roster, self.complete = points, {agent: points[0]}, True

    def policy_of(self, agent: str, point: BoundPoint) -> Any:
        """The policy that answers for an agent; None if the environment's user answers.

        Raises:
            AgentError: The agent is not declared, although the environment's options require it.
        """
        policy = self.policies.get(agent) or point.policy
        if policy is not None:
            return policy
        if self.unanswered or (self.one_agent is not None and agent != self.one_agent):
            return RULE
        if not self.complete or agent in self.roster:
            return None
        if self.options.undeclared == "rule":
            return RULE
        raise AgentError(
            f"the agent {agent!r}, which decides at {point.point.name}, is not declared in possible_agents; declare"
            ' it, or let its rule decide with undeclared="rule"'
        )

    def is_active(self, policy: Any) -> bool:
        """Whether an agent with this policy is an agent of the environment."""
        return policy is None or (self.rewarded and isinstance(policy, DeferredPolicy))

    @property
    def possible_agents(self) -> list[str] | None:
        """The names of all possible agents; None if an agent becomes known only when it decides."""
        return list(self.roster) if self.complete else None

    @property
    def patches(self) -> list[Hook | Plugins]:
        """The hooks and plugins that must be set in the model while an environment is in use."""
        return [*self.hooks] if self.plugins is None else [*self.hooks, self.plugins]

    def _find_removals(self, *, warns: bool) -> None:
        for binding in self.points:
            for name, agent in (*binding.point.removed_by.items(), *binding.definition.removed_by.items()):
                point, _ = locate(name, self._own)
                removal = self._cross(point, Removed(point))
                if not isinstance(removal, Removed):
                    raise DefinitionError(
                        f"{name} is a decision point, so removed_by= cannot name it as a function that ends an agent"
                    )
                owner, remover = owner_class(binding.point), owner_class(point)
                if agent is None and warns and point.bound and owner and remover and not have_instances(owner, remover):
                    warn_user(
                        f"{name}, in removed_by= of {binding.point.name}, is called on a {remover.__name__}, not on a"
                        f" {owner.__name__}, and so ends no agent; pass a dict from {name!r} to a callable of the"
                        " call's arguments that names the agent"
                    )
                removal.of.append((binding, agent, owner))

    def _cross(self, point: DecisionPoint, event: Any) -> Any:
        """Set the event that the simulation sends when a function is called, unless there is one; return the event."""
        if point.hook not in self.hooks:
            self.hooks.append(point.hook)
        return self.events.setdefault(point, event)

    @classmethod
    def draw_up(
        cls,
        source: Any,
        points: Any,
        options: Mapping[str, Any],
        *,
        unanswered: bool = False,
        rewarded: bool = False,
        others: Any = None,
    ) -> Plan:
        """Make a plan from the arguments that a user gives.

        Args:
            source: A simulation, its class, a factory, or a variant.
            points: The active decision points, as ``generate_env`` takes them.
            options: The options, by name.
            unanswered: Whether the environment has no user.
            rewarded: Whether agents with deferred policies are agents of the environment.
            others: The policy of all agents without one. With it, ``points=None`` means all decision points.

        Raises:
            SimEnvError: The arguments do not work. The subclass of the error says why.
        """
        variant = source if hasattr(source, "environment_arguments") else None
        if variant is not None:
            source, points, options = variant.environment_arguments(points, options)
        checked = Options().amended(options)
        if unanswered and checked.agent is not None:
            raise UnknownOptionError("agent is an option of single views only, as single_env makes them")
        model: Any = source
        spare: list[Spare] = []
        plain_factory = not isinstance(source, type) and not hasattr(source, "run")
        if plain_factory or (points is None and getattr(source, "points", None) is None):
            with outside_simulation():
                made = Spare(source, checked.driver)
            spare.append(made)
            model = made.simulation
        modes = getattr(model, "render_modes", RENDER_MODES) if hasattr(model, "render") else ()
        required = not unanswered or others is not None or names_agents(checked.policies)
        own = own_points(model)
        named = find_points(points, model, own, required=required, empty=unanswered)
        return cls(
            source, named, checked, list(modes), unanswered=unanswered, rewarded=rewarded, others=others,
            render_fps=getattr(model, "render_fps", RENDER_FPS), spare=spare, variant=variant,
            ends_agents=issubclass(model if isinstance(model, type) else type(model), SimulationInterface), own=own,
        )  # fmt: skip

    def __deepcopy__(self, memory: Any) -> Plan:
        return self  # a plan holds no state of any environment

    def __reduce__(self) -> Any:
        points = {point.key: point.own_definition for point in self._named}
        options = {option.name: getattr(self.options, option.name) for option in fields(Options)}
        for name in ("policies", "possible_agents"):
            if isinstance(options[name], Mapping):
                options[name] = {portable(key): value for key, value in options[name].items()}
        options["plugins"] = [] if self.plugins is None else self.plugins.portable
        return _remade, (self.source, points, options, self.variant, self.unanswered)

    def spare(self) -> Spare | None:
        """Take the simulation that was made for inspection, with its stack; None if there is none that fits."""
        if self.plugins or self.options.global_rng:  # the simulation was made without them
            return None
        try:
            spare = self._spare.pop()
        except IndexError:  # there is none, or another thread has just taken it
            return None
        return spare if spare.kind == self.options.driver else None

    def redefined(self, point: DecisionPoint, definition: Definition) -> Plan:
        """Make the same plan with another definition of a point."""
        named = [replace(own, definition=definition) if own.point is point else own for own in self._named]
        return self._like(named, self.options)

    def declared(self, roster: Mapping[str, BoundPoint]) -> Plan:
        """Make the same plan with a roster of agents that was found out."""
        names: dict[str, list[str]] = {b.point.name: [] for b in self.active if b.agent is None}
        for agent, binding in roster.items():
            if binding.agent is None:
                names[binding.point.name].append(agent)
        plan = self.amended({"possible_agents": names})
        plan.wanted = self.wanted  # the user has not named the agents that were found out
        return plan

    @property
    def stale(self) -> bool:
        """Whether other code has replaced a function that the plan patches since the plan was made."""
        return any(hook.stale for hook in self.hooks) or (self.plugins is not None and self.plugins.stale)

    @property
    def name(self) -> str:
        """The name of the simulation's class or factory."""
        return str(self.maker.__name__)

    @property
    def maker(self) -> Any:
        """The class or factory of the simulation."""
        source = self.source
        while isinstance(source, partial):
            source = source.func
        return source if hasattr(source, "__qualname__") else type(source)

    def amended(self, options: Mapping[str, Any]) -> Plan:
        """Make the same plan with other values of the given options."""
        if not options:
            return self
        return self._like(self._named, self.options.amended(options))

    def _like(self, named: list[NamedPoint], options: Options) -> Plan:
        return Plan(
            self.source, named, options, self.render_modes, render_fps=self.render_fps, spare=self._spare,
            variant=self.variant, ends_agents=self._ends_agents, own=self._own,
        )  # fmt: skip


def _remade(source: Any, points: Any, options: dict[str, Any], variant: Any, unanswered: bool) -> Plan:
    plan = Plan.draw_up(source, points, options, unanswered=unanswered)
    plan.variant = variant
    return plan
