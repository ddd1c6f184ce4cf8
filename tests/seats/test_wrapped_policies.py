"""Fallbacks for policies that fail, and recordings of answers."""

import asyncio
import copy
import os
import pickle
import time
from contextlib import suppress

import pytest

from simenv_marl import RULE, branch, clone, evaluate, single_env
from simenv_marl.errors import DefinitionError, InvalidActionError, OptionValueError
from simenv_marl.seats import FallbackPolicy, RecordedPolicy
from tests.worlds.seats import FILL, POINTS, Tank, experiment, levels, played


def counted(**numbers):
    kinds = ("asked", "retried", "late", "refused", "http", "failed", "illegal", "fallbacks")
    return dict.fromkeys(kinds, 0) | numbers


def raises(observation):
    raise ZeroDivisionError("of the policy")


async def raises_later(observation):
    await asyncio.sleep(0.001)
    raise ZeroDivisionError("of the policy")


def late(observation):
    time.sleep(0.003)
    return 2


async def never(observation):
    await asyncio.sleep(600)


async def stubborn(observation):
    for _ in range(9):
        with suppress(asyncio.CancelledError):
            await asyncio.sleep(0.1)


async def cancelled(observation):
    raise asyncio.CancelledError


def cancelled_at_once(observation):
    raise asyncio.CancelledError


async def exits(observation):
    raise SystemExit


class BusyError(Exception):
    status_code = 503


def busy(observation):
    raise BusyError


def illegal(observation):
    return 9


async def illegal_later(observation):
    return 9


def one(observation):
    return 1


def two(observation):
    return 2


@pytest.mark.parametrize("retries", [0, 2])
@pytest.mark.parametrize(("policy", "kind"), [
    (raises, "failed"), (raises_later, "failed"), (late, "late"), (never, "late"),
    (stubborn, "late"), (cancelled, "failed"), (cancelled_at_once, "failed"), (busy, "http"),
    (illegal, "illegal"), (illegal_later, "illegal"),
])  # fmt: skip
def test_fallback_policy_answers_after_the_retries_and_counts_it(policy, kind, retries):
    timeout = 0.002 if kind == "late" else None  # others may be late, too, on a busy machine
    guarded = FallbackPolicy(policy, one, timeout=timeout, retries=retries)
    assert played(guarded) == played(one)
    tries = Tank.days * (1 + retries)
    assert guarded.counts == counted(asked=5, fallbacks=5, retried=tries - 5, **{kind: tries})
    assert guarded.last_error is not None


def test_fallback_policy_raises_system_exit_of_a_coroutine():
    with pytest.raises(SystemExit):
        played(FallbackPolicy(exits))
    assert played(FallbackPolicy(illegal_later)) == played(RULE)


def test_fallback_policy_uses_an_answer_after_a_retry():
    tries = []

    def second(observation):
        tries.append(1)
        if len(tries) % 2:
            raise ZeroDivisionError
        return 2

    guarded = FallbackPolicy(second, retries=1)
    assert played(guarded) == played(two)
    assert guarded.counts == counted(asked=5, retried=5, failed=5)


def by_number(observation, *, _decision):
    return _decision.number % 3


async def by_number_later(observation, *, _decision):
    await asyncio.sleep(0)
    return _decision.number % 3


def planner(observation, *, _environment):
    return 2 * (_environment.unwrapped.simulation.level < 5)


@pytest.mark.parametrize(
    ("arguments", "plain", "faults"),
    [
        ((lambda observation, info: 2,), two, {}),
        ((lambda observation: RULE,), RULE, {}),
        ((planner,), lambda observation: 2 * (observation[0] < 5), {}),
        ((raises,), RULE, {"failed": 5, "fallbacks": 5}),
        ((raises, by_number_later), by_number, {"failed": 5, "fallbacks": 5}),
        ((illegal, lambda observation, *, _environment: 1), one, {"illegal": 5, "fallbacks": 5}),
    ],
)
def test_fallback_policy_takes_every_kind_of_policy_and_rule(arguments, plain, faults):
    guarded = FallbackPolicy(*arguments, timeout=60)
    assert played(guarded) == played(plain)
    assert guarded.counts == counted(asked=5, **faults)
    assert (guarded.last_error is None) == (not faults)


def test_fallback_policy_raises_an_error_for_its_fallbacks_illegal_action():
    with pytest.raises(InvalidActionError, match="action 9"):
        played(FallbackPolicy(raises, illegal))


@pytest.mark.parametrize("arguments", [
    {"policy": 3}, {"fallback": 3}, {"timeout": 0}, {"timeout": "1"},
    {"retries": -1}, {"retries": True},
])  # fmt: skip
def test_fallback_policy_refuses_invalid_arguments(arguments, tmp_path):
    with pytest.raises(OptionValueError, match=next(iter(arguments))):
        FallbackPolicy(**{"policy": raises, **arguments})
    with pytest.raises(DefinitionError, match="keyword-only"):
        FallbackPolicy(lambda observation, _decision: 1)
    with pytest.raises(OptionValueError, match="no folder"):
        RecordedPolicy(raises, tmp_path / "missing" / "answers")


# -- in tables ------------------------------------------------------------------------------------


