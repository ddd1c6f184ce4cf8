"""The parallel view: what becomes of the actions of a round."""

import warnings
from collections import Counter
from functools import cache

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import data_equivalence
from hypothesis import given, settings
from hypothesis import strategies as st
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test
from pettingzoo.utils.conversions import parallel_to_aec, turn_based_aec_to_parallel

from simenv_marl import RULE, TRUNCATED, aec_env, difference, generate_env, parallel_env
from simenv_marl.envs import pad_agents
from simenv_marl.errors import (
    AgentError,
    ClosedError,
    EpisodeOverError,
    InvalidActionError,
    MaskError,
    NoDecisionError,
    NotResetError,
    ReentrancyError,
    ResetNeededError,
    RewardError,
    UnknownAgentError,
)
from tests.worlds import worlds
from tests.worlds.many_worlds import (
    HERE,
    NAMES_OF_THE_VILLAGE,
    Announcing,
    Answered,
    Being,
    Village,
    answer,
    being_of,
    beings,
    colony,
    colony_points,
    designs,
    seeds,
)
from tests.worlds.models import Script, calling, decision, define, notes, script


def points(number=2, **changes):
    """Decision functions of so many agents, ``ant_0``, ``bee_0`` and so on."""
    return [decision(agent=f"{name}_0", **changes) for name in ("ant", "bee", "cat", "dog")[:number]]


def flags(results):
    """By agent: terminated, truncated."""
    return {agent: (results[2][agent], results[3][agent]) for agent in results[2]}


def told(results, key):
    """By agent, what the infos say under a key."""
    return {agent: info[key] for agent, info in results[-1].items()}


def acted(results):
    """The agents whose actions were used."""
    return {agent for agent, used in told(results, "acted").items() if used}


def deciding(results):
    """The agents whose decisions are pending."""
    return [agent for agent, pending in told(results, "deciding").items() if pending]


# -- the rule of rounds ---------------------------------------------------------------------------


def test_all_actions_at_once():
    ant, bee = points()
    env = parallel_env(calling(ant, bee, ant, bee), [ant, bee])
    observations, infos = env.reset(seed=1)
    assert set(observations) == set(infos) == {"ant_0", "bee_0"} == set(env.agents) == set(env.possible_agents)
    assert infos["ant_0"] == {"deciding": True, "acted": False}
    assert infos["bee_0"] == {"deciding": False, "acted": False}
    results = env.step({"bee_0": 2, "ant_0": 1})
    assert env.simulation.log == [1, 2]
    assert acted(results) == {"ant_0", "bee_0"}
    assert deciding(results) == ["ant_0"]
    results = env.step({"ant_0": 3, "bee_0": 4})
    assert env.simulation.log == [1, 2, 3, 4]
    assert env.agents == []
    assert flags(results) == {"ant_0": (True, False), "bee_0": (True, False)}
    assert deciding(results) == []


def test_one_action_at_a_time():
    ant, bee = points()
    env = parallel_env(calling(ant, bee, bee, ant), [ant, bee])
    _, infos = env.reset()
    order = []
    while env.agents:
        agent = next(agent for agent in env.agents if infos[agent]["deciding"])
        order.append(agent)
        *_, infos = results = env.step({agent: len(order)})
        assert acted(results) == {agent}
    assert order == ["ant_0", "bee_0", "bee_0", "ant_0"]
    assert env.simulation.log == [1, 2, 3, 4]


def test_an_action_is_used_once():
    ant, bee = points()
    env = parallel_env(calling(ant, ant, bee), [ant, bee])
    env.reset()
    results = env.step({"ant_0": 1, "bee_0": 2})
    assert env.simulation.log == [1]
    assert acted(results) == {"ant_0"}
    assert deciding(results) == ["ant_0"]
    results = env.step({"ant_0": 3, "bee_0": 4})  # the action of the step before is forgotten
    assert env.simulation.log == [1, 3, 4]


def test_a_missing_action_ends_the_round():
    ant, bee, cat = points(3)
    env = parallel_env(calling(ant, bee, cat, ant), [ant, bee, cat])
    env.reset()
    results = env.step({"ant_0": 1, "cat_0": 3})
    assert env.simulation.log == [1]
    assert acted(results) == {"ant_0"}
    assert deciding(results) == ["bee_0"]
    results = env.step({"bee_0": 2})
    assert env.simulation.log == [1, 2]
    assert deciding(results) == ["cat_0"]


def test_nothing_moves_without_the_action_that_is_needed():
    ant, bee = points()
    env = parallel_env(calling(ant, bee), [ant, bee])
    env.reset()
    for actions in ({}, {"bee_0": 2}):
        results = env.step(actions)
        assert env.simulation.log == []
        assert acted(results) == set()
        assert deciding(results) == ["ant_0"]
        assert env.agents == ["ant_0", "bee_0"]
    env.step({"ant_0": 1, "bee_0": 5})
    assert env.simulation.log == [1, 5]


def test_whoever_is_not_called_has_not_acted():
    ant, bee = points()
    env = parallel_env(calling(ant, ant, ant), [ant, bee])
    env.reset()
    for number in range(2):
        results = env.step({"ant_0": number, "bee_0": 9})
        assert acted(results) == {"ant_0"}
    results = env.step({"ant_0": 2, "bee_0": 9})
    assert flags(results) == {"ant_0": (True, False), "bee_0": (True, False)}
    assert env.simulation.log == [0, 1, 2]


class Board:
    """Everybody writes on it and sees what stands there."""

    def __init__(self):
        self.moves = []

    def reset(self, seed=None):
        self.moves = []

    def run(self):
        for _ in range(2):
            for agent in ("ant", "bee"):
                self.moves.append(getattr(self, agent)())

    def ant(self):
        return 8

    def bee(self):
        return 9

    def last_two(self):
        return [0, 0, *self.moves][-2:]


class Announced(Board):
    def expected_calls(self, point):
        return [(self,)]


def boards(**changes):
    changes = {"observation_space_mapping": Board.last_two, "reward_mapping": lambda board: sum(board.moves)} | changes
    return {Board.ant: define(agent="ant_0", **changes), Board.bee: define(agent="bee_0", **changes)}


