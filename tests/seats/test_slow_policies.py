"""Policies that are coroutine functions, and policies that get the pending decision."""

import asyncio
import os
import signal
import threading
import time
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import RULE, aec_env, evaluate, simulate, simulate_many, single_env
from simenv_marl.data import Mixture, collect_episodes, compare_with_rule
from simenv_marl.errors import InvalidActionError, OptionValueError, ReentrancyError
from simenv_marl.planning import RolloutPolicy, action_values
from simenv_marl.seats import FallbackPolicy, RecordedPolicy
from tests.worlds.models import follow_the_rule, stacks
from tests.worlds.seats import FILL, POINTS, Tank, experiment, filling, levels, log_of, played


def quick(observation):
    return int(observation[0] < 5) * 2


async def slow(observation):
    await asyncio.sleep(0.002)
    action = quick(observation)
    observation[:] = 99  # which is its own
    return action


def batched(observations):
    return [quick(observation) for observation in observations]


def in_an_environment(policy):
    env = aec_env(Tank, POINTS, policies={"filler": policy})
    return follow_the_rule(env, seed=3).log


def collected(policy):
    found = collect_episodes(
        Tank, {"filler": policy}, seeds=range(4), points=POINTS, concurrency=3
    )["filler"]
    return [found.actions.tolist(), found.observations.tolist(), found.rewards.tolist()]


def in_a_notebook(policy):
    async def notebook():  # where an event loop runs already
        return levels(policy, concurrency=3)

    return asyncio.run(notebook())


def compared(policy):
    found = compare_with_rule(Tank, {"filler": policy}, seeds=range(3), points={Tank.fill: FILL})[
        "filler"
    ]
    return found.policy_actions.tolist()


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("run", "plain"),
    [
        (played, quick),
        (in_an_environment, quick),
        *[(partial(levels, concurrency=number, workers=2), batched) for number in (1, 64)],
        *[(partial(levels, concurrency=number), batched) for number in (1, 3, 64)],
        (collected, batched),
        (compared, batched),
        (in_a_notebook, batched),
    ],
)
def test_coroutine_policy_decides_like_a_plain_policy(run, plain):
    assert run(slow) == run(plain)


@pytest.mark.parametrize("run", [played, in_an_environment, compared, collected])
@pytest.mark.parametrize("wrap", [
    lambda policy: policy, FallbackPolicy, lambda policy: RecordedPolicy(policy, os.devnull),
    partial(FallbackPolicy, batched),  # which fails
])  # fmt: skip
def test_policies_can_return_extras_in_simulate_and_collect_episodes(run, wrap):
    async def later(observation):
        return await slow(observation), {"odds": 0.5}

    assert run(wrap(later)) == run(slow)


def test_policy_returning_a_tuple_action_is_not_mistaken_for_extras():
    pair = spaces.Tuple([spaces.Discrete(3), spaces.Dict({"odds": spaces.Discrete(2)})])
    seen = []
    points = {Tank.fill: filling(pair, lambda action: seen.append(action) or 1.0)}
    for answer in ((2, {"odds": 1}), ((2, {"odds": 1}), {"odds": 0})):
        played(FallbackPolicy(lambda observation, answer=answer: answer), points=points)
    assert seen == [(2, {"odds": 1})] * 10


@pytest.mark.parametrize("run", [
    lambda policy: levels(policy, concurrency=4),
    lambda policy: evaluate(
        Tank, {"it": {"filler": policy}}, seeds=range(6), points=POINTS, concurrency=4
    ),
])  # fmt: skip
def test_concurrency_option_limits_how_many_coroutine_policies_run(run):
    waiting, most = 0, 0

    async def counted(observation):
        nonlocal waiting, most
        waiting += 1
        most = max(most, waiting)
        await asyncio.sleep(0.02)
        waiting -= 1
        return 0

    run(counted)
    assert most == 4


