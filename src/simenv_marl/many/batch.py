"""Many simulations at once, whose decisions are gathered and answered in batches.

``step_all`` steps many episodes in one thread. Vector environments use it, too.

Each simulation has a session and an episode, as in an environment. Where a batched policy decides,
the episode waits until many decisions wait for the same policy. The number of simulations
determines which decisions share a batch; it does not change the course of any simulation.

In the plan, a ``PolicyKey`` stands for each key of ``policies``. Keys of the same policy share one
``BatchPolicy``. Its decisions are answered in ``Group``s; all decisions of a group have the same
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

from ..core import (
    Agent,
    AskingPolicy,
    DeferredPolicy,
    Episode,
    EpisodePolicy,
    Info,
    Plan,
    Point,
    Session,
    UnmatchedNames,
    close_all,
    duplicate,
    is_asked_alone,
    reuse_resources,
    split_batch,
    split_extras,
    stacked,
    stacker,
    takes_info,
    takes_state,
    two_arguments,
)
from ..core import Answers as PendingAnswers
from ..decision import DecisionPoint
from ..errors import InvalidActionError, annotate, listed, name_of, short_repr
from ..hooks.stacks import EVALUATING, outside_simulation
from ..simulation import RULE, Action, Observation, positional

Answers = tuple[list[Action], Mapping[str, Any]]
"""The actions of a policy for many decisions, and its extras: arrays with a row for each."""

# -- batched policies -----------------------------------------------------------------------------


class BatchPolicy:
    """A policy that answers many decisions at once.

    Attributes:
        keys: The keys of ``policies`` that have this policy.
        policy: The policy, a callable of observations and infos.
        takes_identities: Whether it takes the identities of the decisions, after the infos.
        takes_state: Whether it takes the states of the simulations.
        alone: Whether it answers one decision at a time.
    """

    def __init__(self, policy: Callable[..., Action], *, alone: bool = False) -> None:
        self.keys: list[object] = []
        self.takes_state = takes_state(policy)
        takes_stacks = self.takes_state and not (alone or is_asked_alone(policy))
        self.policy: Callable[..., Action] = policy if takes_stacks else two_arguments(policy)
        self.takes_identities = self.policy is policy and takes_identities(policy)
        self._places = 2 + self.takes_identities
        if takes_stacks and not takes_info(policy):
            self._places = 1
        is_asked = isinstance(self.policy, EpisodePolicy) and not self.policy.batched
        self.alone = alone or is_asked
        self._groups: dict[DecisionPoint, Group] = {}

    def __repr__(self) -> str:
        return f"the policy of {listed([name_of(key) for key in self.keys])}"

    def answers(
        self,
        observations: Observation,
        infos: Sequence[Info],
        identities: Sequence[object],
        states: object,
    ) -> Answers:
        """Call the policy with as many of the arguments as it takes, and return its answers.

        Args:
            observations: Stacked observations, of shape ``(batch, *shape)``.
            infos: An info for each.
            identities: The seed of the episode and the number of the decision, for each.
            states: The stacked states, if it takes them.
        """
        seen = (observations, infos, identities)[: self._places]
        asked = {"_state": states} if self.takes_state else {}
        answers = self.policy(*seen, **asked)
        return read_answers(answers, self if self.keys else self.policy, len(infos))

    def group(self, point: Point) -> Group:
        """Return the group of the decisions at a point."""
        group = self._groups.get(point.hook)
        if group is None:
            group = Group(self, point)
            alike = (known for known in self._groups.values() if known.spaces == group.spaces)
            group = next(alike, group)
            self._groups[point.hook] = group
        return group


def takes_identities(policy: Callable[..., Action]) -> bool:
    """Return whether a policy requires a third argument, the identities of the decisions."""
    return sum(p.default is p.empty for p in positional(policy)) > 2


class PolicyKey(DeferredPolicy):
    """A batched policy in a plan.

    Attributes:
        place: The place of its key in ``policies``.
        batch_policy: The policy.
    """

    def __init__(self, place: int, batch_policy: BatchPolicy) -> None:
        self.place = place
        self.batch_policy = batch_policy
        policy = batch_policy.policy
        self.takes_state = batch_policy.takes_state
        if isinstance(policy, EpisodePolicy):
            self.waits = policy.waits
            self.looks_back = policy.looks_back
            self.sees_all = policy.sees_all
            self.plans = policy.plans
            self.asks = policy.asks

    @property
    def prepare(self) -> Any:
        """Collects the arguments of a policy that waits."""
        return getattr(self.batch_policy.policy, "prepare", None)

    def answer(
        self,
        episode: Any,
        agent: Any,
        observation: Observation,
        info: Info,
    ) -> Action:
        """Answer one decision at once."""
        if self.batch_policy.alone:
            policy = self.batch_policy.policy
            if isinstance(policy, EpisodePolicy):
                return policy.respond(episode, agent, observation, info)
            return policy(observation, info)
        group = self.batch_policy.group(agent.point)
        actions, _ = group.ask([episode], [observation], [info])
        return actions[0]


def policy_keys(policies: Mapping[Any, Any], *, alone: bool = False) -> dict[Any, Any]:
    """Replace policies by their keys for a plan. Values that are not policies stay as they are.

    Args:
        policies: The policies, by agent or point.
        alone: Whether all policies answer one decision at a time.
    """
    batch_policies: dict[int, BatchPolicy] = {}
    keys = dict(policies)
    for place, (key, policy) in enumerate(policies.items()):
        if policy is RULE or not callable(policy):
            continue
        batch_policy = batch_policies.setdefault(id(policy), BatchPolicy(policy, alone=alone))
        batch_policy.keys.append(key)
        keys[key] = PolicyKey(place, batch_policy)
    return keys


class Group:
    """The decisions that one call of a policy can answer, because they have the same spaces.

    Attributes:
        policy: The policy.
        point: One of the points of the decisions; the others have the same spaces.
        spaces: The spaces of observations and actions, and whether actions may be masked.
        stack: Stacks observations.
        waiting: The decisions that wait: the index of the episode's seed, the episode, the
            observation, and the info. To read the last two from many suspended episodes would miss
            the processor's caches.
    """

    def __init__(self, policy: BatchPolicy, point: Point) -> None:
        self.policy = policy
        self.point = point
        definition = point.definition
        is_masked = point.legal is not None
        self.spaces = definition.observation_space, definition.action_space, is_masked
        self.stack = stacker(definition.observation_space, cast=True)
        self.waiting: list[tuple[int, Episode, Observation, Info]] = []

    def ask(
        self,
        episodes: Sequence[Episode],
        observations: list[Observation],
        infos: list[Info],
    ) -> Answers:
        """Ask the policy for one action for each episode.

        Args:
            episodes: The episodes.
            observations: The observation of each.
            infos: The info of each.

        Raises:
            InvalidActionError: The number of actions is wrong.
            BaseException: Any exception of the policy, with a note that names the seeds.
        """
        policy = self.policy
        identities: list[tuple[int, int]] = []
        if policy.takes_identities:
            identities = [(episode.seed, episode.turns) for episode in episodes]
        number = len(episodes)
        try:
            states = None
            if policy.takes_state:
                states = stacked([episode.note_state() for episode in episodes])
            if isinstance(policy.policy, EpisodePolicy):
                agents = [episode.deciding for episode in episodes]
                return policy.policy.respond_to_many(agents, infos, states)
            return policy.answers(self.stack(observations), infos, identities, states)
        except BaseException as error:
            noun = "seed" if number == 1 else "seeds"
            seeds = listed([str(episode.seed) for episode in episodes])
            annotate(
                error,
                f"simenv_marl: in {policy!r}, called for {number} decisions at once;"
                f" {noun} {seeds}",
            )
            raise


def read_answers(answers: Action, policy: object, number: int) -> Answers:
    """Split the result of a policy into actions and extras.

    Args:
        answers: The result.
        policy: The policy, for errors.
        number: The number of the decisions.

    Raises:
        InvalidActionError: The number of actions is wrong.
    """
    answers, extras = split_extras(answers)
    actions = [RULE] * number if answers is RULE else split_batch(answers, integers=True)
    if actions is None or len(actions) != number:
        returned = short_repr(answers) if actions is None else f"{len(actions)} actions"
        raise InvalidActionError(
            f"{short_repr(policy)} was called for {number} decisions at once and returned"
            f" {returned}; it must return one action for each row of the observations, in their"
            " order"
        )
    return actions, extras


# -- runs -----------------------------------------------------------------------------------------


class Watcher(Protocol):
    """An observer of the episodes."""

    def record(
        self,
        group: Group,
        places: list[int],
        waiting: list[Episode],
        observations: list[Observation],
        answers: Answers,
    ) -> None:
        """Record the answers of a policy, before the simulations move.

        Args:
            group: The group of the decisions.
            places: The indices of the episodes' seeds.
            waiting: The episodes.
            observations: The observation of each.
            answers: The answers.
        """

    def pay(self, episode: Episode) -> None:
        """Record the rewards when an episode has reached its next decision or its end."""


CROWD: Final = 256
"""The number of simulations at first.

