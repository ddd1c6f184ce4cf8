"""Policies that are coroutine functions, and policies that get the pending decision."""

import asyncio
import contextlib
import gc
import os
import signal
import threading
import time
from dataclasses import replace
from functools import partial

import greenlet
import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import RULE, aec_env, branch, clone, evaluate, simulate, simulate_many, single_env
from simenv_marl.data import Mixture, collect_episodes, compare_with_rule
from simenv_marl.errors import InvalidActionError, OptionValueError, ReentrancyError
from simenv_marl.experiments import run_experiment
from simenv_marl.planning import RolloutPolicy, action_values
from simenv_marl.seats import FallbackPolicy

from .tank import POINTS, Tank, level_of


def action_for(observation):
    return int(observation[0] < 5) * 2


async def slow(observation):
    await asyncio.sleep(0.002)
    action = action_for(observation)
    observation[:] = 99  # which is its own
    return action


def quick(observation):
    return action_for(observation)


def levels(policy, **options):
    return simulate_many(Tank, {"filler": policy}, seeds=range(6), points=POINTS, collect=level_of, **options)


def test_a_coroutine_function_answers_as_a_function_does():
    plain = simulate(Tank, {"filler": quick}, points=POINTS, seed=3)
    assert simulate(Tank, {"filler": slow}, points=POINTS, seed=3).log == plain.log
    env = aec_env(Tank, POINTS, policies={"filler": slow})
    env.reset(seed=3)
    while env.agents:
        env.step(None if env.terminations[env.agent_selection] else RULE)
    assert env.unwrapped.simulation.log == plain.log


@pytest.mark.parametrize("concurrency", [1, 3, 64])
@pytest.mark.parametrize("workers", [0, 2])
def test_results_do_not_depend_on_concurrency_and_workers(concurrency, workers):
    expected = [level_of(simulate(Tank, {"filler": quick}, points=POINTS, seed=seed)) for seed in range(6)]
    assert levels(slow, concurrency=concurrency, workers=workers) == expected


def test_as_many_decisions_wait_at_once_as_concurrency_says():
    waiting, most = 0, 0

    async def counted(observation):
        nonlocal waiting, most
        waiting += 1
        most = max(most, waiting)
        await asyncio.sleep(0.02)
        waiting -= 1
        return 0

    levels(counted, concurrency=4)
    assert most == 4


def test_quick_policies_are_asked_in_batches_beside_slow_ones():
    sizes = []

    def batched(observations):
        sizes.append(len(observations))
        return np.zeros(len(observations), int)

    policies = {"filler": slow, "drainer": batched}
    found = simulate_many(Tank, policies, seeds=range(6), points=POINTS, collect=level_of)
    plain = {"filler": quick, "drainer": lambda observation: 0}
    assert found == [level_of(simulate(Tank, plain, points=POINTS, seed=seed)) for seed in range(6)]
    assert sum(sizes) == 6 * Tank.days


def test_trajectories_of_slow_policies_are_those_of_quick_ones():
    one = collect_episodes(Tank, {"filler": slow}, seeds=range(4), points=POINTS, concurrency=3)["filler"]
    other = collect_episodes(
        Tank, {"filler": lambda rows: [action_for(row) for row in rows]}, seeds=range(4), points=POINTS
    )
    np.testing.assert_array_equal(one.actions, other["filler"].actions)
    np.testing.assert_array_equal(one.observations, other["filler"].observations)
    np.testing.assert_array_equal(one.rewards, other["filler"].rewards)


def test_evaluations_and_experiments_wait_for_many_episodes_at_once(tmp_path):
    waiting, most = 0, 0

    async def counted(observation, info):
        nonlocal waiting, most
        waiting += 1
        most = max(most, waiting)
        await asyncio.sleep(0.005)
        waiting -= 1
        return action_for(observation)

    contenders = {"slow": {"filler": counted}, "quick": {"filler": quick}}
    found = evaluate(Tank, contenders, seeds=range(6), points=POINTS, concurrency=5)
    assert most == 5
    values = found.values()
    assert (values["slow"] == values["quick"]).all()
    table = run_experiment(
        lambda days: Tank(),
        [{"days": 5}],
        contenders=contenders,
        seeds=range(6),
        points=POINTS,
        store=tmp_path,
        concurrency=5,
    )
    team = table[table["agent"] == "team"].set_index(["contender", "seed"])["return"]
    assert (team["slow"] == team["quick"]).all()
    assert (team["slow"] == values["slow"]).all()


