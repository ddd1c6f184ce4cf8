"""The handlers of a simulation's events: decisions, ends of agents, decisions of rules."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field

from ...decision import inverse
from ...errors import InvalidActionError, listed, short_repr, warn_user
from ...hooks.hook import Hook
from ...simulation import RULE, Action, Model
from ..plans.mappings import adapt
from ..plans.plan import Plan, Remover
from ..plans.point import Args, Kwargs, Point, Policy
from ..switching.driver import WAIT, AnyHandler, Notice, Observer
from ..values.actions import ILLEGAL
from .agent import Agent, RunningEpisode
from .arguments import restore
from .split import SplitHandler

NameAgent = Callable[..., Model]
"""Returns the name of the agent that a call ends, for the arguments of the call."""


class PointHandler:
    """Handles the decisions at a point.

    Attributes:
        point: The decision point.
        report: Handles the decisions of the rule. None if they are not reported.
    """

    def __init__(self, point: Point) -> None:
        self.point = point
        self.report: AnyHandler | None = RuleHandler(point) if point.reports_rule else None
        self._problems: set[str] = set()

    reports_itself = False

    @property
    def deliver(self) -> Callable[..., Model] | None:
        """Turns a reply into the value of a call, on the simulation's side."""
        return self.point.deliver

    def handle(self, episode: RunningEpisode, args: Args, kwargs: Kwargs) -> Model:
        """Find the agent that decides, or let it join; then handle its decision."""
        point = self.point
        name: Model = point.agent
        if name is None:
            name_agent = point.name_agent
            name = name_agent(*args, **kwargs) if kwargs else name_agent(*args)
            if name is None:
                return RULE
        agent = None
        if type(name) is str:
            agent = episode.agents.get(name) or episode.others.get(name)
        if agent is None or agent.handler is not self:
            agent = episode.agent_for(self, name)
        return agent.handle(episode, args, kwargs)

    def warn_of_several(self, agent: str) -> str:
        """Warn once that several objects decide under the name of one agent. Return the text."""
        return self._warn_once(
            "several",
            f"several objects decide at {self.point.hook.name} as one agent, {agent!r}: their"
            " rewards and differences mix. Set agent= of its make_step to a callable that names"
            " each object differently, or to a string if one agent is meant",
        )

    def warn_of_gone(self, gone: set[int | str], effect: str) -> str:
        """Warn once that the model has freed arguments that mappings take. Return the text."""
        signature = self.point.hook.signature
        parameters = ["the item"] * (self.point.split is not None)
        parameters += [] if signature is None else signature.parameters
        known: dict[int | str, str] = dict(enumerate(parameters))
        names = sorted(known.get(argument, f"argument {argument}") for argument in gone)
        return self._warn_once(
            "gone",
            f"the model has freed {', '.join(names)} of the latest call of"
            f" {self.point.hook.name}, which its mappings take, so {effect} where an agent has"
            " ended or a round has returned. Name the function that removes it in removed_by=, let"
            " the mapping take _simulation instead, or keep the object in the simulation",
        )

    def _warn_once(self, kind: str, problem: str) -> str:
        if kind not in self._problems:
            self._problems.add(kind)
            warn_user(problem)
        return problem


