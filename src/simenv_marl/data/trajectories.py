"""Trajectories of many episodes: observations, actions, rewards and what else a learner needs.

While the episodes run, a ``Ledger`` has a page for each group of decisions. A page has the decisions in the order in
which they were answered. Learners get the same rows sorted by policy, episode, agent and step, independent of that
order.
"""

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import cached_property
from math import nan
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ..core.agent import Agent
from ..core.episode import Episode
from ..core.plan import Plan
from ..core.point import Point
from ..core.spaces import blank
from ..core.stacking import empty, joined, stack_masks, stacker, taken
from ..errors import AgentError, OptionValueError, short_repr
from ..many.batch import Group, PolicyKey
from ..simulation import RULE

# -- what learners get ----------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Trajectories:
    """The trajectories of all agents that one policy answered for, in one or many episodes. Immutable.

    There are N rows, one for each decision, and M trajectories, one for each agent in each episode in which it decided.
    The rows of a trajectory are consecutive, in the order of its decisions. Trajectories are sorted by episode and,
    within an episode, by their first decision. For ``Dict`` and ``Tuple`` spaces, an attribute is a dict or a tuple of
    arrays instead of one array. For spaces without a shape (text, graphs, ...), it is an array of objects.

    Attributes:
        observations: ``(N, *shape)``, in the dtype of the observation space: the observations at the decisions.
        actions: ``(N, *shape)``, in the dtype of the action space: the actions. Where the rule decided, this is the
            action that corresponds to the rule's decision, by ``rule_action_mapping`` or, without one, by ``choices``
            or a dict ``action_space_mapping``; zero where this action is unknown.
        rewards: ``(N,)`` float64: the rewards of the actions, as an AEC environment has them.
        terminations: ``(N,)`` bool: whether this was the agent's last decision and the agent then terminated.
        truncations: ``(N,)`` bool: whether this was the agent's last decision and the agent then was truncated.
        last_observations: ``(M, *shape)``: the final observation of each trajectory, for bootstrapping the value of
            truncated ones.
        last_turns: ``(M,)`` int64: the number of decisions in the episode when the trajectory ended, counted as in
            ``turns``.
        starts: ``(M,)`` int64: the first row of each trajectory.
        episodes: ``(N,)`` int64: the number of the episode, which is the index of its seed in ``seeds``.
        seeds: The seeds of all episodes. The seed of row i is ``seeds[episodes[i]]``.
        agents: ``(N,)`` int64: the deciding agent, as an index into ``names``.
        names: The names of the agents, in order of appearance.
        steps: ``(N,)`` int64: the number of the decision in its trajectory, from 0.
        turns: ``(N,)`` int64: the number of the decision among those of all agents of all policies in the episode, from
            0.
        by_rule: ``(N,)`` bool: whether the policy left the decision to the model's rule.
        known: ``(N,)`` bool: whether ``actions`` has the action that was taken.
        action_masks: ``(N, n)`` int8, for a ``MultiDiscrete`` a tuple of such arrays: the legal actions. None where all
            actions are legal.
        times: ``(N,)`` float64: the simulation's time at the decision. None where it has no clock.
        elapsed: ``(N,)`` float64: the time from the decision until its reward was known, at the agent's next decision
            or its end. None where there is no clock.
        extras: A dict from name to array, ``(N, ...)``: what the policy returned besides the actions.
        observation_space, action_space: The spaces of the decision point. None where no agent decided and the decision
            point is not known.
        collected: What ``collect`` returned for each episode's simulation, in the order of the seeds. None where there
            was no ``collect``.
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
    collected: tuple[Any, ...] | None = None

    def __len__(self) -> int:
        """Return N, the number of decisions."""
        return len(self.rewards)

    def __repr__(self) -> str:
        return (
            f"<Trajectories: {len(self)} decisions in {len(self.starts)} trajectories of {len(self.names)} agents,"
            f" {len(self.seeds)} episodes>"
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
        if not len(self):
            return self.observations
        number = len(self)
        following = np.arange(1, number + 1)
        following[self.starts[1:] - 1] = number + np.arange(len(self.starts) - 1)
        following[-1] = number + len(self.starts) - 1
        return taken(joined([self.observations, self.last_observations]), following)


def merged(parts: Sequence[Trajectories]) -> Trajectories:
    """Concatenate the trajectories of one policy in several parts of the episodes."""
    seeds = tuple(seed for part in parts for seed in part.seeds)
    first_episodes = np.cumsum([0, *(len(part.seeds) for part in parts)])
    first_rows = np.cumsum([0, *(len(part) for part in parts)])
    codes = {name: code for code, name in enumerate(dict.fromkeys(name for part in parts for name in part.names))}
    filled = [(number, part) for number, part in enumerate(parts) if len(part)]
    collected = None if parts[0].collected is None else tuple(one for part in parts for one in part.collected or ())
    if not filled:
        return replace(parts[0], seeds=seeds, collected=collected)

    def together(name: str) -> Any:
        values = [getattr(part, name) for _, part in filled]
        return None if values[0] is None else joined(values)

    _check_extras([part.extras for _, part in filled])
    same = (
        "observations", "actions", "rewards", "terminations", "truncations", "last_observations", "last_turns", "steps",
        "turns", "by_rule", "known", "action_masks", "times", "elapsed",
    )  # fmt: skip
    return Trajectories(
        **{name: together(name) for name in same},
        starts=np.concatenate([part.starts + first_rows[number] for number, part in filled]),
        episodes=np.concatenate([part.episodes + first_episodes[number] for number, part in filled]),
        seeds=seeds,
        agents=np.concatenate([np.array([codes[name] for name in part.names])[part.agents] for _, part in filled]),
        names=tuple(codes),
        extras={name: joined([part.extras[name] for _, part in filled]) for name in filled[0][1].extras},
        observation_space=filled[0][1].observation_space,
        action_space=filled[0][1].action_space,
        collected=collected,
    )


# -- while episodes run ---------------------------------------------------------------------------


@dataclass
class _Life:
    """The record of one trajectory. If its episode fails, the trajectory has no end.

    Attributes:
        page: The page that has its decisions.
        number: The number of the trajectory on the page.
        policy: The place of its policy.
        episode: The place of its episode.
        first_turn, last_turn: The number of decisions in the episode when the trajectory began, and when it ended.
        name: The name of its agent.
        row: The row of its latest decision.
        steps: The number of its decisions so far.
        last_observation: Its final observation.
        terminated, truncated: How it ended.
    """

    page: "_Page"
    number: int
    policy: int
    episode: int
    first_turn: int
    name: str
    last_turn: int = -1
    row: int = -1
    steps: int = 0
    last_observation: Any = None
    terminated: bool = False
    truncated: bool = False


class _Page:
    """The records of one group: rows in the order of the answers, trajectories in the order of their beginnings."""

    def __init__(self, group: Group) -> None:
        definition = group.point.definition
        self.point = group.point
        self.restricted = group.point.legal is not None
        self.stack = stacker(definition.observation_space)
        self.stack_actions = stacker(definition.action_space)
        self.blank = blank(definition.action_space)
        self.asked = group.asked
        # One entry per row, or one per batch of answers.
        self.observations: list[Any] = []
        self.actions: list[Any] = []
        self.masks: list[Any] = []
        self.extras: list[dict[str, NDArray[Any]]] = []
        self.trajectory: list[int] = []
        self.steps: list[int] = []
        self.turns: list[int] = []
        self.by_rule: list[bool] = []
        self.rule_actions: dict[int, Any] = {}  # by row; only those that are known
        self.times: list[float] = []
        self.rewards: list[float] = []
        self.elapsed: list[float] = []
        self.lives: list[_Life] = []

    def begin(self, place: int, episode: Episode, agent: Agent) -> _Life:
        """Begin the trajectory of an agent."""
        life = _Life(self, len(self.lives), agent.policy.place, place, episode.turns, agent.name)
        self.lives.append(life)
        return life

    def all_actions(self) -> Any:
        """Return the actions of all rows."""
        actions = joined(self.actions)
        if not self.rule_actions:
            return actions
        rows = np.arange(len(self.rewards))
        places = list(self.rule_actions)
        rows[places] = len(rows) + np.arange(len(places))
        return taken(joined([actions, self.stack_actions(list(self.rule_actions.values()))]), rows)


class Ledger:
    """Records the decisions of episodes while they run."""

    def __init__(self) -> None:
        self._pages: list[_Page] = []

    def asking(self, group: Group, places: Sequence[int], waiting: Sequence[Episode], observations: Any) -> None:
        """Record the decisions that are about to be answered: see ``Watcher``."""
        page: _Page = group.book
        if page is None:
            page = group.book = _Page(group)
            self._pages.append(page)
        row = len(page.rewards)
        trajectories, steps, turns = page.trajectory, page.steps, page.turns
        agents: list[Any] = [episode.pending for episode in waiting]
        for place, episode, agent in zip(places, waiting, agents, strict=True):
            life = agent.notes
            if life is None:
                life = agent.notes = page.begin(place, episode, agent)
            life.row = row
            trajectories.append(life.number)
            steps.append(life.steps)
            turns.append(episode.turns)
            life.steps += 1
            row += 1
        page.observations.append(observations)
        page.rewards.extend([0.0] * len(agents))
        page.elapsed.extend([nan] * len(agents))
        if page.restricted:
            page.masks.append(stack_masks([agent.mask for agent in agents]))
        if waiting[0].clock is not None:
            page.times.extend([agent.now for agent in agents])  # the policy may have been given the info

    def answered(self, group: Group, actions: list[Any], extras: Mapping[str, Any]) -> None:
        """Record the answers: see ``Watcher``."""
        page: _Page = group.book
        by_rule = [action is RULE for action in actions]
        if True in by_rule:
            actions = [page.blank if action is RULE else action for action in actions]
        page.by_rule += by_rule
        page.actions.append(page.stack_actions(actions))
        # Copied because policies may reuse their arrays; in two steps because np.array cannot copy every tensor.
        arrays = {str(name): np.array(np.asarray(values)) for name, values in extras.items()}
        for name, array in arrays.items():
            if not array.ndim or len(array) != len(actions):
                raise OptionValueError(
                    f"{page.asked!r} returned {short_repr(name)} of shape {array.shape} for"
                    f" {len(actions)} decisions; the"
                    " length of its first axis must be their number"
                )
        page.extras.append(arrays)

    def moved(self, episode: Episode) -> None:
        """Record the reward when an episode reaches its next decision or its end: see ``Watcher``."""
        if episode.pending is not None:
            self._pay(episode.pending)
        for agent in episode.just_ended:
            self._close(agent, episode.turns, terminated=True, truncated=False)
        episode.just_ended = []
        if episode.over:
            for agent in episode.agents.values():
                self._close(agent, episode.turns, terminated=episode.terminated, truncated=episode.truncated)

    def _pay(self, agent: Agent) -> None:
        """Record the reward of the agent's latest action."""
        life = agent.notes
        if life is None:  # it has not decided before
            return
        page, row = life.page, life.row
        page.rewards[row] = agent.reward
        page.elapsed[row] = agent.info.get("elapsed", nan)
        if agent.rule_action is not None:
            page.rule_actions[row], agent.rule_action = agent.rule_action, None

    def _close(self, agent: Agent, turns: int, *, terminated: bool, truncated: bool) -> None:
        self._pay(agent)
        life = agent.notes
        if life is not None:
            life.last_observation, life.last_turn = agent.observation, turns
            life.terminated, life.truncated = terminated, truncated

    # -- afterwards -------------------------------------------------------------------------------

    def trajectories(self, plan: Plan, keys: Mapping[Any, int], seeds: Sequence[int]) -> dict[int, Trajectories]:
        """Return the recorded trajectories, by the place of their policy.

        Args:
            plan: The plan of the episodes.
            keys: The places of the policies, by their keys.
            seeds: The seeds of the episodes.

        Raises:
            AgentError: One policy key answered at several points whose spaces differ.
            OptionValueError: A policy did not always return the same extras.
        """
        found: dict[int, Trajectories] = {}
        pages = [_Sorted(page) for page in self._pages]
        for key, place in keys.items():
            own = [page for page in pages if (page.policies == place).any()]
            if len(own) > 1:
                raise AgentError(
                    f"{short_repr(key)} has decided at"
                    f" {' and at '.join(page.page.point.point.name for page in own)}, whose"
                    " spaces differ; give its policy under the names of the points"
                )
            tuple_of_seeds = tuple(seeds)
            found[place] = own[0].of(place, tuple_of_seeds) if own else _nothing(plan, place, tuple_of_seeds)
        return found