def test_nobody_sees_the_others_moves_of_the_round():
    seen = []

    def look(board):
        seen.append(list(board.moves))
        return board.last_two()

    env = parallel_env(Announced, boards(observation_space_mapping=look))
    observations, _ = env.reset()
    assert [observation.tolist() for observation in observations.values()] == [[0, 0], [0, 0]]
    observations, *_ = env.step({"ant_0": 1, "bee_0": 2})
    assert [observation.tolist() for observation in observations.values()] == [[1, 2], [1, 2]]
    assert [1] not in seen
    env.step({"ant_0": 3, "bee_0": 4})
    assert {tuple(moves) for moves in seen} == {(), (1, 2), (1, 2, 3, 4)}


def test_in_turns_everybody_sees_the_moves_before():
    env = parallel_env(Board, boards())
    observations, _ = env.reset()
    assert observations["bee_0"].tolist() == [0, 0]
    observations, *_ = env.step({"ant_0": 1})
    assert observations["bee_0"].tolist() == [0, 1]
    assert observations["ant_0"].tolist() == [0, 1]
    observations, *_ = env.step({"bee_0": 2})
    assert observations["ant_0"].tolist() == [1, 2]


def test_rule_for_some():
    env = parallel_env(Board, boards())
    env.reset()
    env.step({"ant_0": RULE, "bee_0": 2})
    assert env.simulation.moves == [8, 2]
    results = env.step({"ant_0": 1, "bee_0": RULE})
    assert env.simulation.moves == [8, 2, 1, 9]
    assert acted(results) == {"ant_0", "bee_0"}


def test_rule_for_all():
    """``RULE`` is an action of every view."""
    env = parallel_env(Board, boards())
    env.reset()
    env.step(RULE)
    assert env.simulation.moves == [8, 9]


def test_policies_answer_within_a_round():
    ant, bee, cat = points(3)
    env = parallel_env(calling(ant, bee, cat, ant), [ant, bee, cat], policies={"bee_0": lambda observation: 7})
    env.reset()
    assert env.possible_agents == ["ant_0", "cat_0"]
    env.step({"ant_0": 1, "cat_0": 3})
    assert env.simulation.log == [1, 7, 3]


def test_a_decision_within_a_decision():
    inner = decision(agent="inner_0")
    outer = decision(lambda: inner() + 1, agent="outer_0")
    env = parallel_env(calling(outer), [outer, inner])
    env.reset()
    results = env.step({"outer_0": RULE, "inner_0": 5})
    assert env.simulation.log == [6]
    assert acted(results) == {"outer_0", "inner_0"}


# -- actions that are refused ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("actions", "error"),
    [
        ({"ant_0": 1, "nobody": 1}, UnknownAgentError),
        ({"nobody": 1}, UnknownAgentError),
        ({"ant_0": 1, 0: 1}, UnknownAgentError),
        ({"ant_0": 10, "bee_0": 1}, InvalidActionError),
        ({"ant_0": 1, "bee_0": 10}, InvalidActionError),
        ({"ant_0": 1, "bee_0": None}, InvalidActionError),
        ({"ant_0": None}, InvalidActionError),
        ({"ant_0": 1, "bee_0": 1.5}, InvalidActionError),
        ({"ant_0": 1, "bee_0": "1"}, InvalidActionError),
        ({"ant_0": 1, "bee_0": np.array([1])}, InvalidActionError),
    ],
)
def test_what_is_refused_moves_nothing(actions, error):
    calls = []
    ant, bee = points(reward_mapping=lambda: calls.append(0) or 1.0)
    env = parallel_env(calling(ant, bee, ant), [ant, bee])
    env.reset()
    del calls[:]
    with pytest.raises(error):
        env.step(actions)
    assert env.simulation.log == []
    assert calls == []
    assert env.agents == ["ant_0", "bee_0"]
    results = env.step({"ant_0": 1, "bee_0": 2})
    assert env.simulation.log == [1, 2]
    assert acted(results) == {"ant_0", "bee_0"}


@pytest.mark.parametrize("actions", [None, 3, "ant_0", [1, 2]])
def test_what_is_no_dict_moves_nothing(actions):
    ant, bee = points()
    env = parallel_env(calling(ant, bee), [ant, bee])
    env.reset()
    with pytest.raises(InvalidActionError, match="takes a dict of actions"):
        env.step(actions)
    assert env.simulation.log == []
    env.step({"ant_0": 1, "bee_0": 2})
    assert env.simulation.log == [1, 2]


def test_an_action_of_the_dead_is_refused():
    def main(simulation):
        simulation.beings = one, two = Being(0), Being(1)
        one.act()
        two.act()
        one.leave()
        simulation.log.append(two.act())
        simulation.log.append(two.act())

    env = parallel_env(script(main), beings(), possible_agents=["being_0", "being_1"])
    env.reset()
    env.step({"being_0": 1, "being_1": 1})
    assert env.agents == ["being_1"]
    with pytest.raises(UnknownAgentError, match="being_0"):
        env.step({"being_0": 1, "being_1": 1})
    assert env.simulation.log == []
    env.step({"being_1": 4})
    assert env.simulation.log == [4]


def test_a_masked_action_of_the_one_who_decides_is_refused():
    ant, bee = points(action_mask_mapping=lambda: [1] * 5 + [0] * 5)
    env = parallel_env(calling(ant, bee, ant), [ant, bee])
    _, infos = env.reset()
    assert infos["ant_0"]["action_mask"].tolist() == [1] * 5 + [0] * 5
    assert infos["ant_0"]["action_mask"].dtype == np.int8
    with pytest.raises(InvalidActionError, match="mask"):
        env.step({"ant_0": 5, "bee_0": 1})
    assert env.simulation.log == []
    env.step({"ant_0": 4, "bee_0": 4})
    assert env.simulation.log == [4, 4]


def test_an_action_that_becomes_illegal_by_its_turn_counts_as_missing():
    def free(board):
        return [number not in board.moves for number in range(10)]

    env = parallel_env(Announced, boards(action_mask_mapping=free))
    _, infos = env.reset()
    assert infos["bee_0"]["action_mask"].tolist() == [1] * 10
    results = env.step({"ant_0": 3, "bee_0": 3})
    assert env.simulation.moves == [3]
    assert acted(results) == {"ant_0"}
    assert deciding(results) == ["bee_0"]
    mask = results[-1]["bee_0"]["action_mask"]
    assert mask.tolist() == [1, 1, 1, 0, 1, 1, 1, 1, 1, 1]
    assert mask is not results[-1]["ant_0"]["action_mask"]
    with pytest.raises(InvalidActionError, match="is masked"):
        env.step({"bee_0": 3})
    env.step({"bee_0": 4, "ant_0": RULE})
    assert env.simulation.moves == [3, 4, 8]