def test_batched_policies_are_asked_in_batches_beside_coroutine_policies():
    sizes = []

    def downwards(observations):
        sizes.append(len(observations))
        return np.zeros(len(observations), int)

    seeds = range(6)
    found = simulate_many(
        Tank, {"filler": slow, "drainer": downwards}, seeds=seeds, points=POINTS, collect=log_of
    )
    plain = {"filler": quick, "drainer": lambda observation: 0}
    assert found == [simulate(Tank, plain, points=POINTS, seed=seed).log for seed in seeds]
    assert sum(sizes) == 6 * Tank.days


def test_coroutine_policies_give_the_same_results_as_plain_policies(tmp_path):
    contenders, seeds = {"slow": {"filler": slow}, "quick": {"filler": quick}}, range(6)
    values = evaluate(Tank, contenders, seeds=seeds, points=POINTS, concurrency=5).values()
    assert (values["slow"] == values["quick"]).all()
    table = experiment(contenders, tmp_path, seeds=seeds, concurrency=5)
    team = table[table["agent"] == "team"].set_index(["contender", "seed"])["return"]
    assert (team["slow"] == values["slow"]).all()
    assert (team["quick"] == values["slow"]).all()


def test_coroutine_policy_that_fails_does_not_stop_other_decisions(tmp_path):
    async def sometimes(observation, *, _decision):
        await asyncio.sleep(0.001)
        if _decision.seed == 2:
            raise ZeroDivisionError("no")
        return 0

    table = experiment({"slow": {"filler": sometimes}}, tmp_path, seeds=range(4))
    failed = table[table["status"] == "error"]
    assert failed[["contender", "seed"]].to_numpy().tolist() == [["slow", 2]]
    assert "no" in failed["error"].iloc[0]


@pytest.mark.parametrize("run", [
    lambda policy: played(policy, seed=0),
    lambda policy: levels(policy, concurrency=2),
    lambda policy: evaluate(Tank, {"it": {"filler": policy}}, seeds=range(4), points=POINTS),
])  # fmt: skip
def test_coroutine_policy_error_is_raised_and_leaves_no_tasks(run):
    ended = []

    async def failing(observation, info, *, _decision):
        try:
            await asyncio.sleep(0.001 if _decision.seed == 0 else 60)
        finally:
            ended.append(_decision.seed)
        raise ZeroDivisionError("of a coroutine")

    before = stacks()
    with pytest.raises(ZeroDivisionError, match="of a coroutine") as caught:
        run(failing)
    assert any("'filler'" in note and "seed 0" in note for note in caught.value.__notes__)
    assert len(ended) >= 1
    caught = None
    assert stacks() <= before


def test_coroutine_policy_system_exit_is_raised():
    async def leaves(observation):
        raise SystemExit(3)

    with pytest.raises(SystemExit):
        levels(leaves)
    assert levels(slow) == levels(batched)


def test_keyboard_interrupt_cancels_coroutine_policies_and_simulations():
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

    for play in (partial(levels, concurrency=3), played):
        begun, thread = threading.Event(), threading.Thread(target=interrupt)
        thread.start()
        with pytest.raises(KeyboardInterrupt):
            play(endless)
        thread.join()
    assert sorted(cancelled) == [0, 1, 2, 3]


def test_coroutine_policies_run_on_one_event_loop_in_all_simulations():
    loops = set()

    async def noting(observation):
        loops.add(asyncio.get_running_loop())
        return 0

    levels(noting)
    played(noting)
    assert len(loops) == 1


@pytest.mark.parametrize("policy", [slow, RolloutPolicy(), FallbackPolicy(quick)])
def test_mixture_refuses_coroutine_policies(policy):
    with pytest.raises(OptionValueError, match="one decision at a time"):
        Mixture({policy: 1.0})


async def planner(observation, *, _environment):
    return 0


async def nested(observation):
    return len(played(slow))


async def illegal(observation):
    return 9


@pytest.mark.parametrize(
    ("policy", "error", "match"),
    [
        (planner, OptionValueError, "waits, and asks for _environment"),
        (lambda observation: slow(observation), OptionValueError, "async def"),
        (FallbackPolicy(lambda observation: slow(observation)), OptionValueError, "async def"),
        (nested, ReentrancyError, "to_thread"),
        (illegal, InvalidActionError, "action 9"),
    ],
)
def test_coroutine_policy_in_an_env_raises_an_error_with_a_remedy(policy, error, match):
    with pytest.raises(error, match=match):
        played(policy)


