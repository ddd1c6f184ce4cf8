"""Policies that plan: how they spend their branches, and all places where they serve."""

import copy
import pickle
import random
import subprocess
import sys
import textwrap
import threading
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import RULE, aec_env, branch, joint_env, parallel_env, simulate, simulate_many, single_env, vector_env
from simenv_marl.data import Mixture, collect_episodes, compare_with_rule, record_dataset
from simenv_marl.envs import pad_agents
from simenv_marl.errors import BranchError, CopyError, InvalidActionError, OptionValueError, ReentrancyError
from simenv_marl.planning import RolloutPolicy, action_values
from tests.conftest import DRIVERS
from tests.planning.test_action_values import GRAZING, METHODS, Global, Herd, Mortal, begun, greedy, made
from tests.worlds.duels import LEFT, RIGHT, Duel, Unseeded, points, worth
from tests.worlds.models import define, step


class Noted:
    def __init__(self, policy):
        self.policy, self.answers, self.base = policy, [], policy.base

    def __call__(self, observation, info, *, _environment):
        self.answers.append(self.policy(observation, info, _environment=_environment))
        return self.answers[-1]


def planner(**given):
    return RolloutPolicy(**{"base": greedy, "futures": 2, "horizon": 2, "discount": 0.1} | given)


def tame(**changes):
    """Points at which the one on the left is to come near to three, so that it matters what it does."""
    return points(reward_mapping=lambda duel: -abs(duel.value - 3), **changes)


def by_hand(seed=5):
    """What a planner does in a single view whose user asks it: its actions, and what the model has come to."""
    env = begun(single_env(Duel, tame(), agent="left"), seed)
    actions, over = [], False
    while not over:
        actions.append(planner().choose(env).best)
        over = any(env.step(actions[-1])[2:4])
    return actions, env.simulation.value


def test_seeds_tell_planners_apart():
    env = made("single")
    one, same, other = (RolloutPolicy(futures=3, seed=seed).choose(env).means.tolist() for seed in (None, None, 1))
    assert one == same
    assert one[2] != other[2]


def test_one_future_is_tried_once():
    with pytest.warns(UserWarning, match="foresees"):
        told = RolloutPolicy(futures=5).choose(made("single", Unseeded))
    assert told.counts.tolist() == [1, 1, 1]
    assert told.best == 2


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


def test_the_budget_is_divided_among_rounds(wide):
    told = RolloutPolicy(budget=96).choose(wide)
    assert sorted(told.counts.tolist()) == [4, 4, 4, 4, 12, 12, 28, 28]
    assert told.best == 7
    assert told.counts[7] == 28
    assert told.returns.shape == (8, 28)
    assert np.isnan(told.returns[0, 4:]).all()
    assert told.means[0] == pytest.approx(np.nanmean(told.returns[0]))


@pytest.mark.parametrize(
    ("given", "budget"),
    [
        *[({"budget": budget}, budget) for budget in (8, 9, 17, 24, 50, 100)],
        ({"futures": 6}, 48),
        ({"actions": [1, 4, 2], "futures": 6}, 18),
    ],
    ids=str,
)
def test_the_budget_is_spent_and_not_overspent(wide, given, budget):
    counts = RolloutPolicy(**given).choose(wide).counts
    assert budget - 1 <= counts.sum() <= budget
    assert counts.min() >= 1


def test_candidates_of_a_round_meet_the_same_futures(wide):
    told = RolloutPolicy([2, 2, 2, 2], budget=32).choose(wide)
    assert told.counts.tolist() == [12, 12, 4, 4]
    assert told.returns[0].tolist() == told.returns[1].tolist()
    assert told.returns[2, :4].tolist() == told.returns[0, :4].tolist()
    assert told.returns[0, :4].tolist() == action_values(wide, [2], futures=4).returns[0].tolist()
    told = RolloutPolicy([3]).choose(wide)  # one alone is not tried
    assert (told.best, told.counts.tolist()) == (3, [0])
    assert np.isnan(told.means).all()


def test_masked_candidates_are_left_out():
    given = points(action_mask_mapping=lambda duel: [duel.turn % 2, 1, 1])
    env = begun(single_env(Duel, {LEFT: given[LEFT]}))
    told = RolloutPolicy([0, 1], futures=2).choose(env)
    assert told.actions == (1,)
    with pytest.raises(InvalidActionError, match="all candidates"):
        RolloutPolicy([0]).choose(env)
    with pytest.raises(InvalidActionError, match="not in"):
        RolloutPolicy([0, 5]).choose(env)


