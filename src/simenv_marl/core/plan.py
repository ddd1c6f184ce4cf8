"""The plan of an environment: a complete description that is checked before anything runs.

A plan names the decision points of an environment, the names of their agents, the policies and the options. It holds no
state of any episode, so that one plan serves any number of environments.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from functools import partial
from typing import Any, Final
from weakref import finalize

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
from ..hooks.stacks import outside_simulation
from ..plugins import Plugins
from ..simulation import RULE, SimulationInterface, make_simulation
from .agent import make_updates
from .driver import Driver
from .greenlets import GreenletDriver
from .options import Options
from .planner import DeferredPolicy, PlannerPolicy, bind_session
from .point import EndAgent, Point, Removal, given_simulation
from .points import (
    NamedPoint,
    agent_names,
    by_name,
    declared_agents,
    find_points,
    have_instances,
    locate,
    mentions_agents,
    own_points,
    owner_class,
    portable,
    resolve_policies,
    resolve_roster,
)
from .threads import ThreadDriver

DRIVERS: Final[Mapping[str, Callable[..., Driver]]] = {"greenlet": GreenletDriver, "thread": ThreadDriver}

END_AGENT: Final = f"{SimulationInterface.__module__}.{SimulationInterface.end_agent.__qualname__}"
"""The dotted name of the method by which a simulation ends an agent's episode."""

RENDER_MODES: Final = ("ansi", "human", "rgb_array")
"""The render modes of a simulation with a method ``render`` that does not define ``render_modes``."""

RENDER_FPS: Final = 4
"""The frames per second of a simulation that does not define ``render_fps``."""


class Prototype:
    """A simulation that a plan made for inspection, with its stack, until an environment claims both.

    Attributes:
        driver, simulation: The stack, and the simulation that was made on it.
    """

    def __init__(self, source: Any, kind: str) -> None:
        """Make a simulation from a simulation, class or factory, on a stack of the driver with that name."""
        self.driver = DRIVERS[kind]()
        self._end = finalize(self, self.driver.end)
        try:
            with outside_simulation():
                self.simulation = self.driver.run(lambda: make_simulation(source))
        except BaseException:
            self._end()
            raise

    def claim(self) -> tuple[Driver, Any]:
        """Hand over the driver and the simulation. From now on the caller must end them."""
        self._end.detach()
        return self.driver, self.simulation


