"""Many simulations side by side, whose decisions are gathered and answered together.

Of each simulation there is a session and an episode, as there is of an environment. Where a batched policy is to
answer, the episode waits until many decisions wait for the same policy. Which those are at a time depends on how many
simulations there are; what becomes of each of them does not.

Policies stand in the plan as ``PolicyKey``, one for each key under which they were given. Keys of the same policy share
one ``BatchPolicy``, whose decisions are asked in ``Group`` s, each of the same spaces, so that they can be stacked.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from time import perf_counter
from typing import Any, Final, Protocol

import numpy as np

from ..core.asking import AskingPolicy, asks_for_environment
from ..core.bound import BoundPoint, DeferredPolicy
from ..core.episode import Episode, When
from ..core.plan import Plan
from ..core.roster import two_arguments
from ..core.session import Session
from ..core.spaces import duplicate
from ..core.stacking import rows, stacker
from ..core.together import step_all
from ..decision import DecisionPoint
from ..errors import InvalidActionError, annotate, shown
from ..hooks.stacks import outside_simulation
from ..remote.kept import processes_kept
from ..simulation import RULE, positional

# -- who is asked ---------------------------------------------------------------------------------


class BatchPolicy:
    """A policy that answers many decisions at once.

    Attributes:
        keys: Under which it was given.
        policy: The policy, to be called with observations and infos.
        informed: Whether it takes the infos.
        identifying: Whether it takes what identifies each decision besides.
        asking: Whether it asks for the environment, and so answers one decision at a time.
        groups: Of its decisions.
    """

    def __init__(self, policy: Callable[..., Any]) -> None:
        self.keys: list[Any] = []
        self.policy: Callable[..., Any] = two_arguments(policy)
        self.informed = self.policy is policy
        self.identifying = self.informed and takes_identities(policy)
        self.asking = isinstance(self.policy, AskingPolicy)
        self.groups: list[Group] = []

    def __repr__(self) -> str:
        return f"the policy of {', '.join(str(getattr(key, '__qualname__', key)) for key in self.keys[:3])}"

    def answers(self, observations: Any, infos: Sequence[Any], identities: Sequence[tuple[int, int]]) -> Any:
        """What the policy returns, given as much as it takes."""
        if self.identifying:
            return self.policy(observations, infos, identities)
        return self.policy(observations, infos)

    def group(self, point: BoundPoint) -> Group:
        """The group of the decisions at a point."""
        group = next((group for group in self.groups if group.takes(point)), None)
        if group is None:
            group = Group(self, point)
            self.groups.append(group)
        return group


def takes_identities(policy: Callable[..., Any]) -> bool:
    """Whether a policy has to be given a third argument, what identifies each decision."""
    return sum(p.default is p.empty for p in positional(policy)) > 2


class PolicyKey(DeferredPolicy):
    """What stands for a policy in a plan: the policy, and the key under which it was given.

    Attributes:
        place: Of its key in the policies.
        asked: The policy.
    """

    def __init__(self, place: int, asked: BatchPolicy) -> None:
        self.place = place
        self.asked = asked
        self._groups: dict[DecisionPoint, Group] = {}

    def group(self, point: BoundPoint) -> Group:
        """The group of its decisions at a point."""
        group = self._groups.get(point.point)
        if group is None:
            group = self._groups[point.point] = self.asked.group(point)
        return group

    def __call__(self, observation: Any, info: Any) -> Any:
        """Answer one decision, where the policy is one of one decision at a time."""
        return self.asked.policy(observation, info)

    def alone(self, episode: Any, agent: Any) -> Any:
        """Answer a decision at once, of an episode that is a branch and waits for one agent alone."""
        group = self.group(agent.point)
        episode.pending = agent
        try:
            actions, _ = group.ask(group.stack([agent.observation]), [episode])
        finally:
            episode.pending = None
        return actions[0]


class AskingKey(AskingPolicy, PolicyKey):
    """The same of a policy that asks for the environment, and so answers one decision at a time."""

    def __init__(self, place: int, asked: BatchPolicy, policy: Callable[..., Any]) -> None:
        AskingPolicy.__init__(self, policy)
        PolicyKey.__init__(self, place, asked)

    def alone(self, episode: Any, agent: Any) -> Any:
        """Answer a decision at once, of an episode that is a branch and waits for one agent alone."""
        return self(agent.observation, agent.info)


def policy_keys(policies: Mapping[Any, Any], *, rewarded: bool = False) -> dict[Any, Any]:
    """What stands for policies in a plan; what is no policy, as it is.

    Args:
        policies: The policies.
        rewarded: Whether those that ask for the environment are waited for as well. Else they are asked where they
            decide, as they answer one decision at a time.
    """
    known: dict[int, BatchPolicy] = {}
    found: dict[Any, Any] = {}
    for place, (key, policy) in enumerate(policies.items()):
        found[key] = policy
        asks = asks_for_environment(policy)
        if policy is not RULE and callable(policy) and (rewarded or not asks):
            asked = known.setdefault(id(policy), BatchPolicy(policy))
            asked.keys.append(key)
            found[key] = AskingKey(place, asked, policy) if asks else PolicyKey(place, asked)
    return found


class Group:
    """Decisions that are asked together: of one policy, and in the same spaces.

    Attributes:
        asked: The policy.
        point: One of the points at which they are decided; the others are alike.
        stack: Stacks observations.
        waiting: The episodes whose decisions wait.
        places: The places of their seeds among the seeds.
        observations: Theirs.
        book: What is noted of the decisions; None where no trajectories are collected.
    """

    __slots__ = ("_discrete", "asked", "book", "observations", "places", "point", "stack", "waiting")

    def __init__(self, asked: BatchPolicy, point: BoundPoint) -> None:
        self.asked, self.point = asked, point
        self.stack = stacker(point.definition.observation_space, cast=True)
        self.waiting: list[Episode] = []
        self.places: list[int] = []
        # Kept beside the episodes: to ask every one of many suspended episodes again is to wait for their memory.
        self.observations: list[Any] = []
        self.book: Any = None
        self._discrete = not point.definition.action_space.shape

    def takes(self, point: BoundPoint) -> bool:
        """Whether decisions at a point can be stacked with these."""
        own, other = self.point.definition, point.definition
        return point is self.point or (
            own.observation_space == other.observation_space
            and own.action_space == other.action_space
            and (self.point.legal is None) == (point.legal is None)
        )

    def ask(self, observations: Any, waiting: Sequence[Episode]) -> tuple[list[Any], Mapping[str, Any]]:
        """Have the policy answer.

        Args:
            observations: Of those who wait, stacked.
            waiting: The episodes that wait.

        Returns:
            An action for each, and what else the policy has returned.

        Raises:
            InvalidActionError: There is not one action for each.
            BaseException: Whatever the policy raises.
        """
        asked = self.asked
        infos: list[Any] = []
        if asked.informed:
            for episode in waiting:
                agent: Any = episode.pending
                infos.append(agent.info)
                agent.info = {}  # what a policy does to its own is not to be seen at the next decision
        try:
            identities = [(episode.seed, episode.turns) for episode in waiting] if asked.identifying else ()
            answers = _each(waiting) if asked.asking else asked.answers(observations, infos, identities)
            extras: Mapping[str, Any] = {}
            if type(answers) is tuple and len(answers) == 2 and isinstance(answers[1], Mapping):
                answers, extras = answers
            actions = [RULE] * len(waiting) if answers is RULE else rows(answers, integers=self._discrete)
            if actions is None or len(actions) != len(waiting):
                returned = shown(answers) if actions is None else f"{len(actions)} actions"
                raise InvalidActionError(
                    f"{asked!r} was asked for {len(waiting)} decisions at once and has returned {returned}; it is to"
                    " return as many actions, in their order, for observations whose first axis counts the decisions"
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
    """What a policy answers that asks for the environment, one decision after the other."""
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
    """What is told of what happens in the episodes."""

    def asking(self, group: Group, places: Sequence[int], waiting: Sequence[Episode], observations: Any) -> None:
        """Decisions are going to be answered; the observations are the watcher's to keep."""

    def answered(self, group: Group, actions: list[Any], extras: Mapping[str, Any]) -> None:
        """They have been answered."""

    def moved(self, episode: Episode) -> None:
        """An episode stands at its next decision, or is over."""