class _Sorted:
    """A page whose rows are sorted as learners get them, to be selected by policy."""

    def __init__(self, page: "_Page") -> None:
        _check_extras(page.extras)
        self.page, lives = page, page.lives
        self.policies = np.array([life.policy for life in lives])
        self.episodes = np.array([life.episode for life in lives])
        self.trajectory, self.steps = np.array(page.trajectory), np.array(page.steps)
        self.trajectories = np.lexsort((np.array([life.first_turn for life in lives]), self.episodes))
        ranks = np.argsort(self.trajectories)
        self.rows = np.lexsort((self.steps, ranks[self.trajectory]))
        self.observations, self.actions = joined(page.observations), page.all_actions()
        self.masks = joined(page.masks) if page.masks else None
        self.extras = {name: joined([extras[name] for extras in page.extras]) for name in page.extras[0]}
        self.numbers = {
            "rewards": np.array(page.rewards, np.float64),
            "turns": np.array(page.turns, np.int64),
            "by_rule": np.array(page.by_rule, np.bool_),
            "known": ~np.array(page.by_rule, np.bool_),
        }
        self.numbers["known"][np.array(list(page.rule_actions), np.int64)] = True
        if page.times:
            self.numbers["times"] = np.array(page.times, np.float64)
            self.numbers["elapsed"] = np.array(page.elapsed, np.float64)
        last_rows = [life.row for life in lives]
        for name in ("terminations", "truncations"):
            self.numbers[name] = np.zeros(len(self.steps), np.bool_)
        self.numbers["terminations"][last_rows] = [life.terminated for life in lives]
        self.numbers["truncations"][last_rows] = [life.truncated for life in lives]

    def of(self, policy: int, seeds: tuple[int, ...]) -> Trajectories:
        page = self.page
        rows = self.rows[self.policies[self.trajectory[self.rows]] == policy]
        trajectories = self.trajectories[self.policies[self.trajectories] == policy]
        lives = [page.lives[trajectory] for trajectory in trajectories]
        codes = {name: code for code, name in enumerate(dict.fromkeys(life.name for life in lives))}
        agents = np.zeros(len(page.lives), np.int64)
        agents[trajectories] = [codes[life.name] for life in lives]
        steps = self.steps[rows]
        return Trajectories(
            observations=taken(self.observations, rows),
            actions=taken(self.actions, rows),
            last_observations=page.stack([life.last_observation for life in lives]),
            last_turns=np.array([life.last_turn for life in lives], np.int64),
            starts=np.flatnonzero(steps == 0),
            episodes=self.episodes[self.trajectory[rows]],
            seeds=seeds,
            agents=agents[self.trajectory[rows]],
            names=tuple(codes),
            steps=steps,
            action_masks=None if self.masks is None else taken(self.masks, rows),
            extras=taken(self.extras, rows),
            observation_space=page.point.definition.observation_space,
            action_space=page.point.definition.action_space,
            **{name: array[rows] for name, array in self.numbers.items()},
        )