class Plan:
    """The plan of an environment.

    Attributes:
        source: The simulation, class or factory from which the environment makes its simulation.
        variant: The variant from which the environment is made. None if it is not made from a variant.
        options: The options.
        render_modes, render_fps: The simulation's render modes, and the frames per second of its rendering.
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
        points: Any,
        options: Mapping[str, Any],
        *,
        unattended: bool = False,
        rewarded: bool = False,
        others: Any = None,
    ) -> None:
        """Make a plan from the arguments that a user gives, and check them.

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
        self.variant = source if hasattr(source, "environment_arguments") else None
        if self.variant is not None:
            source, points, options = self.variant.environment_arguments(points, options)
        self.source, self.options = source, Options().amended(options)
        self.unattended, self.rewarded, self._others, self.solo = unattended, rewarded, others, False
        if unattended and self.options.agent is not None:
            raise UnknownOptionError("agent is an option of single views only, as single_env makes them")
        inspected: Any = source
        self._prototypes: list[Prototype] = []
        is_factory = not isinstance(source, type) and not hasattr(source, "run")
        if is_factory or (points is None and getattr(source, "points", None) is None):
            self._prototypes.append(Prototype(source, self.options.driver))
            inspected = self._prototypes[0].simulation
        kind = inspected if isinstance(inspected, type) else type(inspected)
        self._ends_agents = issubclass(kind, SimulationInterface)
        modes = getattr(inspected, "render_modes", RENDER_MODES) if hasattr(inspected, "render") else ()
        self.render_modes, self.render_fps = list(modes), getattr(inspected, "render_fps", RENDER_FPS)
        self._own = own_points(inspected)
        required = not unattended or others is not None or mentions_agents(self.options.policies)
        self._named = find_points(points, inspected, self._own, required=required, empty=unattended)
        self._resolve()

    def _resolve(self) -> None:
        """Check the options against the simulation and its points, and find out which policy answers where."""
        options, modes = self.options, self.render_modes
        if options.render_mode is not None and options.render_mode not in modes:
            raise OptionValueError(
                f"render_mode {short_repr(options.render_mode)} is not one of the simulation's:"
                f" {modes or 'it has none'}{did_you_mean(options.render_mode, modes)}"
            )
        agents = agent_names(self._named)
        if options.agent is not None and options.agent not in agents and None not in agents:
            raise AgentError(
                f"agent={short_repr(options.agent)} names no agent; the agents are {', '.join(filter(None, agents))}"
                f"{did_you_mean(options.agent, filter(None, agents))}"
            )
        by_point, self.policies, extra = resolve_policies(options.policies or {}, self._named, agents, self._own)
        self._everything, self._by_point = [*self._named, *extra], by_point
        self.hooks: list[Hook] = [point.point.hook for point in self._everything]
        own_hooks = {name: point.hook for name, point in by_name(self._own).items()}
        self.plugins = Plugins(options.plugins, own_hooks) if options.plugins else None
        self.unmatched_names = {*self.policies, *declared_agents(options.possible_agents)}
        mappings = any(given_simulation(point.definition, None) is not point.definition for point in self._everything)
        self.has_planner = any(isinstance(p, PlannerPolicy) for p in (*by_point.values(), *self.policies.values()))
        self.is_bound_to_simulation = mappings or self.has_planner
        self._prepare_points(warns=True)

    # -- who decides where ------------------------------------------------------------------------

    def _prepare_points(self, *, warns: bool) -> None:
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
        self._find_removals(events, warns=warns)
        if self.points and self._ends_agents:
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
                remover = locate(name, self._own)
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
    def name(self) -> str:
        """The name of the simulation's class or factory."""
        source = self.source
        while isinstance(source, partial):
            source = source.func
        return str((source if hasattr(source, "__qualname__") else type(source)).__name__)

    # -- other plans ------------------------------------------------------------------------------

    def with_simulation(self, simulation: Any, session: Any) -> Plan:
        """Copy the plan, and give the simulation and its session to the mappings and policies that ask for them."""
        made = copy.copy(self)
        made._everything = [
            replace(point, definition=given_simulation(point.definition, simulation)) for point in self._everything
        ]
        made._by_point = {key: bind_session(policy, session) for key, policy in self._by_point.items()}
        made.policies = {key: bind_session(policy, session) for key, policy in self.policies.items()}
        made._prepare_points(warns=False)
        return made

    def for_one(self, agent: str) -> Plan:
        """Copy the plan for a branch that waits for one agent only. The rule decides for agents without a policy."""
        made = copy.copy(self)
        made.unattended, made.rewarded, made.solo = True, False, True
        made.one_agent, made.unmatched_names = agent, set()
        return made

    def with_policies(self, policies: Mapping[str, Any]) -> Plan:
        """Copy the plan for a branch in which policies, given by agent, answer for agents that have none."""
        made = copy.copy(self)
        made.policies = {**policies, **self.policies}
        return made

    def redefined(self, point: DecisionPoint, definition: Definition) -> Plan:
        """Make the same plan with another definition of a point."""
        made = copy.copy(self)
        made._named = [replace(own, definition=definition) if own.point is point else own for own in self._named]
        made._resolve()
        return made

    def declared(self, roster: Mapping[str, Point]) -> Plan:
        """Make the same plan with a roster of agents that was found out."""
        names: dict[str, list[str]] = {point.point.name: [] for point in self.active if point.agent is None}
        for agent, point in roster.items():
            if point.agent is None:
                names[point.point.name].append(agent)
        made = self.amended({"possible_agents": names})
        made.unmatched_names = self.unmatched_names  # the user has not named the agents that were found out
        return made

    def amended(self, options: Mapping[str, Any]) -> Plan:
        """Make the same plan with other values of the given options."""
        if not options:
            return self
        made = copy.copy(self)
        made.options = self.options.amended(options)
        made._resolve()
        return made

    def __copy__(self) -> Plan:
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
        return _unpickle, (self.source, points, options, self.variant, self.unattended)


def _unpickle(source: Any, points: Any, options: dict[str, Any], variant: Any, unattended: bool) -> Plan:
    plan = Plan(source, points, options, unattended=unattended)
    plan.variant = variant
    return plan
