"""Candidates that hold, policies as candidates, incumbents, and horizons of equal durations."""

import random
import warnings

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import (
    RULE,
    aec_env,
    clone,
    difference,
    joint_env,
    parallel_env,
    simulate,
    single_env,
    turn_env,
)
from simenv_marl.errors import InvalidActionError, OptionValueError
from simenv_marl.planning import RolloutPolicy, TreeSearchPolicy, action_values, first
from tests.planning.test_action_values import begun
from tests.test_branch import METHODS
from tests.worlds.models import BY_DRIVER, define


class Works:
    """A machine whose operations take as long as is chosen. A watchman comes every two hours.

    Each hour costs one.
    """

    end = 40.0

    def reset(self, seed=None):
        self.random = random.Random(seed)
        self.clock, self.log = 0.0, []

    def reseed(self, seed):
        self.random.seed(seed)

    def time(self):
        return self.clock

    def run(self):
        while self.clock < self.end:
            hours = self.operate()
            self.log.append(hours)
            until = self.clock + hours * self.random.uniform(0.5, 1.5)
            while self.clock // 2 * 2 + 2 <= until:
                self.clock = self.clock // 2 * 2 + 2.0
                self.look()
            self.clock = until

    def operate(self):
        return 1

    def look(self):
        return 0


OPERATE, LOOK = f"{__name__}.Works.operate", f"{__name__}.Works.look"


def points(cost=lambda works: works.clock, **changes):
    """The machine and the watchman. An action is a number of hours less one."""
    given = {
        "observation_space": spaces.Box(-1e9, 1e9, (1,), np.float64),
        "observation_space_mapping": lambda works: [works.clock],
        "action_space": spaces.Discrete(8),
        "action_space_mapping": lambda action: action + 1,
        "reward_mapping": difference(lambda works: -cost(works)),
        "agent": "machine",
    }
    watch = {"agent": "watchman", "reward_mapping": lambda works: 0.0}
    return {OPERATE: define(**given | changes), LOOK: define(**given | watch)}


def watched(view, **changes):
    """Both points in a view of the machine, or of both agents."""
    if view == "aec":
        return begun(aec_env(Works, points(**changes)))
    policies = {"watchman": lambda observation: 0}
    return begun(single_env(Works, points(**changes), agent="machine", policies=policies))


def one_agent(model=Works, **changes):
    """The single view of the machine. The watchman is no agent."""
    return begun(single_env(model, {OPERATE: points(**changes)[OPERATE]}))


# -- horizons -------------------------------------------------------------------------------------


@pytest.mark.parametrize("horizon", [0.25, 3.0, 8.5])
@pytest.mark.parametrize("make", [watched, aec_env, parallel_env, turn_env])
def test_action_values_of_equivalent_actions_have_equal_means(make, horizon):
    alone = {OPERATE: points()[OPERATE]}
    env = watched("aec") if make is watched else begun(make(Works, alone))
    told = action_values(env, futures=4, horizon=horizon, horizon_by="time", method="replay")
    assert told.returns == pytest.approx(-horizon)


def test_action_values_horizon_counts_a_share_of_the_last_time_interval():
    env = one_agent(cost=lambda works: works.clock**2)
    told = action_values(env, [7], futures=3, horizon=2.0, horizon_by="time", method="replay")
    seen = action_values(env, [7], futures=3, horizon=1, method="replay")
    ends = np.sqrt(-seen.returns)
    assert told.returns == pytest.approx(seen.returns * 2.0 / ends)


@pytest.mark.parametrize("view", ["single", "aec"])
def test_action_values_horizon_can_end_while_another_agent_decides(view):
    env = watched(view, cost=lambda works: works.clock**2)
    told = action_values(env, [7], futures=3, horizon=2.0, horizon_by="time", method="replay")
    assert told.returns == pytest.approx(-4.0)


def test_action_values_with_terminal_value_count_the_last_interval_in_full():
    env = one_agent()
    given = {"futures": 3, "terminal_value": lambda env: 100.0, "method": "replay"}
    told = action_values(env, [7], horizon=2.0, horizon_by="time", **given)
    assert told.returns == pytest.approx(action_values(env, [7], horizon=1, **given).returns)


@METHODS
@BY_DRIVER
def test_action_values_metric_replaces_rewards(driver, method):
    if driver == "thread" and method == "fork":
        method = None
    env = begun(single_env(Works, {OPERATE: points()[OPERATE]}, driver=driver))
    given = {"futures": 3, "metric": lambda works: len(works.log), "method": method}
    told = action_values(env, [0, 7], **given)
    for index, action in enumerate([0, 7]):
        for future, seed in enumerate(_seeds(env, 3)):
            works = Works()
            works.reset(5)
            works.reseed(seed)
            answers = iter([action + 1])
            works.operate = lambda answers=answers: next(answers, 1)
            works.run()
            assert told.returns[index, future] == len(works.log)
    env.close()


