"""The plan of an environment: a complete description that is checked before anything runs.

A plan names the decision points of an environment, the names of their agents, the policies and the options. It holds no
state of any episode, so that one plan serves any number of environments.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from functools import partial
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
from ..plugins import Plugins
from ..simulation import RULE, SimulationInterface
from .agent import make_updates
from .options import Options
from .planner import DeferredPolicy, PlannerPolicy, bind_session
from .point import EndAgent, Point, Removal, given_simulation
from .points import (
    NamedPoint,
    by_name,
    find_points,
    have_instances,
    locate,
    owner_class,
    portable,
)
from .prototype import DRIVERS, Model, Prototype
from .roster import agent_names, declared_agents, mentions_agents, resolve_policies, resolve_roster

END_AGENT = f"{SimulationInterface.__module__}.{SimulationInterface.end_agent.__qualname__}"
"""The dotted name of the method by which a simulation ends an agent's episode."""


class Plan:
    """The plan of an environment.

    Attributes:
        source: The simulation, class or factory from which the environment makes its simulation.
        variant: The variant from which the environment is made. None if it is not made from a variant.
        model: What is known of the simulation.
        options: The options.
        points: The decision points that do not run their rule.
        active: The decision points that the environment's user answers.
        events: For each hook, the event that the simulation sends when its function is called.
        policies: By agent name, the policies of agents that are not agents of the environment.
        is_bound_to_simulation: Whether a mapping asks for the simulation, or a policy asks for the environment.
        has_planner: Whether a policy asks for the environment, and so may branch it.
        solo: Whether this is the plan of a branch that waits for one agent only.
        unmatched_names: The agents that ``policies`` and ``possible_agents`` name. Agents that do not appear in an
            episode are removed from this set, with one warning.
        one_agent: The name of the only agent that the environment's user answers for. None if there may be several.
        roster: By agent name, the decision points of the agents that are known beforehand, in the order of the points.
        complete: Whether ``roster`` contains all possible agents.
        unattended: Whether the environment has no user, so that the rule decides wherever no policy answers.
        rewarded: Whether agents with deferred policies are agents of the environment, with rewards and ends.
        plugins: The handlers for this environment's simulation only. None if there are none.
        hooks: The hooks that must be set in the model while the environment is in use.
    """

    def __init__(
        self,
        source: Any,
        named: list[NamedPoint],
        options: Options,
        model: Model,
        *,
        unattended: bool = False,
        rewarded: bool = False,
        others: Any = None,
        variant: Any = None,
        prototypes: list[Prototype] | None = None,
    ) -> None:
        """Check everything, and find out who decides where: see ``Plan.build``."""
        self.source, self.variant, self.options, self.model = source, variant, options, model
        self._named = named
        self._prototypes = [] if prototypes is None else prototypes
        self.unattended, self.rewarded, self._others, self.solo = unattended, rewarded, others, False
        modes = model.render_modes
        if options.render_mode is not None and options.render_mode not in modes:
            raise OptionValueError(
                f"render_mode {short_repr(options.render_mode)} is not one of the simulation's:"
                f" {modes or 'it has none'}{did_you_mean(options.render_mode, modes)}"
            )
        agents = agent_names(named)
        if options.agent is not None and options.agent not in agents and None not in agents:
            raise AgentError(
                f"agent={short_repr(options.agent)} names no agent; the agents are {', '.join(filter(None, agents))}"
                f"{did_you_mean(options.agent, filter(None, agents))}"
            )
        by_point, self.policies, extra = resolve_policies(options.policies or {}, named, agents, model.points)
        self._everything, self._by_point = [*named, *extra], by_point
        self.hooks: list[Hook] = [point.point.hook for point in self._everything]
        own_hooks = {name: point.hook for name, point in by_name(model.points).items()}
        self.plugins = Plugins(options.plugins, own_hooks) if options.plugins else None
        self.unmatched_names = {*self.policies, *declared_agents(options.possible_agents)}
        mappings = any(given_simulation(point.definition, None) is not point.definition for point in self._everything)
        self.has_planner = any(isinstance(p, PlannerPolicy) for p in (*by_point.values(), *self.policies.values()))
        self.is_bound_to_simulation = mappings or self.has_planner
        self._prepare_points(first=True)

    @classmethod
    def draw_up(
        cls,
        source: Any,
        points: Any,
        options: Mapping[str, Any],
        *,
        unattended: bool = False,
        rewarded: bool = False,
        others: Any = None,
    ) -> Plan:
        """Make a plan from the arguments that a user gives.

        Args:
            source: A simulation, its class, a factory, or a variant.
            points: The active decision points, as ``generate_env`` takes them.
            options: The options, by name.
            unattended: Whether the environment has no user.
            rewarded: Whether agents with deferred policies are agents of the environment.
            others: The policy of all agents without one. With it, ``points=None`` means all decision points.

        Raises:
            SimEnvError: The arguments do not work. The subclass of the error says why.
        """
        variant = source if hasattr(source, "environment_arguments") else None
        if variant is not None:
            source, points, options = variant.environment_arguments(points, options)
        checked = Options().amended(options)
        if unattended and checked.agent is not None:
            raise UnknownOptionError("agent is an option of single views only, as single_env makes them")
        inspected: Any = source
        prototypes: list[Prototype] = []
        is_factory = not isinstance(source, type) and not hasattr(source, "run")
        if is_factory or (points is None and getattr(source, "points", None) is None):
            prototypes.append(Prototype(source, checked.driver))
            inspected = prototypes[0].simulation
        required = not unattended or others is not None or mentions_agents(checked.policies)
        model = Model.of(inspected)
        named = find_points(points, inspected, model.points, required=required, empty=unattended)
        return cls(
            source, named, checked, model, unattended=unattended, rewarded=rewarded, others=others, variant=variant,
            prototypes=prototypes,
        )  # fmt: skip

    # -- who decides where ------------------------------------------------------------------------

    def _prepare_points(self, *, first: bool) -> None:
        """Prepare the decision points, and find out who decides at each."""
        options = self.options
        agents = agent_names(self._everything)
        known = agents[: len(self._named)]
        self.points: list[Point] = []
        self.active: list[Point] = []
        for named, agent in zip(self._everything, agents, strict=True):
            policy = self._by_point.get(named.point, self._others)
            if options.agent is not None and agent != (options.agent if options.agent in known else None):
                policy = policy or RULE
            excepted = self.policies if agent is None else self.policies.get(agent, RULE) is not RULE
            if policy is not RULE or excepted:  # otherwise the rule decides
                self._prepare(named, agent, policy)
            else:
                self.unmatched_names.discard(agent)
        events: dict[DecisionPoint, Any] = {point.point: point for point in self.points}
        self._find_removals(events, warns=first)
        if self.points and self.model.ends_agents:
            self._add_event(events, locate(END_AGENT), EndAgent())
        self.events = {point.hook: event for point, event in events.items()}
        if not self.active and not self.unattended:
            raise UnknownPointError("no decision point is left to the environment: policies answer all of them")
        self.roster: dict[str, Point] = {}
        self.complete = False
        if self.rewarded:
            self.roster = {point.agent: point for point in self.active if point.agent is not None}
        else:
            roster, self.complete = resolve_roster(self.active, options.possible_agents, agents)
            if not self.unattended:
                self.roster = {name: point for name, point in roster.items() if name not in self.policies}
        if options.agent is not None:
            self._choose_one(options.agent)
        self.one_agent = self.active[0].agent or options.agent if len(self.active) == 1 else None

    def _prepare(self, named: NamedPoint, agent: str | None, policy: Any) -> None:
        """Prepare a decision point that does not run its rule."""
        policies = [policy, *self.policies.values()] if agent is None else [self.policies.get(agent, policy)]
        if self.rewarded:
            active = any(isinstance(policy, DeferredPolicy) for policy in policies)
        else:
            active = policy is None and agent not in self.policies
        point = Point(named, agent, policy, records=self.rewarded, clips=self.options.clip_actions)
        point.updates = make_updates(point)
        self.points.append(point)
        if active:
            self.active.append(point)

    def _choose_one(self, agent: str) -> None:
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
                f"the agent {short_repr(agent)} may decide at {', '.join(point.point.name for point in points)}; name"
                " its decision point in points=, or declare the agents of each with possible_agents="
            )
        self.active, self.roster, self.complete = points, {agent: points[0]}, True

    def _find_removals(self, events: dict[DecisionPoint, Any], *, warns: bool) -> None:
        for point in self.points:
            for name, agent in (*point.point.removed_by.items(), *point.definition.removed_by.items()):
                remover = locate(name, self.model.points)
                removal = self._add_event(events, remover, Removal(remover))
                if not isinstance(removal, Removal):
                    raise DefinitionError(
                        f"{name} is a decision point, so removed_by= cannot name it as a function that ends an agent"
                    )
                owner, remover_owner = owner_class(point.point), owner_class(remover)
                is_entity = agent is None and point.point.hook.bound and owner and remover_owner
                if is_entity and warns and not have_instances(owner, remover_owner):  # type: ignore[arg-type]
                    warn_user(
                        f"{name}, in removed_by= of {point.point.name}, is called on a {remover_owner.__name__}, not on"  # type: ignore[union-attr]
                        f" a {owner.__name__}, and so ends no agent; pass a dict from {name!r} to a callable of the"  # type: ignore[union-attr]
                        " call's arguments that names the agent"
                    )
                removal.of.append((point, agent, owner))

    def _add_event(self, events: dict[DecisionPoint, Any], point: DecisionPoint, event: Any) -> Any:
        """Set the event that the simulation sends when a function is called, unless there is one; return the event."""
        if point.hook not in self.hooks:
            self.hooks.append(point.hook)
        return events.setdefault(point, event)

    def policy_of(self, agent: str, point: Point) -> Any:
        """The policy that answers for an agent; None if the environment's user answers.

        Raises:
            AgentError: The agent is not declared, although the environment's options require it.
        """
        policy = self.policies.get(agent) or point.policy
        if policy is not None:
            return policy
        if self.unattended or (self.one_agent is not None and agent != self.one_agent):
            return RULE
        if not self.complete or agent in self.roster:
            return None
        if self.options.undeclared == "rule":
            return RULE
        raise AgentError(
            f"the agent {agent!r}, which decides at {point.point.name}, is not declared in possible_agents; declare"
            ' it, or let its rule decide with undeclared="rule"'
        )

    def owns(self, policy: Any) -> bool:
        """Whether an agent with this policy is an agent of the environment."""
        return policy is None or (self.rewarded and isinstance(policy, DeferredPolicy))

    @property
    def possible_agents(self) -> list[str] | None:
        """The names of all possible agents; None if an agent becomes known only when it decides."""
        return list(self.roster) if self.complete else None

    # -- the simulation ---------------------------------------------------------------------------

    @property
    def patches(self) -> list[Hook | Plugins]:
        """The hooks and plugins that must be set in the model while an environment is in use."""
        return [*self.hooks] if self.plugins is None else [*self.hooks, self.plugins]

    @property
    def stale(self) -> bool:
        """Whether other code has replaced a function that the plan patches since the plan was made."""
        return any(patch.stale for patch in self.patches)

    def prototype(self) -> Prototype | None:
        """Take the simulation that was made for inspection, with its stack; None if there is none that fits."""
        if self.plugins or self.options.global_rng:  # the simulation was made without them
            return None
        try:
            prototype = self._prototypes.pop()
        except IndexError:  # there is none, or another thread has just taken it
            return None
        return prototype if type(prototype.driver) is DRIVERS[self.options.driver] else None

    @property
    def maker(self) -> Any:
        """The class or factory of the simulation."""
        source = self.source
        while isinstance(source, partial):
            source = source.func
        return source if hasattr(source, "__qualname__") else type(source)

    @property
    def name(self) -> str:
        """The name of the simulation's class or factory."""
        return str(self.maker.__name__)

    # -- other plans ------------------------------------------------------------------------------

    def with_simulation(self, simulation: Any, session: Any) -> Plan:
        """Copy the plan, and give the simulation and its session to the mappings and policies that ask for them."""
        made = self._copied()
        made._everything = [
            replace(point, definition=given_simulation(point.definition, simulation)) for point in self._everything
        ]
        made._by_point = {key: bind_session(policy, session) for key, policy in self._by_point.items()}
        made.policies = {key: bind_session(policy, session) for key, policy in self.policies.items()}
        made._prepare_points(first=False)
        return made

    def for_one(self, agent: str) -> Plan:
        """Copy the plan for a branch that waits for one agent only. The rule decides for agents without a policy."""
        made = self._copied()
        made.unattended, made.rewarded, made.solo = True, False, True
        made.one_agent, made.unmatched_names = agent, set()
        return made

    def with_policies(self, policies: Mapping[str, Any]) -> Plan:
        """Copy the plan for a branch in which policies, given by agent, answer for agents that have none."""
        made = self._copied()
        made.policies = {**policies, **self.policies}
        return made

    def redefined(self, point: DecisionPoint, definition: Definition) -> Plan:
        """Make the same plan with another definition of a point."""
        named = [replace(own, definition=definition) if own.point is point else own for own in self._named]
        return self._like(named, self.options)

    def declared(self, roster: Mapping[str, Point]) -> Plan:
        """Make the same plan with a roster of agents that was found out."""
        names: dict[str, list[str]] = {point.point.name: [] for point in self.active if point.agent is None}
        for agent, point in roster.items():
            if point.agent is None:
                names[point.point.name].append(agent)
        plan = self.amended({"possible_agents": names})
        plan.unmatched_names = self.unmatched_names  # the user has not named the agents that were found out
        return plan

    def amended(self, options: Mapping[str, Any]) -> Plan:
        """Make the same plan with other values of the given options."""
        return self._like(self._named, self.options.amended(options)) if options else self

    def _like(self, named: list[NamedPoint], options: Options) -> Plan:
        return Plan(
            self.source, named, options, self.model, variant=self.variant, prototypes=self._prototypes
        )  # fmt: skip

    def _copied(self) -> Plan:
        made = Plan.__new__(Plan)
        vars(made).update(vars(self))
        return made

    def __deepcopy__(self, memory: Any) -> Plan:
        return self  # a plan holds no state of any environment

    def __reduce__(self) -> Any:
        points = {point.key: point.own_definition for point in self._named}
        options = {option.name: getattr(self.options, option.name) for option in fields(Options)}
        for name in ("policies", "possible_agents"):
            if isinstance(options[name], Mapping):
                options[name] = {portable(key): value for key, value in options[name].items()}
        options["plugins"] = [] if self.plugins is None else self.plugins.portable
        return _remade, (self.source, points, options, self.variant, self.unattended)


def _remade(source: Any, points: Any, options: dict[str, Any], variant: Any, unattended: bool) -> Plan:
    plan = Plan.draw_up(source, points, options, unattended=unattended)
    plan.variant = variant
    return plan