@pytest.mark.parametrize(
    ("given", "match"),
    [
        *(({"budget": budget}, "budget") for budget in (0, 1.5)),
        ({"budget": 2}, "3 candidates once"),
        ({"futures": 0}, "futures"),
        ({"horizon": 0}, "horizon"),
        ({"seed": -1}, "seed"),
        ({"discount_by": "day"}, "discount_by"),
    ],
)
def test_what_cannot_be(given, match):
    with pytest.raises(OptionValueError, match=match):
        RolloutPolicy(**given).choose(made("single"))


@METHODS
@pytest.mark.parametrize("key", ["left", LEFT])
@pytest.mark.parametrize("driver", DRIVERS)
def test_simulate(driver, key, method):
    noted, found = Noted(planner(method=None if driver == "thread" and method == "fork" else method)), []

    def work():
        found.append(simulate(Duel, {key: noted}, points=tame(), seed=5, driver=driver).value)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join(60)
    work()
    actions, value = by_hand()
    assert found == [value] * 2
    assert noted.answers == actions * 2
    assert len(set(actions)) > 1


@METHODS
@pytest.mark.parametrize("make", [aec_env, parallel_env, joint_env, single_env])
def test_policies_of_environments(make, method):
    noted = Noted(planner(method=method))
    env = begun(make(Duel, tame(), policies={"left": noted}))
    while not step(env, 1, "right"):
        pass
    assert noted.answers == by_hand()[0]


@pytest.mark.parametrize("batch_size", [1, 8])
@pytest.mark.parametrize("policies", [{}, {"right": lambda observations: np.ones(len(observations), int)}])
def test_many_episodes_ask_row_by_row(batch_size, policies):
    given = {"points": tame(), "seeds": [5, 6], "batch_size": batch_size, "collect": lambda duel: duel.value}
    policies = {"left": planner(), **policies}
    found = collect_episodes(Duel, policies, **given)
    assert simulate_many(Duel, policies, **given) == list(found["left"].collected)
    for place, seed in enumerate([5, 6]):
        own = found["left"].actions[found["left"].episodes == place].tolist()
        assert (own, found["left"].collected[place]) == by_hand(seed)
    assert all(len(of_agent) == 12 for of_agent in found.values())


@METHODS
def test_batch_policies_of_others_go_on_in_branches(method):
    def downwards(observations, infos, identities):
        return np.full(len(observations), 2)

    def alone(observation):
        return 2

    policies = {"left": planner(method=method), "right": downwards}
    told = simulate_many(Duel, policies, points=tame(), seeds=[5, 5], collect=lambda duel: duel.value)
    assert told[0] == told[1] == simulate(Duel, {"left": planner(), "right": alone}, points=tame(), seed=5).value
    values = []

    def left(observation, info, *, _environment):
        values.append(action_values(_environment, base=greedy, futures=2, method=method))
        return values[-1].best

    collect_episodes(Duel, {"left": left, "right": downwards}, points=points(), seeds=[5])
    simulate(Duel, {"left": left, "right": alone}, points=points(), seed=5)
    assert len(values) == 12
    assert values[0].returns == pytest.approx(values[6].returns)


def test_compare_with_rule():
    given = {"points": tame(rule_action_mapping=lambda decision: decision), "seeds": [5, 6]}
    plain = compare_with_rule(Duel, {"left": lambda seen: np.ones(len(seen), int)}, **given)["left"]
    assert plain.agreement == 1
    told = compare_with_rule(Duel, {"left": planner()}, **given)["left"]
    env, wanted = single_env(Duel, given["points"], agent="left"), []
    for seed in (5, 6):
        env.reset(seed=seed)
        for _ in range(6):
            wanted.append(planner().choose(env).best)
            env.step(RULE)
    assert told.policy_actions.tolist() == wanted
    assert told.trajectories.actions.tolist() == [1] * 12


def test_data_sets_are_recorded_of_planners(monkeypatch):
    saved = Mock()
    monkeypatch.setattr("simenv_marl.data.demonstrations._free_path", lambda name: None)
    monkeypatch.setattr("simenv_marl.data.demonstrations.save_dataset", saved)
    record_dataset("duels-v0", Duel, {"left": planner()}, points=tame(), seeds=[5])
    assert saved.call_args.args[1].actions.tolist() == by_hand()[0]