def test_a_row_that_fails_does_not_stop_the_others_that_wait(tmp_path):
    async def sometimes(observation, *, _decision):
        await asyncio.sleep(0.001)
        if _decision.seed == 2:
            raise ZeroDivisionError("no")
        return 0

    table = run_experiment(
        lambda days: Tank(),
        [{"days": 5}],
        contenders={"slow": {"filler": sometimes}},
        seeds=range(4),
        points=POINTS,
        store=tmp_path,
    )
    failed = table[table["status"] == "error"]
    assert failed[["contender", "seed"]].to_numpy().tolist() == [["slow", 2]]
    assert "no" in failed["error"].iloc[0]


def test_comparisons_with_the_rule_take_policies_that_are_asked_alone():
    plain = lambda rows: [action_for(row) for row in rows]  # noqa: E731
    points = {Tank.fill: POINTS[Tank.fill]}
    one = compare_with_rule(Tank, {"filler": slow}, seeds=range(3), points=points)["filler"]
    other = compare_with_rule(Tank, {"filler": plain}, seeds=range(3), points=points)["filler"]
    np.testing.assert_array_equal(one.policy_actions, other.policy_actions)


@pytest.mark.parametrize("run", [
    lambda policy: simulate(Tank, {"filler": policy}, points=POINTS, seed=0),
    lambda policy: levels(policy, concurrency=2),
    lambda policy: evaluate(Tank, {"it": {"filler": policy}}, seeds=range(4), points=POINTS),
])  # fmt: skip
def test_an_error_of_a_coroutine_surfaces_and_nothing_is_left(run):
    ended = []

    async def failing(observation, info, *, _decision):
        try:
            await asyncio.sleep(0.001 if _decision.seed == 0 else 60)
        finally:
            ended.append(_decision.seed)
        raise ZeroDivisionError("of a coroutine")

    greenlets = sum(isinstance(thing, greenlet.greenlet) and not thing.dead for thing in gc.get_objects())
    with pytest.raises(ZeroDivisionError, match="of a coroutine") as caught:
        run(failing)
    assert any("'filler'" in note and "seed 0" in note for note in caught.value.__notes__)
    started = len(ended)
    caught = None
    gc.collect()
    assert started >= 1
    assert sum(isinstance(thing, greenlet.greenlet) and not thing.dead for thing in gc.get_objects()) == greenlets


def test_an_exit_in_a_coroutine_surfaces_and_later_coroutines_are_answered():
    async def leaves(observation):
        raise SystemExit(3)

    with pytest.raises(SystemExit):
        levels(leaves)
    assert levels(slow) == levels(lambda rows: [action_for(row) for row in rows])


def test_ctrl_c_cancels_the_coroutines_and_unwinds_the_simulations():
    cancelled = []

    async def endless(observation, *, _decision):
        try:
            begun.set()
            await asyncio.sleep(600)
        except asyncio.CancelledError:
            await asyncio.sleep(0.01)
            cancelled.append(_decision.seed)
            raise

    def interrupt():
        begun.wait(10)
        time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    for play in (
        partial(levels, concurrency=3),
        lambda policy: simulate(Tank, {"filler": policy}, points=POINTS, seed=3),
    ):
        begun, thread = threading.Event(), threading.Thread(target=interrupt)
        thread.start()
        with pytest.raises(KeyboardInterrupt):
            play(endless)
        thread.join()
    assert sorted(cancelled) == [0, 1, 2, 3]


def test_it_works_where_an_event_loop_runs_already():
    async def notebook():
        return levels(slow, concurrency=3)

    assert asyncio.run(notebook()) == levels(slow)


def test_clients_keep_their_event_loop_from_call_to_call():
    loops = set()

    async def noting(observation):
        loops.add(asyncio.get_running_loop())
        return 0

    levels(noting)
    simulate(Tank, {"filler": noting}, points=POINTS, seed=0)
    assert len(loops) == 1