def test_an_action_that_becomes_legal_by_its_turn_is_used():
    def after(board):
        return [True] + [len(board.moves) > 0] * 9

    env = parallel_env(Board, boards(action_mask_mapping=after))
    env.reset()
    results = env.step({"ant_0": 0, "bee_0": 5})
    assert env.simulation.moves == [0, 5]
    assert acted(results) == {"ant_0", "bee_0"}


def test_choices_of_a_round():
    """An index into the list that the call brings; one beyond its end counts as missing."""

    class Draft:
        def reset(self):
            self.left, self.picked = ["axe", "bow", "cap"], []

        def run(self):
            while self.left:
                for pick in (self.ant, self.bee):
                    if self.left:
                        item = pick(self.left)
                        self.left.remove(item)
                        self.picked.append(item)

        def ant(self, left):
            return left[0]

        def bee(self, left):
            return left[-1]

        def expected_calls(self, point):
            return [(self, self.left)]

    changes = {
        "choices": lambda draft, left: left,
        "action_space": spaces.Discrete(3),
        "reward_mapping": lambda draft, left: 0.0,
    }
    points = {Draft.ant: define(agent="ant_0", **changes), Draft.bee: define(agent="bee_0", **changes)}
    env = parallel_env(Draft, points)
    _, infos = env.reset()
    assert infos["bee_0"]["action_mask"].tolist() == [1, 1, 1]
    results = env.step({"ant_0": 1, "bee_0": 2})
    assert env.simulation.picked == ["bow"]
    assert deciding(results) == ["bee_0"]
    assert results[-1]["bee_0"]["action_mask"].tolist() == [1, 1, 0]
    with pytest.raises(InvalidActionError, match="is masked"):
        env.step({"bee_0": 2})
    env.step({"bee_0": 1, "ant_0": 0})
    assert env.simulation.picked == ["bow", "cap", "axe"]
    assert env.agents == []


@pytest.mark.parametrize("mask", [[0] * 10, [1] * 9, [2] * 10, [[1] * 10]])
def test_a_mask_that_cannot_be_ends_the_episode(mask):
    moved = []
    ant = decision(
        agent="ant_0",
        action_space_mapping=moved.append,
        action_mask_mapping=lambda: mask if moved else [1] * 10,
    )
    env = parallel_env(calling(ant, ant, ant), ant)
    env.reset()
    with pytest.raises(MaskError, match="mask"):
        env.step({"ant_0": 1})
    assert env.agents == []
    with pytest.raises(EpisodeOverError, match="begin the next one"):
        env.step({})


@pytest.mark.parametrize("padded", [False, True])
@pytest.mark.parametrize("end", [None, TRUNCATED])
def test_a_step_without_actions_after_the_end_brings_nothing(end, padded):
    """PettingZoo's own environments do so, and wrappers rely on it."""
    ant = decision(agent="ant_0")
    env = parallel_env(calling(ant, ends=end), ant)
    env = pad_agents(env) if padded else env
    env.reset()
    env.step({"ant_0": 1})
    assert env.step({}) == ({}, {}, {}, {}, {})
    with pytest.raises(EpisodeOverError, match="begin the next one"):
        env.step({"ant_0": 1})
    with pytest.raises(EpisodeOverError, match="begin the next one"):
        env.step(RULE)
    env.close()
    with pytest.raises(ClosedError):
        env.step({})


def test_masks_in_observations():
    space = spaces.Dict({"observation": spaces.Box(0, 9, (2,), np.float32), "action_mask": spaces.MultiBinary(10)})

    def free(board):
        return [number not in board.moves for number in range(10)]

    changes = {
        "observation_space": space,
        "observation_space_mapping": lambda board: {"observation": board.last_two()},
        "action_mask_mapping": free,
    }
    env = parallel_env(Announced, boards(**changes))
    observations, infos = env.reset()
    for _ in range(2):
        for agent in env.agents:
            assert observations[agent] in space
            assert observations[agent]["action_mask"].dtype == np.int8
            assert (observations[agent]["action_mask"] == infos[agent]["action_mask"]).all()
            assert observations[agent]["action_mask"] is not infos[agent]["action_mask"]
        observations, _, _, _, infos = env.step({"ant_0": 1, "bee_0": 2} if not env.simulation.moves else {})
    assert observations["ant_0"]["action_mask"].tolist() == [1, 0, 0, 1, 1, 1, 1, 1, 1, 1]


# -- rewards --------------------------------------------------------------------------------------


class Paid:
    """Who was asked for a reward at which moment."""

    def __init__(self):
        self.calls = []

    def point(self, name):
        return decision(agent=name, reward_mapping=lambda: self.calls.append(name) or float(len(self.calls)))


def test_rewards_are_asked_for_once_for_everybody_at_every_return():
    paid = Paid()
    ant, bee = paid.point("ant_0"), paid.point("bee_0")
    env = parallel_env(calling(ant, bee, ant, bee, ant), [ant, bee])
    env.reset()
    assert paid.calls == ["ant_0"]  # joining; nobody has seen the other
    results = env.step({"ant_0": 1})
    assert paid.calls == ["ant_0", "ant_0", "bee_0"]
    assert results[1] == {"ant_0": 2.0, "bee_0": 0.0}  # joining is not paid for
    results = env.step({"bee_0": 1, "ant_0": 1})
    assert paid.calls[3:] == ["ant_0", "bee_0"]
    assert results[1] == {"ant_0": 4.0, "bee_0": 5.0}
    results = env.step({})
    assert results[1] == {"ant_0": 6.0, "bee_0": 7.0}
    results = env.step({"bee_0": 1, "ant_0": 1})
    assert results[1] == {"ant_0": 8.0, "bee_0": 9.0}
    assert env.agents == []
    assert all(type(reward) is float for reward in results[1].values())


def test_who_acts_as_soon_as_it_is_seen_is_paid_for_it():
    paid = Paid()
    ant, bee = paid.point("ant_0"), paid.point("bee_0")
    env = parallel_env(calling(ant, bee, ant), [ant, bee])
    env.reset()
    results = env.step({"ant_0": 1, "bee_0": 1})
    assert paid.calls == ["ant_0", "bee_0", "ant_0", "bee_0"]
    assert results[1] == {"ant_0": 3.0, "bee_0": 4.0}


