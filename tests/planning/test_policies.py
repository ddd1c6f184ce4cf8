"""Policies that plan: their use of branches, all places for them, and delayed effects."""

import copy
import pickle
import random
import socket
from functools import cache, partial
from itertools import count

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import TransformReward

from simenv_marl import (
    RULE,
    aec_env,
    branch,
    clone,
    evaluate,
    joint_env,
    parallel_env,
    simulate,
    simulate_many,
    single_env,
    turn_env,
    vector_env,
)
from simenv_marl.data import collect_episodes, compare_with_rule
from simenv_marl.errors import ClosedError, CopyError, OptionValueError, ReentrancyError
from simenv_marl.planning import RolloutPolicy, TreeSearchPolicy, action_values, tree
from tests.planning.test_action_values import GRAZING, Herd, begun, greedy, made
from tests.test_branch import METHODS
from tests.worlds.models import BY_DRIVER, define, step
from tests.worlds.valued import LEFT, Duel, Unseeded, points, worth


def planner(**given):
    return RolloutPolicy(**{"base": greedy, "futures": 2, "horizon": 2, "discount": 0.1} | given)


def tame(**changes):
    """Points at which the left one's aim is to come near to three, so its actions matter."""
    given = {
        "reward_mapping": lambda duel: -abs(duel.value - 3),
        "rule_action_mapping": lambda decision: decision,
    }
    return points(**given | changes)


def known(answers):
    """The actions of answers, where the rule's is 1."""
    return [1 if answer is RULE else answer for answer in answers]


@cache
def by_hand(seed=5, down=False):
    """A planner in a single view, called by its user: its actions, and the model's final value."""
    policies = {"right": lambda observation: 2} if down else None
    env = begun(single_env(Duel, tame(), agent="left", policies=policies), seed)
    own = planner(method="replay")
    actions, over = [], False
    while not over:
        actions.append(own.choose(env).best)
        over = any(env.step(actions[-1])[2:4])
    return actions, env.simulation.value


class Wide:
    """Eight candidates, of which the last is the best."""

    def reset(self, seed=None):
        self.random, self.paid = random.Random(seed), 0.0

    def reseed(self, seed):
        self.random.seed(seed)

    def run(self):
        for _ in range(2):
            self.paid = self.choose() + self.random.gauss(0, 1)

    @define(action_space=spaces.Discrete(8), reward_mapping=lambda wide: wide.paid)
    def choose(self):
        return 0


@pytest.fixture
def wide():
    return begun(single_env(Wide, Wide.choose), 1)


def test_rollout_policy_spends_more_of_its_budget_on_better_actions(wide):
    told = RolloutPolicy([*range(8), RULE], budget=96, method="replay").choose(wide)
    assert told.actions == RolloutPolicy(budget=96).choose(wide).actions == (*range(8), RULE)
    assert sorted(told.counts.tolist()) == [2, 2, 2, 2, 7, 7, 15, 29, 29]
    assert told.best == 7
    assert told.counts[7] == 29
    assert told.returns.shape == (9, 29)
    assert np.isnan(told.returns[0, 2:]).all()
    assert told.means[0] == pytest.approx(np.nanmean(told.returns[0]))


@pytest.mark.parametrize(
    ("given", "budget"),
    [
        *[({"budget": budget}, budget) for budget in (9, 10, 17, 50)],
        ({"actions": [1, 4, 2], "futures": 6}, 24),
    ],
)
def test_rollout_policy_spends_its_budget_and_no_more(wide, given, budget):
    counts = RolloutPolicy(method="replay", **given).choose(wide).counts
    assert budget - 1 <= counts.sum() <= budget
    assert counts.min() >= 1


def test_rollout_policy_tries_actions_of_a_round_in_the_same_futures(wide):
    told = RolloutPolicy([2, 2, 2, RULE], budget=32, method="replay").choose(wide)
    assert told.counts.tolist() == [12, 12, 4, 4]
    assert told.returns[0].tolist() == told.returns[1].tolist()
    assert told.returns[2, :4].tolist() == told.returns[0, :4].tolist()
    assert told.returns[0, :4].tolist() == action_values(wide, [2], futures=4).returns[0].tolist()


@pytest.mark.thorough
@METHODS
@pytest.mark.parametrize("key", ["left", LEFT])
@BY_DRIVER
def test_planning_policies_in_simulate_choose_the_actions_of_a_reference(driver, key, method):
    policy = planner(method=None if driver == "thread" and method == "fork" else method)
    found = simulate(Duel, {key: policy}, points=tame(), seed=5, driver=driver)
    answers, value = by_hand()
    assert found.value == value
    assert len(set(answers)) > 1