def _seeds(env, number):
    from simenv_marl.planning.players import player_of
    from simenv_marl.planning.rollouts import Rollouts

    return Rollouts(player_of(env, RULE), RolloutPolicy([RULE])).seeds(number)


@pytest.mark.parametrize("make", [aec_env, parallel_env, joint_env, turn_env])
def test_action_values_metric_works_in_every_env(make):
    env = begun(make(Works, {OPERATE: points()[OPERATE]}))
    actions = [{"machine": 7}] if make is joint_env else [7]
    told = action_values(env, actions, metric=lambda works: works.clock, futures=2)
    alone = action_values(one_agent(), [7], metric=lambda works: works.clock, futures=2)
    assert told.returns.shape == (1, 2)
    if make is not joint_env and make is not turn_env:  # whose futures have other seeds
        assert told.returns.tolist() == alone.returns.tolist()


def test_action_values_do_not_warn_of_unused_actions_in_branches():
    env = begun(joint_env(Works, points()))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        action_values(env, [lambda seen: {"machine": 4, "watchman": 0}], hold=None, method="replay")


def test_action_values_metric_is_interpolated_at_the_horizon():
    env = one_agent()
    given = {"futures": 3, "horizon_by": "time", "method": "replay"}
    told = action_values(env, [7, 2], metric=lambda works: works.clock, horizon=2.5, **given)
    assert told.returns == pytest.approx(2.5)


# -- candidates that hold -------------------------------------------------------------------------


def logs(env, candidates, **given):
    """What the machine has done in the one exact future of each candidate, by its metric."""
    hours = {}

    def note(works):
        return float("".join(map(str, works.log[:9])))

    told = action_values(env, candidates, futures=1, metric=note, method="replay", **given)
    for candidate, value in zip(candidates, told.means, strict=True):
        hours[str(candidate)] = f"{value:.0f}"
    return list(hours.values())


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, "211111111"),
        ({"hold": 3}, "222111111"),
        ({"hold": None}, "222222222"),
        ({"hold": 3, "horizon": 5}, "22211"),
    ],
)
def test_action_values_hold_repeats_an_action_for_some_decisions(given, expected):
    assert logs(one_agent(), [1], **given) == [expected]


def test_action_values_hold_time_repeats_an_action_for_a_time():
    env = one_agent()
    [short] = logs(env, [1], hold=1e-9, hold_by="time")
    [long] = logs(env, [1], hold=6.0, hold_by="time")
    assert short == "211111111"
    assert long.startswith("22")
    assert long.endswith("111")


def test_action_values_accept_policies_and_the_rule_as_actions():
    def three(observation):
        return 2

    env = one_agent()
    candidates = [three, RULE, first(4, three), first(RULE, three)]
    assert logs(env, candidates, hold=2, base=lambda observation: 3) == [
        "334444444", "114444444", "533333333", "133333333",
    ]  # fmt: skip


def test_action_values_policies_get_the_simulation_of_their_branch():
    env = one_agent()
    own, seen = env.unwrapped.simulation, []

    def policy(observation, *, _simulation):
        seen.append(_simulation)
        return 3

    action_values(env, [policy], futures=2, horizon=3, base=policy, method="replay")
    assert len(seen) == 6
    assert all(isinstance(works, Works) and works is not own for works in seen)


def test_action_values_refuse_illegal_actions_before_they_branch():
    env = one_agent()
    for wrong in (8, first(8, RULE), "fast"):
        with pytest.raises(InvalidActionError, match="not in"):
            action_values(env, [wrong])
    with pytest.raises(OptionValueError, match="then must be a policy"):
        first(0, 3)
    for given in ({"hold": 0}, {"hold": 1.5}, {"hold": -1.0, "hold_by": "time"}, {"every": 0}):
        with pytest.raises(OptionValueError, match="must be"):
            RolloutPolicy(**given)
    with pytest.raises(OptionValueError, match="metric must return"):
        action_values(env, [1], metric=lambda works: "good", futures=1, method="replay")


def test_rollout_policy_takes_a_callable_that_proposes_actions():
    asked = []

    def propose(observation, info, *, _decision, _incumbent, _simulation):
        assert _simulation is env.unwrapped.simulation
        asked.append((observation.tolist(), info["time"], _decision.agent, _incumbent))
        return [0, 5]

    env = one_agent()
    planner = RolloutPolicy(propose, futures=1, metric=lambda works: -len(works.log), margin=0.0)
    for _ in range(2):
        told = planner.choose(env)
        assert told.actions[:2] == (0, 5)
        assert told.best == 5
        env.step(told.best)
    assert asked[0] == ([0.0], 0.0, "machine", None)
    assert asked[1][3] == 5