def test_announced_agents_are_paid_from_the_first_round():
    calls = Counter()

    def pay(board):
        calls[len(board.moves)] += 1
        return 1.0

    env = parallel_env(Announced, boards(reward_mapping=pay))
    env.reset()
    assert calls == {0: 2}
    results = env.step({"ant_0": 1})
    assert results[1] == {"ant_0": 1.0, "bee_0": 1.0}
    results = env.step({"bee_0": 1, "ant_0": 1})
    assert results[1] == {"ant_0": 1.0, "bee_0": 1.0}
    assert calls == {0: 2, 1: 2, 3: 2}


def test_differences_add_up_however_the_rounds_fall():
    def played(choose):
        worth = difference(lambda board: sum(board.moves))
        env = parallel_env(Announced, boards(reward_mapping=worth))
        _, infos = env.reset()
        totals = Counter()
        while env.agents:
            agents = choose(env.agents, infos)
            _, rewards, _, _, infos = env.step({agent: 1 + 3 * (agent == "bee_0") for agent in agents})
            totals.update(rewards)
        assert env.simulation.moves == [1, 4, 1, 4]
        return totals

    assert played(lambda agents, infos: agents) == {"ant_0": 10, "bee_0": 10}
    in_turns = played(lambda agents, infos: [agent for agent in agents if infos[agent]["deciding"]])
    assert in_turns == {"ant_0": 10, "bee_0": 10}


@pytest.mark.parametrize("reward", [np.inf, np.nan, None, "1", [1, 2], 1j])
def test_a_reward_that_is_none_ends_the_episode(reward):
    rewards = iter([0.0])
    ant = decision(agent="ant_0", reward_mapping=lambda: next(rewards, reward))
    env = parallel_env(calling(ant, ant, ant), ant)
    env.reset(seed=5)
    with pytest.raises(RewardError):
        env.step({"ant_0": 1})
    assert env.agents == []
    with pytest.raises(EpisodeOverError, match="begin the next one"):
        env.step({"ant_0": 1})


# -- births and deaths ----------------------------------------------------------------------------


def test_a_newborn_joins_at_the_return_that_its_decision_brings():
    def main(simulation):
        simulation.beings = one, two = Being(0), Being(1)
        for being in (one, two, one, two):
            simulation.log.append(being.act())

    env = parallel_env(script(main), beings())
    assert not hasattr(env, "possible_agents")
    observations, _ = env.reset()
    assert set(observations) == {"being_0"} == set(env.agents)
    results = env.step({"being_0": 1})
    assert env.agents == ["being_0", "being_1"]
    assert set(results[0]) == {"being_0", "being_1"}
    assert results[1] == {"being_0": 0.0, "being_1": 0.0}
    assert deciding(results) == ["being_1"]
    assert flags(results) == {"being_0": (False, False), "being_1": (False, False)}
    results = env.step({"being_0": 2, "being_1": 3})
    assert env.simulation.log == [1, 3, 2]
    assert deciding(results) == ["being_1"]


def test_an_action_for_one_who_has_not_joined_is_refused():
    def main(simulation):
        Being(0).act()
        Being(1).act()

    env = parallel_env(script(main), beings())
    env.reset()
    with pytest.raises(UnknownAgentError, match="not a live agent"):
        env.step({"being_0": 1, "being_1": 1})


def test_a_declared_agent_may_act_before_it_was_seen():
    def main(simulation):
        simulation.beings = one, two = Being(0), Being(1)
        for being in (one, two):
            being.health = 5
            simulation.log.append(being.act())
        one.act()

    env = parallel_env(script(main), beings(), possible_agents=["being_0", "being_1", "being_2"])
    observations, _ = env.reset()
    assert observations["being_1"].tolist() == [0, 0]
    results = env.step(dict.fromkeys(env.agents, 4))
    assert env.simulation.log == [4, 4]
    assert acted(results) == {"being_0", "being_1"}
    assert results[0]["being_1"].tolist() == [1, 5]
    assert results[1] == {"being_0": 5.0, "being_1": 5.0, "being_2": 0.0}
    results = env.step({"being_0": 4})
    assert flags(results) == dict.fromkeys(["being_0", "being_1", "being_2"], (True, False))


class Hive:
    """In each round everybody acts who lives; who is born is known before it acts."""

    def __init__(self, rounds=4):
        self.rounds = rounds

    def reset(self, seed=None):
        self.beings, self.tick, self.log = [Being(0), Being(1)], 0, []

    def run(self):
        for tick in range(self.rounds):
            self.tick = tick
            for being in list(self.beings):
                if being.whole:
                    being.health += 1
                    self.log.append((self.tick, being.number, being.act()))
            self.beings.append(Being(len(self.beings)))
            self.beings[self.tick].leave()

    def expected_calls(self, point):
        return [(being,) for being in self.beings if being.whole]


def test_with_calls_announced_there_is_one_round_for_each_tick():
    env = parallel_env(Hive, beings())
    env.reset()
    for tick in range(4):
        assert env.agents == [f"being_{number}" for number in range(tick, tick + 2)]
        results = env.step(dict.fromkeys(env.agents, tick))
        assert acted(results) == {f"being_{number}" for number in range(tick, tick + 2)}
        over = tick == 3
        assert flags(results)[f"being_{tick}"] == (True, False)
        assert flags(results)[f"being_{tick + 1}"] == (over, False)
        # The reward of a being is its health; whoever decides next has grown again; the newborn only joins.
        assert results[1][f"being_{tick}"] == (1.0 if tick == 0 else 2.0)
        assert results[1][f"being_{tick + 1}"] == (1.0 if over else 2.0)
        assert over or results[1][f"being_{tick + 2}"] == 0.0
    assert env.agents == []
    assert env.simulation.log == [(tick, number, tick) for tick in range(4) for number in (tick, tick + 1)]


def test_calls_are_asked_for_at_each_return_and_by_name():
    class Asked(Hive):
        def reset(self, seed=None):
            super().reset()
            self.asked = []

        def expected_calls(self, point):
            self.asked.append((point, self.tick))
            return super().expected_calls(point)

    env = parallel_env(Asked, beings())
    env.reset()
    for _ in range(3):
        env.step(dict.fromkeys(env.agents, 1))
    assert env.simulation.asked == [(f"{HERE}.Being.act", tick) for tick in range(4)]