@METHODS
@pytest.mark.parametrize("make", [aec_env, parallel_env, joint_env, single_env, turn_env])
def test_planning_policies_in_envs_choose_the_best_actions_of_a_reference(make, method):
    env = begun(make(Duel, tame(), policies={"left": planner(method=method)}))
    while not step(env, 1, "right"):
        pass
    assert env.simulation.value == by_hand()[1]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("down", "method", "batch_size"), [(False, "replay", 1), (True, "replay", 8), (True, "fork", 8)]
)
def test_planning_policies_in_simulate_many_decide_one_by_one(down, method, batch_size):
    """Beside policies that are asked in batches, also in branches."""
    given = {
        "points": tame(),
        "seeds": [5, 6],
        "batch_size": batch_size,
        "collect": lambda duel: duel.value,
    }
    policies = {"left": planner(method=method)}
    if down:
        policies["right"] = lambda observations, infos, identities: np.full(len(observations), 2)
    found = collect_episodes(Duel, policies, **given)
    if method == "replay":
        assert simulate_many(Duel, policies, **given) == list(found["left"].collected)
    for place, seed in enumerate([5, 6]):
        own = found["left"].actions[found["left"].episodes == place].tolist()
        answers, value = by_hand(seed, down)
        assert (own, found["left"].collected[place]) == (known(answers), value)
        assert found["left"].by_rule[found["left"].episodes == place].tolist() == [
            a is RULE for a in answers
        ]
    assert all(len(of_agent) == 12 for of_agent in found.values())


def test_compare_with_rule_accepts_planning_policies():
    given = {"points": tame(), "seeds": [5, 6]}
    told = compare_with_rule(Duel, {"left": planner(method="replay")}, **given)["left"]
    env, wanted = single_env(Duel, given["points"], agent="left"), []
    own = planner(method="replay")
    for seed in (5, 6):
        env.reset(seed=seed)
        for _ in range(6):
            wanted.append(own.choose(env).best)
            env.step(RULE)
    assert told.policy_actions.tolist() == known(wanted)
    assert told.trajectories.actions.tolist() == [1] * 12


@pytest.mark.thorough
def test_planning_policies_decide_in_vector_env():
    envs = begun(vector_env(Duel, tame(), num_envs=2, policies={"right": planner()}))
    for _ in range(3):
        envs.step(np.array([1, 1]))
    assert [env.simulation.turn for env in envs.envs] == [3, 3]
    envs.close()


def test_max_steps_ends_a_policys_branch_unless_other_agents_take_steps():
    def to_the_end(twin, number):
        taken = 1
        while not any(over := twin.step(1)[2:4]):
            taken += 1
        return taken, over

    def left(observation, info, *, _environment):
        seen.append(branch(_environment, to_the_end, 1, method="replay")[0])
        return 1

    seen = []
    evaluate(Duel, {"planner": {"left": left}}, points=points(), seeds=[5], max_steps=4)
    assert seen == [(6, (True, False)), (5, (True, False))]
    seen.clear()
    evaluate(
        Duel, {"planner": {"left": left}}, points={LEFT: points()[LEFT]}, seeds=[5], max_steps=4
    )
    assert seen == [(taken, (False, True)) for taken in (4, 3, 2, 1)]


@pytest.mark.parametrize("many", [False, True])
def test_policy_with_environment_parameter_gets_env_at_its_decision(many):
    seen = []

    def tried(twin, action):
        told = twin.step(action)[:4], twin.simulation.turn
        twin.close()
        with pytest.raises(ClosedError):
            twin.step(action)
        return told

    def left(observation, info, *, _environment):
        assert _environment.unwrapped is _environment
        assert _environment.action_space == spaces.Discrete(3)
        assert _environment.observation_space.shape == (2,)
        assert [_environment.simulation.turn, _environment.simulation.value] == observation.tolist()
        for use in (lambda: _environment.step(1), _environment.reset):
            with pytest.raises(ReentrancyError):
                use()
        with pytest.raises((ReentrancyError, EnvironmentError)):
            _environment.close()
        for copied in (copy.deepcopy, pickle.dumps):
            with pytest.raises(CopyError):
                copied(_environment)
        for method in ("fork", "replay"):
            seen.append(branch(_environment, tried, 3, method=method))
            twin = clone(_environment, method=method)
            assert repr(twin.step(1)[:4]) == repr(seen[-1][1][0])
            twin.close()
        return 1

    if many:
        collect_episodes(Duel, {"left": left}, points=points(), seeds=[5])
    else:
        simulate(Duel, {"left": left}, points=points(), seed=5)
    assert len(seen) == 12
    for forked, replayed in zip(seen[::2], seen[1::2], strict=True):
        assert repr(forked) == repr(replayed)
    for turn, told in enumerate(seen[::2]):
        for action, ((_, reward, terminated, truncated), came_to) in enumerate(told):
            # The reward is that of the action alone, since the agent's decision that was pending.
            assert reward == pytest.approx(worth("left", action, None, at=2 * turn, horizon=1))
            assert (terminated, truncated) == (turn == 5, False)
            assert came_to == min(turn + 1, 5)