@pytest.mark.thorough
def test_rollout_policy_tries_box_actions_around_its_last_choice():
    space = spaces.Box(0.5, 8.0, (1,), np.float64)
    changes = {"action_space": space, "action_space_mapping": lambda action: float(action[0])}

    def propose(observation, *, _incumbent):
        middle = 1.0 if _incumbent is None or _incumbent is RULE else float(_incumbent[0])
        return [np.array([min(8.0, middle * factor)]) for factor in (0.7, 1.4)]

    env = one_agent(**changes)
    planner = RolloutPolicy(propose, futures=2, metric=lambda works: -len(works.log), hold=None)
    chosen = []
    for _ in range(5):
        chosen.append(float(planner.choose(env).best[0]))
        env.step(np.array([chosen[-1]]))
    assert chosen == sorted(chosen)
    assert chosen[0] == pytest.approx(1.4)
    assert chosen[-1] > 3.0


# -- incumbents -----------------------------------------------------------------------------------


def long(observation):
    return 6


def short(observation):
    return 1


def patient(**given):
    """A planner that wants few operations."""
    return RolloutPolicy([short, long], futures=2, metric=lambda works: -len(works.log), **given)


@BY_DRIVER
def test_rollout_policy_every_repeats_its_choice_between_plans(driver):
    planned = []

    class Counting(RolloutPolicy):
        def choose(self, env):
            planned.append(env.unwrapped.simulation.clock)
            return super().choose(env)

    policy = Counting([short, long], futures=2, metric=lambda works: -len(works.log), every=3)
    works = simulate(
        Works, {"machine": policy}, points={OPERATE: points()[OPERATE]}, seed=5, driver=driver
    )
    assert set(works.log) == {7}
    assert len(planned) == -(-len(works.log) // 3)


@pytest.mark.thorough
def test_rollout_policy_tries_its_last_choice_again():
    env = one_agent()
    planner = patient(hold=3)
    planner.actions = lambda observation: [long] if observation[0] == 0.0 else [short]
    told = planner.choose(env)
    assert (told.actions, told.best) == ((long, RULE), long)
    for held in (True, True, False):
        env.step(6)
        told = planner.choose(env)
        assert told.actions == (short, RULE, long)
        assert told.best is long, held


@pytest.mark.thorough
@METHODS
def test_clone_keeps_the_last_choice_of_a_rollout_policy(method):
    env = one_agent()
    planner = patient(hold=None, every=2)
    assert planner.choose(env).best is long
    env.step(6)
    twin = clone(env, method=method)
    planner.actions = [short]
    for each in (env, twin):
        assert planner.choose(each).actions == (short, RULE, long)
        each.close()


@pytest.mark.thorough
@METHODS
def test_clone_keeps_the_last_choices_of_rollout_policies_in_policies(method):
    planner = RolloutPolicy([short, long], futures=2, metric=lambda works: works.clock, every=3)
    env = begun(single_env(Works, points(), agent="watchman", policies={"machine": planner}))
    for _ in range(4):
        env.step(0)
    twin = clone(env, method=method)
    logs = []
    for each in (env, twin):
        while not each.step(0)[2]:
            pass
        logs.append(each.unwrapped.call(lambda view: view.unwrapped.simulation.log))
        each.close()
    assert logs[0] == logs[1]
    assert len(set(logs[0])) > 1


def test_rollout_policy_forgets_its_last_choice_in_a_new_episode():
    env = one_agent()
    planner = patient()
    planner.choose(env)
    planner.actions = [short]
    env.reset(seed=5)
    assert planner.choose(env).actions == (short, RULE)


def test_rollout_policy_keeps_the_rule_or_last_choice_over_worse_actions():
    env = one_agent()
    planner = patient(hold=None)
    planner.choose(env)
    planner.actions = [short]
    assert planner.choose(env).best is long
    worse = patient(hold=None)
    worse.metric = lambda works: len(works.log)
    assert worse.choose(env).best is RULE


# -- deterministic models -------------------------------------------------------------------------


class Fixed(Works):
    deterministic = True
    reseed = None

    def reset(self, seed=None):
        super().reset(1)


@pytest.mark.parametrize("kind", [RolloutPolicy, TreeSearchPolicy])
def test_action_values_of_a_deterministic_model_use_one_future(kind):
    env = begun(single_env(Fixed, {OPERATE: points()[OPERATE]}))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        told = kind([0, 6], futures=8, metric=lambda works: -len(works.log)).choose(env)
    assert told.best == 6
    assert told.returns.shape[1] == 1 or kind is TreeSearchPolicy


# -- tree search ----------------------------------------------------------------------------------


def test_tree_search_policy_branches_after_each_held_action():
    env = begun(single_env(Fixed, {OPERATE: points()[OPERATE]}))
    found = set()

    def metric(works):
        found.add("".join(map(str, works.log[:5])))
        return -len(works.log)

    given = {"hold": 2, "depth": 2, "budget": 40, "exploration": 100.0, "method": "replay"}
    assert TreeSearchPolicy([1, 2], metric=metric, **given).choose(env).best == 2
    assert found == {"22111", "33111", "11111", "22221", "22331", "33221", "33331"}
