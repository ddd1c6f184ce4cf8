"""What learners want to know of many episodes: who decided what, on what observation, and what came of it.

While the episodes run, a *ledger* has a page for each group of decisions, on which they stand in the order in which
they were answered. What learners get are the same rows by policy, episode, agent and step, whatever that order was.
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
from ..core.bound import BoundPoint
from ..core.episode import Episode
from ..core.plan import Plan
from ..core.spaces import blank
from ..core.stacking import empty, joined, stack_masks, stacker, taken
from ..errors import AgentError, OptionValueError, shown
from ..simulation import RULE
from .batch import Group, PolicyKey

# -- what learners get ----------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Trajectories:
    """What the agents that one policy answers for have lived through, in one or many episodes. Immutable.

    There are N rows, one for each decision, and M trajectories, one for each agent in each episode in which it has
    decided. The rows of a trajectory follow each other in the order of its decisions; trajectories stand in the order
    of the episodes and, within one, in that of their first decisions. Where spaces are ``Dict`` or ``Tuple``, there is
    a dict or a tuple of arrays in place of one array; where they have no shape (text, graphs, ...), arrays of objects.

    Attributes:
        observations: ``(N, *shape)``, in the dtype of the observation space: what was decided on.
        actions: ``(N, *shape)``, in the dtype of the action space: what was decided. Where it was left to the rule, the
            action that the rule's decision corresponds to, by ``rule_action_mapping`` or, without one, by ``choices``
            or a dict ``action_space_mapping``; zero where that is not known.
        rewards: ``(N,)`` float64: of that action, as an AEC environment has it.
        terminations: ``(N,)`` bool: whether it was the agent's last one, and its episode then ended.
        truncations: ``(N,)`` bool: whether it was the agent's last one, and its episode then was truncated.
        last_observations: ``(M, *shape)``: what each trajectory has come to, to value what is still to come where it
            was truncated.
        last_turns: ``(M,)`` int64: how many decisions the episode had seen when the trajectory ended, in the numbers of
            ``turns``.
        starts: ``(M,)`` int64: in which row each trajectory begins.
        episodes: ``(N,)`` int64: the number of the episode, which is the place of its seed among the seeds.
        seeds: The seeds of all episodes: row i is of ``seeds[episodes[i]]``.
        agents: ``(N,)`` int64: whose decision it was, as a place in ``names``.
        names: The names of the agents, in the order in which they appear.
        steps: ``(N,)`` int64: the number of the decision in its trajectory, from 0.
        turns: ``(N,)`` int64: its number among those of all agents of all policies in the episode, from 0.
        by_rule: ``(N,)`` bool: whether the policy has left it to the model's rule.
        known: ``(N,)`` bool: whether ``actions`` has what was decided.
        action_masks: ``(N, n)`` int8, for a ``MultiDiscrete`` a tuple of such: the legal actions. None where all are.
        times: ``(N,)`` float64: the simulation's time at the decision. None where it has no clock.
        elapsed: ``(N,)`` float64: how much time has gone by until the reward was known, at the agent's next decision or
            its end. None where there is no clock.
        extras: By name, ``(N, ...)``: what else the policy has returned of each decision.
        observation_space, action_space: Of the decision point. None where no agent has decided, and it is not known
            at which point they would have.
        collected: What ``collect`` has returned of each episode's simulation, in the order of the seeds. None where it
            was not asked for.
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
        """N, the number of decisions."""
        return len(self.rewards)

    def __repr__(self) -> str:
        return (
            f"<Trajectories: {len(self)} decisions in {len(self.starts)} trajectories of {len(self.names)} agents,"
            f" {len(self.seeds)} episodes>"
        )

    @cached_property
    def lengths(self) -> NDArray[np.int64]:
        """``(M,)`` int64: how many decisions each trajectory has."""
        return np.diff(self.starts, append=len(self))

    @cached_property
    def returns(self) -> NDArray[np.float64]:
        """``(M,)`` float64: the sum of the rewards of each trajectory, none of them discounted."""
        return np.add.reduceat(self.rewards, self.starts) if len(self) else np.zeros(0)

    @cached_property
    def next_observations(self) -> Any:
        """``(N, *shape)``: what the agent observed next, at its next decision or its end."""
        if not len(self):
            return self.observations
        number = len(self)
        following = np.arange(1, number + 1)
        following[self.starts[1:] - 1] = number + np.arange(len(self.starts) - 1)
        following[-1] = number + len(self.starts) - 1
        return taken(joined([self.observations, self.last_observations]), following)


