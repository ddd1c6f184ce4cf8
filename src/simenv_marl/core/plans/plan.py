"""The plan of an environment: a complete description that is checked before anything runs.

A plan names the decision points of an environment, the names of their agents, the policies and the
options. It is a value: it has no state of any environment, so that one plan serves any number.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import partial
from itertools import chain
from typing import Any, Final, NamedTuple, NoReturn, Protocol, TypeAlias, TypeVar, cast
from weakref import finalize

from ...decision import DecisionPoint, Definition
from ...errors import (
    AgentError,
    DefinitionError,
    OptionValueError,
    UnknownOptionError,
    UnknownPointError,
    ViewError,
    did_you_mean,
    short_repr,
    warn_user,
)
from ...hooks.handlers import Handler
from ...hooks.hook import Hook
from ...hooks.stacks import outside_simulation
from ...plugins import Plugins
from ...simulation import (
    EVERYONE,
    RULE,
    Model,
    SimulationInterface,
    make_simulation,
    optional_method,
)
from ..switching.driver import Driver
from ..switching.greenlets import GreenletDriver
from ..switching.threads import ThreadDriver
from .options import NOT_OF_RUNS, Options
from .point import Point, Policy
from .points import (
    Definitions,
    Points,
    agent_names,
    find_points,
    locate,
    overrides,
    own_points,
    owner_class,
    portable,
    resolve_policies,
    resolve_roster,
)
from .policies import DeferredPolicy, EpisodePolicy

DRIVERS: Final[Mapping[str, type[Driver]]] = {
    "greenlet": GreenletDriver,
    "thread": ThreadDriver,
}

Source: TypeAlias = "Model | type | Callable[[], Model]"
"""A simulation, its class, a zero-argument factory, or a ``Variant``."""

Derived = TypeVar("Derived")

PlannerView: TypeAlias = "Callable[[Any], object]"
"""Makes, from a session, the environment that a planner gets."""


def no_view(session: object) -> NoReturn:
    """Refuse to make the environment of a planner, in plans that run no episodes."""
    raise ViewError("this plan has no environment for planners")


class Mode(Enum):
    """The uses of the episodes of a plan."""

    ENVIRONMENT = "environment"
    """A user answers the agents without a policy."""

    SIMULATE = "simulate"
    """The rule decides for the agents without a policy."""

    COLLECT = "collect"
    """As SIMULATE, but agents with deferred policies have rewards and ends, which are recorded."""


class Variant(Protocol):
    """A variant of a simulation, which replaces the arguments of an environment."""

    name: str
    parameters: Mapping[str, object]
    policies: Mapping[Any, Policy] | None

    def environment_arguments(
        self, points: Points, options: Mapping[str, Any]
    ) -> tuple[Source, Points, Mapping[str, Any]]:
        """Return the source, the points and the options of the environment."""


def source_name(source: Source) -> str:
    """Return the dotted name of a class or factory, or of the class of an object."""
    while isinstance(source, partial):
        source = source.func
    named = source if hasattr(source, "__qualname__") else type(source)
    return f"{named.__module__}.{named.__qualname__}"


class Prototype:
    """A simulation that was made to be inspected, on a stack that ends with this object.

    The first session of a plan claims both.

    Attributes:
        driver: The name of the driver.
    """

    def __init__(self, source: Source, driver: str) -> None:
        """Make a simulation on a stack of the driver with that name."""
        self.driver = driver
        stack = DRIVERS[driver]()
        self._end = finalize(self, stack.end)
        try:
            with outside_simulation():
                stack.enter()
                simulation = stack.run(partial(make_simulation, source))
        except BaseException:
            self._end()
            raise
        self._unclaimed: list[tuple[Driver, Model]] = [(stack, simulation)]

    @property
    def simulation(self) -> Model:
        """The simulation, before it is claimed."""
        return self._unclaimed[0][1]

    def claim(self) -> tuple[Driver, Model] | None:
        """Hand over the stack and the simulation. None if they are claimed already."""
        with suppress(IndexError):  # because another thread may have claimed them
            claimed = self._unclaimed.pop()
            self._end.detach()
            return claimed
        return None


class Remover(NamedTuple):
    """A function of the model whose calls end agents.

    Attributes:
        hook: The function.
        point: The decision point of the agents. None: any.
        name: The name under which ``removed_by`` has the function.
        owner: The class whose instances are such agents. None if it is not known.
    """

    hook: Hook
    point: Point | None
    name: str | Callable[..., Model]
    owner: type | None


@dataclass(frozen=True, eq=False)
class Subject:
    """The source of a plan's simulations, its use, and the features of the simulation.

    Attributes:
        source: The source of its simulations.
        variant: The variant that gave the source, if there is one.
        mode: The use of its episodes.
        default_policy: The policy of all agents without one. None: the user or the rule.
        planner_view: Makes the environment that a planner gets.
        named: The decision points that are named, with their definitions.
        own: The definitions of the simulation itself.
        render_modes: The render modes of the simulation.
        render_fps: The number of images per second of a video.
        ends_agents: Whether the simulation has ``end_agent``.
        prototype: A simulation that was made to be inspected, if there is one.
        given: The decision points as they were named, before a view has changed a definition.
    """

    source: Source
    variant: Variant | None
    mode: Mode
    default_policy: Policy
    planner_view: PlannerView
    named: Definitions
    own: Definitions
    render_modes: Collection[str]
    render_fps: float
    ends_agents: bool
    prototype: Prototype | None
    given: Definitions


@dataclass(frozen=True, eq=False)
class Plan:
    """The plan of an environment.

    Attributes:
        subject: The simulation and its use.
        options: The options.
        points: The decision points that do not run their rule.
        active: The decision points that the environment's user answers.
        policies: The policies of agents, by name.
        everyone: The policy of all agents without one. None: there is none.
        has_planner: Whether a policy asks for the environment, and so may branch it.
        has_split: Whether a call of the model may hold several decisions.
        named_agents: The agents that ``policies`` and ``possible_agents`` name.
        one_agent: The only agent that the environment's user answers for. None if there may be
            several.
        roster: The decision points of the agents that are known beforehand, by agent, in the order
            of the points.
        places: All decision points of these agents, by agent.
        complete: Whether ``roster`` contains all possible agents.
        removers: The functions whose calls end agents.
        overrides: The functions that override each of the points, and are no points.
        plugins: The handlers for this environment's simulation only. None if there are none.
        unites: Whether a view unites the spaces of all agents.
        patches: The hooks, and the handlers with their hooks, that must be set while an environment
            is in use.
    """

    subject: Subject
    options: Options
    points: tuple[Point, ...]
    active: tuple[Point, ...]
    policies: Mapping[str, Policy]
    everyone: Policy
    has_planner: bool
    has_split: bool
    named_agents: frozenset[str]
    one_agent: str | None
    roster: Mapping[str, Point]
    places: Mapping[str, Sequence[Point]]
    complete: bool
    removers: tuple[Remover, ...]
    overrides: Mapping[Point, Collection[Hook]]
    plugins: Plugins | None
    patches: tuple[tuple[Hook, Handler | None], ...]

    unites: bool = False

    _derived: dict[Callable[[Plan], Model], Model] = field(init=False, default_factory=dict)

    def derive(self, function: Callable[[Plan], Derived]) -> Derived:
        """Call a function of the plan once, and return its result each time."""
        if function not in self._derived:
            self._derived[function] = function(self)
        derived: Derived = self._derived[function]
        return derived

    @property
    def has_user(self) -> bool:
        """Whether a user answers the agents without a policy."""
        return self.subject.mode is Mode.ENVIRONMENT

    @property
    def possible_agents(self) -> list[str] | None:
        """The names of all possible agents. None if an agent joins when it first decides."""
        return list(self.roster) if self.complete else None

    @property
    def name(self) -> str:
        """The name of the simulation's class or factory."""
        return source_name(self.subject.source).rpartition(".")[2]

    def policy_of(self, agent: str, point: Point) -> Policy:
        """Return the policy that answers for an agent. None if the environment's user answers."""
        policy = self.policies.get(agent) or point.policy
        if policy is not None:
            return policy
        if not self.has_user or (self.one_agent is not None and agent != self.one_agent):
            return self.everyone or RULE
        if not self.complete or agent in self.roster:
            return None
        if self.options.undeclared == "rule":
            return RULE
        raise AgentError(
            f"the agent {agent!r}, which decides at {point.hook.name}, is not declared in"
            " possible_agents; declare it, or let its rule decide with"
            ' undeclared="rule"'
        )

    def can_share(self, one: Point, other: Point) -> bool:
        """Return whether an agent may decide at both of two points."""
        return self.unites or not self.has_user or one.has_spaces_of(other)

    def is_delegated(self, policy: Policy) -> bool:
        """Return whether agents with a policy are no agents of the environment."""
        if policy is None:
            return False
        return self.subject.mode is not Mode.COLLECT or not isinstance(policy, DeferredPolicy)

    def claim_prototype(self) -> tuple[Driver, Model] | None:
        """Hand over the simulation that was made to be inspected, and its driver, or None."""
        prototype = self.subject.prototype
        options = self.options
        if prototype is None or prototype.driver != options.driver:
            return None
        if self.plugins or options.global_rng:  # it was made without them
            return None
        return prototype.claim()

    # -- other plans ------------------------------------------------------------------------------

    def amended(self, options: Mapping[str, Any]) -> Plan:
        """Return the same plan with other values of some options."""
        return _resolve(self.subject, self.options.amended(options)) if options else self

    def redefined(self, point: DecisionPoint, definition: Definition) -> Plan:
        """Return the same plan with another definition of a point."""
        named = {**self.subject.named, point: definition}
        return _resolve(replace(self.subject, named=named), self.options)

    def declared(self, roster: Mapping[str, Point]) -> Plan:
        """Return the same plan with a roster that an episode has shown."""
        hooks = [point.hook for point in self.active if point.agent is None]
        names = {
            hook.name: [agent for agent, point in roster.items() if point.hook is hook]
            for hook in hooks
        }
        made = self.amended({"possible_agents": names})
        return replace(made, named_agents=self.named_agents)  # the user has named no others

    def for_one(self, agent: str) -> Plan:
        """Return the plan of a branch that waits for one agent only."""
        subject = replace(self.subject, mode=Mode.SIMULATE)
        return replace(self, subject=subject, one_agent=agent, named_agents=frozenset())

    def with_policies(self, policies: Mapping[Any, Policy]) -> Plan:
        """Return the plan of a branch in which policies answer for agents that have none."""
        everyone = policies.get(EVERYONE, self.everyone)
        return replace(self, policies={**policies, **self.policies}, everyone=everyone)

    def __deepcopy__(self, memory: object) -> Plan:
        return self  # because nothing changes it

    def __reduce__(self) -> tuple[Callable[..., Plan], tuple[object, ...]]:
        subject = self.subject
        points: dict[object, Definition | None] = {}
        for point, definition in subject.named.items():
            is_own = definition is point.definition
            points[portable(point.function, point.name)] = None if is_own else definition
        options = dict(vars(self.options))
        options["plugins"] = [] if self.plugins is None else self.plugins.portable
        for name in ("policies", "possible_agents"):
            if isinstance(options[name], Mapping):
                options[name] = {portable(key): value for key, value in options[name].items()}
        make = partial(
            make_plan,
            mode=subject.mode,
            planner_view=subject.planner_view,
            variant=subject.variant,
        )
        return make, (subject.source, points, options)