def test_who_is_announced_several_times_observes_its_next_call():
    """Of the calls to come the first one is decided on next."""
    hour = define(agent="clerk_0", observation_space_mapping=lambda hour: [hour, 0], reward_mapping=lambda hour: 0.0)

    @hour
    def work(hour):
        return "rule"

    door = decision(agent="door_0")

    class Day:
        def reset(self):
            self.hours, self.log = [7, 8, 9], []

        def run(self):
            while self.hours:
                door()
                self.log.append((self.hours[0], work(self.hours.pop(0))))

        def expected_calls(self, point):
            return [(hour,) for hour in self.hours] if point.endswith("work") else []

    env = parallel_env(Day, [door, work])
    observations, _ = env.reset()
    told = []
    while env.agents:
        told.append(int(observations["clerk_0"][0]))
        observations, *_ = env.step({"door_0": 1, "clerk_0": 2})
    assert env.simulation.log == [(7, 2), (8, 2), (9, 2)]
    assert told == [7, 8, 9]


def test_the_dead_are_dropped_from_agents_in_the_same_step():
    def main(simulation):
        simulation.beings = one, two = Being(0), Being(1)
        one.act()
        two.act()
        one.health = 6
        one.leave()
        two.act()

    env = parallel_env(script(main), beings(), possible_agents=["being_0", "being_1"])
    env.reset()
    results = env.step({"being_0": 1, "being_1": 1})
    assert env.agents == ["being_1"]
    assert [set(part) for part in results] == [{"being_0", "being_1"}] * 5
    assert results[0]["being_0"].tolist() == [0, 6]
    assert results[1]["being_0"] == 6.0
    assert flags(results) == {"being_0": (True, False), "being_1": (False, False)}
    assert results[-1]["being_0"] == {"deciding": False, "acted": True}
    results = env.step({"being_1": 1})
    assert [set(part) for part in results] == [{"being_1"}] * 5


def test_who_dies_before_its_turn_has_not_acted():
    class Doomed(Hive):
        def run(self):
            one, two, three = self.beings
            one.act()
            two.health = 3
            two.leave()
            self.log.append(three.act())
            one.act()

        def reset(self, seed=None):
            super().reset()
            self.beings = [Being(number) for number in range(3)]

    env = parallel_env(Doomed, beings())
    env.reset()
    results = env.step({"being_0": 1, "being_1": 2, "being_2": 3})
    assert env.simulation.log == [3]
    assert acted(results) == {"being_0", "being_2"}
    assert results[1]["being_1"] == 3.0
    assert results[0]["being_1"].tolist() == [1, 3]
    assert env.agents == ["being_0", "being_2"]


def test_a_revived_agent_ends_the_episode():
    def main(simulation):
        simulation.beings = one, two = Being(0), Being(1)
        one.act()
        one.leave()
        two.act()
        one.whole = True
        one.act()

    env = parallel_env(script(main), beings())
    env.reset(seed=11)
    env.step({"being_0": 1})
    with pytest.raises(AgentError, match="after its end") as caught:
        env.step({"being_1": 1})
    assert "seed 11" in notes(caught.value)
    assert env.agents == []
    with pytest.raises(EpisodeOverError, match="begin the next one"):
        env.step({})
    observations, _ = env.reset()
    assert set(observations) == {"being_0"}


def test_whoever_is_announced_after_its_end_is_not_revived():
    def main(simulation):
        simulation.beings = one, two = Being(0), Being(1)
        one.act()
        one.leave()
        for _ in range(3):
            two.act()

    class Forgetful(Hive):
        def run(self):
            main(self)

        def expected_calls(self, point):
            return [(being,) for being in self.beings]

    env = parallel_env(Forgetful, beings())
    env.reset()
    for _ in range(2):
        env.step(dict.fromkeys(env.agents, 1))
        assert env.agents == ["being_1"]


def test_removed_in_mid_decision():
    def apply(action, being):
        being.health = action
        if action == 9:
            being.leave()

    env = parallel_env(Hive, beings(apply=apply))
    env.reset()
    results = env.step({"being_0": 9, "being_1": 4})
    assert results[1]["being_0"] == 9.0
    assert acted(results) == {"being_0", "being_1"}
    assert flags(results)["being_0"] == (True, False)
    assert env.agents == ["being_1", "being_2"]


def test_all_at_once_are_removed():
    def main(simulation):
        simulation.beings = crowd = [Being(number) for number in range(3)]
        for being in crowd:
            being.act()
        for being in crowd:
            being.leave()
        simulation.log.append("on and on")
        late = Being(7)
        late.act()

    env = parallel_env(script(main), beings(), possible_agents=[f"being_{number}" for number in (0, 1, 2, 7)])
    env.reset()
    results = env.step(dict.fromkeys(env.agents[:3], 1))
    assert flags(results) == dict.fromkeys(["being_0", "being_1", "being_2"], (True, False)) | {
        "being_7": (False, False)
    }
    assert env.agents == ["being_7"]
    results = env.step({"being_7": 1})
    assert flags(results) == {"being_7": (True, False)}


# -- ends -----------------------------------------------------------------------------------------


def test_the_simulation_may_say_that_it_is_truncated():
    ant, bee = points()
    env = parallel_env(calling(ant, bee, ends=TRUNCATED), [ant, bee])
    env.reset()
    results = env.step({"ant_0": 1, "bee_0": 1})
    assert flags(results) == {"ant_0": (False, True), "bee_0": (False, True)}
    assert all(type(flag) is bool for pair in flags(results).values() for flag in pair)


def test_the_removed_are_terminated_though_the_others_are_truncated():
    def main(simulation):
        simulation.beings = one, two = Being(0), Being(1)
        one.act()
        two.act()
        one.leave()
        return TRUNCATED

    env = parallel_env(script(main), beings(), possible_agents=["being_0", "being_1"])
    env.reset()
    results = env.step({"being_0": 1, "being_1": 1})
    assert flags(results) == {"being_0": (True, False), "being_1": (False, True)}


def endless(*functions):
    def main(simulation):
        while True:
            for function in functions:
                simulation.log.append(function())

    return script(main)


def test_max_steps_counts_rounds():
    ant, bee = points(reward_mapping=lambda: 1.0)
    env = parallel_env(endless(ant, bee), [ant, bee], max_steps=3)
    for _ in range(2):
        env.reset()
        for number in range(3):
            results = env.step({"ant_0": number, "bee_0": number})
            ended = number == 2
            assert flags(results) == {"ant_0": (False, ended), "bee_0": (False, ended)}
            assert results[1] == {"ant_0": 1.0, "bee_0": 1.0}
        assert deciding(results) == env.agents == []
        assert not any(env.step({}))
        with pytest.raises(EpisodeOverError, match="begin the next one"):
            env.step({"ant_0": 1, "bee_0": 1})
        assert env.simulation.log == [0, 0, 1, 1, 2, 2]