def _check_extras(extras: Sequence[Mapping[str, Any]]) -> None:
    for other in extras:
        if other.keys() != extras[0].keys():
            raise OptionValueError(
                f"a policy returned {sorted(extras[0])} beside its actions, but later {sorted(other)}; it must return"
                " the same names in every call"
            )


def _nothing(plan: Plan, place: int, seeds: tuple[int, ...]) -> Trajectories:
    """Return the empty trajectories of a policy that was never asked."""
    point = next((point for point in plan.points if answers(plan, point, place)), None)
    definition = None if point is None else point.definition
    floats, whole, flags = np.zeros(0), np.zeros(0, np.int64), np.zeros(0, np.bool_)
    none: dict[str, Any] = {
        **dict.fromkeys(("last_turns", "starts", "episodes", "agents", "steps", "turns"), whole),
        **dict.fromkeys(("terminations", "truncations", "by_rule", "known"), flags),
    }
    observations = floats if definition is None else empty(definition.observation_space)
    return Trajectories(
        observations=observations,
        actions=floats if definition is None else empty(definition.action_space),
        last_observations=observations,
        rewards=floats,
        seeds=seeds,
        names=(),
        observation_space=None if definition is None else definition.observation_space,
        action_space=None if definition is None else definition.action_space,
        **none,
    )


def answers(plan: Plan, point: Point, place: int) -> bool:
    """Return whether it is known beforehand that the policy at this place answers at a decision point."""
    policy = point.policy if point.agent is None else plan.policies.get(point.agent, point.policy)
    return isinstance(policy, PolicyKey) and policy.place == place
