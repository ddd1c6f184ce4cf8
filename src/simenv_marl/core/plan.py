"""What an environment is made of, all of it known and checked before anything runs.

A plan says which decision points an environment decides, under which agents' names, with which policies and
options. It holds no state of any episode, so that one plan serves any number of environments.
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
    meant,
    shown,
    warn_user,
)
from ..hooks.hook import Hook
from ..hooks.plugins import Plugins
from ..hooks.stacks import outside_simulation
from ..simulation import RULE, SimulationInterface
from .agent import settling
from .asking import AskingPolicy, given_session
from .bound import BoundPoint, DeferredPolicy, given_simulation
from .drivers import Spare
from .events import Answered, Decision, Ended, Removed, Told
from .options import Options
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
from .variant import Variant

RENDER_MODES = ("ansi", "human", "rgb_array")
"""What a simulation with a method ``render`` is taken to render, unless it has ``render_modes``."""

END_AGENT = f"{SimulationInterface.__module__}.{SimulationInterface.end_agent.__qualname__}"
"""Where a simulation says that an agent's episode ends."""

RENDER_FPS = 4
"""How many pictures make a second, unless it has ``render_fps``."""


class Plan:
    """What an environment is made of.

    Attributes:
        source: Of what its simulation is made.
        variant: The variant that it is made of; None if it is of none.
        options: Its options.
        render_modes: What its simulation can be rendered as.
        render_fps: How many of its pictures make a second of a film.
        points: The decision points that do not run their rule.
        active: Those of them that the environment's user answers.
        events: By decision point, what crosses from the simulation when it is called.
        decisions: The same by the point's hook, for drivers.
        policies: By name: the policies of agents that are no agents of the environment.
        asks: Whether some mapping asks for the simulation, or some policy for the environment.
        looked_into: Whether some policy asks for the environment, and may branch it.
        alone: Whether it is the plan of a branch that waits for one agent alone.
        wanted: The agents that ``policies`` and ``possible_agents`` name. Those that do not appear in an episode are
            warned of, once, and taken out.
        one_agent: The name of the one agent that the environment's user answers for; None where there may be more.
        roster: By name: the points of the agents that are known beforehand, in the order of the points.
        complete: Whether no others may join.
        unanswered: Whether there is no environment's user, and what no policy answers is left to its rule.
        rewarded: Whether agents that deferred policies answer are agents of the environment all the same, with rewards
            and ends.
        plugins: The handlers for its simulation alone; None if it has none.
        hooks: Of what must be set in the model while the environment is in use.
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
        variant: Variant | None = None,
        own: Mapping[DecisionPoint, Definition] = MappingProxyType({}),
    ) -> None:
        self.source, self.options, self._named, self._own = source, options, named, own
        self.variant = variant
        self._spare = [] if spare is None else spare  # the simulation that was looked at, until an environment takes it
        self.render_modes, self.render_fps = render_modes, render_fps
        if options.render_mode is not None and options.render_mode not in render_modes:
            raise OptionValueError(
                f"render_mode {shown(options.render_mode)} is not one of the simulation's:"
                f" {render_modes or 'it has none'}{meant(options.render_mode, render_modes)}"
            )
        self.unanswered, self.rewarded, self._ends_agents = unanswered, rewarded, ends_agents
        self._others = others
        agents = name_agents(named)
        if options.agent is not None and options.agent not in agents and None not in agents:
            raise AgentError(
                f"agent={shown(options.agent)} names no agent; the agents are {', '.join(filter(None, agents))}"
                f"{meant(options.agent, filter(None, agents))}"
            )
        by_point, self.policies, extra = assign(options.policies or {}, named, agents, own)
        self._everything, self._by_point = [*named, *extra], by_point
        self.hooks: list[Hook] = [point.point.hook for point in self._everything]
        named_here = {name: point.hook for name, point in by_name(own).items()}
        self.plugins = Plugins(options.plugins, named_here) if options.plugins else None
        self.wanted = {*self.policies, *declared_agents(options.possible_agents)}
        mappings = any(given_simulation(point.definition, None) is not point.definition for point in self._everything)
        self.looked_into = any(isinstance(p, AskingPolicy) for p in (*by_point.values(), *self.policies.values()))
        self.asks, self.alone = mappings or self.looked_into, False
        self._bind_points(first=True)

    def _bind_points(self, *, first: bool) -> None:
        """Make the decision points ready to be called, and find out who decides there."""
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
            if policy is not RULE or excepted:  # else its rule decides
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
        """The same plan, with a simulation, and its session, given to those mappings and policies that ask for it."""
        made = self._copied()
        made._everything = [
            replace(point, definition=given_simulation(point.definition, simulation)) for point in self._everything
        ]
        made._by_point = {key: given_session(policy, session) for key, policy in self._by_point.items()}
        made.policies = {key: given_session(policy, session) for key, policy in self.policies.items()}
        made._bind_points(first=False)
        return made

    def with_source(self, source: Any, variant: Variant | None, spare: Spare) -> Plan:
        """The same plan, of simulations that are made of something else, and of which there is one already."""
        made = self._copied()
        made.source, made.variant, made._spare = source, variant, [spare]
        return made

    @property
    def looked_at(self) -> Any:
        """The simulation that was made to be looked at, unless an environment has taken it."""
        return self._spare[-1].simulation if self._spare else None

    def for_one(self, agent: str) -> Plan:
        """The same plan, for a branch that waits for one agent alone: who has no policy is left to its rule."""
        made = self._copied()
        made.unanswered, made.rewarded, made.alone = True, False, True
        made.one_agent, made.wanted = agent, set()
        return made

    def led_by(self, policies: Mapping[str, Any]) -> Plan:
        """The same plan, for a branch in which policies, by agent, answer for agents that have none."""
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
        """Leave all agents but one to their policies or their rule.

        Raises:
            AgentError: The agent is not declared, or its decision point is not known.
            OptionValueError: A policy answers for it.
        """
        if agent in self.policies:
            raise OptionValueError(
                f"agent={shown(agent)} is answered by policies, and no decision is left to the environment"
            )
        if self.complete and agent not in self.roster:
            raise AgentError(
                f"agent={shown(agent)} names no agent of the environment; its agents are {', '.join(self.roster)}"
                f"{meant(agent, self.roster)}"
            )
        points = [self.roster[agent]] if self.complete else self.active
        if len(points) > 1:
            raise AgentError(
                f"the agent {shown(agent)} may decide at {', '.join(point.point.name for point in points)}; name its"
                " decision point in points=, or declare the agents of each with possible_agents="
            )
        self.active, self.roster, self.complete = points, {agent: points[0]}, True

    def policy_of(self, agent: str, point: BoundPoint) -> Any:
        """The policy of an agent; None: the environment's user.

        Raises:
            AgentError: The agent is not declared, and the environment asks for that.
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
        """Whether an agent with that policy is an agent of the environment."""
        return policy is None or (self.rewarded and isinstance(policy, DeferredPolicy))

    @property
    def possible_agents(self) -> list[str] | None:
        """The names of all agents that there may be; None where they are only known when they decide."""
        return list(self.roster) if self.complete else None

    @property
    def patches(self) -> list[Hook | Plugins]:
        """What must be set in the model while an environment is in use."""
        return [*self.hooks] if self.plugins is None else [*self.hooks, self.plugins]

    def _find_removals(self, *, warns: bool) -> None:
        for binding in self.points:
            for name, agent in (*binding.point.removed_by.items(), *binding.definition.removed_by.items()):
                point, _ = locate(name, self._own)
                removal = self._cross(point, Removed(point))
                if not isinstance(removal, Removed):
                    raise DefinitionError(f"{name} cannot both be decided by an agent and, as removed_by says, end one")
                owner, remover = owner_class(binding.point), owner_class(point)
                if agent is None and warns and point.bound and owner and remover and not have_instances(owner, remover):
                    warn_user(
                        f"{name}, which removed_by= of {binding.point.name} names, is called on a {remover.__name__},"
                        f" which is no {owner.__name__}, and so ends no agent; give a dict from {name!r} to a callable"
                        " of the call's arguments that names the agent"
                    )
                removal.of.append((binding, agent, owner))

    def _cross(self, point: DecisionPoint, event: Any) -> Any:
        """Have an event cross where a function is called, unless one does already; return the one that does."""
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
        """Make a plan of what users say.

        Args:
            source: A simulation, its class, a factory, or a variant.
            points: The active decision points, as ``generate_env`` takes them.
            options: The options, by name.
            unanswered: Whether there is no environment's user.
            rewarded: Whether agents that deferred policies answer are agents of the environment all the same.
            others: The policy of all for whom none is given; all decision points are meant where none is named.

        Raises:
            SimEnvError: Something in them cannot work; the leaf says what.
        """
        variant = source if isinstance(source, Variant) else None
        if variant is not None:
            source, points, options = variant.applied(points, options)
        checked = Options().amended(options)
        if unanswered and checked.agent is not None:
            raise UnknownOptionError("agent is an option of single_env, and of what makes single views, alone")
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
        return self  # it holds nothing of any environment

    def __reduce__(self) -> Any:
        points = {point.key: point.own_definition for point in self._named}
        options = {option.name: getattr(self.options, option.name) for option in fields(Options)}
        for name in ("policies", "possible_agents"):
            if isinstance(options[name], Mapping):
                options[name] = {portable(key): value for key, value in options[name].items()}
        options["plugins"] = [] if self.plugins is None else self.plugins.portable
        return _remade, (self.source, points, options, self.variant, self.unanswered)

    def spare(self) -> Spare | None:
        """The simulation that was made to be looked at, with its stack, if it serves an environment of this plan."""
        if self.plugins or self.options.global_rng:  # which it was made without
            return None
        try:
            spare = self._spare.pop()
        except IndexError:  # there is none, or another thread was faster
            return None
        return spare if spare.kind == self.options.driver else None

    def redefined(self, point: DecisionPoint, definition: Definition) -> Plan:
        """The same plan, with another definition of a point."""
        named = [replace(own, definition=definition) if own.point is point else own for own in self._named]
        return self._like(named, self.options)

    def declared(self, roster: Mapping[str, BoundPoint]) -> Plan:
        """The same plan, with a roster of agents that has been found out."""
        names: dict[str, list[str]] = {b.point.name: [] for b in self.active if b.agent is None}
        for agent, binding in roster.items():
            if binding.agent is None:
                names[binding.point.name].append(agent)
        plan = self.amended({"possible_agents": names})
        plan.wanted = self.wanted  # what was found out was named by no user
        return plan

    @property
    def stale(self) -> bool:
        """Whether a function that it patches has been replaced by another one since it was made."""
        return any(hook.stale for hook in self.hooks) or (self.plugins is not None and self.plugins.stale)

    @property
    def name(self) -> str:
        """What the simulation is called: the name of its class or factory."""
        return str(self.maker.__name__)

    @property
    def maker(self) -> Any:
        """The class or factory of the simulation."""
        source = self.source
        while isinstance(source, partial):
            source = source.func
        return source if hasattr(source, "__qualname__") else type(source)

    def amended(self, options: Mapping[str, Any]) -> Plan:
        """The same plan, but for the options that are given."""
        if not options:
            return self
        return self._like(self._named, self.options.amended(options))

    def _like(self, named: list[NamedPoint], options: Options) -> Plan:
        return Plan(
            self.source, named, options, self.render_modes, render_fps=self.render_fps, spare=self._spare,
            variant=self.variant, ends_agents=self._ends_agents, own=self._own,
        )  # fmt: skip


def _remade(source: Any, points: Any, options: dict[str, Any], variant: Variant | None, unanswered: bool) -> Plan:
    plan = Plan.draw_up(source, points, options, unanswered=unanswered)
    plan.variant = variant
    return plan