def test_rollout_policy_plans_for_the_return_of_its_own_agent():
    point = f"{Herd.__module__}.Herd.graze"
    told = simulate(
        Herd, {point: RolloutPolicy(futures=1, method="replay")}, points=GRAZING, seed=1
    )
    assert told.sum == 6 * 9


@pytest.mark.thorough
@METHODS
def test_planning_policies_do_not_plan_inside_each_others_branches(method):
    """In a branch of one agent, the other follows its base or its rule: branches do not nest."""
    calls, seen, plans = [], [], []

    def branches(observation, info, *, _environment):
        calls.append(int(observation[0]))
        seen.append(
            branch(_environment, lambda twin, i: (twin.step(i)[1], calls[:]), 2, method=method)
        )
        return 1

    simulate(Duel, {"left": branches, "right": branches}, points=points(), seed=5)
    assert len(calls) == 12
    for number, (first, second) in enumerate(seen):
        assert len(first[1]) == len(second[1]) == number + 1  # no policy was asked there
    assert seen[0][1][0] == pytest.approx(worth("left", 1, None, horizon=1))
    branches.base = lambda observation: 2
    del seen[:], calls[:]
    simulate(Duel, {"left": branches, "right": branches}, points=points(), seed=5)
    assert seen[0][1][0] == pytest.approx(
        worth("left", 1, None, horizon=1, bases={"right": branches.base})
    )

    def plan(observation, *, _environment):
        plans.append(action_values(_environment, base=greedy, futures=2, method=method))
        return plans[-1].best

    simulate(Duel, {"left": plan, "right": plan}, points=points(), seed=5)
    assert [told.counts.tolist() for told in plans] == [[2, 2, 2]] * 12
    env = begun(aec_env(Duel, points(), policies={"right": plan}))
    told = action_values(env, futures=3, method=method)
    assert told.returns == pytest.approx(
        action_values(made("aec"), futures=3, method=method).returns
    )
    assert len(plans) == 12


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


def choice(planner, model=Lock, given=None):
    env = single_env(model, given or locked())
    env.reset(seed=1)
    return planner.choose(env)


@METHODS
@pytest.mark.filterwarnings("ignore:all futures of Lock are the same")
def test_tree_search_policy_finds_two_decisions_that_pay_only_together(method):
    tree = TreeSearchPolicy(futures=10, exploration=1.4, method=method)
    rollouts = RolloutPolicy(futures=2, method=method)
    told = choice(tree)
    assert (told.best, told.counts.sum()) == (2, 50)
    assert (
        choice(rollouts).best
        is choice(TreeSearchPolicy(futures=2, depth=1, method=method)).best
        is RULE
    )
    if method == "replay":
        assert simulate(Lock, {"thief": tree}, points=locked(), seed=1).tried[:2] == [2, 3]
        assert not simulate(Lock, {"thief": rollouts}, points=locked(), seed=1).open


@pytest.mark.filterwarnings("ignore:all futures of Lock are the same")
def test_tree_search_policy_leaves_masked_later_actions_to_its_base():
    given = locked(action_mask_mapping=lambda lock: [1, 1, 1, not lock.tried])
    told = choice(TreeSearchPolicy(futures=10), given=given)
    assert (told.best, told.counts.sum()) == (RULE, 50)


class Line(socket.socket):
    def __del__(self):
        self.close()


class Opens(Unseeded):
    """Opens what no fork can share, and keeps it."""

    def right(self):
        if self.turn == 1:
            self.opened = Line()
        return 1


