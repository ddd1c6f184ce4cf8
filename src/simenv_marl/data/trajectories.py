"""Trajectories of many episodes: observations, actions, rewards and further arrays for learners.

While the episodes run, a ``Recorder`` keeps a log for each group of decisions, in the order of the
answers. Learners get the same rows sorted by policy, episode, agent and step, independent of that
order.
"""

from collections.abc import (
    Iterable,
    Iterator,
    Mapping,
    Sequence,
)
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property
from math import nan
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ..core import (
    Agent,
    Episode,
    Plan,
    Point,
    Stacker,
    blank,
    joined,
    stacked,
    stacker,
    taken,
)
from ..errors import AgentError, OptionValueError, short_repr
from ..many.batch import Answers, Group, PolicyKey
from ..simulation import RULE, Action, Model, Observation

# Types of arrays.
Array = NDArray[Any]
Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Bools = NDArray[np.bool_]
Masks = Array | tuple[Array, ...]
"""The int8 masks of N decisions: ``(N, n)``, for a ``MultiDiscrete`` a tuple of such arrays."""

DTYPES: Final = {
    "place": "i8",
    "episodes": "i8",
    "agents": "O",
    "turns": "i8",
    "by_rule": "?",
    "times": "f8",
    "rewards": "f8",
    "elapsed": "f8",
    "last_turns": "i8",
    "terminations": "?",
    "truncations": "?",
}
"""The dtypes of decisions: of the place of the policy, and of attributes of ``Trajectories``.

Agents are names here. The turn of the end is 0 before an agent's last decision.
"""

UNPAID: Final[dict[str, float]] = {
    "rewards": 0.0,
    "elapsed": nan,
    "last_turns": 0,
    "terminations": False,
    "truncations": False,
}
"""The values of a decision before its reward is known."""

End = tuple[int, bool, bool, Model]
"""The end of an agent: the turn, whether it terminated and was truncated, and the state if kept."""