def run(
    plan: Plan,
    seeds: Sequence[int],
    size: int,
    finish: Callable[[int, Any], Callable[[], None] | None],
    watcher: Watcher | None = None,
) -> None:
    """Run one simulation per seed, and have their policies answer.

    Args:
        plan: What they are made of, with a ``PolicyKey`` for each policy.
        seeds: What they are reset with.
        size: How many there may be at a time.
        finish: Called with the place of a seed and its simulation, as soon as that has ended. What it returns is called
            as soon as that is closed.
        watcher: What is told of rewards and ends; None: agents are not rewarded.

    Raises:
        BaseException: Whatever a model, a mapping, a policy or ``finish`` raises. All simulations are unwound.
    """
    with outside_simulation(), processes_kept():
        _Batches(plan, seeds, size, finish, watcher).run()


def _checked(episode: Episode, action: Any) -> Any:
    """A checked action of the pending agent."""
    agent: Any = episode.pending
    try:
        return action if action is RULE else agent.point.checked(action, agent.name, agent.mask)
    except InvalidActionError as error:
        episode.annotate(error)
        raise


def _blame(number: int, error: BaseException) -> None:
    """Do nothing: the notes of an error tell its seed already."""


CROWD: Final = 256
"""So many simulations are under way at first. Of more, each has left the processor's caches when its turn comes again,
and takes twice as long. A policy that takes longer than all of them is worth that: then there may be more."""