@dataclass(eq=False)
class RemovalHandler(Observer):
    """Handles calls that end agents. It changes nothing in the simulation: the function runs.

    Attributes:
        hook: The hook of the function.
        roster: The names of the agents that are known beforehand.
        last: Handles the ends of the calls. None: nothing does.
    """

    hook: Hook
    roster: Collection[str]
    last: AnyHandler | None
    # The handlers of points, the classes of agents, and the callables that name agents.
    _removals: list[tuple[PointHandler | None, type | None, NameAgent | None]] = field(
        default_factory=list
    )
    _has_warned: bool = False

    @property
    def report(self) -> AnyHandler | None:
        """Handles the ends of calls."""
        return self.last

    def add(self, handler: PointHandler | None, remover: Remover) -> None:
        """Let calls end agents of a point. None: any agents."""
        name_agent = None if handler is None else handler.point.removed_by[remover.name]
        if name_agent is not None:
            name_agent = adapt(name_agent, "removed_by", remover.hook).call
        self._removals.append((handler, remover.owner, name_agent))

    def handle(self, episode: RunningEpisode, args: Args, kwargs: Kwargs) -> Model:
        """Give the agents their last rewards and observations; then let the function run."""
        episode.called.add(self.hook)
        # All names come first, because the end of an agent may change them.
        named = []
        for handler, owner, name_agent in self._removals:
            if name_agent is not None:
                name = name_agent(*args, **kwargs)
            elif handler is None:
                name = args[1]  # ``SimulationInterface.end_agent`` gets it after the simulation
            else:
                name = _name_of_entity(episode, handler, owner, args)
            named.append((handler, name))
        for handler, name in named:
            agent = episode.agents.get(name) or episode.others.get(name)
            is_its_own = agent is not None and handler in (None, agent.handler)
            if agent is not None and (is_its_own or name in episode.moved):
                episode.end_agent(agent)
            elif handler is None and name is not None and not self._has_warned:
                known = [*episode.agents, *episode.others, *episode.ended]
                if name in known or name in self.roster:
                    continue
                self._has_warned = True
                warn_user(
                    f"end_agent({short_repr(name)}) has no effect, because no agent has had this"
                    f" name in the episode; these have: {listed(known)}"
                )
        return RULE


class LastHandler(Observer):
    """Handles the ends of calls that end agents, where no decision may ever come after the last."""

    def handle(self, episode: RunningEpisode, args: Args, kwargs: Kwargs) -> Model:
        """End the episode if no agent is left. Return ``WAIT`` then, else None."""
        if episode.agents:
            return None
        episode.finish(truncated=False)
        return WAIT


def _name_of_entity(
    episode: RunningEpisode, handler: PointHandler, owner: type | None, args: Args
) -> Model:
    """Return the name of the agent that is the first argument of a call. None if it is none."""
    point = handler.point
    if not args or (owner is not None and not isinstance(args[0], owner)):
        return None
    if point.agent is not None:
        return point.agent
    name = point.name_agent(args[0])
    if name is not None:
        return name
    for agent in reversed(episode.agents.values()):  # an entity may have been another agent before
        if agent.handler is handler and agent.arguments.first() is args[0]:
            return agent.name
    return None


class RuleHandler(Observer):
    """Handles the decisions that the rule of a point has made."""

    def __init__(self, point: Point) -> None:
        self._point = point
        self._inverse = inverse(point.definition) or {}

    def handle(self, episode: RunningEpisode, args: Args, kwargs: Kwargs) -> None:
        """Note the actions for decisions. ``args``: each, with the arguments of its call."""
        point = self._point
        for decision, call_args, call_kwargs in args:
            name = point.agent or point.name_agent(*call_args, **call_kwargs)
            agent = None
            if type(name) is str:
                agent = episode.agents.get(name) or episode.others.get(name)
            # Not while its own ``apply`` runs the rule.
            if agent is not None and agent.point is point and not agent.applying:
                episode.blame(agent)
                action = self._action(decision, call_args, call_kwargs, agent)
                informs = point.definition.rule_action_mapping is not None and action is not None
                agent.note_rule_action(action, informs)

    def _action(self, decision: Model, args: Args, kwargs: Kwargs, agent: Agent) -> Action:
        """Return the action that corresponds to a decision. None if no action does."""
        point = self._point
        mapping = point.definition.rule_action_mapping
        if mapping is None:
            return self._default_action(decision, agent)
        if isinstance(mapping, Mapping):
            try:
                action = mapping[decision]
            except (KeyError, TypeError):
                raise InvalidActionError(
                    "the dict rule_action_mapping has no action for the rule's decision"
                    f" {short_repr(decision)}; add one, or pass a callable that returns None where"
                    " no action corresponds"
                ) from None
        elif point.rule_action_mapping is not None:
            action = point.rule_action_mapping(decision, *args, **kwargs)
        legal = None if action is None else point.check(action)
        if legal is ILLEGAL:
            raise InvalidActionError(
                f"rule_action_mapping of {point.hook.name} maps the rule's decision"
                f" {short_repr(decision)} to the action {short_repr(action)}, which is not in its"
                f" action space {short_repr(point.definition.action_space)}"
            )
        return legal

    def _default_action(self, decision: Model, agent: Agent) -> Action:
        """Look a decision up among the choices, or among the values of actions."""
        for place, held in enumerate(agent.offered or ()):
            choice = restore(held)
            if choice is decision or choice == decision:
                return place
        with suppress(TypeError):  # the decision is not hashable
            return self._inverse.get(decision)
        return None