def make_plan(
    source: Source,
    points: Points,
    options: Mapping[str, Any],
    *,
    mode: Mode = Mode.ENVIRONMENT,
    default_policy: Policy = None,
    planner_view: PlannerView = no_view,
    variant: Variant | None = None,
) -> Plan:
    """Make a plan from the arguments of ``generate_env``, and check them.

    Args:
        source: The simulation, its class, a factory, or a ``Variant``.
        points: The decision points.
        options: The options.
        mode: The use of the episodes.
        default_policy: The policy of all agents without one. With it, ``points=None`` means all
            decision points.
        planner_view: Makes the environment that a planner gets.
        variant: The variant that has given the other arguments, if there is one.

    Raises:
        SimEnvError: An argument is invalid. The message says which.
    """
    if hasattr(source, "environment_arguments"):
        variant = cast("Variant", source)
        source, points, options = variant.environment_arguments(points, options)
    checked = Options().amended(options)
    has_user = mode is Mode.ENVIRONMENT
    for name, views in () if has_user else NOT_OF_RUNS.items():
        if getattr(checked, name) is not None:
            raise UnknownOptionError(
                f"{name} is an option of {views} only, as single_env makes them"
            )
    prototype: Prototype | None = None
    inspected = source
    named = getattr(source, "points", None) if points is None else points
    if named is None or not isinstance(source, type):
        prototype = Prototype(source, checked.driver)
        inspected = prototype.simulation
    if points is None:
        points = getattr(inspected, "points", None)
    if points is None and not has_user and default_policy is None:
        policies = checked.policies or {}
        names_agents = any(
            key is EVERYONE or (isinstance(key, str) and "." not in key) for key in policies
        )
        if not names_agents:
            points = ()  # the points in ``policies`` are enough
    own = own_points(inspected)
    kind = inspected if isinstance(inspected, type) else type(inspected)
    modes = getattr(inspected, "render_modes", ("ansi", "human", "rgb_array"))
    arguments = ("self", "mode") if inspected is kind else ("mode",)
    found = find_points(points, own, empty=not has_user)
    subject = Subject(
        source,
        variant,
        mode,
        default_policy,
        planner_view,
        found,
        own,
        modes if optional_method(inspected, "render", *arguments) else [],
        getattr(inspected, "render_fps", 4),
        issubclass(kind, SimulationInterface),
        prototype,
        found,
    )
    return _resolve(subject, checked)