# -- trajectories for learners --------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Trajectories:
    """The trajectories of all agents that share a policy, in one or many episodes. Immutable.

    There are N rows, one for each decision, and M trajectories. A trajectory has the decisions of
    one agent in one episode, in consecutive rows. Trajectories are sorted by episode and, within an
    episode, by their first decision. For ``Dict`` and ``Tuple`` spaces, an attribute is a dict or a
    tuple of arrays instead of one array. For spaces without a shape (text, graphs, ...), it is an
    array of objects.

    Attributes:
        observations: ``(N, *shape)``, in the dtype of the observation space: the observations at
            the decisions.
        actions: ``(N, *shape)``, in the dtype of the action space: the actions. Where the rule
            decided, this is the action that corresponds to the rule's decision, by
            ``rule_action_mapping`` or, without one, by ``choices`` or a dict
            ``action_space_mapping``; zero where this action is unknown.
        rewards: ``(N,)`` float64: the rewards of the actions, as an AEC environment has them.
        terminations: ``(N,)`` bool: whether this was the agent's last decision and the agent then
            terminated.
        truncations: ``(N,)`` bool: whether this was the agent's last decision and the agent then
            was truncated.
        last_observations: ``(M, *shape)``: the final observation of each trajectory, for
            bootstrapping the value of truncated ones.
        last_turns: ``(M,)`` int64: the number of decisions in the episode when the trajectory
            ended, counted as in ``turns``.
        starts: ``(M,)`` int64: the first row of each trajectory.
        episodes: ``(N,)`` int64: the number of the episode, which is the index of its seed in
            ``seeds``.
        seeds: The seeds of all episodes. The seed of row i is ``seeds[episodes[i]]``.
        agents: ``(N,)`` int64: the deciding agent, as an index into ``names``.
        names: The names of the agents, in order of appearance.
        steps: ``(N,)`` int64: the number of the decision in its trajectory, from 0.
        turns: ``(N,)`` int64: the number of the decision among the decisions of all agents of all
            policies in the episode, from 0.
        by_rule: ``(N,)`` bool: whether the policy left the decision to the model's rule.
        known: ``(N,)`` bool: whether ``actions`` has the action that was taken.
        action_masks: ``(N, n)`` int8, for a ``MultiDiscrete`` a tuple of such arrays: the legal
            actions. None where all actions are legal.
        times: ``(N,)`` float64: the simulation's time at the decision. None where it has no clock.
        elapsed: ``(N,)`` float64: the time from the decision until its reward was known, at the
            agent's next decision or its end. None where there is no clock.
        states: ``(N, *shape)``, in the dtype of ``state_space`` if there is one: the state at each
            decision. None without the options ``state_space`` and ``state_in_info``, if no policy
            asks for ``_state``.
        last_states: ``(M, *shape)``: the state at the end of each trajectory, or None.
        extras: A dict from name to array, ``(N, ...)``: the values that the policy returned besides
            the actions.
        observation_space, action_space: The spaces of the decision point. None where no agent
            decided and the decision point is not known.
        action_labels: The ``action_labels`` of the decision point; None where it has none, or they
            vary with the call.
        collected: The result of ``collect`` for each episode's simulation, in the order of the
            seeds. None where there was no ``collect``.
        errors: For each seed, the reason why the numbers of its episode are wrong, as
            ``run_experiment`` tells it. Empty where none is known.
        lost: The seeds of the episodes that have ended their worker process twice. They are in no
            other attribute.
    """

    _: KW_ONLY
    observations: Observation
    actions: Action
    rewards: Floats
    terminations: Bools
    truncations: Bools
    last_observations: Observation
    last_turns: Integers
    starts: Integers
    episodes: Integers
    seeds: tuple[int, ...]
    agents: Integers
    names: tuple[str, ...]
    steps: Integers
    turns: Integers
    by_rule: Bools
    known: Bools
    action_masks: Masks | None = None
    times: Floats | None = None
    elapsed: Floats | None = None
    states: Any = None
    last_states: Any = None
    extras: Mapping[str, Array] = field(default_factory=dict)
    observation_space: spaces.Space[Any] | None = None
    action_space: spaces.Space[Any] | None = None
    action_labels: Sequence[str] | Mapping[Any, str] | None = None
    collected: tuple[Any, ...] | None = None
    errors: tuple[str, ...] = ()
    lost: tuple[int, ...] = ()

    def __len__(self) -> int:
        """Return N, the number of decisions."""
        return len(self.rewards)

    def __repr__(self) -> str:
        return (
            f"<Trajectories: {len(self)} decisions in {len(self.starts)} trajectories of"
            f" {len(self.names)} agents, {len(self.seeds)} episodes>"
        )

    @cached_property
    def lengths(self) -> Integers:
        """``(M,)`` int64: the number of decisions in each trajectory."""
        return np.diff(self.starts, append=len(self))

    @cached_property
    def returns(self) -> Floats:
        """``(M,)`` float64: the undiscounted return of each trajectory, the sum of its rewards."""
        return np.add.reduceat(self.rewards, self.starts) if len(self) else np.zeros(0)

    @cached_property
    def next_observations(self) -> Observation:
        """``(N, *shape)``: the agent's next observation, at its next decision or its end."""
        return self._next(self.observations, self.last_observations)

    @cached_property
    def next_states(self) -> Any:
        """``(N, *shape)``: the state at the agent's next decision or its end, or None."""
        return None if self.states is None else self._next(self.states, self.last_states)

    def _next(self, rows: Any, last: Any) -> Any:
        """Return the next row of the same agent for each row. The ends have rows of their own."""
        next_rows = np.arange(1, len(self) + 1)
        last_rows = self.starts + self.lengths - 1
        next_rows[last_rows] = len(self) + np.arange(len(last_rows))
        return taken(joined([rows, last]), next_rows)