def test_a_vector_environment():
    envs = begun(vector_env(Duel, tame(), num_envs=2, policies={"right": planner()}))
    for _ in range(3):
        envs.step(np.array([1, 1]))
    assert [env.unwrapped.simulation.turn for env in envs.envs] == [3, 3]
    envs.close()


def test_a_mixture_cannot_ask_it():
    with pytest.raises(OptionValueError, match="asks for the environment"):
        Mixture({RULE: 1, planner(): 1})


@pytest.mark.parametrize("view", ["simulate", "aec", "parallel", "collect"])
def test_the_environment_of_a_policy(view):
    seen = []

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
            told = branch(_environment, lambda twin, i: (twin.step(i)[:4], twin.simulation.turn), 3, method=method)
            seen.append(told)
        return 1

    if view == "simulate":
        simulate(Duel, {"left": left}, points=points(), seed=5)
    elif view == "collect":
        collect_episodes(Duel, {"left": left}, points=points(), seeds=[5])
    else:
        env = begun((aec_env if view == "aec" else parallel_env)(Duel, points(), policies={"left": left}))
        while not step(env, 1, "right"):
            pass
    assert len(seen) == 12
    for forked, replayed in zip(seen[::2], seen[1::2], strict=True):
        assert repr(forked) == repr(replayed)
    for turn, told in enumerate(seen[::2]):
        for action, ((_, reward, terminated, truncated), came_to) in enumerate(told):
            # The reward is that of the action alone, since the agent's decision that was pending.
            assert reward == pytest.approx(worth("left", action, None, at=2 * turn, horizon=1))
            assert (terminated, truncated) == (turn == 5, False)
            assert came_to == min(turn + 1, 5)


@METHODS
def test_agents_that_die_while_their_policy_plans(method):
    given = {"base": lambda observation: 2, "futures": 4, "method": method}
    values = []

    def left(observation, info, *, _environment):
        values.append(action_values(_environment, **given, terminal_value=lambda env: 1e6))
        return 1

    simulate(Mortal, {"left": left}, points=points(), seed=5)
    assert values[0].returns == pytest.approx(action_values(made("single", Mortal), **given).returns)


def test_entities_plan_each_for_itself():
    point = f"{Herd.__module__}.Herd.graze"
    told = simulate(Herd, {point: RolloutPolicy(futures=1)}, points=GRAZING, seed=1)
    assert told.sum == 6 * 9
    base = {"one": lambda observation: 2, "other": lambda observation: 5}
    values = []

    def one(observation, info, *, _environment):
        values.append(action_values(_environment, [0], base=base, futures=1))
        return 0

    simulate(Herd, {"one": one}, points=GRAZING, seed=1)
    assert values[0].means.tolist() == [5 + 2 + 5 + 2 + 5]
    simulate(Herd, {"one": one, "other": lambda observation: 1}, points=GRAZING, seed=1)
    assert values[3].means.tolist() == [1 + 2 + 1 + 2 + 1]


@METHODS
def test_two_planners_at_once(method):
    values = []

    def noting(observation, info, *, _environment):
        told = action_values(_environment, base=greedy, futures=3, method=method)
        if told.counts[0]:  # else it was asked in a branch
            values.append(told)
        return 1

    down = lambda observation: 2  # noqa: E731
    for right in (RolloutPolicy(base=down, method=method), down):
        simulate(Duel, {"left": noting, "right": right}, points=points(), seed=5)
    assert values[0].returns.tolist() == values[6].returns.tolist()


@METHODS
def test_policies_that_branch_do_not_ask_each_other_for_ever(method):
    """In a branch of the one the other is left to its base, or to its rule; else there were a branch of each branch."""
    calls, seen, plans = [], [], []

    def branches(observation, info, *, _environment):
        calls.append(int(observation[0]))
        seen.append(branch(_environment, lambda twin, i: (twin.step(i)[1], calls[:]), 2, method=method))
        return 1

    simulate(Duel, {"left": branches, "right": branches}, points=points(), seed=5)
    assert len(calls) == 12
    for number, (first, second) in enumerate(seen):
        assert len(first[1]) == len(second[1]) == number + 1  # no policy was asked there
    assert seen[0][1][0] == pytest.approx(worth("left", 1, None, horizon=1))
    branches.base = lambda observation: 2
    del seen[:], calls[:]
    simulate(Duel, {"left": branches, "right": branches}, points=points(), seed=5)
    assert seen[0][1][0] == pytest.approx(worth("left", 1, None, horizon=1, bases={"right": branches.base}))

    def plan(observation, *, _environment):
        plans.append(action_values(_environment, base=greedy, futures=2, method=method))
        return plans[-1].best

    simulate(Duel, {"left": plan, "right": plan}, points=points(), seed=5)
    assert [told.counts.tolist() for told in plans] == [[2, 2, 2]] * 12
    env = begun(aec_env(Duel, points(), policies={"right": plan}))
    told = action_values(env, futures=3, method=method)
    assert told.returns == pytest.approx(action_values(made("aec"), futures=3, method=method).returns)
    assert len(plans) == 12


