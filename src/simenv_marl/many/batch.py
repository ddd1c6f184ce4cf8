"""Many simulations at once, whose decisions are gathered and answered in batches.

Each simulation has a session and an episode, as in an environment. Where a batched policy decides, the episode waits
until many decisions wait for the same policy. The number of simulations determines which decisions share a batch; it
does not change the course of any simulation.

In the plan, a ``PolicyKey`` stands for each key of ``policies``. Keys of the same policy share one ``BatchPolicy``. Its
decisions are asked in ``Group``s; all decisions of a group have the same spaces, so that they can be stacked.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from time import perf_counter
from typing import Any, Final, Protocol

import numpy as np

from ..core.context import reuse_resources
from ..core.episode import Episode
from ..core.plan import Plan
from ..core.planner import DeferredPolicy, PlannerPolicy, is_planner
from ..core.point import Point
from ..core.roster import two_arguments
from ..core.session import Session
from ..core.spaces import duplicate
from ..core.stacking import rows, stacker
from ..core.together import step_all
from ..decision import DecisionPoint
from ..errors import InvalidActionError, annotate, short_repr
from ..hooks.stacks import outside_simulation
from ..simulation import RULE, positional

# -- who is asked ---------------------------------------------------------------------------------


class BatchPolicy:
    """A policy that answers many decisions at once.

    Attributes:
        keys: The keys of ``policies`` that have this policy.
        policy: The policy, a callable of observations and infos.
        informed: Whether it takes the infos.
        identifying: Whether it also takes the identities of the decisions.
        asking: Whether it asks for the environment and therefore answers one decision at a time.
        groups: The groups of its decisions, by decision point.
    """

    def __init__(self, policy: Callable[..., Any]) -> None:
        self.keys: list[Any] = []
        self.policy: Callable[..., Any] = two_arguments(policy)
        self.informed = self.policy is policy
        self.identifying = self.informed and takes_identities(policy)
        self.asking = isinstance(self.policy, PlannerPolicy)
        self.groups: dict[DecisionPoint, Group] = {}

    def __repr__(self) -> str:
        return f"the policy of {', '.join(str(getattr(key, '__qualname__', key)) for key in self.keys[:3])}"

    def answers(self, observations: Any, infos: Sequence[Any], identities: Sequence[tuple[int, int]]) -> Any:
        """Call the policy with as many of the arguments as it takes, and return what it returns."""
        if self.identifying:
            return self.policy(observations, infos, identities)
        return self.policy(observations, infos)

    def group(self, point: Point) -> Group:
        """Return the group of the decisions at a point."""
        group = self.groups.get(point.point)
        if group is None:
            group = next((known for known in self.groups.values() if known.takes(point)), None) or Group(self, point)
            self.groups[point.point] = group
        return group


def takes_identities(policy: Callable[..., Any]) -> bool:
    """Return whether a policy requires a third argument, the identities of the decisions."""
    return sum(p.default is p.empty for p in positional(policy)) > 2


class PolicyKey(DeferredPolicy):
    """A batched policy in a plan, with the key under which it was given.

    Attributes:
        place: The place of its key in ``policies``.
        asked: The policy.
    """

    def __init__(self, place: int, asked: BatchPolicy) -> None:
        self.place = place
        self.asked = asked

    def __call__(self, observation: Any, info: Any) -> Any:
        """Answer one decision, if the policy answers one decision at a time."""
        return self.asked.policy(observation, info)

    def alone(self, episode: Any, agent: Any) -> Any:
        """Answer one decision at once, of an episode that is a branch and waits for one agent alone."""
        group = self.asked.group(agent.point)
        episode.pending = agent
        try:
            actions, _ = group.ask(group.stack([agent.observation]), [episode])
        finally:
            episode.pending = None
        return actions[0]


class PlannerKey(PlannerPolicy, PolicyKey):
    """A ``PolicyKey`` of a policy that asks for the environment and therefore answers one decision at a time."""

    def __init__(self, place: int, asked: BatchPolicy, policy: Callable[..., Any]) -> None:
        PlannerPolicy.__init__(self, policy)
        PolicyKey.__init__(self, place, asked)

    def alone(self, episode: Any, agent: Any) -> Any:
        """Answer one decision at once, of an episode that is a branch and waits for one agent alone."""
        return self(agent.observation, agent.info)


def policy_keys(policies: Mapping[Any, Any], *, rewarded: bool = False) -> dict[Any, Any]:
    """Replace policies by their keys for a plan. Values that are not policies stay as they are.

    ``rewarded``: whether episodes wait for policies that ask for the environment, too. Otherwise, such a policy is
    called where it decides, since it answers one decision at a time.
    """
    known: dict[int, BatchPolicy] = {}
    found: dict[Any, Any] = {}
    for place, (key, policy) in enumerate(policies.items()):
        found[key] = policy
        asks = is_planner(policy)
        if policy is not RULE and callable(policy) and (rewarded or not asks):
            asked = known.setdefault(id(policy), BatchPolicy(policy))
            asked.keys.append(key)
            found[key] = PlannerKey(place, asked, policy) if asks else PolicyKey(place, asked)
    return found


class Group:
    """Decisions that are answered in one batch: those of one policy in the same spaces.

    Attributes:
        asked: The policy.
        point: One of the points of the decisions; the others have the same spaces.
        stack: A callable that stacks observations.
        waiting: The episodes whose decisions wait.
        places: The index of each waiting episode's seed.
        observations: The observation of each waiting episode.
        book: The records of the decisions; None if no trajectories are collected.
    """

    __slots__ = ("_discrete", "asked", "book", "observations", "places", "point", "stack", "waiting")

    def __init__(self, asked: BatchPolicy, point: Point) -> None:
        self.asked, self.point = asked, point
        self.stack = stacker(point.definition.observation_space, cast=True)
        self.waiting: list[Episode] = []
        self.places: list[int] = []
        # Kept outside the episodes: reading them from many suspended episodes would miss the processor's caches.
        self.observations: list[Any] = []
        self.book: Any = None
        self._discrete = not point.definition.action_space.shape

    def takes(self, point: Point) -> bool:
        """Return whether decisions at a point can be stacked with those of this group."""
        own, other = self.point.definition, point.definition
        return point is self.point or (
            own.observation_space == other.observation_space
            and own.action_space == other.action_space
            and (self.point.legal is None) == (point.legal is None)
        )

    def ask(self, observations: Any, waiting: Sequence[Episode]) -> tuple[list[Any], Mapping[str, Any]]:
        """Ask the policy about the stacked observations of waiting episodes; return the actions, and the extras."""
        asked = self.asked
        infos: list[Any] = []
        if asked.informed:
            for episode in waiting:
                agent: Any = episode.pending
                infos.append(agent.info)
                agent.info = {}  # a policy may change its info; the next decision gets a new one
        try:
            identities = [(episode.seed, episode.turns) for episode in waiting] if asked.identifying else ()
            answers = _each(waiting) if asked.asking else asked.answers(observations, infos, identities)
            extras: Mapping[str, Any] = {}
            if type(answers) is tuple and len(answers) == 2 and isinstance(answers[1], Mapping):
                answers, extras = answers
            actions = [RULE] * len(waiting) if answers is RULE else rows(answers, integers=self._discrete)
            if actions is None or len(actions) != len(waiting):
                returned = short_repr(answers) if actions is None else f"{len(actions)} actions"
                raise InvalidActionError(
                    f"{asked!r} was asked for {len(waiting)} decisions at once and returned {returned}; it must return"
                    " one action for each row of the observations, in their order"
                )
        except BaseException as error:
            seeds = [str(episode.seed) for episode in waiting]
            several = f"seeds {', '.join(seeds[:5])}{' and others' if len(seeds) > 5 else ''}"
            annotate(
                error,
                f"simenv_marl: in {asked!r}, asked for {len(seeds)} decisions at once;"
                f" {several if len(seeds) > 1 else f'seed {seeds[0]}'}",
            )
            raise
        return actions, extras


def _each(waiting: Sequence[Episode]) -> Any:
    """Ask a policy that asks for the environment, one decision after the other."""
    answers = []
    for episode in waiting:
        agent: Any = episode.pending
        agent.consultations += 1
        answers.append(agent.policy(duplicate(agent.observation), agent.info))
        agent.info = {}
    if not all(type(answer) is tuple and len(answer) == 2 and isinstance(answer[1], Mapping) for answer in answers):
        return answers
    extras = {name: np.stack([np.asarray(extra[name]) for _, extra in answers]) for name in answers[0][1]}
    return [action for action, _ in answers], extras


# -- all of them ----------------------------------------------------------------------------------


class Watcher(Protocol):
    """An observer of the episodes."""

    def asking(self, group: Group, places: Sequence[int], waiting: Sequence[Episode], observations: Any) -> None:
        """Note that decisions are about to be answered. The watcher may keep the observations."""

    def answered(self, group: Group, actions: list[Any], extras: Mapping[str, Any]) -> None:
        """Note that the policy has answered them."""

    def moved(self, episode: Episode) -> None:
        """Note that an episode has reached its next decision or its end."""


def run(
    plan: Plan,
    seeds: Sequence[int],
    size: int,
    finish: Callable[[int, Any], Callable[[], None] | None],
    watcher: Watcher | None = None,
) -> None:
    """Run one simulation per seed. Batched policies answer the decisions. After an error, all simulations are unwound.

    Args:
        plan: The plan of the episodes, with a ``PolicyKey`` for each policy.
        seeds: The seeds of the simulations.
        size: The largest number of simulations at a time.
        finish: Called with the index of a seed and its simulation when the simulation has ended. If it returns a
            callable, that is called after the simulation is closed.
        watcher: The observer of rewards and ends. None: agents are not rewarded.
    """
    with outside_simulation(), reuse_resources():
        _Simulations(plan, seeds, size, finish, watcher).run()


def _checked(episode: Episode, action: Any) -> Any:
    """Return the action of the pending agent, checked."""
    agent: Any = episode.pending
    try:
        return action if action is RULE else agent.point.checked(action, agent.name, agent.mask)
    except InvalidActionError as error:
        episode.annotate(error)
        raise


CROWD: Final = 256
"""The number of simulations at first. With more, each has left the processor's caches when its turn comes again, and
takes twice as long. If the policy takes longer than all simulations together, more simulations pay off."""


class _Simulations:
    """The simulations that are running."""

    def __init__(
        self,
        plan: Plan,
        seeds: Sequence[int],
        size: int,
        finish: Callable[[int, Any], Callable[[], None] | None],
        watcher: Watcher | None,
    ) -> None:
        self._plan, self._seeds, self._size = plan, seeds, size
        self._finish, self._watcher = finish, watcher
        self._crowd = min(size, CROWD)
        self._next = 0
        self._sessions: dict[int, Session] = {}  # by the place of their seed
        self._groups: dict[Group, None] = {}

    def run(self) -> None:
        try:
            self._refill()
            while self._sessions:
                # Waiting for large groups saves calls of policies.
                self._answer(max(self._groups, key=lambda group: len(group.waiting)))
        except BaseException as error:
            for place, session in self._sessions.items():
                try:
                    session.close()
                except BaseException as problem:
                    where = f"unwinding the simulation of seed {self._seeds[place]}"
                    annotate(error, f"simenv_marl: {where} raised {short_repr(problem)} as well")
            raise

    def _answer(self, group: Group) -> None:
        """Have the decisions of a group answered, and run each simulation to its next decision."""
        waiting, group.waiting = group.waiting, []
        places, group.places = group.places, []
        observations, group.observations = group.observations, []
        watcher, number, begun = self._watcher, len(waiting), perf_counter()
        recorded = None if watcher is None else group.stack(observations)  # policies may change what they get
        actions, extras = group.ask(group.stack(observations), waiting)
        asked = perf_counter()
        if watcher is not None:
            watcher.asking(group, places, waiting, recorded)
        step_all(waiting, list(map(_checked, waiting, actions)))
        waiting.reverse()  # popped one by one, so that nothing keeps ended episodes alive
        for place in places:
            self._queue(place, waiting.pop())
        if watcher is not None:
            watcher.answered(group, actions, extras)
        if 2 * number > self._crowd < self._size and asked - begun > perf_counter() - asked:
            self._crowd = min(self._size, 2 * self._crowd)
        self._refill()

    def _queue(self, place: int, episode: Episode) -> None:
        """Queue an episode that waits at a decision, or end it if it is over."""
        if self._watcher is not None:
            self._watcher.moved(episode)
        agent = episode.pending
        if agent is None:
            self._end(place)
            return
        group = agent.group
        if group is None:
            group = agent.group = agent.policy.asked.group(agent.point)
            self._groups[group] = None
        group.waiting.append(episode)
        group.places.append(place)
        # Kept outside the episodes: reading them from many suspended episodes would miss the processor's caches.
        group.observations.append(agent.observation)
        if self._watcher is None:
            agent.observation = None

    def _refill(self) -> None:
        """Start simulations until the limit is reached."""
        while self._next < len(self._seeds) and len(self._sessions) < self._crowd:
            place, seed = self._next, self._seeds[self._next]
            self._next += 1
            try:
                session = Session(self._plan)
            except BaseException as error:
                annotate(error, f"simenv_marl: while the simulation was made; seed {seed}")
                raise
            self._sessions[place] = session
            self._queue(place, session.start(seed, None))

    def _end(self, place: int) -> None:
        session = self._sessions[place]
        session.end()  # it may have been truncated
        try:
            closed = self._finish(place, session.simulation)
            session.close()
            if closed is not None:
                closed()
        except BaseException as error:
            annotate(error, f"simenv_marl: after the simulation's end; seed {self._seeds[place]}")
            raise
        del self._sessions[place]