def _no_reward() -> float:
    """Reward nothing, because the team's reward takes the place of the agent's."""
    return 0.0


# -- who decides where ----------------------------------------------------------------------------


def _resolve(subject: Subject, options: Options) -> Plan:
    """Check the options against the simulation and its points, and find out who decides where."""
    options = _checked_render_mode(subject, options)
    by_point, by_agent, definitions = resolve_policies(
        options.policies or {}, subject.named, subject.own
    )
    agents = agent_names(definitions)
    known = [agents[hook] for hook in subject.named]
    only = options.agent if options.agent in known else None
    has_user = subject.mode is Mode.ENVIRONMENT
    collects = subject.mode is Mode.COLLECT
    everyone = (options.policies or {}).get(EVERYONE)
    if has_user and everyone is not None and options.agent is None:
        raise OptionValueError(
            "a policy for all agents leaves no decision to the environment; make a single_env, and"
            " name the agent that its user answers with agent="
        )
    default = subject.default_policy if has_user or everyone is None else everyone
    points: list[Point] = []
    active: list[Point] = []
    for hook, definition in definitions.items():
        agent = agents[hook]
        policy = by_point.get(hook, default)
        if options.agent is not None and agent != only:
            policy = policy or everyone or RULE
        policies = [policy, *by_agent.values()] if agent is None else [by_agent.get(agent, policy)]
        if policy is RULE and policies == [RULE]:
            continue
        clips = options.clip_actions
        if options.team_reward is not None:
            definition = replace(definition, reward_mapping=_no_reward)
        point = Point(hook, definition, agent, policy, records=collects, clips=clips)
        points.append(point)
        is_active = policies[0] is None
        if collects:
            is_active = any(isinstance(policy, DeferredPolicy) for policy in policies)
        if is_active:
            active.append(point)
    declared = options.possible_agents if has_user else None
    places, complete = resolve_roster(active, declared, agents.values())
    taken = by_agent if has_user else ()
    roster = {name: place[0] for name, place in places.items() if name not in taken}
    if options.agent is not None and (active or None not in known):
        active, roster = _choose_one(options.agent, known, active, roster, complete, by_agent)
        complete = True
    if has_user and not active:
        raise UnknownPointError(
            "no decision point is left to the environment: policies answer all of them"
        )
    own_hooks = {hook.name: hook for hook in subject.own}
    plugins = Plugins(options.plugins, own_hooks) if options.plugins else None
    handlers = [] if plugins is None else plugins.handlers
    removers = _removers(points, subject)
    others = {
        point: [hook for hook in overrides(point.hook) if hook not in definitions]
        for point in points
        if has_user or by_agent or point.policy is not None
    }
    hooks = (*definitions, *(remover.hook for remover in removers), *chain(*others.values()))
    ruled = set(agents.values()) - {point.agent for point in points}
    return Plan(
        subject,
        options,
        points=tuple(points),
        active=tuple(active),
        policies=by_agent,
        everyone=everyone,
        has_planner=any(
            isinstance(policy, EpisodePolicy) and policy.plans
            for policy in (*by_point.values(), *by_agent.values())
        ),
        has_split=any(point.split is not None for point in points),
        named_agents=frozenset({*by_agent, *options.declared_agents} - ruled),
        one_agent=_one_agent(active, options),
        roster=roster,
        places={name: places.get(name, [point]) for name, point in roster.items()},
        complete=complete,
        removers=removers,
        overrides=others,
        plugins=plugins,
        patches=(
            *dict.fromkeys(hooks).items(),
            *((handler.target, handler) for handler in handlers),
        ),
    )