class Lends(Unseeded):
    """The same, for all duels of a process."""

    def right(self):
        Lends.opened = Line() if self.turn == 1 else None
        return 1


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore:.* cannot draw new random numbers")
@pytest.mark.parametrize(
    ("model", "most", "cost"),
    [(Opens, 200, 0), (Lends, 200, 0), (Unseeded, 3, 0), (Unseeded, 200, 1e9)],
)
def test_tree_search_policy_closes_its_clones_and_keeps_exact_values(
    model, most, cost, monkeypatch
):
    twins = []

    def noted(*given, **options):
        twins.append(clone(*given, **options))
        return twins[-1]

    monkeypatch.setattr(tree, "perf_counter", partial(next, count(0, cost)))  # which a fork takes
    monkeypatch.setattr(tree, "_MOST", most)
    monkeypatch.setattr(tree, "clone", noted)
    kept = TreeSearchPolicy(depth=4, futures=8).choose(made("single", model)).returns
    assert (len(twins) > 1) == (cost == 0)
    number = len(twins)
    replayed = (
        TreeSearchPolicy(depth=4, futures=8, method="replay").choose(made("single", model)).returns
    )
    np.testing.assert_array_equal(kept, replayed)
    assert len(twins) == number
    for twin in twins:
        with pytest.raises(ClosedError):
            twin.step(1)


@pytest.mark.filterwarnings("ignore:.* cannot draw new random numbers")
def test_tree_search_policy_counts_rewards_changed_by_wrappers(monkeypatch):
    monkeypatch.setattr(tree, "perf_counter", partial(next, count(0, 0)))  # forks cost nothing
    env = begun(TransformReward(made("single", Unseeded), lambda reward: -reward))
    found, replayed = (
        TreeSearchPolicy(depth=4, futures=8, method=method).choose(env)
        for method in (None, "replay")
    )
    np.testing.assert_array_equal(found.returns, replayed.returns)
    assert found.best == replayed.best


def test_tree_search_policy_works_if_the_agent_ends_before_its_depth():
    class Short(Duel):
        ceiling = 2.5

    told = TreeSearchPolicy(depth=4, futures=6).choose(made("agent", Short))
    assert told.counts.sum() == 24
    assert not np.isnan(told.means).any()


def rule_to_the_end(env):
    """Play a clone to its end by the rule."""
    over = False
    while not over:
        told = env.step(RULE)
        over = not env.agents if hasattr(env, "agents") else told[2] or told[3]


def far_sighted(observation, *, _environment):
    clone(_environment).unwrapped.call(rule_to_the_end)
    return 1


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore:.* cannot draw new random numbers")
@pytest.mark.parametrize("policy", [TreeSearchPolicy(depth=5, futures=8), far_sighted])
def test_planning_policies_work_in_clones_up_to_the_end(policy, monkeypatch):
    monkeypatch.setattr(tree, "perf_counter", partial(next, count(0, 0)))  # forks cost nothing

    class Short(Unseeded):
        turns = 3

    policies = {"right": policy}
    simulate(Short, policies, points=tame(), seed=1)
    aec = begun(aec_env(Short, tame(), policies=policies))
    rule_to_the_end(aec)
    parallel = begun(parallel_env(Short, tame(), policies=policies))
    while parallel.agents:
        parallel.step({"left": 1})
    rule_to_the_end(begun(joint_env(Short, tame(), policies=policies)))
    single = begun(single_env(Short, tame(), agent="left"))
    over = False
    while not over:
        if policy is far_sighted:
            action = policy(None, _environment=single)
        else:
            action = policy.choose(single).best
        over = any(single.step(action)[2:4])


def test_tree_search_policy_tries_actions_in_the_same_futures():
    env = made("single")
    table = TreeSearchPolicy([1, 1], depth=1, futures=6).choose(env).returns
    both = ~np.isnan(table).any(axis=0)
    assert both.sum() >= 4
    assert table[0, both].tolist() == table[1, both].tolist()
    assert len(set(table[0, both])) == both.sum()


@pytest.mark.parametrize(
    ("option", "values"),
    [
        ("depth", [0, 1.5]),
        ("exploration", [-1, float("inf")]),
        ("budget", [0, 1.5]),
        ("horizon", [0]),
        ("margin", [-1, float("nan"), None]),
    ],
)
def test_rollout_and_tree_search_policy_refuse_invalid_options(option, values):
    for value in values:
        with pytest.raises(OptionValueError, match=option):
            TreeSearchPolicy(**{option: value})
    with pytest.raises(OptionValueError, match="4 candidates once"):
        RolloutPolicy(budget=3).choose(made("single"))