def action_arrays(actions: Action, name: str = "") -> Iterator[tuple[str, Array]]:
    """Yield the arrays of stacked actions, each with its name.

    The name is ``[1]`` in a tuple, ``litres`` or ``[1]['litres']`` in a dict; empty for one array.
    """
    if isinstance(actions, Mapping):
        for key, part in actions.items():
            yield from action_arrays(part, f"{name}[{key!r}]" if name else str(key))
    elif isinstance(actions, tuple):
        for place, part in enumerate(actions):
            yield from action_arrays(part, f"{name}[{place}]")
    else:
        yield name, actions


@dataclass(frozen=True)
class Records:
    """The records of one policy in some episodes, in the order of its ``Trajectories``.

    Attributes:
        decisions: By attribute of ``Trajectories``, a stack with a row for each decision; as in
            ``DTYPES``.
        ends: The same with a row for each trajectory.
        point: The attributes of ``Trajectories`` that describe the decision point.
    """

    decisions: dict[str, Any]
    ends: dict[str, Any]
    point: dict[str, Any]


def combine(
    parts: Sequence[Records],
    seeds: tuple[int, ...],
    collected: tuple[Any, ...] | None = None,
    errors: tuple[str, ...] = (),
    lost: Sequence[int] = (),
) -> Trajectories:
    """Combine the records of one policy in consecutive parts of the episodes.

    ``seeds`` has an item for each episode, ``collected`` and ``errors`` for each but those with the
    numbers ``lost``.
    """
    nonempty = [part for part in parts if len(part.decisions["rewards"])] or parts[:1]
    _check_extras([part.decisions["extras"] for part in nonempty])
    decisions = joined([part.decisions for part in nonempty])
    codes: dict[str, int] = {}
    agents = [codes.setdefault(name, len(codes)) for name in decisions["agents"]]
    is_last = decisions["terminations"] | decisions["truncations"]
    starts = np.flatnonzero(np.append(True, is_last)[:-1])
    lengths = np.diff(starts, append=len(agents))
    decisions |= {
        "episodes": decisions["episodes"] - np.searchsorted(lost, decisions["episodes"]),
        "agents": np.array(agents, np.int64),
        "last_turns": decisions["last_turns"][is_last],
        "steps": np.arange(len(agents)) - np.repeat(starts, lengths),
    }
    return Trajectories(
        **decisions,
        **nonempty[0].point,
        **joined([part.ends for part in nonempty]),
        starts=starts,
        seeds=tuple(seed for number, seed in enumerate(seeds) if number not in lost),
        lost=tuple(seeds[number] for number in lost),
        names=tuple(codes),
        collected=collected,
        errors=errors,
    )


# -- logs of running episodes ---------------------------------------------------------------------


