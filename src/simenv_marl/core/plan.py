"""The plan of an environment: a complete description that is checked before anything runs.

A plan names the decision points of an environment, the names of their agents, the policies and the
options. It holds no state of any episode, so that one plan serves any number of environments.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any, Final
from weakref import finalize

from ..decision import BY_NAME, DecisionPoint, Definition
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
from ..hooks.handlers import Handler
from ..hooks.hook import Hook
from ..hooks.stacks import outside_simulation
from ..plugins import Plugins
from ..simulation import RULE, SimulationInterface, make_simulation
from .agent import make_updates
from .driver import Driver
from .greenlets import GreenletDriver
from .options import Options
from .point import Point, Removal, given_simulation
from .points import (
    agent_names,
    declared_agents,
    find_points,
    locate,
    own_points,
    owner_class,
    portable,
    resolve_policies,
    resolve_roster,
)
from .policies import AskingPolicy, DeferredPolicy
from .split import Split
from .threads import ThreadDriver

DRIVERS: Final[Mapping[str, Callable[..., Driver]]] = {
    "greenlet": GreenletDriver,
    "thread": ThreadDriver,
}


def source_name(source: Any) -> str:
    """Return the dotted name of a class or factory, or of the class of an object."""
    while isinstance(source, partial):
        source = source.func
    named = source if hasattr(source, "__qualname__") else type(source)
    return f"{named.__module__}.{named.__qualname__}"


class Prototype:
    """A simulation that a plan made for inspection, on a stack that ends with this object unless both are claimed."""

    def __init__(self, source: Any, kind: str) -> None:
        """Make a simulation from a simulation, class or factory, on a stack of the driver with that name."""
        self.driver = DRIVERS[kind]()
        self.end = finalize(self, self.driver.end)
        try:
            with outside_simulation():
                self.simulation = self.driver.run(lambda: make_simulation(source))
        except BaseException:
            self.end()
            raise


class Plan:
    """The plan of an environment.

    Attributes:
        source, variant: What the environment makes its simulation from, and the variant that says
            so, if there is one.
        options, render_modes, render_fps: The options, and what the simulation says of its
            rendering.
        points: The decision points that do not run their rule.
        active: The decision points that the environment's user answers.
        events: For each hook, the event that the simulation sends when its function is called.
        policies: By agent name, the policies of agents that are not agents of the environment.
        is_bound_to_simulation: Whether a mapping asks for the simulation.
        has_planner: Whether a policy asks for the environment, and so may branch it.
        unmatched_names: The agents that ``policies`` and ``possible_agents`` name. Agents that do
            not appear in an episode are removed from this set, with one warning.
        one_agent: The name of the only agent that the environment's user answers for. None if there
            may be several.
        roster: By agent name, the decision points of the agents that are known beforehand, in the
            order of the points.
        complete: Whether ``roster`` contains all possible agents.
        unattended: Whether the environment has no user, so that the rule decides wherever no policy
            answers.
        rewarded: Whether agents with deferred policies are agents of the environment, with rewards
            and ends.
        plugins: The handlers for this environment's simulation only. None if there are none.
        patches: The hooks, and the handlers with their hooks, that must be set while an environment
            is in use.
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
        """Make a plan from the arguments of ``generate_env``, and check them.

        ``others`` is the policy of all agents without one. With it, ``points=None`` means all
        decision points.

        Raises:
            SimEnvError: The arguments do not work. The subclass of the error says why.
        """
        self.variant = source if hasattr(source, "environment_arguments") else None
        if self.variant is not None:
            source, points, options = self.variant.environment_arguments(points, options)
        self.source, self.options = source, Options().amended(options)
        self.unattended, self.rewarded, self._others = unattended, rewarded, others
        if unattended and self.options.agent is not None:
            raise UnknownOptionError(
                "agent is an option of single views only, as single_env makes them"
            )
        inspected: Any = source
        self._prototypes: list[Prototype] = []
        if not isinstance(source, type) or (
            points is None and getattr(source, "points", None) is None
        ):
            self._prototypes.append(Prototype(source, self.options.driver))
            inspected = self._prototypes[0].simulation
        kind = inspected if isinstance(inspected, type) else type(inspected)
        self._ends_agents = issubclass(kind, SimulationInterface)
        modes = getattr(inspected, "render_modes", ("ansi", "human", "rgb_array"))
        self.render_modes = modes if hasattr(inspected, "render") else []
        self.render_fps = getattr(inspected, "render_fps", 4)
        self._own = own_points(inspected)
        if points is None:
            points = getattr(inspected, "points", None)
        names_agents = any(
            isinstance(key, str) and "." not in key for key in self.options.policies or {}
        )
        if points is None and unattended and others is None and not names_agents:
            points = ()  # those that ``policies`` names are enough
        self._named = find_points(points, self._own, empty=unattended)
        self._resolve()

    def _resolve(self) -> Plan:
        """Check the options against the simulation and its points, and find out which policy answers where."""
        mode, modes = self.options.render_mode, self.render_modes
        if mode is not None and self.options.picture_mode not in modes:
            warn_user(
                f"render_mode {mode!r} is not one of the simulation's"
                f" ({', '.join(modes) or 'it has none'}), and is ignored{did_you_mean(mode, modes)}"
            )
            self.options = replace(self.options, render_mode=None)
        options = self.options
        self._by_point, self.policies, self._definitions = resolve_policies(
            options.policies or {}, self._named, self._own
        )
        own_hooks = {point.name: point for point in self._own if hasattr(point.function, BY_NAME)}
        self.plugins = Plugins(options.plugins, own_hooks) if options.plugins else None
        self.unmatched_names = {*self.policies, *declared_agents(options.possible_agents)}
        policies = (*self._by_point.values(), *self.policies.values())
        self.has_planner = any(
            isinstance(policy, AskingPolicy) and policy.plans for policy in policies
        )
        self.is_bound_to_simulation = any(
            given_simulation(definition, None) is not definition
            for definition in self._definitions.values()
        )
        self._prepare_points()
        hooks = dict.fromkeys((*self._definitions, *self.events))
        handlers = [] if self.plugins is None else self.plugins.handlers
        self.patches: list[tuple[Hook, Handler | None]] = [(hook, None) for hook in hooks]
        self.patches += [(handler.target, handler) for handler in handlers]
        return self

    # -- who decides where ------------------------------------------------------------------------

    def _prepare_points(self) -> Plan:
        """Prepare the decision points that do not run their rule, and find out who decides at each."""
        options, agents = self.options, agent_names(self._definitions)
        known = [agents[point] for point in self._named]
        only = options.agent if options.agent in known else None
        self.points: list[Point] = []
        self.active: list[Point] = []
        for point, definition in self._definitions.items():
            agent, policy = agents[point], self._by_point.get(point, self._others)
            if options.agent is not None and agent != only:
                policy = policy or RULE
            policies = (
                [policy, *self.policies.values()]
                if agent is None
                else [self.policies.get(agent, policy)]
            )
            if policy is RULE and policies == [RULE]:
                self.unmatched_names.discard(agent)
                continue
            prepared = Point(point, definition, agent, policy, self.rewarded, options.clip_actions)
            prepared.updates = make_updates(prepared)
            self.points.append(prepared)
            if (
                any(isinstance(p, DeferredPolicy) for p in policies)
                if self.rewarded
                else policies[0] is None
            ):
                self.active.append(prepared)
        self._find_events()
        declared = None if self.rewarded else options.possible_agents
        self.roster, self.complete = resolve_roster(self.active, declared, agents.values())
        if not self.unattended:
            self.roster = {
                name: point for name, point in self.roster.items() if name not in self.policies
            }
        if options.agent is not None and (self.active or None not in known):
            self._choose_one(options.agent, known)
        if not self.active and not self.unattended:
            raise UnknownPointError(
                "no decision point is left to the environment: policies answer all of them"
            )
        self.one_agent = self.active[0].agent or options.agent if len(self.active) == 1 else None
        return self

    def _choose_one(self, agent: str, known: Collection[str | None]) -> None:
        """Let policies or the rule answer for all agents except one."""
        if agent in self.policies or (agent in known and agent not in self.roster):
            raise OptionValueError(
                f"agent={short_repr(agent)} is answered by policies, and no decision is left to"
                " the environment"
            )
        if self.complete and agent not in self.roster:
            names = [name for name in dict.fromkeys((*known, *self.roster)) if name is not None]
            raise AgentError(
                f"agent={short_repr(agent)} names no agent of the environment; its agents are"
                f" {', '.join(names)}{did_you_mean(agent, names)}"
            )
        points = [self.roster[agent]] if self.complete else self.active
        if len(points) > 1:
            raise AgentError(
                f"the agent {short_repr(agent)} may decide at"
                f" {', '.join(point.hook.name for point in points)}; name its decision point in"
                " points=, or declare the agents of each with possible_agents="
            )
        self.active, self.roster, self.complete = points, {agent: points[0]}, True

    def _find_events(self) -> None:
        """Find the events that the simulation sends: decisions, and calls that end agents."""
        self.events: dict[Hook, Any] = {
            point.hook: point if point.definition.split is None else Split(point)
            for point in self.points
        }
        for point in self.points:
            for name, agent in (
                *point.hook.removed_by.items(),
                *point.definition.removed_by.items(),
            ):
                remover = locate(name, self._own)
                removal = self.events.setdefault(remover, Removal())
                if not isinstance(removal, Removal):
                    raise DefinitionError(
                        f"{name} is a decision point, so removed_by= cannot name it as a function"
                        " that ends an agent"
                    )
                removal.of.append((point, agent, owner_class(point.hook)))
        if self.points and self._ends_agents:
            ends = self.events.setdefault(locate(SimulationInterface.end_agent), Removal())
            ends.of.append((None, lambda simulation, name: name, None))

    def policy_of(self, agent: str, point: Point) -> Any:
        """The policy that answers for an agent; None if the environment's user answers."""
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
            f"the agent {agent!r}, which decides at {point.hook.name}, is not declared in"
            " possible_agents; declare"
            ' it, or let its rule decide with undeclared="rule"'
        )

    @property
    def possible_agents(self) -> list[str] | None:
        """The names of all possible agents; None if an agent becomes known only when it decides."""
        return list(self.roster) if self.complete else None

    # -- the simulation ---------------------------------------------------------------------------

    @property
    def stale(self) -> bool:
        """Whether other code has replaced a function that the plan patches since the plan was made."""
        return any(hook.stale for hook, _ in self.patches)

    def claim_prototype(self) -> tuple[Driver, Any] | None:
        """Hand over the simulation that was made for inspection, and its driver, which the caller must end; or None."""
        if self.plugins or self.options.global_rng:  # the simulation was made without them
            return None
        with suppress(IndexError):  # there is none, or another thread has just taken it
            prototype = self._prototypes.pop()
            if type(prototype.driver) is DRIVERS[self.options.driver]:
                prototype.end.detach()
                return prototype.driver, prototype.simulation
        return None

    @property
    def name(self) -> str:
        """The name of the simulation's class or factory."""
        return source_name(self.source).rpartition(".")[2]

    # -- other plans ------------------------------------------------------------------------------

    def _changed(self, **changes: Any) -> Plan:
        made = Plan.__new__(Plan)
        vars(made).update(vars(self), **changes)
        return made

    def with_simulation(self, simulation: Any) -> Plan:
        """The same plan, in which mappings get the simulation that they ask for."""
        definitions = {
            key: given_simulation(value, simulation) for key, value in self._definitions.items()
        }
        return self._changed(_definitions=definitions)._prepare_points()

    def for_one(self, agent: str) -> Plan:
        """The plan of a branch that waits for one agent only.

        The rule decides for agents without a policy.
        """
        return self._changed(
            unattended=True, rewarded=False, one_agent=agent, unmatched_names=set()
        )

    def with_policies(self, policies: Mapping[str, Any]) -> Plan:
        """The plan of a branch in which policies, given by agent, answer for agents that have none."""
        return self._changed(policies={**policies, **self.policies})

    def redefined(self, point: DecisionPoint, definition: Definition) -> Plan:
        """The same plan with another definition of a point."""
        return self._changed(_named={**self._named, point: definition})._resolve()

    def declared(self, roster: Mapping[str, Point]) -> Plan:
        """The same plan with a roster of agents that was found out."""
        names = {
            point.hook.name: [agent for agent, other in roster.items() if other.hook is point.hook]
            for point in self.active
            if point.agent is None
        }
        made = self.amended({"possible_agents": names})
        # the user has not named the agents that were found out
        made.unmatched_names = self.unmatched_names
        return made

    def amended(self, options: Mapping[str, Any]) -> Plan:
        """The same plan with other values of the given options."""
        return self._changed(options=self.options.amended(options))._resolve() if options else self

    def __deepcopy__(self, memory: Any) -> Plan:
        return self  # a plan holds no state of any environment

    def __reduce__(self) -> Any:
        points = {
            portable(point.function, point.name): None
            if definition is point.definition
            else definition
            for point, definition in self._named.items()
        }
        options = {
            **vars(self.options),
            "plugins": [] if self.plugins is None else self.plugins.portable,
        }
        for name in ("policies", "possible_agents"):
            if isinstance(options[name], Mapping):
                options[name] = {portable(key): value for key, value in options[name].items()}
        return (
            partial(Plan, unattended=self.unattended),
            (self.source, points, options),
            {"variant": self.variant},
        )