class _Batches:
    """The simulations that are under way."""

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
        self._when = When.NEVER if watcher is None else When.DECISION
        self._crowd = min(size, CROWD)
        self._next = 0
        self._sessions: dict[int, Session] = {}  # by the place of their seed
        # By the power of two that is not above their number: groups of which so many decisions wait.
        self._by_size: list[dict[Group, None]] = [{} for _ in range(size.bit_length())]

    def run(self) -> None:
        try:
            self._refill()
            while self._sessions:
                self._answer(self._largest())
        except BaseException as error:
            self._unwind(error)
            raise

    def _largest(self) -> Group:
        """A group of which more than half as many decisions wait as of any other.

        To wait for large ones takes fewer calls of policies; to look for the very largest would take the longer, the
        more groups there are.
        """
        return next(iter(next(groups for groups in reversed(self._by_size) if groups)))

    def _answer(self, group: Group) -> None:
        """Have decisions answered, and let each simulation go on to its next one."""
        waiting, group.waiting = group.waiting, []
        places, group.places = group.places, []
        seen, group.observations = group.observations, []
        del self._by_size[len(waiting).bit_length() - 1][group]
        watcher, number, begun = self._watcher, len(waiting), perf_counter()
        kept = None if watcher is None else group.stack(seen)
        actions, extras = group.ask(group.stack(seen), waiting)
        asked = perf_counter()
        if watcher is not None:
            watcher.asking(group, places, waiting, kept)
        step_all(waiting, list(map(_checked, waiting, actions)), _blame)
        waiting.reverse()  # taken out one by one, so that nothing holds those that have ended
        for place in places:
            self._settle(place, waiting.pop())
        if watcher is not None:
            watcher.answered(group, actions, extras)
        if 2 * number > self._crowd < self._size and asked - begun > perf_counter() - asked:
            self._crowd = min(self._size, 2 * self._crowd)
        self._refill()

    def _settle(self, place: int, episode: Episode) -> None:
        """See to an episode that stands at its next decision, or is over."""
        if self._watcher is not None:
            self._watcher.moved(episode)
        agent = episode.pending
        if agent is None:
            self._end(place)
            return
        group = agent.group
        if group is None:
            group = agent.group = agent.policy.group(agent.point)
        gathered = group.waiting
        gathered.append(episode)
        group.places.append(place)
        # Kept beside the episodes: to ask every one of many suspended episodes again is to wait for their memory.
        group.observations.append(agent.observation)
        if self._watcher is None:
            agent.observation = None
        many = len(gathered)
        if not many & (many - 1):
            self._grow(group, many)

    def _grow(self, group: Group, number: int) -> None:
        """So many decisions of a group wait now, a power of two."""
        place = number.bit_length() - 1
        if place:
            del self._by_size[place - 1][group]
        self._by_size[place][group] = None

    def _refill(self) -> None:
        """Begin simulations, until there are as many as there may be."""
        while self._next < len(self._seeds) and len(self._sessions) < self._crowd:
            place, seed = self._next, self._seeds[self._next]
            self._next += 1
            try:
                session = Session(self._plan)
            except BaseException as error:
                annotate(error, f"simenv_marl: while the simulation was made; seed {seed}")
                raise
            self._sessions[place] = session
            self._settle(place, session.start(seed, None, self._when))

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

    def _unwind(self, error: BaseException) -> None:
        """Unwind what is suspended, after an error in one of them."""
        for place, session in self._sessions.items():
            try:
                session.close()
            except BaseException as problem:
                annotate(
                    error,
                    f"simenv_marl: and the simulation of seed {self._seeds[place]}, when it was unwound, raised"
                    f" {shown(problem)}",
                )
        self._sessions.clear()
