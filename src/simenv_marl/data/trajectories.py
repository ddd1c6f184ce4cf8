"""Trajectories of many episodes: observations, actions, rewards and what else a learner needs.

While the episodes run, a ``Recorder`` keeps a log for each group of decisions, in the order of the
answers. Learners get the same rows sorted by policy, episode, agent and step, independent of that
order.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property
from math import nan
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ..core import Agent, Episode, Plan, Point, Stacker, blank, joined, stack_masks, stacker, taken
from ..errors import AgentError, OptionValueError, short_repr
from ..many.batch import Answers, Group, PolicyKey
from ..simulation import RULE

# -- what learners get ----------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Trajectories:
    """The trajectories of all agents that one policy answered for, in one or many episodes. Immutable.

    There are N rows, one for each decision, and M trajectories, one for each agent in each episode
    in which it decided. The rows of a trajectory are consecutive, in the order of its decisions.
    Trajectories are sorted by episode and, within an episode, by their first decision. For ``Dict``
    and ``Tuple`` spaces, an attribute is a dict or a tuple of arrays instead of one array. For
    spaces without a shape (text, graphs, ...), it is an array of objects.

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
        turns: ``(N,)`` int64: the number of the decision among those of all agents of all policies
            in the episode, from 0.
        by_rule: ``(N,)`` bool: whether the policy left the decision to the model's rule.
        known: ``(N,)`` bool: whether ``actions`` has the action that was taken.
        action_masks: ``(N, n)`` int8, for a ``MultiDiscrete`` a tuple of such arrays: the legal
            actions. None where all actions are legal.
        times: ``(N,)`` float64: the simulation's time at the decision. None where it has no clock.
        elapsed: ``(N,)`` float64: the time from the decision until its reward was known, at the
            agent's next decision or its end. None where there is no clock.
        extras: A dict from name to array, ``(N, ...)``: what the policy returned besides the
            actions.
        observation_space, action_space: The spaces of the decision point. None where no agent
            decided and the decision point is not known.
        action_labels: The ``action_labels`` of the decision point; None where it has none, or they
            vary with the call.
        collected: What ``collect`` returned for each episode's simulation, in the order of the
            seeds. None where there was no ``collect``.
    """

    _: KW_ONLY
    observations: Any
    actions: Any
    rewards: NDArray[np.float64]
    terminations: NDArray[np.bool_]
    truncations: NDArray[np.bool_]
    last_observations: Any
    last_turns: NDArray[np.int64]
    starts: NDArray[np.int64]
    episodes: NDArray[np.int64]
    seeds: tuple[int, ...]
    agents: NDArray[np.int64]
    names: tuple[str, ...]
    steps: NDArray[np.int64]
    turns: NDArray[np.int64]
    by_rule: NDArray[np.bool_]
    known: NDArray[np.bool_]
    action_masks: Any = None
    times: NDArray[np.float64] | None = None
    elapsed: NDArray[np.float64] | None = None
    extras: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    observation_space: spaces.Space[Any] | None = None
    action_space: spaces.Space[Any] | None = None
    action_labels: Any = None
    collected: tuple[Any, ...] | None = None

    def __len__(self) -> int:
        """Return N, the number of decisions."""
        return len(self.rewards)

    def __repr__(self) -> str:
        return (
            f"<Trajectories: {len(self)} decisions in {len(self.starts)} trajectories of"
            f" {len(self.names)} agents, {len(self.seeds)} episodes>"
        )

    @cached_property
    def lengths(self) -> NDArray[np.int64]:
        """``(M,)`` int64: the number of decisions in each trajectory."""
        return np.diff(self.starts, append=len(self))

    @cached_property
    def returns(self) -> NDArray[np.float64]:
        """``(M,)`` float64: the undiscounted return of each trajectory, the sum of its rewards."""
        return np.add.reduceat(self.rewards, self.starts) if len(self) else np.zeros(0)

    @cached_property
    def next_observations(self) -> Any:
        """``(N, *shape)``: the agent's next observation, at its next decision or its end."""
        ends = self.starts + self.lengths - 1
        following = np.arange(1, len(self) + 1)
        # the last observations lie behind all others
        following[ends] = len(self) + np.arange(len(ends))
        return taken(joined([self.observations, self.last_observations]), following)