class _DecisionLog:
    """The decisions of one group, in the order of the answers.

    ``point`` is one of the group's decision points. It is None if no point is known; such a log
    stays empty. ``stack_states`` is None if states are not kept.
    """

    def __init__(self, point: Point | None, stack_states: Stacker | None) -> None:
        self._stack_states = stack_states
        self.stack_observations: Stacker = np.array
        self.stack_actions: Stacker = np.array
        self.point: dict[str, Any] = {}
        if point is not None:
            definition = point.definition
            labels = definition.action_labels
            self.point = {
                "observation_space": definition.observation_space,
                "action_space": definition.action_space,
                "action_labels": None if callable(labels) else labels,
            }
            self.stack_observations = stacker(definition.observation_space)
            self.stack_actions = stacker(definition.action_space)
            self.unknown_action = blank(definition.action_space)
        # A stack of each attribute of ``Trajectories``, for each batch.
        self.batches: list[dict[str, Any]] = []
        # A value for each row.
        self.table: dict[str, list[Any]] = {name: [] for name in DTYPES}
        # By row; only the known ones.
        self.rule_actions: dict[int, Action] = {}
        # The last observation and the last state, by row of the last decision.
        self.ends: dict[int, tuple[Observation, Model]] = {}

    def add(
        self,
        group: Group,
        numbers: Sequence[int],
        episodes: Sequence[Episode],
        agents: Sequence[Agent],
        observations: Sequence[Observation],
        answers: Answers,
    ) -> None:
        """Add a batch of decisions in episodes with these numbers. Rewards are not known yet."""
        actions, extras = answers
        known = [self.unknown_action if action is RULE else action for action in actions]
        # Copied, because policies may reuse their arrays. Two steps, because np.array cannot copy
        # every tensor.
        arrays = {str(name): np.array(np.asarray(values)) for name, values in extras.items()}
        for name, array in arrays.items():
            if array.shape[:1] != (len(actions),):
                raise OptionValueError(
                    f"{group.policy!r} returned {short_repr(name)} of shape {array.shape} for"
                    f" {len(actions)} decisions; the length of its first axis must be their number"
                )
        batch = {
            "observations": group.stack(observations),
            "actions": self.stack_actions(known),
            "extras": arrays,
        }
        if group.point.legal is not None:
            batch["action_masks"] = stacked([agent.mask for agent in agents])
        if self._stack_states is not None:
            states = [episode.note_state() for episode in episodes]
            batch["states"] = self._stack_states(states)
        self.batches.append(batch)
        table = self.table
        policies: list[Any] = [agent.policy for agent in agents]
        table["place"] += [key.place for key in policies]  # the episodes wait for these keys
        table["episodes"] += numbers
        table["agents"] += [agent.name for agent in agents]
        table["turns"] += [episode.turns for episode in episodes]
        table["by_rule"] += [action is RULE for action in actions]
        # Not from the infos, because the policy may have changed them.
        table["times"] += [agent.now for agent in agents]
        for name, value in UNPAID.items():
            table[name] += [value] * len(actions)

    def pay(
        self,
        row: int,
        agent: Agent,
        end: End | None,
    ) -> None:
        """Record the reward of a decision, the rule's action if it decided, and an end."""
        table = self.table
        table["rewards"][row] = agent.reward
        table["elapsed"][row] = agent.info.get("elapsed", nan)
        rule_action = agent.take_rule_action()  # a rule that is cut short must not report it again
        if rule_action is not None:
            self.rule_actions[row] = rule_action
        if end is not None:
            turns, table["terminations"][row], table["truncations"][row], state = end
            table["last_turns"][row] = turns
            self.ends[row] = agent.observation, state

    @cached_property
    def columns(self) -> dict[str, Any]:
        """The values of all decisions, by attribute of ``Trajectories``."""
        _check_extras([batch["extras"] for batch in self.batches])
        nothing = {
            "observations": self.stack_observations([]),
            "actions": self.stack_actions([]),
            "extras": {},
        }
        if self._stack_states is not None:
            nothing["states"] = self._stack_states([])
        columns: dict[str, Any] = joined(self.batches or [nothing])
        columns |= {name: np.array(self.table[name], dtype) for name, dtype in DTYPES.items()}
        number = len(columns["times"])
        if None in self.table["times"][:1] or not number:  # there is no clock
            del columns["times"], columns["elapsed"]
        # The rule's actions come after the policy's.
        rule_rows = list(self.rule_actions)
        rule_actions = self.stack_actions(list(self.rule_actions.values()))
        action_rows = np.arange(number)
        action_rows[rule_rows] = number + np.arange(len(rule_rows))
        columns["actions"] = taken(joined([columns["actions"], rule_actions]), action_rows)
        columns["known"] = ~columns["by_rule"]
        columns["known"][rule_rows] = True
        return columns

    def records(self, place: int) -> Records:
        """Return the records of the policy at a place, sorted by episode, agent and step."""
        columns = dict(self.columns)
        rows = np.flatnonzero(columns.pop("place") == place)
        first: dict[tuple[int, str], int] = {}
        identities = zip(columns["episodes"][rows].tolist(), columns["agents"][rows], strict=True)
        trajectories = [first.setdefault(key, row) for row, key in enumerate(identities)]
        rows = rows[np.lexsort((trajectories, columns["episodes"][rows]))]
        last = [self.ends[row] for row in rows.tolist() if row in self.ends]
        ends = {"last_observations": self.stack_observations([seen for seen, _ in last])}
        if self._stack_states is not None:
            ends["last_states"] = self._stack_states([state for _, state in last])
        return Records(taken(columns, rows), ends, self.point)