def test_a_step_without_an_action_does_not_count():
    ant, bee = points()
    env = parallel_env(endless(ant, bee), [ant, bee], max_steps=2)
    env.reset()
    for _ in range(3):
        assert not any(env.step({})[3].values())
    assert not any(env.step({"ant_0": 1})[3].values())
    assert all(env.step({"bee_0": 1})[3].values())


def test_the_last_step_runs_on_to_the_next_decision():
    def main(simulation):
        simulation.beings = one, two = Being(0), Being(1)
        while True:
            one.act()
            one.health += 1
            two.health += 10
            two.act()

    env = parallel_env(script(main), beings(), max_steps=2)
    env.reset()
    results = env.step({"being_0": 1})
    assert results[1] == {"being_0": 1.0, "being_1": 0.0}
    results = env.step({"being_1": 1})
    assert results[1] == {"being_0": 1.0, "being_1": 10.0}
    assert flags(results) == {"being_0": (False, True), "being_1": (False, True)}


def test_steps_out_of_place():
    ant, bee = points()
    env = parallel_env(calling(ant, bee), [ant, bee])
    with pytest.raises(NotResetError, match="no episode yet"):
        env.step({})
    env.reset()
    env.step({"ant_0": 1, "bee_0": 1})
    with pytest.raises(EpisodeOverError, match="begin the next one"):
        env.step({"ant_0": 1})
    env.reset()
    env.close()
    with pytest.raises(ResetNeededError, match="call reset"):
        env.step({})
    assert env.agents == []
    env.reset()
    assert env.agents == ["ant_0", "bee_0"]


@pytest.mark.parametrize("mapping", ["reward_mapping", "observation_space_mapping", "action_mask_mapping"])
def test_an_error_in_a_mapping_says_whose_it_was(mapping):
    good = {"reward_mapping": 0.0, "observation_space_mapping": [1, 2], "action_mask_mapping": [1] * 10}[mapping]

    def bad():
        if len(env.simulation.log) == 2:
            raise ZeroDivisionError
        return good

    ant, bee = decision(agent="ant_0"), decision(agent="bee_0", **{mapping: bad})
    env = parallel_env(calling(ant, bee, ant, bee), [ant, bee])
    env.reset(seed=17)
    with pytest.raises(ZeroDivisionError) as caught:
        env.step({"ant_0": 1, "bee_0": 1})
    assert "seed 17" in notes(caught.value)
    assert "bee_0" in notes(caught.value)
    assert env.agents == []


def test_an_environment_is_not_used_while_it_asks_who_is_expected():
    class Nosy(Hive):
        def expected_calls(self, point):
            if self.log and not asked:
                asked.append(point)
                env.step({})
            return super().expected_calls(point)

    asked = []

    env = parallel_env(Nosy, beings())
    env.reset()
    with pytest.raises(ReentrancyError, match="was used from"):
        env.step({"being_0": 1, "being_1": 1})


def test_what_is_returned_is_the_users_own():
    kept = np.array([1.0, 2.0])
    ant, bee = points(observation_space_mapping=lambda: kept)
    env = parallel_env(calling(ant, bee, ant, bee), [ant, bee])
    observations, infos = env.reset()
    observations["ant_0"][:] = 7
    infos["ant_0"]["deciding"] = "me"
    env.agents.append("me")
    results = env.step({"ant_0": 1, "bee_0": 1})
    assert kept.tolist() == [1.0, 2.0]
    assert results[0]["ant_0"].tolist() == [1.0, 2.0]
    assert results[0]["ant_0"] is not results[0]["bee_0"]
    assert env.agents == ["ant_0", "bee_0"]
    assert results[-1]["ant_0"]["deciding"] is True


def test_actions_are_not_changed_and_not_kept():
    given_actions = []
    ant = decision(
        agent="ant_0",
        action_space=spaces.Box(0, 1, (2,), np.float32),
        action_space_mapping=lambda action: given_actions.append(action),
    )
    env = parallel_env(calling(ant, ant), ant)
    env.reset()
    action = np.array([0.5, 0.25], np.float32)
    actions = {"ant_0": action}
    env.step(actions)
    assert actions == {"ant_0": action}
    action[:] = 0
    assert given_actions[0].tolist() == [0.5, 0.25]


def test_a_class_of_parallel_environments():
    ant, bee = points()
    env_class = generate_env(calling(ant, bee), [ant, bee], view="parallel")
    first, second = env_class(), env_class(max_steps=1)
    first.reset()
    second.reset()
    assert flags(first.step({"ant_0": 1}))["ant_0"] == (False, False)
    assert flags(second.step({"ant_0": 1}))["ant_0"] == (False, True)


# -- the rule once more, literally ----------------------------------------------------------------


LETTERS = ("ant", "bee", "cat", "dog")
AGENTS = [f"{letter}_0" for letter in LETTERS]
MASKED = {1, 3}


def allowed(level, number):
    """Whether an action is legal for those who are masked."""
    return (level + number) % 3 != 0


class World:
    """A level that all its agents change, one after the other in the order of a program."""

    def __init__(self):
        self.program = []

    def reset(self, seed=None):
        self.level, self.calls = (seed or 0) % 17, 0

    def run(self):
        for agent in self.program:
            value = getattr(self, LETTERS[agent])()
            self.calls += 1
            self.level = (self.level * 3 + value + 1) % 17

    def rule(self):
        return self.level % 4

    ant, bee, cat, dog = (lambda self: self.rule() for _ in LETTERS)


for _letter in LETTERS:
    _function = World.__dict__[_letter]
    _function.__name__, _function.__qualname__ = _letter, f"World.{_letter}"