def _one_agent(active: Collection[Point], options: Options) -> str | None:
    """Return the only agent that the user answers. None if there may be several."""
    names = {point.agent for point in active}
    if len(names) > 1 or (len(active) > 1 and None in names):
        return None
    return next(iter(names), None) or options.agent


def _checked_render_mode(subject: Subject, options: Options) -> Options:
    """Warn of a render mode that the simulation does not have, and leave it out."""
    mode = options.render_mode
    modes = subject.render_modes
    if mode is None or options.picture_mode in modes:
        return options
    warn_user(
        f"render_mode {mode!r} is not one of the simulation's"
        f" ({', '.join(modes) or 'it has none'}), and is ignored{did_you_mean(mode, modes)}"
    )
    return replace(options, render_mode=None)


def _choose_one(
    agent: str,
    known: Collection[str | None],
    active: list[Point],
    roster: Mapping[str, Point],
    complete: bool,
    by_agent: Mapping[str, Policy],
) -> tuple[list[Point], dict[str, Point]]:
    """Return the one active point, and the roster, of a view of one agent."""
    if agent in by_agent or (agent in known and agent not in roster):
        raise OptionValueError(
            f"agent={short_repr(agent)} is answered by policies, and no decision is left to the"
            " environment"
        )
    if complete and agent not in roster:
        names = [name for name in dict.fromkeys((*known, *roster)) if name is not None]
        raise AgentError(
            f"agent={short_repr(agent)} names no agent of the environment; its agents are"
            f" {', '.join(names)}{did_you_mean(agent, names)}"
        )
    points = active
    if complete:
        points = [point for point in active if point.agent == agent] or [roster[agent]]
    elif len(points) > 1:
        raise AgentError(
            f"the agent {short_repr(agent)} may decide at"
            f" {', '.join(point.hook.name for point in points)}; for a single view, name one of"
            " these in points=, or declare the agents of each with possible_agents=; other views"
            " take no agent="
        )
    return points, {agent: points[0]}


def _removers(points: Collection[Point], subject: Subject) -> tuple[Remover, ...]:
    """Find the functions whose calls end agents."""
    decisions = {point.hook for point in points}
    found: list[Remover] = []
    for point in points:
        for name in point.removed_by:
            hook = locate(name, subject.own)
            if hook in decisions:
                raise DefinitionError(
                    f"{hook.name} is a decision point, so removed_by= cannot name it as a function"
                    " that ends an agent"
                )
            found.append(Remover(hook, point, name, owner_class(point.hook)))
    if points and subject.ends_agents:
        found.append(Remover(locate(SimulationInterface.end_agent), None, "end_agent", None))
    return tuple(found)
