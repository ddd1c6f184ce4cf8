"""Many simulations side by side, whose decisions are gathered and answered together.

Of each simulation there is a session and an episode, as there is of an environment. Where a policy is to answer, the
simulation stays suspended until many of them wait for the same policy. Which those are at a time depends on how many
simulations there are; what becomes of each of them does not.

Policies stand in the plan as ``Entry``, one for each key under which they were given. Entries of the same policy share
one ``Asked``, whose decisions are asked in ``Group`` s, each of the same spaces, so that they can be stacked.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from threading import get_ident
from time import perf_counter
from typing import Any, Final, Protocol

import numpy as np
from greenlet import getcurrent

from ..core.agent import Record
from ..core.bindings import Binding
from ..core.episode import NAMED_AT_CALL, UNNAMED, Episode
from ..core.plan import Plan, two_arguments
from ..core.session import Session
from ..core.stacking import rows, stacker
from ..core.switch import EVALUATING, unattended
from ..decision import DIFFERENCES
from ..errors import InvalidActionError, annotate
from ..hooks.hook import positional
from ..simulation import RULE

# -- who is asked ---------------------------------------------------------------------------------


class Asked:
    """A policy that answers many decisions at once.

    Attributes:
        keys: Under which it was given.
        policy: The policy, to be called with observations and infos.
        informed: Whether it takes the infos.
        identifying: Whether it takes what identifies each decision besides.
        groups: Of its decisions.
    """

    def __init__(self, policy: Callable[..., Any]) -> None:
        self.keys: list[Any] = []
        self.policy: Callable[..., Any] = two_arguments(policy)
        self.informed = self.policy is policy
        self.identifying = self.informed and _takes_three(policy)
        self.groups: list[Group] = []

    def __repr__(self) -> str:
        return f"the policy of {', '.join(str(getattr(key, '__qualname__', key)) for key in self.keys[:3])}"

    def answers(self, observations: Any, infos: Sequence[Any], identities: Sequence[tuple[int, int]]) -> Any:
        """What the policy returns, given as much as it takes."""
        if self.identifying:
            return self.policy(observations, infos, identities)
        return self.policy(observations, infos)

    def group(self, binding: Binding) -> Group:
        """The group of the decisions at a point."""
        group = next((group for group in self.groups if group.takes(binding)), None)
        if group is None:
            group = Group(self, binding)
            self.groups.append(group)
        return group


def _takes_three(policy: Callable[..., Any]) -> bool:
    """Whether a policy has to be given a third argument."""
    return sum(p.default is p.empty for p in positional(policy)) > 2


class Entry:
    """What stands for a policy in a plan: the policy, and the key under which it was given.

    Attributes:
        place: Of its key in the policies.
        asked: The policy.
    """

    def __init__(self, place: int, asked: Asked) -> None:
        self.place = place
        self.asked = asked
        self._groups: dict[Binding, Group] = {}

    def group(self, binding: Binding) -> Group:
        """The group of its decisions at a point."""
        group = self._groups.get(binding)
        if group is None:
            group = self._groups[binding] = self.asked.group(binding)
        return group

    def __call__(self, observation: Any, info: Any) -> Any:
        """Nobody asks it: episodes wait instead."""
        raise NotImplementedError


def entries(policies: Mapping[Any, Any]) -> dict[Any, Any]:
    """What stands for policies in a plan; what is no policy, as it is."""
    known: dict[int, Asked] = {}
    found: dict[Any, Any] = {}
    for place, (key, policy) in enumerate(policies.items()):
        found[key] = policy
        if policy is not RULE and callable(policy):
            asked = known.setdefault(id(policy), Asked(policy))
            asked.keys.append(key)
            found[key] = Entry(place, asked)
    return found


class Group:
    """Decisions that are asked together: of one policy, and in the same spaces.

    Attributes:
        asked: The policy.
        binding: One of the points at which they are decided; the others are alike.
        stack: Stacks observations.
        waiting: The episodes whose decisions wait.
        observations: Theirs.
        book: What is noted of them; None where nobody wants to know.
    """

    __slots__ = ("_discrete", "asked", "binding", "book", "observations", "stack", "waiting")

    def __init__(self, asked: Asked, binding: Binding) -> None:
        self.asked, self.binding = asked, binding
        self.stack = stacker(binding.definition.observation_space)
        self.waiting: list[Asking] = []
        # Kept beside the episodes: to ask every one of many suspended episodes again is to wait for their memory.
        self.observations: list[Any] = []
        self.book: Any = None
        self._discrete = not binding.definition.action_space.shape

    def takes(self, binding: Binding) -> bool:
        """Whether decisions at a point can be stacked with these."""
        own, other = self.binding.definition, binding.definition
        return binding is self.binding or (
            own.observation_space == other.observation_space
            and own.action_space == other.action_space
            and (self.binding.legal is None) == (binding.legal is None)
        )

    def ask(self, observations: Any, waiting: Sequence[Asking]) -> tuple[list[Any], Mapping[str, Any]]:
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
                record: Any = episode.pending
                infos.append(record.info)
                record.info = {}  # what a policy does to its own is not to be seen at the next decision
        try:
            identities = [(episode.seed, episode.turns) for episode in waiting] if asked.identifying else ()
            answers = asked.answers(observations, infos, identities)
            extras: Mapping[str, Any] = {}
            if type(answers) is tuple and len(answers) == 2 and isinstance(answers[1], Mapping):
                answers, extras = answers
            actions = [RULE] * len(waiting) if answers is RULE else rows(answers, integers=self._discrete)
            if actions is None or len(actions) != len(waiting):
                returned = repr(answers) if actions is None else f"{len(actions)} actions"
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


# -- episodes that wait ---------------------------------------------------------------------------


class Waiting(Record):
    """What an episode knows of one agent for whom a policy answers.

    Attributes:
        group: With whose decisions its own are asked.
        swift: Whether it alone decides at its point, and nothing but the mappings is to be seen to.
        entry: The policy that answers for it.
        trajectory, row, steps: In the group's book: of which trajectory its actions are, where its latest action
            stands, and how many there have been; none yet.
    """

    __slots__ = ("entry", "group", "row", "steps", "swift", "trajectory")

    def __init__(self, agent: str, binding: Binding, policy: Any, clock: Callable[[], float] | None) -> None:
        super().__init__(agent, binding, policy, clock)
        self.entry: Any = None
        self.group: Any = None
        self.swift = False
        self.trajectory = self.row = -1
        self.steps = 0


class Asking(Episode):
    """An episode whose decisions wait until their policies are asked.

    Attributes:
        place: Of its seed among the seeds.
        seed: Its seed.
        session: What it belongs to.
        pending: As in every episode; those for whom policies answer are ``Waiting``.
    """

    place: int
    seed: int
    session: Session

    def _enroll(self, agent: str, binding: Binding) -> Record:
        entry: Any = self._plan.policies.get(agent) or binding.policy
        if not isinstance(entry, Entry):
            return super()._enroll(agent, binding)
        record = self._answered[agent] = Waiting(agent, binding, entry, self.clock)
        record.entry, record.group = entry, entry.group(binding)
        return record


class Unrewarded(Asking):
    """An episode in which nobody is rewarded, as ``simulate`` has it."""

    def _foresee(self, pending: Record | None) -> None:
        """Nobody observes before deciding."""

    def _consult(self, record: Record, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        if type(record) is not Waiting:
            return super()._consult(record, args, kwargs)
        record.observe(args, kwargs)
        binding = record.binding
        if self.clock is None and binding.legal is None and binding.point.alone and not binding.tells:
            record.swift = binding.agent is not None
            self._swift[binding] = record if record.swift else NAMED_AT_CALL
        self.pending = record
        return None

    def turn(self, action: Any) -> None:
        """Answer the pending decision, as ``Episode.turn`` does, and run to the next one that waits, or to the end."""
        record: Any = self.pending
        driver: Any = self._driver
        if getcurrent() is not driver.caller:
            driver.enter()
        binding: Any = record.binding
        try:
            if type(action) is int and binding.first <= action < binding.end:
                convert = binding.convert
                reply = convert(action)
            elif action is RULE:
                reply = action
            else:
                reply = binding.reply(action, record.agent, record.mask, record.choices)
        except Exception as error:
            self._annotate(error)
            raise
        self.pending = None
        self.turns += 1
        if record.followed_up:
            record.follow_up()
        agent: Any
        first: Any
        try:
            while True:
                resume = driver.resume
                binding, args, kwargs = resume(reply)
                agent = UNNAMED
                if record is None or binding is not record.binding or not record.swift:
                    record = self._swift.get(binding)
                # Else the agent decides again that has decided before, and its record is at hand.
                if record is NAMED_AT_CALL:
                    (first,) = args
                    name_agent = binding.name_agent
                    agent = name_agent(first)
                    record = self._answered.get(agent) if type(agent) is str else None
                    if record is not None and (record.binding is not binding or type(record) is not Waiting):
                        record = None
                if record is not None:
                    # What ``_take``, ``_consult`` and ``Record.observe`` do, for the calls of most models. Their info
                    # is empty.
                    self._latest = record
                    (first,) = args
                    if DIFFERENCES:
                        EVALUATING[get_ident()] = record.memory
                    observe, cast = binding.observe, binding.cast
                    record.observation = cast(observe(first))
                    if DIFFERENCES:
                        EVALUATING.pop(get_ident(), None)
                    self.pending = record
                    return
                reply = self._take(binding, args, kwargs, agent)
                if self.pending is not None or self.over:
                    return
                # Else they would keep alive what the model lets go meanwhile.
                binding = args = kwargs = first = agent = record = None
        except BaseException as error:
            binding = args = kwargs = first = driver = resume = None  # else the error would keep them alive
            self._fail(error)
            raise


class Rewarded(Asking):
    """An episode in which those for whom policies answer are rewarded and end, as in an AEC environment."""

    _make_record = Waiting

    def _enroll(self, agent: str, binding: Binding) -> Record:
        record = super()._enroll(agent, binding)
        if isinstance(record.policy, Entry):
            record.policy = None  # its user answers, once that has asked
            self.agents[agent] = self._answered.pop(agent)
        return record

    def _arise(self, record: Record, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        assert type(record) is Waiting
        if record.group is None:  # it was there from the beginning
            record.entry = self._plan.policies.get(record.agent) or record.binding.policy
            record.group = record.entry.group(record.binding)
        super()._arise(record, args, kwargs)


# -- all of them ----------------------------------------------------------------------------------


class Watcher(Protocol):
    """Whoever wants to know what happens in the episodes."""

    def asking(self, group: Group, waiting: Sequence[Asking], observations: Any) -> None:
        """Decisions are going to be answered, whose observations are theirs to keep."""

    def answered(self, group: Group, actions: list[Any], extras: Mapping[str, Any]) -> None:
        """They have been."""

    def moved(self, episode: Asking) -> None:
        """An episode stands at its next decision, or is over."""


def run(
    plan: Plan,
    seeds: Sequence[int],
    size: int,
    finish: Callable[[int, Any], None],
    watcher: Watcher | None = None,
) -> None:
    """Run one simulation per seed, and have their policies answer.

    Args:
        plan: What they are made of, with an ``Entry`` for each policy.
        seeds: What they are reset with.
        size: How many there may be at a time.
        finish: Called with the place of a seed and its simulation, as soon as that has ended.
        watcher: Who wants to know of rewards and ends; None: nobody, and then there are none.

    Raises:
        BaseException: Whatever a model, a mapping, a policy or ``finish`` raises. All simulations are unwound.
    """
    with unattended():
        _Batches(plan, seeds, size, finish, watcher).run()


CROWD: Final = 256
"""So many simulations are under way at first. Of more, each has left the processor's caches when its turn comes again,
and takes twice as long. A policy that takes longer than all of them is worth that: then there may be more."""


class _Batches:
    """The simulations that are under way."""

    def __init__(
        self, plan: Plan, seeds: Sequence[int], size: int, finish: Callable[[int, Any], None], watcher: Watcher | None
    ) -> None:
        self._plan, self._seeds, self._size = plan, seeds, size
        self._finish, self._watcher = finish, watcher
        self._kind: type[Asking] = Unrewarded if watcher is None else Rewarded
        self._crowd = min(size, CROWD)
        self._next = 0
        self._open: dict[int, Session] = {}
        # By the power of two that is not above their number: groups of which so many decisions wait.
        self._by_size: list[dict[Group, None]] = [{} for _ in range(size.bit_length())]
        self._generator = np.random.default_rng(0)  # of seeds, none of which is ever drawn

    def run(self) -> None:
        try:
            self._refill()
            while self._open:
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
        seen, group.observations = group.observations, []
        del self._by_size[len(waiting).bit_length() - 1][group]
        watcher, number = self._watcher, len(waiting)
        observations, begun = group.stack(seen), perf_counter()
        if watcher is None:
            actions, _ = group.ask(observations, waiting)
            asked = perf_counter()
            waiting.reverse()  # taken out one by one, so that nothing holds those that have ended
            for action in actions:
                episode = waiting.pop()
                episode.turn(action)
                record: Any = episode.pending
                if record is None:
                    self._end(episode)
                    continue
                # ``_wait``, without the call.
                following = record.group
                gathered = following.waiting
                gathered.append(episode)
                following.observations.append(record.observation)
                record.observation = None
                many = len(gathered)
                if not many & (many - 1):
                    self._grow(following, many)
        else:
            kept = group.stack(seen)
            actions, extras = group.ask(observations, waiting)
            asked = perf_counter()
            watcher.asking(group, waiting, kept)
            waiting.reverse()
            for action in actions:
                episode = waiting.pop()
                episode.turn(action)
                self._settle(episode)
            watcher.answered(group, actions, extras)
        if 2 * number > self._crowd < self._size and asked - begun > perf_counter() - asked:
            self._crowd = min(self._size, 2 * self._crowd)
        self._refill()

    def _settle(self, episode: Asking) -> None:
        if self._watcher is not None:
            self._watcher.moved(episode)
        if episode.pending is None:
            self._end(episode)
        else:
            self._wait(episode)

    def _wait(self, episode: Asking) -> None:
        record: Any = episode.pending
        group = record.group
        group.waiting.append(episode)
        group.observations.append(record.observation)
        number = len(group.waiting)
        if not number & (number - 1):
            self._grow(group, number)

    def _grow(self, group: Group, number: int) -> None:
        """So many decisions of a group wait now, a power of two."""
        place = number.bit_length() - 1
        if place:
            del self._by_size[place - 1][group]
        self._by_size[place][group] = None

    def _refill(self) -> None:
        """Begin simulations, until there are as many as there may be."""
        while self._next < len(self._seeds) and len(self._open) < self._crowd:
            place, seed = self._next, self._seeds[self._next]
            self._next += 1
            try:
                session = Session(self._plan)
            except BaseException as error:
                annotate(error, f"simenv_marl: while the simulation was made; seed {seed}")
                raise
            self._open[place] = session
            episode = session.start(seed, None, self._generator, self._kind)
            episode.place, episode.seed, episode.session = place, seed, session
            self._settle(episode)

    def _end(self, episode: Asking) -> None:
        place, session = episode.place, episode.session
        session.close()  # it may have been truncated
        del self._open[place]
        try:
            self._finish(place, session.simulation)
        except BaseException as error:
            annotate(error, f"simenv_marl: after the simulation's end; seed {episode.seed}")
            raise

    def _unwind(self, error: BaseException) -> None:
        """Unwind what is suspended, after an error in one of them."""
        for place, session in self._open.items():
            try:
                session.close()
            except BaseException as problem:
                annotate(
                    error,
                    f"simenv_marl: and the simulation of seed {self._seeds[place]}, when it was unwound, raised"
                    f" {problem!r}",
                )
        self._open.clear()
