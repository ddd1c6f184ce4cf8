"""Many simulations at once, whose decisions are gathered and answered in batches.

``step_all`` steps many episodes in one thread. Vector environments use it, too.

Each simulation has a session and an episode, as in an environment. Where a batched policy decides,
the episode waits until many decisions wait for the same policy. The number of simulations
determines which decisions share a batch; it does not change the course of any simulation.

In the plan, a ``PolicyKey`` stands for each key of ``policies``. Keys of the same policy share one
``BatchPolicy``. Its decisions are asked in ``Group``s; all decisions of a group have the same
spaces, so that they can be stacked.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from time import perf_counter
from typing import Any, Final, Protocol

import numpy as np
from greenlet import getcurrent

from ..core import Answers as Awaited
from ..core import (
    AskingPolicy,
    DeferredPolicy,
    Episode,
    Plan,
    Point,
    Session,
    UnmatchedNames,
    close_all,
    duplicate,
    is_asked_alone,
    reuse_resources,
    split_batch,
    stacker,
    two_arguments,
    waits,
)
from ..decision import DecisionPoint
from ..errors import InvalidActionError, annotate, short_repr
from ..hooks.stacks import EVALUATING, outside_simulation
from ..simulation import RULE, positional

Answers = tuple[list[Any], Mapping[str, Any]]
"""The actions of a policy for many decisions, and the extras that it has returned beside them."""

# -- who is asked ---------------------------------------------------------------------------------


class BatchPolicy:
    """A policy that answers many decisions at once.

    Attributes:
        keys: The keys of ``policies`` that have this policy.
        policy: The policy, a callable of observations and infos.
        informed, identifying: Whether it takes the infos, and the identities of the decisions.
        alone: Whether it answers one decision at a time.
    """

    def __init__(self, policy: Callable[..., Any], *, alone: bool = False) -> None:
        self.keys: list[Any] = []
        self.policy: Callable[..., Any] = two_arguments(policy)
        self.informed = self.policy is policy
        self.identifying = self.informed and takes_identities(policy)
        self.alone = alone or isinstance(self.policy, AskingPolicy)
        self.groups: dict[DecisionPoint, Group] = {}

    def __repr__(self) -> str:
        return (
            "the policy of"
            f" {', '.join(str(getattr(key, '__qualname__', key)) for key in self.keys[:3])}"
        )

    def answers(
        self, observations: Any, infos: Sequence[Any], identities: Sequence[tuple[int, int]]
    ) -> Any:
        """Call the policy with as many of the arguments as it takes, and return what it returns."""
        if self.identifying:
            return self.policy(observations, infos, identities)
        return self.policy(observations, infos)

    def group(self, point: Point) -> Group:
        """Return the group of the decisions at a point."""
        group = self.groups.get(point.hook)
        if group is None:
            group = next(
                (known for known in self.groups.values() if known.takes(point)), None
            ) or Group(self, point)
            self.groups[point.hook] = group
        return group


def takes_identities(policy: Callable[..., Any]) -> bool:
    """Return whether a policy requires a third argument, the identities of the decisions."""
    return sum(p.default is p.empty for p in positional(policy)) > 2


class PolicyKey(DeferredPolicy):
    """A batched policy in a plan, with the place of its key in ``policies``."""

    def __init__(self, place: int, asked: BatchPolicy) -> None:
        self.place = place
        self.asked = asked

    def answer(self, episode: Any, agent: Any, observation: Any, info: Any) -> Any:
        """Answer one decision at once."""
        if self.asked.alone:
            return self.asked.policy(observation, info)
        group = self.asked.group(agent.point)
        actions, _ = group.ask(group.stack([observation]), [episode], [agent])
        return actions[0]


class AskingKey(AskingPolicy, PolicyKey):
    """A ``PolicyKey`` of a policy that is asked one decision at a time, because of what it asks for."""

    def __init__(self, place: int, asked: BatchPolicy, policy: Callable[..., Any]) -> None:
        AskingPolicy.__init__(self, policy)
        PolicyKey.__init__(self, place, asked)


def policy_keys(
    policies: Mapping[Any, Any], *, rewarded: bool = False, alone: bool = False
) -> dict[Any, Any]:
    """Replace policies by their keys for a plan. Values that are not policies stay as they are.

    ``rewarded``: whether episodes wait for all policies. Otherwise, a policy that is asked one
    decision at a time is called where it decides, unless it has to be awaited. ``alone``: all are
    asked so.
    """
    known: dict[int, BatchPolicy] = {}
    found: dict[Any, Any] = {}
    for place, (key, policy) in enumerate(policies.items()):
        found[key] = policy
        asks = is_asked_alone(policy)
        if policy is not RULE and callable(policy) and (rewarded or not asks or waits(policy)):
            asked = known.setdefault(id(policy), BatchPolicy(policy, alone=alone))
            asked.keys.append(key)
            found[key] = AskingKey(place, asked, policy) if asks else PolicyKey(place, asked)
    return found


class Group:
    """Decisions that are answered in one batch: those of one policy in the same spaces.

    Attributes:
        point: One of the points of the decisions; the others have the same spaces.
        waiting, places, observations: The episodes whose decisions wait, the indices of their
            seeds, and what they see.
    """

    __slots__ = ("_discrete", "asked", "observations", "places", "point", "stack", "waiting")

    def __init__(self, asked: BatchPolicy, point: Point) -> None:
        self.asked, self.point = asked, point
        self.stack = stacker(point.definition.observation_space, cast=True)
        self.waiting: list[Episode] = []
        self.places: list[int] = []
        # Kept outside the episodes: reading them from many suspended episodes would miss the
        # processor's caches.
        self.observations: list[Any] = []
        self._discrete = not point.definition.action_space.shape

    def takes(self, point: Point) -> bool:
        """Return whether decisions at a point can be stacked with those of this group."""
        own, other = self.point.definition, point.definition
        return point is self.point or (
            own.observation_space == other.observation_space
            and own.action_space == other.action_space
            and (self.point.legal is None) == (point.legal is None)
        )

    def ask(self, observations: Any, waiting: Sequence[Episode], agents: Sequence[Any]) -> Answers:
        """Ask the policy about the stacked observations of waiting episodes.

        Return the actions, and the extras.
        """
        asked = self.asked
        infos: list[Any] = []
        for agent in agents if asked.informed else ():
            infos.append(agent.take_info())
        try:
            identities = (
                [(episode.seed, episode.turns) for episode in waiting] if asked.identifying else ()
            )
            answers = asked.answers(observations, infos, identities)
            return read_answers(answers, asked, len(waiting), integers=self._discrete)
        except BaseException as error:
            number, seeds = len(waiting), ", ".join(str(episode.seed) for episode in waiting[:5])
            seeds = (
                f"{'seed' if number == 1 else 'seeds'} {seeds}{' and others' if number > 5 else ''}"
            )
            annotate(
                error, f"simenv_marl: in {asked!r}, asked for {number} decisions at once; {seeds}"
            )
            raise


def read_answers(answers: Any, policy: Any, number: int, *, integers: bool = False) -> Answers:
    """Return the actions and the extras in what a policy has returned for a number of decisions."""
    extras: Mapping[str, Any] = {}
    if type(answers) is tuple and len(answers) == 2 and isinstance(answers[1], Mapping):
        answers, extras = answers
    actions = [RULE] * number if answers is RULE else split_batch(answers, integers=integers)
    if actions is None or len(actions) != number:
        returned = short_repr(answers) if actions is None else f"{len(actions)} actions"
        raise InvalidActionError(
            f"{short_repr(policy)} was asked for {number} decisions at once and returned"
            f" {returned}; it must return one action for each row of the observations, in their"
            " order"
        )
    return actions, extras


# -- all of them ----------------------------------------------------------------------------------


class Watcher(Protocol):
    """An observer of the episodes."""

    def record(
        self,
        group: Group,
        places: list[int],
        waiting: list[Any],
        observations: Any,
        answers: Answers,
    ) -> None:
        """Note what a policy has answered, before the simulations move.

        The list has an observation for each.
        """

    def pay(self, episode: Episode) -> None:
        """Note the rewards when an episode has reached its next decision or its end."""


CROWD: Final = 256
"""The number of simulations at first. With more, each has left the processor's caches when its turn comes again, and
takes twice as long. If the policy takes longer than all simulations together, more simulations pay
off."""


def run(
    plan: Plan,
    seeds: Sequence[int],
    size: int,
    finish: Callable[[int, Any], Callable[[], None] | None],
    watcher: Watcher | None = None,
    concurrency: int = 1,
) -> None:
    """Run one simulation per seed, ``size`` at a time, of which ``concurrency`` wait for policies that are awaited.

    After an error, these policies are cancelled, and all simulations are unwound.

    The plan has a ``PolicyKey`` for each policy. ``finish`` is called with the index of a seed and
    its simulation when the simulation has ended. If it returns a callable, that is called after the
    simulation is closed.
    """
    simulations = _Simulations(plan, seeds, size, finish, watcher, concurrency)
    with outside_simulation(), reuse_resources():
        try:
            simulations.refill()
            while simulations.sessions:
                simulations.proceed()
        except BaseException as error:
            simulations.awaited.cancel()
            left = simulations.sessions.items()
            close_all(
                ((f"the simulation of seed {seeds[place]}", session) for place, session in left),
                error,
            )
            raise


@dataclass
class _Simulations:
    """The simulations that are running, and the decisions that wait: see ``run``."""

    plan: Plan
    seeds: Sequence[int]
    size: int
    finish: Callable[[int, Any], Callable[[], None] | None]
    watcher: Watcher | None
    concurrency: int

    def __post_init__(self) -> None:
        self.crowd = min(self.size, CROWD)
        # decisions for policies that are awaited
        self.backlog: deque[tuple[int, Episode]] = deque()
        self.awaited = Awaited()
        self.next = 0
        self.sessions: dict[int, Session] = {}  # by the place of their seed
        self.groups: dict[Group, None] = {}
        self.unmatched = UnmatchedNames(self.plan.named_agents)

    def proceed(self) -> None:
        """Have decisions answered, and run their simulations to their next decisions."""
        while self.backlog and len(self.awaited) < self.concurrency:
            place, episode = self.backlog.popleft()
            try:
                agent: Any = episode.pending
                self.awaited.add((place, episode), agent.policy.begin(*_seen(episode)))
            except BaseException as error:
                episode.annotate(error)
                raise
        # Waiting for large groups saves calls of policies.
        group = max(self.groups, key=lambda group: len(group.waiting), default=None)
        if group is not None and group.waiting and not self.awaited.ready:
            self.answer(group)
        elif self.awaited:
            (place, episode), answer = self.awaited.take()
            self.step(place, episode, answer.result)
            self._queue(place, episode)
        self.refill()

    def answer(self, group: Group) -> None:
        """Have the decisions of a group answered, and run each simulation to its next decision."""
        waiting, group.waiting = group.waiting, []
        places, group.places = group.places, []
        observations, group.observations = group.observations, []
        number, start = len(waiting), perf_counter()
        answers = group.ask(
            group.stack(observations), waiting, [episode.pending for episode in waiting]
        )
        asked = perf_counter()
        actions = list(map(_checked, waiting, answers[0]))
        if self.watcher is not None:
            self.watcher.record(group, places, waiting, observations, answers)
        step_all(waiting, actions)
        waiting.reverse()  # popped one by one, so that nothing keeps ended episodes alive
        for place in places:
            self._queue(place, waiting.pop())
        if 2 * number > self.crowd < self.size and asked - start > perf_counter() - asked:
            self.crowd = min(self.size, 2 * self.crowd)

    def step(self, place: int, episode: Episode, ask: Callable[[], Any]) -> None:
        """Have one decision answered, and run its simulation to the next one."""
        agent: Any = episode.pending
        extras: Mapping[str, Any] = {}
        try:
            answer = ask()
        except BaseException as error:
            episode.annotate(error)
            raise
        if type(answer) is tuple and len(answer) == 2 and isinstance(answer[1], Mapping):
            answer, extras = answer
        action = _checked(episode, answer)
        if self.watcher is not None:
            extras = {name: np.asarray(value)[None] for name, value in extras.items()}
            group = agent.policy.asked.group(agent.point)
            self.watcher.record(group, [place], [episode], [agent.observation], ([action], extras))
        episode.step(action)

    def refill(self) -> None:
        """Start simulations until the limit is reached."""
        while self.next < len(self.seeds) and len(self.sessions) < self.crowd:
            place, seed = self.next, self.seeds[self.next]
            self.next += 1
            try:
                session = Session(self.plan, self.unmatched)
            except BaseException as error:
                annotate(error, f"simenv_marl: while the simulation was made; seed {seed}")
                raise
            self.sessions[place] = session
            self._queue(place, session.start(seed, None))

    def _queue(self, place: int, episode: Episode) -> None:
        """Queue an episode that waits at a decision, or end it if it is over."""
        if self.watcher is not None:
            self.watcher.pay(episode)
        agent: Any = episode.pending
        while agent is not None and agent.policy.asked.alone and not agent.policy.waits:
            self.step(place, episode, partial(_ask_now, episode))
            if self.watcher is not None:
                self.watcher.pay(episode)
            agent = episode.pending
        if agent is None:
            self._end(place)
            return
        if agent.policy.waits:
            self.crowd = min(self.size, max(self.crowd, self.concurrency))
            self.backlog.append((place, episode))
            return
        group = agent.policy.asked.group(agent.point)
        self.groups[group] = None
        group.waiting.append(episode)
        group.places.append(place)
        # Kept outside the episodes: reading them from many suspended episodes would miss the
        # processor's caches.
        is_watched = self.watcher is not None
        group.observations.append(agent.observation if is_watched else agent.take_observation())

    def _end(self, place: int) -> None:
        session = self.sessions[place]
        session.end()  # it may have been truncated
        try:
            closed = self.finish(place, session.simulation)
            session.close()
            if closed is not None:
                closed()
        except BaseException as error:
            annotate(error, f"simenv_marl: after the simulation's end; seed {self.seeds[place]}")
            raise
        del self.sessions[place]


def _checked(episode: Episode, action: Any) -> Any:
    """Return the action of the pending agent, checked."""
    agent: Any = episode.pending
    try:
        return action if action is RULE else agent.point.validate(action, agent.name, agent.mask)
    except InvalidActionError as error:
        episode.annotate(error)
        raise


def _seen(episode: Episode) -> tuple[Any, ...]:
    """Return the arguments of a policy of one decision."""
    agent: Any = episode.pending
    return episode, agent, duplicate(agent.observation), agent.take_info()


def _ask_now(episode: Episode) -> Any:
    """Ask this policy, and wait for its answer."""
    agent: Any = episode.pending
    with episode.context() if episode.plan.options.global_rng else nullcontext():
        return agent.policy.answer(*_seen(episode))


# -- many episodes and sessions -------------------------------------------------------------------


def step_all(
    episodes: Sequence[Episode],
    actions: Sequence[Any],
    blame: Callable[[int, BaseException], None] = lambda number, error: None,
) -> None:
    """Answer the pending decisions of episodes of one plan with checked actions, and run each to its next decision.

    All simulations move before any agent is updated, so that the data of each loop stays in the
    processor's caches. If an episode raises, ``blame`` is called with its number and the error. The
    others may have moved or not; they can be closed.
    """
    if not episodes:
        return
    agents: list[Any] = [episode.pending for episode in episodes]
    callers = {episode.driver.caller for episode in episodes}
    first = episodes[0]
    together = callers == {getcurrent()} and not (
        EVALUATING or None in agents or first.in_rounds or first.plan.plugins is not None
    )
    number = 0
    event: Any = None
    events: Any = []
    try:
        if not together:
            for number, episode in enumerate(episodes):
                episode.step(actions[number])
            return
        replies: list[Any] = []
        for number, episode in enumerate(episodes):
            replies.append(episode.answer(agents[number], actions[number]))
        for number, episode in enumerate(episodes):
            events.append(episode.resume(replies[number]))
        del replies
        # popped one by one, so that the list keeps nothing alive that a model frees
        events.reverse()
        for number, episode in enumerate(episodes):  # noqa: B007 - the handler below needs it
            event, args, kwargs = events.pop()
            reply = event.handle(episode, args, kwargs)
            event = args = kwargs = None
            if not episode.has_to_wait(reply):
                episode.advance(reply)
    except BaseException as error:
        # so that the error's traceback does not keep them alive
        events = event = args = kwargs = None
        culprit = episodes[number]
        for episode in episodes:
            if episode is not culprit:
                episode.restore_pending()
        if culprit.pending is None and not culprit.over:
            culprit.fail(error)
        elif together:  # otherwise the episode has already done this
            culprit.annotate(error)
        blame(number, error)
        raise