@dataclass(frozen=True, eq=False)
class Handlers:
    """The handlers of the events of a simulation.

    Attributes:
        by_point: The handler of the decisions at each point of the plan.
        by_hook: The handler of the events of each hook.
        roster: For each agent that is known beforehand, the handler of its decisions, its policy,
            and whether that answers.
        alone: The points that have an agent of their own.
    """

    by_point: Mapping[Point, PointHandler]
    by_hook: Mapping[Hook, AnyHandler]
    roster: Mapping[str, tuple[PointHandler, Policy, bool]]
    alone: Collection[Hook]

    def announced(
        self, expected_calls: Callable[[str], Iterable[Args]], points: Iterable[Point]
    ) -> list[tuple[PointHandler, Model, Args, Kwargs]]:
        """Return the announced decisions at points: handler, agent's name and arguments of each."""
        found = []
        for plan_point in points:
            handler = self.by_point[plan_point]
            point = handler.point
            for call in expected_calls(point.hook.name):
                for args, kwargs in point.decisions_of(call):
                    name = point.agent or point.name_agent(*args, **kwargs)
                    if name is not None:
                        found.append((handler, name, args, kwargs))
        return found

    def with_agents(self, agents: Iterable[Agent]) -> dict[Hook, AnyHandler]:
        """Return the handlers, with agents in place of those of their points where they can."""
        own = {agent.point.hook: agent for agent in agents if agent.point.hook in self.alone}
        return {**self.by_hook, **own}


def handlers_of(plan: Plan, simulation: Model) -> Handlers:
    """Return the handlers of a simulation's events.

    All simulations of a plan share them, unless callables ask for the simulation.
    """
    if any(point.needs_simulation for point in plan.points):
        return _make_handlers(plan, simulation)
    return plan.derive(_make_handlers)


def _make_handlers(plan: Plan, simulation: Model = None) -> Handlers:
    by_point = {point: PointHandler(point.bind(simulation)) for point in plan.points}
    by_hook: dict[Hook, AnyHandler] = {}
    for handler in by_point.values():
        by_hook[handler.point.hook] = handler
        if handler.point.split is not None:
            by_hook[handler.point.hook] = SplitHandler(handler)
    removals: dict[Hook, RemovalHandler] = {}
    last = LastHandler() if plan.complete and plan.options.max_steps else None
    for remover in plan.removers:
        removal = removals.setdefault(remover.hook, RemovalHandler(remover.hook, plan.roster, last))
        removal.add(None if remover.point is None else by_point[remover.point], remover)
    by_hook.update(removals)
    for point, hooks in plan.overrides.items():
        notice = Notice(
            f"{listed([hook.name for hook in hooks])} override {point.hook.name}: objects of these"
            " classes are no agents, and their own rule decides. Name the functions in points=,"
            " too, or call the decision function in them"
        )
        by_hook |= dict.fromkeys(hooks, notice)
    roster: dict[str, tuple[PointHandler, Policy, bool]] = {}
    for name, point in plan.roster.items():
        policy = plan.policy_of(name, point)
        roster[name] = by_point[point], policy, plan.is_delegated(policy)
    agents = [point.agent for point in plan.points]
    alone = {
        point.hook
        for point in plan.points
        if point.agent is not None and point.split is None and agents.count(point.agent) == 1
    }
    return Handlers(by_point, by_hook, roster, alone)