def test_a_coroutine_cannot_get_the_environment():
    async def planner(observation, *, _environment):
        return 0

    with pytest.raises(OptionValueError, match="waits, and asks for _environment"):
        simulate(Tank, {"filler": planner}, points=POINTS, seed=0)


@pytest.mark.parametrize("policy", [slow, RolloutPolicy(), FallbackPolicy(quick)])
def test_a_mixture_refuses_policies_that_are_asked_alone(policy):
    with pytest.raises(OptionValueError, match="one decision at a time"):
        Mixture({policy: 1.0})


def test_labels_for_each_call_reach_coroutines_in_many_simulations():
    points = {Tank.fill: replace(POINTS[Tank.fill], action_labels=lambda tank: [f"{tank.level}", "b", "c"])}
    labels = []

    async def noting(observation, *, _decision):
        labels.append(_decision.action_labels[0])
        return 0

    simulate_many(Tank, {"filler": noting}, points=points, seeds=[1])
    assert labels[0] == "5.0"


def test_a_coroutine_that_waits_for_others_is_told_of_threads():
    async def nested(observation):
        return len(simulate(Tank, {"filler": slow}, points=POINTS, seed=1).log)

    async def threaded(observation):
        await asyncio.to_thread(simulate, Tank, {"filler": slow}, points=POINTS, seed=1)
        return 0

    with pytest.raises(ReentrancyError, match="to_thread"):
        simulate(Tank, {"filler": nested}, points=POINTS, seed=0)
    assert len(simulate(Tank, {"filler": threaded}, points=POINTS, seed=0).log) == Tank.days


def test_partial_coroutine_functions_and_objects_are_awaited():
    class Asked:
        async def __call__(self, more, observation):
            return 2

    plain = simulate(Tank, {"filler": lambda observation: 2}, points=POINTS, seed=0).log
    assert simulate(Tank, {"filler": partial(Asked(), "more")}, points=POINTS, seed=0).log == plain


@pytest.mark.parametrize("wrap", [lambda policy: policy, FallbackPolicy])
def test_a_function_that_returns_an_awaitable_is_told_what_to_do(wrap):
    with pytest.raises(OptionValueError, match="async def"):
        simulate(Tank, {"filler": wrap(lambda observation: slow(observation))}, points=POINTS, seed=0)


def test_an_illegal_answer_of_a_coroutine_is_an_error():
    async def illegal(observation):
        return 9

    with pytest.raises(InvalidActionError, match="action 9"):
        levels(illegal)


# -- the pending decision -------------------------------------------------------------------------


@pytest.mark.parametrize("waits", [False, True])
@pytest.mark.parametrize("many", [False, True])
def test_a_policy_gets_the_pending_decision(waits, many):
    seen = []

    def answer(observation, _decision):
        seen.append(_decision)
        np.testing.assert_array_equal(observation, _decision.observation)
        return 1

    def plain(observation, *, _decision):
        return answer(observation, _decision)

    async def coroutine(observation, *, _decision):
        return answer(observation, _decision)

    policies = {"filler": coroutine if waits else plain}
    if many:
        simulate_many(Tank, policies, seeds=[7], points=POINTS)
    else:
        simulate(Tank, policies, points=POINTS, seed=7)
    first, second = seen[:2]
    assert (first.agent, first.seed, first.time, first.reward) == ("filler", 7, 0.0, 0.0)
    assert first.point.endswith("Tank.fill")
    assert first.doc == "Choose how much water flows in."
    assert [decision.number for decision in seen] == [1, 2, 3, 4, 5]
    assert second.time == 1.0
    assert second.reward == pytest.approx(second.observation[0])  # the level since the first decision
    assert first.action_labels == {0: "closed", 1: "half", 2: "open"}
    assert first.observation_labels == ("level",)
    assert first.mask is None
    assert first.choices is None
    assert not first.in_clone