class Rounds:
    """The contract's rule of rounds, without the library."""

    def __init__(self, program, seed, max_steps):
        self.max_steps = max_steps
        self.program, self.level, self.calls, self.steps = list(program), seed % 17, 0, 0
        self.joined = {self.program[0]}
        self.over = self.truncated = False

    def legal(self, agent, action):
        return action is RULE or agent not in MASKED or allowed(self.level, action)

    def step(self, actions):
        """Returns who has acted and who is paid, or None where the actions are refused."""
        left = dict(actions)
        pending = self.program[0]
        if pending in left and not self.legal(pending, left[pending]):
            return None
        self.steps += bool(actions)
        used = set()
        while self.program:
            agent = self.program[0]
            if agent not in left or not self.legal(agent, left[agent]):
                break
            action = left.pop(agent)
            used.add(agent)
            self.joined.add(agent)
            self.calls += 1
            self.level = (self.level * 3 + (self.level % 4 if action is RULE else action) + 1) % 17
            del self.program[0]
        paid = set(self.joined)
        self.over = not self.program
        if self.program:
            self.joined.add(self.program[0])
            self.over = self.truncated = self.steps == self.max_steps
        return used, paid


def allowed_now(world):
    """The mask of those who are masked."""
    return [allowed(world.level, number) for number in range(4)]


@cache
def world_env(max_steps):
    """An environment of a world, whose program may be changed."""
    definitions = {
        f"{__name__}.World.{letter}": define(
            agent=f"{letter}_0",
            observation_space_mapping=lambda world: [world.level, world.calls],
            reward_mapping=lambda world: float(world.level),
            action_space=spaces.Discrete(4),
            action_mask_mapping=allowed_now if number in MASKED else None,
        )
        for number, letter in enumerate(LETTERS)
    }
    return parallel_env(World, definitions, max_steps=max_steps)


@given(
    program=st.lists(st.integers(0, 3), min_size=1, max_size=20),
    seed=st.integers(0, 16),
    max_steps=st.none() | st.integers(1, 6),
    data=st.data(),
)
@settings(max_examples=250)
def test_rounds_are_as_the_contract_has_it(program, seed, max_steps, data):
    env = world_env(max_steps)
    env.simulation.program = program
    reference = Rounds(program, seed, max_steps)
    observations, infos = env.reset(seed=seed)
    for _ in range(40):
        if reference.over:
            break
        wanted = data.draw(
            st.dictionaries(st.integers(0, 3), st.integers(0, 3) | st.just(RULE), min_size=1, max_size=4)
        )
        before = reference.level
        expected = reference.step(wanted)
        actions = {AGENTS[agent]: action for agent, action in wanted.items()}
        if expected is None:
            with pytest.raises(InvalidActionError, match="is masked"):
                env.step(actions)
            assert env.simulation.level == before
            continue
        used, paid = expected
        observations, rewards, terminated, truncated, infos = env.step(actions)
        assert (env.simulation.level, env.simulation.calls) == (reference.level, reference.calls)
        assert {agent for agent in AGENTS if infos[agent]["acted"]} == {AGENTS[agent] for agent in used}
        assert rewards == {name: float(reference.level) if n in paid else 0.0 for n, name in enumerate(AGENTS)}
        for number, name in enumerate(AGENTS):
            seen = [reference.level, reference.calls] if number in reference.joined else [0, 0]
            assert observations[name].tolist() == seen
            if number in MASKED and number in reference.joined:
                mask = [allowed(reference.level, action) for action in range(4)]
                assert infos[name]["action_mask"].tolist() == mask
        assert set(terminated.values()) == {reference.over and not reference.truncated}
        assert set(truncated.values()) == {reference.truncated}
        assert env.agents == ([] if reference.over else AGENTS)
        if not reference.over:
            assert [name for name in AGENTS if infos[name]["deciding"]] == [AGENTS[reference.program[0]]]


# -- colonies -------------------------------------------------------------------------------------


def played(env, seed, choose):
    """Play a colony in rounds; returns the totals, and the fortune at which everybody joined."""
    observations, infos = env.reset(seed=seed)
    used, totals, joined, ended = Counter(), Counter(), {}, {}
    for _ in range(2000):
        for agent in env.agents:
            joined.setdefault(agent, env.simulation.fortune)
        agents = choose(env.agents, infos)
        actions = {agent: answer(seed, agent, used[agent]) for agent in agents}
        observations, rewards, terminated, truncated, infos = env.step(actions)
        assert set(observations) == set(rewards) == set(terminated) == set(truncated) == set(infos)
        assert set(env.agents) == {a for a in terminated if not (terminated[a] or truncated[a])}
        assert sum(info["deciding"] for info in infos.values()) == (1 if env.agents else 0)
        for agent, info in infos.items():
            assert agent not in ended
            assert observations[agent] in env.observation_space(agent)
            used[agent] += info["acted"]
            totals[agent] += rewards[agent]
            if terminated[agent] or truncated[agent]:
                ended[agent] = (terminated[agent], truncated[agent])
        if not env.agents:
            break
    assert not env.agents
    return totals, joined, ended


def everybody(agents, infos):
    return agents


def whose_turn_it_is(agents, infos):
    return [agent for agent in agents if infos[agent]["deciding"]]


def every_other(agents, infos):
    return [agent for number, agent in enumerate(agents) if number % 2 or infos[agent]["deciding"]]


@given(designs, seeds)
@settings(max_examples=60)
def test_a_colony_is_what_it_would_be_without_the_library(design, seed):
    plain = Answered(design, seed)
    if not plain.decisions:
        return
    died = {entry[0] for entry in plain.trace if entry[1:] == ("died",)}
    for choose in (everybody, whose_turn_it_is, every_other):
        for roster in (False, True):
            env = colony(parallel_env, design, roster=roster)
            totals, _, ended = played(env, seed, choose)
            assert env.simulation.trace == plain.trace
            assert env.simulation.random.getstate() == plain.random.getstate()
            assert {agent: totals[agent] for agent in plain.first} == plain.totals
            assert not any(total for agent, total in totals.items() if agent not in plain.first)
            for agent, flags in ended.items():
                assert flags == ((True, False) if agent in died or not design.truncates else (False, True))


@given(designs, seeds)
@settings(max_examples=60)
def test_a_colony_that_announces_loses_no_reward(design, seed):
    plain = Answered(design, seed)
    for choose in (everybody, whose_turn_it_is):
        env = colony(parallel_env, design, Announcing)
        if not plain.decisions:
            with pytest.raises(NoDecisionError):
                env.reset(seed=seed)
            return
        totals, joined, ended = played(env, seed, choose)
        assert env.simulation.trace == plain.trace
        assert set(ended) >= set(plain.first)
        for agent in plain.first:
            assert totals[agent] == plain.last[agent] - joined[agent]


# -- points of all kinds --------------------------------------------------------------------------