def leaves(stack: Any, name: str = "") -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the arrays of a stack, with their names: ``[1]`` in a tuple, ``litres`` or ``[1]['litres']`` in a dict."""
    if isinstance(stack, Mapping):
        for key, part in stack.items():
            yield from leaves(part, f"{name}[{key!r}]" if name else str(key))
    elif isinstance(stack, tuple):
        for place, part in enumerate(stack):
            yield from leaves(part, f"{name}[{place}]")
    else:
        yield name, stack


@dataclass(frozen=True)
class Records:
    """The records of one policy in some episodes, in the order of its ``Trajectories``."""

    # by attribute of ``Trajectories``: arrays with a row for each decision
    decisions: Mapping[str, Any]
    trajectories: Mapping[str, Any]  # the same with a row for each trajectory
    observation_space: spaces.Space[Any] | None
    action_space: spaces.Space[Any] | None
    action_labels: Any


def combine(
    parts: Sequence[Records], seeds: tuple[int, ...], collected: tuple[Any, ...] | None = None
) -> Trajectories:
    """Combine the records of one policy in consecutive parts of the episodes.

    Seeds and values are those of all.
    """
    filled = [part for part in parts if len(part.decisions["rewards"])] or parts[:1]
    _check_extras([part.decisions["extras"] for part in filled])
    trajectories = joined([part.trajectories for part in filled])
    lengths, names = trajectories["lengths"], dict.fromkeys(trajectories["agents"].tolist())
    starts, codes = np.cumsum(lengths) - lengths, {name: code for code, name in enumerate(names)}
    agents = np.array([codes[name] for name in trajectories["agents"].tolist()], np.int64)
    return Trajectories(
        **joined([part.decisions for part in filled]),
        last_observations=trajectories["last_observations"],
        last_turns=trajectories["last_turns"],
        starts=starts,
        episodes=np.repeat(trajectories["episodes"], lengths),
        seeds=seeds,
        agents=np.repeat(agents, lengths),
        names=tuple(names),
        steps=np.arange(lengths.sum()) - np.repeat(starts, lengths),
        observation_space=filled[0].observation_space,
        action_space=filled[0].action_space,
        action_labels=filled[0].action_labels,
        collected=collected,
    )


# -- while episodes run ---------------------------------------------------------------------------


@dataclass(slots=True)
class _TrajectoryLog:
    """The record of one trajectory. If its episode fails, it has no end."""

    decisions: "_DecisionLog"
    episode: int
    agent: str
    rows: list[int] = field(default_factory=list)  # of its decisions in their log
    last_observation: Any = None
    last_turn: int = -1  # the number of decisions in the episode when it ended
    terminated: bool = False
    truncated: bool = False


class _DecisionLog:
    """The decisions of one group, in the order of the answers.

    The point is one of those at which the group decides; None if it is not known, and there are no
    decisions.
    """

    def __init__(self, point: Point | None) -> None:
        self.observation_space = self.action_space = self.action_labels = None
        self.stack_observations: Stacker = np.array
        self.stack_actions: Stacker = np.array
        if point is not None:
            self.name, definition = point.hook.name, point.definition
            self.observation_space, self.action_space = (
                definition.observation_space,
                definition.action_space,
            )
            self.action_labels = (
                None if callable(definition.action_labels) else definition.action_labels
            )
            self.stack_observations, self.stack_actions = (
                stacker(self.observation_space),
                stacker(self.action_space),
            )
            self.unknown_action = blank(self.action_space)
        # One entry for each batch.
        self.observations: list[Any] = []
        self.actions: list[Any] = []
        self.masks: list[Any] = []
        self.extras: list[dict[str, NDArray[Any]]] = []
        # One entry for each decision.
        self.turns: list[int] = []
        self.by_rule: list[bool] = []
        self.times: list[float] = []
        self.rewards: list[float] = []
        self.elapsed: list[float] = []
        self.rule_actions: dict[int, Any] = {}  # by row; only those that are known
        self.trajectories: dict[int, list[_TrajectoryLog]] = {}  # by the place of their policy

    @cached_property
    def columns(self) -> dict[str, Any]:
        """Return the values of all decisions, by attribute of ``Trajectories``."""
        _check_extras(self.extras)
        number, by_rule = len(self.rewards), np.array(self.by_rule, np.bool_)
        # The actions of the rule lie behind those of the policy; ``rows`` finds the action of each
        # decision.
        actions = joined([*self.actions, self.stack_actions(list(self.rule_actions.values()))])
        rows, replaced = np.arange(number), list(self.rule_actions)
        rows[replaced] = number + np.arange(len(replaced))
        known = ~by_rule
        known[replaced] = True
        columns = {
            "observations": joined([*self.observations, self.stack_observations([])]),
            "actions": taken(actions, rows),
            "rewards": np.array(self.rewards, np.float64),
            "turns": np.array(self.turns, np.int64),
            "by_rule": by_rule,
            "known": known,
            "extras": joined(self.extras) if self.extras else {},
        }
        if self.masks:
            columns["action_masks"] = joined(self.masks)
        if self.times:
            columns["times"] = np.array(self.times, np.float64)
            columns["elapsed"] = np.array(self.elapsed, np.float64)
        return columns

    def records(self, place: int) -> Records:
        """Return the records of the policy at a place, sorted by episode, agent and step."""
        logs = sorted(self.trajectories.get(place, ()), key=lambda log: (log.episode, log.rows[0]))
        lengths = np.array([len(log.rows) for log in logs], np.int64)
        last_rows = np.cumsum(lengths) - 1
        terminations, truncations = np.zeros((2, lengths.sum()), np.bool_)
        terminations[last_rows] = [log.terminated for log in logs]
        truncations[last_rows] = [log.truncated for log in logs]
        rows = np.array([row for log in logs for row in log.rows], np.int64)
        decisions = taken(self.columns, rows) | {
            "terminations": terminations,
            "truncations": truncations,
        }
        trajectories = {
            "lengths": lengths,
            "episodes": np.array([log.episode for log in logs], np.int64),
            "agents": np.array([log.agent for log in logs], object),
            "last_turns": np.array([log.last_turn for log in logs], np.int64),
            "last_observations": self.stack_observations([log.last_observation for log in logs]),
        }
        return Records(
            decisions, trajectories, self.observation_space, self.action_space, self.action_labels
        )


class Recorder:
    """Records the decisions of episodes while they run: a ``Watcher`` for ``BatchRun``."""

    def __init__(self, first_episode: int) -> None:
        self._first_episode = first_episode
        self._logs: dict[Group, _DecisionLog] = {}
        self._trajectories: dict[Agent, _TrajectoryLog] = {}  # of agents that have not ended

    def record(
        self,
        group: Group,
        places: list[int],
        waiting: list[Any],
        observations: Any,
        answers: Answers,
    ) -> None:
        """Record decisions and their answers: see ``Watcher``."""
        actions, extras = answers
        log = self._logs.get(group)
        if log is None:
            log = self._logs[group] = _DecisionLog(group.point)
        row, turns = len(log.rewards), log.turns
        agents = [episode.pending for episode in waiting]
        for place, episode, agent in zip(places, waiting, agents, strict=True):
            trajectory = self._trajectories.get(agent)
            if trajectory is None:
                trajectory = _TrajectoryLog(log, self._first_episode + place, agent.name)
                self._trajectories[agent] = trajectory
                log.trajectories.setdefault(agent.policy.place, []).append(trajectory)
            trajectory.rows.append(row)
            turns.append(episode.turns)
            row += 1
        log.observations.append(group.stack(observations))
        log.rewards.extend([0.0] * len(agents))
        log.elapsed.extend([nan] * len(agents))
        if group.point.legal is not None:
            log.masks.append(stack_masks([agent.mask for agent in agents]))
        if waiting[0].clock is not None:
            # the policy may have been given the info
            log.times.extend([agent.now for agent in agents])
        log.by_rule += [action is RULE for action in actions]
        log.actions.append(
            log.stack_actions(
                [log.unknown_action if action is RULE else action for action in actions]
            )
        )
        # Copied because policies may reuse their arrays; in two steps because np.array cannot copy
        # every tensor.
        arrays = {str(name): np.array(np.asarray(values)) for name, values in extras.items()}
        for name, array in arrays.items():
            if not array.ndim or len(array) != len(actions):
                raise OptionValueError(
                    f"{group.policy!r} returned {short_repr(name)} of shape {array.shape} for"
                    f" {len(actions)} decisions; the length of its first axis must be their number"
                )
        log.extras.append(arrays)

    def pay(self, episode: Episode) -> None:
        """Record the rewards: see ``Watcher``."""
        if episode.pending is not None:
            self._reward(episode.pending)
        if not (episode.over or episode.just_ended):
            return
        ended = [(agent, True, False) for agent in episode.take_ended()]
        if episode.over:
            ended += [
                (agent, episode.terminated, episode.truncated) for agent in episode.agents.values()
            ]
        for agent, terminated, truncated in ended:
            self._reward(agent)
            trajectory = self._trajectories.pop(agent, None)
            if trajectory is not None:
                trajectory.last_observation, trajectory.last_turn = agent.observation, episode.turns
                trajectory.terminated, trajectory.truncated = terminated, truncated

    def _reward(self, agent: Agent) -> None:
        """Record the reward of the agent's latest action, if it has decided before."""
        trajectory = self._trajectories.get(agent)
        if trajectory is None:
            return
        log, row = trajectory.decisions, trajectory.rows[-1]
        log.rewards[row] = agent.reward
        log.elapsed[row] = agent.info.get("elapsed", nan)
        rule_action = agent.take_rule_action()
        if rule_action is not None:
            log.rule_actions[row] = rule_action

    def records(self, plan: Plan, keys: Iterable[Any]) -> list[Records]:
        """Return the records of each policy, in the order of the policies, which have these keys."""
        records = []
        for place, key in enumerate(keys):
            logs = [log for log in self._logs.values() if place in log.trajectories]
            if len(logs) > 1:
                raise AgentError(
                    f"{short_repr(key)} has decided at"
                    f" {' and at '.join(log.name for log in logs)}, whose spaces differ; give its"
                    " policy under the names of the points"
                )
            if not logs:
                point = next(
                    (point for point in plan.points if is_answered_by(plan, point, place)), None
                )
                logs = [_DecisionLog(point)]
            records.append(logs[0].records(place))
        return records


def is_answered_by(plan: Plan, point: Point, place: int) -> bool:
    """Return whether it is known beforehand that the policy at this place answers at a decision point."""
    policy = point.policy if point.agent is None else plan.policies.get(point.agent, point.policy)
    return isinstance(policy, PolicyKey) and policy.place == place


def _check_extras(batches: Sequence[Mapping[str, Any]]) -> None:
    """Check that all batches of a policy have the same extras."""
    for batch in batches:
        if batch.keys() != batches[0].keys():
            raise OptionValueError(
                f"a policy returned {sorted(batches[0])} beside its actions, but later"
                f" {sorted(batch)}; it must return the same names in every call"
            )