def test_what_a_policy_does_to_its_decision_changes_nothing_else():
    def spoil(observation, *, _decision):
        assert _decision.observation_labels == {"level": "Level"}
        before = float(observation["level"][0])
        _decision.observation["level"][:] = before + 1
        _decision.observation_labels.clear()
        _decision.choices.clear()
        _decision.mask[:] = 1
        assert observation["level"] == before
        return 2 * (_decision.number - 1)

    given = {
        "observation_space": spaces.Dict({"level": spaces.Box(-50, 50, (1,))}),
        "observation_space_mapping": lambda tank: {"level": [tank.level]},
        "observation_labels": {"level": "Level"},
        "action_labels": None,
        "action_space_mapping": None,
        "choices": lambda tank: [0.0, 1.0],
    }
    with pytest.raises(InvalidActionError, match="masked"):
        simulate(Tank, {"filler": spoil}, points={Tank.fill: replace(POINTS[Tank.fill], **given)}, seed=0)


def test_rewards_of_forced_moves_add_up_in_the_pending_decision():
    rewards = []

    def plain(observation, *, _decision):
        rewards.append((_decision.number, _decision.reward))
        return 0

    def forced(tank):
        return [1, 0, 0] if tank.day % 2 == 0 else [1, 1, 1]

    points = {Tank.fill: replace(POINTS[Tank.fill], action_mask_mapping=forced)}
    tank = simulate(Tank, {"filler": plain}, points=points, seed=0, skip_forced=True)
    assert [number for number, _ in rewards] == [2, 4]
    assert rewards[0][1] == 0.0  # nothing was asked before; that reward adds to the next one
    assert rewards[1][1] == pytest.approx(sum(tank.log[:3]))
    seen = [*rewards]
    evaluate(Tank, {"it": {"filler": plain}}, points=points, seeds=[0], skip_forced=True)
    assert rewards[2:] == seen


# -- in clones ------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["fork", "replay"])
def test_a_coroutine_is_not_asked_in_clones_and_branches(method):
    asked = []

    async def noting(observation):
        asked.append(float(observation[0]))
        return 2

    env = single_env(Tank, POINTS, agent="drainer", policies={"filler": noting})
    env.reset(seed=1)
    number = len(asked)
    by_rule = single_env(Tank, POINTS, agent="drainer", policies={"filler": lambda observation: 2})
    by_rule.reset(seed=1)

    def rest(env, _=0):
        rewards = []
        with contextlib.suppress(Exception):
            while True:
                _, reward, terminated, *_rest = env.step(0)
                rewards.append(reward)
                if terminated:
                    break
        return rewards

    twin = clone(env, method=method)
    values = rest(twin)
    twin.close()
    assert len(asked) == number  # the fork would hide it, the replay not
    assert values == branch(env, rest, 1, method=method)[0]
    assert values != rest(by_rule)
    assert len(values) == Tank.days


def test_planners_leave_the_decisions_of_coroutines_to_the_rule():
    async def never(observation):
        raise AssertionError("it is asked in a branch")

    env = aec_env(Tank, POINTS)
    env.reset(seed=1)
    one = action_values(env, base={"drainer": never}, futures=3, horizon=2)
    other = action_values(env, futures=3, horizon=2)
    np.testing.assert_array_equal(one.means, other.means)


def test_a_base_that_asks_for_the_decision_gets_it_in_branches():
    def base(observation, *, _decision):
        assert _decision.in_clone
        assert _decision.agent == "drainer"
        return _decision.number % 2

    env = single_env(Tank, POINTS, agent="drainer")
    env.reset(seed=1)
    plain = action_values(env, base=lambda observation: 1, futures=2, horizon=2, method="replay")
    found = action_values(env, base=base, futures=2, horizon=2, method="replay")
    assert found.means[0] > plain.means[0]  # the second decision of the base is 0


def test_a_base_of_another_agent_that_waits_is_the_rule_and_one_that_asks_gets_the_decision():
    async def never(observation):
        raise AssertionError("it is asked in a branch")

    def odd(observation, *, _decision):
        return 2 * (_decision.number % 2)

    def plan(base):
        planner = RolloutPolicy(base={"filler": base}, futures=2, horizon=3, margin=0.0, method="replay")
        return simulate(Tank, {"drainer": planner}, points=POINTS, seed=4).log

    assert plan(never) == plan(RULE)
    assert len(plan(odd)) == Tank.days