class Recorder:
    """Records the decisions of episodes while they run: a ``Watcher`` for ``BatchRun``."""

    def __init__(self, first_episode: int, stack_states: Stacker | None) -> None:
        """``stack_states``: None if states are not kept."""
        self._first_episode = first_episode
        self._stack_states = stack_states
        self._logs: dict[Group, _DecisionLog] = {}
        # The latest decision of each agent that has not ended: its log and its row.
        self._decisions: dict[Agent, tuple[_DecisionLog, int]] = {}

    def record(
        self,
        group: Group,
        places: list[int],
        waiting: list[Episode],
        observations: Sequence[Observation],
        answers: Answers,
    ) -> None:
        """Record decisions and their answers: see ``Watcher``."""
        if group not in self._logs:
            self._logs[group] = _DecisionLog(group.point, self._stack_states)
        log = self._logs[group]
        first = len(log.table["place"])
        agents = [agent for episode in waiting if (agent := episode.pending) is not None]
        numbers = [self._first_episode + place for place in places]
        log.add(group, numbers, waiting, agents, observations, answers)
        for row, agent in enumerate(agents, first):
            self._decisions[agent] = (log, row)

    def pay(self, episode: Episode) -> None:
        """Record the rewards and the ends of agents: see ``Watcher``."""
        if episode.pending is not None:
            self._pay(episode.pending)
        ends = episode.end_states or {}
        for agent in episode.take_ended():
            self._pay(agent, (episode.turns, True, False, ends.pop(agent, None)))
        if episode.over:
            agents = [agent for agent in episode.agents.values() if agent in self._decisions]
            state = None
            if agents and self._stack_states is not None:
                state = episode.note_state()
            for agent in agents:
                self._pay(agent, (episode.turns, episode.terminated, episode.truncated, state))

    def _pay(
        self,
        agent: Agent,
        end: End | None = None,
    ) -> None:
        """Record the reward of an agent's latest decision, and the agent's end."""
        if agent in self._decisions:
            log, row = self._decisions[agent]
            log.pay(row, agent, end)
            if end is not None:
                del self._decisions[agent]

    def records(
        self,
        plan: Plan,
        keys: Iterable[Any],
    ) -> list[Records]:
        """Return the records of each policy, by the order of their keys."""
        records = []
        for place, key in enumerate(keys):
            logs = {
                group.point.hook.name: log
                for group, log in self._logs.items()
                if place in log.table["place"]
            }
            if len(logs) > 1:
                raise AgentError(
                    f"{short_repr(key)} has decided at {' and at '.join(logs)}, whose spaces"
                    " differ; give its policy under the names of the points"
                )
            if not logs:
                point = next(points_of(plan, place), None)
                logs[""] = _DecisionLog(point, self._stack_states)
            (log,) = logs.values()
            records.append(log.records(place))
        return records


def points_of(plan: Plan, place: int) -> Iterator[Point]:
    """Yield the decision points that are known to be answered by the policy at a place."""
    for point in plan.points:
        policy = plan.policies.get(point.agent or "", point.policy)
        if isinstance(policy, PolicyKey) and policy.place == place:
            yield point


def _check_extras(batches: Sequence[Mapping[str, Any]]) -> None:
    """Check that all batches of a policy have the same extras."""
    for batch in batches:
        if batch.keys() != batches[0].keys():
            raise OptionValueError(
                f"a policy returned {sorted(batches[0])} beside its actions, but later"
                f" {sorted(batch)}; it must return the same names in every call"
            )