def merged(parts: Sequence[Trajectories]) -> Trajectories:
    """One after the other, the trajectories of one policy in several lots of episodes."""
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
    """What is noted of one trajectory, which stays without an end where its episode fails.

    Attributes:
        page: The page on which its decisions stand.
        number: Its number on the page.
        policy: The place of its policy.
        episode: The place of its episode.
        first_turn, last_turn: How many decisions the episode had seen when it began, and when it ended.
        name: The name of its agent.
        row: Where its latest decision stands.
        steps: How many decisions there have been.
        last_observation: What it has come to.
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
    """What is noted of one group: rows in the order of their answers, and trajectories in that of their beginnings."""

    def __init__(self, group: Group) -> None:
        definition = group.point.definition
        self.point = group.point
        self.restricted = group.point.legal is not None
        self.stack = stacker(definition.observation_space)
        self.stack_actions = stacker(definition.action_space)
        self.blank = blank(definition.action_space)
        self.asked = group.asked
        # Of rows, or of as many at a time as were answered at once.
        self.observations: list[Any] = []
        self.actions: list[Any] = []
        self.masks: list[Any] = []
        self.extras: list[dict[str, NDArray[Any]]] = []
        self.trajectory: list[int] = []
        self.steps: list[int] = []
        self.turns: list[int] = []
        self.by_rule: list[bool] = []
        self.rule_actions: dict[int, Any] = {}  # by row, as far as they are known
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
        """What was decided, in all rows."""
        actions = joined(self.actions)
        if not self.rule_actions:
            return actions
        rows = np.arange(len(self.rewards))
        places = list(self.rule_actions)
        rows[places] = len(rows) + np.arange(len(places))
        return taken(joined([actions, self.stack_actions(list(self.rule_actions.values()))]), rows)


class Ledger:
    """What is noted of episodes while they run."""

    def __init__(self) -> None:
        self._pages: list[_Page] = []

    def asking(self, group: Group, places: Sequence[int], waiting: Sequence[Episode], observations: Any) -> None:
        """Decisions are going to be answered: see ``Watcher``."""
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
        """They have been: see ``Watcher``."""
        page: _Page = group.book
        by_rule = [action is RULE for action in actions]
        if True in by_rule:
            actions = [page.blank if action is RULE else action for action in actions]
        page.by_rule += by_rule
        page.actions.append(page.stack_actions(actions))
        # Copied, for policies may use their arrays again; in two steps, for tensors cannot be copied in one.
        arrays = {str(name): np.array(np.asarray(values)) for name, values in extras.items()}
        for name, array in arrays.items():
            if not array.ndim or len(array) != len(actions):
                raise OptionValueError(
                    f"{page.asked!r} has returned {shown(name)} of shape {array.shape} for {len(actions)} decisions;"
                    " the first axis is to count them"
                )
        page.extras.append(arrays)

    def moved(self, episode: Episode) -> None:
        """An episode stands at its next decision, or is over: see ``Watcher``."""
        if episode.pending is not None:
            self._pay(episode.pending)
        for agent in episode.just_ended:
            self._close(agent, episode.turns, terminated=True, truncated=False)
        episode.just_ended = []
        if episode.over:
            for agent in episode.agents.values():
                self._close(agent, episode.turns, terminated=episode.terminated, truncated=episode.truncated)

    def _pay(self, agent: Agent) -> None:
        """Note what an agent's latest action has brought."""
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
        """What has been noted, by the places of the policies.

        Args:
            plan: The plan of the episodes.
            keys: The keys of the policies, with their places.
            seeds: Of the episodes.

        Raises:
            AgentError: One agent has decided at several points.
            OptionValueError: A policy has returned something else besides actions now and then.
        """
        found: dict[int, Trajectories] = {}
        pages = [_Sorted(page) for page in self._pages]
        for key, place in keys.items():
            own = [page for page in pages if (page.policies == place).any()]
            if len(own) > 1:
                raise AgentError(
                    f"{shown(key)} has decided at {' and at '.join(page.page.point.point.name for page in own)}, whose"
                    " spaces differ; give its policy under the names of the points"
                )
            tuple_of_seeds = tuple(seeds)
            found[place] = own[0].of(place, tuple_of_seeds) if own else _nothing(plan, place, tuple_of_seeds)
        return found


class _Sorted:
    """A page, for its rows to be taken by policy, in the order in which learners get them."""

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
                f"a policy has returned {sorted(extras[0])} beside its actions, and another time {sorted(other)}; it is"
                " to return the same at every time"
            )


def _nothing(plan: Plan, place: int, seeds: tuple[int, ...]) -> Trajectories:
    """What there is to know of a policy that was never asked."""
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


def answers(plan: Plan, point: BoundPoint, place: int) -> bool:
    """Whether it is known beforehand that a policy, by its place, answers at a decision point."""
    policy = point.policy if point.agent is None else plan.policies.get(point.agent, point.policy)
    return isinstance(policy, PolicyKey) and policy.place == place