With more, each has left the processor's caches when its turn comes again, and takes twice as long.
If the policy takes longer than all simulations together, more simulations pay off.
"""


@dataclass
class BatchRun:
    """Runs one simulation per seed, many of them together.

    Attributes:
        plan: The plan, with a ``PolicyKey`` for each policy.
        seeds: The seeds.
        size: The largest number of simulations that run together.
        finish: Called with the index of a seed and its episode when that has ended. If it returns
            a callable, that is called after the simulation is closed.
        watcher: Observes the episodes. None: no observer.
        concurrency: The number of decisions that wait together for policies that are awaited.
    """

    plan: Plan
    seeds: Sequence[int]
    size: int
    finish: Callable[[int, Episode], Callable[[], None] | None]
    watcher: Watcher | None = None
    concurrency: int = 1

    def __post_init__(self) -> None:
        self._sessions: dict[int, Session] = {}  # by the index of their seed
        self._unstarted = deque(enumerate(self.seeds))
        self._crowd = min(self.size, CROWD)
        self._groups: dict[Group, None] = {}
        # Decisions of policies that are awaited.
        self._backlog: deque[tuple[int, Episode, Callable[[], Action]]] = deque()
        self._awaited = PendingAnswers()
        self._asking: set[int] = set()  # the places of their episodes
        self._unmatched = UnmatchedNames(self.plan.named_agents)

    def run(self) -> None:
        """Run all simulations. After an error, cancel policies and unwind simulations."""
        with outside_simulation(), reuse_resources():
            try:
                self._refill()
                while self._sessions:
                    self._proceed()
                    self._refill()
            except BaseException as error:
                self._awaited.cancel()
                sessions = [
                    (f"the simulation of seed {session.seed}", session)
                    for session in self._sessions.values()
                ]
                close_all(sessions, error)
                raise

    def _refill(self) -> None:
        """Start simulations until the limit is reached."""
        while self._unstarted and len(self._sessions) < self._crowd:
            place, seed = self._unstarted.popleft()
            try:
                session = Session(self.plan, self._unmatched)
            except BaseException as error:
                annotate(error, f"simenv_marl: while the simulation was made; seed {seed}")
                raise
            self._sessions[place] = session
            beside = None if self.watcher is None else self.size > 1
            self._queue(place, session.start(seed, None, beside=beside))

    def _proceed(self) -> None:
        """Have decisions answered, and run their simulations to their next decisions."""
        while self._backlog and len(self._asking) < self.concurrency:
            place, episode, begin = self._backlog.popleft()
            self._asking.add(place)
            try:
                for question in episode.questions:
                    self._awaited.add((place, episode, question), question.begin())
                if not episode.questions:
                    self._awaited.add((place, episode, None), begin())
            except BaseException as error:
                episode.annotate(error)
                raise
        # The largest group, because large batches save calls of policies.
        group = max(self._groups, key=lambda group: len(group.waiting), default=None)
        if group is not None and group.waiting and not self._awaited.ready:
            self._answer(group)
        elif self._awaited:
            (place, episode, question), answer = self._awaited.take()
            if question is not None:
                question.note(answer)
                if not all(each.answered for each in episode.questions):
                    return
                answer = episode.questions[0].answered
            self._asking.remove(place)
            self._step(place, episode, answer.result)
            self._queue(place, episode)

    def _queue(self, place: int, episode: Episode) -> None:
        """Queue an episode that waits at a decision, or end it if it is over."""
        while True:
            if self.watcher is not None:
                self.watcher.pay(episode)
            if episode.pending is None:
                self._end(place, episode)
                return
            agent, key = _pending(episode)
            if episode.questions and episode.questions[0].answered:
                self._step(place, episode, episode.questions[0].answered.result)
                continue
            if not key.batch_policy.alone:
                group = key.batch_policy.group(agent.point)
                group.waiting.append((place, episode, agent.raw_observation, agent.take_info()))
                self._groups[group] = None
                return
            arguments = episode, agent, duplicate(agent.raw_observation), agent.take_info()
            policy = key.batch_policy.policy
            if isinstance(policy, AskingPolicy) and policy.waits:
                self._crowd = min(self.size, max(self._crowd, self.concurrency))
                self._backlog.append((place, episode, partial(policy.begin, *arguments)))
                return
            self._step(place, episode, partial(key.answer, *arguments))

    def _answer(self, group: Group) -> None:
        """Have the decisions of a group answered, and run each simulation to its next decision."""
        start = perf_counter()
        places, episodes, observations, infos = map(list, zip(*group.waiting, strict=True))
        group.waiting.clear()
        answers = group.ask(episodes, observations, infos)
        answered = perf_counter()
        actions = list(map(_validate, episodes, answers[0]))
        if self.watcher is not None:
            self.watcher.record(group, places, episodes, observations, answers)
        step_all(episodes, actions)
        episodes.reverse()  # popped one by one, so that nothing keeps ended episodes alive
        for place in places:
            self._queue(place, episodes.pop())
        is_slow = answered - start > perf_counter() - answered
        if is_slow and 2 * len(places) > self._crowd:
            self._crowd = min(self.size, 2 * self._crowd)

    def _step(self, place: int, episode: Episode, answer: Callable[[], Action]) -> None:
        """Have one decision answered, and run its simulation to the next one."""
        agent, key = _pending(episode)
        try:
            with episode.context() if self.plan.options.global_rng else nullcontext():
                action, extras = split_extras(answer(), agent.point.definition.action_space)
        except BaseException as error:
            episode.annotate(error)
            raise
        action = _validate(episode, action)
        if self.watcher is not None:
            arrays = {name: np.asarray(value)[None] for name, value in extras.items()}
            group = key.batch_policy.group(agent.point)
            answers = [action], arrays
            self.watcher.record(group, [place], [episode], [agent.raw_observation], answers)
        episode.step(action)

    def _end(self, place: int, episode: Episode) -> None:
        session = self._sessions[place]
        session.end()  # it may have been truncated
        try:
            after_close = self.finish(place, episode)
            session.close()
            if after_close is not None:
                after_close()
        except BaseException as error:
            annotate(error, f"simenv_marl: after the simulation's end; seed {session.seed}")
            raise
        del self._sessions[place]


def _pending(episode: Episode) -> tuple[Agent, PolicyKey]:
    """Return the agent whose decision waits, and its policy."""
    agent = episode.pending
    assert agent is not None
    assert isinstance(agent.policy, PolicyKey)
    return agent, agent.policy


def _validate(episode: Episode, action: Action) -> Action:
    """Validate an action of the pending agent."""
    agent, _ = _pending(episode)
    try:
        return action if action is RULE else agent.validate(action)
    except InvalidActionError as error:
        episode.annotate(error)
        raise


# -- many episodes --------------------------------------------------------------------------------


def step_all(
    episodes: Sequence[Episode],
    actions: Sequence[Action],
    blame: Callable[[int, BaseException], None] | None = None,
) -> None:
    """Answer the pending decisions of episodes of one plan, and run each to its next decision.

    All simulations move before any agent is updated, so that the data of each loop stays in the
    processor's caches.

    Args:
        episodes: The episodes.
        actions: A checked action for each.
        blame: Called with the number of an episode that raises, and the error. The others may have
            moved or not; they can be closed.
    """
    if not episodes:
        return
    agents = [episode.pending for episode in episodes if episode.pending]
    is_inside = {episode.driver.caller for episode in episodes} == {getcurrent()}
    episode = episodes[0]
    has_rounds = episode.in_rounds or len(agents) != len(episodes)
    is_plain = not EVALUATING and episode.plan.plugins is None and not episode.plan.has_split
    together = is_inside and is_plain and not has_rounds
    replies = []
    events = []
    try:
        if not together:
            for episode, action in zip(episodes, actions, strict=True):
                episode.step(action)
            return
        for episode, agent, action in zip(episodes, agents, actions, strict=True):
            replies.append(episode.answer(agent, action))
        replies.reverse()  # popped one by one, so that the lists keep nothing of the models alive
        for episode in episodes:
            events.append(episode.driver.resume(replies.pop()))
        events.reverse()
        for episode in episodes:
            episode.receive(events)
    except BaseException as error:
        events.clear()  # because the error's traceback refers to it
        for other in episodes:
            if other is not episode:
                other.restore_pending()
        if episode.pending is None and not episode.over:
            episode.fail(error)
        elif together:  # otherwise the episode has already done this
            episode.annotate(error)
        if blame is not None:
            blame(episodes.index(episode), error)
        raise