async def sometimes(observation, *, _decision):
    if _decision.seed % 2 and _decision.number == 1:
        raise ZeroDivisionError
    return 1


@pytest.mark.thorough
@pytest.mark.parametrize("workers", [0, 2])
def test_fallback_policy_counts_are_kept_per_agent_and_seed(workers, tmp_path):
    guarded, seeds = FallbackPolicy(sometimes), range(4)
    contenders = {"guarded": {"filler": guarded}, "plain": {"filler": one}}
    found = evaluate(Tank, contenders, seeds=seeds, points=POINTS, workers=workers)
    own = found.frame[(found.frame["contender"] == "guarded")]
    for agent, expected in (("filler", [0, 1, 0, 1]), ("drainer", [0] * 4), ("team", [0, 1, 0, 1])):
        assert own[own["agent"] == agent].sort_values("seed")["fallbacks"].tolist() == expected
    assert guarded.counts == counted(asked=20, failed=2, fallbacks=2)
    for many in (workers, 0):  # the second time nothing is run
        frame = experiment(contenders, tmp_path, seeds=seeds, workers=many)
        team = frame[(frame["agent"] == "team") & (frame["contender"] == "guarded")]
        assert team["fallbacks"].tolist() == [0, 1, 0, 1]
    levels(guarded, seeds, workers=workers)
    assert guarded.counts == counted(asked=60, failed=6, fallbacks=6)


def test_fallback_policy_share_counts_only_decisions_of_the_wrapped_policy():
    async def counting(observation, *, _decision):
        _decision.count(tokens=3, words=1)
        return await sometimes(observation, _decision=_decision)

    contenders = {"guarded": {"filler": FallbackPolicy(counting)}, "plain": {"filler": one}}
    found = evaluate(Tank, contenders, seeds=range(4), points=POINTS)
    assert found.summary()["fallbacks"].tolist() == [0.1, 0.0]
    seats = found.seats.set_index(["contender", "agent"])
    assert seats.loc[("guarded", "filler"), "seconds"] > 0
    assert seats.drop(columns=["seconds", "failed"]).to_dict("index") == {
        ("guarded", "filler"): {
            "decisions": 20, "asked": 20, "fallbacks": 2, "tokens": 60, "words": 20
        },
        **{
            key: {"decisions": 20, "asked": 0, "fallbacks": 0, "tokens": 0, "words": 0}
            for key in (("guarded", "drainer"), ("plain", "filler"), ("plain", "drainer"))
        },
    }  # fmt: skip


def test_evaluate_counts_the_seconds_until_a_coroutine_policy_has_answered():
    async def slow(observation, *, _decision):
        await asyncio.sleep(0.01)
        return 1

    found = evaluate(Tank, {"slow": {"filler": slow}}, seeds=[0], points=POINTS)
    seats = found.seats.set_index("agent")
    assert seats.loc["filler", "seconds"] >= 0.009 * seats.loc["filler", "decisions"]


def test_evaluate_summary_marks_contenders_with_many_fallbacks():
    contenders = {
        "bad": {"filler": FallbackPolicy(raises)},
        "good": {"filler": FallbackPolicy(one)},
    }
    found = evaluate(Tank, contenders, seeds=range(3), points={Tank.fill: FILL})
    summary = found.summary()
    assert summary["fallbacks"].tolist() == [1.0, 0.0]
    assert summary["note"].tolist() == ["100% of decisions by a fallback", ""]
    assert [label.get_text() for label in found.plot().axes[0].get_xticklabels()] == [
        "bad\n100% fallbacks",
        "good",
    ]
    assert "fallbacks" in str(found)
    found = evaluate(Tank, {"plain": {"filler": one}}, seeds=range(2), points=POINTS)
    assert "fallbacks" not in found.frame
    assert "fallbacks" not in found.summary()


async def two_outside_clones(observation, *, _decision):
    assert not _decision.in_clone
    return 2


def then_the_rule(observation, *, _decision):
    return 2 if _decision.number == 1 else RULE


@pytest.mark.parametrize("method", ["fork", "replay"])
@pytest.mark.parametrize(
    ("policy", "plain"),
    [
        (two_outside_clones, then_the_rule),
        (RecordedPolicy(two, os.devnull), then_the_rule),
        (FallbackPolicy(illegal, two), two),
        (FallbackPolicy(illegal_later, two), two),
    ],
)
def test_fallback_policy_does_not_count_in_clones_and_branches(policy, plain, method):
    def begun(policy):
        env = single_env(Tank, POINTS, agent="drainer", policies={"filler": policy})
        env.reset(seed=1)
        return env

    def rest(env, number=0):
        return [float(env.step(0)[1]) for _ in range(Tank.days)]

    env = begun(policy)
    before = getattr(policy, "counts", None)
    twin = clone(env, method=method)
    assert [rest(twin)] == branch(env, rest, method=method) == [rest(begun(plain))]
    assert getattr(policy, "counts", None) == before
    twin.close()
    assert rest(env) == rest(begun(two))


def test_fallback_policy_copies_and_pickles_share_their_counts():
    guarded = FallbackPolicy(raises)
    played(copy.deepcopy(guarded))
    played(pickle.loads(pickle.dumps(guarded)))
    assert guarded.counts == counted(asked=10, failed=10, fallbacks=10)