def test_the_users_own_branches_are_exact():
    env = begun(aec_env(Duel, tame(), policies={"left": planner()}))
    env.step(1)

    def ahead(twin, number):
        for _ in range(3):
            twin.step(1)
        return twin.simulation.value

    forked, replayed = branch(env, ahead)[0], branch(env, ahead, method="replay")[0]
    assert forked == replayed == ahead(env, 0)


def test_errors_surface_from_where_the_policy_is_asked():
    def fails(observation):
        raise LookupError("no idea")

    given = {"policies": {"left": RolloutPolicy(base=fails, futures=1)}, "points": points()}
    for ask in (lambda: simulate(Duel, seed=5, **given), lambda: aec_env(Duel, **given).reset(seed=5)):
        with pytest.raises(LookupError, match="no idea"):
            ask()


def test_a_replay_of_a_branch_of_a_policy_is_refused():
    def left(observation, info, *, _environment):
        branch(_environment, lambda twin, i: branch(twin, lambda again, j: again.step(1), method="replay"))

    with pytest.raises(BranchError, match="fork"):
        simulate(Duel, {"left": left}, points=points(), seed=5)


def test_global_generators_of_their_own():
    def answers(method):
        noted = Noted(RolloutPolicy(base=lambda seen: random.randrange(3), futures=3, method=method))
        simulate(Global, {"left": noted}, points=tame(), seed=5, global_rng=True)
        return noted.answers

    assert answers("fork") == answers("replay")


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"skip_forced": True},
        {"max_steps": 4},
        {"global_rng": True},
        {"plugins": [(lambda duel: None, LEFT, "before"), (lambda duel: None, RIGHT, "after")]},
    ],
    ids=lambda options: next(iter(options), "padded"),
)
@pytest.mark.parametrize("make", [aec_env, parallel_env])
def test_both_methods_do_alike_with_all_options(make, options):
    given, found = points(action_mask_mapping=lambda duel: [1, duel.turn % 2, duel.turn % 2]), []
    for method in ("fork", "replay"):
        noted = Noted(RolloutPolicy(futures=2, horizon=2, method=method))
        env = make(Duel, given, policies={"left": noted}, **options)
        env = begun(env if options else pad_agents(env))
        for _ in range(3):
            env.step(1 if make is aec_env else {"right": 1})
        found.append((noted.answers, env.unwrapped.simulation.value))
        env.close()
    assert found[0] == found[1]
    assert set(found[0][0]) == ({2} if "skip_forced" in options else {0, 2})


def test_max_steps_end_the_futures_of_the_one_agent_that_is_asked():
    """There they count its own decisions; in those of a policy beside a user's agents they count nothing."""
    told = []

    def left(observation, info, *, _environment):
        told.append(action_values(_environment, [1], futures=1).means[0])
        return 1

    collect_episodes(Duel, {"left": left}, points=points(), seeds=[5], max_steps=2)
    env = made("single", max_steps=2)
    assert told[0] == pytest.approx(action_values(env, [1], futures=1).means[0])
    env = begun(aec_env(Duel, points(), policies={"left": left}, max_steps=2))
    assert told[-1] == pytest.approx(action_values(made("single"), [1], futures=1).means[0])


def test_a_simulation_without_environments_has_planners():
    code = """
        from simenv_marl import simulate
        from simenv_marl.planning import RolloutPolicy
        from tests.worlds.inventory import Shop

        simulate(Shop, {"buyer": RolloutPolicy(futures=1, horizon=1)}, points=Shop.order, seed=1)
    """
    root = Path(__file__).parent.parent.parent
    subprocess.run([sys.executable, "-c", textwrap.dedent(code)], cwd=root, check=True, timeout=60)
