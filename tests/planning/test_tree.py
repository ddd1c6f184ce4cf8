"""The tree: what shows its worth only with the decisions after it."""

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import simulate, single_env
from simenv_marl.errors import OptionValueError
from simenv_marl.planning import RolloutPolicy, TreeSearchPolicy
from tests.planning.test_action_values import METHODS, made
from tests.worlds.duels import Duel, points
from tests.worlds.models import define


class Lock:
    """Opens by 2 and then 3. Any other number but 0 costs something at once."""

    def reset(self, seed=None):
        self.tried, self.open = [], False

    def reseed(self, seed):
        pass

    def run(self):
        for _ in range(4):
            self.tried.append(self.turn())
            self.open = self.open or self.tried[-2:] == [2, 3]

    def turn(self):
        return 0


def locked(**changes):
    given = {
        "action_space": spaces.Discrete(4),
        "observation_space_mapping": lambda lock: [len(lock.tried), lock.open],
        "reward_mapping": lambda lock: 10.0 * lock.open - 0.1 * bool(lock.tried and lock.tried[-1]),
    }
    return {f"{__name__}.Lock.turn": define(agent="thief", **given | changes)}


def choice(planner, model=Lock, given=None, **options):
    env = single_env(model, given or locked(), **options)
    env.reset(seed=1)
    return planner.choose(env)


@METHODS
def test_two_decisions_that_are_worth_something_together(method):
    tree = TreeSearchPolicy(futures=10, exploration=1.4, method=method)
    rollouts = RolloutPolicy(futures=10, method=method)
    told = choice(tree)
    assert (told.best, told.counts.sum()) == (2, 40)
    assert choice(rollouts).best == 0
    assert simulate(Lock, {"thief": tree}, points=locked(), seed=1).tried[:2] == [2, 3]
    assert not simulate(Lock, {"thief": rollouts}, points=locked(), seed=1).open


def test_the_depth():
    class Deep(Lock):
        def run(self):
            for _ in range(4):
                self.tried.append(self.turn())
                self.open = self.open or self.tried[-3:] == [2, 3, 2]

    assert choice(TreeSearchPolicy(futures=40, depth=3, exploration=1.4), Deep).best == 2
    told = choice(TreeSearchPolicy(futures=40, depth=1))
    assert (told.best, told.counts.sum()) == (0, 160)


def test_actions_that_are_masked_by_then_are_left_to_the_base():
    given = locked(action_mask_mapping=lambda lock: [1, 1, 1, not lock.tried])
    told = choice(TreeSearchPolicy(futures=10), given=given)
    assert (told.best, told.counts.sum()) == (0, 40)


@METHODS
def test_results_do_not_depend_on_how_branches_are_made(method):
    env = made("single")
    told, again = (TreeSearchPolicy(futures=9, horizon=3, method=kind).choose(env) for kind in (None, method))
    assert told.counts.tolist() == again.counts.tolist()
    assert told.means == pytest.approx(again.means)


def test_candidates_meet_the_same_futures():
    env = made("single")
    table = TreeSearchPolicy([1, 1], depth=1, futures=6).choose(env).returns
    both = ~np.isnan(table).any(axis=0)
    assert both.sum() >= 4
    assert table[0, both].tolist() == table[1, both].tolist()
    assert len(set(table[0, both])) == both.sum()


def test_agents_that_end_before_the_depth():
    class Short(Duel):
        ceiling = 2.5

    told = choice(TreeSearchPolicy(depth=4, futures=6), Short, points(), agent="left")
    assert told.counts.sum() == 18
    assert not np.isnan(told.means).any()


@pytest.mark.parametrize("budget", [3, 4, 9, 20])
def test_the_budget_is_spent(budget):
    assert TreeSearchPolicy(budget=budget).choose(made("single")).counts.sum() == budget


@pytest.mark.parametrize(
    ("option", "values"),
    [("depth", [0, 1.5]), ("exploration", [-1, float("inf")]), ("budget", [0]), ("horizon", [0])],
)
def test_what_cannot_be(option, values):
    for value in values:
        with pytest.raises(OptionValueError, match=option):
            TreeSearchPolicy(**{option: value})
