"""Section 5.10 of the contract, and models with stacks: SimPy, generators, greenlets, asyncio."""

import asyncio
import gc
import re
import sys

import greenlet
import pytest
import simpy

from simenv_marl import RULE, aec_env, difference, single_env
from tests.worlds.models import begun, calling, decision, decisions, play, script, stacks, unwinding

# -- nested ---------------------------------------------------------------------------------------


INNER = decision(lambda: "inner rule", agent="inner_0", reward_mapping=difference(lambda: 1))


def inner_env():
    return single_env(calling(*[INNER] * 3), INNER)


def run_inner(env, action):
    env.reset()
    while not env.step(action)[2]:
        pass
    return env.simulation.log


@pytest.mark.parametrize(
    "place",
    [
        "rule",
        "observation_space_mapping",
        "reward_mapping",
        "action_space_mapping",
        "agent",
        "policy",
    ],
)
def test_models_mappings_and_policies_can_run_an_env_of_their_own(place):
    inner, logs = inner_env(), []
    value = {"observation_space_mapping": [0, 0], "reward_mapping": 0, "agent": "outer_0"}.get(
        place, 7
    )

    def nested(*args):
        logs.append([list(run_inner(inner, action)) for action in (4, RULE)])
        return value

    other, given = decision(agent="other_0"), {"agent": "outer_0"}
    if place not in ("rule", "policy"):
        given[place] = nested
    outer = decision(nested if place == "rule" else None, **given)
    policies = {outer: nested} if place == "policy" else None
    env = aec_env(calling(outer, other, outer, INNER), [outer, other, INNER], policies=policies)
    turns = play(env, {"outer_0": RULE if place == "rule" else 7, "other_0": 7, "inner_0": 7})
    # What the inner environment decides is no decision of the outer one, although that has the same
    # point.
    asked = ["outer_0", "other_0", "outer_0", "inner_0"]
    assert decisions(turns) == [agent for agent in asked if place != "policy" or agent != "outer_0"]
    assert env.simulation.log == [7, 7, 7, 7]
    assert logs
    assert all(log == [[4, 4, 4], ["inner rule"] * 3] for log in logs)


def test_env_errors_pass_through_deeply_nested_environments():
    def nested(depth):
        decide = decision(lambda: nested(depth - 1) if depth else 1 / 0, agent=f"deep_{depth}")
        run_inner(single_env(calling(decide), decide), RULE)

    outer = decision(lambda: nested(5), agent="outer_0")
    env = begun(single_env(calling(outer), outer))
    with pytest.raises(ZeroDivisionError) as caught:
        env.step(RULE)
    agents = [re.search(r"(deep|outer)_\d", note)[0] for note in caught.value.__notes__]
    assert agents == [*(f"deep_{depth}" for depth in range(6)), "outer_0"]
    env.reset()
    env.step(1)


def test_dropped_env_unwinds_environments_nested_in_its_model():
    before, unwound, outer = stacks(), [], decision(agent="outer_0")

    def main(simulation):
        simulation.inner = single_env(unwinding(INNER, unwound), INNER)
        simulation.inner.reset()
        try:
            outer()
        finally:
            unwound.append("outer")

    env = begun(single_env(script(main), outer))
    del env
    assert not stacks(before)
    assert sorted(unwound) == ["outer", "unwound"]


def test_env_can_be_stepped_from_a_users_greenlets():
    decide = decision()
    env = begun(single_env(calling(*[decide] * 6), decide))
    for number in range(6):
        assert greenlet.greenlet(env.step).switch(number)[2] == (number == 5)
    assert env.simulation.log == list(range(6))


# -- SimPy ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["collect", "error"])
def test_env_close_unwinds_all_processes_of_a_simpy_model(how):
    before, unwound, decide = stacks(), [], decision(lambda: 1 / 0)

    def process(env, number):
        try:
            yield env.timeout(1)
            decide()
        finally:
            unwound.append(number)

    def main(simulation):
        env = simpy.Environment()
        env.run(env.all_of([env.process(process(env, n)) for n in range(3)]))

    gym = begun(single_env(script(main), decide))
    if how == "error":
        # SimPy keeps the error of a process until those that wait for it are told
        for n in range(2):
            assert len(unwound) == n
            gym.step(RULE)
        with pytest.raises(ZeroDivisionError):
            gym.step(RULE)
    del gym
    gc.collect()
    assert set(unwound) == {0, 1, 2}
    assert not stacks(before)


# -- greenlets of the model ------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["end", "collect"])
def test_greenlets_that_a_model_starts_can_decide_and_unwind(how):
    before, unwound = stacks(), []
    decide = decision(lambda name: name, agent=lambda name: f"{name}_0")

    def worker(name):
        parent = greenlet.getcurrent().parent
        try:
            for _ in range(2):
                parent.switch(decide(name))
        finally:
            unwound.append(name)

    def main(simulation):
        workers = {name: greenlet.greenlet(worker) for name in "ab"}
        for _ in range(3):
            for name, work in workers.items():
                simulation.log.append(work.switch(name))
            simulation.log.append(decide("m"))

    env = aec_env(script(main), decide)
    if how == "end":
        turns = play(env, lambda agent, env: len(env.simulation.log))
        assert decisions(turns) == ["a_0", "b_0", "m_0"] * 2 + ["m_0"]
        assert env.simulation.log == [0, 1, 2, 3, 4, 5, None, None, 8]
    else:
        env.reset()
        for number in range(4):
            env.step(number)
    del env
    assert not stacks(before)
    assert sorted(unwound) == ["a", "b"]


# -- asyncio --------------------------------------------------------------------------------------


def test_interleaved_envs_of_asyncio_models_do_not_affect_each_other():
    """Clerks work concurrently on one event loop; each decides how many rounds a task takes."""

    async def few(number):
        await asyncio.sleep(0)
        return number % 3

    rounds, bonus = decision(few, agent="clerk_0"), decision(lambda number: 1, agent="boss_0")

    async def clerk(number, log):
        taken = await rounds(number)
        for _ in range(taken):
            await asyncio.sleep(0)
        log.append((number, taken, bonus(number)))

    async def work(log):
        await asyncio.gather(*[clerk(number, log) for number in range(4)])

    office = script(lambda simulation: asyncio.run(work(simulation.log)))
    envs = [aec_env(office, points) for points in (rounds, bonus, [rounds, bonus])]
    for env in envs:
        env.reset()
    while any(env.agents for env in envs):
        for env in envs:
            if env.agents:
                env.step(None if env.last()[2] else RULE)
    plain = begun(office())
    plain.run()
    assert [env.simulation.log for env in envs] == [plain.log] * 3
    turns = play(envs[2], {"clerk_0": iter([3, 2, 1, 0]), "boss_0": 7})
    assert envs[2].unwrapped.simulation.log == [(3, 0, 7), (2, 1, 7), (1, 2, 7), (0, 3, 7)]
    assert sorted(decisions(turns)) == ["boss_0"] * 4 + ["clerk_0"] * 4


# -- depth ----------------------------------------------------------------------------------------


@pytest.mark.usefixtures("_collected")
def test_env_allows_models_the_full_recursion_depth():
    decide = decision()

    def dive(depth):
        return decide() if depth == 0 else dive(depth - 1)

    depth = sys.getrecursionlimit() - 200
    env = begun(single_env(calling(*[lambda: dive(depth)] * 2), decide))
    env.step(1)
    env.step(2)
    assert env.simulation.log == [1, 2]