def test_coroutine_policy_can_wait_for_work_in_a_thread():
    async def threaded(observation):
        return len(await asyncio.to_thread(played, slow)) - 3

    assert played(threaded) == played(lambda observation: 2)


def test_partial_coroutine_functions_and_objects_work_as_policies():
    class Asked:
        async def __call__(self, more, observation):
            return 2

    assert played(partial(Asked(), "more")) == played(lambda observation: 2)


# -- the pending decision -------------------------------------------------------------------------


@pytest.mark.parametrize("waits", [False, True])
@pytest.mark.parametrize("many", [False, True])
def test_policy_with_decision_parameter_gets_the_pending_decision(waits, many):
    seen = []

    def plain(observation, *, _decision):
        seen.append(_decision)
        np.testing.assert_array_equal(observation, _decision.observation)
        return 1

    async def coroutine(observation, *, _decision):
        return plain(observation, _decision=_decision)

    points = {
        Tank.fill: replace(FILL, action_labels=lambda tank: [f"{tank.level}", "half", "open"])
    }
    policy = coroutine if waits else plain
    levels(policy, [7], points) if many else played(policy, 7, points)
    first, second = seen[:2]
    assert (first.agent, first.seed, first.time, first.reward) == ("filler", 7, 0.0, 0.0)
    assert first.point.endswith("Tank.fill")
    assert first.doc == "Choose how much water flows in."
    assert [decision.number for decision in seen] == [1, 2, 3, 4, 5]
    assert second.time == 1.0
    # the level since the first decision
    assert second.reward == pytest.approx(second.observation[0])
    assert first.action_labels == {0: "5.0", 1: "half", 2: "open"}
    assert first.observation_labels == ("level",)
    assert first.mask is None
    assert first.choices is None
    assert not first.in_clone


def test_policy_that_changes_its_decision_object_affects_nothing_else():
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
        played(spoil, points={Tank.fill: replace(FILL, **given)})


def test_pending_decision_adds_up_rewards_of_skipped_decisions():
    rewards = []

    def plain(observation, *, _decision):
        rewards.append((_decision.number, _decision.reward))
        return 0

    def forced(tank):
        return [1, 0, 0] if tank.day % 2 == 0 else [1, 1, 1]

    points = {Tank.fill: replace(FILL, action_mask_mapping=forced)}
    log = played(plain, points=points, skip_forced=True)
    assert [number for number, _ in rewards] == [2, 4]
    assert rewards[0][1] == 0.0  # nothing was asked before; that reward adds to the next one
    assert rewards[1][1] == pytest.approx(sum(log[:3]))
    seen = [*rewards]
    evaluate(Tank, {"it": {"filler": plain}}, points=points, seeds=[3], skip_forced=True)
    assert rewards[2:] == seen


# -- in clones ------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_planning_with_a_coroutine_base_uses_the_models_rule():
    async def never(observation):
        raise AssertionError("it is asked in a branch")

    def alternating(observation, *, _decision):
        assert _decision.in_clone
        agents.add(_decision.agent)
        return _decision.number % 2

    def values(env, base):
        env.reset(seed=1)
        return action_values(env, base=base, futures=3, horizon=3, method="replay").means.tolist()

    def planned(base):
        planner = RolloutPolicy(
            base={"filler": base}, futures=2, horizon=3, margin=0.0, method="replay"
        )
        return simulate(Tank, {"drainer": planner}, points=POINTS, seed=4).log

    agents, single, turns = set(), single_env(Tank, POINTS, agent="drainer"), aec_env(Tank, POINTS)
    assert values(turns, {"drainer": never}) == values(turns, RULE)
    assert values(single, never) == values(single, RULE)
    assert planned(never) == planned(RULE)
    # its second decision is 0
    assert values(single, alternating)[0] > values(single, lambda observation: 1)[0]
    assert len(planned(alternating)) == Tank.days
    assert agents == {"filler", "drainer"}