def made(design, make, **options):
    """An environment of a world with points of all kinds."""
    functions = worlds.points_of(design)
    policies = {functions[point]: worlds.advised for point in design.policies}
    policies |= {functions[point]: RULE for point in design.rules}
    return make(lambda: worlds.World(design, functions), functions, policies=policies or None, **options)


@given(worlds.designs(), seeds, worlds.answers)
@settings(max_examples=150)
def test_in_turns_it_is_the_aec_view(design, seed, answers):
    """Generators, nested decisions, choices and all: the same decisions bring the same run, and the same ends."""
    aec = made(design, aec_env, max_steps=design.max_steps)
    aec.reset(seed=seed)
    given_answers, observed = iter(answers), []
    while not any(aec.terminations.values()) and not any(aec.truncations.values()):
        observation, _, _, _, info = aec.last()
        observed.append((aec.agent_selection, observation.tolist()))
        aec.step(worlds.legal(next(given_answers), info))
    turns = made(design, parallel_env, max_steps=design.max_steps)
    observations, infos = turns.reset(seed=seed)
    given_answers, observed_in_turns = iter(answers), []
    while turns.agents:
        (agent,) = (agent for agent in turns.agents if infos[agent]["deciding"])
        observed_in_turns.append((agent, observations[agent].tolist()))
        mask = {"action_mask": infos[agent]["action_mask"]} if "action_mask" in infos[agent] else {}
        action = worlds.legal(next(given_answers), mask)
        observations, _, terminated, truncated, infos = turns.step({agent: action})
        assert infos[agent]["acted"]
    assert observed_in_turns == observed
    assert turns.simulation.trace == aec.simulation.trace
    assert set(terminated.values()) == set(aec.terminations.values())
    assert set(truncated.values()) == set(aec.truncations.values())


# -- PettingZoo's tests ---------------------------------------------------------------------------


class AnnouncingVillage(Village, Announcing):
    pass


def unmasked(**options):
    ant, bee, cat = points(3)
    return parallel_env(calling(*[ant, bee, bee, cat, ant] * 5), [ant, bee, cat], **options)


def masked_in_observations(**options):
    space = spaces.Dict(
        {"observation": spaces.Box(0, 100, (2,), np.float32), "action_mask": spaces.Box(0, 1, (10,), np.int8)}
    )
    changes = {
        "observation_space": space,
        "observation_space_mapping": lambda board: {"observation": board.last_two()},
        "action_mask_mapping": lambda board: [number != len(board.moves) for number in range(10)],
    }
    return parallel_env(Announced, boards(**changes), **options)


SHAPES = {
    "irregular order": unmasked,
    "truncated by steps": lambda: unmasked(max_steps=3),
    "masked": masked_in_observations,
    "all are known": lambda: parallel_env(Village, colony_points(overseen=True), possible_agents=NAMES_OF_THE_VILLAGE),
    "a hive with a roster": lambda: parallel_env(
        Hive, beings(), possible_agents=[f"being_{number}" for number in range(6)]
    ),
}


@pytest.mark.parametrize("make", SHAPES.values(), ids=SHAPES.keys())
def test_api(make):
    parallel_api_test(make(), num_cycles=100)


@pytest.mark.parametrize("shape", sorted(SHAPES.keys() - {"masked"}))
def test_seeds(shape):
    # PettingZoo's test knows of no masks, and a masked action is an illegal one.
    parallel_seed_test(SHAPES[shape], num_cycles=100)


LATE = {
    "a village": lambda: parallel_env(Village, colony_points(overseen=True)),
    "a village that announces": lambda: parallel_env(AnnouncingVillage, colony_points(overseen=True)),
    "a hive": lambda: parallel_env(Hive, beings()),
}


@pytest.mark.parametrize("make", LATE.values(), ids=LATE.keys())
def test_api_of_agents_that_join_late(make):
    with warnings.catch_warnings():
        # What PettingZoo says of every environment whose agents are not known beforehand, and at each end.
        warnings.filterwarnings("ignore", message=r"This environment does not have possible_agents defined\.")
        warnings.filterwarnings("ignore", message="No agents present")
        parallel_api_test(make(), num_cycles=100)


def test_the_rounds_of_pettingzoos_conversions():
    with warnings.catch_warnings():
        # Those who have not been called yet are observed as zeros.
        warnings.filterwarnings("ignore", message="Observation numpy array is all zeros")
        api_test(parallel_to_aec(unmasked()), num_cycles=20)
    env = turn_based_aec_to_parallel(aec_env(calling(*(pair := points()) * 9), list(pair)))
    parallel_api_test(env, num_cycles=20)


@pytest.mark.parametrize("make", LATE.values(), ids=LATE.keys())
def test_seeds_of_agents_that_join_late(make):
    parallel_seed_test(make, num_cycles=100)


def test_episodes_repeat_themselves():
    env = parallel_env(Village, colony_points(overseen=True))

    def episode():
        results = [env.reset(seed=9)]
        while env.agents:
            results.append(env.step({agent: env.action_space(agent).sample() % 5 for agent in env.agents}))
        return results

    first, second = episode(), episode()
    assert len(first) == len(second)
    assert all(data_equivalence(one, other) for one, other in zip(first, second, strict=True))


def test_what_cannot_be_observed_anew_is_never_the_same_object():
    """An agent whose entity the model has let go of keeps its observation, whatever its user does to it."""

    def main(simulation):
        one, other = Being(0), Being(1)
        one.act()
        del one
        for _ in range(5):
            other.act()

    env = parallel_env(script(main), beings(removed_by=()), possible_agents=["being_0", "being_1"])
    env.reset()
    for _ in range(4):
        observations, *_ = env.step({"being_0": 1, "being_1": 1})
        assert observations["being_0"].tolist() == [0, 0]
        observations["being_0"][:] = 99


def test_one_that_was_announced_can_be_removed_when_its_agent_has_no_name_any_more():
    class Crowd(Script):
        def reset(self, seed=None):
            super().reset(seed)
            self.beings = [Being(0), Being(1)]

        def expected_calls(self, point):
            return [(being,) for being in self.beings]

    def main(simulation):
        one, other = simulation.beings
        one.act()
        other.health = 1
        other.leave()
        one.act()

    named = beings(agent=lambda being: being_of(being) if being.health == 0 else None)
    env = parallel_env(lambda: Crowd(main), named)
    env.reset()
    assert env.agents == ["being_0", "being_1"]
    _, _, terminations, *_ = env.step({"being_0": 1, "being_1": 1})
    assert terminations == {"being_0": False, "being_1": True}
